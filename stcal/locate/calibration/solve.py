"""Calibration of the target: corners of its tags, from photographs with a board in the same plane.

The start follows the patent (step S3): the board's pose in each image, each corner at the intersection of its ray with
the board's plane, {obj} in the middle of a chosen tag. Then one adjustment refines all poses and corners, with σ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.boards.design import BoardView
from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.locate.calibration.adjust import AdjustedLayout, ImageCorners, adjust
from stcal.locate.data.layout import LayoutPlan, TargetLayout, obj_from_plane
from stcal.parallel import one_thread

MIN_IMAGES = 2
MIN_BOARD_POINTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedLayout:
    """Result of a target's calibration.

    Parameters
    ----------
    layout : TargetLayout
        Layout with the covariance of all corners.
    published : (n, 4, 2) array
        Corners in {obj} by the method of the patent, before the adjustment, mm.
    board_from_obj : Rigid
        Pose of {obj} on the board.
    adjusted : AdjustedLayout
        Poses and residuals of the adjustment.
    images : tuple of str
        Names of the images used.
    counts : (n,) int array
        Number of images that show each tag.
    unseen : tuple of int
        Rows of the plan whose tags no image shows; the layout lacks them.
    deviation_mm : (n,) array
        Largest distance of a tag's corner from its nominal place, after the nominal target is fitted to the calibrated
        one; NaN if the plan has no place.
    left_out : tuple of str
        Images that were not used, and why.
    """

    layout: TargetLayout
    published: np.ndarray
    board_from_obj: Rigid
    adjusted: AdjustedLayout
    images: tuple[str, ...]
    counts: np.ndarray
    unseen: tuple[int, ...]
    deviation_mm: np.ndarray
    left_out: tuple[str, ...]


@one_thread()
def calibrate(
    plan: LayoutPlan,
    views: Sequence[BoardView | None],
    tags: Sequence[Tags],
    names: Sequence[str],
    camera: Camera,
    symmetries: Sequence[Rigid] = (),
) -> CalibratedLayout:
    """Calibrates the corners of a target's tags in {obj}, from photographs with a board in the same plane.

    Parameters
    ----------
    plan : LayoutPlan
        Tags of the target, and the tag that holds the origin of {obj}.
    views : sequence of BoardView or None
        Views of the board in m images; None if it is not seen.
    tags : sequence of Tags
        Tags in the m images.
    names : sequence of str
        Names of the images.
    camera : Camera
        Camera that took the images, at their size.
    symmetries : sequence of Rigid
        All board_from_board that map the board onto itself. The tags then decide the board's numbering in each image.

    Returns
    -------
    CalibratedLayout
        Corners in mm, with their covariance.

    Raises
    ------
    DegenerateError
        Fewer than two images show board and tags, or none of them shows the tag that holds {obj}.
    """
    rows = {tag: row for row, tag in enumerate(plan.tags)}
    images, left_out = [], []
    for name, view, detected in zip(names, views, tags, strict=True):
        listed = [k for k, tag in enumerate(detected.tags) if tag in rows]
        if view is None or len(view) < MIN_BOARD_POINTS or not listed:
            left_out.append(f"{name}: {'no tag of the layout' if listed == [] else 'the board is not seen'}")
            continue
        repeated = [tag for _, tag in (t for t in detected.repeated if t in rows)]
        if repeated:
            left_out.append(f"{name}: tag {repeated[0]} is seen twice")
            continue
        images.append(_image(name, view, detected, listed, rows, camera))
    if len(images) < MIN_IMAGES:
        raise DegenerateError(
            "E-LAYOUT-FEW-IMAGES",
            f"layout: {len(images)} of {len(names)} images show board and tags, {MIN_IMAGES} needed"
            + (f" ({left_out[0]})" if left_out else ""),
        )
    if symmetries:
        images = _turned_alike(images, symmetries)
    seen_rows = np.array(sorted({int(row) for image in images for row in image.rows}))
    if plan.origin not in seen_rows:
        raise DegenerateError(
            "E-LAYOUT-UNLINKED",
            f"layout: tag {plan.tags[plan.origin][1]}, which holds the origin, is in none of {len(images)} images; "
            "show it, or name another origin in the layout file",
        )
    images = [image.numbered(np.searchsorted(seen_rows, image.rows)) for image in images]
    start = _median_corners(images, len(seen_rows))
    adjusted = adjust(images, start)
    return _collected(plan, images, seen_rows, start, adjusted, left_out)


def _image(name: str, view: BoardView, found: Tags, own: list[int], rows: dict, camera: Camera) -> ImageCorners:
    """Returns board and tags of one image in normalised coordinates, and the pose of the board."""
    board_seen = camera.normalised_from_pixel(view.xy_px)
    xy = view.xyz_board[:, :2]
    pose = refine_planar_pose(camera_from_plane(fit_homography(xy, board_seen)), xy, board_seen)
    pixels = found.corners_px[own].reshape(-1, 2)
    ideal = camera.normalised_from_pixel(pixels)
    board_px2 = np.tile(np.eye(2), (len(view), 1, 1)) if view.covariance_px2 is None else view.covariance_px2
    return ImageCorners(
        name,
        pose,
        view.xyz_board,
        board_seen,
        _normalised(board_px2, board_seen, camera),
        np.array([rows[found.tags[k]] for k in own]),
        ideal,
        _tag_covariances(found, own),
        float(camera.focal.mean()),
    )


def _normalised(covariance_px2: np.ndarray, ideal: np.ndarray, camera: Camera) -> np.ndarray:
    normalised_from_px = np.linalg.inv(camera.distort_jacobian(ideal)[1] * camera.focal[:, None])
    return normalised_from_px @ covariance_px2 @ np.swapaxes(normalised_from_px, 1, 2)


def _tag_covariances(found: Tags, own: list[int]) -> np.ndarray:
    """Returns the covariance of each tag's corners, (k, 8, 8) px²: single corners, and the edges' common shift."""
    direction = corners_by_edges(found.corners_px[own]).reshape(-1, 8)
    full = found.edge_sigma_px()[own, None, None] ** 2 * direction[:, :, None] * direction[:, None, :]
    for corner in range(4):
        coordinates = slice(2 * corner, 2 * corner + 2)
        full[:, coordinates, coordinates] += found.covariance_px2[own, corner]
    return full


def plane_points(camera_from_plane: Rigid, seen: np.ndarray) -> np.ndarray:
    """Returns where the rays of normalised coordinates (n, 2) meet the plane, (n, 2) mm in its frame."""
    rotation = camera_from_plane.rotation
    return apply_homography(np.linalg.inv(np.column_stack([rotation[:, :2], camera_from_plane.translation])), seen)


def _turned_alike(images: Sequence[ImageCorners], symmetries: Sequence[Rigid]) -> list[ImageCorners]:
    """Chooses in each image the numbering of a symmetric board that places the tags where the first image has them."""
    order = sorted(range(len(images)), key=lambda i: -len(images[i].rows))
    turned, place_of_tag = list(images), {}
    for i in order:
        image = images[i]
        choices = [image, *(image.turned(symmetry) for symmetry in symmetries)]
        places = [plane_points(choice.pose, choice.seen).reshape(-1, 4, 2) for choice in choices]
        common = [k for k, row in enumerate(image.rows) if row in place_of_tag]
        if common:
            expected = np.array([place_of_tag[image.rows[k]] for k in common])
            best = int(np.argmin([np.abs(place[common] - expected).sum() for place in places]))
        elif place_of_tag:
            raise DegenerateError(
                "E-LAYOUT-UNLINKED",
                f"layout: {image.name} shares no tag with the other images, and the board looks the same turned; "
                "show a tag of another image too, or use a board without symmetry",
            )
        else:
            best = 0
        turned[i] = choices[best]
        place_of_tag |= {
            row: place for row, place in zip(image.rows, places[best], strict=True) if row not in place_of_tag
        }
    return turned


def _median_corners(images: Sequence[ImageCorners], count: int) -> np.ndarray:
    """Returns each corner's median over all images, (count, 4, 2) mm on the board, robust against a misread tag."""
    places = np.full((len(images), count, 4, 2), np.nan)
    for i, image in enumerate(images):
        places[i, image.rows] = plane_points(image.pose, image.seen).reshape(-1, 4, 2)
    return np.nanmedian(places, axis=0)


