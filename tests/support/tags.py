"""Targets, poses and corners with known truth: corners as a detector would state them, without images. And how far
poses are off in photographs that also show a board: the target calibrated on some, found in others."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import UNIT_SQUARE
from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import camera_from_plane, fit_homography, mirrored, refine_planar_pose
from stcal.geometry.rigid import Poses, Rigid
from stcal.locate.estimate import SeenTags, locate, merge
from stcal.locate.layout import LayoutPlan, TargetLayout
from stcal.locate.layout_calibration import CalibratedLayout, CalibrationImages, calibrate
from stcal.locate.verdict import Decision, PatentOptions, VerdictOptions, judge, locate_as_patent

CAMERA = Camera(1600, 1200, [1350.0, 1350.0], [799.5, 599.5], [-0.1, 0.05, 0, 0, 0, 0, 0, 0])
PLACES = (
    ("DICT_APRILTAG_36h11", 0, 40.0, 0.0, 0.0),
    ("DICT_6X6_250", 11, 20.0, 60.0, -40.0),
    ("DICT_6X6_250", 12, 20.0, -60.0, -40.0),
    ("DICT_4X4_50", 3, 15.0, 60.0, 45.0),
    ("DICT_5X5_100", 7, 25.0, -60.0, 45.0),
    ("DICT_4X4_50", 8, 15.0, 0.0, 50.0),
)
"""Dictionary, id, side, x and y of the example's tags, mm."""


@dataclass(frozen=True, slots=True)
class CornerNoise:
    """``sigma_px`` of a corner's coordinate; ``shared`` : of its variance, what all exposures have in common."""

    sigma_px: float = 0.05
    shared: float = 0.5


def example_layout(sigma_mm: float = 0.03, sigma_px: float = 0.0) -> TargetLayout:
    """Six tags of four families and four sizes on 150 × 125 mm."""
    corners = np.array([size * UNIT_SQUARE + np.array([x, y]) for _, _, size, x, y in PLACES])
    tags = tuple((dictionary, tag) for dictionary, tag, *_ in PLACES)
    return TargetLayout("example", tags, corners, sigma_mm**2 * np.eye(corners.size), 0, sigma_px)


def random_pose(
    rng: np.random.Generator, distance_mm: float = 700.0, tilt_deg: tuple[float, float] = (10, 50)
) -> Rigid:
    """camera_from_obj: tilted by an angle of that range to any side, turned at will, near the middle of the image."""
    tilt = np.radians(rng.uniform(*tilt_deg))
    side, spin = rng.uniform(0, 2 * np.pi, 2)
    turn = Rotation.from_rotvec(tilt * np.array([np.cos(side), np.sin(side), 0])) * Rotation.from_rotvec([0, 0, spin])
    depth = distance_mm * rng.uniform(0.8, 1.25)
    return Rigid(turn.as_matrix(), [*(0.15 * depth * rng.uniform(-1, 1, 2)), depth])


def simulated_exposures(
    layout: TargetLayout,
    camera_from_obj: Rigid,
    rng: np.random.Generator,
    noise: CornerNoise | None = None,
    shown: Sequence[Sequence[int]] = ((0, 1, 2, 3, 4, 5),),
    camera: Camera = CAMERA,
) -> list[Tags]:
    """The tags in those rows of the layout in each exposure; the real corners off the layout's by its covariance."""
    noise = noise or CornerNoise()
    n = len(layout.tags)
    root = np.linalg.cholesky(layout.covariance_mm2 + 1e-18 * np.eye(8 * n))
    real = layout.corners_mm + (root @ rng.standard_normal(8 * n)).reshape(n, 4, 2)
    flat = np.pad(real.reshape(-1, 2), ((0, 0), (0, 1)))
    ideal = camera.project(camera_from_obj @ flat).reshape(n, 4, 2)
    common = noise.sigma_px * np.sqrt(noise.shared) * rng.standard_normal(ideal.shape)
    common += layout.sigma_px * rng.standard_normal(ideal.shape)
    common += layout.tag_sigma_px * rng.standard_normal((n, 1, 2))
    edge_sigma = Tags(layout.tags, ideal, np.zeros((n, 8, 8))).edge_sigma_px()
    common += (edge_sigma * rng.standard_normal(n))[:, None, None] * corners_by_edges(ideal)
    found = []
    for rows in map(list, shown):
        own = noise.sigma_px * np.sqrt(1 - noise.shared) * rng.standard_normal((len(rows), 4, 2))
        covariance = np.tile(noise.sigma_px**2 * np.eye(8), (len(rows), 1, 1))
        tags = tuple(layout.tags[row] for row in rows)
        found.append(Tags(tags, ideal[rows] + common[rows] + own, covariance))
    return found


