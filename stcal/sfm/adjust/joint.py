"""One adjustment over all groups: one target, one board with a pose for each group, all cameras, intrinsics if asked.

Board positions are observations with their stated σ, so scale is part of the estimate. The circles of a face are
coplanar within a stated σ. Residuals far beyond their σ weigh less (Huber). The inverse of the reduced normal matrix
is the marginal covariance of the circles, everything else accounted for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, ScaleError
from stcal.geometry.align import align_rigid
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import constrained_inverse, free_motions
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, robust_sigma
from stcal.io.camera import CameraPrior, intrinsic_basis
from stcal.labels import CircleLabel, DotLabel, dot_cells
from stcal.sfm.adjust.blocks import Block, Reduced, Shared, moved, normalised, reduced, robust_weights, step_of
from stcal.sfm.adjust.scale import MIN_DOTS
from stcal.sfm.data.model import GroupModel, MetricModel

EXACTLY = 1e-15
"""Share of χ² that the last step may promise: corrections of nanometres are to be seen."""
MAX_STEPS = 100
MAX_MOVE_PX = 0.02
"""Contradictory observations make the last steps slow; what still moves less than this has an answer for the checks."""
DAMPING = 1e-12
"""Nothing that the datum leaves open is determined by less."""
SETTLED_PX = 1e-7
"""What moves less has settled; what stops between the two limits is returned, and marked."""
FREE_DIRECTIONS = 6
"""The models' frame may be anywhere: a rigid motion of everything changes nothing."""
MIN_COMMON = 0.1
MAX_COMMON = 0.99
"""Share of the board's variance that is common to all groups: below the first it is taken as none, above the second
what is left to a single group would be smaller than anything a board does."""


@dataclass(frozen=True, slots=True, eq=False)
class JointResult:
    """The adjusted models, in one frame, mm.

    ``models`` : one for each group, mm; ``model_from_board`` by group; ``labels`` : (c,) of the target's circles;
    ``xyz_model`` : (c, 3) mm; ``covariance_mm2`` : (3c, 3c) marginal, in the datum of smallest trace, scaled by
    ``sigma0``²; ``sigma0`` : residuals against the centres' own σ; ``board_residuals_mm`` by group: (n, 3), board
    frame; ``board_common`` : share of the board's variance that all groups have in common; ``camera`` : adjusted where
    asked, with ``camera_covariance`` (q, q) of the parameters of its COLMAP model, else empty; ``weights`` by group:
    (n,) Huber's; ``redundancy`` : degrees of freedom; ``last_move_px`` : by how much the last whole step moves a
    projection at most.
    """

    models: tuple[MetricModel, ...]
    model_from_board: dict[str, Rigid]
    labels: tuple[CircleLabel, ...]
    xyz_model: np.ndarray
    covariance_mm2: np.ndarray
    sigma0: float
    board_residuals_mm: dict[str, np.ndarray]
    board_common: float
    camera: Camera
    camera_covariance: np.ndarray
    weights: dict[str, np.ndarray]
    redundancy: int
    last_move_px: float

    def __post_init__(self):
        c = len(self.labels)
        object.__setattr__(self, "xyz_model", frozen(self.xyz_model, (c, 3), "circles"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (3 * c, 3 * c), "covariance"))

    @property
    def settled(self) -> bool:
        """Whether the adjustment ended at its minimum, not merely on the way to it."""
        return self.last_move_px < SETTLED_PX


