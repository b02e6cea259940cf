"""Mistakes that poses show by themselves: conventions that are easily mixed up, and views of a board with two answers.

A side may be inverted or mirrored, quaternions may be in another order, metres may be called millimetres, or rows may
belong to other poses. A symmetric board may be numbered from another end, and a flat one seem tilted the other way.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.least_squares import PoseStack
from stcal.geometry.plane import mirrored
from stcal.geometry.rigid import Poses, Rigid, other_axes, skew
from stcal.handeye.data.pairs import HandEyePoses, Loop, Setup
from stcal.handeye.data.record import FRAMES
from stcal.handeye.data.views import Views
from stcal.handeye.judge.remarks import HALL_MM, Aside, Grave, of_still, spoken
from stcal.handeye.methods import closed_form
from stcal.handeye.methods.closed_form import mean_pose
from stcal.io.poses.rotations import INVERTED as CONJUGATED
from stcal.io.poses.rotations import LAST, ORDERS, ROTATION_VECTOR

FAR_BETTER, BETTER = 30.0, 3.0
"""Factors by which a variant must reduce the product of the median residuals in rotation and translation, and the
median residual in translation, before the poses are refused."""
DOUBTFUL = 1.5
"""Factor by which the other setup must reduce the same product before a note says that it fits better."""
INVERTED = "with one side inverted"
WELL = np.radians(0.5), 5.0
"""Median residuals (rad, mm) up to which poses are not suspected."""
LOST = 0.25
"""Share of the spread of the poses that the solution leaves unexplained, above which the poses of robot and camera have
nothing in common."""
NAMED = "rename them in the file, or give --poses-are where the file does not name them"
NAMED_ORDER = "name the columns so; for a file without names of columns give --rotation {side}={order}"
RADIANS_AS_DEGREES = np.radians(11.0)
"""Largest rotation between two poses whose three angles, up to π each, were taken for degrees: 2 · √3 · 3.14°."""
MIRROR = np.diag([1.0, -1.0, 1.0])
Guess = Callable[[Loop, bool], tuple[Rigid, Rigid, float]]


def check_conventions(
    pairs: HandEyePoses, loop: Loop, setup: Setup, guess: Guess, with_scale: bool, by_images: bool
) -> tuple[str, ...]:
    """Refuse poses that fit far better in another convention, or in none; return notes on what the fit cannot decide.
    With both sides inverted, X and Z change places, and only a board behind the camera shows it.

    ``guess`` : returns X, Z and scale of a loop; ``by_images`` : the board's poses come from images, so that only the
    robot's can be named wrongly. Raises InputError: the message says what is mixed up, and the remedy.
    """
    as_read, notes = _typical(loop, guess, with_scale), ()
    if as_read[0] > WELL[0] or as_read[1] > WELL[1]:
        size = f"{np.degrees(as_read[0]):.3g}° and {as_read[1]:.3g} mm (median)"
        contradict = f"{pairs.where}: the poses contradict each other by {size}"
        for still in of_still(pairs):
            if isinstance(still, Grave):
                raise InputError("E-POSES-IDENTICAL", f"{contradict}, as {still}")
        variants = _variants(loop, setup, by_images)
        typical_of_variant = _typical_of(variants, guess, with_scale)
        gain, convention = _best(as_read, typical_of_variant)
        if convention is None:
            more = _other_angles(loop, by_images)
            more |= _other_places(loop, by_images) if as_read[0] <= WELL[0] else {}
            typical_of_variant |= _typical_of(more, guess, with_scale)
            convention = _best(as_read, typical_of_variant)[1]
        if convention is None and as_read[0] > WELL[0]:
            other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
            other_loop = Loop.of(pairs, other)
            both = {"": other_loop, **_variants(other_loop, other, by_images)}
            with_setup = {f"with --setup {other}{' and ' if k else ''}{k}": each for k, each in both.items()}
            typical_of_variant |= _typical_of(with_setup, guess, with_scale)
            convention = _best(as_read, typical_of_variant)[1]
        if convention is not None:
            turn, shift = typical_of_variant[convention]
            but = f"{contradict}, but by {np.degrees(turn):.2g}° and {shift:.2g} mm "
            raise InputError("E-HANDEYE-CONVENTION", f"{but}{_with_its_like(convention, typical_of_variant)}")
        if (row := _other_from(loop, guess, with_scale, as_read)) is not None:
            raise InputError(
                "E-HANDEYE-CONVENTION",
                f"{contradict}, but those before {pairs.names[row]}, and those from it on, fit by themselves: another "
                "tool (TCP) or base was set in the controller there, or camera or board were moved; solve them "
                "separately",
            )
        inverted = next(each for each in variants if each.startswith(INVERTED))
        if gain[inverted] > DOUBTFUL and as_read[1] > typical_of_variant[inverted][1]:
            turn, shift = typical_of_variant[inverted]
            than = f"by {np.degrees(turn):.2g}° and {shift:.2g} mm {inverted}"
            notes = (Grave(f"the poses contradict each other by {size}, but {than}"),)
        spread = _differ(loop)
        turn, shift = np.divide(_typical(loop, guess, True), spread)
        if max(turn, shift) > LOST:
            remedy = "pair each pose of the board with that of the flange at the same moment"
            if radians := _as_of_radians(loop, by_images):
                remedy = (
                    f"if the angles of {radians} are radians, name their columns _rad, or give a --rotation that "
                    f"ends in -rad; if not, {remedy}"
                )
            elif as_read[0] <= WELL[0]:
                remedy = (
                    "as rotations agree, rows and conventions of rotation are right: check units, signs and order of "
                    "the columns of positions"
                )
            else:
                remedy += (
                    f", and {'check the camera file' if by_images else 'look for another convention of rotations'}"
                )
            raise InputError(
                "E-HANDEYE-CONVENTION",
                f"{contradict}, where they spread over {np.degrees(spread[0]):.3g}° and {spread[1]:.3g} mm (RMS), as "
                f"if {'positions' if as_read[0] <= WELL[0] else 'poses'} of robot and camera did not belong together; "
                f"{remedy}",
            )
    behind = loop.camera_from_board.translation[:, 2] <= 0
    if behind.all():
        robot, camera = (" in place of ".join(names) for names in FRAMES.values())
        return (
            *notes,
            Grave(
                "the board lies behind the camera in all poses, as it does where both sides are inverted: turn both "
                f"round, {robot} and {camera}, or the reverse, by --poses-are or the names of columns; or, if the "
                "camera stood beside the robot, the camera's side alone, with --setup eye-to-hand; or the camera's "
                "axes are those of OpenGL, y up and z backwards: change the signs of y and z of the board in its frame"
            ),
        )
    if behind.any():
        return (*notes, f"the board lies behind the camera in {pairs.names[int(behind.argmax())]}: check its pose")
    return notes


LEAST_PART, PART_BETTER = 6, 10.0
"""Least number of poses that fit by themselves, and how much better than all together, in rotation and translation."""


def _other_from(loop: Loop, guess: Guess, with_scale: bool, as_read: tuple[float, float]) -> int | None:
    """Returns the row from which on poses fit by themselves, as those before it do; None if there is no such row."""

    def misfit(row: int) -> float:
        parts = [_typical_or_far(part, guess, with_scale, np.mean) for part in (loop[:row], loop[row:])]
        return float(np.max(np.divide(parts, as_read)))

    each = {row: misfit(row) for row in range(LEAST_PART, len(loop) - LEAST_PART + 1)}
    best = min(each, key=each.__getitem__, default=None)
    return best if best is not None and each[best] < 1 / PART_BETTER else None


def _typical_of(variants: dict[str, Loop], guess: Guess, with_scale: bool) -> dict[str, tuple[float, float]]:
    """Returns :func:`_typical_or_far` of each loop."""
    return {convention: _typical_or_far(variant, guess, with_scale) for convention, variant in variants.items()}


def _best(as_read: tuple[float, float], typical: dict[str, tuple[float, float]]) -> tuple[dict[str, float], str | None]:
    """Returns by how much each variant reduces the product of residuals; and the best, None if it is not far better."""
    gain = {
        convention: as_read[0] / max(turn, 1e-12) * as_read[1] / max(shift, 1e-12)
        for convention, (turn, shift) in typical.items()
    }
    # Readings that give the same residuals, but for rounding, are told by the first of them.
    best = max(gain, key=lambda each: float(f"{gain[each]:.3g}"))
    better = gain[best] > FAR_BETTER and as_read[1] > BETTER * typical[best][1]
    return gain, best if better else None


def _with_its_like(convention: str, typical: dict[str, tuple[float, float]]) -> str:
    """Returns the convention, and readings of angles with the same residuals: how they were read tells which it is."""
    start, angles, first = convention.partition(OTHER_ANGLES)
    if not angles:
        return convention
    residuals = np.array(typical[convention])
    like = [
        each.removeprefix(start + angles)
        for each, other in typical.items()
        if each.startswith(start + angles) and np.allclose(other, residuals, rtol=1e-3) and each != convention
    ]
    return start + angles + ", ".join([first, *like])


ANGLES = ("xyz", "ZYX", "XYZ", "zyx", "ZYZ", "rotvec")
"""Orders of axes, fixed (xyz …) or turned (ZYX …), whose angles are mixed up with one another or with rotation vectors,
by the names that --rotation has for them; the most frequent first."""
OTHER_ANGLES = " angles in another convention: "


def _other_angles(loop: Loop, by_images: bool) -> dict[str, Loop]:
    """Returns the loop with angles that were read in one sequence, and meant in another."""
    variants = {}
    for side, role in (("robot", "robot"),) if by_images else (("robot", "robot"), ("board", "camera")):
        for one, other in permutations(ANGLES, 2):
            key = f"with the {side}'s{OTHER_ANGLES}--rotation {role}={other}-deg (or -rad) if they were read as {one}"
            variants[key] = _with_stated(loop, side, _with_angles(_stated(loop, side), one, other))
    return variants


def _with_angles(poses: Poses, read: str, meant: str) -> Poses:
    """Returns poses whose angles were read in one sequence, or as rotation vectors, and meant in another."""
    rotation = Rotation.from_matrix(poses.rotation)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the gimbal lock: its angles give the same rotation
        angles = rotation.as_rotvec() if read == ROTATION_VECTOR else rotation.as_euler(read)
    turns = Rotation.from_rotvec(angles) if meant == ROTATION_VECTOR else Rotation.from_euler(meant, angles)
    return Poses(turns.as_matrix(), poses.translation)


def _other_places(loop: Loop, by_images: bool) -> dict[str, Loop]:
    """Returns the loop with other signs and another order of the coordinates of places, on either side."""
    variants = {}
    for side in ("robot",) if by_images else ("robot", "board"):
        read = _stated(loop, side)
        for names, places in other_axes(read.translation):
            key = f"with x, y, z of the {side} taken as {names}: correct order and signs of the columns of positions"
            variants[key] = _with_stated(loop, side, Poses(read.rotation, places))
    return variants


def _stated(loop: Loop, side: str) -> Poses:
    """Returns the poses of a side as their file states them."""
    poses = _of_side(loop, side)
    return poses.inverse() if side == "robot" and loop.inverted else poses


def _with_stated(loop: Loop, side: str, poses: Poses) -> Loop:
    """Returns the loop with other poses of a side, as a file would state them."""
    if side == "board":
        return replace(loop, camera_from_board=poses)
    return replace(loop, stand_from_mount=poses.inverse() if loop.inverted else poses)


def _variants(loop: Loop, setup: Setup, by_images: bool) -> dict[str, Loop]:
    """Returns the loop in each other convention; the key says which convention that is, and what to do. ``by_images`` :
    the board's poses were computed here from images."""
    kind = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    # A rotation by the mirror is absorbed by X and Z, so mirroring the robot is the same as mirroring the camera.
    mirrored = Poses(MIRROR @ eye.rotation @ MIRROR, eye.translation @ MIRROR)
    named = _inverted_names(eye, by_images)
    states = "the robot states" if by_images else "robot or camera states"
    remedy = "change the signs of its y, qx and qz" + (
        "; or images are mirrored: use them as taken" if by_images else ""
    )
    variants = {
        f"{INVERTED}: either these are {named}: {NAMED}; or all are named rightly: give --setup {kind}": (
            replace(loop, camera_from_board=eye.inverse())
        ),
        **_other_units(loop, by_images),
        f"with one side mirrored: if {states} left-handed poses, {remedy}": replace(loop, camera_from_board=mirrored),
    }
    for which, late, robot_rows, board_rows in (
        ("below", "robot's", slice(1, None), slice(-1)),
        ("above", "board's", slice(-1), slice(1, None)),
    ):
        variants[
            f"with each pose of the board beside that of the flange one row {which}: move the {late} poses up by one "
            "row, or the names of their images"
        ] = Loop(hand[robot_rows], eye[board_rows], loop.inverted)
    for reading in (*ORDERS, CONJUGATED):
        robot, board = (reading.poses(_stated(loop, side)) for side in ("robot", "board"))
        by_robot = _with_stated(loop, "robot", robot)
        kind = "conjugated" if reading.conjugated else "in another order"
        order = "xyzw" if reading is LAST else "wxyz"
        robot_side, camera_side = (
            f"quaternions {kind}: if {reading.held}, "
            + (reading.remedy if reading.conjugated else NAMED_ORDER.format(side=side, order=order))
            for side in ("robot", "camera")
        )
        both_sides = f"quaternions {kind}: if {reading.held}, {reading.remedy}"
        variants[f"with the robot's {both_sides if by_images else robot_side}"] = by_robot
        if not by_images:
            variants[f"with the board's {camera_side}"] = replace(loop, camera_from_board=board)
            variants[f"with all {both_sides}"] = replace(by_robot, camera_from_board=board)
    return variants


