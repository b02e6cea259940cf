"""Circles in the pixels of a photograph: outlines, ellipses, centres to the sub-pixel with their covariances."""
