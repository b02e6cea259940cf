"""Hand-eye calibration: where a camera sits on a robot's flange, or beside the robot, and how well that is known."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