@dataclass(frozen=True, slots=True)
class PoseTrial:
    """One pose against the board's: ``decision``, ``error_rad``, ``error_mm`` at the origin of {obj}, ``sigmas`` : the
    rotation's error over its σ; ``flipped`` : nearer to the true pose's mirror image than to the true pose. Without a
    pose the errors are infinite."""

    image: str
    rows: tuple[int, ...]
    decision: Decision
    error_rad: float = np.inf
    error_mm: float = np.inf
    sigmas: float = np.inf
    flipped: bool = False


def half_calibrated(images: CalibrationImages, plan: LayoutPlan, chosen: Sequence[int]) -> CalibratedLayout:
    parts = ([each[i] for i in chosen] for each in (images.views, images.tags, images.names))
    return calibrate(plan, *parts, images.camera)


def true_pose(images: CalibrationImages, i: int, calibrated: CalibratedLayout) -> Rigid:
    """camera_from_obj of image i, by its board, printed as the other images tell."""
    view = images.views[i]
    if view is None:
        raise DegenerateError("E-LOCATE-NO-BOARD", f"{images.names[i]}: no board, which the pose to compare with needs")
    seen = images.camera.normalised_from_pixel(view.xy_px)
    longer = calibrated.adjusted.stretch / 2 * np.array([1, -1])
    xy = view.xyz_board[:, :2]
    xy = xy + longer * (xy - xy.mean(0))
    pose = refine_planar_pose(camera_from_plane(fit_homography(xy, seen)), xy, seen)
    return pose @ calibrated.board_from_obj


def subset_trials(
    images: CalibrationImages,
    held_out: Sequence[int],
    calibrated: CalibratedLayout,
    size: int | None,
    options: VerdictOptions | PatentOptions | None = None,
    most: int | None = None,
    seed: int = 0,
) -> Iterator[PoseTrial]:
    """Poses from all subsets of ``size`` tags of each held-out image, or of ``most`` random ones; from all tags where
    None. With :class:`PatentOptions` by the patent's method and gate."""
    rng = np.random.default_rng(seed)
    for i in held_out:
        truth = true_pose(images, i, calibrated)
        seen = merge([images.tags[i]], calibrated.layout).seen
        subsets = list(combinations(range(len(seen)), size or len(seen)))
        if most is not None and len(subsets) > most:
            subsets = [subsets[k] for k in sorted(rng.choice(len(subsets), most, replace=False))]
        for subset in subsets:
            part = SeenTags(*(getattr(seen, each.name)[list(subset)] for each in fields(SeenTags)))
            yield _trial(images, i, part, calibrated.layout, truth, options)


def _trial(images: CalibrationImages, i: int, part: SeenTags, layout: TargetLayout, truth: Rigid, options) -> PoseTrial:
    name, rows, sigma = images.names[i], tuple(int(row) for row in part.rows), np.inf
    try:
        if isinstance(options, PatentOptions):
            tags = Tags(tuple(layout.tags[row] for row in rows), part.corners_px, part.covariance_px2)
            found = locate_as_patent([tags], layout, images.camera, options)
            pose, verdict = found.camera_from_obj, found.verdict
        else:
            located, verdict = judge(locate(part, layout, images.camera), options)
            pose, sigma = located.camera_from_obj, located.sigma_rad()
    except StcalError:
        return PoseTrial(name, rows, "reject")
    error = (pose @ truth.inverse()).angle_rad()
    middle = Rigid(np.eye(3), np.append(layout.corners_mm[part.rows].reshape(-1, 2).mean(0), 0.0))
    second = mirrored(Poses.of([truth]), middle)[0]
    shift = float(np.linalg.norm(pose.translation - truth.translation))
    return PoseTrial(
        name, rows, verdict.decision, error, shift, error / sigma, (pose @ second.inverse()).angle_rad() < error
    )
