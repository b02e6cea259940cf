"""Poses, rotations and tables as other programs, instruments and controllers of robots write them."""
