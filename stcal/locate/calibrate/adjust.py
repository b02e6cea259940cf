"""One adjustment of the board's poses in all images and of the tags' corners in the board's plane."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import root_scalar
from scipy.stats import chi2 as chi_square

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Poses, Rigid
from stcal.locate.pose.problem import PlanarProblem, project

MAX_STEPS = 60
SETTLED = 1e-4
"""A step that moves nothing by more than this, in mm or milliradians, is the last."""
HUBER_TAIL = 0.011
"""Share of honest points, or tags, whose residuals Huber's loss damps: 3 σ in the plane."""
GROSS = 4.0
"""Times that limit: another tag than it is read as, or a corner that is hidden. It has no weight at all."""
VARIANCE_ROUNDS = 6
TOGETHER = np.tile(np.eye(2), (4, 1))
"""(8, 2): the corners of a tag that moves as a whole."""
APART = null_space(TOGETHER.T)
"""(8, 6): what its corners do beside that."""
NEAR_PX = 0.005
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))


@dataclass(frozen=True, slots=True, eq=False)
class ImageCorners:
    """Board and tags in one image, the lens taken out.

    ``pose`` : camera_from_board; ``board_xyz`` : (b, 3) mm and ``board_seen`` : (b, 2) normalised, ``board_noise`` :
    (b, 2, 2) their covariance up to a factor; ``rows`` : (k,) tags, ``seen`` : (4k, 2) their corners, ``noise`` :
    (k, 8, 8) px² of each tag's; ``focal_px`` : px by normalised coordinates, about.
    """

    name: str
    pose: Rigid
    board_xyz: np.ndarray
    board_seen: np.ndarray
    board_noise: np.ndarray
    rows: np.ndarray
    seen: np.ndarray
    noise: np.ndarray
    focal_px: float

    def numbered(self, rows: np.ndarray) -> "ImageCorners":
        """With other numbers of the tags."""
        return replace(self, rows=rows)

    def turned(self, board_from_board: Rigid) -> "ImageCorners":
        """With the board numbered as it is after one of its symmetries."""
        back = board_from_board.inverse()
        return replace(self, pose=self.pose @ back, board_xyz=board_from_board @ self.board_xyz)


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """``corners_mm`` : (n, 4, 2) on the board, ``covariance_mm2`` : (8n, 8n); ``poses`` camera_from_board;
    ``board_factor`` : by which the stated σ of the board's points are too small, as the residuals say; ``sigma_px``,
    ``tag_sigma_px`` : what print, lens and flatness add to the σ of a corner, and to the four of a tag together;
    ``board_rms_px``, ``tag_rms_px`` : per coordinate; ``image_rms_px`` : (m,) of the tags in each image;
    ``downweighted`` : share of the tags that are damped as outliers; ``settled`` : whether the σ did within
    :data:`VARIANCE_ROUNDS`."""

    corners_mm: np.ndarray
    covariance_mm2: np.ndarray
    poses: Poses
    board_factor: float
    sigma_px: float
    tag_sigma_px: float
    board_rms_px: float
    tag_rms_px: float
    image_rms_px: np.ndarray
    downweighted: float
    settled: bool


@dataclass(frozen=True, slots=True)
class _Noise:
    """``board`` : factor on the σ of the board's points; ``corner_px``, ``tag_px`` : added to those of the tags'
    corners, one by one and the four of a tag together."""

    board: float
    corner_px: float
    tag_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """p points of the board (d = 2) or tags (d = 8). Whitened residuals (p, d), their derivatives by the pose (p, d, 6)
    and by the points (p, d, d); Huber's ``weight`` (p,); ``px`` : (p, d) residuals in pixels."""

    residual: np.ndarray
    by_pose: np.ndarray
    by_point: np.ndarray
    weight: np.ndarray
    px: np.ndarray


