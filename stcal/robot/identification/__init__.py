"""Kinematic parameters from poses, positions or distances."""
