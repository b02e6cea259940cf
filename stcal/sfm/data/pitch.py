"""The pitch of a board's dots as images show it, where the board file's cannot be."""

from collections.abc import Sequence

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import DegenerateError
from stcal.geometry.plane import fit_homography, homography_jacobian
from stcal.labels import DotLabel, dot_cells
from stcal.sfm.data.observations import ImageObservations

MIN_DOTS = 9
"""Of an image that is measured."""
MOST_OFF = 0.05
"""Share of the pitch: blur makes dots larger than they are by less."""


def measured_pitch_mm(images: Sequence[ImageObservations], board: BoardDesign) -> float | None:
    """Distance of neighbouring dots, mm, if their radius is what the board file says: the median over all dots of how
    far the homography of each image's grid puts a step, in radii of the dot's ellipse; None where no image shows
    enough dots."""
    radius, found = board.radius_of(), []
    for image in images:
        own = [i for i, label in enumerate(image.labels) if isinstance(label, DotLabel)]
        if len(own) < MIN_DOTS:
            continue
        labels = [label for label in image.labels if isinstance(label, DotLabel)]
        cells = dot_cells(labels)[:, ::-1].astype(float)
        try:
            local = homography_jacobian(fit_homography(cells, image.centre[own]), cells)
        except DegenerateError:
            continue
        steps = np.sqrt(np.abs(np.linalg.det(local) / np.linalg.det(image.shape[own])))
        found.append(steps * [radius[label] for label in labels])
    return float(np.median(np.concatenate(found))) if found else None


def pitch_hint(images: Sequence[ImageObservations], board: BoardDesign) -> str:
    """What to correct in the board file; empty where its pitch agrees with the images."""
    pitch = measured_pitch_mm(images, board)
    if pitch is None or abs(pitch / board.pitch_mm - 1) < MOST_OFF:
        return ""
    return (
        f"; dots of radius_mm {board.radius_mm:g} are {pitch:.3g} mm apart in the images, the board file says pitch_mm "
        f"{board.pitch_mm:g}: correct pitch_mm, or radius_mm"
    )