def _inverted_names(camera_from_board: Poses, by_images: bool) -> str:
    """Returns the names that the poses of the inverted side should have. As a board is in front of its camera, the side
    is known unless the poses have the board in front in both directions."""
    robot, camera = FRAMES["robot"][1], FRAMES["camera"][1]
    if by_images:
        return robot
    in_front = [bool((poses.translation[:, 2] > 0).all()) for poses in (camera_from_board, camera_from_board.inverse())]
    if in_front[0] != in_front[1]:
        return f"{robot} (the board is in front of the camera as read)" if in_front[0] else camera
    return f"{camera} or {robot}"


def _other_units(loop: Loop, by_images: bool) -> dict[str, Loop]:
    """Returns the loop with either side's lengths in the other unit, by what to do. Residuals show only the ratio of
    the units; lengths beyond :data:`HALL_MM` tell which side it is."""
    variants = {}
    for side, other in (("robot", "board"), ("board", "robot")):
        factor, which = 1000.0, side
        remedy = "if they are metres, name the columns x_m …, or give --length-unit m where none states a unit"
        if side == "board" and by_images:
            remedy = "if the size in its file is in metres, correct that"
        if np.median(np.linalg.norm(_of_side(loop, other).translation, axis=1)) > HALL_MM:
            factor, which = 1e-3, other
            role = "robot" if other == "robot" else "camera"
            remedy = (
                f"if they are mm, name the columns x_mm …, or give --length-unit {role}=mm where none states a unit"
            )
        poses = _of_side(loop, which)
        scaled = Poses(poses.rotation, factor * poses.translation)
        times = "times" if factor > 1 else "divided by"
        variants[f"with the {which}'s lengths {times} 1000: {remedy}"] = (
            replace(loop, stand_from_mount=scaled) if which == "robot" else replace(loop, camera_from_board=scaled)
        )
    return variants


