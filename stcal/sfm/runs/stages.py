"""The stages of a run that lead to solved groups: detect and label, with the camera to begin with; and map, group by
group, each of which is cached by its inputs."""

import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from stcal.boards.finders import why_unseen
from stcal.design import BoardDesign, TargetDesign, faces_of_known_shape, scale_reference, with_drawn_size
from stcal.errors import (
    ConvergenceError,
    DegenerateError,
    DetectionError,
    InputError,
    MappingError,
    ScaleError,
    StcalError,
)
from stcal.geometry.arrays import Brief
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cache import keep, kept, made_by
from stcal.io.cameras.camera_model import CameraModel, model_of, refinable
from stcal.io.cameras.read import camera_of_photograph
from stcal.io.images import HOLDS_IMAGES, SUFFIXES, TOP_GROUP, ImageFile, ImageFiles, Skipped, require_common_size
from stcal.labels import DotLabel, parse_labels, unseen_lines
from stcal.parallel import Progress, counted, run_in_order
from stcal.report.text import significant
from stcal.sfm.adjust.refine import Refined, find_scale, refine, with_edge_sigma
from stcal.sfm.camera.calibrate import camera_of_dots, camera_of_labelled, weighted_rms_px
from stcal.sfm.camera.intrinsics import start_camera
from stcal.sfm.checks.significance import MOVED, MOVED_REMEDY, moved_apart
from stcal.sfm.checks.suite import EXPLAINS, cause_of_file
from stcal.sfm.data.group_model import BOARD_LEFT_OUT, ImageObservations, Note, Outlier, WorldModel, by_group
from stcal.sfm.detect.detect_files import PHOTOGRAPHS, DetectionResult, detect_files, require_upright, seen_by
from stcal.sfm.detect.labelling import Detection, LabelledImage, is_board_alone, label_boards, label_images, label_once
from stcal.sfm.detect.published import PublishedPattern, detect_published
from stcal.sfm.mapping.body import LENS, MIN_CORNERS, map_body, place_and_find_camera, place_with_camera, unknown_lens
from stcal.sfm.mapping.database import image_ids, write_database
from stcal.sfm.mapping.incremental import Mapping, left_out, map_group
from stcal.sfm.mapping.pairs import ImageGraph, PairOptions, PairScore, image_graph, pair_of_model, rank_pairs
from stcal.sfm.report.check import Check
from stcal.sfm.runs.run_options import RunOptions, is_vague, require_dots
from stcal.sfm.runs.transaction import RunFolder

CACHE_VERSION = 9
LEAST_WITHOUT, MOST_WITHOUT = 3, 40  # one that contradicts is sought in groups of more than 3 and up to 40 images
UNSOLVED = (MappingError, ScaleError, ConvergenceError, DegenerateError)  # a group has no solution, others may
LIKELY = "; the likely cause: "  # then what the photographs that cannot be solved have in common
_ARRAYS = ("xyz_model", "image_index", "point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")
S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What all stages of a run work on."""

    files: ImageFiles
    folder: RunFolder  # claimed
    target: TargetDesign
    board: BoardDesign  # without rows where there is none
    options: RunOptions
    progress: Progress
    camera: CameraModel | None = None  # as given
    photographs: Path | str = ""  # the folder that they are in

    @property
    def camera_given(self) -> bool:
        """False if the camera is found from the photographs, also where its file is only a start of that."""
        return self.camera is not None and not (self.options.refine_camera and is_vague(self.camera))

    def named(self, words: str) -> "Task":
        """Returns the task with other words for its stages, of which ``{}`` is the own name."""
        return replace(self, progress=lambda stage, *count: self.progress(words.format(stage), *count))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectedImages(Brief):
    """The circles and corners of all images.

    ``detection`` : what was measured, and the images ``skipped``; ``labelled`` : images with their labels, in the
    database's order; ``camera`` : with which they were detected; ``notes`` : on the camera, and on what no image shows.
    """

    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    camera: CameraModel
    notes: tuple[str, ...] = ()

    @property
    def observations(self) -> list[ImageObservations]:
        """Labelled centres of all images."""
        return [image.observations for image in self.labelled]

    @property
    def images(self) -> dict[str, Detection]:
        """Labels, centres and covariances, px, by the name of the image."""
        return {
            seen.name: Detection(seen.labels, seen.centre_px, seen.covariance_px2, tuple(image.notes))
            for image, seen in zip(self.labelled, self.observations, strict=True)
        }


def detect_and_label(task: Task) -> DetectedImages:
    """Detects and labels with the camera given, or with the one that printed faces, or the board's dots, determine."""
    camera, printed = task.camera, task.target.with_faces(printed=True)
    if camera is None and printed.faces:
        faces_alone = replace(task, target=printed, board=scale_reference(None, printed))
        guesses = guessed_cameras(task.files[0])
        seen = detect_with(faces_alone, model_of(guesses[0], PHOTOGRAPHS))
        if not any(image.face_ids() for image in seen.observations):
            return seen  # :func:`scaled_by_drawing` refuses it
        found = place_and_find_camera(seen.observations, printed.faces, guesses).camera
        if not task.board.rows and len(printed.faces) == len(task.target.faces):  # all was measured already
            return _labelled(task, seen_by(seen.detection, found, task.target), model_of(found, PHOTOGRAPHS))
        camera = model_of(found, PHOTOGRAPHS)
    elif camera is None or (task.board.rows and not task.camera_given):
        camera = camera_by_dots(task, camera)
    return detect_with(task, camera)


