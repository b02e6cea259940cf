"""Mistakes that poses show by themselves: conventions that are mixed up, and views of a board with two answers."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.explain import Candidate, explain
from stcal.geometry.plane import mirrored
from stcal.geometry.rigid import Poses, Rigid, other_axes, skew
from stcal.handeye.data.corner_views import Views
from stcal.handeye.data.pose_pairs import OTHER, SIDES, HandEyePoses, Loop, LoopState, Setup, carried
from stcal.handeye.methods import closed_form
from stcal.handeye.methods.closed_form import mean_pose
from stcal.handeye.remarks import HALL_MM, Grave, Remarks
from stcal.io.rotations import INVERTED as CONJUGATED
from stcal.io.rotations import LAST, ORDERS, ROTATION_VECTOR

FAR_BETTER, BETTER = 30.0, 3.0
"""Factors by which a refused reading exceeds a variant in the product of both median residuals, and in translation."""
DOUBTFUL = 1.5  # factor by which the other setup must reduce the same product before a note says that it fits better
WELL = np.radians(0.5), 5.0  # median residuals (rad, mm) up to which poses are not suspected
LOST = 0.25
"""Share of the spread of the poses left unexplained, above which those of robot and camera have nothing in common."""
MIRROR = np.diag([1.0, -1.0, 1.0])
CALLED = (("robot", "robot"), ("board", "camera"))  # what messages and options call the two sides
Guess = Callable[[Loop, bool], LoopState]


def check_conventions(pairs: HandEyePoses, loop: Loop, guess: Guess, with_scale: bool, by_images: bool) -> Remarks:
    """Refuse poses that fit far better in another convention, or in none, with the remedy; return notes on what the fit
    cannot decide. With both sides inverted only a board behind the camera shows it. ``guess`` : returns X, Z and scale
    of a loop; ``by_images`` : the board's poses come from images, so that only the robot's can be wrong."""
    turn, shift = as_read = _typical(loop, guess, with_scale)
    notes: Remarks = ()
    if turn > WELL[0] or shift > WELL[1]:
        size = f"{np.degrees(turn):.3g}° and {shift:.3g} mm"
        contradict = f"{pairs.where}: the poses contradict each other by {size} (median)"

        def misfit(variant: Loop) -> float:
            again = _typical(variant, guess, with_scale)
            share = np.prod(np.maximum(again, 1e-12)) / np.prod(as_read)
            return float(f"{share:.3g}") if shift > BETTER * again[1] else np.inf  # equal but for rounding

        def apart(parts: tuple[Loop, Loop]) -> float:
            return float(np.max(np.divide([_typical(part, guess, with_scale, np.mean) for part in parts], as_read)))

        def errs(reading: Candidate) -> tuple[float, float, str]:
            less = _typical(reading.change(), guess, with_scale)
            return *less, f"but by {np.degrees(less[0]):.2g}° and {less[1]:.2g} mm"

        if best := explain(_readings(loop, by_images, turn <= WELL[0]), misfit, 1 / FAR_BETTER, ALIKE):
            words = "; or ".join(each.words for each, _ in best)
            raise InputError("E-HANDEYE-CONVENTION", f"{contradict}, {errs(best[0][0])[2]} {words}")
        rows = range(LEAST_PART, len(loop) - LEAST_PART + 1)
        halves = [Candidate(pairs.names[row], partial(lambda row: (loop[:row], loop[row:]), row)) for row in rows]
        if best := explain(halves, apart, 1 / PART_BETTER):
            first = best[0][0].words
            said = f"{contradict}, but those before {first}, and those from it on, fit by themselves: another tool "
            said += "(TCP) or base was set in the controller there, or camera or board were moved; solve them "
            said += "separately"
            raise InputError("E-HANDEYE-CONVENTION", said)
        inverted = _inverted(loop, by_images)
        with suppress(DegenerateError):
            *less, words = errs(inverted)
            if turn * shift > DOUBTFUL * less[0] * less[1] and shift > less[1]:
                notes = (Grave(f"the poses contradict each other by {size} (median), {words} {inverted.words}"),)
        spread = _differ(loop)
        if np.divide(_typical(loop, guess, True), spread).max() > LOST:
            remedy = "pair each pose of the board with that of the flange at the same moment"
            if turn <= WELL[0]:
                remedy = "as rotations agree, rows and conventions of rotation are right: check units, signs and "
                remedy += "order of the columns of positions"
            else:
                convention = "look for another convention of rotations, or radians where degrees were read"
                remedy += f"; {convention}{', and check the camera file' if by_images else ''}"
            what = "positions" if turn <= WELL[0] else "poses"
            said = f"{contradict}, where they spread over {np.degrees(spread[0]):.3g}° and {spread[1]:.3g} mm (RMS), "
            said += f"as if {what} of robot and camera did not belong together; {remedy}"
            raise InputError("E-HANDEYE-CONVENTION", said)
    behind = loop.camera_from_board.translation[:, 2] <= 0
    if behind.all():
        robot, camera = (" in place of ".join(names) for names in SIDES.values())
        said = "the board lies behind the camera in all poses, as it does where both sides are inverted: turn both "
        said += f"round, {robot} and {camera}, or the reverse, by --poses-are or the names of columns; or, if the "
        said += "camera stood beside the robot, the camera's side alone, with --setup eye-to-hand; or the camera's "
        said += "axes are those of OpenGL, y up and z backwards: change the signs of y and z of the board in its frame"
        return (*notes, Grave(said))
    if behind.any():
        return (*notes, f"the board lies behind the camera in {pairs.names[int(behind.argmax())]}: check its pose")
    return notes


LEAST_PART, PART_BETTER = 6, 10.0
"""Least number of poses that fit by themselves, and how much better than all together, in rotation and translation."""
ALIKE = 1.001  # ratio of misfits up to which two readings cannot be told apart: they give the same residuals
ANGLES = ("xyz", "ZYX", "XYZ", "zyx", "ZYZ", "rotvec")
"""Orders of axes, fixed (xyz …) or turned (ZYX …), whose angles are mixed up with one another or with rotation vectors,
by the names that --rotation has for them; the most frequent first."""


def _readings(loop: Loop, by_images: bool, turns_agree: bool) -> Iterator[Candidate]:
    """Yields the loop in each other convention: of one setup, of angles or places, of the other setup."""
    yield from _variants(loop, by_images)
    for side, role in CALLED[: 1 if by_images else 2]:
        for one, other in permutations(ANGLES, 2):
            words = f"with the {side}'s angles by --rotation {role}={other}-deg (or -rad), or by the names of its "
            words += f"columns, if they were read as {one}"
            yield Candidate(words, _changed(loop, partial(_with_angles, one, other), side), 1)
        read = loop.camera_from_board if side == "board" else loop.base_from_flange
        for names, places in other_axes(read.translation) if turns_agree else ():
            words = f"with x, y, z of the {side} taken as {names}: correct order and signs of the columns of positions"
            placed = partial(lambda places, poses: Poses(poses.rotation, places), places)
            yield Candidate(words, _changed(loop, placed, side), 1)
    if not turns_agree:
        other = replace(loop, setup=OTHER[loop.setup])
        words = f"with --setup {other.setup}"
        yield Candidate(words, lambda: other, 2)
        for each in _variants(other, by_images):
            yield Candidate(f"{words} and {each.words}", each.change, 2)


def _with_angles(read: str, meant: str, poses: Poses) -> Poses:
    """Returns poses whose angles were read in one sequence, or as rotation vectors, and meant in another."""
    rotation = Rotation.from_matrix(poses.rotation)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the gimbal lock: its angles give the same rotation
        angles = rotation.as_rotvec() if read == ROTATION_VECTOR else rotation.as_euler(read)
    turns = Rotation.from_rotvec(angles) if meant == ROTATION_VECTOR else Rotation.from_euler(meant, angles)
    return Poses(turns.as_matrix(), poses.translation)


def _changed(loop: Loop, change: Callable[[Poses], Poses], *sides: str) -> Callable[[], Loop]:
    """Returns a function that gives the loop with changed poses of sides, as a file would state them."""
    names = {"robot": "base_from_flange", "board": "camera_from_board"}

    def changed() -> Loop:
        poses: dict[str, Any] = {names[side]: change(getattr(loop, names[side])) for side in sides}
        return replace(loop, **poses)

    return changed


def _inverted(loop: Loop, by_images: bool) -> Candidate:
    """Returns the loop with one side inverted: that which puts the board in front of the camera, if only one does."""
    seen = loop.camera_from_board
    robot, camera = SIDES["robot"][1], SIDES["camera"][1]
    front, front_inverted = (bool((poses.translation[:, 2] > 0).all()) for poses in (seen, seen.inverse()))
    named = f"{camera} or {robot}"
    if by_images:
        named = robot
    elif front != front_inverted:
        named = f"{robot} (the board is in front of the camera as read)" if front else camera
    return Candidate(
        f"with one side inverted: either these are {named}: rename them in the file, or give --poses-are where the "
        f"file does not name them; or all are named rightly: give --setup {OTHER[loop.setup]}",
        _changed(loop, Poses.inverse, "board"),
    )


def _variants(loop: Loop, by_images: bool) -> Iterator[Candidate]:
    """Yields the loop with a side inverted, mirrored, in another unit, by another row, or with other quaternions."""
    hand, eye = loop.base_from_flange, loop.camera_from_board
    yield _inverted(loop, by_images)
    # Residuals show only the ratio of two units; lengths beyond a hall tell which side it is.
    for (side, _), (other, role) in (CALLED, CALLED[::-1]):
        factor, which, times = 1000.0, side, "times"
        remedy = "if they are metres, name the columns x_m …, or give --length-unit m where none states a unit"
        if side == "board" and by_images:
            remedy = "if the size in its file is in metres, correct that"
        if np.median(np.linalg.norm((eye if other == "board" else hand).translation, axis=1)) > HALL_MM:
            factor, which, times = 1e-3, other, "divided by"
            unit = f"{role}=mm"
            remedy = f"if they are mm, name the columns x_mm …, or give --length-unit {unit} where none states a unit"
        scaled = partial(lambda factor, poses: Poses(poses.rotation, factor * poses.translation), factor)
        yield Candidate(f"with the {which}'s lengths {times} 1000: {remedy}", _changed(loop, scaled, which))
    states = "the robot states" if by_images else "robot or camera states"
    remedy = "change the signs of its y, qx and qz" + "; or images are mirrored: use them as taken" * by_images
    # A rotation by the mirror is absorbed by X and Z, so mirroring the robot is the same as mirroring the camera.
    other_hand = _changed(loop, lambda seen: Poses(MIRROR @ seen.rotation @ MIRROR, seen.translation @ MIRROR), "board")
    yield Candidate(f"with one side mirrored: if {states} left-handed poses, {remedy}", other_hand)
    rows = slice(1, None), slice(-1)
    for which, late, (of_robot, of_board) in (("below", "robot's", rows), ("above", "board's", rows[::-1])):
        yield Candidate(
            f"with each pose of the board beside that of the flange one row {which}: move the {late} poses up by one "
            "row, or the names of their images",
            partial(Loop, hand[of_robot], eye[of_board], loop.setup),
        )
    for reading in (*ORDERS, CONJUGATED):
        quaternions = f"quaternions {'conjugated' if reading.conjugated else 'in another order'}: if {reading.held}"
        order = "xyzw" if reading is LAST else "wxyz"
        for side, role in CALLED[: 1 if by_images else 2]:
            remedy = f"name the columns so; for a file without names of columns give --rotation {role}={order}"
            remedy = reading.remedy if reading.conjugated or by_images else remedy
            yield Candidate(f"with the {side}'s {quaternions}, {remedy}", _changed(loop, reading.poses, side))
        if not by_images:
            both = _changed(loop, reading.poses, "robot", "board")
            yield Candidate(f"with all {quaternions}, {reading.remedy}", both)


def _differ(loop: Loop) -> tuple[float, float]:
    """Returns the RMS deviation of poses from their mean: rad, and mm of flange or board, whichever moved more."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    angle = Rotation.from_matrix(hand.rotation @ mean_pose(hand).rotation.T).magnitude()
    shifts = [np.linalg.norm(poses.translation - poses.translation.mean(0), axis=1) for poses in (hand, eye)]
    return float(np.sqrt((angle**2).mean())), float(max(np.sqrt((shift**2).mean()) for shift in shifts))


