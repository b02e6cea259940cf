"""Checks of the measured radius of every circle: labels, radii and scale must agree with the ellipses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.plane import fit_plane
from stcal.geometry.robust import robust_sigma
from stcal.labels import CircleLabel, DotLabel, Label
from stcal.sfm.adjust.network import Network
from stcal.sfm.checks.verdict import Check, Trial, judge
from stcal.sfm.data.observations import ImageObservations

EDGE_BIAS_PX = 0.05
"""σ of the bias that light, lens and threshold add to all radii alike; it moves no centre."""
EDGE_DIFFERENCE_PX = 0.01
"""σ of the difference of this bias between large and small circles."""
RADIUS_TOLERANCE = 2e-3
"""Relative σ of a single radius from manufacturing; it moves the centre by 4·10⁻³ of its eccentricity, about 1 nm."""
MIN_PEERS = 5
"""Smallest number of circles of one design radius among which one can stand out."""
MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation: degrees of freedom, per value, of a spread estimated by it."""


@dataclass(frozen=True, slots=True, eq=False)
class Radii:
    """Radii of the target's circles and the board's dots, over all images and groups.

    ``labels`` ; ``design_mm`` : (c,); ``ratio`` : (c,) measured over designed, median; ``size_px`` : (c,) designed
    radius in the images, geometric mean of the ellipse's axes, median.
    """

    labels: tuple[Label, ...]
    design_mm: np.ndarray
    ratio: np.ndarray
    size_px: np.ndarray

    def __post_init__(self):
        for name in ("design_mm", "ratio", "size_px"):
            object.__setattr__(self, name, frozen(getattr(self, name), (len(self.labels),), name))

    def classes(self) -> dict[str, np.ndarray]:
        """Returns the indices of the circles of each kind and radius, by the name of the class."""
        indices: dict[str, list[int]] = {}
        for i, (label, radius) in enumerate(zip(self.labels, self.design_mm, strict=True)):
            kind = "dots" if isinstance(label, DotLabel) else "circles"
            indices.setdefault(f"{kind} of radius {radius:g} mm", []).append(i)
        return {name: np.array(members) for name, members in indices.items()}


@dataclass(frozen=True, slots=True)
class Size:
    """Size of the target over that of its design, minus 1, with its σ and the degrees of freedom of σ."""

    name: str
    size: float
    sigma: float
    freedom: int


def measure_radii(
    networks: Sequence[Network], images: Sequence[ImageObservations], design_mm: dict[Label, float], camera: Camera
) -> Radii:
    """Computes radii from the areas of the ellipses and the positions and planes of the circles."""
    shapes = {image.name: image.shape for image in images}
    ratio: dict[Label, list[np.ndarray]] = {}
    size: dict[Label, list[np.ndarray]] = {}
    focal = float(np.sqrt(camera.focal.prod()))
    for network in networks:
        model = network.model
        designed = np.array([design_mm[label] for label in model.labels])
        measured = np.concatenate([shapes[model.images[i]][model.keypoint[rows]]
                                   for i, rows in enumerate(model.rows_by_image())])  # fmt: skip
        order = np.concatenate(model.rows_by_image())
        expected = _areas(network, designed)[order]
        ratios = np.sqrt(np.maximum(np.linalg.det(measured), 0) / expected)
        point = model.point_index[order]
        for k, label in enumerate(model.labels):
            ratio.setdefault(label, []).append(ratios[point == k])
            size.setdefault(label, []).append(focal * np.sqrt(expected[point == k]))
    return Radii(
        tuple(ratio),
        np.array([design_mm[label] for label in ratio]),
        np.array([np.median(np.concatenate(values)) for values in ratio.values()]),
        np.array([np.median(np.concatenate(values)) for values in size.values()]),
    )


def _areas(network: Network, radius_mm: np.ndarray) -> np.ndarray:
    """Returns the areas over π of the circles' images in normalised coordinates, (n,).

    They follow from the dual conic r²(I − n·nᵀ) − C·Cᵀ (Hartley & Zisserman, sec. 8.3), with the estimated planes of
    the faces.
    """
    model = network.model
    normal = np.zeros((len(model.labels), 3))
    for members in model.points_by_face().values():
        normal[members] = fit_plane(model.xyz_model[members]).normal
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    n = np.einsum("nij,nj->ni", rotation, normal[model.point_index])
    c = model.xyz_camera()
    square = radius_mm[model.point_index, None, None] ** 2
    dual = square * (np.eye(3) - n[:, :, None] * n[:, None, :]) - c[:, :, None] * c[:, None, :]
    middle = dual[:, :2, 2] / dual[:, 2:, 2]
    shape2 = middle[:, :, None] * middle[:, None, :] - dual[:, :2, :2] / dual[:, 2:, 2:]
    return np.sqrt(np.maximum(np.linalg.det(shape2), 1e-300))


def radius_checks(radii: Radii) -> list[Check]:
    """Tests every circle against those of its kind and radius, and each such class against its design."""
    single, whole = [], []
    for name, members in radii.classes().items():
        ratio = radii.ratio[members]
        usual = float(np.median(ratio))
        bias_px = (usual - 1) * float(np.median(radii.size_px[members]))
        whole.append(Trial(name, bias_px, "px", (bias_px / EDGE_BIAS_PX) ** 2, 1))
        if len(members) < MIN_PEERS:
            continue
        sigma = float(np.hypot(robust_sigma(np.abs(ratio - usual)), RADIUS_TOLERANCE))
        freedom = max(MAD_EFFICIENCY * len(members) - 1, 2.0)
        for i in members:
            away = float(radii.ratio[i]) - usual
            single.append(
                Trial(radii.labels[i], 1e3 * away * float(radii.design_mm[i]), "µm", (away / sigma) ** 2, 1, freedom)
            )
    single_remedy = (
        "a damaged or dirty circle, a wrong label, or another radius than the design's: look at it in the overlays, "
        "correct target.toml"
    )
    class_remedy = (
        "all circles of a kind are larger or smaller than target.toml or board.toml says, or over-exposed: measure "
        "one, correct the file; a wrong radius makes a wrong eccentricity"
    )
    return [
        judge("radius", "Radius of each circle against those made alike", single, "circles", single_remedy),
        judge("radius-design", "Radii against the design", whole, "kinds of circle", class_remedy),
    ]


def size_by_radii(radii: Radii) -> Size | None:
    """Returns the slope of measured over designed radii of the target's circles, minus 1.

    The result is None if all radii are alike, or if there are fewer than ``MIN_PEERS`` circles.
    """
    is_circle = np.array([isinstance(label, CircleLabel) for label in radii.labels])
    size = radii.size_px[is_circle]
    design = radii.design_mm[is_circle]
    if len(size) < MIN_PEERS or np.ptp(design) == 0:
        return None
    design_matrix = np.column_stack([np.ones(len(size)), size])
    excess = (radii.ratio[is_circle] - 1) * size
    fit, *_ = np.linalg.lstsq(design_matrix, excess, rcond=None)
    freedom = len(size) - 2
    variance = float(((excess - design_matrix @ fit) ** 2).sum()) / freedom
    slope_variance = variance * np.linalg.inv(design_matrix.T @ design_matrix)[1, 1]
    reach = np.median(size[design == design.max()]) - np.median(size[design == design.min()])
    sigma = np.hypot(np.sqrt(slope_variance), EDGE_DIFFERENCE_PX / reach)
    return Size("by radii of circles", float(fit[1]), float(sigma), freedom)
