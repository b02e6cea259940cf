"""The main job: calibrates a target from a folder of images. Each call is a stage, and its result is saved."""

import itertools
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.boards.board_file import board_of
from stcal.boards.on_faces import tags_of_no_face, why_unseen
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign, faces_of_known_shape, scale_reference, with_drawn_size
from stcal.errors import ConvergenceError, DegenerateError, DetectionError, InputError, InputNote, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraModel, camera_prior, model_of, refinable
from stcal.io.cameras.photograph import camera_of_photograph
from stcal.io.cameras.read import camera_model
from stcal.io.files import save
from stcal.io.images import TOP_GROUP, ImageFile, ImageFiles, chosen_images, require_common_size
from stcal.io.video import AUTO, write_frames
from stcal.labels import DotLabel
from stcal.parallel import Progress, kept_processes, one_thread, scratch_folder
from stcal.sfm.adjust.calibration import Calibration, calibrate, calibrate_board, on_luminous_surface
from stcal.sfm.adjust.chain import measure_chains
from stcal.sfm.adjust.rims import MIN_VIEWS, find_rims
from stcal.sfm.adjust.scale import with_edge_sigma
from stcal.sfm.camera.calibrate import camera_of_dots
from stcal.sfm.camera.intrinsics import start_camera
from stcal.sfm.checks.causes import cause_of_drawing, cause_of_size
from stcal.sfm.checks.significance import MOST_SIGMAS, Check
from stcal.sfm.checks.suite import run_checks, shows_rim
from stcal.sfm.data.as_drawn import misnamed_groups, misplaced_images, not_as_drawn
from stcal.sfm.data.model import by_group, detections_csv
from stcal.sfm.data.note import NOT_AS_DRAWN, Note, lost_groups
from stcal.sfm.detect.files import PHOTOGRAPHS, DetectionResult, files_of_arrays, seen_by
from stcal.sfm.detect.labelling import LabelledImage, is_board_alone, label_images
from stcal.sfm.mapping.body import MIN_CORNERS
from stcal.sfm.mapping.pairs import image_graph
from stcal.sfm.mapping.placed import LENS, place_and_find_camera, place_with_camera, plain_lens, unknown_lens
from stcal.sfm.runs.folder import overlays_beside, shown_if_failed, write_run
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.published import compare_with_paper, require_comparable
from stcal.sfm.runs.report import unadjusted
from stcal.sfm.runs.result import RunResult
from stcal.sfm.runs.solve import (
    DetectedImages,
    GroupSolution,
    Task,
    detected_images,
    explained,
    labelled_images,
    require_dots,
    require_no_calibration,
    solve_body,
    solve_groups,
    ungrouped,
    unknown_face_notes,
    unseen_board,
    unseen_circles,
    usable_groups,
    wrong_file,
)
from stcal.sfm.runs.transaction import MarkerFile, frames_folder, require_ours, run_folder

