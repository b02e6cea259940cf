"""Hand-eye calibration: where a camera is mounted on a robot's flange, or stands in its base, with σ."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
