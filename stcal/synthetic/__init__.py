"""Simulated targets, boards and photographs with known truth."""
