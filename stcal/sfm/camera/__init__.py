"""Intrinsics from photographs of the board."""
