"""Identification of a robot's kinematic parameters from poses, positions or distances."""
