"""Flat boards and tags of other makers: their designs, their files, and detection of their corners in an image."""
