"""Keyframes that a person makes at the operator's page: poses, times, a try in physics, and a clip of them."""
