"""Geometry that every system shares: numpy and scipy only, mm, px and rad, pixel centres on integers."""
