"""Errors of measured circle centres over their stated σ, under noise, JPEG, defocus, motion and correlated noise.

.venv/bin/python scripts/studies/centre_sigma_study.py [--circles 200] [--seed 1] [--only q75]

Ellipses with axis ratios 0.4…1 at random places against the pixels and JPEG's blocks, rendered with exact coverage on
8 × 8 samples a pixel; ten at a time share contrast (60…200 grey values), as a face's do, and are measured in one call.
Prints, as Markdown, √(mean of eᵀC⁻¹e / 2) for every condition and larger radius, bright circles / dark ones (1 is
right; in brackets how many of the fits were refused, where any were), and, of all, the RMS error per axis in px and
the mean error over its own σ, the larger of x and y.
"""

import argparse
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np

from stcal.geometry.camera import Camera
from stcal.io.images import decode
from stcal.parallel import one_thread
from stcal.sfm.data.model import Centres
from stcal.sfm.detect.circles.candidates import Ellipses
from stcal.sfm.detect.circles.centres import measure_centres
from tests.support import degrade

RADII_PX = (6.0, 8.0, 12.0, 20.0, 30.0)
MARGIN_PX = 18
FINE = 8
LENS_PX = 0.75
"""Blur of a sharp image, before the pixel's own area."""
DARKEST = 25.0
TOGETHER = 10


@dataclass(frozen=True, slots=True)
class Condition:
    """What befalls an image, in this order: blur, motion (px), noise (grey values), what correlates it, JPEG."""

    name: str
    noise: float = 2.0
    defocus: float = 0.0
    motion: float = 0.0
    smooth: float = 0.0
    mosaic: bool = False
    quality: int = 0


CONDITIONS = (
    *(Condition(f"noise {sigma}", noise=sigma) for sigma in (1, 2, 5, 10, 20)),
    *(Condition(f"q{q}, noise {n}", noise=n, quality=q) for q in (95, 85, 75, 60, 50) for n in (1, 3)),
    *(Condition(f"defocus {px}", defocus=px) for px in (1, 2, 3, 4, 5)),
    *(Condition(f"motion {px}", motion=px) for px in (2, 4, 6, 8)),
    *(Condition(f"defocus 3, q{quality}", defocus=3, quality=quality) for quality in (95, 75)),
    *(Condition(f"motion 4, q{quality}", motion=4, quality=quality) for quality in (95, 75)),
    Condition("demosaiced, noise 4", noise=4, mosaic=True),
    Condition("demosaiced, noise 4, q85", noise=4, mosaic=True, quality=85),
    Condition("smoothed 0.7 px, noise 5", noise=5, smooth=0.7),
)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """``share`` : (height, width) how much of each pixel the circles cover; ``centre`` : (n, 2); ``shape`` : (n, 2,
    2); ``cell`` : (height, width) the circle that each pixel is nearest to."""

    share: np.ndarray
    centre: np.ndarray
    shape: np.ndarray
    cell: np.ndarray = field(repr=False)