VAGUE = 0.01
"""Relative σ of a camera file's focal length above which the boards tell it better."""
IN_MEMORY = "images in memory"
"""What a run's folder states as the folder of its images where there is none."""
FOUND_BY_DOTS = "no --camera: found by the dots of the board, f {:.0f} px"
ASSUMED = (
    "no --camera, and no board of dots that tells one: a lens without distortion is assumed, and centres are good "
    "for a look, not for measuring"
)
"""What `detect` says of the camera where none is given."""
Images = str | Path | Mapping[str, Sequence[np.ndarray]]
"""A folder of images, or grey or RGB arrays by the name of their group."""
OwnCheck = Callable[[RunResult], Check]
"""A check that the caller supplies."""


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
    RunResult
        ``target`` is the calibrated target. All results are in the folder, too.

    Raises
    ------
    StcalError
        A subclass of it, with a one-line message that says what to do.
    """
    options = options or RunOptions()
    if camera is None:
        options = replace(options, refine_camera=True)
    if out is None:
        with scratch_folder("run") as scratch:
            result = run(images, camera, scratch, target, board, options, progress, checks, every)
            return replace(result, out=None)
    if isinstance(images, str | Path) and Path(images).is_file():
        images = frames_in_run(images, out, every or AUTO)
    elif every is not None:
        raise InputError("E-OPTION-VALUE", f"--every {every}: a video file in place of the images needed")
    if isinstance(images, Mapping):
        files, place = files_of_arrays(images, options.exclude), IN_MEMORY
    else:
        files, place = chosen_images(images, options.exclude), images
    return run_on_files(files, place, camera, out, target, board, options, progress, checks)


def frames_in_run(video: str | Path, out: str | Path, every: str | int) -> Path:
    """Writes the chosen frames of a video below the folder of a run, and returns their folder."""
    require_ours(Path(out))
    folder = frames_folder(out)
    write_frames(video, folder, every)
    return folder


@one_thread()
def run_on_files(
    files: ImageFiles,
    images: str | Path,
    camera: str | Path | Camera | CameraModel | None,
    out: str | Path,
    target: str | Path | TargetDesign | None,
    board: str | Path | BoardDesign | None,
    options: RunOptions,
    progress: Progress | None = None,
    checks: Sequence[OwnCheck] = (),
) -> RunResult:
    """Calibrates a target from some of the photographs in the folder ``images``; see :func:`run`."""
    progress = progress or (lambda *_: None)
    model = None if camera is None else camera_model(camera)
    if model is not None and is_vague(model) and not (options.refine_camera or options.compare):
        options = replace(options, refine_camera=True)
        known = f"camera file {model.source}: states its focal length to ±{_focal_sigma(model):.3g} px only"
        warnings.warn(f"{known}; intrinsics are adjusted, as with --refine-camera", InputNote, stacklevel=2)
    given = {"images": images, "--camera": camera, "--target": target, "--board": board}
    target_design = target_of(target)
    known = None if board is None and target_design.has_scale else board_of(board)
    board_design = scale_reference(known, target_design)
    if target_design.with_faces(printed=True).faces:
        _require_for_printed(options)
    if model is None and not (board_design.rows or target_design.with_faces(printed=True).faces):
        raise InputError(
            "E-CAMERA-NEEDED",
            "missing option '--camera': circles without a board of dots need a camera file, which `stcal-sfm "
            "calibrate-camera` makes; the camera is also found if a board is in view, or if faces have a board or tags",
        )
    if options.compare:
        require_dots(known, f"--compare {options.compare}")
    options = options.settled(target_design)
    if options.compare:
        require_comparable(options.adjustment(target_design))
    with kept_processes(options.workers), run_folder(out, MarkerFile.of(images, options), given) as folder:
        task = Task(files, folder, target_design, board_design, options, progress)
        result = _calibrated(task, model, board is None and not target_design.has_scale)
        result = replace(result, camera_given=model is not None and not is_rough(model, options))
        if options.compare and result.target.target_from_face and model is not None:
            result = replace(result, comparison=compare_with_paper(result, _published(task, model)))
        evidence = result.evidence(camera_prior(result.camera))
        if options.rim is None:
            evidence = replace(evidence, rim=shows_rim(evidence))
        sized = cause_of_size(result.target.circles, target_design, board_design)
        cause = sized or cause_of_drawing(result.target.target_from_face, target_design)
        is_misfit = result.calibration.sigma_factors.all > MOST_SIGMAS or lost_groups(result.notes)
        if is_misfit and sized is None and result.camera_given and not options.refine_camera:
            cause = wrong_file(result.observations(), result.camera, result.board_design) or cause
        made = run_checks(replace(evidence, cause=cause), progress)
        factor = max(check.enlarges for check in made)
        result = replace(result, checks=made, calibration=result.calibration.with_larger_sigma(factor))
        result = replace(result, calibration=_on_surface(result, evidence.rim))
        own = own_checks(result, checks)
        more = max([factor, *(check.enlarges for check in own)]) / factor
        result = replace(result, checks=(*made, *own), calibration=result.calibration.with_larger_sigma(more))
        return replace(result, judgement=write_run(result, folder.stage, progress))


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
            keys = (f"{name}_{number}" if number else name for number in itertools.count())
            key = next(key for key in keys if key not in known)
            remedy = "mend this check; the result does not depend on it"
            check = Check(key, f"Check {name}", "suspicious", f"it {fault}", (), 0, (), remedy)
        checks.append(check)
    return checks


def _calibrated(task: Task, model: CameraModel | None, is_board_assumed: bool) -> RunResult:
    target, options, camera_given = task.target, task.options, model is not None
    if model is None and target.with_faces(printed=True).faces:
        detection, labelled, model = _with_found_camera(task)
    else:
        if model is None or (task.board.rows and is_rough(model, options)):
            model = _camera_of_dots(task, model)
        detection, labelled = labelled_images(task, model)
    with (
        shown_if_failed(target.name, detection, labelled, task.folder),
        overlays_beside(detection, labelled, target, task.folder, task.progress) as left_out,
    ):
        if not (options.board_only or any(image.observations.face_ids() for image in labelled)):
            _require_seen(task, labelled)
        shows_dots = any(isinstance(label, DotLabel) for image in labelled for label in image.observations.labels)
        if is_board_assumed and not options.board_only and not shows_dots:
            target = with_drawn_size(target, [image.observations.labels for image in labelled])
            task = replace(task, target=target, board=scale_reference(None, target))
        result = _solved(task, detection, labelled, model)
        if not (camera_given or _unfolded(result.calibration.camera)):
            warnings.warn(PLAIN, InputNote, stacklevel=2)
            result = _solved(task, detection, labelled, model_of(plain_lens(result.calibration.camera), PHOTOGRAPHS))
        printed = target.with_faces(printed=True).faces
        absent = [face for face in printed if face.id not in result.target.target_from_face]
        tags, remedy = tags_of_no_face(task.files[0], printed, absent), "correct the ids in target.toml"
        strange = [Note(words, NOT_AS_DRAWN, remedy=remedy, then=": ") for words in tags]
        result = replace(result, notes=(*result.notes, *strange))
        left_out.update(unadjusted(result))
    return result


PLAIN = (
    "the faces are too few or too small in these images, or in their middle alone, to tell the lens's distortion and "
    "principal point: they are held near none, and near the middle; give --camera, or photograph the faces larger"
)


def _unfolded(camera: Camera) -> bool:
    """Returns whether all corners of a camera's image have rays."""
    try:
        camera.normalised_from_pixel(np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], float))
    except ConvergenceError:
        return False
    return True


