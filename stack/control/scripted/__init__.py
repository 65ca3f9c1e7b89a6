"""The expert under a script that has the upper body do something else: a style, a box that is carried."""
