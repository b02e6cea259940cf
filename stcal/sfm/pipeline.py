"""The main job: calibrates a target from a folder of images. Each call of :func:`run` is a stage."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stcal.boards.board_file import board_of as board_of
from stcal.boards.finders import tags_of_no_face
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign, scale_reference
from stcal.errors import ConvergenceError, DegenerateError, DetectionError, InputError, InputNote, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import CameraModel, camera_prior, model_of
from stcal.io.cameras.read import camera_model
from stcal.io.device import AUTO, write_frames
from stcal.io.images import TOP_GROUP, chosen_images
from stcal.parallel import Progress, kept_processes, one_thread, scratch_folder
from stcal.sfm.adjust.calibration import Calibration, calibrate, calibrate_board, on_luminous_surface
from stcal.sfm.adjust.chain import measure_chains
from stcal.sfm.adjust.rims import MIN_VIEWS
from stcal.sfm.checks.board_checks import shows_rim
from stcal.sfm.checks.significance import MOST_SIGMAS, Evidence
from stcal.sfm.checks.suite import cause_of_drawing, cause_of_size, run_checks
from stcal.sfm.data.group_model import NOT_AS_DRAWN, Note, lost_groups, not_as_drawn
from stcal.sfm.detect.detect_files import PHOTOGRAPHS, files_of_arrays
from stcal.sfm.mapping.body import plain_lens
from stcal.sfm.report.check import Check
from stcal.sfm.runs import stages
from stcal.sfm.runs.comparisons import MethodResult, compare_with_paper
from stcal.sfm.runs.folder import overlays_beside, write_run
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.saved import RunResult
from stcal.sfm.runs.stages import DetectedImages, Groups, Task
from stcal.sfm.runs.transaction import MarkerFile, frames_folder, require_ours, run_folder

IN_MEMORY = "images in memory"  # what a run's folder states as the folder of its images where there is none
ASSUMED = (
    "no --camera, and no board of dots that tells one: a lens without distortion is assumed, and centres are good "
    "for a look, not for measuring"
)
"""What `detect` says of the camera where none is given."""
PLAIN = (
    "the faces are too few or too small in these images, or in their middle alone, to tell the lens's distortion and "
    "principal point: they are held near none, and near the middle; give --camera, or photograph the faces larger"
)
Images = str | Path | Mapping[str, Sequence[np.ndarray]]  # a folder, or grey or RGB arrays by group
OwnCheck = Callable[[RunResult], Check]  # a check that the caller supplies


@require_arguments
@one_thread()
def run(
    images: Images,
    camera: str | Path | Camera | CameraModel | None = None,
    out: str | Path | None = None,
    target: str | Path | TargetDesign | None = None,
    board: str | Path | BoardDesign | None = None,
    options: RunOptions | None = None,
    progress: Progress | None = None,
    checks: Sequence[OwnCheck] = (),
    every: str | int | None = None,
) -> RunResult:
    """Calibrate a target from photographs.

    Parameters
    ----------
    images
        Folder with one folder of images for each group; or grey or RGB arrays of 8 or 16 bit by the name of their
        group, which are named ``12/0.png``, ``12/1.png`` … in results; or a video file, which is one group.
    camera
        Camera from :func:`stcal.load_camera` or :meth:`stcal.Camera.from_opencv`, or a camera file; if None, it is
        found from the target's printed faces or the dots of the board, and adjusted with all else.
    out
        The run's folder: new, empty, or of an earlier run. If None, no file stays: a temporary folder holds COLMAP's
        database meanwhile.
    target, board
        Designs or their TOML files; the reference design if None, or no board if the target tells its own size.
    options
        Options of the run; the defaults if None.
    progress
        Called with (stage, done, total).
    checks
        Additional checks: functions of the result that return a :class:`stcal.sfm.Check`, such as
        :func:`stcal.sfm.judge` makes. They count in the answer and stand in the report like all others. One that
        raises is suspicious; the result stays.
    every
        Of a video: the sharpest of this many frames is used; by ``auto``, also the value if None, the sharpest of those
        between which the view hardly changes.

    Returns
    -------
    RunResult : ``target`` is the calibrated target. All results are in the folder, too.

    Raises
    ------
    StcalError
        A subclass of it, with a one-line message that says what to do.
    """
    options = options or RunOptions()
    if out is None:
        with scratch_folder("run") as scratch:
            return replace(run(images, camera, scratch, target, board, options, progress, checks, every), out=None)
    with begun(frames_of_video(images, out, every), camera, out, target, board, options, progress) as task:
        seen = stages.detect_and_label(task)
        with overlays_beside(seen, task) as left_out:
            task = stages.scaled_by_drawing(task, seen, board is not None)
            groups = stages.map_groups(task, stages.groups_of(task, seen))
            groups, calibration = scale_chain_adjust(task, groups)
            result = result_of(task, seen, groups, calibration)
            left_out.update(result.unadjusted())
        result = checked(compared(task, result), checks, task.progress)
        return write_run(result, task.folder.stage, task.progress)


def frames_of_video(images: Images, out: str | Path, every: str | int | None) -> Images:
    """Returns the images, of a video the folder of the chosen frames, which are written below the folder of the run."""
    if not isinstance(images, Mapping) and Path(images).is_file():
        require_ours(Path(out))
        write_frames(images, frames_folder(out), every or AUTO)
        return frames_folder(out)
    if every is not None:
        raise InputError("E-OPTION-VALUE", f"--every {every}: a video file in place of the images needed")
    return images


@contextmanager
def begun(
    images: Images,
    camera: str | Path | Camera | CameraModel | None,
    out: str | Path,
    target: str | Path | TargetDesign | None,
    board: str | Path | BoardDesign | None,
    options: RunOptions,
    progress: Progress | None,
    settle: bool = True,
) -> Iterator[Task]:
    """Reads the inputs and claims the folder. Options are settled for a calibration, not for a detection alone."""
    if isinstance(images, Mapping):
        files, place = files_of_arrays(images, options.exclude), Path(IN_MEMORY)
    else:
        files, place = chosen_images(images, options.exclude), Path(images)
    model = None if camera is None else camera_model(camera)
    design = target_of(target)
    scale = scale_reference(None if board is None and design.has_scale else board_of(board), design)
    options = options.for_run(model, design, scale) if settle else options
    given = {"images": place, "--camera": camera, "--target": target, "--board": board}
    marker = MarkerFile.of(place, options if settle else None)
    with kept_processes(options.workers), run_folder(out, marker, given) as folder:
        yield Task(files, folder, design, scale, options, progress or (lambda *_: None), model, place.absolute())


def scale_chain_adjust(task: Task, groups: Groups) -> tuple[Groups, Calibration]:
    """Scales, chains and adjusts. Groups with gross errors are mapped again with the refined camera, where they may
    agree; all are with a plain lens if the faces do not tell the lens of a camera that was not given."""
    calibration = calibration_by(task, groups)
    if doubted := {s.model.group for s in groups.solutions if s.outliers and groups.options.refine_camera}:
        with suppress(StcalError):
            again = stages.map_groups(task, replace(groups, camera=calibration.camera), doubted)
            by_name = {s.model.group: s for s in again.solutions}
            refined = replace(groups, solutions=tuple(by_name.get(s.model.group, s) for s in groups.solutions))
            calibration, groups = calibration_by(task, refined), refined
    lens = calibration.camera
    corners = np.array([[x, y] for x in (0, lens.width) for y in (0, lens.height)], float)
    try:
        if task.camera is None:
            lens.normalised_from_pixel(corners)
    except ConvergenceError:  # a lens that folds its image
        warnings.warn(PLAIN, InputNote, stacklevel=2)
        plain = model_of(plain_lens(lens), PHOTOGRAPHS)
        groups = replace(groups, camera=stages.start_of(plain, lens, task.options))
        return scale_chain_adjust(replace(task, camera=plain), stages.map_groups(task, groups))
    return groups, calibration


def calibration_by(task: Task, groups: Groups) -> Calibration:
    """Returns the calibration by the solutions of the groups; of the board alone, its scale."""
    models = [solution.model for solution in groups.solutions]
    camera, board, options = groups.camera, groups.board, groups.options.adjustment(task.target)
    with groups.naming_cause():
        if not groups.board_alone:
            return calibrate(models, camera, task.target, board, options, camera_prior(camera), task.progress)
        task.progress("faces", 0, 1)
        calibration = calibrate_board(models, camera, board, options)
    task.progress("faces", 1, 1)
    return calibration


def result_of(task: Task, seen: DetectedImages, groups: Groups, calibration: Calibration) -> RunResult:
    """Returns the result of all stages, with every note on what was left out or is doubtful."""
    target, faces, has_board = task.target, calibration.target.target_from_face, bool(task.board.rows)
    printed = target.with_faces(printed=True).faces
    strange = tags_of_no_face(task.files[0], printed, [face for face in printed if face.id not in faces])
    return RunResult(
        out=task.folder.out,
        photographs=task.photographs,
        camera=groups.camera,
        target_design=target,
        board_design=groups.board,
        options=groups.options,
        detection=seen.detection,
        labelled=groups.labelled,
        observations=tuple(groups.observations),
        graph=groups.graph,
        solutions=groups.solutions,
        calibration=calibration,
        chains=measure_chains(calibration.faces, calibration.target),
        camera_given=task.camera_given,
        notes=(
            *(groups.assumed_notes() if has_board else ()),
            *groups.notes,
            *groups.unsolved,
            *calibration.notes,
            *not_as_drawn(faces, target, has_board and set(groups.names) == {TOP_GROUP}),
            *groups.unseen_notes(target),
            *(Note(tags, NOT_AS_DRAWN, remedy="correct the ids in target.toml", then=": ") for tags in strange),
        ),
    )


def compared(task: Task, result: RunResult) -> RunResult:
    """Returns the result with its comparison with the published method on the same photographs, if it is asked for."""
    model = task.camera
    published: dict[str, Any] = {"solve": "paper", "frame": "three-point", "eccentricity": False}
    if not task.options.compare or not result.target.target_from_face or model is None:
        return result
    options = replace(task.options, **published, refine_camera=False, compare=None).settled(task.target)
    task = replace(task.named("{}, as published"), options=options)
    answer: MethodResult | StcalError
    try:
        groups = stages.map_groups(task, stages.groups_of(task, stages.detect_with(task, model)))
        calibration = calibration_by(task, groups)
        models = tuple(solution.model for solution in groups.solutions)
        answer = MethodResult(calibration.target, models, calibration.scales)
    except StcalError as error:
        answer = error
    return replace(result, comparison=compare_with_paper(result, answer))


def checked(result: RunResult, own: Sequence[OwnCheck], progress: Progress) -> RunResult:
    """Returns the result with its checks, the caller's ``own`` last, σ that cover their findings, and rims."""
    evidence = replace(result.evidence(), cause=_cause(result))
    if result.options.rim is None and shows_rim(evidence):
        evidence = replace(evidence, rim=True)
    made = run_checks(evidence, progress)
    factor = max(check.enlarges for check in made)
    calibration = on_surface(result, result.calibration.with_larger_sigma(factor), evidence)
    result = replace(result, checks=made, calibration=calibration)
    further = own_checks(result, own)
    more = max([factor, *(check.enlarges for check in further)]) / factor
    return replace(result, checks=(*made, *further), calibration=calibration.with_larger_sigma(more))


