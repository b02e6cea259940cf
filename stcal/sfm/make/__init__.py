"""Targets to be made: patterns that cannot be mistaken for one another."""