def _typical(loop: Loop, guess: Guess, with_scale: bool, middle: Callable = np.median) -> tuple[float, float]:
    """Returns the median residuals of a first solution, or another ``middle``, rad and mm."""
    turn, shift = middle(loop.misses(*guess(loop, with_scale)), axis=0)
    return float(turn), float(shift)


ROUNDS = 20


def repair(
    pairs: HandEyePoses, setup: Setup, symmetries: tuple[Rigid, ...], views: Views | None = None
) -> tuple[HandEyePoses, Views | None, np.ndarray]:
    """Give all views the most common numbering of a symmetric board. Angle and advance of robot and camera between two
    poses agree whatever X is. ``symmetries`` : all board_from_board except the identity. Returns poses and views as if
    all views had been numbered alike, and (m,) the number, from 1, of the symmetry that each view was turned by; 0
    where the view stayed. Raises DegenerateError: fewer than three poses."""
    loop, every = Loop.of(pairs, setup), (Rigid(), *symmetries)
    as_numbered = loop.camera_from_board
    variants = [as_numbered @ turn for turn in every]
    best, least = np.zeros(len(loop), int), np.inf
    for labels in np.unique(_guesses(loop, variants), axis=0):
        labels, cost = _settled(loop, variants, labels)
        if cost < least:
            best, least = labels, cost
    # Label k of a view means C S_k. All views are turned by S_common⁻¹ from the right, so that most stay as they are.
    turns = np.array([turn.rotation for turn in every])
    left = turns[best] @ turns[np.bincount(best).argmax()].T
    best = np.einsum("kab,mab->mk", turns, left).argmax(1)  # the nearest of the symmetries
    poses = Poses.of(variants[k][i] for i, k in enumerate(best))
    # The origin moves on the board, and with it errors of rotation move it in the camera.
    jacobian = np.tile(np.eye(6), (len(poses), 1, 1))
    jacobian[:, 3:, :3] = -skew(poses.translation - as_numbered.translation)
    errors = carried(jacobian, pairs.camera_from_board_covariance, pairs.camera_from_board_common)
    names = ("camera_from_board", "camera_from_board_covariance", "camera_from_board_common")
    changed: dict[str, Any] = dict(zip(names, (poses, *errors), strict=True))
    repaired = replace(pairs, **changed)
    if views is not None:
        turned = (view.turned(every[k].inverse()) for view, k in zip(views.views, best, strict=True))
        views = Views(views.camera, tuple(turned))
    return repaired, views, best