def detect_with(task: Task, camera: CameraModel) -> DetectedImages:
    """Detects and labels the images by the rules that the options ask for."""
    (chosen, skipped), target, options = task.files, task.target, task.options
    step = counted(task.progress, "detect", len(chosen))
    dots, detector = task.board if task.board.rows else None, None
    if options.solve == "paper":
        require_dots(dots, "--solve paper")
        PublishedPattern(target)
        detector = detect_published
    how = options.ellipses, task.folder.cache, options.workers
    detection = detect_files(chosen, camera, target, dots, *how, step, detector)
    detection = replace(detection, skipped=(*skipped, *detection.skipped))
    require_upright(detection.images, task.board)
    return _labelled(task, detection, camera)


def _labelled(task: Task, detection: DetectionResult, camera: CameraModel) -> DetectedImages:
    target, options, dots = task.target, task.options, task.board if task.board.rows else None
    if dots is not None and (options.board_only or is_board_alone(detection)):
        labelled = label_boards(detection, target, dots)
    elif options.solve == "paper":
        labelled = label_once(detection, target, dots)
    else:
        labelled = label_images(detection, target, dots, options.ellipses, task.folder.cache, options.workers)
    return DetectedImages(detection, tuple(labelled), camera)


def camera_by_dots(task: Task, rough: CameraModel | None) -> CameraModel:
    """Returns the camera calibrated from the dots of the board, with the weak prior of an unknown lens."""
    files = task.files[0]
    start = guessed_cameras(files)[0] if rough is None else rough.calibrated(*require_common_size(files)[0])
    seen = detect_with(task.named("{} for the camera"), model_of(start, PHOTOGRAPHS))
    return model_of(unknown_lens(camera_of_dots(files, seen.detection, task.board, start, LENS).camera), PHOTOGRAPHS)


def guessed_cameras(files: Sequence[ImageFile]) -> list[Camera]:
    """Returns where the search for a camera begins: at the first EXIF that states one, or a medium focal length."""
    (width, height), _ = require_common_size(list(files))
    for file in files:
        with suppress(InputError):
            camera, _ = camera_of_photograph(file.path)
            if (camera.width, camera.height) == (width, height):
                return [camera]
    return [Camera.of(start_camera(width, height, LENS), LENS)]


def unseen_faces(task: Task, seen: DetectedImages) -> str:
    """Returns that no printed face of the target is seen, and which tags are; empty if one is, or none is printed."""
    printed = task.target.with_faces(printed=True).faces
    faces = {face for image in seen.observations for face in image.face_ids()}
    return why_unseen(task.files[0], printed) if printed and faces.isdisjoint(face.id for face in printed) else ""


