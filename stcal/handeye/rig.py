"""Cross-validation of a rig's calibration over the robot's poses, compared with each camera by itself."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.arrays import Brief, freeze, require_arguments, require_fields
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.handeye.data.pairs import Loop, Setup
from stcal.handeye.data.views import RigPoses, Views
from stcal.handeye.judge import remarks
from stcal.handeye.judge.mistakes import check_conventions, repair, turned_view
from stcal.handeye.judge.observability import LEAST_POSES, Observability, check, require_scale
from stcal.handeye.judge.remarks import Aside, Grave
from stcal.handeye.methods import closed_form
from stcal.handeye.methods.joint import Adjusted, adjust_rig
from stcal.handeye.methods.noise import Noise, kind
from stcal.handeye.methods.reprojection import GROSS_RAD, GROSS_SHARE, resected
from stcal.handeye.result import HandEye
from stcal.handeye.solve import HandEyeOptions, handeye, of_camera_file
from stcal.handeye.validate import HeldOutPoses, predicted, scatter_notes, scatter_of
from stcal.parallel import one_thread, run_in_order

POSE = 6
"""Number of parameters of a pose."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rig(Brief):
    """Poses of c cameras of one robot, from one adjustment of all their corners.

    Parameters
    ----------
    names : tuple of str
        Names of the cameras.
    cameras : tuple of HandEye
        Result of each camera: its ``mount_from_camera`` with covariance, residuals and corners of its own views, and σ
        by which these were weighted. ``stand_from_board`` and σ of robot and board are the same for all cameras.
    covariance : (6c + 6, 6c + 6) array
        Covariance of all ``mount_from_camera`` in their order and of ``stand_from_board``: rotation (rad), translation
        (mm) of each, left perturbations.
    poses : tuple of str
        Names of the robot's poses.
    outliers : (m,) bool array
        Poses of the robot that contradict the others.
    notes : tuple of str
        Notes on the rig as a whole, one line each.
    """

    names: tuple[str, ...]
    cameras: tuple[HandEye, ...]
    covariance: np.ndarray
    poses: tuple[str, ...]
    outliers: np.ndarray
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        size = POSE * (len(self.names) + 1)
        freeze(self, "covariance", (size, size), "covariance")
        freeze(self, "outliers", (len(self.poses),), "outliers", bool)

    @property
    def setup(self) -> Setup:
        """Setup, which says what carries the cameras."""
        return self.cameras[0].setup

    @property
    def stand_from_board(self) -> Rigid:
        """Pose of the board, mm."""
        return self.cameras[0].stand_from_board

    def camera(self, name: str) -> HandEye:
        """Returns the result of one camera.

        Raises
        ------
        InputError
            No camera has this name.
        """
        return self.cameras[self._number(name)]

    def relative(self, first: str, second: str) -> tuple[Rigid, np.ndarray]:
        """Returns the pose of one camera in another, with its covariance.

        Parameters
        ----------
        first, second : names of two cameras

        Returns
        -------
        Rigid
            first_from_second, mm.
        (6, 6) array
            Its covariance, rotation (rad) and translation (mm), left perturbation. It includes the correlation of the
            two ``mount_from_camera``: common errors due to board and robot cancel.

        Raises
        ------
        InputError
            No camera has this name.
        """
        i, j = self._number(first), self._number(second)
        x, y = self.cameras[i].mount_from_camera, self.cameras[j].mount_from_camera
        x_from_mount, jacobian = x.rotation.T, np.zeros((POSE, len(self.covariance)))
        # X and Y perturbed by u and w give exp(v) X⁻¹ Y: v is w − u in axes of X, plus u's turn times the lever arm.
        by_x, by_y = jacobian[:, POSE * i : POSE * i + POSE], jacobian[:, POSE * j : POSE * j + POSE]
        by_y[:3, :3] = by_y[3:, 3:] = x_from_mount
        by_x[:3, :3] -= x_from_mount
        by_x[3:, 3:] -= x_from_mount
        by_x[3:, :3] += x_from_mount @ skew(y.translation - x.translation)
        return x.inverse() @ y, jacobian @ self.covariance @ jacobian.T

    def widened(self, factor: float) -> "Rig":
        """Returns the rig with all σ of the transforms multiplied by ``factor``."""
        cameras = tuple(camera.widened(factor) for camera in self.cameras)
        return replace(self, cameras=cameras, covariance=factor**2 * self.covariance)

    def all_notes(self) -> tuple[str, ...]:
        """Returns the notes on the rig, then those on each camera under its name."""
        of_cameras = (
            type(n)(f"{name}: {n}") for name, c in zip(self.names, self.cameras, strict=True) for n in c.notes
        )
        return (*self.notes, *of_cameras)

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise InputError("E-RIG-NO-CAMERA", f"rig: no camera {name!r}; one of {', '.join(self.names)} needed")
        return self.names.index(name)