def _with_found_camera(task: Task) -> tuple[DetectionResult, list[LabelledImage], CameraModel]:
    """Finds the camera by the printed faces of the target, and labels the images with it."""
    target, options, folder = task.target, task.options, task.folder
    printed = target.with_faces(printed=True)
    guesses = guessed_cameras(task.files[0])
    faces_alone = replace(task, target=printed, board=scale_reference(None, printed))
    detection, labelled = detected_images(faces_alone, model_of(guesses[0], PHOTOGRAPHS))
    _require_seen(task, labelled)
    observations = [image.observations for image in labelled]
    found = place_and_find_camera(observations, printed.faces, guesses).camera
    model = model_of(found, PHOTOGRAPHS)
    if task.board.rows or len(printed.faces) < len(target.faces):
        return *labelled_images(task, model), model
    detection = seen_by(detection, found, target)
    labelled = label_images(detection, target, None, options.ellipses, folder.cache, options.workers)
    save(folder.stage / "detections.csv", detections_csv([image.observations for image in labelled]))
    return detection, labelled, model


def is_rough(model: CameraModel, options: RunOptions) -> bool:
    """Whether a camera is to be refined whose focal length, as of EXIF, is known less well than boards tell it."""
    return options.refine_camera and is_vague(model)


def is_vague(model: CameraModel) -> bool:
    """Returns whether a camera file states its focal length less well than the boards tell it."""
    if model.covariance is None or model.colmap_model != LENS:
        return False
    return _focal_sigma(model) > VAGUE * model.focal[0]


def _focal_sigma(model: CameraModel) -> float:
    return float(np.sqrt(model.covariance[0, 0])) if model.covariance is not None else 0.0


def _camera_of_dots(task: Task, rough: CameraModel | None) -> CameraModel:
    """Returns the camera calibrated from the dots of the board, with the weak prior of an unknown lens: the adjustment
    of all groups estimates it again from the same dots."""
    files = task.files[0]
    start = guessed_cameras(files)[0] if rough is None else rough.calibrated(*require_common_size(files)[0])

    def told(stage: str, done: int, total: int) -> None:
        task.progress(f"{stage} for the camera", done, total)

    detection, _ = detected_images(replace(task, progress=told), model_of(start, PHOTOGRAPHS))
    found = camera_of_dots(files, detection, task.board, start, LENS).camera
    return model_of(unknown_lens(found), PHOTOGRAPHS)


def _require_seen(task: Task, labelled: Sequence[LabelledImage]) -> None:
    """Refuses images in which no printed face of the target is seen, and names the tags that are."""
    if unseen := _why_unseen(task, labelled):
        raise DetectionError("E-TARGET-UNSEEN", unseen)


