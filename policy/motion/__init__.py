"""Recorded and authored motions: clips, and libraries of them."""