def _cause(result: RunResult) -> Check | None:
    """Returns what of the input is wrong for all images together, if it is known before the checks."""
    target, board = result.target_design, result.board_design
    is_misfit = result.calibration.sigma_factors.all > MOST_SIGMAS or lost_groups(result.notes)
    by_file = is_misfit and result.camera_given and not result.options.refine_camera
    return (
        cause_of_size(result.target.circles, target, board)
        or (stages.wrong_file(result.observations, result.camera, board) if by_file else None)
        or cause_of_drawing(result.target.target_from_face, target)
    )


def own_checks(result: RunResult, makers: Sequence[OwnCheck]) -> list[Check]:
    """Returns the checks of a caller's own on a result. One that could not be made is suspicious: the result stays."""
    checks: list[Check] = []
    for make in makers:
        known = {other.key for other in (*result.checks, *checks)}
        try:
            check = make(result)
            fault = f"returned {type(check).__name__}, a Check needed, such as judge returns"
            if isinstance(check, Check):
                fault = f"has the key {check.key!r} of another" if check.key in known else ""
        except Exception as error:
            fault = f"raised {type(error).__name__}: {error}"
        if fault:
            name = getattr(make, "__name__", repr(make))
            key = name if name not in known else f"{name}_{len(known)}"
            remedy = "mend this check; the result does not depend on it"
            check = Check(key, f"Check {name}", "suspicious", f"it {fault}", (), 0, (), remedy)
        checks.append(check)
    return checks


