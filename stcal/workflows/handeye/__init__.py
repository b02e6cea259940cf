"""Hand-eye calibration from files or images of any board, beside a robot file, or of a rig."""
