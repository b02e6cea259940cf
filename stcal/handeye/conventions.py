"""Conventions that are easily mixed up, found from the poses: one side inverted, metres that are called millimetres."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.loop import Loop, Setup
from stcal.handeye.pairs import HandEyePoses

FAR_BETTER = 30.0
"""By so many times the product of the typical residuals in rotation and translation must shrink."""
WELL = np.radians(0.5), 5.0
"""Poses whose median residuals (rad, mm) are below are not suspected."""
Guess = Callable[[Loop], tuple[Rigid, Rigid, float]]


def check_conventions(pairs: HandEyePoses, setup: Setup, guess: Guess) -> tuple[str, ...]:
    """Refuse poses that fit far better in another convention; return notes on what the fit cannot decide.

    With both sides inverted X and Z change places and all fits as before: only a board behind the camera shows it.

    Raises
    ------
    InputError
        What is mixed up, and the remedy.
    """
    loop = Loop.of(pairs, setup)
    eye = loop.camera_from_board
    behind = eye.translation[:, 2] <= 0
    given = _typical(loop, guess)
    if given[0] > WELL[0] or given[1] > WELL[1]:
        for what, variant in _variants(loop, setup).items():
            found = _typical(variant, guess)
            better = given[0] / max(found[0], 1e-12) * given[1] / max(found[1], 1e-12)
            if better > FAR_BETTER:
                raise InputError(
                    f"{pairs.where}: the poses contradict each other by {np.degrees(given[0]):.3g}° and {given[1]:.3g} "
                    f"mm (median), but by {np.degrees(found[0]):.2g}° and {found[1]:.2g} mm {what}"
                )
    if behind.all():
        return ("the board lies behind the camera in all poses: if these are board_from_camera, name the columns so",)
    if behind.any():
        return (f"{pairs.names[int(behind.argmax())]}: the board lies behind the camera; check its pose",)
    return ()


def _variants(loop: Loop, setup: Setup) -> dict[str, Loop]:
    """By what they mean, and what to do."""
    other = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    return {
        "with one side inverted: if these are board_from_camera or flange_from_base, name the columns so; "
        f"if all are named rightly, the setup is {other}": replace(loop, camera_from_board=eye.inverse()),
        "with the board's lengths times 1000: if they are metres, name the columns _m": replace(
            loop, camera_from_board=Poses(eye.rotation, 1000 * eye.translation)
        ),
        "with the robot's lengths times 1000: if they are metres, name the columns _m": replace(
            loop, stand_from_mount=Poses(hand.rotation, 1000 * hand.translation)
        ),
    }


def _typical(loop: Loop, guess: Guess) -> tuple[float, float]:
    """Median residuals of a first solution, rad and mm."""
    found = loop.residuals(*guess(loop)).reshape(-1, 2, 3)
    turn, shift = np.median(np.linalg.norm(found, axis=2), axis=0)
    return float(turn), float(shift)
