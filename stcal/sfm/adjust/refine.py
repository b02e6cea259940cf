"""Eccentricity in the observation model: alternates with bundle adjustment until it no longer changes."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, MappingError
from stcal.geometry.camera import Camera
from stcal.geometry.conic import circle_image_offset
from stcal.geometry.plane import fit_plane
from stcal.geometry.robust import robust_sigma
from stcal.labels import Label
from stcal.sfm.adjust.group import adjust
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.data.model import GroupModel, Outlier, WorldModel

MAX_ROUNDS = 20
SETTLED_PX = 1e-5
"""Largest change of corrections that have settled, in px: far below any centring noise."""
OUTLIER_RMS = 6.0
"""Limit of a residual, as a multiple of the residuals' robust RMS length, √2 σ. Observations that exceed it, and twice
this multiple of their own σ, are named and left out."""
MIN_OUTLIER_PX = 0.1
WORST_SHARE = 0.5
MAX_OUTLIER_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Result of :func:`refine`.

    ``model`` : the model with settled corrections; ``rounds`` : number of rounds; ``outliers`` : observations that were
    left out.
    """

    model: WorldModel
    rounds: int
    outliers: tuple[Outlier, ...]


def refine(
    model: WorldModel,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    eccentricity: bool = True,
) -> Refined:
    """Alternates between the eccentricity of the circles and bundle adjustment.

    Raises
    ------
    ConvergenceError
        The corrections did not settle.
    MappingError
        A face has too few mapped circles to have a plane, or too many observations are outliers.
    """
    radius = target.radius_of() | board.radius_of()
    model = adjust(model, camera)
    observations = len(model.image_index)
    outliers: list[Outlier] = []
    rounds = 0
    while rounds < MAX_ROUNDS:  # rounds that find outliers do not count: their number is limited separately
        rounds += 1
        shift = np.zeros_like(model.shift_px)
        if eccentricity:
            shift = eccentricity_px(model, camera, radius, find_scale(model, board).mm_per_unit)
        change = np.abs(shift - model.shift_px).max(initial=0.0)
        model = replace(model, shift_px=shift)
        if change > SETTLED_PX:
            model = adjust(model, camera)
        if rounds >= 2 or not eccentricity:
            is_outlier, new_outliers = _outliers(model, camera)
            if len(new_outliers):
                outliers += new_outliers
                _require_few(outliers, observations, model.group)
                model = adjust(model.without(is_outlier), camera)
                rounds -= 1
                continue
        if change <= SETTLED_PX:
            return Refined(model, rounds, tuple(outliers))
    raise ConvergenceError(
        "E-NO-MINIMUM",
        f"group {model.group}: the eccentricity still changes by {change:.2g} px after {MAX_ROUNDS} rounds, "
        f"{SETTLED_PX:g} needed; check the radii in the target and board files",
    )


def _require_few(outliers: list[Outlier], observations: int, group: str) -> None:
    """Raises an error if the outliers are many: then the model is wrong, not the observations."""
    if len(outliers) > MAX_OUTLIER_SHARE * observations:
        raise MappingError(
            "E-GROUP-CONTRADICTS",
            f"group {group}: more than {100 * MAX_OUTLIER_SHARE:.0f} % of {observations} observations contradict the "
            f"others, first {outliers[0].image} {outliers[0].label} by {outliers[0].residual_px:.1f} px; "
            "check that the camera file belongs to the images, and that nothing but the camera moved",
        )


def eccentricity_px(model: GroupModel, camera: Camera, radius_mm: dict[Label, float], mm_per_unit: float) -> np.ndarray:
    """Returns the centre of the imaged ellipse minus the image of the circle's centre, (n, 2), for every observation.

    Raises
    ------
    MappingError
        A face has too few mapped circles to have a plane.
    """
    normal = np.zeros((len(model.labels), 3))
    for key, members in model.points_by_face().items():
        try:
            normal[members] = fit_plane(model.xyz_model[members]).normal
        except DegenerateError as error:
            surface = "the board" if key == "board" else f"face {key}"
            raise MappingError(
                "E-GROUP-FEW-CIRCLES",
                f"group {model.group}: {surface}: {len(members)} circles mapped, 3 off one line needed for its plane; "
                f"add views that show {surface}",
            ) from error
    radius = np.array([radius_mm[label] for label in model.labels]) / mm_per_unit
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    xyz = model.xyz_camera()
    normal_camera = np.einsum("nij,nj->ni", rotation, normal[model.point_index])
    ellipse = circle_image_offset(xyz, normal_camera, radius[model.point_index])
    return camera.project(ellipse) - camera.project(xyz)


def _outliers(model: GroupModel, camera: Camera) -> tuple[np.ndarray, list[Outlier]]:
    """Returns the worst observation of each image if it is an outlier of comparable size to the worst of all.

    One bad observation affects all observations that share a point or a camera with it.
    """
    residual = np.linalg.norm(model.residuals_px(camera), axis=1)
    rms = np.sqrt(2) * robust_sigma(residual, 2)
    limit = np.maximum(np.maximum(OUTLIER_RMS * rms, 2 * OUTLIER_RMS * model.sigma_px()), MIN_OUTLIER_PX)
    least = max(1.0, WORST_SHARE * float((residual / limit).max(initial=0.0)))
    is_outlier = np.zeros(len(residual), bool)
    outliers = []
    for name, rows in zip(model.images, model.rows_by_image(), strict=True):
        worst = rows[np.argmax(residual[rows] / limit[rows])]
        if residual[worst] > least * limit[worst]:
            is_outlier[worst] = True
            label = model.labels[model.point_index[worst]]
            outliers.append(Outlier(name, label, float(residual[worst]), float(limit[worst])))
    return is_outlier, outliers
