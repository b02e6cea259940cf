"""Pose of a target in one scene, and whether it may be trusted."""
