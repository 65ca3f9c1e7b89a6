"""`servoid motions`: making, playing, checking and changing clips."""
