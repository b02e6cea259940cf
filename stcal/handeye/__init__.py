"""Hand-eye calibration: where a camera sits on a robot's flange, or beside the robot, and how well that is known."""

from stcal.handeye.evolution import EvolutionOptions
from stcal.handeye.loop import SETUPS
from stcal.handeye.noise import Noise
from stcal.handeye.pairs import HandEyePoses, read_poses
from stcal.handeye.result import HandEye
from stcal.handeye.solve import METHODS, HandEyeOptions, handeye
from stcal.handeye.validate import Compared, HeldOut, compare, cross_validate, splits
from stcal.handeye.views import View, Views, pairs_of_views

__all__ = [
    "METHODS",
    "SETUPS",
    "Compared",
    "EvolutionOptions",
    "HandEye",
    "HandEyeOptions",
    "HandEyePoses",
    "HeldOut",
    "Noise",
    "View",
    "Views",
    "compare",
    "cross_validate",
    "handeye",
    "pairs_of_views",
    "read_poses",
    "splits",
]