def adjust(images: Sequence[ImageCorners], start: np.ndarray) -> Adjusted:
    """Least squares with Huber's loss over 6m + 8n unknowns; the poses are eliminated image by image.

    The board is the reference and exact. The σ of the board's points have a factor, and those of the tags' corners a
    part that is added, which the residuals give over their redundancy (variance components: Förstner 1979).

    Raises
    ------
    ConvergenceError
        The iteration does not settle.
    """
    corners = start.reshape(-1, 2).copy()
    poses = Poses.of([image.pose for image in images])
    noise = _first_noise(images, poses, corners)
    settled = False
    for round_ in range(VARIANCE_ROUNDS):
        poses, corners = _settled(images, poses, corners, noise)
        blocks = [_blocks(image, poses[[i]], corners, noise) for i, image in enumerate(images)]
        covariance = np.linalg.inv(_reduced(images, blocks, len(corners))[0])
        before, noise = noise, _variances(images, blocks, covariance, noise)
        change = max(abs(noise.corner_px - before.corner_px), abs(noise.tag_px - before.tag_px))
        settled = round_ > 0 and abs(noise.board / before.board - 1) < 0.01 and change < NEAR_PX
        if settled:
            break
    board, tags = ([block[side] for block in blocks] for side in (0, 1))
    return Adjusted(
        corners_mm=corners.reshape(-1, 4, 2),
        covariance_mm2=covariance,
        poses=poses,
        board_factor=noise.board,
        sigma_px=noise.corner_px,
        tag_sigma_px=noise.tag_px,
        board_rms_px=_rms(np.concatenate([g.px.ravel() for g in board])),
        tag_rms_px=_rms(np.concatenate([g.px.ravel() for g in tags])),
        image_rms_px=np.array([_rms(g.px) for g in tags]),
        downweighted=float((np.concatenate([g.weight for g in tags]) < 1).mean()),
        settled=settled,
    )


def _first_noise(images, poses: Poses, corners: np.ndarray) -> "_Noise":
    """By the medians of the residuals."""
    blocks = [_blocks(image, poses[[i]], corners, _Noise(1.0, 0.0, 0.0)) for i, image in enumerate(images)]
    board = np.median(np.concatenate([np.linalg.norm(b[0].residual, axis=1) for b in blocks]))
    tags = np.median(np.concatenate([np.linalg.norm(b[1].px.reshape(-1, 2), axis=1) for b in blocks]))
    return _Noise(max(float(board) / RAYLEIGH_MEDIAN, 1e-3), float(tags) / RAYLEIGH_MEDIAN, 0.0)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _settled(images, poses: Poses, corners: np.ndarray, noise: _Noise) -> tuple[Poses, np.ndarray]:
    for _ in range(MAX_STEPS):
        blocks = [_blocks(image, poses[[i]], corners, noise) for i, image in enumerate(images)]
        eliminated, right = _reduced(images, blocks, len(corners))
        by_corner = np.linalg.solve(eliminated, right)
        steps = np.array(
            [
                np.linalg.solve(own, g - cross @ by_corner[where])
                for own, g, cross, where in (_normal(image, block) for image, block in zip(images, blocks, strict=True))
            ]
        )
        poses, corners = poses.moved(steps), corners + by_corner.reshape(-1, 2)
        if max(np.abs(by_corner).max(), np.abs(steps * [1e3, 1e3, 1e3, 1, 1, 1]).max()) < SETTLED:
            return poses, corners
    raise ConvergenceError(
        f"layout: the adjustment does not settle in {MAX_STEPS} steps (last {np.abs(by_corner).max():.2g} mm); "
        "check board file and camera file"
    )


def _blocks(image: ImageCorners, pose: Poses, corners: np.ndarray, noise: _Noise) -> tuple[_Group, _Group]:
    """Board and tags of one image."""
    own = (4 * image.rows[:, None] + np.arange(4)).ravel()
    board = _group(image, pose, image.board_xyz[:, :2], image.board_seen, noise.board**2 * image.board_noise)
    spread = image.noise + noise.corner_px**2 * np.eye(8) + noise.tag_px**2 * TOGETHER @ TOGETHER.T
    return board, _group(image, pose, corners[own], image.seen, spread / image.focal_px**2)


