"""Data that the stages hand to each other: labelled observations, and models of groups."""
