"""Normal equations of a camera calibration, with the board's shape as unknowns."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import Reduction, reduce
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.adjust.equations import equations_of_poses, image_cost, normalised, robust_weights
from stcal.sfm.adjust.refine import moved_poses, projection_jacobians
from stcal.sfm.data.model import MetricModel

BOW_SHARE = 0.005
"""σ of a board's bends at its edge relative to its extent: 1 mm on 200 mm, more than that of any board in use."""
BENT_P = 1e-3
"""Significance level of bends. Insignificant bends are fixed to zero, as free bends cost accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardShape:
    """Design places of a folder's dots, and the prior of their deviations.

    ``places`` : (n, 3) mm; ``bow`` : (3n, m) orthonormal, second-order bends of the board out of its plane;
    ``bow_sigma_mm`` : σ of the amplitude of each bend. All other deviations are independent with the board's σ.
    """

    places: np.ndarray
    bow: np.ndarray
    bow_sigma_mm: float

    @classmethod
    def of(cls, places: np.ndarray) -> "BoardShape":
        """Returns the shape of a board with these places, its bends scaled by their extent."""
        xy = places[:, :2] - places[:, :2].mean(axis=0)
        extent = max(float(np.ptp(xy, axis=0).max()), 1e-9)
        x, y = 2 * xy.T / extent
        flat = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]
        bends = np.column_stack([x * x, x * y, y * y])
        bends -= flat @ (flat.T @ bends)
        u, size, _ = np.linalg.svd(bends, full_matrices=False)
        u = u[:, size > 1e-3 * np.sqrt(len(x))]  # fewer bends if the visible dots lie along a line
        bow = np.zeros((3 * len(places), u.shape[1]))
        bow[2::3] = u
        return cls(places, bow, BOW_SHARE * extent * float(np.sqrt(len(places))))

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Returns the inverse covariance (3n, 3n) of the dots' places."""
        bent = 1 / (sigma_mm**2 + self.bow_sigma_mm**2)
        return np.eye(len(self.bow)) / sigma_mm**2 - (1 / sigma_mm**2 - bent) * (self.bow @ self.bow.T)

    def costs(self, xyz: np.ndarray, sigma_mm: float) -> tuple[float, float]:
        """Returns the χ² of the deviations of places (n, 3) from the design: without bends, and of the bends."""
        deviation = (xyz - self.places).ravel()
        bends = self.bow.T @ deviation
        cost_of_dots = float(deviation @ deviation - bends @ bends) / sigma_mm**2
        return cost_of_dots, float(bends @ bends) / (sigma_mm**2 + self.bow_sigma_mm**2)

    def redundancy(self, board: Reduction, covariance: np.ndarray, sigma_mm: float) -> float:
        """Returns the redundancy of the observations of the dots without the bends.

        ``board`` : reduction of the dots; ``covariance`` : of the unknowns that are kept.
        """
        inverse, from_kept = board.inverse[0], board.from_kept[0]
        bent = from_kept.T @ self.bow
        taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept)
        taken -= np.sum(self.bow * (inverse @ self.bow)) + np.sum((covariance @ bent) * bent)
        return board.step.size - self.bow.shape[1] - float(taken) / sigma_mm**2

    def flat_by_chance(
        self, xyz: np.ndarray, board: Reduction, covariance: np.ndarray, sigma_mm: float
    ) -> "BoardShape":
        """Returns the shape without bends if the bends of ``xyz`` (n, 3) are insignificant, else itself.

        Other arguments as in :meth:`redundancy`.
        """
        bends = self.bow.T @ (xyz - self.places).ravel()
        bent = board.from_kept[0].T @ self.bow
        spread = self.bow.T @ board.inverse[0] @ self.bow + bent.T @ covariance @ bent
        spread += sigma_mm**2 * np.eye(len(bends))
        chance = chdtrc(max(len(bends), 1), float(bends @ np.linalg.solve(spread, bends)))
        return self if chance < BENT_P else replace(self, bow=self.bow[:, :0])


