"""Judgement of poses and solutions: observability, conventions, and notes on a solution."""
