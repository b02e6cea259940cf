"""Conventions that are easily mixed up, found from the poses.

A side inverted or mirrored, quaternions in another order, metres that are called millimetres, rows of other poses.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import Loop, Setup
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.judge.notes import Grave
from stcal.handeye.methods.start import mean_pose
from stcal.io.quaternions import INVERTED as CONJUGATED
from stcal.io.quaternions import ORDERS, Reading

FAR_BETTER, BETTER = 30.0, 3.0
"""By so many times the product of the typical residuals in rotation and translation must shrink, and the latter."""
DOUBTFUL = 1.5
"""The same for a note that the other setup fits better."""
INVERTED = "with one side inverted"
WELL = np.radians(0.5), 5.0
"""Poses whose median residuals (rad, mm) are below are not suspected."""
LOST = 0.25
"""Share of what the poses differ by that is not explained, from which on robot and camera have nothing in common."""
MIRROR = np.diag([1.0, -1.0, 1.0])
Guess = Callable[[Loop, bool], tuple[Rigid, Rigid, float]]


def check_conventions(
    pairs: HandEyePoses, loop: Loop, setup: Setup, guess: Guess, with_scale: bool, by_images: bool
) -> tuple[str, ...]:
    """Refuse poses that fit far better in another convention, or in none; notes on what the fit cannot decide.

    With both sides inverted X and Z change places and all fits as before: only a board behind the camera shows it.

    Parameters
    ----------
    loop : of the pairs
    guess : called with a loop and whether the board's scale is free; X, Z and scale
    with_scale : whether it is
    by_images : whether the board's poses come from images, so that nothing but the robot's can be named wrongly

    Raises
    ------
    InputError
        What is mixed up, and the remedy.
    """
    given, notes = _typical(loop, guess, with_scale), ()
    if given[0] > WELL[0] or given[1] > WELL[1]:
        by = f"{np.degrees(given[0]):.3g}° and {given[1]:.3g} mm (median)"
        contradict = f"{pairs.where}: the poses contradict each other by {by}"
        found = {
            what: _typical(variant, guess, with_scale) for what, variant in _variants(loop, setup, by_images).items()
        }
        gain = {
            what: given[0] / max(turn, 1e-12) * given[1] / max(shift, 1e-12) for what, (turn, shift) in found.items()
        }
        what = max(gain, key=gain.__getitem__)
        if gain[what] > FAR_BETTER and given[1] > BETTER * found[what][1]:
            turn, shift = found[what]
            raise InputError(
                "E-HANDEYE-CONVENTION", f"{contradict}, but by {np.degrees(turn):.2g}° and {shift:.2g} mm {what}"
            )
        other = next(what for what in found if what.startswith(INVERTED))
        if gain[other] > DOUBTFUL and given[1] > found[other][1]:
            turn, shift = found[other]
            than = f"by {np.degrees(turn):.2g}° and {shift:.2g} mm {other}"
            notes = (Grave(f"the poses contradict each other by {by}, but {than}"),)
        turn, shift = np.divide(_typical(loop, guess, True), _differ(loop))
        if max(turn, shift) > LOST:
            pair = "pair each pose of the board with that of the flange at the same moment"
            other = "check the camera file" if by_images else "look for another convention of rotations"
            raise InputError(
                "E-HANDEYE-CONVENTION",
                f"{contradict}, {max(turn, shift):.0%} of what they differ by; {pair}, and {other}",
            )
    behind = loop.camera_from_board.translation[:, 2] <= 0
    if behind.all():
        return (
            *notes,
            Grave("the board lies behind the camera in all poses: if these are board_from_camera, name the columns so"),
        )
    if behind.any():
        return (*notes, f"the board lies behind the camera in {pairs.names[int(behind.argmax())]}: check its pose")
    return notes


def _variants(loop: Loop, setup: Setup, by_images: bool) -> dict[str, Loop]:
    """By what they mean, and what to do; ``by_images`` : the board's poses are ours."""
    other = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    # A turn of the mirror is a turn of X and Z, and a mirrored robot is to the camera what a mirrored camera is to it.
    mirrored = Poses(MIRROR @ eye.rotation @ MIRROR, eye.translation @ MIRROR)
    named = "flange_from_base" if by_images else "board_from_camera or flange_from_base"
    metres = "if they are metres, name the columns _m"
    size = "if the size in its file is in metres, correct that" if by_images else metres
    states = "the robot states" if by_images else "robot or camera states"
    left = "change the signs of its y, qx and qz" + ("; or images are mirrored: use them as taken" if by_images else "")
    found = {
        f"{INVERTED}: if these are {named}, name the columns so; if all are named rightly, the setup is {other}": (
            replace(loop, camera_from_board=eye.inverse())
        ),
        f"with the board's lengths times 1000: {size}": (
            replace(loop, camera_from_board=Poses(eye.rotation, 1000 * eye.translation))
        ),
        f"with the robot's lengths times 1000: {metres}": (
            replace(loop, stand_from_mount=Poses(hand.rotation, 1000 * hand.translation))
        ),
        f"with one side mirrored: if {states} left-handed poses, {left}": replace(loop, camera_from_board=mirrored),
    }
    for reading in (*ORDERS, CONJUGATED):
        robot, board = _read_as(reading, hand, loop.inverted), _read_as(reading, eye)
        other = "conjugated" if reading.conjugated else "in another order"
        one = f"quaternions {other}: if {reading.held}, "
        one += reading.remedy if reading.conjugated else "name the columns so"
        every = f"quaternions {other}: if {reading.held}, {reading.remedy}"
        found[f"with the robot's {every if by_images else one}"] = replace(loop, stand_from_mount=robot)
        if not by_images:
            found[f"with the board's {one}"] = replace(loop, camera_from_board=board)
            found[f"with all {every}"] = replace(loop, stand_from_mount=robot, camera_from_board=board)
    return found


def _read_as(reading: Reading, poses: Poses, inverted: bool = False) -> Poses:
    """With quaternions that hold something else; ``inverted`` : the inverses of ``poses`` were read."""
    right = reading.poses(poses.inverse() if inverted else poses)
    return right.inverse() if inverted else right


def _differ(loop: Loop) -> tuple[float, float]:
    """By what poses differ from their mean: angle, and place of flange or board, whichever moved more; RMS."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    turn = hand.rotation @ mean_pose(hand).rotation.T
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    shifts = [np.linalg.norm(each.translation - each.translation.mean(0), axis=1) for each in (hand, eye)]
    return float(np.sqrt((angle**2).mean())), float(max(np.sqrt((shift**2).mean()) for shift in shifts))


def _typical(loop: Loop, guess: Guess, with_scale: bool) -> tuple[float, float]:
    """Median residuals of a first solution, rad and mm."""
    found = loop.residuals(*guess(loop, with_scale)).reshape(-1, 2, 3)
    turn, shift = np.median(np.linalg.norm(found, axis=2), axis=0)
    return float(turn), float(shift)
