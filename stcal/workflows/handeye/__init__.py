"""Hand-eye calibration from files or images of any board, with a robot file if wanted."""