@dataclass(frozen=True, slots=True)
class _Places:
    """Of circles, common shape and intrinsics among the unknowns that the groups share, and how many those are."""

    circles: slice
    shape: slice
    intrinsics: slice
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """What stays the same in one minimisation; ``flatness_mm`` is infinite where nothing is known of it."""

    labels: tuple[CircleLabel, ...]
    board: BoardDesign
    common: float
    flatness_mm: float
    given: Camera
    prior: np.ndarray
    huber: float

    def places(self, shared: Shared) -> "_Places":
        """Where the shared unknowns stand."""
        c = 3 * len(self.labels)
        s = c + (3 * len(shared.shape_mm) if self.common else 0)
        count = s + shared.basis.shape[1]
        return _Places(slice(0, c), slice(c, s), slice(s, count), count)

    def own_sigma_mm(self) -> float:
        return self.board.sigma_mm * float(np.sqrt(1 - self.common))

    def shape_sigma_mm(self) -> float:
        return self.board.sigma_mm * float(np.sqrt(self.common))


def adjust_jointly(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,
    prior: CameraPrior | None = None,
    start: Camera | None = None,
) -> JointResult:
    """Adjust metric models that share one frame, all observations weighted by their σ.

    ``flatness_mm`` : σ of a circle's distance from the plane of its face, None for no such knowledge; ``prior`` : the
    intrinsics of ``camera`` are observations with this covariance and are adjusted, from ``start``; fixed where None.

    Whether the board kept its shape between the groups (one plate) or not (a film, a screen) is estimated from its
    dots: first every group has its own deviations from the design, and where these agree a common shape follows.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    blocks, shared, setting = _start(models, board, camera, flatness_mm, prior, start or camera)
    setting = replace(setting, huber=HUBER * _robust_sigma(blocks, shared.camera))
    blocks, shared, move = _minimise(blocks, shared, setting)
    common = _common_share(blocks, board)
    if common > 0:
        blocks, setting = _with_common(blocks, setting, common)
        blocks, shared, move = _minimise(blocks, shared, setting)
    return _result(blocks, shared, setting, move)


def covariance_of(
    models: Sequence[MetricModel],
    board: BoardDesign,
    camera: Camera,
    flatness_mm: float | None = None,
    prior: CameraPrior | None = None,
    common: float = 0.0,
) -> JointResult:
    """What :func:`adjust_jointly` is to report of models that are where they should be: nothing is moved, σ₀ is 1.

    Arguments as there; ``common`` : share of the board's variance that all groups have in common.
    """
    blocks, shared, setting = _start(models, board, camera, flatness_mm, prior, camera)
    if common > 0:
        blocks, setting = _with_common(blocks, setting, common)
    return _result(blocks, shared, setting, 0.0, 1.0)


def _start(models, board: BoardDesign, camera: Camera, flatness_mm, prior: CameraPrior | None, start: Camera):
    """Groups, what they share, and the setting: each group with its own board, no residual too long."""
    labels = tuple(sorted({label for model in models for label in model.labels if isinstance(label, CircleLabel)}))
    basis = intrinsic_basis(prior.colmap_model) if prior else np.zeros((12, 0))
    weight = np.linalg.inv(prior.covariance) if prior else np.zeros((0, 0))
    blocks = [_block(model, board, labels) for model in models]
    xyz = _shared_circles(blocks, len(labels))
    shared = Shared(xyz, np.zeros((board.rows * board.columns, 3)), start, basis)
    blocks = [replace(b, model=_with_circles(b, xyz)) for b in blocks]
    flatness_mm = np.inf if flatness_mm is None else flatness_mm
    return blocks, shared, _Setting(labels, board, 0.0, flatness_mm, camera, weight, np.inf)


def _with_common(blocks: list[Block], setting: _Setting, common: float) -> tuple[list[Block], _Setting]:
    """The same with a shape of the board that the groups have in common."""
    setting = replace(setting, common=common)
    own, board = setting.own_sigma_mm(), setting.board
    return [replace(b, sigma_mm=own, dot_place=_dot_place(b.model, b.dots, board)) for b in blocks], setting


def _minimise(blocks: list[Block], shared: Shared, setting: _Setting) -> tuple[list[Block], Shared, float]:
    """The state of least cost; and by how much the next whole step would still move a projection at most, px."""
    found = minimise(
        _State(tuple(blocks), shared),
        lambda state: _Normal.of(state, setting),
        lambda state, step: state.moved(step, setting),
        cost=lambda state: _cost(state.blocks, state.shared, setting),
        damping=DAMPING,
        least_damping=DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    last, beyond = found.state, found.state.moved(found.linear.step(DAMPING)[0], setting)
    move = max(_largest_move(a, last.shared, b, beyond.shared) for a, b in zip(last.blocks, beyond.blocks, strict=True))
    if not move <= MAX_MOVE_PX:  # not a number either
        raise ConvergenceError(
            f"joint adjustment: projections still move by {move:.1g} px in the last of at most {MAX_STEPS} steps; "
            "compare with --solve chain and look at the outliers"
        )
    return list(last.blocks), last.shared, float(move)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """All unknowns."""

    blocks: tuple[Block, ...]
    shared: Shared

    def moved(self, step: np.ndarray, setting: _Setting) -> "_State":
        """After a step of what the groups share, then of each group's own."""
        shared, places = self.shared, setting.places(self.shared)
        ends = places.count + np.cumsum([0, *(_size(b) for b in self.blocks)])
        blocks = tuple(moved(b, step[i:j]) for b, i, j in zip(self.blocks, ends[:-1], ends[1:], strict=True))
        shape = shared.shape_mm + step[places.shape].reshape(-1, 3) if setting.common else shared.shape_mm
        camera = shared.camera
        if shared.basis.shape[1]:
            camera = camera.with_parameters(camera.parameters() + shared.basis @ step[places.intrinsics])
        xyz = shared.xyz_model + step[places.circles].reshape(-1, 3)
        return _State(blocks, Shared(xyz, shape, camera, shared.basis))