def _guesses(loop: Loop, variants: list[Poses]) -> np.ndarray:
    """Returns labels (m, m): with each pose as reference, the numberings that agree best with the robot's motion."""
    hand, m = loop.stand_from_mount, len(loop)
    labels = np.zeros((m, m), int)
    for reference in range(m):
        by_robot, misfits = _invariants(hand.inverse() @ hand[reference]), []
        for variant in variants:
            off = by_robot - _invariants(variant @ variants[0][reference].inverse())
            # Angles are multiplied by the distance of the board, so that both terms are in mm.
            misfits.append(np.hypot(off[:, 0] * np.linalg.norm(variant.translation, axis=1), off[:, 1]))
        labels[reference] = np.argmin(misfits, axis=0)
        labels[reference, reference] = 0
    return labels


def _invariants(motions: Poses) -> np.ndarray:
    """Returns angle (rad) and advance along the axis (mm) of motions, (m, 2), equal for A and B where AX = XB."""
    log = Rotation.from_matrix(np.array(motions.rotation)).as_rotvec()
    angle = np.linalg.norm(log, axis=1)
    advance = np.abs((log / np.maximum(angle, 1e-12)[:, None] * motions.translation).sum(1))
    return np.column_stack([angle, np.where(angle > 1e-3, advance, np.linalg.norm(motions.translation, axis=1))])


