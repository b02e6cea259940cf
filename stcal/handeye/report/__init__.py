"""A hand-eye calibration for people and for other programs."""
