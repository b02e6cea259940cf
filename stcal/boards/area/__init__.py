"""Edges by the dark and bright areas of pixels: the profile of a step, and how sampling displaces lines."""
