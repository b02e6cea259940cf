"""A run: what it was given and what it found, just made, or read back from its folder for every command that continues
from it."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from stcal.boards.board_file import load_board
from stcal.boards.target_file import load_target
from stcal.design import BoardDesign, TargetDesign, faces_of_known_shape, known_distances, scale_reference
from stcal.errors import InputError
from stcal.geometry.arrays import OF_PIXEL, Brief, first_fault, frozen, require_arguments, rms
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.rigid import Rigid
from stcal.io import files
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.cameras.read import read_camera
from stcal.io.images import name_fault
from stcal.io.json import Part, checked, read_json
from stcal.io.table import csv_rows
from stcal.labels import CircleLabel, Label, circle_labels
from stcal.report.document import html
from stcal.sfm.adjust.calibration import Calibration, SigmaFactors, with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget, FaceChain
from stcal.sfm.adjust.faces_file import FacesFile, TargetCircles
from stcal.sfm.adjust.joint import Adjusted, adjusted
from stcal.sfm.adjust.refine import ScaleSource, projection_jacobians, with_edge_sigma
from stcal.sfm.adjust.uncertainty import with_scatter
from stcal.sfm.checks.significance import Evidence
from stcal.sfm.data.group_model import GroupModel, ImageObservations, by_group
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import DetectionResult
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import read_model
from stcal.sfm.mapping.pairs import ImageGraph, PairOptions
from stcal.sfm.report.check import Check
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs.comparisons import Comparison
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.stages import GroupSolution
from stcal.sfm.runs.transaction import AGAIN, MarkerFile, as_written, complete_interrupted, read_marker, require_run

Value = TypeVar("Value")
COLUMNS = ("x_px", "y_px", "corrected_x_px", "corrected_y_px", "var_x_px2", "cov_xy_px2", "var_y_px2")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ImageResult(Brief):
    """An image that the result rests on.

    Parameters
    ----------
    name, group : Of the image, as in all results.
    camera_from_target : Its pose as adjusted, mm.
    covariance : (6, 6) array
        Covariance of the pose from this image's circles, rad and mm, left perturbation in the camera frame: target,
        board and camera are taken as they were calibrated. ``stcal.sfm.measure`` adds the target's own uncertainty.
    labels : n circles and dots of the image that were used.
    xy_px : (n, 2) array. Their measured centres, corrected for the eccentricity, px.
    residuals_px : (n, 2) array. Measured minus projected, px.
    """

    name: str
    group: str
    camera_from_target: Rigid
    covariance: np.ndarray
    labels: tuple[Label, ...]
    xy_px: np.ndarray
    residuals_px: np.ndarray

    @property
    def rms_px(self) -> float:
        """RMS of the residuals per axis, px."""
        return rms(self.residuals_px)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SavedRun(Brief):
    """A run: what it was given, and what it found. One that was just made is a :class:`RunResult`.

    Parameters
    ----------
    out : The run's folder; None if no file stays.
    photographs : The folder of photographs as given.
    options : Options with every default decided.
    camera : The camera as its file states it; refined intrinsics are ``calibration.camera``.
    target_design, board_design : The designs as given.
    observations : tuple of ImageObservations
        Labelled centres of all images, px, in the database's order; without the shapes of the ellipses if read back.
    corrected_px : tuple of (n, 2) array. By image, the centres in the database, corrected for the eccentricity.
    faces_file : Content of ``faces.json``; None of the board alone.
    report : Content of ``report.json``.
    """

    out: Path | None
    photographs: Path | str
    options: RunOptions
    camera: Camera
    target_design: TargetDesign
    board_design: BoardDesign
    observations: tuple[ImageObservations, ...]
    corrected_px: tuple[np.ndarray, ...] = ()
    faces_file: FacesFile | None = None
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def database(self) -> Path:
        """Path of COLMAP's database."""
        return self.folder / files.DATABASE

    @property
    def folder(self) -> Path:
        """The run's folder; an error if no file of it was kept."""
        if self.out is None:
            raise InputError("E-RUN-FOLDER", "run: in memory, no file of it was kept; run it with out=")
        return self.out

    @property
    def faces(self) -> FacesFile:
        """Content of ``faces.json``; an error if the run is of the board alone."""
        if self.faces_file is None:
            raise no_faces(self.folder)
        return self.faces_file

    @property
    def sha256(self) -> dict[str, str]:
        """Hashes of the folder's files at the end of the run, by path below the folder."""
        return read_marker(self.folder).sha256 or {}

    @property
    def target(self) -> CalibratedTarget:
        """The calibrated target with the covariances of ``faces.json``; poses of groups are not kept."""
        return target_in(self.faces)

    def groups(self) -> dict[str, list[ImageObservations]]:
        """Returns the observations by group, in order."""
        return by_group(self.observations)

    def sigma_factors(self) -> SigmaFactors:
        """Returns the factors on the centres' own σ; the factor of all circles for a kind that an older run lacks."""
        summary = self.report["summary"]
        overall = summary["sigma_factor"]
        circles, dots = (summary.get(f"{kind}_sigma_factor", overall) for kind in ("circle", "dot"))
        printed = summary.get("printed_sigma_factor") or circles
        return SigmaFactors(overall, circles, dots, printed, self.target_design.printed_ids())

    def rims_mm(self) -> tuple[dict[CircleLabel, float], float]:
        """Heights of the rims behind which the faces lie, by circle, and σ of all, mm, 0 if they are stated."""
        return by_circle(self.faces.rim_mm), self.report["summary"].get("rim_sigma_mm") or 0.0

    def failed_checks(self) -> list[dict]:
        """Returns the checks that failed, as ``report.json`` has them."""
        return [check for check in self.report.get("checks", ()) if check["verdict"] == "failed"]


