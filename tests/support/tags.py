"""Targets, poses and corners with known truth: corners as a detector would state them, without images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import UNIT_SQUARE
from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.locate.layout import TargetLayout

CAMERA = Camera(1600, 1200, [1350.0, 1350.0], [799.5, 599.5], [-0.1, 0.05, 0, 0, 0, 0, 0, 0])
PLACES = (
    ("DICT_APRILTAG_36h11", 0, 40.0, 0.0, 0.0),
    ("DICT_6X6_250", 11, 20.0, 60.0, -40.0),
    ("DICT_6X6_250", 12, 20.0, -60.0, -40.0),
    ("DICT_4X4_50", 3, 15.0, 60.0, 45.0),
    ("DICT_5X5_100", 7, 25.0, -60.0, 45.0),
    ("DICT_4X4_50", 8, 15.0, 0.0, 50.0),
)
"""Dictionary, id, side, x and y of the example's tags, mm."""


@dataclass(frozen=True, slots=True)
class CornerNoise:
    """``sigma_px`` of a corner's coordinate; ``shared`` : of its variance, what all exposures have in common."""

    sigma_px: float = 0.05
    shared: float = 0.5


def example_layout(sigma_mm: float = 0.03, sigma_px: float = 0.0) -> TargetLayout:
    """Six tags of four families and four sizes on 150 × 125 mm."""
    corners = np.array([size * UNIT_SQUARE + np.array([x, y]) for _, _, size, x, y in PLACES])
    tags = tuple((dictionary, tag) for dictionary, tag, *_ in PLACES)
    return TargetLayout("example", tags, corners, sigma_mm**2 * np.eye(corners.size), 0, sigma_px)


def random_pose(
    rng: np.random.Generator, distance_mm: float = 700.0, tilt_deg: tuple[float, float] = (10, 50)
) -> Rigid:
    """camera_from_obj: tilted by an angle of that range to any side, turned at will, near the middle of the image."""
    tilt = np.radians(rng.uniform(*tilt_deg))
    side, spin = rng.uniform(0, 2 * np.pi, 2)
    turn = Rotation.from_rotvec(tilt * np.array([np.cos(side), np.sin(side), 0])) * Rotation.from_rotvec([0, 0, spin])
    depth = distance_mm * rng.uniform(0.8, 1.25)
    return Rigid(turn.as_matrix(), [*(0.15 * depth * rng.uniform(-1, 1, 2)), depth])


def simulated_exposures(
    layout: TargetLayout,
    camera_from_obj: Rigid,
    rng: np.random.Generator,
    noise: CornerNoise | None = None,
    shown: Sequence[Sequence[int]] = ((0, 1, 2, 3, 4, 5),),
    camera: Camera = CAMERA,
) -> list[Tags]:
    """The tags in those rows of the layout in each exposure; the real corners off the layout's by its covariance."""
    noise = noise or CornerNoise()
    n = len(layout.tags)
    root = np.linalg.cholesky(layout.covariance_mm2 + 1e-18 * np.eye(8 * n))
    real = layout.corners_mm + (root @ rng.standard_normal(8 * n)).reshape(n, 4, 2)
    flat = np.pad(real.reshape(-1, 2), ((0, 0), (0, 1)))
    ideal = camera.project(camera_from_obj @ flat).reshape(n, 4, 2)
    common = noise.sigma_px * np.sqrt(noise.shared) * rng.standard_normal(ideal.shape)
    common += layout.sigma_px * rng.standard_normal(ideal.shape)
    common += layout.tag_sigma_px * rng.standard_normal((n, 1, 2))
    edge_sigma = Tags(layout.tags, ideal, np.zeros((n, 8, 8))).edge_sigma_px()
    common += (edge_sigma * rng.standard_normal(n))[:, None, None] * corners_by_edges(ideal)
    found = []
    for rows in map(list, shown):
        own = noise.sigma_px * np.sqrt(1 - noise.shared) * rng.standard_normal((len(rows), 4, 2))
        covariance = np.tile(noise.sigma_px**2 * np.eye(8), (len(rows), 1, 1))
        tags = tuple(layout.tags[row] for row in rows)
        found.append(Tags(tags, ideal[rows] + common[rows] + own, covariance))
    return found