def _as_of_radians(loop: Loop, by_images: bool) -> str:
    """Returns the sides whose rotations are as small as radians are that were taken for degrees, in words."""
    sides = ("robot",) if by_images else ("robot", "board")
    small = []
    for side in sides:
        rotation = _of_side(loop, side).rotation
        cosines = (np.trace(rotation @ rotation[0].T, axis1=1, axis2=2) - 1) / 2
        if np.arccos(np.clip(cosines, -1, 1)).max() < RADIANS_AS_DEGREES:
            small.append(f"the {side}")
    return " and ".join(small)


def _of_side(loop: Loop, side: str) -> Poses:
    return loop.stand_from_mount if side == "robot" else loop.camera_from_board


def _differ(loop: Loop) -> tuple[float, float]:
    """Returns the RMS deviation of poses from their mean: rad, and mm of flange or board, whichever moved more."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    turn = hand.rotation @ mean_pose(hand).rotation.T
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    shifts = [np.linalg.norm(poses.translation - poses.translation.mean(0), axis=1) for poses in (hand, eye)]
    return float(np.sqrt((angle**2).mean())), float(max(np.sqrt((shift**2).mean()) for shift in shifts))


def _typical(loop: Loop, guess: Guess, with_scale: bool, middle: Callable = np.median) -> tuple[float, float]:
    """Returns the median residuals of a first solution, or another ``middle``, rad and mm."""
    residuals = loop.residuals(*guess(loop, with_scale)).reshape(-1, 2, 3)
    turn, shift = middle(np.linalg.norm(residuals, axis=2), axis=0)
    return float(turn), float(shift)


def _typical_or_far(loop: Loop, guess: Guess, with_scale: bool, middle: Callable = np.median) -> tuple[float, float]:
    """Returns :func:`_typical`, infinite where the poses give no solution."""
    try:
        return _typical(loop, guess, with_scale, middle)
    except DegenerateError:
        return np.inf, np.inf


ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """``pairs`` : m, the board's poses as if all views had been numbered alike; ``views`` : the same, where given;
    ``turned`` : (m,) number, from 1, of the symmetry that each view was turned by; 0 where the view stayed."""

    pairs: HandEyePoses
    views: Views | None
    turned: np.ndarray

    def notes(self) -> tuple[str, ...]:
        """Returns a note that names the turned views."""
        names = [name for name, turn in zip(self.pairs.names, self.turned, strict=True) if turn]
        if not names:
            return ()
        return (Aside(f"numbered from another end of the board, and corrected: {', '.join(names)}"),)


def repair(pairs: HandEyePoses, setup: Setup, symmetries: tuple[Rigid, ...], views: Views | None = None) -> Repair:
    """Give all views the most common numbering of a symmetric board. Angle and advance of robot and camera between two
    poses agree whatever X is.

    ``symmetries`` : all board_from_board except the identity. Raises DegenerateError: fewer than three poses.
    """
    loop, every = Loop.of(pairs, setup), (Rigid(), *symmetries)
    as_numbered = loop.camera_from_board
    variants = [as_numbered @ turn for turn in every]
    best, least = np.zeros(len(loop), int), np.inf
    for labels in np.unique(_guesses(loop, variants), axis=0):
        labels, cost = _settled(loop, variants, labels)
        if cost < least:
            best, least = labels, cost
    # Label k of a view means C S_k. All views are turned by S_common⁻¹ from the right, so that most stay as they are.
    common_inverse = every[int(np.bincount(best).argmax())].inverse()
    best = np.array([_nearest(every[k] @ common_inverse, every) for k in best])
    poses = Poses.of(variants[k][i] for i, k in enumerate(best))
    covariance, common = pairs.camera_from_board_covariance, pairs.camera_from_board_common
    carried = _carried(as_numbered, poses)
    repaired = replace(
        pairs,
        camera_from_board=poses,
        camera_from_board_covariance=None if covariance is None else carried @ covariance @ np.swapaxes(carried, 1, 2),
        camera_from_board_common=None if common is None else carried @ common,
    )
    if views is not None:
        turned = (view.turned(every[k].inverse()) for view, k in zip(views.views, best, strict=True))
        views = Views(views.camera, tuple(turned))
    return Repair(repaired, views, best)


def _guesses(loop: Loop, variants: list[Poses]) -> np.ndarray:
    """Returns labels (m, m): with each pose as reference, the numberings that agree best with the robot's motion."""
    hand, m = loop.stand_from_mount, len(loop)
    labels = np.zeros((m, m), int)
    for reference in range(m):
        by_robot = _invariants(hand.inverse() @ hand[reference])
        misfits = []
        for variant in variants:
            by_camera = _invariants(variant @ variants[0][reference].inverse())
            # Angles are multiplied by the distance of the board, so that both terms are in mm.
            reach = np.linalg.norm(variant.translation, axis=1)
            misfits.append(np.hypot((by_robot - by_camera)[:, 0] * reach, (by_robot - by_camera)[:, 1]))
        labels[reference] = np.argmin(misfits, axis=0)
        labels[reference, reference] = 0
    return labels