def scaled_by_drawing(task: Task, seen: DetectedImages, board_given: bool) -> Task:
    """Returns the task, in the unit of the drawing if nothing of known size is seen; refuses unseen printed faces."""
    if task.options.board_only:
        return task
    is_seen = any(image.face_ids() for image in seen.observations)
    if not is_seen and (unseen := unseen_faces(task, seen)):
        raise DetectionError("E-TARGET-UNSEEN", unseen)
    if board_given or task.target.has_scale:
        return task
    labels = [image.labels for image in seen.observations]
    if any(isinstance(label, DotLabel) for of_image in labels for label in of_image):
        return task
    target = with_drawn_size(task.target, labels)
    return replace(task, target=target, board=scale_reference(None, target))


@dataclass(frozen=True, slots=True, eq=False)
class GroupSolution:
    """Solution of one group in a world without unit."""

    pairs: tuple[PairScore, ...]  # the ranking, the chosen pair first; without poses
    model: WorldModel
    seeded: str  # how the pair was registered
    rounds: int  # of refinement
    left_out: dict[str, str]  # reason by image
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """The images by the groups in which they are solved, and their solutions."""

    labelled: tuple[LabelledImage, ...]
    names: tuple[str, ...]  # of the groups that can be solved
    graph: ImageGraph  # of all images
    camera: Camera  # with which their solution begins
    board: BoardDesign  # with the σ of its printed edges
    options: RunOptions
    board_alone: bool
    notes: tuple[str, ...]  # on groups that cannot be solved
    solutions: tuple[GroupSolution, ...] = ()
    unsolved: tuple[str, ...] = ()  # notes on groups that were not

    @property
    def observations(self) -> list[ImageObservations]:
        return [image.observations for image in self.labelled]

    @property
    def usable(self) -> list[ImageObservations]:
        """Labelled centres of the images whose groups can be solved."""
        return [image for image in self.observations if image.group in self.names]

    def naming_cause(self) -> AbstractContextManager[None]:
        """Lets errors name what of the camera file is wrong, unless the file is a start alone."""
        return nullcontext() if self.options.refine_camera else explained(self.usable, self.camera, self.board)

    def assumed_notes(self) -> list[str]:
        """Returns a note on the assumption about images that lie in no folder of a group, if there are any."""
        images = [image for image in self.labelled if image.observations.group == TOP_GROUP]
        lost = [i.observations.name for i in images if any(getattr(n, "code", "") == BOARD_LEFT_OUT for n in i.notes)]
        one = f"{len(images)} images that lie in no folder of a group are one group, in which only the camera moved"
        elsewhere = f"the board of {len(lost)} of them ({_listed(lost)}) is elsewhere and was left out"
        remark = f"; {elsewhere}, so that they are more than one group" if lost else ""
        remedy = "put the images of each setting of target and board into a folder of its own, IMAGES/<group>/"
        return [f"assumed: {one}{remark}; {remedy}"] if images else []

    def unseen_notes(self, target: TargetDesign) -> list[str]:
        """Returns notes on rows and columns of the board, and on circles or corners of the faces in the result, that no
        image shows as the designs have them."""
        mapped = {label for solution in self.solutions for label in solution.model.labels}
        dots = (label for label in mapped if isinstance(label, DotLabel))
        faces = {label.plane for label in mapped}
        every = (label for face in target.faces if face.id in faces for label in face.labels())
        missing = [str(label) for label in every if label not in mapped]
        them = "it" if len(missing) == 1 else "them"
        what = f"{_listed(missing)}: not in the result, as too few images show {them} as drawn"
        note = f"{what}; check their design in target.toml, unless something hides it"
        return [*unseen_lines(dots, self.board.rows, self.board.columns), *([note] if missing else [])]


def groups_of(task: Task, seen: DetectedImages) -> Groups:
    """Returns the groups that can be solved; without a board all images are one, and a board alone is chained."""
    options, labelled = task.options, seen.labelled
    if not task.board.rows:
        labelled = tuple(replace(i, observations=replace(i.observations, group=TOP_GROUP)) for i in labelled)
    observations = [image.observations for image in labelled]
    board_alone = options.board_only or is_board_alone(seen.detection)
    if board_alone and options.solve == "joint":
        options = replace(options, solve="chain", refine_camera=False)
    board = with_edge_sigma(task.board, observations)
    camera = start_of(seen.camera, seen.detection.camera, task.options)
    needs_board = not task.target.has_scale
    usable, notes = usable_groups(by_group(observations), seen.detection.skipped, board_alone, needs_board)
    task.progress("map", 0, len(usable))
    graph = image_graph(observations, board)
    return Groups(labelled, tuple(usable), graph, camera, board, options, board_alone, tuple(notes))


