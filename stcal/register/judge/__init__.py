"""Checks whether the points determine the transform, and of mistakes in the data."""
