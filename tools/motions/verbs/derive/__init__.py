"""The verbs of `servoid motions` that make a clip of what is there: of other clips, or of the gait."""
