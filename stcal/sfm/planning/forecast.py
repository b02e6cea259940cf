"""Forecast of the σ of a geometry, photographed or only planned, and nominal poses before a photograph exists."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
from pydantic import Field

from stcal.boards.target_file import ROUGH_KEYS
from stcal.design import POINT_RADIUS_MM, BoardDesign, ScaleReference, TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import require_fields, rms
from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset, singular_values
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.io.json import ByFace, Part, read_result
from stcal.labels import CircleLabel, DotLabel, Label
from stcal.report.text import join, number, text_table
from stcal.sfm.adjust.chain import CalibratedTarget, FrameKind
from stcal.sfm.adjust.faces_file import FacePoses
from stcal.sfm.adjust.joint import Adjusted, Extensible, unmoved
from stcal.sfm.adjust.refine import projection_jacobians
from stcal.sfm.adjust.uncertainty import Derivatives, derivatives, scale_sigma
from stcal.sfm.data.group_model import ImageObservations, MetricModel, assemble, by_group
from stcal.sfm.runs.conditions import BLUR_PX, CONTRAST, IMAGE_NOISE, PRACTICE
from stcal.synthetic.scene import Scene, image_circles


def nominal_poses(target: TargetDesign, faces: str | Path | None) -> dict[str, Rigid]:
    """Returns the pose of every face in one frame, of a ``faces.json`` or, without one, by the design's rough poses."""
    if faces is None:
        rough = target.rough_poses()
        if missing := [face.id for face in target.faces if face.id not in rough]:
            *more, last = missing
            named = f"faces {', '.join(more)} and {last} are" if more else f"face {last} is"
            unplaced = f"target {target.name}: the design does not say where {named}"
            remedy = f"add approximate {ROUGH_KEYS} to each [[face]] of the target file"
            alternative = "or for `plan` give --faces, the faces.json of an earlier run"
            raise InputError("E-TARGET-ROUGH-POSE", f"{unplaced}; {remedy}, {alternative}")
        return rough
    poses = read_result(faces, FacePoses, "faces", "give RUN/faces.json, the faces.json of a run").poses()
    if missing := [face.id for face in target.faces if face.id not in poses]:
        fault = f"{faces}: no face {missing[0]} of target {target.name}"
        raise InputError("E-TARGET-NO-FACE", f"{fault}; give a run that shows all of its faces")
    return {face.id: poses[face.id] for face in target.faces}


EXACT_SIGMA_PX = 0.005  # the σ that is stated for centres without noise


def observe(scene: Scene, noise_px: float, rng: np.random.Generator, missing: float = 0.0) -> list[ImageObservations]:
    """Returns the centres of all circles but a share ``missing``, with Gaussian noise of σ ``noise_px`` per axis."""
    images = []
    for name, group in scene.groups.items():
        for i in range(len(group.camera_from_target)):
            circles = image_circles(scene, name, i)
            keep = circles.must_find & (rng.random(len(circles.labels)) >= missing)
            ideal = circle_image_offset(circles.xyz_camera[keep], circles.normal_camera[keep], circles.radius_mm[keep])
            centre_px = scene.camera.project(ideal) + noise_px * rng.standard_normal((len(ideal), 2))
            centre = scene.camera.normalised_from_pixel(centre_px)
            labels = tuple(compress(circles.labels, keep.tolist()))
            covariance_px2 = np.tile((noise_px or EXACT_SIGMA_PX) ** 2 * np.eye(2), (len(ideal), 1, 1))
            shape, image = np.zeros((len(ideal), 2, 2)), f"{name}/{i:04d}"
            images.append(ImageObservations(image, name, labels, centre_px, centre, shape, covariance_px2))
    return images


def true_models(scene: Scene, observations: Sequence[ImageObservations]) -> list[MetricModel]:
    """Returns models of the groups at the true geometry, mm, target frame, not yet corrected for eccentricity."""
    models = []
    for name, images in by_group(observations).items():
        group = scene.groups[name]
        place = scene.circles_target | dict(zip(scene.board.labels(), group.board_circles_target, strict=True))
        labels = {label for image in images for label in image.labels}
        poses = [group.camera_from_target[int(image.name.rpartition("/")[2])] for image in images]
        models.append(assemble(MetricModel, name, images, poses, {label: place[label] for label in labels}))
    return models


