"""Simulation of targets, boards and photographs with known truth."""
