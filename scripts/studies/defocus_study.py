"""How the fit of a circle answers to blur: shift of its centre by blur that varies, loss of its radius by blur.

    .venv/bin/python scripts/studies/defocus_study.py [--scenes N] [--points N]

Circles without noise, tilted and out of focus: the mean of their sharp images through points of a round pupil, each an
ellipse with an edge of 0.55 px. First single circles: blur over the smaller radius, and the loss of the radius over
σ²/2R, which `stcal.sfm.adjust.rims` puts back. Then the circles of simulated scenes of four groups, each image with its
own plane of focus, corrected by `stcal.sfm.detect.defocus` as a run corrects them: shift of the centres against sharp
twins, RMS, before and after; the shift as a multiple of the correction; and the coefficients of the response that would
fit best, with the scatter that is left of single circles and of the means over a face in an image.
"""

import argparse
import itertools

import numpy as np
from scipy.special import ndtr

from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_images
from stcal.labels import DotLabel
from stcal.report.text import text_table
from stcal.sfm.data.model import Centres, ImageObservations
from stcal.sfm.data.patterns import patterns_of
from stcal.sfm.detect.circles.candidates import Ellipses
from stcal.sfm.detect.circles.centres import measure_centres
from stcal.sfm.detect.defocus import FAR_BLUR, RESPONSE, RESPONSE_OF_BLUR2, correct_defocus
from stcal.synthetic.scene import ImageCircles, SceneOptions, image_circles, make_scene

FOCAL_PX, DEPTH_MM, FOCUS_MM, EDGE_PX = 1743.0, 1000.0, 1150.0, 0.55
MIDDLE_MM, AZIMUTH = np.array([30.0, 20.0]), np.radians(30.0)
TILTS_DEG, RADII_PX, PUPILS_MM = (35, 50, 62, 72), (5, 8, 14, 28), (5.0, 10.0, 16.0)
DARK, BRIGHT = 20.0, 220.0
WIDTH_PX, FOCUS_SPREAD_MM, SCENE_PUPILS_MM = 1620, 80.0, (16.0, 10.0)
DOTS = 4
"""Every so many dots of the board are taken."""
MAX_TILT_RAD = np.radians(75)
CLASSES = (0.0, 0.1, 0.15, 0.2, 0.3, FAR_BLUR)
LEAST_PX = 0.0015
"""Smallest shift that counts in the coefficients: below it the pixels' squares matter."""


