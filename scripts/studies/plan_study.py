"""What the σ of a target depend on, as `stcal-sfm plan` forecasts them: one thing at a time departs from a base.

.venv/bin/python scripts/studies/plan_study.py

The reference target and board, groups 12, 14, 15, 23 of ten images at 1 m, ±40°, 5184×3456 px of a 24 mm lens, a board
of σ 5 µm; image noise 1 % and contrast 70 % of full scale, edges blurred by 0.76 px. No photograph and no Monte Carlo:
the covariance of the joint adjustment at the nominal geometry. Prints, as Markdown, the σ of the position of the face
that is known worst and the largest σ of a face's orientation, both as lengths over the three axes.

A second table goes through the apertures of that lens: blur of an edge (σ, px) DEPTH_MM before the plane in focus, by
defocus (a disc of diameter f² / (N (s − f)) · |d − s| / d, whose σ is a quarter of it), by diffraction (0.42 λ N, the
Gaussian of the Airy pattern) and by the lens and the pixels themselves, and the σ with all edges blurred so.
"""

from dataclasses import replace

import numpy as np

from scripts.runner import head, row, script
from stcal.design import reference_board, reference_target
from stcal.sfm.planning import forecast
from stcal.sfm.planning.forecast import nominal_poses
from stcal.sfm.planning.session import PlanOptions, pairs_of_faces, plan
from stcal.sfm.runs.run_options import RunOptions

BASE = PlanOptions()
FOCAL_MM, SENSOR_MM, WAVELENGTH_MM = 24.0, 36.0, 550e-6
"""A lens of 24 mm before a full-frame sensor, in green light."""
DEPTH_MM = 150.0
"""From the plane in focus to the nearest part of target and board."""
GROUPS = {"5: and 34, a loop": "12,14,15,23,34", "8: every pair of neighbours": "12,14,15,23,25,34,35,45"}


def centre_noise(
    noise: float = forecast.IMAGE_NOISE, contrast: float = forecast.CONTRAST, blur: float = forecast.BLUR_PX
):
    """CentreNoise of images with this noise and contrast (fractions of full scale) and blur of edges (px)."""
    edge = forecast.CentreNoise.expected().edge
    return forecast.CentreNoise(
        edge * noise / forecast.IMAGE_NOISE * forecast.CONTRAST / contrast * float(np.sqrt(blur / forecast.BLUR_PX))
    )


CASES = (
    ("images in each group", "{}", (3, 5, 20, 40), lambda n: {"images": n}),
    ("spread of the views", "±{}°", (15, 25, 60), lambda deg: {"spread_deg": float(deg)}),
    ("distance", "{} mm", (700, 1500, 2500), lambda mm: {"distance_mm": float(mm)}),
    ("width of the images", "{} px", (2592, 1728), lambda px: {"width": px}),
    ("groups", "{}", GROUPS, lambda name: {"groups": pairs_of_faces(GROUPS[name], reference_target())}),
    ("σ of the board's dots", "{} µm", (2, 10, 20), lambda _: {}),
    ("board", "{}", ("a new print for each group",), lambda _: {"one_board": False}),
    ("intrinsics", "{}", ("`--refine-camera`",), lambda _: {"run": RunOptions(refine_camera=True)}),
    ("image noise", "{} %", (0.3, 3), lambda share: {"noise": centre_noise(noise=share / 100)}),
    ("contrast", "{} %", (35,), lambda share: {"noise": centre_noise(contrast=share / 100)}),
    ("blur of the edges", "{:g} px", (1.5, 3.0), lambda px: {"noise": centre_noise(blur=px)}),
)
"""What departs, in words, the form of its values, these, and the change of the options."""


def forecast_of(options: PlanOptions, sigma_mm: float | None = None) -> str:
    """Cells of a row: worst face, σ of its position, largest σ of an orientation, σ of a centre."""
    target, board = reference_target(), reference_board()
    if sigma_mm is not None:
        board = replace(board, sigma_mm=sigma_mm)
    found = plan(options, target, board, nominal_poses(target, None))
    face, position = found.forecast.worst()
    turns = [np.degrees(np.sqrt(np.trace(c[:3, :3]))) for c in found.forecast.face_covariance.values()]
    return f"{face} | {1e3 * position:.2f} | {1e3 * max(turns):.2f} | {found.centre_sigma_px:.4f}"


def blur_px(f_number: float) -> tuple[float, float, float]:
    """σ of the blur of an edge by defocus, by diffraction, and of all together."""
    pixel_mm = SENSOR_MM / BASE.width
    before = BASE.distance_mm - DEPTH_MM
    disc = FOCAL_MM**2 / (f_number * (BASE.distance_mm - FOCAL_MM)) * DEPTH_MM / before
    defocus, diffraction = disc / 4 / pixel_mm, 0.42 * WAVELENGTH_MM * f_number / pixel_mm
    return defocus, diffraction, float(np.linalg.norm([defocus, diffraction, forecast.BLUR_PX]))


@script()
def main(_) -> None:
    print("| | | worst face | σ of its position, µm | largest σ of an orientation, mdeg | σ of a centre, px |")
    print("|---|---|---|---|---|---|")
    row("base", "", forecast_of(BASE))
    for what, form, values, change in CASES:
        for value in values:
            sigma_mm = value / 1e3 if form == "{} µm" else None
            row(what, form.format(value), forecast_of(replace(BASE, **change(value)), sigma_mm))
    print()
    blurs = "defocus, px", "diffraction, px", "blur, px"
    head("aperture", *blurs, "worst face", "σ, µm", "σ, mdeg", "σ of a centre, px")
    for f_number in (2.8, 4, 5.6, 8, 11, 16, 22):
        blurs = blur_px(f_number)
        found = forecast_of(replace(BASE, noise=centre_noise(blur=blurs[-1])))
        row(f"f/{f_number:g}", *(f"{each:.2f}" for each in blurs), found)
