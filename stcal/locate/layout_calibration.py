"""Calibration of a target of tags: poses of the board in all images, and corners of the tags in the board's plane."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.optimize import root_scalar

from stcal.adjust.blocks import Huber, Vector, sigma_factor
from stcal.adjust.engine import Adjustment, Solution
from stcal.boards.board_designs import BoardView
from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.errors import DegenerateError
from stcal.geometry.arrays import Brief, require_arguments, rms
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import block_diagonal
from stcal.geometry.plane import apply_homography, camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.print_modes import PrintModes, Told, found_amplitude
from stcal.geometry.rigid import Poses, Rigid, align_rigid, by_pose, perspective
from stcal.geometry.robust import length_limit, robust_sigma
from stcal.locate.layout import LayoutPlan, TargetLayout, in_obj, obj_from_plane
from stcal.parallel import one_thread

HUBER_TAIL, GROSS = 0.011, 4.0
"""Share of inliers whose residuals Huber's loss damps, 3 σ in the plane; multiple of its limit beyond which a residual
is gross, such as a misread tag or a hidden corner: weight 0."""
VARIANCE_ROUNDS, NEAR_PX = 6, 0.005
LEAST_FACTOR = 1e-3
"""Least factor on the stated σ of the board's points. Exact data would give 0, and rounding would be weighed."""
STEP_MM = 1e-4
"""Step of numerical derivatives of the frame {obj}, which turns by 1e-5 rad at most."""
TOGETHER = np.tile(np.eye(2), (4, 1))
"""Basis (8, 2) of the corners' displacements when a tag moves as a whole."""
APART = null_space(TOGETHER.T)  # basis (8, 6) of all other displacements of a tag's corners


@dataclass(frozen=True, slots=True, eq=False)
class ImageCorners:
    """Board and tags in one image, in normalised coordinates without distortion."""

    name: str
    pose: Rigid  # camera_from_board
    board_xyz: np.ndarray  # (b, 3) mm
    board_seen: np.ndarray  # (b, 2)
    board_noise: np.ndarray  # (b, 2, 2) its covariance, up to a factor
    rows: np.ndarray  # (k,) of the tags
    seen: np.ndarray  # (4k, 2) their corners
    noise: np.ndarray  # (k, 8, 8) covariance of a tag's corners, px²
    focal_px: float  # approximate ratio of pixels to normalised coordinates


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedLayout:
    """Result of the adjustment: corners of the tags, and poses of the board."""

    corners_mm: np.ndarray  # (n, 4, 2) in the frame of the board
    covariance_mm2: np.ndarray  # (8n, 8n)
    poses: Poses  # camera_from_board
    board_factor: float  # on the stated σ of the board's points
    sigma_px: float  # of single corners, due to print, lens and flatness
    tag_sigma_px: float  # of the four corners of a tag together
    board_rms_px: float  # residuals per coordinate
    tag_rms_px: float
    image_rms_px: np.ndarray  # (m,) of the tags by image
    downweighted: float  # share of the tags that are damped
    settled: bool  # whether the σ converged
    stretch: float  # how much longer the board is printed along its rows than across, relative
    shear: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Board points (c = 1) or tags (c = 4 corners) of all images."""

    image: np.ndarray  # (r,)
    seen: np.ndarray  # (r, c, 2)
    noise: np.ndarray  # (r, 2c, 2c)
    focal_px: np.ndarray  # (r,)
    places: Callable[[Vector], np.ndarray]  # returns the points (r, c, 3) on the board for the values of a block
    slopes: Callable[[np.ndarray], np.ndarray]  # (r, 2c, k) by these values, from those (r, c, 2, 3) by the points

    @classmethod
    def of(cls, images: Sequence[ImageCorners], kind: Literal["board_", ""], *places) -> "_Rows":
        seen, noise = ([getattr(image, kind + name) for image in images] for name in ("seen", "noise"))
        image = np.repeat(np.arange(len(images)), [len(each) for each in noise])
        focal = np.array([each.focal_px for each in images])[image]
        return cls(image, np.concatenate(seen).reshape(len(image), -1, 2), np.concatenate(noise), focal, *places)

    def off(self, poses: Poses, values: Vector) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Returns projected minus seen corners, (r, 2c), and the derivatives by the poses and by the values."""
        rotation = poses.rotation[self.image]
        turned = self.places(values) @ np.swapaxes(rotation, 1, 2)
        uv, by_point = perspective(turned + poses.translation[self.image][:, None])
        flat = len(uv), -1
        slopes = by_pose(by_point, turned).reshape(*flat, 6), self.slopes(by_point @ rotation[:, None])
        return (uv - self.seen).reshape(flat), slopes

    def px(self, solution: Solution, block: str) -> np.ndarray:
        """Returns the residuals (r, 2c), px, at the values of a block."""
        return self.focal_px[:, None] * self.off(solution.values["pose"], solution.values[block])[0]