def seen(
    xyz: np.ndarray,
    normal: np.ndarray,
    radius_mm: float,
    pupil_mm: float,
    focus_mm: float,
    focal_px: float,
    points: int,
) -> Centres:
    """What is measured of one circle, normalised coordinates; ``points`` : of the pupil, in pairs."""
    axes = np.linalg.svd(normal[None])[2][1:].T
    turn = (np.arange(points // 2) + 0.5) * np.pi * (3 - np.sqrt(5))
    rho = np.sqrt((np.arange(len(turn)) + 0.5) / len(turn))
    pupil = pupil_mm / 2 * rho[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    pupil = np.concatenate([pupil, -pupil])
    through = np.column_stack([xyz[:2] - pupil, np.full(len(pupil), xyz[2])])
    centres, shapes = circle_images(through, axes, np.full(len(pupil), radius_mm))
    true, shape = (each[0] for each in circle_images(xyz[None], axes, np.array([radius_mm])))
    confusion_px = focal_px * pupil_mm / 2 * abs(1 / xyz[2] - 1 / focus_mm)
    size = 2 * int(focal_px * np.linalg.norm(shape, 2) + 2.2 * confusion_px + 10)
    corner = np.floor(focal_px * true) - size // 2
    y, x = np.mgrid[:size, :size].astype(float)
    image = np.zeros((size, size))
    for centre, own in zip(focal_px * (centres + pupil / focus_mm), focal_px * shapes, strict=True):
        inverse = np.linalg.inv(own)
        on_unit = (np.stack([x, y], -1) - (centre - corner)) @ inverse
        length, slope = np.linalg.norm(on_unit, axis=2), np.linalg.norm(on_unit @ inverse, axis=2)
        image += ndtr(-(length - 1) * length / np.maximum(slope, 1e-9) / EDGE_PX)
    image = DARK + (BRIGHT - DARK) * image / len(pupil)
    camera = Camera(size, size, np.full(2, focal_px), -corner, np.zeros(12))
    start = Ellipses((focal_px * true - corner)[None], focal_px * shape[None], np.array([BRIGHT - DARK]))
    return measure_centres(image.astype(np.float32), camera, start, start)


def single_circles(points: int) -> list[list[str]]:
    """Rows of the loss of the radius."""
    rows = []
    for tilt_deg in TILTS_DEG:
        tilt = np.radians(tilt_deg)
        normal = np.array([np.sin(tilt) * np.cos(AZIMUTH), np.sin(tilt) * np.sin(AZIMUTH), -np.cos(tilt)])
        for radius_px in RADII_PX:
            circle = np.append(MIDDLE_MM, DEPTH_MM), normal, radius_px * DEPTH_MM / FOCAL_PX
            sharp, *blurred = (seen(*circle, pupil_mm, FOCUS_MM, FOCAL_PX, points) for pupil_mm in (1e-3, *PUPILS_MM))
            for pupil_mm, found in zip(PUPILS_MM, blurred, strict=True):
                before, after = (FOCAL_PX * np.sqrt(np.linalg.det(each.shape[0])) for each in (sharp, found))
                blur2 = float(found.blur_px[0] ** 2)
                loss = (before - after) / ((blur2 - float(sharp.blur_px[0] ** 2)) / (2 * before))
                wide = np.sqrt(blur2) / (radius_px * np.cos(tilt))
                rows.append([f"{tilt_deg}", f"{radius_px}", f"{pupil_mm:g}", f"{wide:.2f}", f"{loss:.2f}"])
    return rows


def photograph(
    circles: ImageCircles, rows: list[int], camera: Camera, name: str, pupil_mm: float, focus_mm: float, points: int
) -> ImageObservations:
    """The circles of one image; ``camera`` : without distortion."""
    found = Centres.concatenate(
        [
            seen(
                circles.xyz_camera[k],
                circles.normal_camera[k],
                float(circles.radius_mm[k]),
                pupil_mm,
                focus_mm,
                float(camera.focal[0]),
                points,
            )
            for k in rows
        ]
    )
    centre_px = camera.pixel_from_normalised(found.centre)
    labels = tuple(circles.labels[k] for k in rows)
    return ImageObservations(
        name, name, labels, centre_px, found.centre, found.shape, found.covariance_px2, blur_px=found.blur_px
    )


def scene_circles(seed: int, pupil_mm: float, points: int) -> np.ndarray:
    """Circles of one scene: blur over the smaller radius, shift and correction (2 each), px, and number of the face."""
    pairs = (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3"))
    scene = make_scene(
        SceneOptions(seed=seed, width=WIDTH_PX, height=WIDTH_PX * 2 // 3, images_per_group=4, groups=pairs)
    )
    focal_px = float(scene.camera.focal.mean())
    camera = Camera(WIDTH_PX, WIDTH_PX * 2 // 3, np.full(2, focal_px), scene.camera.centre, np.zeros(12))
    rng, blurred, sharp = np.random.default_rng(seed), [], []
    for group in scene.groups:
        for i in range(4):
            circles = image_circles(scene, group, i)
            focus_mm = float(np.median(circles.xyz_camera[:, 2]) + rng.uniform(-FOCUS_SPREAD_MM, FOCUS_SPREAD_MM))
            rows = [
                k
                for k, label in enumerate(circles.labels)
                if circles.tilt_rad[k] < MAX_TILT_RAD and (not isinstance(label, DotLabel) or k % DOTS == 0)
            ]
            blurred.append(photograph(circles, rows, camera, f"{group}/{i}", pupil_mm, focus_mm, points))
            sharp.append(photograph(circles, rows, camera, f"{group}/{i}", 1e-3, focus_mm, 2))
    corrected, _ = correct_defocus(blurred, camera, patterns_of(scene.target, scene.board))
    found, number = [], 0
    for image, twin, own in zip(blurred, sharp, corrected, strict=True):
        smaller_px = np.linalg.svd(image.shape, compute_uv=False)[:, 1] * focal_px
        planes = [label.plane for label in image.labels]
        numbers = number + np.array([sorted(set(planes)).index(plane) for plane in planes])
        number = int(numbers.max()) + 1
        shift, correction = (focal_px * (image.centre - each.centre) for each in (twin, own))
        found.append(np.column_stack([image.blur_px / smaller_px, shift, correction, numbers]))
    return np.concatenate(found)


def scenes(number: int, points: int) -> list[str]:
    """Lines on the shifts and their corrections in scenes."""
    parts = [scene_circles(101 + i, SCENE_PUPILS_MM[i % len(SCENE_PUPILS_MM)], points) for i in range(number)]
    face = np.concatenate([part[:, 5] + 1000 * i for i, part in enumerate(parts)])
    wide, shift, correction = np.concatenate(parts)[:, 0], *np.split(np.concatenate(parts)[:, 1:5], 2, axis=1)
    rows = []
    for low, high in (*itertools.pairwise(CLASSES), (0.0, FAR_BLUR)):
        own = (wide >= low) & (wide < high)
        before, after = (np.sqrt((each[own] ** 2).sum(1).mean()) for each in (shift, shift - correction))
        multiple = (shift[own] * correction[own]).sum() / (correction[own] ** 2).sum()
        rows.append([f"{low:g} to {high:g}", f"{own.sum()}", f"{before:.4f}", f"{after:.4f}", f"{multiple:.2f}"])
    gradient = correction / (RESPONSE + RESPONSE_OF_BLUR2 * wide**2)[:, None]
    large = (np.linalg.norm(shift, axis=1) > LEAST_PX) & (np.linalg.norm(gradient, axis=1) > 0) & (wide < FAR_BLUR)
    response = (shift * gradient).sum(1)[large] / (gradient**2).sum(1)[large]
    design, weight = np.column_stack([np.ones(large.sum()), wide[large] ** 2]), 1 / response**2
    for _ in range(5):
        best = np.linalg.solve((design.T * weight) @ design, (design.T * weight) @ response)
        off = np.abs(response / (design @ best) - 1)
        weight = 1 / (response * np.maximum(1, off / 0.2)) ** 2
    means = [
        (shift[own] * correction[own]).sum() / (correction[own] ** 2).sum()
        for own in (large & (face == k) for k in np.unique(face))
        if own.sum() >= 4
    ]
    return [
        *text_table([["<blur / radius", "circles", "shift px", "corrected px", "multiple"], *rows]),
        f"best response: {best[0]:.2f} + {best[1]:.1f} (blur / radius)²; in use {RESPONSE} + {RESPONSE_OF_BLUR2}",
        f"scatter about it: {1.4826 * np.median(off):.2f} of single circles, {np.std(means):.2f} of faces in an image",
    ]


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--points", type=int, default=60, help="of the pupil")
    args = parser.parse_args()
    rows = single_circles(args.points)
    print("\n".join(text_table([["tilt °", "radius px", "pupil mm", "blur / radius", "loss / (σ²/2R)"], *rows])))
    print(f"loss of radius over σ²/2R: median {np.median([float(row[-1]) for row in rows]):.2f}\n")
    print("\n".join(scenes(args.scenes, args.points)))


if __name__ == "__main__":
    main()
