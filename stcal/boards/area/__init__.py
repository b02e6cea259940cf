"""Measuring edges by the areas of pixels."""
