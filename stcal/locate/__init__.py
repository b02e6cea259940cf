"""A planar target of several tags: its calibration, its pose under any light, and whether the pose may be trusted."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