def _collected(plan, images, seen, start, adjusted: AdjustedLayout, left_out) -> CalibratedLayout:
    """Returns the calibration in {obj}. The frame is defined by the corners of one tag, and depends on their errors."""
    origin = int(np.flatnonzero(seen == plan.origin)[0])
    turn, shift = obj_from_plane(adjusted.corners_mm[origin])
    by_corner = _by_board_corners(adjusted.corners_mm, origin, turn)
    covariance = by_corner @ adjusted.covariance_mm2 @ by_corner.T
    layout = TargetLayout(
        plan.name,
        tuple(plan.tags[row] for row in seen),
        adjusted.corners_mm @ turn.T + shift,
        (covariance + covariance.T) / 2,
        origin,
        adjusted.sigma_px,
        adjusted.tag_sigma_px,
    )
    obj_from_board = Rigid(np.block([[turn, np.zeros((2, 1))], [np.zeros((1, 2)), 1.0]]), np.append(shift, 0.0))
    first_turn, first_shift = obj_from_plane(start[origin])
    counts = np.bincount(np.concatenate([image.rows for image in images]), minlength=len(seen))
    return CalibratedLayout(
        layout,
        start @ first_turn.T + first_shift,
        obj_from_board.inverse(),
        adjusted,
        tuple(image.name for image in images),
        counts,
        tuple(row for row in range(len(plan.tags)) if row not in seen),
        _deviation(plan.corners_mm[seen], layout.corners_mm),
        tuple(left_out),
    )


