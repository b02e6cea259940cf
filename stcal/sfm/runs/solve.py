"""The first stages of a run: detection in all images, and the solution of each group, which is cached by its inputs."""

import hashlib
import json
import shutil
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from stcal.boards.design import CornerBoard
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, InputError, MappingError, ScaleError, StcalError
from stcal.geometry.arrays import Brief
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cache import keep, kept, made_by
from stcal.io.cameras.model import CameraModel
from stcal.io.files import save
from stcal.io.images import HOLDS_IMAGES, SUFFIXES, TOP_GROUP, ImageFiles, Skipped
from stcal.labels import DotLabel, parse_labels, unseen_lines
from stcal.parallel import Progress, counted, run_in_order
from stcal.report.text import significant
from stcal.sfm.adjust.refine import Refined, refine
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.camera.calibrate import camera_of_labelled, weighted_rms_px
from stcal.sfm.checks.causes import EXPLAINS, cause_of_file
from stcal.sfm.checks.significance import MOVED, MOVED_REMEDY, Check, moved_apart
from stcal.sfm.data.model import ImageObservations, Outlier, WorldModel, by_group, detections_csv
from stcal.sfm.data.note import BOARD_LEFT_OUT, Note
from stcal.sfm.data.patterns import pitch_hint
from stcal.sfm.detect.files import DetectionResult, detect_files, require_upright
from stcal.sfm.detect.labelling import (
    Detection,
    LabelledImage,
    is_board_alone,
    label_boards,
    label_images,
    label_once,
)
from stcal.sfm.detect.published import PublishedPattern, detect_published
from stcal.sfm.mapping.database import image_ids, write_database
from stcal.sfm.mapping.incremental import left_out, map_group
from stcal.sfm.mapping.pairs import ImageGraph, PairOptions, PairScore, rank_pairs
from stcal.sfm.mapping.placed import BY_FACES, PlacedBody, model_of_body, pair_of_model
from stcal.sfm.runs.options import RunOptions, unknown_faces
from stcal.sfm.runs.transaction import RunFolder


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectedImages(Brief):
    """The circles and corners of all images.

    ``detection`` : what was measured, and the images ``skipped``; ``labelled`` : images with their labels, in the
    database's order; ``notes`` : on the camera, and on what no image shows.
    """

    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    notes: tuple[str, ...]

    @property
    def images(self) -> dict[str, Detection]:
        """Labels, centres and covariances, px, by the name of the image."""
        return {
            (seen := image.observations).name: Detection(
                seen.labels, seen.centre_px, seen.covariance_px2, tuple(image.notes)
            )
            for image in self.labelled
        }


def require_no_calibration(out: str | Path) -> None:
    """Refuses a folder for detections that holds a finished calibration."""
    if (Path(out) / "faces.json").exists():
        raise InputError(
            "E-OUTPUT-EXISTS", f"output folder {out}: holds a finished calibration; give another folder with --out"
        )


