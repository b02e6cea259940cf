"""Good photographs made bad as photographs are: by lens, sensor, light, what covers them and what stands behind.

Every function takes an image (height, width) in grey values of 0…255, uint8 or float, and returns float32 in the same
unit, not clipped: :func:`stored` makes the file's pixels of it. Places come as shares of the pixels (0…1) or from a
:class:`~tests.support.photograph.Photograph`. The same seed gives the same image.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from scipy import ndimage

from stcal.synthetic.render import encode
from tests.support.photograph import MARGIN_MM, Photograph, Plane, disc_share, half_share

WHITE = 255.0
HIDDEN_REACH = 1.35
"""Radii about a circle's centre within which it is painted over; its ring, which gives the colour, goes further."""
RING_REACH = 1.8
BLOOM_PX = 6.0
BLOOM = 0.15
"""Share of the light beyond the scale that reaches the surroundings, spread by a Gauss of ``BLOOM_PX``."""


def stored(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Pixels of a file: clipped, rounded, uint8; of 9 to 16 bits uint16 with white at 2^bits − 1."""
    top = 2**bits - 1
    levels = np.rint(np.clip(np.asarray(image, np.float32) * np.float32(top / WHITE), 0, top))
    return levels.astype(np.uint8 if bits == 8 else np.uint16)


def defocused(image: np.ndarray, radius_px: float) -> np.ndarray:
    """Out of focus: every point becomes an even disc of ``radius_px``."""
    reach = int(np.ceil(radius_px)) + 1
    step = (np.arange(-8 * reach - 4, 8 * reach + 4) + 0.5) / 8
    inside = (step[:, None] ** 2 + step**2 <= radius_px**2).astype(np.float32)
    return _filtered(image, inside.reshape(2 * reach + 1, 8, 2 * reach + 1, 8).mean((1, 3)))


def motion_blurred(image: np.ndarray, length_px: float, angle_rad: float) -> np.ndarray:
    """Moved by ``length_px`` along ``angle_rad`` while the shutter was open, evenly, half of it to either side: the
    middle of a circle stays where it was."""
    reach = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for along in np.linspace(-length_px / 2, length_px / 2, 16 * reach + 1):
        x, y = reach + along * np.cos(angle_rad), reach + along * np.sin(angle_rad)
        i, j = int(np.floor(y)), int(np.floor(x))
        for row, column in ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)):
            if 0 <= row < len(kernel) and 0 <= column < len(kernel):
                kernel[row, column] += max(0, 1 - abs(y - row)) * max(0, 1 - abs(x - column))
    return _filtered(image, kernel)


def rolling_shutter(image: np.ndarray, shift_px: float) -> np.ndarray:
    """Rows read one after the other while the image moves sideways: the last row stands ``shift_px`` to the right of
    the first, the middle one where it was. :func:`rolled` says where a point went."""
    height, width = image.shape
    rows, columns = np.meshgrid(np.arange(height, dtype=float), np.arange(width, dtype=float), indexing="ij")
    columns -= shift_px * (rows / (height - 1) - 0.5)
    return ndimage.map_coordinates(np.asarray(image, np.float32), [rows, columns], order=3, mode="nearest")


def rolled(xy_px: np.ndarray, shift_px: float, height: int) -> np.ndarray:
    """Where :func:`rolling_shutter` puts points (..., 2) px."""
    xy = np.array(xy_px, float)
    xy[..., 0] += shift_px * (xy[..., 1] / (height - 1) - 0.5)
    return xy


def shrunk(image: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(np.asarray(image, np.float32), (width, height), interpolation=cv2.INTER_AREA)


def noisy(image: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(image.shape, dtype=np.float32)
    return np.asarray(image, np.float32) + np.float32(sigma) * noise


def exposed(image: np.ndarray, factor: float) -> np.ndarray:
    """Exposed ``factor`` times as long; light beyond white is lost, and a part of it blooms into the surroundings."""
    light = np.asarray(image, np.float32) * np.float32(factor)
    beyond = np.maximum(light - WHITE, 0)
    return np.minimum(light, WHITE) + BLOOM * cv2.GaussianBlur(beyond, (0, 0), BLOOM_PX)


def toned(image: np.ndarray, gamma: float) -> np.ndarray:
    """Another response: share of white to the power of 1/``gamma``; above 1 the dark parts get brighter."""
    share = np.clip(np.asarray(image, np.float32) / WHITE, 0, 1)
    return WHITE * share ** np.float32(1 / gamma)


def jpeg(image: np.ndarray, quality: int) -> bytes:
    return encode(stored(image), ".jpg", quality)


def hot_pixels(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    hot = np.random.default_rng(seed).random(image.shape) < share
    return np.where(hot, np.float32(WHITE), np.asarray(image, np.float32))


def dusty(image: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Dust on the sensor: ``count`` soft spots of 3 to 10 px (Gauss), each taking 10 to 40 % of the light."""
    rng = np.random.default_rng(seed)
    result = np.array(image, np.float32)
    for _ in range(count):
        x, y = rng.uniform(0, 1, 2) * np.array(image.shape)[::-1]
        spot = _spot(image.shape, (x, y), rng.uniform(3, 10))
        result *= 1 - np.float32(rng.uniform(0.1, 0.4)) * spot
    return result


def vignetted(image: np.ndarray, loss: float) -> np.ndarray:
    """The corners lose this share of their light, the way there by the square of the distance."""
    x, y = _from_middle(image.shape)
    corner = np.hypot(x[0, 0], y[0, 0])
    return np.asarray(image, np.float32) * (1 - np.float32(loss) * (x**2 + y**2) / corner**2)


def graded(image: np.ndarray, ratio: float, angle_rad: float) -> np.ndarray:
    """Light that falls off evenly towards ``angle_rad``: ``ratio`` between the brightest corner and the darkest."""
    x, y = _from_middle(image.shape)
    along = x * np.cos(angle_rad) + y * np.sin(angle_rad)
    share = (along - along.min()) / np.ptp(along)
    return np.asarray(image, np.float32) * (1 - np.float32(1 - 1 / ratio) * share)


def hazy(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Haze of grey 190 ± 20 takes this share of the contrast and lays itself over the image."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(190, 20, (4, 6)).astype(np.float32)
    veil = cv2.resize(coarse, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return (1 - np.float32(share)) * np.asarray(image, np.float32) + np.float32(share) * veil


def brightened(image: np.ndarray, share: np.ndarray, factor: float) -> np.ndarray:
    """``factor`` times as bright where ``share``, (height, width), is 1."""
    return np.asarray(image, np.float32) * (1 + np.float32(factor - 1) * share)


def glared(image: np.ndarray, places_px: Iterable[np.ndarray], radius_px: float, peak: float) -> np.ndarray:
    """Glare spots: Gaussian of ``radius_px`` about each place, ``peak`` grey values in the middle."""
    result = np.array(image, np.float32)
    for place in places_px:
        result += np.float32(peak) * _spot(image.shape, place, radius_px)
    return result


def unevenly_lit(photograph: Photograph, ratio: float) -> np.ndarray:
    """The target lit from one side: from face to face, and across each, brightness falls by up to ``ratio``, fixed to
    the target; the board keeps its light."""
    light = np.array([0.55, -0.45, 0.70])
    image = photograph.grey.astype(np.float32)
    for face in photograph.faces:
        share = photograph.face_region(face)
        rows, columns = (np.flatnonzero(share.any(axis)) for axis in (1, 0))
        if not len(rows):
            continue
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        normal = photograph.camera_from_target.rotation.T @ np.cross(face.matrix[:, 0], face.matrix[:, 1])
        towards = 0.5 + 0.5 * float(light @ normal) / np.linalg.norm(light)
        low, high = face.xy_mm.min(0), face.xy_mm.max(0)
        place = (photograph.in_plane(face, window) - low) / (high - low)
        across = np.clip(place[..., 0], -0.3, 1.3)
        factor = ratio ** (-(0.5 * (1 - towards) + 0.5 * across))
        image[window] *= 1 + share[window] * (factor.astype(np.float32) - 1)
    return image


def without_circles(photograph: Photograph, labels: Iterable[str]) -> np.ndarray:
    """These circles painted over in the colour around them."""
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, RING_REACH, labels):
        image[window] = _covered(image[window], unit, disc_share(unit, HIDDEN_REACH, 1.0))
    return image


def cut_circles(photograph: Photograph, labels: Iterable[str], share: float, seed: int) -> np.ndarray:
    """Of each of these circles a segment of that share of its area is covered in the colour around, from any side."""
    rng = np.random.default_rng(seed)
    heights = np.linspace(-1, 1, 2001)
    beyond = (np.arccos(heights) - heights * np.sqrt(1 - heights**2)) / np.pi
    offset = float(np.interp(-share, -beyond, heights))
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, RING_REACH, labels):
        segment = half_share(unit, rng.uniform(0, 2 * np.pi), offset)
        image[window] = _covered(image[window], unit, disc_share(unit, HIDDEN_REACH, 1.0) * segment)
    return image


def half_darker(photograph: Photograph, share: float, angle_rad: float = 0.6) -> np.ndarray:
    """One half of every circle has this share less contrast against its surroundings, the same half in all images, as
    where an LED stands off the middle behind it. Rims stay where they are: any shift of a centre is the detector's."""
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, 1.3):
        distance = np.hypot(unit[..., 0], unit[..., 1])
        ring = (distance > 1.1) & (distance < 1.3)
        if ring.any():
            inside = disc_share(unit, 1.15, 1.0) * half_share(unit, angle_rad)
            contrast = image[window] - np.median(image[window][ring])
            image[window] -= (np.float32(share) * inside * contrast).astype(np.float32)
    return image


