"""Evaluation by the simulation's truth."""