def _group(image: ImageCorners, pose: Poses, xy: np.ndarray, seen: np.ndarray, noise: np.ndarray) -> _Group:
    p, d = noise.shape[:2]
    empty = np.zeros((0, 0))
    view = project(PlanarProblem(xy, seen, empty, empty, empty, empty, empty), pose)
    raw = view.residual[0].reshape(p, d)
    by_point = np.zeros((p, d // 2, 2, d // 2, 2))
    each = np.arange(d // 2)
    by_point[:, each, :, each] = np.moveaxis(view.by_corner[0].reshape(p, d // 2, 2, 2), 1, 0)
    root = np.linalg.inv(np.linalg.cholesky(noise))
    residual = (root @ raw[..., None])[..., 0]
    limit = float(np.sqrt(chi_square.isf(HUBER_TAIL, d)))
    length = np.linalg.norm(residual, axis=1)
    weight = np.where(length > GROSS * limit, 0.0, np.minimum(1.0, limit / np.maximum(length, limit)))
    return _Group(
        residual,
        root @ view.by_pose[0].reshape(p, d, 6),
        root @ by_point.reshape(p, d, d),
        weight,
        image.focal_px * raw,
    )


def _normal(image: ImageCorners, block: tuple[_Group, _Group]):
    """Normal matrix (6, 6) and right side of a pose, its cross block with the corners, and their columns."""
    own, g = np.zeros((6, 6)), np.zeros(6)
    for group in block:
        weighted = group.weight[:, None, None] * group.by_pose
        own += np.einsum("pij,pik->jk", weighted, group.by_pose)
        g += np.einsum("pij,pi->j", weighted, group.residual)
    tags = block[1]
    cross = np.einsum("p,pij,pik->jpk", tags.weight, tags.by_pose, tags.by_point).reshape(6, -1)
    return own, g, cross, (8 * image.rows[:, None] + np.arange(8)).ravel()


def _reduced(images, blocks, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and right side of the corners, the poses eliminated (Schur complement)."""
    normal, right = np.zeros((2 * points, 2 * points)), np.zeros(2 * points)
    for image, block in zip(images, blocks, strict=True):
        own, g, cross, where = _normal(image, block)
        tags = block[1]
        each = np.einsum("p,pij,pik->pjk", tags.weight, tags.by_point, tags.by_point)
        place = where.reshape(-1, 8)
        normal[place[:, :, None], place[:, None, :]] += each
        right[where] += np.einsum("p,pij,pi->pj", tags.weight, tags.by_point, tags.residual).ravel()
        gain = np.linalg.solve(own, np.column_stack([cross, g]))
        normal[np.ix_(where, where)] -= cross.T @ gain[:, :-1]
        right[where] -= cross.T @ gain[:, -1]
    return normal, right


def _variances(images, blocks, covariance: np.ndarray, noise: _Noise) -> _Noise:
    """The noise with which the squared residuals of either kind are as many as their redundancy."""
    square, free, taken = 0.0, np.zeros(2), 0.0
    for image, block in zip(images, blocks, strict=True):
        own, _, cross, where = _normal(image, block)
        inverse = np.linalg.inv(own)
        gain = inverse @ cross
        of_pose = inverse + gain @ covariance[np.ix_(where, where)] @ gain.T
        board = block[0]
        by_board = np.einsum("p,pij,pik->jk", board.weight, board.by_pose, board.by_pose)
        taken += float(np.trace(of_pose @ by_board))
        square += float((board.weight * (board.residual**2).sum(1)).sum())
        free += [group.residual.shape[1] * np.count_nonzero(group.weight) for group in block]
    unknowns = 6 * len(blocks) + len(covariance)
    free = np.maximum(free - [taken, unknowns - taken], 1.0)
    own = np.concatenate([image.noise for image in images])
    px = np.concatenate([block[1].px for block in blocks])
    weight = np.concatenate([block[1].weight for block in blocks])

    corner = _added(own, px, weight, APART, 6 / 8 * free[1])
    both = _added(own, px, weight, TOGETHER / 2, 2 / 8 * free[1])
    # The mean of four corners, times two: a tag's shift counts four times, the corners' own once.
    tag = np.sqrt(max(both**2 - corner**2, 0.0) / 4)
    return _Noise(noise.board * float(np.sqrt(square / free[0])), corner, float(tag))


def _added(own: np.ndarray, px: np.ndarray, weight: np.ndarray, part: np.ndarray, free: float) -> float:
    """σ that the residuals px (p, 8) have beside their own covariance (p, 8, 8), in the directions ``part`` (8, q)."""
    seen, known, unit = px @ part, part.T @ own @ part, np.eye(part.shape[1])

    def excess(added_px: float) -> float:
        solved = np.linalg.solve(known + added_px**2 * unit, seen[..., None])[..., 0]
        return float((weight * (seen * solved).sum(1)).sum()) - free

    if excess(0.0) <= 0:
        return 0.0
    most = float(np.sqrt((seen**2).sum() / free)) + 1e-9
    return float(root_scalar(excess, method="brentq", bracket=(0.0, most)).root)
