"""How far poses are off in photographs that also show a board: the target calibrated on some, found in others."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np

from stcal.boards.tags import Tags
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.plane import camera_from_plane, fit_homography, mirrored, refine_planar_pose
from stcal.geometry.rigid import Poses, Rigid
from stcal.locate.estimate import SeenTags, locate, merge
from stcal.locate.layout import LayoutPlan, TargetLayout
from stcal.locate.layout_calibration import CalibratedLayout, CalibrationImages, calibrate
from stcal.locate.verdict import Decision, PatentOptions, VerdictOptions, judge, locate_as_patent


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
