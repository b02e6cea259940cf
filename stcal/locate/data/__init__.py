"""Data of locate: the target's layout, its scenes, and the photographs of its calibration."""