def _size(block: Block) -> int:
    """Number of a group's own unknowns, points that it shares included."""
    return 3 * len(block.model.labels) + 6 * len(block.model.images) + 6


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations over what the groups share, each group's own unknowns reduced away."""

    cost: float
    state: _State
    setting: _Setting
    normal: np.ndarray
    right: np.ndarray
    groups: tuple[Reduced, ...]

    @classmethod
    def of(cls, state: _State, setting: _Setting) -> "_Normal":
        cost = _cost(state.blocks, state.shared, setting)
        return cls(cost, state, setting, *_normal_equations(state.blocks, state.shared, setting))

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Of what the groups share, then of each group's own."""
        setting, shared = self.setting, self.state.shared
        free = _free(len(self.normal), shared)
        held = self.normal + damping * np.diag(np.diag(self.normal))
        held += np.median(np.diag(self.normal)[: shared.xyz_model.size]) * free @ free.T
        outer = np.linalg.solve(held, self.right)
        gain = 2 * float(outer @ self.right) - float(outer @ self.normal @ outer) + sum(g.gain for g in self.groups)
        intrinsics = outer[setting.places(shared).intrinsics]
        own = [
            step_of(b, g, outer[_outer(b, setting, shared)], intrinsics)
            for b, g in zip(self.state.blocks, self.groups, strict=True)
        ]
        return np.concatenate([outer, *own]), gain


def _block(model: MetricModel, board: BoardDesign, labels: tuple[CircleLabel, ...]) -> Block:
    place = {label: i for i, label in enumerate(labels)}
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)])
    circles = np.array([i for i, label in enumerate(model.labels) if isinstance(label, CircleLabel)], int)
    if len(dots) < MIN_DOTS:
        raise ScaleError(
            f"group {model.group}: {len(dots)} board dots in the joint adjustment, {MIN_DOTS} needed; "
            "photograph the board with the faces"
        )
    design = board.places_mm(model.labels[i] for i in dots)
    return Block(
        model,
        align_rigid(model.xyz_model[dots], design),
        design,
        board.sigma_mm,
        dots,
        circles,
        np.zeros(0, int),
        np.array([place[model.labels[i]] for i in circles], int),
    )


