"""Circles whose centres do not agree with the rest of their group."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.least_squares import PoseStack
from stcal.geometry.plane import circle_image_offset
from stcal.geometry.plane_bundle import PlaneBundle
from stcal.labels import BOARD, Label
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.data.patterns import Pattern
from stcal.sfm.detect.group_geometry import Arrangement

MIN_LIMIT_PX = 0.5
"""Largest deviation that never counts as outlying.

Centres of clear circles are good to hundredths, designs to tenths.
"""
BEYOND = 4.0
"""Factor on the median deviation of the plane's circles: 4.7 σ of normal errors, exceeded by one in 60 000."""
BEYOND_SIGMA = 5.0
"""Smallest outlying distance in σ of the centre; one normal error in 270 000 is larger (two coordinates)."""
MIN_USUAL = 6
"""Least number of circles for a plane's own pose and median. Circles of other planes
are judged by the poses and the median of all."""
ALIKE = 0.5
"""Relative difference up to which a circle's deviation in another image counts as the same."""
MAX_ROUNDS = 10


def outlying_circles(
    arrangement: Arrangement, images: Sequence[ImageObservations], patterns: dict[str, Pattern], focal_px: float
) -> tuple[Arrangement, dict[int, dict[Label, str]]]:
    """Finds circles that contradict the others of their group; returns the arrangement adjusted without them, the same
    object if there are none, and reasons by image and label."""
    circles = _Circles.of(arrangement, images, patterns, focal_px)
    if not len(circles.rows):
        return arrangement, {}
    keep, reasons = np.ones(len(circles.rows), bool), {}
    for _ in range(MAX_ROUNDS):
        circles = circles.adjusted(keep)
        new = _worst(circles, keep)
        if not new:
            break
        reasons |= new
        keep[list(new)] = False
    if not reasons:
        return arrangement, {}
    found: dict[int, dict[Label, str]] = {}
    for k, reason in reasons.items():
        image, label = circles.rows[k]
        found.setdefault(image, {})[label] = reason
    return circles.rearranged(arrangement), found


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """n circles of a group, and its arrangement as stacks."""

    rows: list[tuple[int, Label]]  # image and label of each
    image: np.ndarray  # (n,) place in the arrangement, as ``plane``
    plane: np.ndarray
    xyz_mm: np.ndarray  # (n, 3) in the plane
    centre_px: np.ndarray  # (n, 2) images of the circles' centres, ideal, without eccentricity
    sigma_px: np.ndarray
    focal_px: float
    camera_from_group: PoseStack
    group_from_plane: PoseStack

    @classmethod
    def of(
        cls,
        arrangement: Arrangement,
        images: Sequence[ImageObservations],
        patterns: dict[str, Pattern],
        focal_px: float,
    ) -> "_Circles":
        names, planes = list(arrangement.camera_from_group), list(arrangement.group_from_plane)
        design = {
            label: (*xyz, radius)
            for plane in planes
            for label, xyz, radius in zip(
                patterns[plane].labels, patterns[plane].xyz_mm(), patterns[plane].radius_mm, strict=True
            )
        }
        rows, columns = [], []
        for a, i in enumerate(names):
            sigma = images[i].sigma_px()
            for k, label in enumerate(images[i].labels):
                if label in design:
                    rows.append((i, label))
                    columns.append((a, planes.index(label.plane), *images[i].centre[k], sigma[k], *design[label]))
        table = np.array(columns, float).reshape(-1, 9)
        circles = cls(
            rows,
            table[:, 0].astype(int),
            table[:, 1].astype(int),
            table[:, 5:8],
            focal_px * table[:, 2:4],
            table[:, 4],
            focal_px,
            PoseStack.of(*arrangement.camera_from_group.values()),
            PoseStack.of(*arrangement.group_from_plane.values()),
        )
        return (
            replace(circles, centre_px=circles.centre_px - circles._eccentricity_px(table[:, 8])) if rows else circles
        )

    def rearranged(self, arrangement: Arrangement) -> Arrangement:
        """Returns the arrangement with these poses."""
        cameras = {i: self.camera_from_group.rigid(a) for a, i in enumerate(arrangement.camera_from_group)}
        planes = {p: self.group_from_plane.rigid(b) for b, p in enumerate(arrangement.group_from_plane)}
        return replace(arrangement, camera_from_group=cameras, group_from_plane=planes)

    def adjusted(self, keep: np.ndarray) -> "_Circles":
        """Returns the circles with poses adjusted to those to ``keep`` on planes with enough circles for a pose."""
        use = keep & self.enough()
        if not use.any():
            return self
        bundle = PlaneBundle(self.image[use], self.plane[use], self.xyz_mm[use], self.centre_px[use], self.focal_px)
        cameras, planes = bundle.adjusted(self.camera_from_group, self.group_from_plane)
        return replace(self, camera_from_group=cameras, group_from_plane=planes)

    def enough(self) -> np.ndarray:
        """Returns the mask of the circles on planes with enough circles."""
        return np.bincount(self.plane, minlength=1)[self.plane] >= MIN_USUAL

    def in_one_image(self) -> np.ndarray:
        """Returns the mask of the circles of faces that only one image shows."""
        images = [len(np.unique(self.image[self.plane == p])) for p in range(len(self.group_from_plane))]
        return np.array(
            [images[p] == 1 and row[1].plane != BOARD for p, row in zip(self.plane, self.rows, strict=True)]
        )

    def off_px(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns centres minus their places, (n, 2) px, and derivatives (n, 2, 2) by the place in the plane, px/mm."""
        rotation, xyz = self._placed()
        ideal = xyz[:, :2] / xyz[:, 2:]
        by_point = np.zeros((len(xyz), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1
        by_point[:, :, 2] = -ideal
        by_point *= (self.focal_px / xyz[:, 2])[:, None, None]
        return self.centre_px - self.focal_px * ideal, by_point @ rotation[:, :, :2]

    def _placed(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns rotations camera_from_plane (n, 3, 3), and circles in the camera frame (n, 3)."""
        camera, plane = self.camera_from_group[self.image], self.group_from_plane[self.plane]
        xyz = np.einsum("nij,nj->ni", plane.rotation, self.xyz_mm) + plane.translation
        return camera.rotation @ plane.rotation, np.einsum("nij,nj->ni", camera.rotation, xyz) + camera.translation

    def _eccentricity_px(self, radius_mm: np.ndarray) -> np.ndarray:
        rotation, xyz = self._placed()
        centre = circle_image_offset(xyz, rotation[:, :, 2], radius_mm)
        return self.focal_px * (centre[:, :2] / centre[:, 2:] - xyz[:, :2] / xyz[:, 2:])


def _worst(circles: _Circles, keep: np.ndarray) -> dict[int, str]:
    """Returns the worst outlying circle to ``keep`` of each plane and image, as it biases the others."""
    shift, by_place = circles.off_px()
    off_px, limit = np.linalg.norm(shift, axis=1), np.maximum(MIN_LIMIT_PX, BEYOND_SIGMA * circles.sigma_px)
    alone, enough = circles.in_one_image(), circles.enough()
    usual = np.full(len(off_px), np.median(off_px[keep]))
    for plane in np.unique(circles.plane[keep & enough]):
        usual[circles.plane == plane] = np.median(off_px[keep & (circles.plane == plane)])
    limit = np.where(alone & enough, limit, np.maximum(limit, BEYOND * usual))
    outlying = keep & (off_px > limit)
    moved_mm = np.linalg.solve(by_place, shift[..., None])[..., 0]
    reasons: dict[int, str] = {}
    for k in np.flatnonzero(outlying):
        same = keep & (circles.image != circles.image[k]) & [label == circles.rows[k][1] for _, label in circles.rows]
        apart_px = np.linalg.norm((moved_mm[same] - moved_mm[k]) @ by_place[k].T, axis=1)
        outlying[k] = not (apart_px < ALIKE * off_px[k]).any()
    for image, plane in {(circles.image[k], circles.plane[k]) for k in np.flatnonzero(outlying)}:
        circles_of_face = np.flatnonzero(keep & (circles.image == image) & (circles.plane == plane))
        worst = circles_of_face[
            np.argmax(np.where(outlying[circles_of_face], off_px[circles_of_face] / limit[circles_of_face], 0))
        ]
        error = f"{off_px[worst]:.3g} px from its place, {limit[worst]:.3g} allowed"
        if alone[worst] and enough[worst]:
            why = f"{circles.rows[worst][1]} is {error}, and no other image of the group tells which circles are right"
            reasons |= dict.fromkeys(circles_of_face.tolist(), why)
        else:
            reasons[int(worst)] = error
    return reasons
