"""Verdict on a pose, and the mistake in a layout that explains a bad fit; for comparison, the method of the CN patent
"monocular visual target positioning" (Anhui Yuanguji), steps S5 to S9."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.special import chdtri

from stcal.boards.board_designs import mean_sides
from stcal.boards.tags import Tags
from stcal.errors import DegenerateError, InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.plane import covariance_of_both, deciding_delta, poses_of_plane
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.locate.estimate import ObjPose, SeenTags, locate, reprojection_rms
from stcal.locate.layout import TargetLayout
from stcal.locate.layout_calibration import plane_points

Decision = Literal["accept", "ambiguous", "reject"]


@dataclass(frozen=True, slots=True)
class VerdictOptions:
    """Limits of the verdict.

    Parameters
    ----------
    min_tags : least number of tags used.
    min_spread_px : least extent of the corners across their longer direction.
    min_foreshortening : least cosine between the target's normal and the line of sight. It replaces det J for a target
        of any size and distance.
    max_p : significance level: a pose is rejected if its residuals are so large that chance makes them more rarely.
    flip_odds : largest odds of the second solution, for Gaussian errors.
    sigma_margin : factor by which all σ may be too small while ``flip_odds`` still holds.
    equal_deg : two solutions nearer than this count as one, whose covariance covers both.
    max_sigma_deg, max_sigma_mm : largest σ of rotation and position in their worst direction; no limit if None.
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
            given = f"odds {self.max_p:g} and {self.flip_odds:g}, margin {self.sigma_margin:g}, {self.min_tags} tags"
            needed = "odds between 0 and 1, a margin and a number of at least 1 needed"
            raise InputError("E-OPTION-RANGE", f"verdict: {given}: {needed}")
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

    ``decision`` : accept, reject, or ambiguous if χ² of the second solution is not sufficiently larger; ``checks`` :
    all values with their limits; ``reasons`` : failed checks, in words.
    """

    decision: Decision
    checks: tuple[PoseCheck, ...]
    reasons: tuple[str, ...]


def judge(pose: ObjPose, options: VerdictOptions | None = None) -> tuple[ObjPose, Verdict]:
    """Judges a pose. Returns the pose, its covariance widened where two solutions count as one, and the verdict."""
    options = options or VerdictOptions()
    apart_deg = 0.0
    if pose.second is not None:
        away = pose.second.difference(pose.camera_from_obj)
        apart_deg = float(np.degrees(np.linalg.norm(away[:3])))
        if apart_deg <= options.equal_deg:
            pose = replace(pose, covariance=covariance_of_both(pose.covariance, away, pose.delta_chi2))
    chi2_limit = options.sigma_margin**2 * float(chdtri(pose.redundancy, options.max_p) / pose.redundancy)
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


FITS, BETTER = 0.02, 3.0
"""Largest RMS distance of corners from where a layout has them, over the mean side of the tags; factor by which it must
shrink for a mistake to be named. A wrong tag misses by half a side and more; lens and print by less than 0.01."""
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
    if len(detected) < 2:  # a single tag fits each way round
        return None
    allowed = FITS * float(mean_sides(detected.corners_px).mean())
    if pose is not None:
        allowed = min(allowed, _misfit_px(detected, layout, camera, pose) / BETTER)

    def misfit(corners_mm: np.ndarray) -> float:
        variant = replace(layout, corners_mm=corners_mm)
        return _misfit_px(detected, variant, camera, locate(detected, variant, camera, prior))

    candidates = [*_mistakes(layout.corners_mm), *_other_size(detected, layout, camera, pose)]
    found = [candidate for candidate, _ in explain(candidates, misfit, allowed, ALIKE)]
    return next((each.words for each in candidates if each in found), None)


def _misfit_px(detected: SeenTags, layout: TargetLayout, camera: Camera, pose: ObjPose) -> float:
    """Returns the RMS distance of all corners, those left out by the pose too, from where the layout has them."""
    if pose.foreshortening <= 0:
        return np.inf
    xy = layout.corners_mm[detected.rows].reshape(-1, 2)
    return reprojection_rms(pose.camera_from_obj, xy, detected.corners_px.reshape(-1, 2), camera)


def _other_size(detected: SeenTags, layout: TargetLayout, camera: Camera, pose: ObjPose | None) -> Iterator[Candidate]:
    """Yields the layout with tags of the size, about their middles, at which the image has them."""
    if pose is None:
        return
    stated, rays = layout.corners_mm[detected.rows], camera.normalised_from_pixel(detected.corners_px.reshape(-1, 2))
    seen = plane_points(pose.camera_from_obj, rays).reshape(stated.shape)
    middle_seen, middle = (corners.mean(axis=1, keepdims=True) for corners in (seen, stated))
    apart = [float(np.linalg.norm(places - places.mean(axis=0))) for places in (middle_seen, middle)]
    size = float(np.median(np.linalg.norm(seen - middle_seen, axis=2) / np.linalg.norm(stated - middle, axis=2)))
    times, every = size * apart[1] / apart[0], layout.corners_mm.mean(axis=1, keepdims=True)
    words = f"every tag were {times:.3g} times as large (multiply each size_mm by that)"
    yield Candidate(words, lambda: every + times * (layout.corners_mm - every))


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


ASSUMED = (
    "assumed where the text has no formula or no value: E_res is the larger reprojection error over the smaller; "
    "errors are RMS over the corners; exposures form a geometric series; S_dis, J_lim, E_lim and E_ratio as given"
)
SAME_RAD, SAME_SHARE = 1e-3, 1e-3
"""T_a and T_b are the same pose if they differ by less: in rotation, and in translation as a share of the distance."""


@dataclass(frozen=True, slots=True)
class PatentOptions:
    """Thresholds of the patent, which names them but gives no values.

    Parameters
    ----------
    area_share : S_dis, least area that an exposure's tags span, as a share of the largest area.
    min_det_j : J_lim, 1/mm². A target of any size that is seen frontally from 10 m has 10⁻⁸.
    max_error_px : E_lim, largest RMS error.
    min_error_ratio : E_ratio, least ratio of the second solution's error to the first's.
    """

    area_share: float = 0.8
    min_det_j: float = 1e-8
    max_error_px: float = 1.0
    min_error_ratio: float = 2.0

    def __post_init__(self):
        require_fields(self, "patent", min_det_j=0)
        if not (0 <= self.area_share < 1 and self.max_error_px > 0 and self.min_error_ratio >= 1):
            given = f"S_dis {self.area_share:g}, E_lim {self.max_error_px:g}, E_ratio {self.min_error_ratio:g}"
            needed = "0 to less than 1, a positive number and 1 or more needed"
            raise InputError("E-OPTION-RANGE", f"patent: {given}: {needed}")


@dataclass(frozen=True, slots=True, eq=False)
class PatentExposure:
    """Result of one exposure by the patent's method."""

    exposure: int
    tags: int  # of the layout
    area_px2: float | None = None  # of their triangles; None if others show more
    candidate: bool = False  # compared with others
    poses: tuple[Rigid, Rigid] | None = None  # T_a, T_b by ``errors_px``
    errors_px: tuple[float, float] | None = None
    det_j: float | None = None  # of the homography's derivative at the normalised centre, 1/mm²


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PatentPose(Brief):
    """Result of the patent's method for one scene.

    ``exposure`` : index of the exposure that was chosen; ``candidates`` : indices of the exposures whose poses were
    compared; ``camera_from_obj`` : the better pose; ``second`` : the second solution; ``errors_px`` : (float, float)
    RMS errors of both poses in the chosen exposure, the smaller first; ``det_j`` : determinant of the homography's
    derivative at the normalised centre, 1/mm²; ``tags`` : number of tags used; ``verdict`` : verdict of the patent's
    gate; ``exposures`` : results of all exposures, in their order; ``same`` : whether both poses are the same.
    """

    exposure: int
    candidates: tuple[int, ...]
    camera_from_obj: Rigid
    second: Rigid
    errors_px: tuple[float, float]
    det_j: float
    tags: int
    verdict: Verdict
    exposures: tuple[PatentExposure, ...] = ()
    same: bool = False


