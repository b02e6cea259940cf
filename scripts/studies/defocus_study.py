"""How the fit of a circle answers to blur: shift of its centre by blur that varies, loss of its radius by blur.

    .venv/bin/python scripts/studies/defocus_study.py [--pupil POINTS]

Simulated circles without noise, tilted and out of focus: the mean of their sharp images through points of a
round pupil, each an ellipse with an edge of 0.55 px. Printed for each case: blur over the smaller radius;
shift of the centre as a multiple of the gradient of the squared blur, measured, and as `stcal.sfm.detect.defocus` has
it; loss of the radius over σ²/2R, which `stcal.sfm.adjust.rims` puts back.
"""

import argparse

import numpy as np
from scipy.special import ndtr

from stcal.geometry.camera import Camera
from stcal.geometry.conic import circle_images
from stcal.report.text import text_table
from stcal.sfm.detect.circles.candidates import Ellipses
from stcal.sfm.detect.circles.centres import measure_centres
from stcal.sfm.detect.defocus import RESPONSE, RESPONSE_OF_BLUR2

FOCAL_PX, DEPTH_MM, FOCUS_MM, EDGE_PX = 1743.0, 1000.0, 1150.0, 0.55
MIDDLE_MM, AZIMUTH = np.array([30.0, 20.0]), np.radians(30.0)
TILTS_DEG, RADII_PX, PUPILS_MM = (15, 35, 50, 62, 72), (5, 8, 14, 28), (0.001, 5.0, 10.0, 16.0)
DARK, BRIGHT = 20.0, 220.0


def seen(tilt_deg: float, radius_px: float, pupil_mm: float, points: int) -> tuple[np.ndarray, float, float, float]:
    """Shift of the centre (2,) px, squared blur px², loss of the radius and the radius, px."""
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt) * np.cos(AZIMUTH), np.sin(tilt) * np.sin(AZIMUTH), -np.cos(tilt)])
    axes, xyz = np.linalg.svd(normal[None])[2][1:].T, np.append(MIDDLE_MM, DEPTH_MM)
    radius_mm = radius_px * DEPTH_MM / FOCAL_PX
    turn = (np.arange(points) + 0.5) * np.pi * (3 - np.sqrt(5))
    pupil = pupil_mm / 2 * np.sqrt((np.arange(points) + 0.5) / points)[:, None] * [[np.cos(t), np.sin(t)] for t in turn]
    pupil = np.concatenate([pupil, -pupil])
    through = np.column_stack([xyz[:2] - pupil, np.full(len(pupil), DEPTH_MM)])
    centres, shapes = circle_images(through, axes, np.full(len(pupil), radius_mm))
    true, shape = (each[0] for each in circle_images(xyz[None], axes, np.array([radius_mm])))
    size = 2 * int(radius_px + 4 * 3 + 8)
    corner = np.floor(FOCAL_PX * true) - size // 2 + 0.13
    y, x = np.mgrid[:size, :size].astype(float)
    image = np.zeros((size, size))
    for centre, own in zip(FOCAL_PX * (centres + pupil / FOCUS_MM), FOCAL_PX * shapes, strict=True):
        value, vector = np.linalg.eigh(own @ own.T)
        inverse = (vector / np.sqrt(value)) @ vector.T
        on_unit = np.stack([x, y], -1) @ inverse - (centre - corner) @ inverse
        rho, slope = np.linalg.norm(on_unit, axis=2), np.linalg.norm(on_unit @ inverse, axis=2)
        image += ndtr(-(rho - 1) * rho / np.maximum(slope, 1e-9) / EDGE_PX)
    image = DARK + (BRIGHT - DARK) * image / len(pupil)
    camera = Camera(size, size, np.full(2, FOCAL_PX), -corner, np.zeros(12))
    start = Ellipses((FOCAL_PX * true - corner)[None], FOCAL_PX * shape[None], np.array([BRIGHT - DARK]))
    found = measure_centres(image.astype(np.float32), camera, start, start)
    radius = FOCAL_PX * np.sqrt(np.linalg.det(shape))
    lost = radius - FOCAL_PX * np.sqrt(np.linalg.det(found.shape[0]))
    return found.centre_px[0] - start.centre_px[0], float(found.blur_px[0] ** 2), float(lost), float(radius)


def main() -> None:
    """The table of all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pupil", type=int, default=200, help="half the number of points of the pupil")
    points = parser.parse_args().pupil
    rows, ratios, losses = [], [], []
    for tilt_deg in TILTS_DEG:
        tilt = np.radians(tilt_deg)
        normal = np.array([np.sin(tilt) * np.cos(AZIMUTH), np.sin(tilt) * np.sin(AZIMUTH), -np.cos(tilt)])
        gradient = normal[:2] / (normal @ np.append(MIDDLE_MM, DEPTH_MM)) / FOCAL_PX
        for radius_px in RADII_PX:
            sharp = seen(tilt_deg, radius_px, PUPILS_MM[0], 1)
            for pupil_mm in PUPILS_MM[1:]:
                shift, blur2, lost, radius = seen(tilt_deg, radius_px, pupil_mm, points)
                away = 1 / DEPTH_MM - 1 / FOCUS_MM
                of_blur2 = 2 * (blur2 - sharp[1]) / away * gradient
                response = float((shift - sharp[0]) @ of_blur2 / (of_blur2 @ of_blur2))
                wide2 = blur2 / (radius_px * np.cos(tilt)) ** 2
                expected = RESPONSE + RESPONSE_OF_BLUR2 * wide2
                loss = (lost - sharp[2]) / ((blur2 - sharp[1]) / (2 * radius))  # the edge of 0.55 px takes nothing off
                ratios.append(response / expected)
                losses.append(loss)
                rows.append(
                    [
                        f"{tilt_deg}",
                        f"{radius_px}",
                        f"{pupil_mm:g}",
                        *(f"{v:.2f}" for v in (np.sqrt(wide2), response, expected, loss)),
                    ]
                )
    heads = ["tilt °", "radius px", "pupil mm", "blur / radius", "response", "formula", "loss / (σ²/2R)"]
    print("\n".join(text_table([heads, *rows])))
    spread = 1.4826 * np.median(np.abs(np.array(ratios) - 1))
    print(f"response over formula: median {np.median(ratios):.2f}, σ {spread:.2f}")
    print(f"loss of radius over σ²/2R: median {np.median(losses):.2f}")


if __name__ == "__main__":
    main()