CORNER_SIGMA_PX = 0.02  # σ of a corner of a tag or square in a good photograph, of cells 6 to 14 px wide
ONE_PLATE = 0.99  # share of the board's variance that all groups have in common if the same plate is in all of them
ENOUGH = 10_000  # number of observations from which the parameters of their noise are estimated
STEPS = 64  # around a rim, whose integral errs by less than 1e-10 of itself for axes of 1:4
SMALLER = 1 - 1e-3  # factor on the σ of a source of error whose share of the variance is sought


@dataclass(frozen=True, slots=True)
class CentreNoise:
    """Noise of a measured centre: covariance = edge² (1 + (narrow/b)²) (∮ n nᵀ ds)⁻¹ + floor² 1.

    The integral runs over the rim (normals n, arc ds, px), b is the minor semi-axis. A straight edge fixes its place
    along its normal with an information of 1/edge² per pixel of its length. For noise s, contrast C and a blur β that
    bound is edge = s/C √(2 √π β) (∫ of the squared slope over s²: Kay 1993, Fundamentals of Statistical Signal
    Processing, example 3.13), so that the centre of a circle of radius r has σ = edge/√(π r): noise by the root of its
    perimeter.

    Parameters
    ----------
    edge : Noise along the rim, px^1.5.
    narrow_px : Minor semi-axis at which half of the information is lost, px; 0 for no loss.
    floor_px : σ per axis that does not depend on the size, px.
    corner_px : σ per axis of corners, which have no size, px.

    Raises
    ------
    InputError
        A value is negative or no number.
    """

    edge: float
    narrow_px: float = 0.0
    floor_px: float = 0.0
    corner_px: float = CORNER_SIGMA_PX

    def __post_init__(self):
        require_fields(self, "noise of centres", edge=0, narrow_px=0, floor_px=0, corner_px=0)

    @classmethod
    def expected(cls) -> "CentreNoise":
        """Returns the noise of good photographs, from the constants of this file."""
        return cls(PRACTICE * IMAGE_NOISE / CONTRAST * float(np.sqrt(2 * np.sqrt(np.pi) * BLUR_PX)))

    @classmethod
    def measured(cls, models: Sequence[MetricModel], camera: Camera, radius_mm: dict[Label, float]) -> "CentreNoise":
        """Noise fitted to the covariances of the observations of metric models. Large sets are thinned out evenly."""
        step = max(1, sum(len(model.point_index) for model in models) // ENOUGH)
        sampled = [model.observed(np.arange(0, len(model.point_index), step)) for model in models]
        corner = [_is_corner(model, radius_mm) for model in sampled]
        corners = [m.sigma_px()[own] for m, own in zip(sampled, corner, strict=True) if own.any()]
        corner_px = rms(np.concatenate(corners)) if corners else CORNER_SIGMA_PX
        sampled = [model.observed(np.flatnonzero(~own)) for model, own in zip(sampled, corner, strict=True)]
        if not any(len(model.point_index) for model in sampled):
            return replace(cls.expected(), corner_px=corner_px)
        rims = (_rim_images(model, camera, radius_mm) for model in sampled)
        information, minor_px = (np.concatenate(each) for each in zip(*rims, strict=True))
        covariance_px2 = np.concatenate([model.covariance_px2 for model in sampled])
        ratio, narrow = np.trace(information @ covariance_px2, axis1=1, axis2=2) / 2, minor_px**-2
        usual = ratio <= 4 * np.median(ratio)
        slope, level = np.polyfit(narrow[usual], ratio[usual], 1)
        if slope <= 0 or level <= 0:
            return cls(float(np.sqrt(ratio[usual].mean())), corner_px=corner_px)
        return cls(float(np.sqrt(level)), float(np.sqrt(slope / level)), corner_px=corner_px)

    def scaled(self, factor: float) -> "CentreNoise":
        return CentreNoise(factor * self.edge, self.narrow_px, factor * self.floor_px, factor * self.corner_px)

    def applied(self, model: MetricModel, camera: Camera, radius_mm: dict[Label, float]) -> MetricModel:
        """Returns the metric model with the covariances that this noise gives its observations."""
        information, minor_px = _rim_images(model, camera, radius_mm)
        size = self.edge**2 * (1 + (self.narrow_px / minor_px) ** 2)
        covariance = size[:, None, None] * np.linalg.inv(information) + self.floor_px**2 * np.eye(2)
        covariance[_is_corner(model, radius_mm)] = self.corner_px**2 * np.eye(2)
        return replace(model, covariance_px2=covariance)


def _is_corner(model: MetricModel, radius_mm: dict[Label, float]) -> np.ndarray:
    """Returns the mask of the observations that are of corners, not of circles, (n,)."""
    return np.array([radius_mm[label] <= POINT_RADIUS_MM for label in model.labels])[model.point_index]


def _rim_images(model: MetricModel, camera: Camera, radius_mm: dict[Label, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns ∮ n nᵀ ds (n, 2, 2) and minor semi-axes (n,), px, of rims as ellipses, to first order in radius over
    distance. The error is negligible for a σ."""
    radius = np.array([radius_mm[label] for label in model.labels])
    in_plane = np.linalg.svd(model.normals()[:, None])[2][:, 1:] * radius[:, None, None]
    by_point = projection_jacobians(model, camera)[1]
    shape = by_point @ np.swapaxes(in_plane, 1, 2)[model.point_index]
    angle = 2 * np.pi * np.arange(STEPS) / STEPS
    along = shape @ np.array([-np.sin(angle), np.cos(angle)])  # of each step along the rim
    normal = along[:, ::-1] * np.array([[1.0], [-1.0]])
    by_length = normal / np.linalg.norm(along, axis=1)[:, None] * (2 * np.pi / STEPS)
    return by_length @ np.swapaxes(normal, 1, 2), singular_values(shape)[1]


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Input of a forecast besides the views: the hardware and the options of the adjustment."""

    target: TargetDesign
    board: BoardDesign
    camera: Camera
    start: CalibratedTarget  # the target as it is, for the reference face and the sides that faces look to
    frame: FrameKind
    flatness_mm: float | None
    prior: CameraPrior | None  # of the intrinsics, None if they are fixed
    common: float  # see :func:`stcal.sfm.adjust.joint.adjusted`
    sigma0: float = 1.0  # factor on all σ
    rims_mm2: np.ndarray | None = None  # (3c, 3c) by the heights of rims, which no view changes, None if not estimated
    stands_for: float = 1.0  # dots of the board for which each dot of the models stands

    def circle_covariance(self, adjusted_mm2: np.ndarray) -> np.ndarray:
        """Returns the covariance of the circles, (3c, 3c) mm², from that of an adjustment whose σ₀ is 1."""
        return self.sigma0**2 * adjusted_mm2 + (0.0 if self.rims_mm2 is None else self.rims_mm2)

    def centres(self, model: MetricModel) -> np.ndarray:
        """Returns the number of real centres (n,) for which each observation stands."""
        is_dot = np.array([isinstance(label, DotLabel) for label in model.labels])
        return np.where(is_dot[model.point_index], self.stands_for, 1.0)

    def adjusted(self, models: Sequence[MetricModel]) -> Adjusted:
        """Returns the adjustment of models; a dot that stands for several has the σ of their mean."""
        seen = [replace(m, covariance_px2=m.covariance_px2 / self.centres(m)[:, None, None]) for m in models]
        board = self.board if self.stands_for == 1 else self.better_board(self.stands_for**-0.5).board
        return unmoved(seen, board, self.camera, self.flatness_mm, self.prior, self.common)

    def radius_mm(self) -> dict[Label, float]:
        return self.target.radius_of() | self.board.radius_of()

    def better_board(self, factor: float) -> "Setup":
        """Returns the same setup with the σ of the board, and of print and distances, multiplied by a factor."""
        if isinstance(self.board, ScaleReference):
            return replace(self, board=self.board.with_sigma_times(factor))
        return replace(self, board=replace(self.board, sigma_mm=factor * self.board.sigma_mm))


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The σ to expect of a geometry, target frame."""

    face_covariance: dict[str, np.ndarray]  # (6, 6) except for the reference face, rad and mm
    circle_sigma_mm: dict[CircleLabel, float]  # root of the trace
    scale_sigma: float  # relative, of the target's size
    derivatives: Derivatives  # reusable for other views of the same circles

    def position_sigma_mm(self) -> dict[str, float]:
        return {face: position_sigma_mm(c) for face, c in self.face_covariance.items()}

    def worst(self) -> tuple[str, float]:
        return worst_of(self.position_sigma_mm())


def worst_of(sigma: dict[str, float]) -> tuple[str, float]:
    face = max(sigma, key=sigma.__getitem__)
    return face, sigma[face]


def forecast(models: Sequence[MetricModel], setup: Setup, known: Derivatives | None = None) -> Forecast:
    """Returns the σ of metric models, mm, target frame, as the joint adjustment would state them. ``known``:
    derivatives of an earlier forecast of the same circles."""
    joint = setup.adjusted(models).result(1.0)
    used_derivatives = known or derivatives(joint, setup.start, setup.target, setup.frame)
    covariance = setup.circle_covariance(joint.covariance_mm2)
    circles_mm = np.sqrt(np.trace(used_derivatives.circle_covariance(covariance), axis1=1, axis2=2))
    circles = dict(zip(joint.labels, circles_mm.tolist(), strict=True))
    faces = used_derivatives.face_covariance(covariance)
    others = {face: faces[face] for face in faces if face != setup.start.reference_face}
    return Forecast(others, circles, scale_sigma(joint.xyz_model, covariance), used_derivatives)


@dataclass(frozen=True, slots=True, eq=False)
class PositionsWith:
    """Computes :meth:`Forecast.position_sigma_mm` with one further view, as :func:`forecast` would."""

    now: Extensible
    variance_mm2: dict[str, float]  # of the position of each face without it
    # (3p + q, 3f) covariance with the positions, by group, without the factor ``scale``
    to_positions: dict[str, np.ndarray]
    scale: float

    @classmethod
    def of(cls, models: Sequence[MetricModel], setup: Setup, known: Derivatives) -> "PositionsWith":
        """Prepares views in addition to these models. ``known`` is as in :func:`forecast`."""
        now = setup.adjusted(models).extensible()
        faces = known.face_covariance(setup.circle_covariance(now.covariance_mm2))
        variance = {f: position_sigma_mm(c) ** 2 for f, c in faces.items() if f != setup.start.reference_face}
        jacobian = np.concatenate([own[3:] for face, own in known.by_circles().items() if face in variance])
        to_positions = {group: covariance @ jacobian.T for group, covariance in now.to_circles.items()}
        return cls(now, variance, to_positions, setup.sigma0**2)

    def __call__(self, view: MetricModel) -> dict[str, float]:
        """Returns the σ of each face's position with this view, mm."""
        lowered = self.scale * self.now.lowered(view, self.to_positions[view.group]).reshape(-1, 3).sum(1)
        return {
            face: float(np.sqrt(max(now - less, 0.0)))
            for (face, now), less in zip(self.variance_mm2.items(), lowered, strict=True)
        }


def position_sigma_mm(face_covariance: np.ndarray) -> float:
    return float(np.sqrt(np.trace(face_covariance[3:, 3:])))


def variance_shares(now: Forecast, models: Sequence[MetricModel], setup: Setup) -> dict[str, dict[str, float]]:
    """Returns, by face and source, the share of the variance of the face's position that is due to the source. A
    variance grows by f² where all σ do by f, so that its derivatives by the sources' variances add up to it."""
    noisy = [replace(model, covariance_px2=SMALLER**2 * model.covariance_px2) for model in models]
    size = "board" if setup.board.rows else "print"
    smaller = {"image noise": (noisy, setup), size: (models, setup.better_board(SMALLER))}
    if setup.flatness_mm is not None:
        smaller["flatness"] = models, replace(setup, flatness_mm=SMALLER * setup.flatness_mm)
    if setup.prior is not None:
        prior = replace(setup.prior, covariance=SMALLER**2 * setup.prior.covariance)
        smaller["intrinsics"] = models, replace(setup, prior=prior)
    if setup.rims_mm2 is not None:
        smaller["rims"] = models, replace(setup, rims_mm2=SMALLER**2 * setup.rims_mm2)
    shares: dict[str, dict[str, float]] = {face: {} for face in now.face_covariance}
    for source, (own_models, own_setup) in smaller.items():
        less = forecast(own_models, own_setup, now.derivatives).position_sigma_mm()
        for face, sigma in now.position_sigma_mm().items():
            shares[face][source] = (1 - (less[face] / sigma) ** 2) / (1 - SMALLER**2)
    return shares


MICRO, PPM = 1e3, 1e6
LEAST_SHARE = 0.005  # least share of a variance that is printed


@dataclass(frozen=True, slots=True)
class FaceForecast:
    translation_sigma_um: list[float]
    rotation_sigma_mdeg: list[float]
    position_sigma_um: float
    worst_circle: str
    worst_circle_sigma_um: float
    variance_shares: dict[str, float]


class ForecastPart(Part):
    """σ against the reference face, in the target frame."""

    worst_face: str
    worst_sigma_um: float
    scale_sigma_ppm: float
    faces: dict[ByFace, FaceForecast] = Field(
        description="all faces but the reference: `translation_sigma_um` and `rotation_sigma_mdeg` (x, y, z), "
        "`position_sigma_um` (root of the summed variances of x, y, z), `worst_circle` and its "
        "`worst_circle_sigma_um` (likewise), `variance_shares`: by source (`image noise`, `board` or `print`, "
        "`flatness` where stated, `intrinsics` where adjusted, `rims` where estimated) the share of the position's "
        "variance that is due to the source; they add up to 1"
    )

    @classmethod
    def of(cls, forecast: Forecast, shares: dict[str, dict[str, float]]) -> "ForecastPart":
        faces, position_mm = {}, forecast.position_sigma_mm()
        for face, covariance in forecast.face_covariance.items():
            sigma = MICRO * np.sqrt(np.diag(covariance))
            worst, circle_mm = worst_of({c: own for c, own in forecast.circle_sigma_mm.items() if c.face == face})
            rows = sigma[3:].tolist(), np.degrees(sigma[:3]).tolist(), MICRO * position_mm[face]
            faces[face] = FaceForecast(*rows, worst, MICRO * circle_mm, shares[face])
        name, sigma_mm = worst_of(position_mm)
        scale_ppm = PPM * forecast.scale_sigma
        return cls(worst_face=name, worst_sigma_um=MICRO * sigma_mm, scale_sigma_ppm=scale_ppm, faces=faces)

    def table(self) -> list[str]:
        rows = [["<face", "σ x, µm", "y", "z", "all", "σ about x, mdeg", "y", "z", "<worst point", "µm", "<variance"]]
        for face, row in self.faces.items():
            shares = sorted(row.variance_shares.items(), key=lambda item: -item[1])
            said = [f"{name.removeprefix('image ')} {100 * own:.0f} %" for name, own in shares if own > LEAST_SHARE]
            sigma = [*row.translation_sigma_um, row.position_sigma_um, *row.rotation_sigma_mdeg]
            worst = [row.worst_circle, number(row.worst_circle_sigma_um, 2)]
            rows.append([face, *(number(s, 2) for s in sigma), *worst, join(said)])
        return text_table(rows)


FORECAST = (
    "`worst_face`, whose position is known worst, and its `worst_sigma_um`; `scale_sigma_ppm` of the target's size; and"
)