@dataclass(frozen=True, slots=True)
class _Noise:
    """Noise model."""

    board: float  # factor on the σ of the board's points
    corner_px: float  # additional σ of single corners
    tag_px: float  # of the four corners of a tag together
    amplitude: float  # of the smooth deviations of the board's print


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """All observations."""

    board: _Rows
    tags: _Rows
    tag: np.ndarray  # (r,) numbers of the tags
    print: PrintModes  # of the board

    @classmethod
    def of(cls, images: Sequence[ImageCorners]) -> "_Layout":
        tag, xyz = (np.concatenate([getattr(image, name) for image in images]) for name in ("rows", "board_xyz"))
        drawn, place = np.unique(xyz.round(6), axis=0, return_inverse=True)
        prints = PrintModes.of(drawn[:, :2])
        modes = prints.modes.reshape(len(drawn), 3, -1)[place.ravel()]  # (r, 3, m) at the board's points
        board = _Rows.of(
            images,
            "board_",
            lambda along: (xyz + modes @ along.array[0])[:, None],
            lambda by_place: by_place[:, 0] @ modes,
        )
        tags = _Rows.of(
            images,
            "",
            lambda corners: np.pad(corners.array[tag].reshape(-1, 4, 2), ((0, 0), (0, 0), (0, 1))),
            lambda by_place: block_diagonal(by_place[..., :2]),
        )
        return cls(board, tags, tag, prints)

    def problem(self, start: Mapping[str, Any], noise: _Noise) -> Adjustment:
        """Returns the adjustment from poses, corners (n, 8) and modes of the print (1, m), with σ of ``noise``."""
        a, tags = Adjustment(), self.tags
        pose = a.block("pose", start["pose"], eliminate=True)
        corners, prints = (a.block(name, start[name]) for name in ("corners", "print"))
        covariance = tags.noise + noise.corner_px**2 * np.eye(8) + noise.tag_px**2 * TOGETHER @ TOGETHER.T
        in_px = covariance / tags.focal_px[:, None, None] ** 2
        for kind, rows, own, noise_of_rows in (
            ("board", self.board, (prints, None), noise.board**2 * self.board.noise),
            ("tags", tags, (corners, self.tag), in_px),
        ):
            limit = length_limit(noise_of_rows.shape[-1], HUBER_TAIL)
            a.factor(
                lambda *values, rows=rows: rows.off(*values)[0],
                [(pose, rows.image), own],
                derivatives=lambda *values, rows=rows: rows.off(*values)[1],
                root=np.linalg.inv(np.linalg.cholesky(noise_of_rows)),
                kind=kind,
                cluster=rows.image,
                loss=Huber(limit, GROSS * limit),
            )
        spread = noise.amplitude * self.print.spread_mm
        a.prior(prints, np.zeros((1, len(spread))), np.diag(spread**-2.0))
        return a

    def noise(self, solution: Solution, noise: _Noise) -> _Noise:
        """Returns the noise with which the squared residuals of board and tags each equal their redundancy."""
        board, tags = solution.rows
        redundancy = [max(solution.redundancy(kind), 1.0) for kind in ("board", "tags")]
        square, px = float((board.residual**2).sum()), self.tags.px(solution, "corners")
        corner = _added(self.tags.noise, px, tags.weight, APART, 6 / 8 * redundancy[1])
        whole_tag = _added(self.tags.noise, px, tags.weight, TOGETHER / 2, 2 / 8 * redundancy[1])
        # Twice the mean of four corners: its variance holds that of the tag's shift four times, of a corner once.
        tag = np.sqrt(max(whole_tag**2 - corner**2, 0.0) / 4)
        at = solution.places["print"]
        nothing = np.full(len(self.print.spread_mm), 1e-12)  # of an amplitude of 0, for an inverse
        told = Told(solution.values["print"].array[0], solution.inverse[at, at], nothing, self.print.spread_mm)
        factor = max(noise.board * sigma_factor(square, redundancy[0]), LEAST_FACTOR)
        return _Noise(factor, corner, float(tag), found_amplitude([told], noise.amplitude))


