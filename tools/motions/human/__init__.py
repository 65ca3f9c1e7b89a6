"""Motions of people: where points of their bodies are, out of files of motion capture."""