def _why_unseen(task: Task, labelled: Sequence[LabelledImage]) -> str:
    printed = task.target.with_faces(printed=True).faces
    ids = {face.id for face in printed}
    if not printed or any(ids.intersection(image.observations.face_ids()) for image in labelled):
        return ""
    return why_unseen(task.files[0], printed)


def guessed_cameras(files: Sequence[ImageFile]) -> list[Camera]:
    """Returns where the search for a camera begins: at the first EXIF that states one, or a medium focal length."""
    (width, height), _ = require_common_size(list(files))
    for file in files:
        try:
            camera = camera_of_photograph(file.path).camera
        except InputError:
            continue
        if (camera.width, camera.height) == (width, height):
            return [camera]
    return [Camera.of(start_camera(width, height, LENS), LENS)]


def _camera_for_a_look(task: Task) -> tuple[CameraModel, bool]:
    """Returns the camera with which images are detected where none is given, and whether the dots of the board told it.
    Else it is one of medium focal length: in a wide image faces far from the middle may lose their names."""
    if task.board.rows:
        with suppress(DetectionError, DegenerateError):
            return _camera_of_dots(task, None), True
    return model_of(guessed_cameras(task.files[0])[0], PHOTOGRAPHS), False


def _require_for_printed(options: RunOptions) -> None:
    """Refuses options that a target with boards or tags on its faces has no use for."""
    given = {
        "--solve paper": options.solve == "paper",
        "--compare paper": options.compare is not None,
        "--board-only": options.board_only,
    }
    for name in (name for name, is_given in given.items() if is_given):
        raise InputError(
            "E-OPTION-CONFLICT",
            f"{name}: only for targets of circles, and faces of this one have boards or tags; leave it out",
        )


def _on_surface(result: RunResult, rim: bool) -> Calibration:
    """Returns the calibration, of the luminous surface if rims are stated, or to be estimated (``rim``)."""
    design, calibration = result.target_design, result.calibration
    heights, sigma_mm = design.rim_of(), 0.0
    if rim:
        radius = design.radius_of() | result.board_design.radius_of()
        found = find_rims(calibration.models, result.observations(), radius, calibration.camera).get("circles")
        if found is None:
            raise InputError(
                "E-RIM-UNKNOWN",
                f"--rim: circles of the faces in fewer than {MIN_VIEWS} views or at too few tilts; photograph them "
                "from several angles, or state rim_mm in target.toml",
            )
        heights, sigma_mm = dict.fromkeys(calibration.target.circles, found.height_mm), found.sigma_mm
    if not any(heights.values()):
        return calibration
    frame = result.options.adjustment(design).frame
    return on_luminous_surface(calibration, heights, sigma_mm, design, frame)


def _published(task: Task, model: CameraModel) -> RunResult | StcalError:
    """Returns the result of the published method on the same photographs, or the error that prevents it."""
    options = replace(
        task.options, solve="paper", frame="three-point", eccentricity=False, refine_camera=False, compare=None
    ).settled(task.target)

    def told(stage: str, done: int, total: int) -> None:
        task.progress(f"{stage}, as published", done, total)

    published = replace(task, options=options, progress=told)
    try:
        return _solved(published, *detected_images(published, model), model)
    except StcalError as error:
        return error


