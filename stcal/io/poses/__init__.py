"""Rotations as other programs and controllers of robots write them."""