def adjust(images: Sequence[ImageCorners], start: np.ndarray) -> AdjustedLayout:
    """Minimises Huber's loss over 6m + 8n unknowns, the board being the datum but for stretch and bend of its print.
    Variance components (Förstner 1979) give its factor and the additional σ of tags. Raises ConvergenceError."""
    layout, poses = _Layout.of(images), Poses.of(image.pose for image in images)
    prints = Vector(np.zeros((1, len(layout.print.spread_mm))))
    values = {"pose": poses, "corners": Vector(start.reshape(-1, 8)), "print": prints}
    first = layout.problem(values, _Noise(1.0, 0.0, 0.0, 1.0)).at(values)
    apart = np.linalg.norm(layout.tags.px(first, "corners").reshape(-1, 2), axis=1)
    noise = _Noise(max(robust_sigma(first.rows[0].length, 2), LEAST_FACTOR), robust_sigma(apart, 2), 0.0, 1.0)
    settled = False
    for round_ in range(VARIANCE_ROUNDS):
        minimum = layout.problem(values, noise).minimum(max_steps=60)
        solution = minimum.required("layout", "check board file and camera file").linear
        values: dict[str, Any] = solution.values
        previous, noise = noise, layout.noise(solution, noise)
        change = max(abs(noise.corner_px - previous.corner_px), abs(noise.tag_px - previous.tag_px))
        settled = round_ > 0 and abs(noise.board / previous.board - 1) < 0.01 and change < NEAR_PX
        if settled:
            break
    tags_px = layout.tags.px(solution, "corners")
    stretch, shear = layout.print.stretch(layout.print.modes @ values["print"].array[0])
    return AdjustedLayout(
        corners_mm=values["corners"].array.reshape(-1, 4, 2),
        covariance_mm2=solution.inverse[solution.places["corners"], solution.places["corners"]],
        poses=Poses(values["pose"].rotation, values["pose"].translation),
        board_factor=noise.board,
        sigma_px=noise.corner_px,
        tag_sigma_px=noise.tag_px,
        board_rms_px=rms(layout.board.px(solution, "print")),
        tag_rms_px=rms(tags_px),
        image_rms_px=np.array([rms(tags_px[layout.tags.image == i]) for i in range(len(images))]),
        downweighted=float((solution.rows[1].weight < 1).mean()),
        settled=settled,
        stretch=stretch,
        shear=shear,
    )


def _added(own: np.ndarray, px: np.ndarray, weight: np.ndarray, part: np.ndarray, free: float) -> float:
    """Returns σ of the residuals px (p, 8) in addition to their covariance (p, 8, 8), in directions ``part`` (8, q)."""
    components, variance, identity = px @ part, part.T @ own @ part, np.eye(part.shape[1])

    def excess(added_px: float) -> float:
        solved = np.linalg.solve(variance + added_px**2 * identity, components[..., None])[..., 0]
        return float((weight * (components * solved).sum(1)).sum()) - free

    if excess(0.0) <= 0:
        return 0.0
    upper = float(np.sqrt((components**2).sum() / free)) + 1e-9
    return float(root_scalar(excess, method="brentq", bracket=(0.0, upper)).root)


MIN_IMAGES = 2


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CalibratedLayout(Brief):
    """Result of a target's calibration.

    ``layout`` : layout with the covariance of all corners; ``published`` : (n, 4, 2) corners in {obj} by the method of
    the patent, before the adjustment, mm; ``board_from_obj`` : pose of {obj} on the board; ``adjusted`` : poses and
    residuals of the adjustment; ``images`` : names of the images used; ``counts`` : (n,) number of images that show
    each tag; ``unseen`` : rows of the plan whose tags no image shows; the layout lacks them; ``deviation_mm`` : (n,)
    largest distance of a tag's corner from its nominal place, after the nominal target is fitted to the calibrated one;
    NaN if the plan has no place; ``left_out`` : images that were not used, and why.
    """

    format: ClassVar = "stcal layout calibration 1"
    unit: ClassVar = "mm"
    layout: TargetLayout
    published: np.ndarray
    board_from_obj: Rigid
    adjusted: AdjustedLayout
    images: tuple[str, ...]
    counts: np.ndarray
    unseen: tuple[int, ...]
    deviation_mm: np.ndarray
    left_out: tuple[str, ...]


