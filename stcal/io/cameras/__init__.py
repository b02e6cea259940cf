"""Cameras of other programs, and the difference between two cameras."""
