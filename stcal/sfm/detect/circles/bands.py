"""The pixels that a rim is fitted to: a band around it in the image, without pixels of neighbouring circles."""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.sfm.detect.circles.candidates import Ellipses

BAND_PX = 4.0
"""Half width of the band of pixels around the rim, at first and at least."""
RIM_CLEARANCE_PX = 1.5


def boxes(ellipses: Ellipses) -> np.ndarray:
    """Returns half widths and heights, (n, 2) px, of the boxes that the rims may move in."""
    return 1.25 * np.sqrt((ellipses.shape_px**2).sum(2)) + 3 * BAND_PX


def monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the monomials up to third degree, (10, ...)."""
    found = np.empty((10, *x.shape), x.dtype)
    found[0], found[1], found[2] = 1, x, y
    found[3], found[4], found[5] = x * x, x * y, y * y
    found[6], found[7], found[8], found[9] = found[3] * x, found[3] * y, x * found[5], found[5] * y
    return found


def local_ideal_maps(camera: Camera, centre_px: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Returns cubic polynomials, (n, 2, 10), that map the box around each candidate (scaled to ±1) to ideal pixels."""
    knots = np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    x, y = (g.ravel() for g in np.meshgrid(knots, knots))
    basis = monomials(x, y)
    points = centre_px[:, None] + half[:, None] * np.column_stack([x, y])
    ideal = camera.normalised_from_pixel(points) * np.sqrt(camera.focal.prod())
    return np.swapaxes(np.linalg.pinv(basis.T) @ ideal, 1, 2)


def intruders(ellipses: Ellipses, neighbours: Ellipses, half: np.ndarray) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Returns by ellipse the (relative centre, inverse shape) of other candidates that reach into its box."""
    reach = np.sqrt((neighbours.shape_px**2).sum(2))
    gap = np.abs(ellipses.centre_px[:, None] - neighbours.centre_px) - half[:, None] - reach
    near = (gap < 0).all(2)
    lists = []
    for i in range(len(ellipses)):
        found = []
        for j in np.flatnonzero(near[i]):
            between = neighbours.centre_px[j] - ellipses.centre_px[i]
            square = between @ between
            support = np.linalg.norm(ellipses.shape_px[i] @ between) + np.linalg.norm(neighbours.shape_px[j] @ between)
            # Ellipses that overlap are the same blob, or one holds the other: supports along the line of centres.
            if square > 1 and square > support - 2 * np.sqrt(square):
                wider = neighbours.shape_px[j] + RIM_CLEARANCE_PX * np.eye(2)
                found.append((between, np.linalg.inv(wider)))
        lists.append(found)
    return lists


def offsets(low: np.ndarray, high: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns columns (w,) and rows (h, 1) of a box, px from ``place``."""
    x, y = ((np.arange(a, b) - c).astype(np.float32) for a, b, c in zip(low, high, place, strict=True))
    return x, y[:, None]


def near_rim(
    offset: tuple[np.ndarray, np.ndarray],
    on_unit: np.ndarray,
    centre: np.ndarray,
    width: float,
    beside: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Returns rows and columns, in a box, of the pixels within a band around a rim.

    Parameters
    ----------
    offset : the box's columns and rows, px from a place in it, as :func:`offsets` gives them
    on_unit : (2, 2) matrix that takes the ellipse to the unit circle
    centre : (2,) centre of the ellipse, px from that place
    width : half width of the band, in the lengths that ``on_unit`` measures
    beside : (centre from that place, inverse shape) of ellipses whose pixels are left out
    """
    (dx, dy), inverse = offset, on_unit.astype(np.float32)
    x, y = dx - np.float32(centre[0]), dy - np.float32(centre[1])
    a, b = inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y
    square = a * a + b * b
    slope_x, slope_y = inverse[0, 0] * a + inverse[1, 0] * b, inverse[0, 1] * a + inverse[1, 1] * b
    slope_x *= slope_x
    slope_y *= slope_y
    slope_x += slope_y
    slope_x *= np.float32(width**2)
    square -= np.sqrt(square)
    square *= square
    chosen = square < slope_x
    for place, shape in beside:
        x, y = dx - np.float32(place[0]), dy - np.float32(place[1])
        chosen &= (shape[0, 0] * x + shape[0, 1] * y) ** 2 + (shape[1, 0] * x + shape[1, 1] * y) ** 2 > 1
    rows, columns = np.divmod(np.flatnonzero(chosen), chosen.shape[1])
    return rows, columns