def board_covered(photograph: Photograph, share: float, seed: int, grey: float = 120.0) -> np.ndarray:
    """A sheet of paper over this share of the board, from one of its sides."""
    rng = np.random.default_rng(seed)
    outline = photograph.board.outline_mm()
    low, high = outline.min(0), outline.max(0)
    axis, from_low = int(rng.integers(2)), bool(rng.integers(2))
    edge = share * (high[axis] - low[axis])
    low, high = low - 20.0, high + 20.0
    if from_low:
        high[axis] = low[axis] + 20.0 + edge
    else:
        low[axis] = high[axis] - 20.0 - edge
    sheet = _polygon(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))
    cover = photograph.region(photograph.camera.project(photograph.board.xyz_camera(sheet)), 0.7)
    body = np.vstack([photograph.outline_px(face) for face in (*photograph.faces, *photograph.hidden_faces)])
    cover *= 1 - photograph.region(cv2.convexHull(body.astype(np.float32))[:, 0], 0.7)
    paper = grey + rng.normal(0, 2, photograph.grey.shape).astype(np.float32)
    return photograph.grey * (1 - cover) + paper * cover


def covered_labels(photograph: Photograph, image: np.ndarray, least: float = 8.0) -> tuple[set[str], set[str]]:
    """Labels of circles in view whose pixels an image has changed by ``least`` grey values or more: (all over, in
    part). All over means in nine tenths of the disc."""
    changed = np.abs(image - photograph.grey) >= least
    whole, part = set(), set()
    for label, window, unit in _circles(photograph, 1.1, photograph.must_find):
        disc = np.hypot(unit[..., 0], unit[..., 1]) < 1.1
        share = changed[window][disc].mean() if disc.any() else 0.0
        (whole if share > 0.9 else part if share > 0.02 else set()).add(label)
    return whole, part


