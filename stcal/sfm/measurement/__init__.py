"""Measurement of the pose of a calibrated target in images."""
