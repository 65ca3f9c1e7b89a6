"""The verbs of `servoid motions`, a module each."""