def _dot_place(model: GroupModel, dots: np.ndarray, board: BoardDesign) -> np.ndarray:
    cells = dot_cells(model.labels[i] for i in dots)
    return cells[:, 0] * board.columns + cells[:, 1]


def _robust_sigma(blocks: list[Block], camera: Camera) -> float:
    """Robust σ of the normalised residuals per axis."""
    length = np.concatenate([np.linalg.norm(normalised(b.model, camera), axis=1) for b in blocks])
    return max(robust_sigma(length, 2), 1e-6)


def _common_share(blocks: list[Block], board: BoardDesign) -> float:
    """Covariance between the groups' board residuals over their variance; 0 where it is no more than chance."""
    by_dot = np.full((len(blocks), board.rows * board.columns, 3), np.nan)
    for k, b in enumerate(blocks):
        by_dot[k, _dot_place(b.model, b.dots, board)] = b.board_residual()
    product, square, count = 0.0, 0.0, 0
    for i in range(len(blocks)):
        for j in range(i):
            both = np.isfinite(by_dot[i]) & np.isfinite(by_dot[j])
            product += float((by_dot[i][both] * by_dot[j][both]).sum())
            square += float((by_dot[i][both] ** 2 + by_dot[j][both] ** 2).sum()) / 2
            count += int(both.sum())
    if not count or square == 0:
        return 0.0
    share = product / square
    return 0.0 if share < max(MIN_COMMON, 3 / np.sqrt(count)) else min(share, MAX_COMMON)


def _shared_circles(blocks: list[Block], count: int) -> np.ndarray:
    """Start values: the mean over the groups."""
    total, seen = np.zeros((count, 3)), np.zeros(count)
    for b in blocks:
        np.add.at(total, b.circle_place, b.model.xyz_model[b.circles])
        np.add.at(seen, b.circle_place, 1)
    return total / seen[:, None]


def _with_circles(block: Block, xyz: np.ndarray) -> MetricModel:
    points = block.model.xyz_model.copy()
    points[block.circles] = xyz[block.circle_place]
    return replace(block.model, xyz_model=points)


def _outer(block: Block, setting: _Setting, shared: Shared) -> np.ndarray:
    """Places of a group's outer unknowns among all: circles, shape, intrinsics."""
    places = setting.places(shared)
    circles = (3 * block.circle_place[:, None] + np.arange(3)).ravel()
    shape = places.shape.start + (3 * block.dot_place[:, None] + np.arange(3)).ravel()
    intrinsics = np.arange(places.intrinsics.start, places.intrinsics.stop)
    return np.concatenate([circles, shape, intrinsics]).astype(int)


def _normal_equations(blocks: Sequence[Block], shared: Shared, setting: _Setting):
    """Over circles, common shape and intrinsics: matrix and right-hand side; and the groups, reduced."""
    places = setting.places(shared)
    normal, right = np.zeros((places.count, places.count)), np.zeros(places.count)
    groups = tuple(reduced(b, shared, setting.huber) for b in blocks)
    for b, each in zip(blocks, groups, strict=True):
        place = _outer(b, setting, shared)
        normal[np.ix_(place, place)] += each.normal
        right[place] += each.right
    if setting.common:
        shape = np.arange(places.shape.start, places.shape.stop)
        normal[shape, shape] += 1 / setting.shape_sigma_mm() ** 2
        right[shape] -= shared.shape_mm.ravel() / setting.shape_sigma_mm() ** 2
    normal[places.intrinsics, places.intrinsics] += setting.prior
    right[places.intrinsics] -= setting.prior @ _away(shared, setting)
    for members, across, normal_model in _planes(shared, setting):
        jacobian = across[:, :, None] * normal_model  # distances from the plane by the circles
        flat = jacobian.reshape(len(members), -1)
        place = (3 * members[:, None] + np.arange(3)).ravel()
        distance = across @ (shared.xyz_model[members] @ normal_model)
        normal[np.ix_(place, place)] += flat.T @ flat / setting.flatness_mm**2
        right[place] -= flat.T @ distance / setting.flatness_mm**2
    return normal, right, groups


