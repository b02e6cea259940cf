"""A planar target of several tags: its calibration, where it is under any light, and whether that may be trusted."""