def behind(
    photograph: Photograph, planes: Iterable[Plane], levels: Iterable[tuple[float, float]], margin_mm: float = MARGIN_MM
) -> np.ndarray:
    """The photograph with planes drawn behind target and board; ``levels`` : grey values of each one's circles and of
    its plate. Later ones cover earlier ones; those that reach behind the camera are not drawn."""
    image = photograph.grey.astype(np.float32)
    free = 1 - photograph.foreground()
    for plane, (circle, plate) in zip(planes, levels, strict=True):
        if (plane.xyz_camera(plane.outline_mm(margin_mm))[:, 2] < 10).any():
            continue
        share = photograph.region(photograph.outline_px(plane, margin_mm), 0.7)
        drawn = image * (1 - share) + np.float32(plate) * share
        for i in range(len(plane.labels)):
            if found := photograph.circle(plane, i, 1.5):
                window, unit = found
                disc = disc_share(unit).astype(np.float32)
                drawn[window] += disc * (np.float32(circle) - drawn[window])
        image += free * (drawn - image)
    return image


def _covered(pixels: np.ndarray, unit: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """A window with a circle covered in the colour of its ring, a linear fit, with the ring's noise."""
    distance = np.hypot(unit[..., 0], unit[..., 1])
    ring = (distance > HIDDEN_REACH) & (distance < RING_REACH)
    terms = np.stack([np.ones_like(distance), unit[..., 0], unit[..., 1]], axis=-1)
    if ring.sum() < 10:
        return pixels
    values = pixels[ring]
    usual = np.abs(values - np.median(values)) <= 3 * max(float(np.median(np.abs(values - np.median(values)))), 2.0)
    fit, *_ = np.linalg.lstsq(terms[ring][usual], values[usual], rcond=None)
    spread = float(np.std(values[usual] - terms[ring][usual] @ fit))
    noise = np.random.default_rng(pixels.shape).normal(0, spread, pixels.shape)
    return (pixels * (1 - cover) + (terms @ fit + noise) * cover).astype(np.float32)


def _circles(photograph: Photograph, reach: float, labels: Iterable[str] | None = None):
    """Label and surroundings (:meth:`Photograph.circle`) of circles in view, of all where no labels are given."""
    wanted = None if labels is None else set(labels)
    for plane in photograph.planes:
        for i, label in enumerate(plane.labels):
            if (wanted is None or label in wanted) and (found := photograph.circle(plane, i, reach)):
                yield label, *found


def _polygon(corners: np.ndarray, steps: int = 20) -> np.ndarray:
    """A polygon with points along its sides, so that lens distortion bends them."""
    share = np.arange(steps)[:, None] / steps
    return np.vstack([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])


def _filtered(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return cv2.filter2D(np.asarray(image, np.float32), -1, kernel, borderType=cv2.BORDER_REPLICATE)


def _spot(shape: tuple[int, ...], place_px: Iterable[float], radius_px: float) -> np.ndarray:
    """A Gaussian of height 1."""
    px, py = place_px
    x = np.exp(-(((np.arange(shape[1]) - px) / radius_px) ** 2) / 2)
    y = np.exp(-(((np.arange(shape[0]) - py) / radius_px) ** 2) / 2)
    return np.outer(y, x).astype(np.float32)


def _from_middle(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    height, width = shape
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    return x.astype(np.float32), y.astype(np.float32)
