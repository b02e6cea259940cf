"""Verdict on a pose, each value with its limit, and accept, ambiguous or reject; and the mistake in a layout that would
explain why it fits badly."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from scipy.stats import chi2 as chi_square

from stcal.errors import InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.plane import deciding_delta
from stcal.geometry.rigid import Poses
from stcal.io.cameras.camera_model import CameraPrior
from stcal.locate.estimate import ObjPose, SeenTags, covering_both, locate, reprojection_rms
from stcal.locate.layout import TargetLayout

Decision = Literal["accept", "ambiguous", "reject"]


@dataclass(frozen=True, slots=True)
class VerdictOptions:
    """Limits of the verdict.

    Parameters
    ----------
    min_tags : int
        Least number of tags used.
    min_spread_px : float
        Least extent of the corners across their longer direction.
    min_foreshortening : float
        Least cosine between the target's normal and the line of sight. It replaces det J for a target of any size
        and distance.
    max_p : float
        Significance level: a pose is rejected if its residuals are so large that chance makes them more rarely.
    flip_odds : float
        Largest odds of the second solution, for Gaussian errors.
    sigma_margin : float
        Factor by which all σ may be too small while ``flip_odds`` still holds.
    equal_deg : float
        Two solutions nearer than this count as one, whose covariance covers both.
    max_sigma_deg, max_sigma_mm : float
        Largest σ of rotation and position in their worst direction; no limit if None.
    """

    min_tags: int = 1
    min_spread_px: float = 12.0
    min_foreshortening: float = 0.17
    max_p: float = 1e-4
    flip_odds: float = 1e-6
    sigma_margin: float = 1.5
    equal_deg: float = 1.0
    max_sigma_deg: float = 2.0
    max_sigma_mm: float | None = None

    def __post_init__(self):
        require_fields(self, "verdict", min_foreshortening=0, equal_deg=0)
        odds = all(0 < value < 1 for value in (self.max_p, self.flip_odds))
        if not (odds and self.sigma_margin >= 1 and self.min_tags >= 1):
            raise InputError(
                "E-OPTION-RANGE",
                f"verdict: odds {self.max_p:g} and {self.flip_odds:g}, margin {self.sigma_margin:g}, {self.min_tags} "
                "tags: odds between 0 and 1, a margin and a number of at least 1 needed",
            )
        for value, unit in ((self.max_sigma_deg, "°"), (self.max_sigma_mm or 0.0, " mm"), (self.min_spread_px, " px")):
            if not 0 <= value < np.inf:
                raise InputError("E-OPTION-RANGE", f"verdict: limit {value:g}{unit}; a number of at least 0 needed")


@dataclass(frozen=True, slots=True)
class PoseCheck:
    """One value and its limit: ``value`` must not be less than ``at_least``, or not greater than ``at_most``."""

    KEYS: ClassVar = "name value at_least at_most unit passed"
    name: str
    value: float
    at_least: float | None = None
    at_most: float | None = None
    unit: str = ""

    @property
    def passed(self) -> bool:
        """True if the value keeps its limit; False for NaN."""
        low = self.at_least is None or self.value >= self.at_least
        return low and (self.at_most is None or self.value <= self.at_most)

    def text(self) -> str:
        """Returns the check in words: ``foreshortening 0.11, at least 0.17 needed``."""
        limit = f"at least {self.at_least:.3g}" if self.at_least is not None else f"at most {self.at_most:.3g}"
        return f"{self.name} {self.value:.3g}{self.unit}, {limit}{self.unit} needed"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Verdict(Brief):
    """Verdict on whether a pose may be used.

    Parameters
    ----------
    decision : {"accept", "ambiguous", "reject"}
        Ambiguous: χ² of the second solution is not sufficiently larger.
    checks : tuple of PoseCheck
        All values with their limits.
    reasons : tuple of str
        Failed checks, in words.
    """

    decision: Decision
    checks: tuple[PoseCheck, ...]
    reasons: tuple[str, ...]


def judge(pose: ObjPose, options: VerdictOptions | None = None) -> tuple[ObjPose, Verdict]:
    """Judges a pose. Returns the pose, its covariance widened where two solutions count as one, and the verdict."""
    options = options or VerdictOptions()
    apart_deg = 0.0
    if pose.second is not None:
        difference = Poses.of([pose.second]).difference(Poses.of([pose.camera_from_obj]))[0]
        apart_deg = float(np.degrees(np.linalg.norm(difference[:3])))
        if apart_deg <= options.equal_deg:
            pose = covering_both(pose)
    chi2_limit = options.sigma_margin**2 * float(chi_square.isf(options.max_p, pose.redundancy) / pose.redundancy)
    checks = [
        PoseCheck("tags", len(pose.rows), at_least=options.min_tags),
        PoseCheck("spread", pose.extent_px, at_least=options.min_spread_px, unit=" px"),
        PoseCheck("foreshortening", pose.foreshortening, at_least=options.min_foreshortening),
        PoseCheck("chi2 per dof", pose.chi2_per_redundancy(), at_most=chi2_limit),
        PoseCheck("sigma of rotation", float(np.degrees(pose.sigma_rad())), at_most=options.max_sigma_deg, unit="°"),
    ]
    if options.max_sigma_mm is not None:
        checks.append(PoseCheck("sigma of position", pose.sigma_mm(), at_most=options.max_sigma_mm, unit=" mm"))
    failed = tuple(check.text() for check in checks if not check.passed)
    needed_delta = deciding_delta(options.flip_odds, options.sigma_margin, pose.chi2_per_redundancy())
    checks.append(PoseCheck("delta chi2 of the other pose", pose.delta_chi2, at_least=needed_delta))
    if failed:
        return pose, Verdict("reject", tuple(checks), failed)
    if checks[-1].passed or apart_deg <= options.equal_deg:
        return pose, Verdict("accept", tuple(checks), ())
    return pose, Verdict("ambiguous", tuple(checks), (f"two poses {apart_deg:.1f}° apart: {checks[-1].text()}",))


LEAST_TAGS = 2
"""A single tag fits each way round."""
FITS = 0.02
"""Largest RMS distance of corners from where a layout has them, over the mean side of the tags in the image. A tag that
is turned or elsewhere misses by half a side and more; lens and print by less than a hundredth."""
BETTER = 3.0
"""Factor by which this distance must shrink for a mistake to be named."""
ALIKE = 1.5
"""Mistakes that fit within this factor of the best one fit as well: the first of them is named, the simplest."""
TURNS = {
    2: "every tag stood half a turn the other way (add 180 to each angle_deg; corners_mm begin at the opposite corner; "
    "of apriltag_ros give upright: true)",
    1: "every tag were turned by 90° more (add 90 to each angle_deg)",
    3: "every tag were turned by 90° less (subtract 90 from each angle_deg)",
}
MIRRORED = "Y pointed down (the layout has it upwards: change the signs of y_mm{})"


def likely_mistake(
    detected: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None, pose: ObjPose | None
) -> str | None:
    """Returns the mistake in a layout whose correction makes all tags fit, or None; ``pose`` : by it as it is."""
    if len(detected) < LEAST_TAGS:
        return None
    side = np.linalg.norm(detected.corners_px - np.roll(detected.corners_px, 1, axis=1), axis=2).mean()
    allowed = FITS * float(side)
    if pose is not None:
        allowed = min(allowed, _misfit_px(detected, layout, camera, pose) / BETTER)

    def misfit(corners_mm: np.ndarray) -> float:
        variant = replace(layout, corners_mm=corners_mm)
        return _misfit_px(detected, variant, camera, locate(detected, variant, camera, prior))

    candidates = _mistakes(layout.corners_mm)
    found = [candidate for candidate, _ in explain(candidates, misfit, allowed, ALIKE)]
    return next((each.words for each in candidates if each in found), None)


def _misfit_px(detected: SeenTags, layout: TargetLayout, camera: Camera, pose: ObjPose) -> float:
    """Returns the RMS distance of all corners, those left out by the pose too, from where the layout has them."""
    if pose.foreshortening <= 0:
        return np.inf
    xy = layout.corners_mm[detected.rows].reshape(-1, 2)
    return reprojection_rms(pose.camera_from_obj, xy, detected.corners_px.reshape(-1, 2), camera)


def _mistakes(corners: np.ndarray) -> list[Candidate]:
    """Returns each mistake with the corners as they would be without it, the simplest first."""
    down = np.array([1.0, -1.0])
    # A mirrored tag has its upper corners where the lower ones were.
    mirrored = (corners * down)[:, [3, 2, 1, 0]]
    middles = corners.mean(axis=1, keepdims=True)
    moved = corners - middles + middles * down
    found = [(words, np.roll(corners, -turns, axis=1)) for turns, words in TURNS.items()]
    for words, other in ((MIRRORED.format(" and angle_deg"), mirrored), (MIRRORED.format(""), moved)):
        found += [(words, other), (f"{words} and {TURNS[2]}", np.roll(other, 2, axis=1))]
    return [Candidate(words, lambda other=other: other) for words, other in found]