def start_of(model: CameraModel, sized: Camera, options: RunOptions) -> Camera:
    """Returns the camera with which a solution of the images begins."""
    camera = model.calibrated(sized.width, sized.height)
    return refinable(camera) if options.refine_camera else camera


def map_groups(task: Task, groups: Groups, names: Collection[str] = ()) -> Groups:
    """Maps and refines the groups, or some: by the mapper, or by faces of known shape, which place the whole body."""
    solve = _solve_body if faces_of_known_shape(groups.board) and not groups.board_alone else _solve_groups
    with groups.naming_cause():
        solutions, unsolved = solve(task, groups, names or groups.names)
    return replace(groups, solutions=tuple(solutions.values()), unsolved=tuple(unsolved))


def _each_group(names: Iterable[str], solve: Callable[[str], S]) -> tuple[dict[str, S], list[str]]:
    """Returns the solutions by group, and notes on the others; raises the first error if no group has one."""
    solutions: dict[str, S] = {}
    errors: list[tuple[str, StcalError]] = []
    for name in names:
        try:
            solutions[name] = solve(name)
        except UNSOLVED as error:
            errors.append((name, error))
    if not solutions:
        raise errors[0][1]
    return solutions, [Note.of_group(name, error) for name, error in errors]


def usable_groups(
    groups: dict[str, list[ImageObservations]],
    skipped: Sequence[Skipped],
    board_alone: bool = False,
    needs_board: bool = True,
) -> tuple[dict[str, list[ImageObservations]], list[str]]:
    """Returns the groups that can be solved, and the reasons why others cannot, before anything is mapped."""
    lost: dict[str, Skipped] = {}  # the first file of each group; a folder that holds only copies is not a group
    for file in skipped:
        group = file.name.rpartition("/")[0] or TOP_GROUP
        if file.name.lower().endswith(SUFFIXES) and (group in groups or file.gate != "copy"):
            lost.setdefault(group, file)

    def usable(name: str) -> list[ImageObservations]:
        group = groups.get(name, [])
        if len(group) < 2:
            count = f"1 usable image ({group[0].name})" if group else "0 usable images"
            why = f", not {lost[name].name}: {lost[name].reason}" if name in lost else ""
            remedy = "add photographs from other places"
            raise MappingError("E-GROUP-FEW-IMAGES", f"group {name}: {count}, 2 needed{why}; {remedy}")
        if not board_alone and not any(image.face_ids() for image in group):
            fault = f"group {name}: no face of the target recognised in {len(group)} images"
            remedy = "look at the overlays, check target.toml (radii, polarity) and the exposure"
            raise MappingError("E-GROUP-NO-FACE", f"{fault}; {remedy}; for the board alone, use --board-only")
        if needs_board and not any(isinstance(label, DotLabel) for image in group for label in image.labels):
            keys = "rows, columns, sizes; radius and polarity of dots, dictionary and ids of tags"
            fault = f"group {name}: no board recognised in {len(group)} images"
            remedy = f"keep the whole board in view, check board.toml ({keys})"
            raise MappingError("E-GROUP-NO-BOARD", f"{fault}; {remedy}")
        return group

    try:
        return _each_group(sorted(groups.keys() | lost.keys()), usable)
    except MappingError as error:
        error.append("".join([f"; {file.name}: {file.reason}" for file in skipped if HOLDS_IMAGES in file.reason][:1]))
        raise


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + " …" * (len(names) > 6)


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """A group and all that its solution depends on."""

    images: list[ImageObservations]
    skeleton: list[str]  # names of the images that are mapped first, among which the initial pair is chosen
    matched: np.ndarray  # (n, 2) indices of images to match, in the group
    camera: Camera
    target: TargetDesign
    board: BoardDesign
    pair_options: PairOptions
    eccentricity: bool

    def key(self) -> str:
        """Returns a hash of all inputs of the solution. It does not depend on other groups."""
        hasher = hashlib.sha256()
        for image in self.images:
            hasher.update(f"{image.name}\0{image.labels}\0".encode())
            hasher.update(image.centre_px.tobytes() + image.covariance_px2.tobytes())
        hasher.update(self.matched.astype("<i8").tobytes())
        camera = [self.camera.width, self.camera.height, self.camera.parameters()]
        designs = map(asdict, (self.target.patterns_alone(), self.board, self.pair_options))
        plain = [CACHE_VERSION, made_by(), self.skeleton, camera, *designs, self.eccentricity]
        hasher.update(json.dumps(plain, default=lambda v: v.tolist() if isinstance(v, np.ndarray) else str(v)).encode())
        return hasher.hexdigest()[:40]


