"""Robots: model, robot file, forward and inverse kinematics, and measured data."""