def require_dots(board: BoardDesign | None, option: str) -> None:
    """Refuses a board of corners for an option whose method finds dots."""
    if isinstance(board, CornerBoard):
        raise InputError(
            "E-OPTION-CONFLICT", f"{option}: finds boards of dots, and --board is one of squares or tags; leave it out"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """The subject of all stages of a run."""

    files: ImageFiles
    folder: RunFolder  # claimed
    target: TargetDesign
    board: BoardDesign  # without rows where there is none
    options: RunOptions
    progress: Progress


def labelled_images(task: Task, camera: CameraModel) -> tuple[DetectionResult, list[LabelledImage]]:
    """Detects and labels the images, and writes ``detections.csv`` into the folder."""
    detection, labelled = detected_images(task, camera)
    save(task.folder.stage / "detections.csv", detections_csv([image.observations for image in labelled]))
    return detection, labelled


def detected_images(task: Task, camera: CameraModel) -> tuple[DetectionResult, list[LabelledImage]]:
    """Detects and labels the images by the rules that the options ask for."""
    (chosen, skipped), target, options, cache = task.files, task.target, task.options, task.folder.cache
    step = counted(task.progress, "detect", len(chosen))
    dots = task.board if task.board.rows else None
    published = options.solve == "paper"
    if published:
        require_dots(dots, "--solve paper")
        PublishedPattern.of(target)
    detector = detect_published if published else None
    detection = detect_files(chosen, camera, target, dots, options.ellipses, cache, options.workers, step, detector)
    detection = replace(detection, skipped=(*skipped, *detection.skipped))
    require_upright(detection.images, task.board)
    if dots is not None and (options.board_only or is_board_alone(detection)):
        return detection, label_boards(detection, target, dots)
    if published:
        return detection, label_once(detection, target, dots)
    return detection, label_images(detection, target, dots, options.ellipses, cache, options.workers)


CACHE_VERSION = 7
LEAST_WITHOUT, MOST_WITHOUT = 3, 40
"""Number of images of a group above which, and up to which, one that contradicts the others is looked for."""
FEW_NAMED = 6
SHOW_MORE = "show two faces of it at once, or one by more corners"
_ARRAYS = ("xyz_model", "image_index", "point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")


@dataclass(frozen=True, slots=True, eq=False)
class GroupSolution:
    """Solution of one group in a world without unit."""

    pairs: tuple[PairScore, ...]  # the ranking, the chosen pair first
    model: WorldModel
    seeded: str  # how the pair was registered
    rounds: int  # of refinement
    left_out: dict[str, str]  # reason by image
    outliers: tuple[Outlier, ...]


def usable_groups(
    groups: dict[str, list[ImageObservations]],
    skipped: Sequence[Skipped],
    board_alone: bool = False,
    needs_board: bool = True,
) -> tuple[dict[str, list[ImageObservations]], list[str]]:
    """Returns the groups that can be solved, and the reasons why others cannot, before anything is mapped."""
    lost: dict[str, list[Skipped]] = {}
    for file in skipped:
        # A folder that holds only copies is not a group.
        group = file.name.rpartition("/")[0] or TOP_GROUP
        if file.name.lower().endswith(SUFFIXES) and (group in groups or file.gate != "copy"):
            lost.setdefault(group, []).append(file)
    usable: dict[str, list[ImageObservations]] = {}
    errors: list[tuple[str, MappingError]] = []
    for name in sorted(groups.keys() | lost.keys()):
        group, first = groups.get(name, []), lost.get(name, [])[:1]
        try:
            if len(group) < 2:
                count = f"1 usable image ({group[0].name})" if group else "0 usable images"
                why = "".join(f", not {s.name}: {s.reason}" for s in first)
                remedy = "add photographs from other places"
                if name == TOP_GROUP and group and len(groups) > 1:
                    others = _listed(g for g in groups if g != TOP_GROUP)
                    remedy = (
                        f"it lies beside the folders of groups ({others}): move it into the one it belongs to, or "
                        f"leave it out with --exclude {group[0].name}"
                    )
                raise MappingError("E-GROUP-FEW-IMAGES", f"group {name}: {count}, 2 needed{why}; {remedy}")
            require_usable(group, board_alone, needs_board)
        except MappingError as error:
            errors.append((name, error))
        else:
            usable[name] = group
    if not usable:
        deeper = [f"; {file.name}: {file.reason}" for file in skipped if HOLDS_IMAGES in file.reason]
        errors[0][1].append("".join(deeper[:1]))
        raise errors[0][1]
    return usable, [Note.of_group(name, error) for name, error in errors]


def ungrouped(labelled: Sequence[LabelledImage]) -> list[str]:
    """Returns a note on the assumption about images that lie in no folder of a group, if there are any."""
    images = [image for image in labelled if image.observations.group == TOP_GROUP]
    if not images:
        return []
    dropped = [
        image.observations.name
        for image in images
        if any(isinstance(note, Note) and note.code == BOARD_LEFT_OUT for note in image.notes)
    ]
    remark = (
        f"; the board of {len(dropped)} of them ({_listed(dropped)}) is elsewhere and was left out, so that they are "
        "more than one group"
        if dropped
        else ""
    )
    return [
        f"assumed: {len(images)} images that lie in no folder of a group are one group, in which only the camera "
        f"moved{remark}; put the images of each setting of target and board into a folder of its own, IMAGES/<group>/"
    ]


def unknown_face_notes(groups: Iterable[str], target: TargetDesign) -> list[str]:
    """Returns notes on faces that groups are named after and the target does not have."""
    known = ", ".join(face.id for face in target.faces)
    return [
        f"group {group} seems to be named after face {face}, which the target does not have (faces {known}): add it to "
        "target.toml, or rename the folder"
        for face, group in unknown_faces(groups, target).items()
    ]


def _listed(names: Iterable[str], most: int = 4) -> str:
    all_names = list(names)
    return ", ".join(all_names[:most]) + (", …" if len(all_names) > most else "")


def require_usable(group: list[ImageObservations], board_alone: bool = False, needs_board: bool = True) -> None:
    """Refuses a group that cannot be solved: without a needed board, or without a face."""
    where = f"group {group[0].group}"
    if not board_alone and not any(image.face_ids() for image in group):
        raise MappingError(
            "E-GROUP-NO-FACE",
            f"{where}: no face of the target recognised in {len(group)} images; look at the overlays, "
            "check target.toml (radii, polarity) and the exposure; for the board alone, use --board-only",
        )
    if needs_board and not any(isinstance(label, DotLabel) for image in group for label in image.labels):
        raise MappingError(
            "E-GROUP-NO-BOARD",
            f"{where}: no board recognised in {len(group)} images; keep the whole board in view, "
            "check board.toml (rows, columns, sizes; radius and polarity of dots, dictionary and ids of tags)",
        )


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
        plain = [
            CACHE_VERSION,
            made_by(),
            self.skeleton,
            [self.camera.width, self.camera.height, self.camera.parameters()],
            asdict(self.target.patterns_alone()),
            asdict(self.board),
            asdict(self.pair_options),
            self.eccentricity,
        ]
        hasher.update(json.dumps(plain, default=lambda v: v.tolist() if isinstance(v, np.ndarray) else str(v)).encode())
        return hasher.hexdigest()[:40]


def _solved(group: _Group, scratch: Path) -> GroupSolution | StcalError:
    """Solves one group with a database of its own in a folder that is made; returns why it has no solution."""
    images, camera, board = group.images, group.camera, group.board
    scratch.mkdir()
    ids, database = image_ids(images), scratch / "mapping.db"
    try:
        pairs = rank_pairs(
            [image for image in images if image.name in group.skeleton], camera, group.pair_options, board
        )
        write_database(database, camera, images, group.matched)
        mapping = map_group(database, scratch / "models", images, group.skeleton, ids, pairs, camera)
        refined = refine_or_explain(mapping.model, camera, group.target, board, group.eccentricity)
    except (MappingError, ScaleError, ConvergenceError, DegenerateError) as error:
        return error
    return GroupSolution(
        tuple(pairs),
        refined.model,
        mapping.seeded,
        refined.rounds,
        mapping.left_out | left_out([i for i in images if i.name in mapping.model.images], refined.model),
        (*mapping.outliers, *refined.outliers),
    )


LIKELY = "; the likely cause: "
"""How the part of an error begins that says what the photographs that cannot be solved have in common."""


def refine_or_explain(
    model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign, eccentricity: bool = True
) -> Refined:
    """Refines a group, as :func:`stcal.sfm.adjust.refine.refine`; its errors say if target and board moved apart."""
    try:
        return refine(model, camera, target, board, eccentricity)
    except (MappingError, ConvergenceError) as error:
        if (image := _odd_one_out(model, camera, target, board, eccentricity)) is not None:
            raise MappingError(
                error.code,
                f"group {model.group}: {image} contradicts the others, which agree without it; leave it out, with "
                f"--exclude {image}, or take it again",
            ) from error
        if moved_apart(model, camera, target, board):
            agree = "the circles of the faces agree with one another, and the dots of the board do"
            error.append(f"{LIKELY}{MOVED}, as {agree}: {MOVED_REMEDY}")
        raise


def _odd_one_out(
    model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign, eccentricity: bool
) -> str | None:
    """Returns the one image without which a group can be refined; None if there is none, or more than one."""
    cures: list[str] = []
    if not LEAST_WITHOUT < len(model.images) <= MOST_WITHOUT:
        return None
    for k, image in enumerate(model.images):
        with suppress(MappingError, ConvergenceError, DegenerateError):
            refine(model.without(model.image_index == k), camera, target, board, eccentricity)
            cures.append(image)
        if len(cures) > 1:
            return None
    return cures[0] if cures else None


def wrong_file(images: Sequence[ImageObservations], camera: Camera, board: BoardDesign) -> Check | None:
    """Returns a failed check that names what of a camera file is wrong by the dots of the board alone, whose places are
    known: another camera explains what it leaves as residuals."""
    if not board.rows:
        return None
    try:
        found, stated = camera_of_labelled(images, board, camera)
    except StcalError:
        return None
    square, square_of_file = (weighted_rms_px(each) ** 2 for each in (found, stated))
    if square > (1 - EXPLAINS) * square_of_file:
        return None
    cause = cause_of_file(camera, found.camera, found.covariance, found.colmap_model)
    if cause is None:
        return None
    rms = f"{significant(square**0.5)} px RMS from where the board has them, {significant(square_of_file**0.5)} px"
    return replace(cause, reason=f"{cause.reason}; by the dots of the board alone, which are {rms} with the file")


@contextmanager
def explained(images: Sequence[ImageObservations], camera: Camera, board: BoardDesign) -> Iterator[None]:
    """Lets errors of a run that cannot be solved name what of the camera file is wrong, if the board tells it."""
    try:
        yield
    except (MappingError, ScaleError, ConvergenceError, DegenerateError) as error:
        if LIKELY not in str(error) and (cause := wrong_file(images, camera, board)):
            name = cause.cause
            error.append(f"{LIKELY}{name} ({cause.reason}): {cause.remedy}")
        raise


def _save(path: Path, solution: GroupSolution) -> None:
    model = solution.model
    meta = {
        "group": model.group,
        "images": model.images,
        "labels": model.labels,
        "seeded": solution.seeded,
        "rounds": solution.rounds,
        "left_out": solution.left_out,
        "outliers": [asdict(o) for o in solution.outliers],
        "pairs": [
            {f.name: getattr(p, f.name) for f in fields(PairScore) if f.name != "second_from_first"}
            for p in solution.pairs
        ],
        "pair_poses": [
            None if p.second_from_first is None else p.second_from_first.matrix().tolist() for p in solution.pairs
        ],
    }
    arrays = {name: getattr(model, name) for name in _ARRAYS}
    keep(path, {"poses": np.stack([pose.matrix() for pose in model.camera_from_model]), **arrays}, meta)


def _stored(stored, meta) -> GroupSolution:
    """Returns the solution that is kept in arrays and metadata."""
    model = WorldModel(
        meta["group"],
        tuple(meta["images"]),
        tuple(Rigid(m[:3, :3], m[:3, 3]) for m in stored["poses"]),
        parse_labels(meta["labels"]),
        **{name: stored[name] for name in _ARRAYS},
    )
    pairs = tuple(
        PairScore(**p, second_from_first=None if m is None else Rigid.from_matrix(m))
        for p, m in zip(meta["pairs"], meta["pair_poses"], strict=True)
    )
    outliers = tuple(Outlier(**o) for o in meta["outliers"])
    return GroupSolution(pairs, model, meta["seeded"], meta["rounds"], meta["left_out"], outliers)


def solve_body(
    observations: Sequence[ImageObservations],
    body: PlacedBody,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    eccentricity: bool,
    progress: Progress,
) -> tuple[list[GroupSolution], list[str]]:
    """Maps and refines the groups of a body that its faces have placed; returns the solutions, and why groups have
    none. If there is no solution, the error of the first group is raised."""
    solutions: list[GroupSolution] = []
    errors: list[tuple[str, StcalError]] = []
    groups = by_group(observations)
    for done, (name, group) in enumerate(groups.items(), 1):
        try:
            model = model_of_body(body, group, camera)
            gross = {(o.image, o.label): o for o in body.contradictions if o.image in model.images}
            seen = zip(model.image_index.tolist(), model.point_index.tolist(), strict=True)
            is_gross = np.array([(model.images[i], model.labels[p]) in gross for i, p in seen], bool)
            refined = refine_or_explain(model.without(is_gross), camera, target, board, eccentricity)
            find_scale(refined.model, board)
        except (MappingError, ScaleError, ConvergenceError, DegenerateError) as error:
            errors.append((name, error))
        else:
            missing = left_out(group, refined.model, SHOW_MORE) | left_out(group, model, SHOW_MORE)
            pair = pair_of_model(refined.model)
            outliers = (*gross.values(), *refined.outliers)
            solutions.append(GroupSolution((pair,), refined.model, BY_FACES, refined.rounds, missing, outliers))
        progress("map", done, len(groups))
    if not solutions:
        raise errors[0][1]
    return solutions, [Note.of_group(name, error) for name, error in errors]


def unseen_board(solutions: list[GroupSolution], board: BoardDesign) -> list[str]:
    """Returns notes on rows and columns of the board that no image shows: hidden everywhere, or nonexistent."""
    dots = (label for s in solutions for label in s.model.labels if isinstance(label, DotLabel))
    return unseen_lines(dots, board.rows, board.columns)


def unseen_circles(solutions: Sequence[GroupSolution], target: TargetDesign) -> list[str]:
    """Returns a note on circles or corners of the faces in the result that no image shows as the design has them."""
    mapped = {label for s in solutions for label in s.model.labels}
    faces = {label.plane for label in mapped}
    every = (label for face in target.faces if face.id in faces for label in face.labels())
    missing = [str(label) for label in every if label not in mapped]
    if not missing:
        return []
    named = ", ".join(missing[:FEW_NAMED]) + (" …" if len(missing) > FEW_NAMED else "")
    return [
        f"{named}: not in the result, as too few images show {'it' if len(missing) == 1 else 'them'} as drawn; check "
        "radius and place in target.toml, unless something hides it"
    ]


def solve_groups(
    observations: Sequence[ImageObservations],
    graph: ImageGraph,
    scratch: Path,  # a folder that is made and removed again
    cache: Path,  # folder for what later runs take up
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    options: RunOptions,
    progress: Progress,
    names: Collection[str] | None = None,  # groups to solve, all if None
) -> tuple[list[GroupSolution], list[str]]:
    """Maps and refines group by group; returns the solutions, and the reasons why groups have none. If there is no
    solution, the error of the first group is raised."""
    groups = [
        _Group(
            images,
            [observations[i].name for i in graph.skeleton[name]],
            _pairs_within(name, observations, graph),
            camera,
            target,
            board,
            options.pairs,
            options.eccentricity,
        )
        for name, images in by_group(observations).items()
        if names is None or name in names
    ]
    paths = [cache / f"group-{group.key()}.npz" for group in groups]
    found: list[GroupSolution | StcalError | None] = [kept(path, _stored) for path in paths]
    pending = [k for k, solution in enumerate(found) if solution is None]
    step = counted(progress, "map", len(groups))
    for _ in range(len(groups) - len(pending)):
        step(None)
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        jobs = [(groups[k], scratch / str(k)) for k in pending]
        for k, solution in zip(pending, run_in_order(_solved, jobs, 1, lambda done, _: step(done)), strict=True):
            found[k] = solution
            if isinstance(solution, GroupSolution):
                _save(paths[k], solution)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    solutions: list[GroupSolution] = []
    errors: list[tuple[str, StcalError]] = []
    for group, solution in zip(groups, (each for each in found if each is not None), strict=True):
        try:
            if isinstance(solution, StcalError):
                raise solution
            find_scale(solution.model, board)
        except (MappingError, ScaleError, ConvergenceError, DegenerateError) as error:
            error.append(pitch_hint(group.images, board))
            errors.append((group.images[0].group, error))
        else:
            solutions.append(solution)
    if not solutions:
        raise errors[0][1]
    return solutions, [Note.of_group(name, error) for name, error in errors]


def _pairs_within(group: str, observations: Sequence[ImageObservations], graph: ImageGraph) -> np.ndarray:
    """Returns the pairs of the graph that lie within a group, (n, 2) indices in the group."""
    members = [i for i, image in enumerate(observations) if image.group == group]
    place = np.full(len(observations), -1)
    place[members] = np.arange(len(members))
    pairs = place[graph.pairs]
    return pairs[(pairs >= 0).all(1)]