def _solve_groups(task: Task, groups: Groups, names: Collection[str]) -> tuple[dict[str, GroupSolution], list[str]]:
    """Maps and refines each group, or takes up what an earlier run kept; returns solutions, and notes on others."""
    images, options, graph = groups.observations, groups.options, groups.graph
    inputs = {}
    for name, of_group in by_group(images).items():
        if name in names:
            within = np.array([image.group == name for image in images])
            pairs = (np.cumsum(within) - 1)[graph.pairs[within[graph.pairs].all(1)]]
            skeleton = [images[i].name for i in graph.skeleton[name]]
            how = groups.camera, task.target, groups.board, options.pairs, options.eccentricity
            inputs[name] = _Group(of_group, skeleton, pairs, *how)
    paths = {name: task.folder.cache / f"group-{group.key()}.npz" for name, group in inputs.items()}
    found: dict[str, GroupSolution | StcalError | None] = {name: kept(path, _stored) for name, path in paths.items()}
    pending = [name for name, solution in found.items() if solution is None]
    step = counted(task.progress, "map", len(inputs))
    for _ in range(len(inputs) - len(pending)):
        step(None)
    scratch = task.folder.stage / "scratch"
    scratch.mkdir()
    try:
        jobs = [(inputs[name], scratch / f"{k}.db") for k, name in enumerate(pending)]
        for name, solution in zip(pending, run_in_order(_solved, jobs, 1, lambda done, _: step(done)), strict=True):
            found[name] = solution
            if isinstance(solution, GroupSolution):
                _save(paths[name], solution)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)

    def with_scale(name: str) -> GroupSolution:
        solution = found[name]
        if not isinstance(solution, GroupSolution):
            raise solution or KeyError(name)
        find_scale(solution.model, groups.board)  # raises ScaleError where nothing tells the size
        return solution

    return _each_group(inputs, with_scale)


def _solved(group: _Group, database: Path) -> GroupSolution | StcalError:
    """Solves one group with a database of its own, which is written; returns why it has no solution."""
    images, camera, board = group.images, group.camera, group.board
    try:
        first = [image for image in images if image.name in group.skeleton]
        pairs = rank_pairs(first, camera, group.pair_options, board)
        write_database(database, camera, images, group.matched)
        mapping = map_group(database, images, group.skeleton, image_ids(images), pairs, camera)
        refined = refine_or_explain(mapping.model, camera, group.target, board, group.eccentricity)
    except UNSOLVED as error:
        return error
    return _solution(images, mapping, refined, [replace(p, second_from_first=None) for p in pairs])


def _solution(
    images: Sequence[ImageObservations], mapping: Mapping, refined: Refined, pairs: Sequence[PairScore]
) -> GroupSolution:
    """Returns the solution of a group that was mapped in any way."""
    missing = left_out([i for i in images if i.name not in mapping.left_out], refined.model, mapping.remedy)
    outliers = *mapping.outliers, *refined.outliers
    reasons = mapping.left_out | missing
    return GroupSolution(tuple(pairs), refined.model, mapping.seeded, refined.rounds, reasons, outliers)


def _save(path: Path, solution: GroupSolution) -> None:
    model = solution.model
    poses = np.stack([pose.matrix() for pose in model.camera_from_model])
    plain = {f.name: getattr(solution, f.name) for f in fields(solution) if f.name != "model"}
    plain |= {"pairs": [asdict(pair) for pair in solution.pairs], "outliers": [asdict(o) for o in solution.outliers]}
    names = [model.group, model.images, model.labels]
    keep(path, {"poses": poses} | {name: getattr(model, name) for name in _ARRAYS}, {"solution": plain, "names": names})


