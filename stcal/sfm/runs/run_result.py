"""Result of a run, and its comparison with the published method."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import Field

from stcal.design import BoardDesign, TargetDesign, faces_of_known_shape, known_distances
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, rms
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.io.files import DATABASE, RUN_MARKER
from stcal.io.json import ByFace, Part, checked, read_result
from stcal.labels import CircleLabel, Label, circle_labels
from stcal.report.document import html
from stcal.sfm.adjust.calibration import Calibration, SigmaFactors
from stcal.sfm.adjust.chain import CalibratedTarget, FaceChain
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.adjust.refine import projection_jacobians
from stcal.sfm.adjust.scale import ScaleSource
from stcal.sfm.checks.significance import Evidence
from stcal.sfm.data.group_model import ImageObservations, MetricModel, by_group
from stcal.sfm.detect.detect_files import DetectionResult
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.mapping.pairs import ImageGraph
from stcal.sfm.measurement.known_target import TargetCircles
from stcal.sfm.report.check import Check
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs.groups import GroupSolution
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.transaction import AGAIN, MarkerFile, as_written

if TYPE_CHECKING:
    from pandas import DataFrame

    from stcal.sfm.runs.report_file import ReportCamera

ReportPart = TypeVar("ReportPart", bound=Part)
Value = TypeVar("Value")
Cells = Mapping[str, str | float]
"""A row of a table."""
Rows = Literal["faces", "circles", "images", "observations"]
"""Tables of :meth:`RunResult.to_dataframe`."""


class FaceOff(Part):
    translation_um: float
    rotation_mdeg: float


class ComparedRow(Part):
    method: str
    faces: dict[ByFace, FaceOff] = Field(default={})
    missing: list[str] = Field(default=[])
    board_mean_um: float | None = None
    board_spread_um: float | None = None
    residual_rms_px: float | None = None
    reason: str | None = None


class Comparison(Part):
    """Content that ``--compare paper`` adds to ``report.json``."""

    method: str = Field(alias="with", description="`paper`")
    rows: list[ComparedRow] = Field(
        description="`as published`, then with one step more each, all with three-point frames: `method`; `faces` "
        "face → `translation_um`, `rotation_mdeg` off the last row (empty in that), `missing` faces; length of the "
        "board's residuals, `board_mean_um` and `board_spread_um` (mean and standard deviation over all groups' dots, "
        "Table 1); "
        "`residual_rms_px` per coordinate; `reason` where a row has no result, null otherwise"
    )
    sigma: dict[ByFace, FaceOff] = Field(
        description="of the last row by face: `translation_um`, `rotation_mdeg`, lengths of σ over the three axes"
    )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ImageResult(Brief):
    """An image that the result rests on.

    Parameters
    ----------
    name, group : str
        Of the image, as in all results.
    camera_from_target : Rigid
        Its pose as adjusted, mm.
    covariance : (6, 6) array
        Covariance of the pose from this image's circles, rad and mm, left perturbation in the camera frame: target,
        board and camera are taken as they were calibrated. ``stcal.sfm.measure`` adds the target's own uncertainty.
    labels : tuple of Label
        n circles and dots of the image that were used.
    xy_px : (n, 2) array
        Their measured centres, corrected for the eccentricity, px.
    residuals_px : (n, 2) array
        Measured minus projected, px.
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


def _images(model: MetricModel, camera: Camera, scale: float) -> list[ImageResult]:
    """Returns the images of a group; ``scale`` : factor on the centres' σ."""
    by_pose = model.whiten(projection_jacobians(model, camera)[0])
    alone = np.linalg.inv(blocks_of(by_pose, by_pose[..., 0], model.image_index, len(model.images))[0])
    corrected, residuals = model.corrected_px(), model.residuals_px(camera)
    images = zip(model.images, model.camera_from_model, scale**2 * alone, model.rows_by_image(), strict=True)
    return [
        ImageResult(name, model.group, pose, covariance, labels, corrected[rows], residuals[rows])
        for name, pose, covariance, rows in images
        for labels in [tuple(model.labels[k] for k in model.point_index[rows])]
    ]


OF_POSE = ("rx_rad", "ry_rad", "rz_rad", "x_mm", "y_mm", "z_mm")


