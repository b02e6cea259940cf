"""One call for a rig: X of every camera, Z, and what is doubtful."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from stcal.errors import DegenerateError, StcalError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import Loop, Setup
from stcal.handeye.data.rig import RigPoses
from stcal.handeye.data.views import Views
from stcal.handeye.judge import remarks
from stcal.handeye.judge.conventions import check_conventions
from stcal.handeye.judge.notes import Aside, Grave
from stcal.handeye.judge.observability import LEAST_POSES, Observability, check, require_scale
from stcal.handeye.judge.symmetry import repair, turned_view
from stcal.handeye.methods import start
from stcal.handeye.methods.noise import Noise
from stcal.handeye.methods.reprojection import GROSS_RAD, GROSS_SHARE, resected
from stcal.handeye.methods.rig import AdjustedRig, adjust_rig
from stcal.handeye.methods.rounds import kind
from stcal.handeye.result import HandEye
from stcal.handeye.rig.result import Rig
from stcal.handeye.solve import HandEyeOptions, handeye, of_camera_file
from stcal.parallel import one_thread

BY_CHANCE = 1e-5
"""Odds at which two good cameras are said to see two boards."""


@dataclass(frozen=True, slots=True, eq=False)
class RigOptions:
    """What is known, and what is to be solved for.

    Parameters
    ----------
    noise : Noise
        What is known of the errors of robot, corners and board; the rest is estimated, σ of corners of each camera by
        itself. σ of the board's poses play no part.
    refine : bool
        Solve for the intrinsics too, of each camera from what is known of them (its ``prior``). Where not, their
        errors become part of σ.
    with_scale : bool
        Solve for the board's true size too.
    symmetries : tuple of Rigid
        All board_from_board after which the board looks the same, but for the identity.
    """

    noise: Noise = field(default_factory=Noise)
    refine: bool = False
    with_scale: bool = False
    symmetries: tuple[Rigid, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _First:
    """Of one camera by itself: ``x``, ``z``, ``scale``; ``views`` with their numbering put right; ``notes``."""

    x: Rigid
    z: Rigid
    scale: float
    views: Views
    notes: tuple[str, ...]


@one_thread()
def handeye_rig(given: RigPoses, setup: Setup = "eye-in-hand", options: RigOptions | None = None) -> Rig:
    """Where several cameras sit on one flange, or in one base, from one adjustment of all their corners.

    The images of one pose of the robot share its error, and all cameras the board and its place: a camera gains from
    what the others see, and the cameras' poses in each other are known better than two calibrations would tell. A
    camera of which too few images are there to find it by itself is found by means of the others.

    Parameters
    ----------
    given : RigPoses
        Poses of the robot, and what each camera saw from them.
    setup : {"eye-in-hand", "eye-to-hand"}
        ``eye-in-hand``: cameras on the flange, board in the base; ``eye-to-hand``: cameras in the base, board on the
        flange.
    options : RigOptions, optional
        The defaults where None.

    Returns
    -------
    Rig

    Raises
    ------
    InputError
        Poses of a camera that contradict each other, or fit in another convention; the message names the camera.
    DegenerateError
        No camera can be found by itself, or cameras that see the board at different places; the message names them.
    ConvergenceError
        No minimum is reached.

    Examples
    --------
    >>> rig = handeye_rig(given, "eye-in-hand")  # doctest: +SKIP
    >>> left_from_right, covariance = rig.relative("left", "right")  # doctest: +SKIP
    """
    options = options or RigOptions()
    firsts = [_first(given, i, setup, options) for i in range(len(given.cameras))]
    known = [first for first in firsts if isinstance(first, _First)]
    if not known:
        raise next(first for first in firsts if isinstance(first, DegenerateError))
    given, known = _same_numbering(given, firsts, options.symmetries)
    z, scale = start.mean_pose(Poses.of([first.z for first in known.values()])), 1.0
    if options.with_scale:
        scale = float(np.median([first.scale for first in known.values()]))
    _require_one_board(given, known)
    x = [known[i].x if i in known else _by_board(given, i, setup, z, scale) for i in range(len(given.cameras))]
    solution = adjust_rig(given, setup, (x, z, scale), options.noise, options.refine, options.with_scale)
    return _rig(given, setup, options, solution, {i: first.notes for i, first in known.items()})


def same_numbering(given: RigPoses, setup: Setup, symmetries: tuple[Rigid, ...]) -> RigPoses:
    """With views of a symmetric board that were numbered from another end put right, as :func:`handeye_rig` does.

    Raises
    ------
    StcalError
        As there.
    """
    if not symmetries:
        return given
    options = RigOptions(symmetries=symmetries)
    firsts = [_first(given, i, setup, options) for i in range(len(given.cameras))]
    return _same_numbering(given, firsts, symmetries)[0]


def alone(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> HandEye:
    """One camera of a rig by itself, as :func:`~stcal.handeye.handeye` finds it by method ``reprojection``.

    Raises
    ------
    StcalError
        As there.
    """
    camera = given.cameras[i]
    prior, one = camera.prior, options
    intrinsics = prior if options.refine else None
    own = HandEyeOptions(one.noise, intrinsics, one.with_scale, one.symmetries, camera=prior)
    return handeye(given.pairs(i), setup, "reprojection", camera.views, own)


def of_places(names: tuple[str, ...], found: list[HandEye | None]) -> tuple[str, ...]:
    """Notes on cameras of which the board, as each finds it by itself, stands where others do not find it."""
    apart = {}
    for i, one in enumerate(found):
        for j, other in enumerate(found[:i]):
            if one is None or other is None or one.stand_covariance is None or other.stand_covariance is None:
                continue
            off = Poses.of([one.stand_from_board]).difference(Poses.of([other.stand_from_board]))[0]
            squared = float(off @ np.linalg.solve(one.stand_covariance + other.stand_covariance, off))
            apart[j, i] = squared > chi2.ppf(1 - BY_CHANCE, len(off)), off
    notes = []
    for names_of, against, off in _named({pair: far for pair, (far, _) in apart.items()}, len(names), apart):
        many = len(names_of) > 1
        who, whom = ", ".join(names[k] for k in names_of), ", ".join(names[k] for k in against)
        where = f"{np.linalg.norm(off[3:]):.2g} mm and {np.degrees(np.linalg.norm(off[:3])):.2g}°"
        said = f"{who} and {whom} find the board {where} apart" if many or len(names) < 3 else ""
        said = said or f"{who} finds the board {where} from where {whom} do{'es' * (len(against) == 1)}"
        whose = "both" if not many and len(names) < 3 else who
        notes.append(Grave(f"{said}, more than σ allow: check images, intrinsics and board of {whose}"))
    return tuple(notes)


def _named(apart: dict[tuple[int, int], bool], count: int, off: dict) -> list[tuple[list[int], list[int], np.ndarray]]:
    """Which cameras contradict which, as few as explain it: those that contradict most of the others first."""
    left, named = {pair for pair, far in apart.items() if far}, []
    while left:
        hits = [sum(k in pair for pair in left) for k in range(count)]
        k = int(np.argmax(hits))
        own = sorted(pair for pair in left if k in pair)
        others = [pair[0] if pair[1] == k else pair[1] for pair in own]
        named.append(([k], others, off[own[0]][1]))
        left -= set(own)
    return named


def _first(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> "_First | DegenerateError":
    """Of one camera by itself; why it has none, where its images are too few or turn too little."""
    camera, pairs = given.cameras[i], given.pairs(i)
    if len(camera) < LEAST_POSES:
        return DegenerateError(
            "E-HANDEYE-FEW-POSES", f"{pairs.where}: {len(camera)} images, {LEAST_POSES} needed; take more"
        )
    views, notes = camera.views, ()
    try:
        check(Loop.of(pairs, setup), setup, pairs.where, False)
        if options.symmetries:
            mended = repair(pairs, setup, options.symmetries, views)
            pairs, views, notes = mended.pairs, mended.views or views, mended.notes()
    except DegenerateError as error:
        return error
    loop = Loop.of(pairs, setup)
    x, z, scale = start.robust(loop, options.with_scale)
    notes += check_conventions(pairs, loop, setup, start.robust, options.with_scale, True)
    return _First(x, z, scale, views, notes)


def _same_numbering(given: RigPoses, firsts: list, symmetries: tuple[Rigid, ...]) -> tuple[RigPoses, dict[int, _First]]:
    """Corners of a symmetric board numbered alike by all cameras, as the first one that stands for itself does."""
    known, cameras = {}, list(given.cameras)
    for i, first in enumerate(firsts):
        if not isinstance(first, _First):
            continue
        reference = next(iter(known.values()), first).z
        turns = (Rigid(), *symmetries)
        miss = [
            Rigid(reference.rotation.T @ (first.z @ turn).rotation).angle_rad()
            + float(np.linalg.norm((first.z @ turn).translation - reference.translation)) / 1e3
            for turn in turns
        ]
        turn = turns[int(np.argmin(miss))]
        views = Views(first.views.camera, tuple(turned_view(view, turn) for view in first.views.views))
        notes = first.notes
        if turn is not turns[0]:
            notes += (Aside("all its views were numbered from another end of the board than those of the others"),)
        known[i] = replace(first, z=first.z @ turn, views=views, notes=notes)
        cameras[i] = replace(cameras[i], views=views)
    return replace(given, cameras=tuple(cameras)), known


def _require_one_board(given: RigPoses, known: dict[int, _First]) -> None:
    """Refuse cameras that see boards at different places, far beyond what noise makes."""
    reach = {i: float(np.median(np.linalg.norm(given.pairs(i).camera_from_board.translation, axis=1))) for i in known}
    apart = {}
    for i, one in known.items():
        for j, other in known.items():
            if j < i:
                off = Poses.of([one.z]).difference(Poses.of([other.z]))[0]
                far = np.linalg.norm(off[3:]) > GROSS_SHARE * max(reach[i], reach[j])
                apart[j, i] = bool(far or np.linalg.norm(off[:3]) > GROSS_RAD), off
    named = _named({pair: far for pair, (far, _) in apart.items()}, len(given.cameras), apart)
    if not named:
        return
    (odd, *_), others, off = named[0]
    name, whom = given.cameras[odd].name, ", ".join(given.cameras[k].name for k in others)
    away = f"{np.linalg.norm(off[3:]):.3g} mm and {np.degrees(np.linalg.norm(off[:3])):.3g}°"
    pair = f"{name} and {whom} see it {away} apart" if len(known) < 3 else f"{name} sees it {away} from {whom}"
    one = "both" if len(known) < 3 else name
    raise DegenerateError(
        "E-RIG-CONTRADICTS",
        f"{given.where}: one board in one place needed, but {pair}; check images, intrinsics, board and poses of "
        f"{one}, or leave one camera out",
    )


def _by_board(given: RigPoses, i: int, setup: Setup, z: Rigid, scale: float) -> Rigid:
    """X of a camera that its own images do not tell, from where the others see the board."""
    loop = Loop.of(given.pairs(i), setup)
    seen = Poses(loop.camera_from_board.rotation, scale * loop.camera_from_board.translation)
    return start.mean_pose(loop.stand_from_mount.inverse() @ z @ seen.inverse())


def _rig(
    given: RigPoses, setup: Setup, options: RigOptions, solution: AdjustedRig, first_notes: dict[int, tuple[str, ...]]
) -> Rig:
    state, c = solution.state, len(given.cameras)
    loops = [Loop.of(given.pairs(i), setup) for i in range(c)]
    rows = np.unique(np.concatenate([camera.rows for camera in given.cameras]))
    flange = given.base_from_flange[rows[~solution.outliers[rows]]]
    seen = Observability.of(
        Loop(flange.inverse() if setup == "eye-to-hand" else flange, flange, setup == "eye-to-hand")
    )
    most = int(np.argmax([used.sum() for used in solution.used]))
    largest = loops[most][solution.used[most]]
    if solution.sigma_scale is not None:
        require_scale(state.scale, solution.sigma_scale, largest, given.where)
    cameras = []
    for i, (camera, loop, used) in enumerate(zip(given.cameras, loops, solution.used, strict=True)):
        x, z, place = state.mount_from_camera[i], state.stand_from_board, slice(6 * i, 6 * i + 6)
        at = resected(camera.images, camera.views, solution.found[i])
        residuals = replace(loop, camera_from_board=at).residuals(x, z)
        own = {kind(n): v for n, v in solution.sigma.items() if n.partition(":")[2] in ("", camera.name)}
        whole = ~solution.outliers[camera.rows]
        kept = tuple(name for name, use in zip(camera.images, used, strict=True) if use)
        notes = first_notes.get(i, ())
        notes += remarks.of_outliers(
            tuple(name for name, use in zip(camera.images, whole, strict=True) if use), ~used[whole], residuals[whole]
        )
        notes += remarks.of_groups(kept, residuals[used]) + remarks.of_distance(loop)
        notes += of_camera_file(float(solution.camera_gain[i]), own)
        cameras.append(
            HandEye(
                method="reprojection",
                setup=setup,
                mount_from_camera=x,
                stand_from_board=z,
                residuals=residuals,
                names=camera.images,
                outliers=~used,
                covariance=solution.covariance[place, place],
                stand_covariance=solution.covariance[6 * c :, 6 * c :],
                scale=state.scale,
                sigma_scale=solution.sigma_scale,
                sigma=own,
                estimated=tuple(dict.fromkeys(kind(n) for n in solution.estimated if kind(n) in own)),
                reprojection=solution.found[i],
                observability=seen,
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
    return Rig(names, tuple(cameras), solution.covariance, given.names, solution.outliers, notes)


def alone_or_none(given: RigPoses, i: int, setup: Setup, options: RigOptions) -> HandEye | None:
    """As :func:`alone`; None where one camera by itself cannot be found."""
    try:
        return alone(given, i, setup, options)
    except StcalError:
        return None