def _stored(stored, meta) -> GroupSolution:
    """Returns the solution that is kept in arrays and metadata."""
    (group, images, labels), plain = meta["names"], meta["solution"]
    poses = tuple(Rigid(m[:3, :3], m[:3, 3]) for m in stored["poses"])
    arrays = {name: stored[name] for name in _ARRAYS}
    plain["pairs"] = tuple(PairScore(**pair) for pair in plain["pairs"])
    plain["outliers"] = tuple(Outlier(**outlier) for outlier in plain["outliers"])
    return GroupSolution(model=WorldModel(group, tuple(images), poses, parse_labels(labels), **arrays), **plain)


def _solve_body(task: Task, groups: Groups, _: Collection[str]) -> tuple[dict[str, GroupSolution], list[str]]:
    """Places the body by its faces, and maps and refines its groups; returns solutions, and notes on others."""
    camera, board, eccentricity = groups.camera, groups.board, groups.options.eccentricity
    circles = [face for face in task.target.with_faces(printed=False).faces if len(face.ids) >= MIN_CORNERS]
    body = place_with_camera(groups.usable, (*faces_of_known_shape(board), *circles), camera)
    images = by_group(groups.usable)
    step = counted(task.progress, "map", len(images))

    def solved(name: str) -> GroupSolution:
        try:
            mapping = map_body(body, images[name], camera)
            refined = refine_or_explain(mapping.model, camera, task.target, board, eccentricity)
            find_scale(refined.model, board)  # raises ScaleError where nothing tells the size
        finally:
            step(None)
        return _solution(images[name], mapping, refined, [pair_of_model(refined.model)])

    solutions, notes = _each_group(images, solved)
    return solutions, notes + body.unlinked_notes()


def refine_or_explain(
    model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign, eccentricity: bool = True
) -> Refined:
    """Refines a group, as :func:`stcal.sfm.adjust.refine.refine`; its errors say if target and board moved apart."""
    try:
        return refine(model, camera, target, board, eccentricity)
    except (MappingError, ConvergenceError) as error:
        if (image := _odd_one_out(model, camera, target, board, eccentricity)) is not None:
            fault = f"group {model.group}: {image} contradicts the others, which agree without it"
            remedy = f"leave it out, with --exclude {image}, or take it again"
            raise MappingError(error.code, f"{fault}; {remedy}") from error
        if moved_apart(model, camera, target, board):
            agree = "the circles of the faces agree with one another, and the dots of the board do"
            error.append(f"{LIKELY}{MOVED}, as {agree}: {MOVED_REMEDY}")
        raise


def _odd_one_out(model: WorldModel, *arguments) -> str | None:
    """Returns the one image without which a group can be refined; None if there is none, or more than one."""
    cures: list[str] = []
    for k, image in enumerate(model.images if LEAST_WITHOUT < len(model.images) <= MOST_WITHOUT else ()):
        with suppress(MappingError, ConvergenceError, DegenerateError):
            refine(model.without(model.image_index == k), *arguments)
            cures.append(image)
        if len(cures) > 1:
            break
    return cures[0] if len(cures) == 1 else None


def wrong_file(images: Sequence[ImageObservations], camera: Camera, board: BoardDesign) -> Check | None:
    """Returns a failed check that names what of a camera file is wrong by the dots of the board alone."""
    if not board.rows:
        return None
    try:
        found, stated = camera_of_labelled(images, board, camera)
    except StcalError:
        return None
    square, square_of_file = (weighted_rms_px(each) ** 2 for each in (found, stated))
    if square > (1 - EXPLAINS) * square_of_file:
        return None
    if (cause := cause_of_file(camera, found.camera, found.covariance, found.colmap_model)) is None:
        return None
    rms = f"{significant(square**0.5)} px RMS from where the board has them, {significant(square_of_file**0.5)} px"
    return replace(cause, reason=f"{cause.reason}; by the dots of the board alone, which are {rms} with the file")


@contextmanager
def explained(images: Sequence[ImageObservations], camera: Camera, board: BoardDesign) -> Iterator[None]:
    """Lets errors of a run that cannot be solved name what of the camera file is wrong, if the board tells it."""
    try:
        yield
    except UNSOLVED as error:
        if LIKELY not in str(error) and (cause := wrong_file(images, camera, board)):
            error.append(f"{LIKELY}{cause.cause} ({cause.reason}): {cause.remedy}")
        raise
