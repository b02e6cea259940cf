"""Calibration of the target."""