def no_faces(folder: Path) -> InputError:
    """Returns the error of a run without a result for faces."""
    fault = f"run {folder}: no faces.json: of the board alone, or of another version"
    return InputError("E-RUN-NO-FACES", f"{fault}; for faces, run it on photographs that show them")


def by_circle(values: dict[str, Value]) -> dict[CircleLabel, Value]:
    """Returns values of ``faces.json`` by the labels of the circles."""
    return dict(zip(circle_labels(values), values.values(), strict=True))


def target_in(faces: FacesFile) -> CalibratedTarget:
    """Returns the target in the content of ``faces.json``, which has no poses of groups."""
    joint, ppm = faces.circles_joint_covariance_mm2, faces.scale_sigma_ppm
    scale_sigma, whole = None if ppm is None else 1e-6 * ppm, None if joint is None else joint.matrix()
    covariances = dict(faces.target_from_face_covariance), by_circle(faces.circle_covariance_mm2)
    circles = by_circle(faces.circles)
    return CalibratedTarget(faces.reference_face, faces.poses(), circles, {}, *covariances, {}, scale_sigma, whole)


AnyRun = SavedRun | str | Path  # its folder, or what ``load_run`` or ``run`` returned


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class RunResult(SavedRun):
    """A run with the results of its stages; :attr:`target` is the calibrated target. Further fields are those of every
    run: ``out``, ``photographs``, ``options``, ``camera`` (as its file states it; refined intrinsics are
    ``calibration.camera``), ``target_design``, ``board_design``, ``observations``, ``corrected_px``, ``faces_file``,
    ``report``.

    Parameters
    ----------
    detection : Detections of each image, and the images skipped.
    labelled : Labelled centres of all images, px, in the database's order.
    graph : Pairs of images that were matched.
    solutions : Solutions of the single groups, in worlds without unit.
    calibration : Target and models in mm, target frame.
    chains : Ways to each face through single groups, by face id.
    notes : What was left out or did not settle, and what to do.
    checks : Checks in the order of the report.
    comparison : Comparison with the published method, if requested.
    judgement : The report in words, once it is made.
    camera_given : False if the camera was found from the photographs; ``camera`` is then the start of its adjustment.
    """

    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    graph: ImageGraph
    solutions: tuple[GroupSolution, ...]
    calibration: Calibration
    chains: dict[str, tuple[FaceChain, ...]]
    notes: tuple[str, ...]
    checks: tuple[Check, ...] = ()
    comparison: Comparison | None = None
    judgement: Judgement | None = None
    camera_given: bool = True

    def scale_from(self) -> list[ScaleSource]:
        """Returns what the size of the result rests on."""
        board, drawn = self.board_design, self.target_design.up_to_scale
        known: dict[str, Any] = {"board": board.rows, "faces": faces_of_known_shape(board), "drawing": drawn}
        known["distances"] = known_distances(board) and not drawn
        return [source for source in get_args(ScaleSource) if known[source]]

    @property
    def target(self) -> CalibratedTarget:
        """The calibrated target."""
        return self.calibration.target

    def __repr__(self) -> str:
        place = f" in {self.out}" if self.out else ""
        return f"<RunResult{place}: {'not judged' if self.judgement is None else self.judgement.use.removesuffix('.')}>"

    def _repr_html_(self) -> str:
        """Returns verdict, faces and checks as HTML, which notebooks show."""
        from stcal.sfm.runs.folder import document_of

        document = document_of(self)
        return html(document.about, *document.banner, *document.sections[0].blocks)

    def circles(self) -> TargetCircles:
        """Returns the calibrated circles with their joint covariance, as :class:`stcal.sfm.Tracker` takes them."""
        return TargetCircles.of(self.target, self.target_design, self.calibration.sigma_factors.of_target)

    def images(self) -> tuple[ImageResult, ...]:
        """Returns the images that the result rests on, each with its pose and residuals, in the order of the groups."""
        calibration, images = self.calibration, []
        scale = 1.0 if calibration.joint is None else calibration.joint.sigma_scale  # factor on the centres' σ
        for model in calibration.models:
            by_pose = model.whiten(projection_jacobians(model, calibration.camera)[0])
            alone = np.linalg.inv(blocks_of(by_pose, by_pose[..., 0], model.image_index, len(model.images))[0])
            corrected, residuals = model.corrected_px(), model.residuals_px(calibration.camera)
            of_images = zip(model.images, model.camera_from_model, scale**2 * alone, model.rows_by_image(), strict=True)
            for name, pose, covariance, rows in of_images:
                labels = tuple(model.labels[k] for k in model.point_index[rows])
                measured = labels, corrected[rows], residuals[rows]
                images.append(ImageResult(name, model.group, pose, covariance, *measured))
        return tuple(images)

    def final_models(self) -> dict[str, GroupModel]:
        """Returns the models that the result rests on, by group."""
        models = self.calibration.joint.models if self.calibration.joint else [s.model for s in self.solutions]
        return {model.group: model for model in models}

    def residuals_px(self) -> dict[str, np.ndarray]:
        """Returns corrected minus projected keypoints, (k, 2), by image; NaN for keypoints not in the result."""
        by_image = {image.name: np.full((len(image), 2), np.nan) for image in self.observations}
        for model in self.final_models().values():
            residual = model.residuals_px(self.calibration.camera)
            for name, rows in zip(model.images, model.rows_by_image(), strict=True):
                by_image[name][model.keypoint[rows]] = residual[rows]
        return by_image

    def unadjusted(self) -> dict[str, frozenset[Label]]:
        """Returns the labels of the keypoints that are not in the result, by image."""
        residuals = self.residuals_px()
        return {
            image.name: frozenset(
                image.labels[i] for i in np.flatnonzero(np.isnan(residuals[image.name]).any(1)).tolist()
            )
            for image in self.observations
        }

    @property
    def refined_camera(self) -> Camera | None:
        """Camera as adjusted, with covariance; None if the intrinsics were held fixed."""
        joint = self.calibration.joint
        if joint is None or not joint.camera_covariance.size:
            return None
        return Camera.of(joint.camera, self.camera.colmap_model, joint.camera_covariance)

    def evidence(self) -> Evidence:
        """Returns the input of the checks."""
        blur = {i.file.name: i.detection.centres.blur_px for i in self.detection.images}
        return Evidence(
            models=tuple(s.model for s in self.solutions),
            outliers=tuple(o for s in self.solutions for o in s.outliers),
            images=self.observations,
            camera=self.camera,
            target=self.target_design,
            board=self.board_design,
            options=self.options.adjustment(self.target_design),
            calibration=self.calibration,
            prior=camera_prior(self.camera) if self.options.refine_camera else None,
            rim=bool(self.options.rim),
            camera_given=self.camera_given,
            blur_px={name: float(np.median(edge_blur)) for name, edge_blur in blur.items() if len(edge_blur)},
        )


