"""Instructions in plain English: the motions that can be asked for, their phrasings, and numbers a network can read."""