def _cells(names: Sequence[str], values: np.ndarray, covariance: np.ndarray | None) -> dict[str, float]:
    """Returns the cells of values and their σ, NaN without a covariance."""
    sigma = np.full(len(names), np.nan) if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0))
    sigmas = zip([f"sigma_{name}" for name in names], sigma.tolist(), strict=True)
    return dict(zip(names, values.tolist(), strict=True)) | dict(sigmas)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SavedRun(Brief):
    """A run: what it was given, and what it found. One that was just made is a :class:`RunResult`.

    Parameters
    ----------
    out : Path or None
        The run's folder; None if no file stays.
    photographs : Path or str
        The folder of photographs as given.
    options : RunOptions
        Options with every default decided.
    camera : Camera
        The camera as its file states it; refined intrinsics are ``calibration.camera``.
    target_design, board_design : TargetDesign, BoardDesign
        The designs as given.
    observations : tuple of ImageObservations
        Labelled centres of all images, px, in the database's order; without the shapes of the ellipses if read back.
    corrected_px : tuple of (n, 2) array
        By image, the centres in the database, corrected for the eccentricity.
    faces_file : FacesFile or None
        Content of ``faces.json``; None of the board alone.
    report : dict
        Content of ``report.json``.
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
        return self.folder / DATABASE

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
        return read_result(self.folder / RUN_MARKER, MarkerFile, "run", AGAIN).sha256 or {}

    @property
    def target(self) -> CalibratedTarget:
        """The calibrated target with the covariances of ``faces.json``; poses of groups are not kept."""
        faces, joint = self.faces, self.faces.circles_joint_covariance_mm2
        return CalibratedTarget(
            faces.reference_face,
            faces.poses(),
            by_circle(faces.circles),
            {},
            dict(faces.target_from_face_covariance),
            by_circle(faces.circle_covariance_mm2),
            {},
            None if faces.scale_sigma_ppm is None else 1e-6 * faces.scale_sigma_ppm,
            None if joint is None else joint.matrix(),
        )

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

    def report_as(self, part: type[ReportPart]) -> ReportPart:
        """Returns the part of ``report.json`` that a command needs."""
        with as_written(self.folder / "report.json"):
            return checked(self.report, part)

    def adjusted_camera(self, own: "ReportCamera") -> Camera:
        """Returns the camera of the final model, refined if it was, else as given; ``own`` : that of the report."""
        if not self.options.refine_camera:
            return self.camera
        camera = Camera(self.camera.width, self.camera.height, own.focal_px, own.centre_px, own.distortion)
        return Camera.of(camera, self.camera.colmap_model)


def no_faces(folder: Path) -> InputError:
    """Returns the error of a run without a result for faces."""
    return InputError(
        "E-RUN-NO-FACES",
        f"run {folder}: no faces.json: of the board alone, or of another version; for faces, run it on photographs "
        "that show them",
    )


def by_circle(values: dict[str, Value]) -> dict[CircleLabel, Value]:
    """Returns values of ``faces.json`` by the labels of the circles."""
    return dict(zip(circle_labels(values), values.values(), strict=True))


AnyRun = SavedRun | str | Path
"""A finished run: its folder, or what ``load_run`` or ``run`` returned."""


def folder_of(run: AnyRun) -> Path:
    """Returns the folder of a run; an error if no file of it was kept."""
    return run.folder if isinstance(run, SavedRun) else Path(run)


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class RunResult(SavedRun):
    """A run with the results of its stages; :attr:`target` is the calibrated target. Further fields are those of every
    run: ``out``, ``photographs``, ``options``, ``camera`` (as its file states it; refined intrinsics are
    ``calibration.camera``), ``target_design``, ``board_design``, ``observations``, ``corrected_px``, ``faces_file``,
    ``report``.

    Parameters
    ----------
    detection : DetectionResult
        Detections of each image, and the images skipped.
    labelled : tuple of LabelledImage
        Labelled centres of all images, px, in the database's order.
    graph : ImageGraph
        Pairs of images that were matched.
    solutions : tuple of GroupSolution
        Solutions of the single groups, in worlds without unit.
    calibration : Calibration
        Target and models in mm, target frame.
    chains : dict of tuple of FaceChain
        Ways to each face through single groups, by face id.
    notes : tuple of str
        What was left out or did not settle, and what to do.
    checks : tuple of Check
        Checks in the order of the report.
    comparison : Comparison, optional
        Comparison with the published method, if requested.
    judgement : Judgement, optional
        The report in words, once it is made.
    camera_given : bool
        False if the camera was found from the photographs; ``camera`` is then the start of its adjustment.
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
        known = {
            "board": board.rows,
            "faces": faces_of_known_shape(board),
            "distances": known_distances(board) and not drawn,
            "drawing": drawn,
        }
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
        from stcal.sfm.runs.run_text import document_of

        document = document_of(self)
        return html(document.about, *document.banner, *document.sections[0].blocks)

    def circles(self) -> TargetCircles:
        """Returns the calibrated circles with their joint covariance, as :class:`stcal.sfm.Tracker` takes them."""
        return TargetCircles.of(self.target, self.target_design, self.calibration.sigma_factors.of_target)

    def images(self) -> tuple[ImageResult, ...]:
        """Returns the images that the result rests on, each with its pose and residuals, in the order of the groups."""
        calibration = self.calibration
        scale = 1.0 if calibration.joint is None else calibration.joint.sigma_scale
        return tuple(image for model in calibration.models for image in _images(model, calibration.camera, scale))

    def to_dataframe(self, rows: Rows = "faces") -> "DataFrame":
        """Returns a table of the result as a DataFrame of pandas (``pip install stereo-target-calibration[pandas]``).

        Parameters
        ----------
        rows : {"faces", "circles", "images", "observations"}
            ``faces``: place, rotation vector and σ of each face, target frame; ``circles``: the calibrated circles;
            ``images``: pose of each image; ``observations``: each circle in each image, with its residual.

        Raises
        ------
        InputError
            pandas is not installed, or there is no such table.
        """
        tables = {"faces": self._faces, "circles": self._circles, "images": self._images, "observations": self._seen}
        if rows not in tables:
            raise InputError("E-OPTION-VALUE", f"table of {rows!r}: not a choice; use {', '.join(tables)}")
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise InputError(
                "E-EXTRA-MISSING", "DataFrame: needs pandas; install stereo-target-calibration[pandas]"
            ) from error
        return DataFrame(tables[rows]())

    def _faces(self) -> list[Cells]:
        covariance = self.target.face_covariance
        poses = self.target.target_from_face.items()
        return [{"face": face} | _cells(OF_POSE, pose.log(), covariance.get(face)) for face, pose in poses]

    def _circles(self) -> list[Cells]:
        covariance, circles = self.target.circle_covariance, self.target.circles.items()
        return [
            {"label": str(label), "face": label.face} | _cells(OF_POSE[3:], xyz, covariance.get(label))
            for label, xyz in circles
        ]

    def _images(self) -> list[Cells]:
        return [
            {"image": image.name, "group": image.group}
            | _cells(OF_POSE, image.camera_from_target.log(), image.covariance)
            | {"circles": len(image.labels), "rms_px": image.rms_px}
            for image in self.images()
        ]

    def _seen(self) -> list[Cells]:
        columns = ("x_px", "y_px", "residual_x_px", "residual_y_px")
        return [
            {"image": image.name, "group": image.group, "label": str(label)} | dict(zip(columns, row, strict=True))
            for image in self.images()
            for label, row in zip(image.labels, np.hstack([image.xy_px, image.residuals_px]).tolist(), strict=True)
        ]

    @property
    def refined_camera(self) -> Camera | None:
        """Camera as adjusted, with covariance; None if the intrinsics were held fixed."""
        joint = self.calibration.joint
        if joint is None or not joint.camera_covariance.size:
            return None
        return Camera.of(joint.camera, self.camera.colmap_model, joint.camera_covariance)

    def evidence(self, prior: CameraPrior) -> Evidence:
        """Returns the input of the checks; ``prior`` : of the intrinsics, used if they were refined."""
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
            prior=prior if self.options.refine_camera else None,
            rim=bool(self.options.rim),
            camera_given=self.camera_given,
            blur_px={name: float(np.median(edge_blur)) for name, edge_blur in blur.items() if len(edge_blur)},
        )
