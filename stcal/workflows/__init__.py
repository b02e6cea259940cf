"""Workflows that need several systems at once. Only workflows compose systems."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
