"""Robots: what they are, their file, forward and inverse kinematics, and what was measured on them."""