BY_CHANCE = 1e-5
"""False-alarm probability of the note that two cameras place the board differently."""


@dataclass(frozen=True, slots=True, eq=False)
class RigOptions:
    """Options of a rig's calibration: known errors, and further unknowns.

    Parameters
    ----------
    noise : Noise
        Known σ of robot, corners and board. Unknown σ are estimated, those of corners for each camera separately. σ of
        the board's poses are not used.
    refine : bool
        Solve for the intrinsics of each camera too, held by its ``prior``. If not, their uncertainty is propagated into
        σ.
    with_scale : bool
        Solve for the board's true size too.
    symmetries : tuple of Rigid
        All board_from_board except the identity that map the board onto itself.
    """

    noise: Noise = field(default_factory=Noise)
    refine: bool = False
    with_scale: bool = False
    symmetries: tuple[Rigid, ...] = ()

    def __post_init__(self):
        require_fields(self, "rig")


@dataclass(frozen=True, slots=True, eq=False)
class _First:
    """First solution of one camera alone: ``x``, ``z``, ``scale``, ``views`` after repair of numbering, ``notes``."""

    x: Rigid
    z: Rigid
    scale: float
    views: Views
    notes: tuple[str, ...]


@require_arguments
@one_thread()
def handeye_rig(given: RigPoses, setup: Setup = "eye-in-hand", options: RigOptions | None = None) -> Rig:
    """Returns the poses of several cameras on one flange, or in one base, from one adjustment of all their corners.

    The images from one pose of the robot share its error, and all cameras share the board and its pose. A camera
    therefore gains from the images of the others, and relative poses of cameras are more accurate than from separate
    calibrations. A camera with too few images to be solved alone is solved with the help of the others.

    Parameters
    ----------
    given : RigPoses
        Poses of the robot, and the views of each camera from them.
    setup : {"eye-in-hand", "eye-to-hand"}
        ``eye-in-hand``: cameras on the flange, board in the base; ``eye-to-hand``: cameras in the base, board on the
        flange.
    options : RigOptions, optional
        Options of the solution; the defaults if None.

    Returns
    -------
    Rig

    Raises
    ------
    InputError
        Poses of a camera contradict each other, or follow another convention; the message names the camera.
    DegenerateError
        No camera can be solved alone, or cameras see the board at different places; the message names them.
    ConvergenceError
        No minimum is reached.

    Examples
    --------
    >>> rig = handeye_rig(given, "eye-in-hand")  # doctest: +SKIP
    >>> left_from_right, covariance = rig.relative("left", "right")  # doctest: +SKIP
    """
    options = options or RigOptions()
    firsts = [_first(given, i, setup, options) for i in range(len(given.cameras))]
    solved = [first for first in firsts if isinstance(first, _First)]
    if not solved:
        raise next(first for first in firsts if isinstance(first, DegenerateError))
    given, solved = _same_numbering(given, firsts, options.symmetries)
    z, scale = closed_form.mean_pose(Poses.of([first.z for first in solved.values()])), 1.0
    if options.with_scale:
        scale = float(np.median([first.scale for first in solved.values()]))
    _require_one_board(given, solved)
    x = [solved[i].x if i in solved else _by_board(given, i, setup, z, scale) for i in range(len(given.cameras))]
    solution = adjust_rig(given, setup, (x, z, scale), options.noise, options.refine, options.with_scale)
    return _rig(given, setup, options, solution, {i: first.notes for i, first in solved.items()})


def same_numbering(given: RigPoses, setup: Setup, symmetries: tuple[Rigid, ...]) -> RigPoses:
    """Renumbers views of a symmetric board that were numbered from another end, as :func:`handeye_rig` does.

    Raises StcalError as :func:`handeye_rig`.
    """
    if not symmetries:
        return given
    options = RigOptions(symmetries=symmetries)
    firsts = [_first(given, i, setup, options) for i in range(len(given.cameras))]
    return _same_numbering(given, firsts, symmetries)[0]