MAX_STEPS = 200
EXACTLY = 1e-15
"""Largest relative decrease of χ² that is predicted for a step at convergence."""
SETTLED_PX = 1e-5
"""Largest move of a projection at convergence, px. Along a valley, χ² may decrease forever without a visible change."""
TINY_PX = 1e-3
"""Focal length that stands for invalid parameters."""
CREEPING_PX = 1e-3
"""Largest move of a projection accepted after all steps: a direction that hardly changes the images has a large σ."""
START_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Unknowns of a calibration.

    ``models`` : views of one folder's board by one camera each; ``folder``, ``camera_of`` : of each model; models of
    one folder share their points; ``instant_of`` : (m,) index of each image of a model among the poses of its folder;
    ``first_from_board`` : these poses, by folder; ``camera_from_first`` : poses on the rig, empty without a rig.
    """

    models: tuple[MetricModel, ...]
    folder: tuple[str, ...]
    camera_of: tuple[int, ...]
    instant_of: tuple[np.ndarray, ...]
    first_from_board: dict[str, tuple[Rigid, ...]]
    cameras: tuple[Camera, ...]
    camera_from_first: tuple[Rigid, ...] = ()

    def boards(self) -> dict[str, list[int]]:
        """Returns the indices of the models by folder."""
        members: dict[str, list[int]] = {}
        for i, folder in enumerate(self.folder):
            members.setdefault(folder, []).append(i)
        return members

    def only(self, names: set[str]) -> "State":
        """Returns the state with the images of these ``names`` alone, of cameras that are on no rig."""
        kept = [(i, part) for i, model in enumerate(self.models) if (part := _of_images(model, names)).images]
        return self._of(
            [part for _, part in kept], [self.folder[i] for i, _ in kept], [self.camera_of[i] for i, _ in kept]
        )

    def in_two(self, half: dict[str, int]) -> "State":
        """Returns the state of one camera as that of two, of which each took the images of one ``half``, 0 or 1."""
        models, folders, cameras = [], [], []
        for model, folder in zip(self.models, self.folder, strict=True):
            for k in (0, 1):
                part = _of_images(model, {name for name, own in half.items() if own == k})
                if part.images:
                    models.append(part)
                    folders.append(folder)
                    cameras.append(k)
        return replace(self._of(models, folders, cameras), cameras=self.cameras * 2)

    def _of(self, models: list[MetricModel], folders: list[str], cameras: list[int]) -> "State":
        poses: dict[str, tuple[Rigid, ...]] = {}
        instants = []
        for model, folder in zip(models, folders, strict=True):
            before = poses.get(folder, ())
            instants.append(len(before) + np.arange(len(model.images)))
            poses[folder] = before + model.camera_from_model
        return replace(
            self,
            models=tuple(models),
            folder=tuple(folders),
            camera_of=tuple(cameras),
            instant_of=tuple(instants),
            first_from_board=poses,
        )

    def seen(self) -> "State":
        """Returns the state with the views' poses computed from those of instants and cameras."""
        return replace(
            self, models=tuple(replace(m, camera_from_model=self._poses(i)) for i, m in enumerate(self.models))
        )

    def _poses(self, i: int) -> tuple[Rigid, ...]:
        poses, k = self.first_from_board[self.folder[i]], self.camera_of[i]
        own = [poses[t] for t in self.instant_of[i].tolist()]
        return (
            tuple(self.camera_from_first[k] @ pose for pose in own) if self.camera_from_first and k > 0 else tuple(own)
        )

    def cost(self, huber: float) -> float:
        """Returns the χ² of the images, with Huber's loss beyond ``huber``."""
        return sum(image_cost(m, self.cameras[k], huber) for m, k in zip(self.models, self.camera_of, strict=True))

    def normalised(self) -> np.ndarray:
        """Returns the normalised residuals of all observations, (n, 2)."""
        each = zip(self.models, self.camera_of, strict=True)
        return np.concatenate([normalised(m, self.cameras[k]) for m, k in each])

    def redundancy(self, kept: int) -> int:
        """Returns the redundancy: observed coordinates minus unknowns of poses minus the ``kept`` unknowns.

        The dots add as many observations as unknowns.
        """
        poses = sum(len(each) for each in self.first_from_board.values())
        return sum(2 * len(m.image_index) for m in self.models) - 6 * poses - kept