def _settled(loop: Loop, variants: list[Poses], labels: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns labels that fit the solution they lead to, and the sum of their residuals, mm."""
    for _ in range(ROUNDS):
        chosen = replace(loop, camera_from_board=Poses.of(variants[k][i] for i, k in enumerate(labels)))
        x, z, _ = closed_form.robust(chosen)
        costs = []
        for variant in variants:
            turn, shift = replace(loop, camera_from_board=variant).misses(x, z).T
            costs.append(np.hypot(turn * np.linalg.norm(variant.translation, axis=1), shift))
        better = np.argmin(costs, axis=0)
        if (better == labels).all():
            break
        labels = better
    return labels, float(np.min(costs, axis=0).sum())


PUT_RIGHT = 0.2
"""Largest share of a pose's error of rotation that is left when it is tilted the other way. Of errors of any direction
0.2³, one in a hundred, seem to be flips."""


def tilted(poses: Poses) -> Poses:
    """Returns camera_from_board with the depths about the board's origin mirrored along the line of sight."""
    other = mirrored(poses, Rigid())
    return Poses(other.rotation, np.asarray(poses.translation))


def flipped(loop: Loop, x: Rigid, z: Rigid, outliers: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the ``outliers`` that agree with the solution when they are tilted the other way."""
    other = replace(loop, camera_from_board=tilted(loop.camera_from_board))
    before, after = (each.misses(x, z)[:, 0] for each in (loop, other))
    return outliers & (after < PUT_RIGHT * before)