def on_surface(result: RunResult, calibration: Calibration, evidence: Evidence) -> Calibration:
    """Returns the calibration, of the luminous surface if rims are stated, or to be estimated."""
    design = result.target_design
    heights, sigma_mm = design.rim_of(), 0.0
    if evidence.rim:
        found = evidence.rims.get("circles")
        if found is None:
            fault = f"--rim: circles of the faces in fewer than {MIN_VIEWS} views or at too few tilts"
            remedy = "photograph them from several angles, or state rim_mm in target.toml"
            raise InputError("E-RIM-UNKNOWN", f"{fault}; {remedy}")
        heights, sigma_mm = dict.fromkeys(calibration.target.circles, found.height_mm), found.sigma_mm
    if not any(heights.values()):
        return calibration
    return on_luminous_surface(calibration, heights, sigma_mm, design, result.options.adjustment(design).frame)


@require_arguments
@one_thread()
def detect_images(
    images: Images,
    camera: str | Path | Camera | CameraModel | None = None,
    out: str | Path | None = None,
    target: str | Path | TargetDesign | None = None,
    board: str | Path | BoardDesign | None = None,
    options: RunOptions | None = None,
    progress: Progress | None = None,
) -> DetectedImages:
    """Detect and label the circles and corners of all images, as :func:`run` does at its beginning.

    Parameters
    ----------
    images, camera, target, board, options, progress
        As of :func:`run`, without videos. If ``camera`` is None, it is found by the dots of the board, or assumed: a
        note says which.
    out
        Folder for ``detections.csv`` and an overlay picture of each image; nothing is written if None.

    Returns
    -------
    DetectedImages : ``images`` has the labelled circles by name of the image, px; ``notes`` what was left out.

    Raises
    ------
    InputError
        An input cannot be used, or the folder holds a finished calibration.
    """
    if out is None:
        with scratch_folder("detect") as scratch:
            return detect_images(images, camera, scratch, target, board, options, progress)
    if (Path(out) / "faces.json").exists():
        fault = f"output folder {out}: holds a finished calibration"
        raise InputError("E-OUTPUT-EXISTS", f"{fault}; give another folder with --out")
    with begun(images, camera, out, target, board, options or RunOptions(), progress, settle=False) as task:
        note, model = "", task.camera
        if model is None:
            model, note = model_of(stages.guessed_cameras(task.files[0])[0], PHOTOGRAPHS), ASSUMED
            with suppress(DetectionError, DegenerateError):
                if task.board.rows:
                    model = stages.camera_by_dots(task, None)
                    note = f"no --camera: found by the dots of the board, f {model.focal[0]:.0f} px"
        seen, has_circles = stages.detect_with(task, model), bool(task.target.with_faces(printed=False).faces)
        notes = note * has_circles, stages.unseen_faces(task, seen)
        with overlays_beside(seen, task, page=False):
            return replace(seen, notes=tuple(filter(None, notes)))