def _of_images(model: MetricModel, names: set[str]) -> MetricModel:
    """Returns the model with the images of these names alone, and with all its points."""
    keep = np.array([name in names for name in model.images])
    rows = np.flatnonzero(keep[model.image_index])
    return replace(
        model,
        images=tuple(name for name in model.images if name in names),
        camera_from_model=tuple(pose for pose, own in zip(model.camera_from_model, keep, strict=True) if own),
        image_index=(np.cumsum(keep) - 1)[model.image_index[rows]],
        **{name: getattr(model, name)[rows] for name in OF_OBSERVATIONS},
    )


OF_OBSERVATIONS = ("point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Constants of one minimisation.

    By camera, ``basis`` : (16, q) and ``weight`` : (q, q) of the vague prior about ``start``; ``rig`` : whether the
    cameras are on one rig.
    """

    basis: tuple[np.ndarray, ...]
    weight: tuple[np.ndarray, ...]
    start: tuple[Camera, ...]
    shape: dict[str, BoardShape]
    sigma_mm: float
    huber: float
    rig: bool = False

    def away(self, k: int, camera: Camera) -> np.ndarray:
        """Returns the parameters of the COLMAP model minus those at the start, (q,)."""
        return np.linalg.pinv(self.basis[k]) @ (camera.parameters() - self.start[k].parameters())

    def intrinsics(self, k: int) -> slice:
        """Returns the place of a camera's intrinsics among the kept unknowns."""
        ends = np.cumsum([0, *(b.shape[1] for b in self.basis)])
        return slice(int(ends[k]), int(ends[k + 1]))

    def sits(self, k: int) -> slice:
        """Returns the place of a camera's pose on the rig among the kept unknowns, 6 or empty."""
        begin = self.intrinsics(len(self.basis) - 1).stop
        return slice(begin + 6 * (k - 1), begin + 6 * k) if self.rig and k else slice(begin, begin)

    def of_camera(self, k: int) -> np.ndarray:
        """Returns the indices of the kept unknowns that a camera's views depend on."""
        intrinsics, sits = self.intrinsics(k), self.sits(k)
        return np.concatenate([np.arange(intrinsics.start, intrinsics.stop), np.arange(sits.start, sits.stop)])

    @property
    def kept(self) -> int:
        """Number of kept unknowns."""
        return max(self.sits(len(self.basis) - 1).stop, self.intrinsics(len(self.basis) - 1).stop)


def dots_costs(state: State, setting: Setting) -> np.ndarray:
    """Returns the χ² of the dots' places: without the bends of boards, and of the bends."""
    each = [
        setting.shape[folder].costs(state.models[rows[0]].xyz_model, setting.sigma_mm)
        for folder, rows in state.boards().items()
    ]
    return np.sum(each, axis=0)


def _cost(state: State, setting: Setting) -> float:
    cost = float(dots_costs(state, setting).sum())
    for k, camera in enumerate(state.cameras):
        away = setting.away(k, camera)
        cost += float(away @ setting.weight[k] @ away)
    return cost + state.cost(setting.huber)


def derivatives(state: State, setting: Setting, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the derivatives of a model's projections, px.

    By the poses of its instants, (n, 2, 6), by its points, (n, 2, 3), and by the unknowns of
    :meth:`Setting.of_camera`, (n, 2, k).

    All motions are left perturbations. With camera_k_from_first = (R, t) and first_from_board = (S, s), a rotation w
    and a shift d of the latter rotate the view's pose by R w and shift it by R d; of the former, by w and w × R s + d.
    """
    model, k = state.models[i], state.camera_of[i]
    camera = state.cameras[k]
    by_pose, by_point = projection_jacobians(model, camera)
    xyz = model.xyz_camera()
    by_shared = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ setting.basis[k]
    if setting.rig and k:
        turn = state.camera_from_first[k].rotation
        poses = state.first_from_board[state.folder[i]]
        carried = np.array([poses[t].translation for t in state.instant_of[i].tolist()]) @ turn.T
        by_shift = by_pose[:, :, 3:]
        by_turn = by_pose[:, :, :3] - by_shift @ skew(carried[model.image_index])
        by_shared = np.concatenate([by_shared, by_turn, by_shift], axis=2)
        by_pose = np.concatenate([by_pose[:, :, :3] @ turn, by_shift @ turn], axis=2)
    return by_pose, by_point, by_shared


def _of_board(state: State, setting: Setting, folder: str, rows: list[int]):
    """Returns the normal equations of a board's dots and the kept unknowns, and the reduction of the poses."""
    p, t = setting.shape[folder].places.size, len(state.first_from_board[folder])
    size = p + setting.kept
    full, full_right = np.zeros((size, size)), np.zeros(size)
    block, block_right, cross = np.zeros((t, 6, 6)), np.zeros((t, 6)), np.zeros((t, 6, size))
    for i in rows:
        model, k, instant = state.models[i], state.camera_of[i], state.instant_of[i]
        root = np.sqrt(robust_weights(model, state.cameras[k], setting.huber))[:, None]
        a, c, e = (model.whiten(d) * root[..., None] for d in derivatives(state, setting, i))
        equations = equations_of_poses(model, a, c, e, normalised(model, state.cameras[k]) * root)
        place = np.concatenate([np.arange(p), p + setting.of_camera(k)])
        if len(place) == size:
            full += equations.normal  # an index of all rows takes as long as all else here
        else:
            full[np.ix_(place, place)] += equations.normal
        full_right[place] += equations.right
        block[instant] += equations.block
        block_right[instant] += equations.block_right
        cross[np.ix_(instant, np.arange(6), place)] += equations.cross
    poses = reduce(block, block_right, cross)
    return full - poses.normal, full_right - poses.right, poses


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of the kept unknowns, after elimination of the poses and then of each board's dots."""

    cost: float
    state: State
    setting: Setting
    normal: np.ndarray
    right: np.ndarray
    boards: tuple[Reduction, ...]
    poses: tuple[Reduction, ...]

    @classmethod
    def of(cls, state: State, setting: Setting) -> "Normal":
        normal, right = np.zeros((setting.kept, setting.kept)), np.zeros(setting.kept)
        for k, camera in enumerate(state.cameras):
            place = setting.intrinsics(k)
            normal[place, place] += setting.weight[k]
            right[place] -= setting.weight[k] @ setting.away(k, camera)
        boards, poses = [], []
        for folder, rows in state.boards().items():
            shape = setting.shape[folder]
            p = shape.places.size
            full, full_right, away = _of_board(state, setting, folder, rows)
            own = shape.weight(setting.sigma_mm)
            full[:p, :p] += own
            full_right[:p] -= own @ (state.models[rows[0]].xyz_model - shape.places).ravel()
            dots = reduce(full[None, :p, :p], full_right[None, :p], full[None, :p, p:])
            normal += full[p:, p:] - dots.normal
            right += full_right[p:] - dots.right
            boards.append(dots)
            poses.append(away)
        return cls(_cost(state, setting), state, setting, normal, right, tuple(boards), tuple(poses))

    def dots_left(self) -> float:
        """Returns the redundancy of the observations of the dots."""
        covariance, setting = np.linalg.inv(self.normal), self.setting
        left = (
            setting.shape[folder].redundancy(board, covariance, setting.sigma_mm)
            for board, folder in zip(self.boards, self.state.boards(), strict=True)
        )
        return float(sum(left))

    def with_flat_boards(self) -> dict[str, BoardShape]:
        """Returns the shapes of the boards, without bends if these are insignificant."""
        covariance, setting = np.linalg.inv(self.normal), self.setting
        return {
            folder: setting.shape[folder].flat_by_chance(
                self.state.models[rows[0]].xyz_model, board, covariance, setting.sigma_mm
            )
            for board, (folder, rows) in zip(self.boards, self.state.boards().items(), strict=True)
        }

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of the kept unknowns, then of the boards' dots, then of their poses; and the predicted
        gain."""
        kept_step = np.linalg.solve(self.normal + damping * np.diag(np.diag(self.normal)), self.right)
        gain = 2 * float(kept_step @ self.right) - float(kept_step @ self.normal @ kept_step)
        gain += sum(each.gain for each in (*self.boards, *self.poses))
        dots = [board.back(kept_step).ravel() for board in self.boards]
        poses = [
            each.back(np.concatenate([moved, kept_step])).ravel() for each, moved in zip(self.poses, dots, strict=True)
        ]
        step = np.concatenate([kept_step, *dots, *poses])
        return step, gain if self.largest_move(step) > SETTLED_PX else 0.0

    def largest_move(self, step: np.ndarray) -> float:
        """Returns the largest move of a projection by a step, px."""
        new = moved(self.state, self.setting, step)
        moves = [
            np.abs(b.residuals_px(new.cameras[k]) - a.residuals_px(self.state.cameras[k])).max()
            for a, b, k in zip(self.state.models, new.models, self.state.camera_of, strict=True)
        ]
        return float(max(moves))


def minimum(state: State, setting: Setting) -> State:
    """Returns the state of least cost. Only the kept unknowns are damped; dots and poses are optimal for each step.

    Raises ConvergenceError: no minimum is reached.
    """
    solution = minimise(
        state,
        lambda at: Normal.of(at, setting),
        lambda at, step: moved(at, setting, step),
        cost=lambda at: _cost(at, setting),
        damping=START_DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    if not solution.converged:  # a direction that hardly changes the images has a large σ
        move = solution.linear.largest_move(solution.linear.step(START_DAMPING)[0])
        if not move < CREEPING_PX:
            raise ConvergenceError(
                "E-NO-MINIMUM",
                f"camera: projections still move by {move:.1g} px after {solution.steps} steps, {CREEPING_PX:g} px "
                "needed; look at the images, add views that fill the image and are tilted, or choose a simpler --model",
            )
    return solution.state


def moved(state: State, setting: Setting, step: np.ndarray) -> State:
    """Returns the state after a step of :meth:`Normal.step`."""
    boards, models = state.boards(), list(state.models)
    kept_step, remaining = np.split(step, [setting.kept])
    sizes = [setting.shape[folder].places.size for folder in boards]
    *dots, remaining = np.split(remaining, np.cumsum(sizes))
    instants = np.cumsum([6 * len(state.first_from_board[folder]) for folder in boards])[:-1]
    first_from_board = {
        folder: moved_poses(state.first_from_board[folder], each.reshape(-1, 6))
        for folder, each in zip(boards, np.split(remaining, instants), strict=True)
    }
    for rows, shift in zip(boards.values(), dots, strict=True):
        for i in rows:
            models[i] = replace(models[i], xyz_model=models[i].xyz_model + shift.reshape(-1, 3))
    cameras = tuple(
        camera.with_parameters(_positive(camera.parameters() + setting.basis[k] @ kept_step[setting.intrinsics(k)]))
        for k, camera in enumerate(state.cameras)
    )
    camera_from_first = state.camera_from_first
    if setting.rig:
        moved_cameras = moved_poses(camera_from_first[1:], kept_step[setting.sits(1).start :].reshape(-1, 6))
        camera_from_first = (camera_from_first[0], *moved_cameras)
    return replace(
        state,
        models=tuple(models),
        first_from_board=first_from_board,
        cameras=cameras,
        camera_from_first=camera_from_first,
    ).seen()


def _positive(parameters: np.ndarray) -> np.ndarray:
    """Returns the parameters if they are those of a camera, else parameters that no image agrees with."""
    if (parameters[:2] > 0).all() and np.isfinite(parameters).all():
        return parameters
    return np.concatenate([[TINY_PX, TINY_PX], np.zeros(len(parameters) - 2)])