@require_arguments
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
    plan : tags of the target, and the tag that holds the origin of {obj}.
    views : views of the board in m images; None if it is not seen.
    tags : tags in the m images.
    names : names of the images.
    camera : camera that took the images, at their size.
    symmetries : all board_from_board that map the board onto itself. The tags then decide the board's numbering in each
        image.

    Returns
    -------
    CalibratedLayout : corners in mm, with their covariance.

    Raises DegenerateError: fewer than two images show board and tags, or none of them shows the tag that holds {obj}.
    """
    rows = {tag: row for row, tag in enumerate(plan.tags)}
    images, left_out = [], []
    for name, view, detected in zip(names, views, tags, strict=True):
        listed = [k for k, tag in enumerate(detected.tags) if tag in rows]
        repeated = [tag for _, tag in (t for t in detected.repeated if t in rows)]
        if not listed:
            left_out.append(f"{name}: no tag of the layout")
        elif view is None or len(view) < 4:
            left_out.append(f"{name}: the board is not seen")
        elif repeated:
            left_out.append(f"{name}: tag {repeated[0]} is seen twice")
        else:
            images.append(_image(name, view, detected, listed, rows, camera))
    if len(images) < MIN_IMAGES:
        fault = f"layout: {len(images)} of {len(names)} images show board and tags, {MIN_IMAGES} needed"
        raise DegenerateError("E-LAYOUT-FEW-IMAGES", fault + (f" ({left_out[0]})" if left_out else ""))
    if symmetries:
        images = _turned_alike(images, symmetries)
    seen_rows = np.array(sorted({int(row) for image in images for row in image.rows}))
    if plan.origin not in seen_rows:
        fault = f"layout: tag {plan.tags[plan.origin][1]}, which holds the origin, is in none of {len(images)} images"
        raise DegenerateError("E-LAYOUT-UNLINKED", f"{fault}; show it, or name another origin in the layout file")
    images = [replace(image, rows=np.searchsorted(seen_rows, image.rows)) for image in images]
    places = np.full((len(images), len(seen_rows), 4, 2), np.nan)  # medians are robust against a misread tag
    for i, image in enumerate(images):
        places[i, image.rows] = plane_points(image.pose, image.seen).reshape(-1, 4, 2)
    start = np.nanmedian(places, axis=0)
    adjusted = adjust(images, start)
    return _collected(plan, images, seen_rows, start, adjusted, left_out)


def _image(name: str, view: BoardView, found: Tags, own: list[int], rows: dict, camera: Camera) -> ImageCorners:
    """Returns board and tags of one image in normalised coordinates, and the pose of the board."""
    board_seen = camera.normalised_from_pixel(view.xy_px)
    xy = view.xyz_board[:, :2]
    board_px2 = np.tile(np.eye(2), (len(view), 1, 1)) if view.covariance_px2 is None else view.covariance_px2
    seen_from_px = np.linalg.inv(camera.pixel_jacobian(board_seen))
    # A tag's corners err as measured, and by the edges' common shift.
    direction = corners_by_edges(found.corners_px[own]).reshape(-1, 8)
    shift = found.edge_sigma_px()[own, None, None] ** 2 * direction[:, :, None] * direction[:, None, :]
    pose = refine_planar_pose(camera_from_plane(fit_homography(xy, board_seen)), xy, board_seen)
    board = view.xyz_board, board_seen, seen_from_px @ board_px2 @ np.swapaxes(seen_from_px, 1, 2)
    tags_seen = camera.normalised_from_pixel(found.corners_px[own].reshape(-1, 2))
    tags = np.array([rows[found.tags[k]] for k in own]), tags_seen, shift + found.joint_px2[own]
    return ImageCorners(name, pose, *board, *tags, float(camera.focal.mean()))


def plane_points(camera_from_plane: Rigid, seen: np.ndarray) -> np.ndarray:
    """Returns where the rays of normalised coordinates (n, 2) meet the plane, (n, 2) mm in its frame."""
    rotation = camera_from_plane.rotation
    return apply_homography(np.linalg.inv(np.column_stack([rotation[:, :2], camera_from_plane.translation])), seen)


def _turned_alike(images: Sequence[ImageCorners], symmetries: Sequence[Rigid]) -> list[ImageCorners]:
    """Chooses in each image the numbering of a symmetric board that places tags as elsewhere."""
    turned, place_of_tag, left = list(images), {}, list(range(len(images)))
    while left:
        i = max(left, key=lambda i: (sum(row in place_of_tag for row in images[i].rows), len(images[i].rows), -i))
        left.remove(i)
        image = images[i]
        choices = [image]
        for turn in symmetries:
            choices.append(replace(image, pose=image.pose @ turn.inverse(), board_xyz=turn @ image.board_xyz))
        places = [plane_points(choice.pose, choice.seen).reshape(-1, 4, 2) for choice in choices]
        common = [k for k, row in enumerate(image.rows) if row in place_of_tag]
        if common:
            expected = np.array([place_of_tag[image.rows[k]] for k in common])
            best = int(np.argmin([np.abs(place[common] - expected).sum() for place in places]))
        elif place_of_tag:
            fault = f"{image.name} shares no tag with the other images, and the board looks the same when turned"
            remedy = "show a tag of another image too, or use a board without symmetry"
            raise DegenerateError("E-LAYOUT-UNLINKED", f"layout: {fault}; {remedy}")
        else:
            best = 0
        turned[i] = choices[best]
        place_of_tag |= {
            row: place for row, place in zip(image.rows, places[best], strict=True) if row not in place_of_tag
        }
    return turned


def _collected(plan, images, tag_rows, start, adjusted: AdjustedLayout, left_out) -> CalibratedLayout:
    """Returns the calibration in {obj}. The frame is defined by the corners of one tag, and depends on their errors."""
    origin = int(np.flatnonzero(tag_rows == plan.origin)[0])
    turn, shift = obj_from_plane(adjusted.corners_mm[origin])
    # Derivative (8n, 8n) of corners in {obj} by those on the board, from central differences.
    flat, steps = adjusted.corners_mm.ravel(), STEP_MM * np.eye(adjusted.corners_mm.size)
    ends = ([in_obj((flat + sign * step).reshape(-1, 4, 2), origin).ravel() for step in steps] for sign in (1, -1))
    by_corner = np.subtract(*map(np.array, ends)).T / (2 * STEP_MM)
    covariance = by_corner @ adjusted.covariance_mm2 @ by_corner.T
    tags, corners = tuple(plan.tags[row] for row in tag_rows), adjusted.corners_mm @ turn.T + shift
    known = tags, corners, (covariance + covariance.T) / 2, origin, adjusted.sigma_px, adjusted.tag_sigma_px
    layout = TargetLayout(plan.name, *known, plan.unusual_size)
    obj_from_board = Rigid(np.asarray(block_diag(turn, 1.0)), np.append(shift, 0.0))
    nominal = plan.corners_mm[tag_rows]
    placed, deviation = np.isfinite(nominal).all((1, 2)), np.full(len(nominal), np.nan)
    if placed.any():
        pair = layout.corners_mm, nominal
        a, b = (np.pad(each[placed].reshape(-1, 2), ((0, 0), (0, 1))) for each in pair)
        deviation[placed] = np.linalg.norm(align_rigid(a, b) @ b - a, axis=1).reshape(-1, 4).max(1)
    names = tuple(image.name for image in images)
    counts = np.bincount(np.concatenate([image.rows for image in images]), minlength=len(tag_rows))
    unseen = tuple(row for row in range(len(plan.tags)) if row not in tag_rows)
    result = layout, in_obj(start, origin), obj_from_board.inverse(), adjusted
    return CalibratedLayout(*result, names, counts, unseen, deviation, tuple(left_out))


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImages:
    """Images of a target's calibration."""

    names: tuple[str, ...]  # of m readable images of one size
    views: tuple[BoardView | None, ...]  # of the board in them, None if it is not seen
    tags: tuple[Tags, ...]
    camera: Camera
    symmetries: tuple[Rigid, ...] = ()  # rotations that map the board onto itself
    left_out: tuple[str, ...] = ()  # files that are not used, and why
