"""One call for every method."""

from dataclasses import replace

import numpy as np

from stcal.camera_file import CameraPrior
from stcal.errors import InputError
from stcal.handeye import start
from stcal.handeye.closed_form import AX_XB, AX_ZB, closed_form
from stcal.handeye.leastsq import generalised_inverse
from stcal.handeye.loop import Loop, Setup
from stcal.handeye.noise import Noise
from stcal.handeye.pairs import HandEyePoses
from stcal.handeye.pose_adjustment import State, adjust_poses
from stcal.handeye.reprojection import adjust_views, resected
from stcal.handeye.result import HandEye
from stcal.handeye.views import Views

METHODS = (*AX_XB, *AX_ZB, "pose", "reprojection")
"""Names of the methods."""


def handeye(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    *,
    views: Views | None = None,
    noise: Noise | None = None,
    intrinsics: CameraPrior | None = None,
    with_scale: bool = False,
) -> HandEye:
    """Where the camera sits on the flange, or in the robot's base.

    Parameters
    ----------
    pairs : HandEyePoses
        At least three, rotated about two axes that are not parallel; see :func:`~stcal.handeye.read_poses`,
        :func:`~stcal.handeye.pairs_of_views`.
    setup : str
        ``eye-in-hand``: the camera on the flange; ``eye-to-hand``: the board on the flange.
    method : str, optional
        One of :data:`METHODS`; ``reprojection`` with views, else ``pose`` where none is named.
    views : Views, optional
        The corners that ``pairs`` come from; only ``reprojection`` uses them.
    noise : Noise, optional
        What is known of the errors; the rest is estimated.
    intrinsics : CameraPrior, optional
        Solve for the camera's parameters too, held by this; ``reprojection`` only.
    with_scale : bool
        Solve for the board's true size too; ``pose`` and ``reprojection`` only.

    Raises
    ------
    InputError
        Unknown method or setup, or ``reprojection`` without views.
    DegenerateError
        The poses do not determine the answer.
    ConvergenceError
        The method fails on these poses.

    Examples
    --------
    >>> pairs = read_poses("poses.csv")  # doctest: +SKIP
    >>> found = handeye(pairs, "eye-in-hand")  # doctest: +SKIP
    >>> found.flange_from_camera @ [0, 0, 500]  # a point half a metre before the camera  # doctest: +SKIP
    """
    method = method or ("pose" if views is None else "reprojection")
    if method not in METHODS:
        raise InputError(f"hand-eye: method {method!r} is unknown; one of {', '.join(METHODS)} needed")
    noise, loop = noise or Noise(), Loop.of(pairs, setup)
    if method in (*AX_XB, *AX_ZB):
        x, z = closed_form(loop, method)
        return HandEye(method, setup, x, z, loop.residuals(x, z), pairs.names, np.zeros(len(loop), bool))
    if method == "pose":
        return _by_poses(pairs, loop, setup, noise, with_scale)
    if views is None or len(views) != len(pairs):
        raise InputError("hand-eye: reprojection needs the corners of every pose; give views, or use method pose")
    return _by_views(pairs, loop, setup, views, noise, intrinsics, with_scale)


def _by_poses(pairs, loop, setup, noise, with_scale) -> HandEye:
    solution = adjust_poses(loop, State(*start.robust(loop)), noise, with_scale)
    covariance, state = generalised_inverse(solution.normal), solution.state
    names = (f"{solution.side}_rad", f"{solution.side}_mm") if solution.side else ()
    stated = {name: getattr(noise, name) for name in ("robot_rad", "robot_mm", "camera_rad", "camera_mm")}
    sigma = {name: value for name, value in stated.items() if value} | dict(zip(names, solution.sigma, strict=True))
    return HandEye(
        "pose",
        setup,
        state.mount_from_camera,
        state.stand_from_board,
        solution.residuals,
        pairs.names,
        solution.outliers,
        covariance[:6, :6],
        covariance[6:12, 6:12],
        state.scale,
        float(np.sqrt(covariance[12, 12])) if with_scale else None,
        sigma,
        names,
    )


def _by_views(pairs, loop, setup, views, noise, intrinsics, with_scale) -> HandEye:
    solution = adjust_views(loop, pairs.base_from_flange, views, noise, intrinsics, with_scale)
    x, z = solution.state.mount_from_camera, solution.state.stand_from_board
    seen = replace(loop, camera_from_board=resected(pairs.names, views, solution))
    return HandEye(
        "reprojection",
        setup,
        x,
        z,
        seen.residuals(x, z),
        pairs.names,
        solution.outliers,
        solution.covariance[:6, :6],
        solution.covariance[6:, 6:],
        solution.state.scale,
        solution.sigma_scale,
        solution.sigma,
        solution.estimated,
        solution.found,
    )
