"""One adjustment of the board's poses in all images and of the tags' corners in the board's plane."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import root_scalar

from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import Reduction, reduce
from stcal.geometry.rigid import Poses, Rigid
from stcal.geometry.robust import huber_cost, huber_weights, length_limit, robust_sigma
from stcal.geometry.variances import sigma_factor
from stcal.locate.pose.problem import PlanarProblem, project

MAX_STEPS = 60
HUBER_TAIL = 0.011
"""Share of honest points, or tags, whose residuals Huber's loss damps: 3 σ in the plane."""
GROSS = 4.0
"""Times that limit: another tag than it is read as, or a corner that is hidden. It has no weight at all."""
VARIANCE_ROUNDS = 6
LEAST_FACTOR = 1e-3
"""Of the stated σ of the board's points: exact data have none, and rounding would count."""
TOGETHER = np.tile(np.eye(2), (4, 1))
"""(8, 2): the corners of a tag that moves as a whole."""
APART = null_space(TOGETHER.T)
"""(8, 6): what its corners do beside that."""
NEAR_PX = 0.005


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
class AdjustedLayout:
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
    and by the points (p, d, d); Huber's ``weight`` (p,); ``px`` : (p, d) residuals in pixels; ``cost`` : of Huber's
    loss, which rises no further where a residual is gross."""

    residual: np.ndarray
    by_pose: np.ndarray
    by_point: np.ndarray
    weight: np.ndarray
    px: np.ndarray
    cost: float


def adjust(images: Sequence[ImageCorners], start: np.ndarray) -> AdjustedLayout:
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
        linear = _Linear.of(images, poses, corners, noise)
        covariance = np.linalg.inv(linear.normal)
        before, noise = noise, _variances(images, linear, covariance, noise)
        change = max(abs(noise.corner_px - before.corner_px), abs(noise.tag_px - before.tag_px))
        settled = round_ > 0 and abs(noise.board / before.board - 1) < 0.01 and change < NEAR_PX
        if settled:
            break
    board, tags = ([block[side] for block in linear.blocks] for side in (0, 1))
    return AdjustedLayout(
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
    board = np.concatenate([np.linalg.norm(b[0].residual, axis=1) for b in blocks])
    tags = np.concatenate([np.linalg.norm(b[1].px.reshape(-1, 2), axis=1) for b in blocks])
    return _Noise(max(robust_sigma(board, 2), LEAST_FACTOR), robust_sigma(tags, 2), 0.0)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def _settled(images, poses: Poses, corners: np.ndarray, noise: _Noise) -> tuple[Poses, np.ndarray]:
    def moved(at: tuple[Poses, np.ndarray], step: np.ndarray) -> tuple[Poses, np.ndarray]:
        by_corner, by_pose = np.split(step, [corners.size])
        return at[0].moved(by_pose.reshape(-1, 6)), at[1] + by_corner.reshape(-1, 2)

    found = minimise((poses, corners), lambda at: _Linear.of(images, *at, noise), moved, max_steps=MAX_STEPS)
    return found.required("layout", "check board file and camera file").state


def _blocks(image: ImageCorners, pose: Poses, corners: np.ndarray, noise: _Noise) -> tuple[_Group, _Group]:
    """Board and tags of one image."""
    own = (4 * image.rows[:, None] + np.arange(4)).ravel()
    board = _group(image, pose, image.board_xyz[:, :2], image.board_seen, noise.board**2 * image.board_noise)
    covariance = image.noise + noise.corner_px**2 * np.eye(8) + noise.tag_px**2 * TOGETHER @ TOGETHER.T
    return board, _group(image, pose, corners[own], image.seen, covariance / image.focal_px**2)


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
    limit = length_limit(d, HUBER_TAIL)
    length = np.linalg.norm(residual, axis=1)
    return _Group(
        residual=residual,
        by_pose=root @ view.by_pose[0].reshape(p, d, 6),
        by_point=root @ by_point.reshape(p, d, d),
        weight=np.where(length > GROSS * limit, 0.0, huber_weights(length, limit)),
        px=image.focal_px * raw,
        cost=float(huber_cost(np.minimum(length, GROSS * limit), limit).sum()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """About a state: ``cost``; ``blocks`` : board and tags by image; ``normal`` (8n, 8n) and ``right`` (8n,) of the
    corners, the ``poses`` reduced away."""

    cost: float
    blocks: list[tuple[_Group, _Group]]
    normal: np.ndarray
    right: np.ndarray
    poses: Reduction

    @classmethod
    def of(cls, images, poses: Poses, corners: np.ndarray, noise: _Noise) -> "_Linear":
        blocks = [_blocks(image, poses[[i]], corners, noise) for i, image in enumerate(images)]
        m, k = len(blocks), corners.size
        own, own_right, cross = np.zeros((m, 6, 6)), np.zeros((m, 6)), np.zeros((m, 6, k))
        normal, right = np.zeros((k, k)), np.zeros(k)
        for i, (image, block) in enumerate(zip(images, blocks, strict=True)):
            for group in block:
                weighted = group.weight[:, None, None] * group.by_pose
                own[i] += np.einsum("pij,pik->jk", weighted, group.by_pose)
                own_right[i] += np.einsum("pij,pi->j", weighted, group.residual)
            tags, place = block[1], _place(image)
            weighted = tags.weight[:, None, None] * tags.by_point
            cross[i][:, place.ravel()] = np.einsum("pij,pik->jpk", tags.by_pose, weighted).reshape(6, -1)
            normal[place[:, :, None], place[:, None, :]] += np.einsum("pij,pik->pjk", weighted, tags.by_point)
            right[place] += np.einsum("pij,pi->pj", weighted, tags.residual)
        away = reduce(own, own_right, cross)
        cost = sum(group.cost for block in blocks for group in block)
        return cls(cost, blocks, normal - away.normal, right - away.right, away)

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Of the corners, which is damped, then of the poses, at their best for it."""
        own = np.linalg.solve(self.normal + damping * np.diag(np.diag(self.normal)), self.right)
        gain = 2 * float(own @ self.right) - float(own @ self.normal @ own) + self.poses.gain
        return np.concatenate([own, self.poses.back(own).ravel()]), gain


def _place(image: ImageCorners) -> np.ndarray:
    """(k, 8) where the coordinates of each tag stand among the unknowns."""
    return 8 * image.rows[:, None] + np.arange(8)


def _variances(images, linear: _Linear, covariance: np.ndarray, noise: _Noise) -> _Noise:
    """The noise with which the squared residuals of either kind are as many as their redundancy."""
    square, free, taken, blocks = 0.0, np.zeros(2), 0.0, linear.blocks
    for i, (image, block) in enumerate(zip(images, blocks, strict=True)):
        where = _place(image).ravel()
        by_corners = linear.poses.from_kept[i][:, where]
        of_pose = linear.poses.inverse[i] + by_corners @ covariance[np.ix_(where, where)] @ by_corners.T
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
    return _Noise(max(noise.board * sigma_factor(square, free[0]), LEAST_FACTOR), corner, float(tag))


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
