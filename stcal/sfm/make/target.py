"""A target that is designed and forecast, with the files of it: for a box, or a body of tags."""

import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from stcal.boards.target import save_body
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.io.design import load_board, save_design
from stcal.io.files import BOARD, TARGET
from stcal.parallel import Progress
from stcal.sfm.make.box import require_size
from stcal.sfm.make.design import DesignOptions, Made, make_target
from stcal.sfm.planning.advise import expected_noise
from stcal.sfm.planning.bodies import plan_body
from stcal.sfm.planning.session import Plan, PlanOptions, plan_with_board
from stcal.synthetic.designs import Body, tag_body


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DesignedTarget(Brief):
    """A target that was designed.

    ``target``, ``board`` : the designs, no board of a body of tags; ``forecast`` : the σ to expect, None where a group
    is not linked with so few images, for the ``reason``; ``source`` : of the σ of its centres; ``made`` : how the
    circles were chosen, None of tags; ``files`` : those that were written.
    """

    target: TargetDesign
    board: BoardDesign | None
    forecast: Plan | None
    reason: str
    source: str
    made: Made | None
    files: tuple[Path, ...]


@require_arguments
def design_target(
    options: DesignOptions, images: int = 10, out: str | Path | None = None, progress: Progress | None = None
) -> DesignedTarget:
    """Returns a target of circles for a box, whose faces are told apart with any three circles hidden, and its σ.

    Parameters
    ----------
    options : DesignOptions
        Box, circles and camera.
    images : int
        Number of images of each group in the forecast.
    out : str or Path, optional
        Folder for ``target.toml`` and ``board.toml``. A ``board.toml`` that is there is kept, and forecast with.
        Nothing is written if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    DesignedTarget
        ``target`` and ``board``, mm; ``forecast`` with the σ to expect of every face, mm and rad.

    Raises
    ------
    InputError
        Circles are too small or too large for the camera, too few or without room, a face is not told apart, or
        ``target.toml`` exists.
    """
    target_file, board_file = _free(out)
    board = load_board(board_file) if board_file is not None and os.path.lexists(board_file) else None
    made = make_target(options, progress and partial(progress, "patterns"))
    target, noise, source = made.pattern.target, *expected_noise()
    session = PlanOptions(
        images=images,
        distance_mm=options.distance_mm,
        width=options.width,
        camera=options.camera,
        noise=noise,
        seed=options.seed,
    )
    forecast = plan_with_board(session, target, board or made.board, target.rough_poses())
    files: tuple[Path, ...] = ()
    if target_file is not None and board_file is not None:
        designs = {target_file: target} | ({} if board is not None else {board_file: made.board})
        for path, each in designs.items():
            save_design(path, each)
        files = tuple(designs)
    return DesignedTarget(target, board or made.board, forecast, "", source, made, files)


@require_arguments
def design_tag_body(
    kind: Body,
    size_mm: float,
    dictionary: str = "APRILTAG_36h11",
    first_id: int = 0,
    session: PlanOptions | None = None,
    out: str | Path | None = None,
) -> DesignedTarget:
    """Returns a cube or dodecahedron with a tag on each face, and its σ.

    Parameters
    ----------
    kind : {"cube", "dodecahedron"}
        The body.
    size_mm : float
        Width between opposite faces, mm.
    dictionary : str
        Dictionary of the tags.
    first_id : int
        Id of the first tag, from which they count up.
    session : PlanOptions, optional
        Photographs of the forecast: ``images``, ``distance_mm``, ``width`` or ``camera``, and ``seed``.
    out : str or Path, optional
        Folder for ``target.toml``; nothing is written if None.

    Returns
    -------
    DesignedTarget
        ``target``, mm; ``forecast`` with the σ to expect of every face, mm and rad, or the ``reason`` why there is
        none.

    Raises
    ------
    InputError
        The size is not within 1 mm and 100 m, a tag does not exist, ``target.toml`` exists, or the body does not fit
        into the image.
    """
    require_size([size_mm], f"{size_mm:g}")
    path, _ = _free(out)
    target, (noise, source) = tag_body(kind, size_mm, dictionary, first_id), expected_noise(of_corners=True)
    forecast, reason = None, ""
    try:
        forecast = plan_body(replace(session or PlanOptions(), noise=noise), target, target.rough_poses())
    except InputError as error:
        if error.code != "E-PLAN-UNLINKED":
            raise
        reason = str(error)
    if path is not None:
        save_body(path, target)
    return DesignedTarget(target, None, forecast, reason, source, None, () if path is None else (path,))


def _free(out: str | Path | None) -> tuple[Path | None, Path | None]:
    """Returns the places of the two files in a folder, in which there must be no target yet."""
    if out is None:
        return None, None
    target_file = Path(out) / TARGET
    if os.path.lexists(target_file):
        raise InputError("E-OUTPUT-EXISTS", f"{target_file}: exists; move it away, or give another folder")
    return target_file, Path(out) / BOARD