def _invariants(motions: Poses) -> np.ndarray:
    """Returns angle (rad) and advance along the axis (mm) of motions, (m, 2), equal for A and B where AX = XB."""
    log = Rotation.from_matrix(np.array(motions.rotation)).as_rotvec()
    angle = np.linalg.norm(log, axis=1)
    axis = log / np.maximum(angle, 1e-12)[:, None]
    advance = np.abs((axis * motions.translation).sum(1))
    return np.column_stack([angle, np.where(angle > 1e-3, advance, np.linalg.norm(motions.translation, axis=1))])


def _settled(loop: Loop, variants: list[Poses], labels: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns labels that fit the solution they lead to, and the sum of their residuals, mm."""
    for _ in range(ROUNDS):
        chosen = replace(loop, camera_from_board=Poses.of(variants[k][i] for i, k in enumerate(labels)))
        x, z, _ = closed_form.robust(chosen)
        costs = []
        for variant in variants:
            misses = replace(loop, camera_from_board=variant).residuals(x, z).reshape(-1, 2, 3)
            turn, shift = np.linalg.norm(misses, axis=2).T
            costs.append(np.hypot(turn * np.linalg.norm(variant.translation, axis=1), shift))
        better = np.argmin(costs, axis=0)
        if (better == labels).all():
            break
        labels = better
    return labels, float(np.min(costs, axis=0).sum())


def _nearest(turn: Rigid, every: tuple[Rigid, ...]) -> int:
    angles = [Rigid(symmetry.rotation.T @ turn.rotation).angle_rad() for symmetry in every]
    return int(np.argmin(angles))


def _carried(seen: Poses, poses: Poses) -> np.ndarray:
    """Returns the derivative (m, 6, 6) of errors of camera_from_board when its origin moves on the board."""
    jacobian = np.tile(np.eye(6), (len(poses), 1, 1))
    jacobian[:, 3:, :3] = -skew(poses.translation - seen.translation)
    return jacobian


PUT_RIGHT = 0.2
"""Largest share of a pose's error of rotation that is left when it is tilted the other way. Of errors of any direction
0.2³, one in a hundred, seem to be flips."""


def tilted(poses: Poses) -> Poses:
    """Returns camera_from_board with the depths about the board's origin mirrored along the line of sight."""
    other = mirrored(PoseStack(np.asarray(poses.rotation), np.asarray(poses.translation)), Rigid())
    return Poses(other.rotation, np.asarray(poses.translation))


def flipped(loop: Loop, x: Rigid, z: Rigid, outliers: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the ``outliers`` that agree with the solution when they are tilted the other way."""
    other = replace(loop, camera_from_board=tilted(loop.camera_from_board))
    before, after = (np.linalg.norm(each.residuals(x, z)[:, :3], axis=1) for each in (loop, other))
    return outliers & (after < PUT_RIGHT * before)


def flip_note(names: tuple[str, ...], flips: np.ndarray) -> tuple[str, ...]:
    """Returns a note on the poses that are flipped, (m,)."""
    if not flips.any():
        return ()
    shown = ", ".join(spoken(name) for name, flip in zip(names, flips, strict=True) if flip)
    return (
        Aside(
            f"{flips.sum()} of the poses left out agree when tilted the other way, as the second pose of a flat target "
            f"is, which its image hardly excludes: {shown}; --undo-flips takes that one, or give images"
        ),
    )
