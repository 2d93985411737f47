"""Surfaces: prediction, evaluation on photographs, and accuracy over time."""
