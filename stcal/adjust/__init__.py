"""Least squares of one's own: blocks of unknowns, factors that tie them, and what the answer is worth."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
