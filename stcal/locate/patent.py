"""The method of the CN patent "monocular visual target positioning" (Anhui Yuanguji), steps S5 to S9, for comparison.

The steps follow the text of the patent. Every step is a function that can be replaced.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import Delaunay, QhullError

from stcal.boards.tags import Tags
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.plane import PlanePoses, poses_of_plane
from stcal.geometry.rigid import Rigid
from stcal.locate.estimate import reprojection_rms
from stcal.locate.layout import TargetLayout
from stcal.locate.verdict import PoseCheck, Verdict

ASSUMED = (
    "assumed where the text has no formula or no value: E_res is the larger reprojection error over the smaller; "
    "errors are RMS over the corners; exposures form a geometric series; S_dis, J_lim, E_lim and E_ratio as given"
)
SAME_RAD, SAME_SHARE = 1e-3, 1e-3
"""T_a and T_b are the same pose if they differ by less: in rotation, and in translation as a share of the distance."""
TINY_PX = 1e-9
"""Error that stands for an exact fit in the ratio of errors, in px."""


@dataclass(frozen=True, slots=True)
class PatentOptions:
    """Thresholds of the patent, which names them but gives no values.

    Parameters
    ----------
    area_share : float
        S_dis, least area that an exposure's tags span, as a share of the largest area.
    min_det_j : float
        J_lim, 1/mm². A target of any size that is seen frontally from 10 m has 10⁻⁸.
    max_error_px : float
        E_lim, largest RMS error.
    min_error_ratio : float
        E_ratio, least ratio of the second solution's error to the first's.
    """

    area_share: float = 0.8
    min_det_j: float = 1e-8
    max_error_px: float = 1.0
    min_error_ratio: float = 2.0

    def __post_init__(self):
        require_fields(self, "patent", min_det_j=0)
        if not (0 <= self.area_share < 1 and self.max_error_px > 0 and self.min_error_ratio >= 1):
            raise InputError(
                "E-OPTION-RANGE",
                f"patent: S_dis {self.area_share:g}, E_lim {self.max_error_px:g}, E_ratio {self.min_error_ratio:g}: "
                "0 to less than 1, a positive number and 1 or more needed",
            )


@dataclass(frozen=True, slots=True, eq=False)
class PatentExposure:
    """``tags`` : of the layout in exposure number ``exposure``; ``area_px2`` : of their triangles; None if others show
    more; ``candidate`` : compared with others; ``poses`` : T_a, T_b by ``errors_px``, or None; ``det_j`` : of the
    homography's derivative at the normalised centre, 1/mm²."""

    exposure: int
    tags: int
    area_px2: float | None = None
    candidate: bool = False
    poses: tuple[Rigid, Rigid] | None = None
    errors_px: tuple[float, float] | None = None
    det_j: float | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PatentPose(Brief):
    """Result of the patent's method for one scene.

    Parameters
    ----------
    exposure : int
        Index of the exposure that was chosen.
    candidates : tuple of int
        Indices of the exposures whose poses were compared.
    camera_from_obj : Rigid
        The better pose.
    second : Rigid
        The second solution.
    errors_px : (float, float)
        RMS errors of both poses in the chosen exposure, the smaller first.
    det_j : float
        Determinant of the homography's derivative at the normalised centre, 1/mm².
    tags : int
        Number of tags used.
    verdict : Verdict
        Verdict of the patent's gate.
    exposures : tuple of PatentExposure
        Results of all exposures, in their order.
    same : bool
        Whether both poses are the same.
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


def most_tags(corners: Sequence[np.ndarray]) -> list[int]:
    """Returns the indices of the exposures with the most tags (S5); ``corners`` : (k, 4, 2) px of each exposure."""
    most = max(len(each) for each in corners)
    return [i for i, each in enumerate(corners) if len(each) == most]


def largest_area(corners: Sequence[np.ndarray], chosen: Sequence[int], share: float) -> list[int]:
    """Returns the chosen exposures whose tags span more than ``share`` of the largest area (S5)."""
    area = {i: triangulated_area(corners[i].reshape(-1, 2)) for i in chosen}
    return [i for i in chosen if area[i] > share * max(area.values())]


def triangulated_area(points: np.ndarray) -> float:
    """Returns the sum of the Delaunay triangles' areas by Heron's formula, px²; 0 for collinear points."""
    try:
        triangles = points[Delaunay(points).simplices]
    except QhullError:
        return 0.0
    a, b, c = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).T
    s = (a + b + c) / 2
    return float(np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0)).sum())


def same_pose(a: Rigid, b: Rigid) -> bool:
    """True if T_a and T_b are equivalent (S8)."""
    difference = a @ b.inverse()
    shift = np.linalg.norm(a.translation - b.translation)
    return difference.angle_rad() < SAME_RAD and bool(shift < SAME_SHARE * np.linalg.norm(a.translation))


def locate_as_patent(
    exposures: Sequence[Tags],
    layout: TargetLayout,
    camera: Camera,
    options: PatentOptions | None = None,
    where: str = "scene",
    solve: Callable[[np.ndarray, np.ndarray], PlanePoses] = poses_of_plane,
) -> PatentPose:
    """Applies the gate (S5 to S9) to the exposure of least IPPE error; raises DegenerateError: no tag, or no pose."""
    options = options or PatentOptions()
    rows = layout.rows()
    listed = [[k for k, tag in enumerate(tags.tags) if tag in rows] for tags in exposures]
    corners = [tags.corners_px[of_layout] for tags, of_layout in zip(exposures, listed, strict=True)]
    if not any(listed):
        raise DegenerateError("E-LOCATE-NO-TAG", f"{where}: no tag of the layout; 1 needed")
    most = most_tags(corners)
    chosen = largest_area(corners, most, options.area_share)
    results = [PatentExposure(i, len(of_layout)) for i, of_layout in enumerate(listed)]
    for i in most:
        results[i] = replace(results[i], area_px2=triangulated_area(corners[i].reshape(-1, 2)), candidate=i in chosen)
    best: PatentPose | None = None
    for i in chosen:
        xy = layout.corners_mm[[rows[exposures[i].tags[k]] for k in listed[i]]].reshape(-1, 2)
        pixels = corners[i].reshape(-1, 2)
        try:
            found = solve(xy, camera.normalised_from_pixel(pixels))
        except DegenerateError:
            continue
        (low, first), (high, second) = sorted(
            ((reprojection_rms(pose, xy, pixels, camera), pose) for pose in found.poses), key=lambda each: each[0]
        )
        results[i] = replace(results[i], poses=(first, second), errors_px=(low, high), det_j=found.determinant)
        if best is None or low < best.errors_px[0]:
            same = same_pose(first, second)
            verdict = gate(found.determinant, low, high / max(low, TINY_PX), same, options)
            pair, count = (first, second, (low, high)), len(listed[i])
            best = PatentPose(i, tuple(chosen), *pair, found.determinant, count, verdict, same=same)
    if best is None:
        raise DegenerateError(
            "E-LOCATE-NO-POSE",
            f"{where}: no pose explains the tags' corners in any exposure; check layout and camera file",
        )
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