@lru_cache(maxsize=len(RADII_PX))
def make_field(radius: float, count: int, seed: int) -> Field:
    """Ellipses on a grid, each anywhere in its cell's middle."""
    rng = np.random.default_rng([seed, int(10 * radius)])
    side, columns = int(2 * (radius + MARGIN_PX)), int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    share = np.zeros((rows * side, columns * side), np.float32)
    cell = np.kron(np.arange(rows * columns).reshape(rows, columns), np.ones((side, side), int))
    centres, shapes = [], []
    for k in range(count):
        low = side * np.array([k % columns, k // columns])
        centre = (side - 1) / 2 + rng.uniform(-2, 2, 2)
        angle = rng.uniform(0, np.pi)
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shape = axes @ np.diag([radius, radius * rng.uniform(0.4, 1)]) @ axes.T
        share[low[1] : low[1] + side, low[0] : low[0] + side] = coverage(centre, shape, side)
        centres.append(low + centre)
        shapes.append(shape)
    return Field(share, np.array(centres), np.array(shapes), np.minimum(cell, count - 1))


def coverage(centre: np.ndarray, shape: np.ndarray, side: int) -> np.ndarray:
    """How much of each pixel an ellipse covers, (side, side), through the lens; exact to 1e-4 px."""
    x, y = np.meshgrid(*[(np.arange(side * FINE) + 0.5) / FINE - 0.5] * 2)
    inverse = np.linalg.inv(shape)
    v = np.tensordot(inverse, np.stack([x - centre[0], y - centre[1]]), 1)
    rho = np.maximum(np.hypot(*v), 1e-9)
    distance = (rho - 1) * rho / np.hypot(*np.tensordot(inverse.T, v, 1))
    fine = np.clip(0.5 - FINE * distance, 0, 1)
    fine = cv2.GaussianBlur(fine, (0, 0), LENS_PX * FINE, borderType=cv2.BORDER_REPLICATE)
    return fine.reshape(side, FINE, side, FINE).mean((1, 3))


def photograph(drawn: Field, bright: bool, condition: Condition, seed: int) -> np.ndarray:
    """The image, uint8."""
    rng = np.random.default_rng([seed, bright])
    contrast = np.repeat(rng.uniform(60, 200, -(-len(drawn.centre) // TOGETHER)), TOGETHER)
    image = DARKEST + contrast[drawn.cell] * (drawn.share if bright else 1 - drawn.share)
    if condition.defocus:
        image = degrade.defocused(image, condition.defocus)
    if condition.motion:
        image = degrade.motion_blurred(image, condition.motion, rng.uniform(0, np.pi))
    image = degrade.noisy(image, condition.noise, int(rng.integers(2**31)))
    if condition.mosaic:
        image = cv2.cvtColor(cv2.cvtColor(degrade.stored(image), cv2.COLOR_BAYER_BG2BGR), cv2.COLOR_BGR2GRAY)
    if condition.smooth:
        image = cv2.GaussianBlur(image, (0, 0), condition.smooth)
    if condition.quality:
        return decode(degrade.jpeg(image, condition.quality), condition.name)
    return degrade.stored(image)


def measure(image: np.ndarray, drawn: Field, rng: np.random.Generator) -> Centres:
    """All ellipses, ten in a call, from candidates a little off."""
    height, width = image.shape
    camera = Camera(width, height, [3000.0, 3000.0], [(width - 1) / 2, (height - 1) / 2], np.zeros(8))
    count = len(drawn.centre)
    places = drawn.centre + rng.uniform(-0.15, 0.15, (count, 2))
    start = Ellipses(places, drawn.shape + 0.2 * np.eye(2), np.full(count, 100.0))
    groups = [start.select(np.arange(k, min(k + TOGETHER, count))) for k in range(0, count, TOGETHER)]
    return Centres.concatenate([measure_centres(image, camera, group, group) for group in groups])


def over_sigma(error: np.ndarray, covariance: np.ndarray) -> float:
    """RMS of errors (n, 2) over their σ, per axis."""
    return float(np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean() / 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--circles", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="conditions whose name holds this")
    given = parser.parse_args()
    print("| | " + " | ".join(f"{radius:g} px" for radius in RADII_PX) + " | RMS, px | mean / σ |")
    print("|---|" + "---|" * (len(RADII_PX) + 2))
    for number, condition in enumerate(CONDITIONS):
        if given.only not in condition.name:
            continue
        columns, errors, sizes = [], [], []
        for radius in RADII_PX:
            drawn, texts, refused = make_field(radius, given.circles, given.seed), [], 0
            for bright in (True, False):
                seed = hash((given.seed, number, int(10 * radius)))
                found = measure(photograph(drawn, bright, condition, seed % 2**32), drawn, np.random.default_rng(5))
                error = (found.centre_px - drawn.centre)[found.ok]
                covariance = found.covariance_px2[found.ok]
                texts.append(f"{over_sigma(error, covariance):.2f}" if len(error) else "–")
                refused += int((~found.ok).sum())
                errors.append(error)
                sizes.append(error / np.sqrt(np.einsum("nii->ni", covariance)))
            columns.append(" / ".join(texts) + (f" ({refused})" if refused else ""))
        every, own = np.concatenate(errors), np.concatenate(sizes)
        bias = np.abs(own.mean(0)).max() / own.std() * np.sqrt(len(own))
        rms = np.sqrt((every**2).mean())
        print(f"| {condition.name} | {' | '.join(columns)} | {rms:.4f} | {bias:.1f} |", flush=True)


if __name__ == "__main__":
    with one_thread():
        main()