def _by_board_corners(corners: np.ndarray, origin: int, turn: np.ndarray) -> np.ndarray:
    """Returns the derivative (8n, 8n) of all coordinates in {obj} by those on the board.

    The derivative is of first order. The rotation of {obj} changes by the mean of the small rotations of the origin
    tag's corners about its middle.
    """
    n = corners.size // 2
    rows = slice(4 * origin, 4 * origin + 4)
    flat = corners.reshape(-1, 2)
    middle = flat[rows].mean(0)
    nominal = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ turn  # corners of the square in the axes of the board
    offset = flat[rows] - middle
    quarter_turn = nominal @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # quarter turn from x to y
    by_angle = quarter_turn / np.sum(nominal * offset)
    jacobian = np.zeros((n, 2, n, 2))
    jacobian[np.arange(n), :, np.arange(n)] = np.eye(2)
    jacobian[:, :, rows] -= np.eye(2)[None, :, None, :] / 4
    swing = (flat - middle) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    jacobian[:, :, rows] -= swing[:, :, None, None] * by_angle[None, None]
    return np.einsum("ij,njmk->nimk", turn, jacobian).reshape(2 * n, 2 * n)


def _deviation(nominal: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Returns the largest distance of each tag's corners from their nominal places, after one fit of all tags."""
    placed = np.isfinite(nominal).all((1, 2))
    deviation = np.full(len(nominal), np.nan)
    if placed.any():
        a, b = corners[placed].reshape(-1, 2), nominal[placed].reshape(-1, 2)
        u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        turn = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
        distance = np.linalg.norm((b - b.mean(0)) @ turn.T + a.mean(0) - a, axis=1)
        deviation[placed] = distance.reshape(-1, 4).max(1)
    return deviation
