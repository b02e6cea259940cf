"""Hand-eye calibration: where a camera sits on a robot's flange, or beside the robot, and how well that is known."""

from stcal.front import front

front(__name__, __file__)