def _solved(task: Task, detection: DetectionResult, labelled: list[LabelledImage], model: CameraModel) -> RunResult:
    folder, target, options, progress = task.folder, task.target, task.options, task.progress
    calibrated_camera = model.calibrated(detection.camera.width, detection.camera.height)
    calibrated_camera = refinable(calibrated_camera) if options.refine_camera else calibrated_camera
    if not task.board.rows:
        labelled = as_one_group(labelled)
    observations = [image.observations for image in labelled]
    board_alone = options.board_only or is_board_alone(detection)
    if board_alone and options.solve == "joint":  # which adjusts faces, and there are none
        options = replace(options, solve="chain", refine_camera=False)
    board = with_edge_sigma(task.board, observations)
    known = faces_of_known_shape(board)
    groups, unusable = usable_groups(
        by_group(observations), detection.skipped, board_alone, needs_board=not target.has_scale
    )

    progress("map", 0, len(groups))
    graph = image_graph(observations, board)
    usable = [image for image in observations if image.group in groups]
    circles = [face for face in target.with_faces(printed=False).faces if len(face.ids) >= MIN_CORNERS]

    def solve(camera: Camera, names: Collection[str]) -> tuple[list[GroupSolution], list[str]]:
        if known and not board_alone:
            body = place_with_camera(usable, (*known, *circles), camera)
            found, notes = solve_body(usable, body, camera, target, board, options.eccentricity, progress)
            return found, notes + body.unlinked_notes()
        scratch = folder.stage / "scratch"
        return solve_groups(observations, graph, scratch, folder.cache, camera, target, board, options, progress, names)

    adjust_options, prior = options.adjustment(target), camera_prior(calibrated_camera)

    def adjust_all(of: Sequence[GroupSolution]) -> Calibration:
        models = [s.model for s in of]
        if board_alone:
            return calibrate_board(models, calibrated_camera, board, adjust_options)
        return calibrate(models, calibrated_camera, target, board, adjust_options, prior, progress)

    with nullcontext() if options.refine_camera else explained(usable, calibrated_camera, board):
        solutions, unsolved = solve(calibrated_camera, groups)
        if board_alone:
            progress("faces", 0, 1)
        calibration = adjust_all(solutions)
    if board_alone:
        progress("faces", 1, 1)
    elif doubted := {s.model.group for s in solutions if s.outliers and options.refine_camera}:
        # What disagrees with the others by the first camera may agree by the refined one.
        with suppress(StcalError):
            again = {s.model.group: s for s in solve(calibration.camera, doubted)[0]}
            refined = [again.get(s.model.group, s) for s in solutions]
            calibration, solutions = adjust_all(refined), refined
    return RunResult(
        out=folder.out,
        camera=calibrated_camera,
        target_design=target,
        board_design=board,
        options=options,
        detection=detection,
        labelled=tuple(labelled),
        graph=graph,
        solutions=tuple(solutions),
        calibration=calibration,
        chains=measure_chains(calibration.faces, calibration.target),
        notes=(
            *(ungrouped(labelled) if board.rows else ()),
            *unknown_face_notes({image.file.group for image in detection.images}, target),
            *unusable,
            *unsolved,
            *calibration.notes,
            *not_as_drawn(calibration.target.target_from_face, target, bool(board.rows) and set(groups) == {TOP_GROUP}),
            *(misnamed_groups(observations, target) if board.rows else ()),
            *(misplaced_images(observations, {i.observations.name: i.notes for i in labelled}, target)),
            *unseen_board(solutions, board),
            *unseen_circles(solutions, target),
        ),
    )


def as_one_group(labelled: Sequence[LabelledImage]) -> list[LabelledImage]:
    """Returns the images as one group: without a board nothing but the body is used, whatever stands beside it."""
    return [replace(image, observations=replace(image.observations, group=TOP_GROUP)) for image in labelled]


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
    DetectedImages
        ``images`` has the labelled circles by name of the image, px; ``notes`` what was left out.

    Raises
    ------
    InputError
        An input cannot be used, or the folder holds a finished calibration.
    """
    if out is None:
        with scratch_folder("detect") as scratch:
            return detect_images(images, camera, scratch, target, board, options, progress)
    options, progress = options or RunOptions(), progress or (lambda *_: None)
    target_design = target_of(target)
    has_none = board is None and target_design.has_scale
    board_design = scale_reference(None, target_design) if has_none else board_of(board)
    require_no_calibration(out)
    if isinstance(images, Mapping):
        files, place = files_of_arrays(images, options.exclude), IN_MEMORY
    else:
        files, place = chosen_images(images, options.exclude), images
    model = None if camera is None else camera_model(camera)
    given = {"images": place, "--camera": camera, "--target": target, "--board": board}
    with run_folder(out, MarkerFile.of(place, None), given) as folder:
        return _detected(Task(files, folder, target_design, board_design, options, progress), model)


def _detected(task: Task, model: CameraModel | None) -> DetectedImages:
    """Detects and labels the images, and writes ``detections.csv`` and overlays into the folder."""
    notes = []
    if model is None:
        model, told = _camera_for_a_look(task)
        if task.target.with_faces(printed=False).faces:
            notes.append(FOUND_BY_DOTS.format(model.focal[0]) if told else ASSUMED)
    detection, labelled = labelled_images(task, model)
    if unseen := _why_unseen(task, labelled):
        notes.append(unseen)
    with overlays_beside(detection, labelled, task.target, task.folder, task.progress):
        return DetectedImages(detection, tuple(labelled), tuple(notes))
