"""Poses of the goal in the robot's base, of located targets: what ``locate run`` adds to camera_from_obj."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.geometry.rigid import Order, Rigid
from stcal.locate.pipeline import Located
from stcal.locate.report.chain import (
    GoalChain,
    HandEyeResult,
    RegistrationResult,
    on_chain,
    read_chain,
    read_registered,
)
from stcal.locate.report.page import accepted, uncertain


@require_arguments
def goal_chain(
    hand_eye: HandEyeResult | Rigid | str | Path | None = None,
    registration: RegistrationResult | str | Path | None = None,
    *,
    robot_poses: Mapping[str, Rigid] | str | Path | None = None,
    offset: Rigid | str | Path | None = None,
    key: str = "scene",
    columns: str | Path | None = None,
    quaternions: Order = "wxyz",
) -> GoalChain:
    """Returns the chain base_from_goal = base_from_flange · flange_from_camera · camera_from_obj · obj_from_goal.

    For a fixed camera, base_from_camera stands in place of the first two.

    Parameters
    ----------
    hand_eye : HandEye, Rigid, str or Path, optional
        Result of :func:`stcal.handeye.handeye`, or its file; or an exact transform, mm: flange_from_camera with
        ``robot_poses``, base_from_camera without.
    registration : Registration, str or Path, optional
        Result of :func:`stcal.register.register`, or its file, in place of ``hand_eye``. It must be rigid; a is the
        frame of a fixed camera, b the robot's base.
    robot_poses : dict of Rigid, str or Path, optional
        base_from_flange of each scene by its name, mm, exact; or a table of them (CSV), whose covariances are used.
        Needed for a camera on the flange only.
    offset : Rigid, str or Path, optional
        obj_from_goal, mm, exact; or a file with it (JSON). The goal is the target itself by default.
    key : str
        Column of the table that names the scenes.
    columns : str or Path, optional
        File with the columns, delimiter … of the table (TOML).
    quaternions : {"wxyz", "xyzw"}
        Order of the table's quaternions: by the names of their columns, or x, y, z, w in the order of the columns.

    Returns
    -------
    GoalChain
        For :func:`~stcal.locate.goals` and :func:`~stcal.locate.poses_csv`.

    Raises
    ------
    InputError
        Neither or both of ``hand_eye`` and ``registration`` are given, robot poses are missing or not needed, the
        registration is not rigid, or a file does not follow ``data_layout.md``.
    """
    if hand_eye is not None and registration is not None:
        raise InputError(
            "E-OPTION-CONFLICT",
            f"--hand-eye {_named(hand_eye)}, --registration {_named(registration)}: both lead to the base; give one",
        )
    if hand_eye is None and robot_poses is not None:
        raise InputError("E-OPTION-NEEDS", "--robot-poses: only with --hand-eye, for a camera on the flange")
    if hand_eye is not None:
        return read_chain(hand_eye, robot_poses, offset, quaternions, key, columns)
    if registration is not None:
        return read_registered(registration, offset)
    if offset is not None:
        raise InputError(
            "E-OPTION-NEEDS",
            "--offset: only with --hand-eye or --registration, which lead from the camera to the robot",
        )
    raise InputError("E-OPTION-MISSING", "goals: --hand-eye or --registration needed, which lead to the robot's base")


def _named(given: object) -> str:
    return str(given) if isinstance(given, str | Path) else type(given).__name__


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Goals(Brief):
    """Goals of the accepted scenes in the robot's base.

    Parameters
    ----------
    base_from_goal : dict of Rigid
        Pose by scene, mm.
    covariance : dict of (6, 6) array
        Covariance of each, of rotation (rad) and translation (mm), left perturbation in the base. It holds the errors
        of all links of the chain; the patent's method states none of its own.
    notes : tuple of str
        Doubts about the robot's poses or the transform to it.
    """

    base_from_goal: dict[str, Rigid]
    covariance: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()


@require_arguments
def goals(results: Sequence[Located], chain: GoalChain) -> Goals:
    """Returns where the robot has to go: the goal's pose in the robot's base, of each accepted scene.

    Parameters
    ----------
    results : sequence of Located
        Results of :func:`~stcal.locate.run` or :func:`~stcal.locate.locate_image`, by whose names the robot's poses are
        found.
    chain : GoalChain
        Transforms to the robot's base, of :func:`~stcal.locate.goal_chain`.

    Returns
    -------
    Goals
        Of accepted poses only, so that no robot moves to a rejected one.

    Raises
    ------
    InputError
        A scene has no robot pose; or the target stands still between the scenes only in another unit or convention of
        the robot's poses or the transform, which the message names.
    """
    chain.require_poses([each.name for each in results])
    seen = {each.name: uncertain(each) for each in accepted(results)}
    notes = on_chain(chain, seen)
    found = {name: chain.base_from_goal(name, pose) for name, pose in seen.items()}
    return Goals(
        {name: each.rigid for name, each in found.items()},
        {name: each.covariance for name, each in found.items()},
        notes,
    )
