"""Cameras of other programs, and how far two are apart."""
