"""The calibrated target at work: its pose in each image."""
