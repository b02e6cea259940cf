"""The target's own calibration."""
