"""Workflows that need several systems at once. Only workflows compose systems."""