class ImageRow(Part):
    image_id: int
    name: str
    group: str
    circles: int


class ReportRead(Part):
    """Content of ``report.json`` that every command on a run needs, of whatever version."""

    format: Literal["stcal report 1"] = "stcal report 1"
    images: list[ImageRow]
    groups: list[dict[str, Any]]
    summary: dict[str, Any]

    def names(self) -> list[tuple[str, str, int]]:
        """Returns (name, group, circles) of the images in the database's order; an error if something is missing."""
        pairs = {row["name"]: row["pairs"][0] for row in self.groups}
        group_of = {entry.name: entry.group for entry in self.images}
        for name, group in group_of.items():
            if fault := name_fault(name):
                raise ValueError(f"image {name!r}: its name {fault}")
            if not all(group_of.get(pairs[group][which]) == group for which in ("first", "second")):
                raise ValueError(f"group {group}: its initial pair is not of its images")
        float(self.summary["residual_rms_px"])
        return [(entry.name, entry.group, entry.circles) for entry in self.images]


def saved_run(run: AnyRun) -> SavedRun:
    """Returns a run that has a folder, read back if the folder is given; errors as of :func:`load_run`."""
    if not isinstance(run, SavedRun):
        return load_run(run)
    require_run(run.folder)
    return run


@require_arguments
def load_run(folder: str | Path) -> SavedRun:
    """Reads a finished run.

    Parameters
    ----------
    folder : Folder that was given to the run as ``out``.

    Returns
    -------
    SavedRun : Inputs, labelled centres and results of the run.

    Raises
    ------
    InputError
        Not a run's folder, an unfinished run, or a damaged file in the folder.
    """
    folder = Path(folder)
    require_run(folder)
    complete_interrupted(folder)
    target = load_target(folder / files.TARGET) if (folder / files.TARGET).is_file() else None
    has_board = target is None or not target.has_scale or (folder / files.BOARD).exists()
    inputs = (files.CAMERA, files.TARGET, *[files.BOARD] * has_board)
    needed = (*inputs, "labels.csv", files.DATABASE, "report.json", "faces.json")
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing == ["faces.json"]:
        raise no_faces(folder)
    if missing:
        fault = f"run {folder}: unfinished, or of another version: no {', '.join(missing)}"
        raise InputError("E-RUN-UNFINISHED", f"{fault}; run it again")
    assert target is not None
    marker, faces, report = (read_json(folder / n, "", AGAIN) for n in (files.RUN_MARKER, "faces.json", "report.json"))
    camera = read_camera(folder / files.CAMERA).calibrated(0, 0)
    board = scale_reference(load_board(folder / files.BOARD) if has_board else None, target)
    with as_written(folder / files.RUN_MARKER):
        marker_file = checked(marker, MarkerFile)
        options, photographs = _options(marker_file.options or {}).settled(target), Path(marker_file.images)
    with as_written(folder / "report.json"):
        names = checked(report, ReportRead).names()
    with as_written(folder / "faces.json"):
        result = checked(faces, FacesFile)
    with as_written(folder / "labels.csv"):
        known = {*target.radius_of(), *board.radius_of()}
        observations, corrected = _labels(folder / "labels.csv", names, camera, known)
        board = with_edge_sigma(board, observations)
    for name in (files.RUN_MARKER, *needed):
        if name != files.DATABASE:  # SQLite writes to it when it is read
            files.require_unchanged(folder / name)
    return SavedRun(folder, photographs, options, camera, target, board, observations, corrected, result, report)