def alone(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> HandEye:
    """Solves for one camera of a rig by itself, with :func:`~stcal.handeye.handeye` and method ``reprojection``.

    Raises StcalError as :func:`~stcal.handeye.handeye`.
    """
    camera = given.cameras[i]
    prior, one = camera.prior, options
    intrinsics = prior if options.refine else None
    options_of_camera = HandEyeOptions(one.noise, intrinsics, one.with_scale, one.symmetries, camera=prior)
    return handeye(given.pairs(i), setup, "reprojection", camera.views, options_of_camera)


def of_places(names: tuple[str, ...], found: list[HandEye | None]) -> tuple[str, ...]:
    """Returns notes on cameras whose own solutions, ``found``, place the board differently from other cameras' ones."""
    apart = {}
    for i, later in enumerate(found):
        for j, earlier in enumerate(found[:i]):
            if later is None or earlier is None or later.stand_covariance is None or earlier.stand_covariance is None:
                continue
            difference = Poses.of([later.stand_from_board]).difference(Poses.of([earlier.stand_from_board]))[0]
            squared = float(difference @ np.linalg.solve(later.stand_covariance + earlier.stand_covariance, difference))
            apart[j, i] = squared > chi2.ppf(1 - BY_CHANCE, len(difference)), difference
    notes = []
    for names_of, against, difference in _named(apart, len(names)):
        many = len(names_of) > 1
        accused, witnesses = ", ".join(names[k] for k in names_of), ", ".join(names[k] for k in against)
        where = f"{np.linalg.norm(difference[3:]):.2g} mm and {np.degrees(np.linalg.norm(difference[:3])):.2g}°"
        finding = f"{accused} and {witnesses} find the board {where} apart" if many or len(names) < 3 else ""
        finding = finding or f"{accused} finds the board {where} from where {witnesses} do{'es' * (len(against) == 1)}"
        whose = "both" if not many and len(names) < 3 else accused
        notes.append(Grave(f"{finding}, more than σ allow: check images, intrinsics and board of {whose}"))
    return tuple(notes)


def _named(
    apart: dict[tuple[int, int], tuple[bool, np.ndarray]], count: int
) -> list[tuple[list[int], list[int], np.ndarray]]:
    """Explains contradicting pairs by few cameras: repeatedly names the camera with most contradictions.

    Returns per camera its number, the numbers of the cameras that it contradicts, and one difference of poses.
    """
    unexplained, named = {pair for pair, (far, _) in apart.items() if far}, []
    while unexplained:
        contradictions = [sum(k in pair for pair in unexplained) for k in range(count)]
        k = int(np.argmax(contradictions))
        pairs_of_camera = sorted(pair for pair in unexplained if k in pair)
        others = [pair[0] if pair[1] == k else pair[1] for pair in pairs_of_camera]
        named.append(([k], others, apart[pairs_of_camera[0]][1]))
        unexplained -= set(pairs_of_camera)
    return named


def _first(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> "_First | DegenerateError":
    """Returns the first solution of one camera by itself, or the error if its images are too few or turn too little."""
    camera, pairs = given.cameras[i], given.pairs(i)
    if len(camera) < LEAST_POSES:
        return DegenerateError(
            "E-HANDEYE-FEW-POSES", f"{pairs.where}: {len(camera)} images, {LEAST_POSES} needed; take more"
        )
    views, notes = camera.views, ()
    try:
        check(Loop.of(pairs, setup), setup, pairs.where, False)
        if options.symmetries:
            repaired = repair(pairs, setup, options.symmetries, views)
            pairs, views, notes = repaired.pairs, repaired.views or views, repaired.notes()
    except DegenerateError as error:
        return error
    loop = Loop.of(pairs, setup)
    x, z, scale = closed_form.robust(loop, options.with_scale)
    notes += check_conventions(pairs, loop, setup, closed_form.robust, options.with_scale, True)
    return _First(x, z, scale, views, notes)


def _same_numbering(given: RigPoses, firsts: list, symmetries: tuple[Rigid, ...]) -> tuple[RigPoses, dict[int, _First]]:
    """Numbers the corners of a symmetric board alike in all cameras: as the first camera that was solved alone does."""
    numbered, cameras = {}, list(given.cameras)
    for i, first in enumerate(firsts):
        if not isinstance(first, _First):
            continue
        reference = next(iter(numbered.values()), first).z
        turns = (Rigid(), *symmetries)
        deviations = [
            Rigid(reference.rotation.T @ (first.z @ turn).rotation).angle_rad()
            + float(np.linalg.norm((first.z @ turn).translation - reference.translation)) / 1e3
            for turn in turns
        ]
        turn = turns[int(np.argmin(deviations))]
        views = Views(first.views.camera, tuple(turned_view(view, turn) for view in first.views.views))
        notes = first.notes
        if turn is not turns[0]:
            notes += (Aside("all its views were numbered from another end of the board than those of the others"),)
        numbered[i] = replace(first, z=first.z @ turn, views=views, notes=notes)
        cameras[i] = replace(cameras[i], views=views)
    return replace(given, cameras=tuple(cameras)), numbered


def _require_one_board(given: RigPoses, known: dict[int, _First]) -> None:
    """Raises DegenerateError if cameras place the board so differently that noise cannot explain it."""
    reach = {i: float(np.median(np.linalg.norm(given.pairs(i).camera_from_board.translation, axis=1))) for i in known}
    apart = {}
    for i, camera in known.items():
        for j, earlier in known.items():
            if j < i:
                difference = Poses.of([camera.z]).difference(Poses.of([earlier.z]))[0]
                far = np.linalg.norm(difference[3:]) > GROSS_SHARE * max(reach[i], reach[j])
                apart[j, i] = bool(far or np.linalg.norm(difference[:3]) > GROSS_RAD), difference
    named = _named(apart, len(given.cameras))
    if not named:
        return
    (accused, *_), others, difference = named[0]
    name, witnesses = given.cameras[accused].name, ", ".join(given.cameras[k].name for k in others)
    away = f"{np.linalg.norm(difference[3:]):.3g} mm and {np.degrees(np.linalg.norm(difference[:3])):.3g}°"
    pair = (
        f"{name} and {witnesses} see it {away} apart" if len(known) < 3 else f"{name} sees it {away} from {witnesses}"
    )
    camera = "both" if len(known) < 3 else name
    raise DegenerateError(
        "E-RIG-CONTRADICTS",
        f"{given.where}: the board must be at one place, but {pair}; check images, intrinsics, board and poses of "
        f"{camera}, or leave one camera out",
    )


def _by_board(given: RigPoses, i: int, setup: Setup, z: Rigid, scale: float) -> Rigid:
    """Returns X of a camera that cannot be solved alone, from the board's pose according to the other cameras."""
    loop = Loop.of(given.pairs(i), setup)
    scaled_poses = Poses(loop.camera_from_board.rotation, scale * loop.camera_from_board.translation)
    return closed_form.mean_pose(loop.stand_from_mount.inverse() @ z @ scaled_poses.inverse())


def _rig(
    given: RigPoses, setup: Setup, options: RigOptions, solution: Adjusted, first_notes: dict[int, tuple[str, ...]]
) -> Rig:
    state, c, covariance = solution.state, len(given.cameras), solution.whole_covariance()
    loops = [Loop.of(given.pairs(i), setup) for i in range(c)]
    rows = np.unique(np.concatenate([camera.rows for camera in given.cameras]))
    flange = given.base_from_flange[rows[~solution.outliers[rows]]]
    observability = Observability.of(
        Loop(flange.inverse() if setup == "eye-to-hand" else flange, flange, setup == "eye-to-hand")
    )
    best_camera = int(np.argmax([used.sum() for used in solution.used]))
    largest = loops[best_camera][solution.used[best_camera]]
    if solution.sigma_scale is not None:
        require_scale(state.scale, solution.sigma_scale, largest, given.where)
    cameras = []
    for i, (camera, loop, used) in enumerate(zip(given.cameras, loops, solution.used, strict=True)):
        x, z, place = state.mount_from_camera[i], state.stand_from_board, slice(6 * i, 6 * i + 6)
        camera_from_board = resected(camera.images, camera.views, solution.found[i])
        residuals = replace(loop, camera_from_board=camera_from_board).residuals(x, z)
        sigma_of_camera = {kind(n): v for n, v in solution.sigma.items() if n.partition(":")[2] in ("", camera.name)}
        with_robot_pose = ~solution.outliers[camera.rows]
        used_images = tuple(name for name, use in zip(camera.images, used, strict=True) if use)
        notes = first_notes.get(i, ())
        notes += remarks.of_outliers(
            tuple(name for name, use in zip(camera.images, with_robot_pose, strict=True) if use),
            ~used[with_robot_pose],
            residuals[with_robot_pose],
            np.zeros(int(with_robot_pose.sum()), bool),
        )
        notes += remarks.of_groups(used_images, residuals[used]) + remarks.of_distance(loop)
        notes += of_camera_file(float(solution.camera_gain[i]), sigma_of_camera)
        cameras.append(
            HandEye(
                method="reprojection",
                setup=setup,
                mount_from_camera=x,
                stand_from_board=z,
                residuals=residuals,
                names=camera.images,
                outliers=~used,
                covariance=covariance[place, place],
                stand_covariance=covariance[6 * c :, 6 * c :],
                scale=state.scale,
                sigma_scale=solution.sigma_scale,
                sigma=sigma_of_camera,
                estimated=tuple(dict.fromkeys(kind(n) for n in solution.estimated if kind(n) in sigma_of_camera)),
                reprojection=solution.found[i],
                observability=observability,
                notes=notes,
            )
        )
    notes = tuple(
        Aside(f"{name}: contradicts the other poses of the robot, and was left out")
        for name, bad in zip(given.names, solution.outliers, strict=True)
        if bad
    )
    if not options.with_scale:
        notes += remarks.of_size(largest, solution.scale_hint, options.noise)
    notes += remarks.of_rounds(solution.settled)
    names = tuple(camera.name for camera in given.cameras)
    return Rig(names, tuple(cameras), covariance, given.names, solution.outliers, notes)


def alone_or_none(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> HandEye | None:
    """Returns :func:`alone`, or None if the camera cannot be solved alone."""
    try:
        return alone(given, i, setup, options)
    except StcalError:
        return None


ERRORS = ("rotation_rad", "translation_mm", "board_mm", "pose_mm")


@dataclass(frozen=True, slots=True, eq=False)
class CameraHeldOut:
    """Errors of one camera on n views from held-out poses of the robot.

    ``split``, ``view`` : (n,) number of the split, and of the camera's view; ``joint``, ``alone`` : errors of
    :class:`~stcal.handeye.HeldOutPoses` by name: from all cameras solved together, and from this camera alone with the
    same poses of the robot. NaN if the camera cannot be solved alone.
    """

    split: np.ndarray
    view: np.ndarray
    joint: dict[str, np.ndarray]
    alone: dict[str, np.ndarray]

    def means(self, by: str = "joint") -> dict[str, float]:
        """Returns mean errors over the views for which both ``joint`` and ``alone`` are known.

        If ``alone`` is known for no view, the means of ``joint`` cover all views and those of ``alone`` are empty.
        """
        both = np.isfinite(self.alone["board_mm"])
        rows = both if both.any() or by == "alone" else np.ones(len(both), bool)
        if not rows.any():
            return {}
        return {name: float(values[rows].mean()) for name, values in getattr(self, by).items()}

    def gain(self) -> float | None:
        """Returns the relative reduction of the 3-D error at the board against the camera alone, or None if unknown."""
        by_itself = self.means("alone")
        return 1 - self.means()["board_mm"] / by_itself["board_mm"] if by_itself else None

    def poses(self) -> HeldOutPoses | None:
        """Returns the joint errors with equally many views in every split, or None if a split has no view."""
        splits = np.unique(self.split)
        rows_of_split = [np.flatnonzero(self.split == k) for k in splits]
        fewest = min(map(len, rows_of_split), default=0)
        if not fewest:
            return None
        rows = np.array([views[:fewest] for views in rows_of_split])
        return HeldOutPoses(self.view[rows], **{name: values[rows] for name, values in self.joint.items()})


@dataclass(frozen=True, slots=True, eq=False)
class RigHeldOut:
    """Errors of a rig on held-out poses of the robot.

    ``rows`` : (s, k) poses of the robot held out in each split; ``cameras`` : errors of each camera;
    ``mount_from_camera`` : (s, c, 4, 4) solutions from the other poses of each split, mm.
    """

    rows: np.ndarray
    cameras: tuple[CameraHeldOut, ...]
    mount_from_camera: np.ndarray

    def __post_init__(self):
        freeze(self, "rows", (None, None), "held-out poses", int)
        shape = len(self.rows), len(self.cameras), 4, 4
        freeze(self, "mount_from_camera", shape, "solutions")


@one_thread()
def cross_validate_rig(
    given: RigPoses,
    setup: Setup,
    options: RigOptions,
    rows: np.ndarray,
    workers: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> RigHeldOut:
    """Solves without some of the robot's poses, all cameras together and each alone, and predicts these poses.

    Parameters
    ----------
    given, setup, options : see :func:`~stcal.handeye.handeye_rig`
    rows : (s, k) poses of the robot to hold out, from :func:`~stcal.handeye.splits`
    workers : number of processes; as many as cores if None
    progress : called with the number of splits done, and the number of all splits

    Returns
    -------
    RigHeldOut

    Raises
    ------
    StcalError
        A split cannot be solved; see :func:`~stcal.handeye.handeye_rig`.
    """
    jobs = [(given, setup, options, out) for out in rows]
    results = run_in_order(_errors_without, jobs, workers, progress)
    cameras = []
    for i in range(len(given.cameras)):
        parts = [errors[i] for errors, _ in results]
        split = np.repeat(np.arange(len(parts)), [len(camera_errors["view"]) for camera_errors in parts])
        joint, by_itself = (
            {name: np.concatenate([camera_errors[by][name] for camera_errors in parts]) for name in ERRORS}
            for by in ("joint", "alone")
        )
        cameras.append(
            CameraHeldOut(split, np.concatenate([camera_errors["view"] for camera_errors in parts]), joint, by_itself)
        )
    return RigHeldOut(rows, tuple(cameras), np.array([x for _, x in results]))


def _errors_without(
    given: RigPoses, setup: Setup, options: RigOptions, out: np.ndarray
) -> tuple[list[dict], np.ndarray]:
    """Solves without the poses ``out``. Returns each camera's views of these and their errors, and all X, (c, 4, 4)."""
    training = given.only(np.setdiff1d(np.arange(len(given)), out))
    try:
        rig = handeye_rig(training, setup, options)
    except DegenerateError as error:
        raise DegenerateError(error.code, f"without {', '.join(given.names[i] for i in out)}: {error}") from error
    errors_of_cameras = []
    for i, camera in enumerate(given.cameras):
        held = np.flatnonzero(np.isin(camera.rows, out))
        unknown = dict.fromkeys(ERRORS, np.full(len(held), np.nan))
        camera_errors = {"view": held, "joint": unknown, "alone": unknown}
        if len(held):
            pairs, views = given.pairs(i)[held], camera.views[held]
            camera_errors["joint"] = predicted(rig.cameras[i], pairs, views)
            with suppress(
                StcalError
            ):  # with too few of its images left, the camera is solved by means of the others only
                camera_errors["alone"] = predicted(alone(training, i, setup, options), pairs, views)
        errors_of_cameras.append(camera_errors)
    return errors_of_cameras, np.array([each.mount_from_camera.matrix() for each in rig.cameras])


def rig_scatter(rig: Rig, held_out: RigHeldOut) -> float:
    """Returns the scatter of solutions without some of the robot's poses, relative to what σ predict.

    It is :func:`~stcal.handeye.validate.scatter` of all cameras at once.
    """
    images, size = sum(len(camera.names) for camera in rig.cameras), POSE * len(rig.names)
    found = [camera.mount_from_camera for camera in rig.cameras]
    out = held_out.rows.shape[1] / len(rig.poses)
    covariance = rig.covariance[:size, :size]
    return scatter_of(found, held_out.mount_from_camera, covariance, images, out, len(rig.covariance))


def widened_by_scatter(rig: Rig, held_out: RigHeldOut) -> tuple[Rig, float]:
    """Returns the rig with σ widened by the :func:`rig_scatter`, with a note if that is large, and the factor."""
    factor = rig_scatter(rig, held_out)
    if not factor > 1:
        return rig, 1.0
    return replace(rig.widened(factor), notes=(*rig.notes, *scatter_notes(factor, "all"))), factor
