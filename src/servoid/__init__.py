"""Servoid: a ROS-free control stack for servo humanoids.

The packages are the folders at the top of the repository, linked here so that they are imported as `servoid.hw` and so
on, whatever else is called `hw`, `sim` or `tools` where Python looks.
"""
