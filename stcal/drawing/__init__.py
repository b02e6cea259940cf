"""Drawings of targets and boards, 1:1 in mm, as PDF and SVG."""