def _planes(shared: Shared, setting: _Setting):
    """For every face: its circles, the projector that takes heights to distances from the best plane, its normal."""
    if not np.isfinite(setting.flatness_mm):
        return
    faces: dict[str, list[int]] = {}
    for i, label in enumerate(setting.labels):
        faces.setdefault(label.face, []).append(i)
    for own in faces.values():
        if len(own) > 3:
            members = np.array(own)
            xyz = shared.xyz_model[members]
            normal = fit_plane(xyz).normal
            base = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
            design = np.column_stack([np.ones(len(own)), (xyz - xyz.mean(0)) @ base])
            yield members, np.eye(len(own)) - design @ np.linalg.pinv(design), normal


def _away(shared: Shared, setting: _Setting) -> np.ndarray:
    """Adjusted minus given intrinsics, (q,)."""
    return np.linalg.pinv(shared.basis) @ (shared.camera.parameters() - setting.given.parameters())


def _cost(blocks: Sequence[Block], shared: Shared, setting: _Setting) -> float:
    cost = sum(b.cost(shared, setting.huber) for b in blocks)
    if setting.common:
        cost += float(((shared.shape_mm / setting.shape_sigma_mm()) ** 2).sum())
    if shared.basis.shape[1]:
        away = _away(shared, setting)
        cost += float(away @ setting.prior @ away)
    for members, across, normal in _planes(shared, setting):
        cost += float(((across @ (shared.xyz_model[members] @ normal)) ** 2).sum()) / setting.flatness_mm**2
    return cost


def _free(count: int, shared: Shared) -> np.ndarray:
    """Directions (count, 6) in which all circles move as one: the datum is that of smallest trace over them."""
    free = np.zeros((count, FREE_DIRECTIONS))
    free[: shared.xyz_model.size] = free_motions(shared.xyz_model, scale=False)
    return free


def _largest_move(old: Block, shared: Shared, new: Block, new_shared: Shared) -> float:
    before, after = old.model.residuals_px(shared.camera), new.model.residuals_px(new_shared.camera)
    return float(np.abs(after - before).max(initial=0.0))


def _result(
    blocks: list[Block], shared: Shared, setting: _Setting, move_px: float, sigma0: float | None = None
) -> JointResult:
    """``move_px`` : of the last step; ``sigma0`` : estimated from the residuals where None."""
    normal, _, _ = _normal_equations(blocks, shared, setting)
    inverse = constrained_inverse(normal, _free(len(normal), shared))
    places = setting.places(shared)
    c = places.circles.stop
    flat = sum(len(members) - 3 for members, _, _ in _planes(shared, setting))
    observations = sum(2 * len(b.model.image_index) + 3 * len(b.dots) for b in blocks) + flat
    unknowns = c + sum(6 * len(b.model.images) + 3 * len(b.dots) + 6 for b in blocks)
    redundancy = observations - unknowns + FREE_DIRECTIONS
    if sigma0 is None:
        sigma0 = float(np.sqrt(_cost(blocks, shared, setting) / max(redundancy, 1)))
    covariance = sigma0**2 * inverse
    return JointResult(
        tuple(b.model for b in blocks),
        {b.model.group: b.model_from_board for b in blocks},
        setting.labels,
        shared.xyz_model,
        covariance[:c, :c],
        sigma0,
        {b.model.group: b.board_residual() for b in blocks},
        setting.common,
        shared.camera,
        covariance[places.intrinsics, places.intrinsics],
        {b.model.group: robust_weights(b.model, shared.camera, setting.huber) for b in blocks},
        redundancy,
        move_px,
    )
