"""Robots as URDF, in metres and rad."""