def _options(stored: dict) -> RunOptions:
    read: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in stored.items()}
    pairs, ellipses = PairOptions(**stored["pairs"]), EllipseOptions(**stored["ellipses"])
    return RunOptions(**read | {"pairs": pairs, "ellipses": ellipses})


def _labels(path: Path, names: list[tuple[str, str, int]], camera: Camera, known: Collection[str]):
    """Observations and corrected centres from ``labels.csv``; ``names``: (name, group, circles) of the images."""
    rows: dict[str, list[dict]] = {name: [] for name, _, _ in names}
    for row in csv_rows(files.read_bytes(path, files.MODEL_BYTES).decode()):
        if None in row.values():
            raise ValueError(f"image {row['image']}: keypoint {row['keypoint']}: its row is cut")
        rows[row["image"]].append(row)
    observations, corrected = [], []
    for name, group, circles in names:
        image_rows = rows[name]
        if [int(row["keypoint"]) for row in image_rows] != list(range(circles)):
            raise ValueError(f"image {name}: its keypoints are not 0 to {circles - 1} in the order of the database")
        labels = tuple(row["label"] for row in image_rows)
        unknown = [label for label in labels if label not in known]
        if unknown or len(set(labels)) < len(labels):
            raise ValueError(f"image {name}: {f'no circle {unknown[0]}' if unknown else 'a label twice'}")
        texts = [[row[column] for column in COLUMNS] for row in image_rows]
        values = frozen(np.array(texts, float).reshape(-1, len(COLUMNS)), (None, len(COLUMNS)), name)
        centre_px, covariance = values[:, :2], values[:, [4, 5, 5, 6]].reshape(-1, 2, 2)
        if (fault := first_fault(covariance, OF_PIXEL, definite=True)) is not None:
            raise ValueError(f"image {name}: keypoint {fault.row}: covariance: {fault.reason}")
        centre, shape = camera.normalised_from_pixel(centre_px), np.zeros_like(covariance)
        observations.append(ImageObservations(name, group, labels, centre_px, centre, shape, covariance))
        corrected.append(values[:, 2:4])
    return tuple(observations), tuple(corrected)


def adjusted_run(run: SavedRun) -> tuple[Adjusted, CalibratedTarget]:
    """Repeats the final adjustment of a run, which moves nothing, from its model in mm in the target frame; returns it
    with σ as in the run, and the result of the run."""
    ids = image_ids(run.observations)
    read = read_model(run.folder / files.TARGET_MODEL, run.observations, ids, run.corrected_px, corrected_again=True)
    models = [with_sigma(model, run.sigma_factors()) for model in read.in_mm()]
    placed = {model.group: Rigid() for model in models}
    start = CalibratedTarget(run.faces.reference_face, run.faces.poses(), by_circle(run.faces.circles), placed)
    prior = camera_prior(run.camera) if run.options.refine_camera else None
    state = adjusted(models, run.board_design, run.camera, run.options.flatness_mm, prior, read.camera)
    state = with_scatter(state, start, run.target_design, run.faces.frame)
    return replace(state, enlarged=run.report["summary"].get("sigma_enlarged") or 1.0), start