def largest_area(corners: Sequence[np.ndarray], share: float) -> tuple[dict[int, float], list[int]]:
    """Returns the areas, px², that the exposures with the most tags span, and those of these exposures that span more
    than ``share`` of the largest (S5); ``corners`` : (k, 4, 2) px of each exposure."""
    most = max(map(len, corners))
    area = {i: 0.0 for i, each in enumerate(corners) if len(each) == most}
    for i in area:  # Delaunay's triangles fill the convex hull
        with suppress(QhullError):  # collinear points span nothing
            area[i] = float(ConvexHull(corners[i].reshape(-1, 2)).volume)
    return area, [i for i in area if area[i] > share * max(area.values())]


def locate_as_patent(
    exposures: Sequence[Tags], layout: TargetLayout, camera: Camera, options: PatentOptions, where: str = "scene"
) -> PatentPose:
    """Applies the gate (S5 to S9) to the exposure of least IPPE error; raises DegenerateError: no tag, or no pose."""
    rows = layout.rows()
    listed = [[k for k, tag in enumerate(tags.tags) if tag in rows] for tags in exposures]
    corners = [tags.corners_px[of_layout] for tags, of_layout in zip(exposures, listed, strict=True)]
    if not any(listed):
        raise DegenerateError("E-LOCATE-NO-TAG", f"{where}: no tag of the layout; 1 needed")
    area, chosen = largest_area(corners, options.area_share)
    results = [PatentExposure(i, len(of_layout), area.get(i), i in chosen) for i, of_layout in enumerate(listed)]
    best: PatentPose | None = None
    for i in chosen:
        xy = layout.corners_mm[[rows[exposures[i].tags[k]] for k in listed[i]]].reshape(-1, 2)
        pixels = corners[i].reshape(-1, 2)
        try:
            found = poses_of_plane(xy, camera.normalised_from_pixel(pixels))
        except DegenerateError:
            continue
        (low, first), (high, second) = sorted(
            ((reprojection_rms(pose, xy, pixels, camera), pose) for pose in found.poses), key=lambda each: each[0]
        )
        results[i] = replace(results[i], poses=(first, second), errors_px=(low, high), det_j=found.determinant)
        if best is None or low < best.errors_px[0]:
            shift = np.linalg.norm(first.translation - second.translation)
            same = (first @ second.inverse()).angle_rad() < SAME_RAD  # T_a and T_b are equivalent (S8)
            same = bool(same and shift < SAME_SHARE * np.linalg.norm(first.translation))
            verdict = gate(found.determinant, low, high / max(low, 1e-9), same, options)
            figures = (low, high), found.determinant, len(listed[i])
            best = PatentPose(i, tuple(chosen), first, second, *figures, verdict, same=same)
    if best is None:
        fault = f"{where}: no pose explains the tags' corners in any exposure"
        raise DegenerateError("E-LOCATE-NO-POSE", f"{fault}; check layout and camera file")
    return replace(best, exposures=tuple(results))


def gate(det_j: float, error_px: float, error_ratio: float, same: bool, options: PatentOptions) -> Verdict:
    """Accepts if det J, the error, and (for two different poses) the ratio of the errors keep their limits (S9)."""
    checks = [
        PoseCheck("det J", det_j, at_least=options.min_det_j, unit="/mm²"),
        PoseCheck("error", error_px, at_most=options.max_error_px, unit=" px"),
    ]
    if not same:
        checks.append(PoseCheck("error ratio", error_ratio, at_least=options.min_error_ratio))
    failed = tuple(check.text() for check in checks if not check.passed)
    return Verdict("reject" if failed else "accept", tuple(checks), failed)
