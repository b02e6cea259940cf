"""A registration for people and for programs."""
