"""The pitch of a board's dots measured in images, for boards whose file states a wrong pitch."""

from collections.abc import Sequence

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import DegenerateError
from stcal.geometry.plane import fit_homography, homography_jacobian
from stcal.labels import DotLabel, dot_cells
from stcal.sfm.data.observations import ImageObservations

MIN_DOTS = 9
"""Smallest number of dots in an image that is used."""
MOST_OFF = 0.05
"""Largest relative deviation of the pitch that is tolerated. Blur enlarges dots by less than this."""


def measured_pitch_mm(images: Sequence[ImageObservations], board: BoardDesign) -> float | None:
    """Returns the distance of neighbouring dots, mm, if their radius in the board file is right.

    The homography of each image's grid gives the step between neighbours in units of the dot's ellipse radius; the
    result is the median over all dots. None if no image shows enough dots.
    """
    radius, pitches = board.radius_of(), []
    for image in images:
        dots = [i for i, label in enumerate(image.labels) if isinstance(label, DotLabel)]
        if len(dots) < MIN_DOTS:
            continue
        labels = [label for label in image.labels if isinstance(label, DotLabel)]
        cells = dot_cells(labels)[:, ::-1].astype(float)
        try:
            local = homography_jacobian(fit_homography(cells, image.centre[dots]), cells)
        except DegenerateError:
            continue
        steps = np.sqrt(np.abs(np.linalg.det(local) / np.linalg.det(image.shape[dots])))
        pitches.append(steps * [radius[label] for label in labels])
    return float(np.median(np.concatenate(pitches))) if pitches else None


def pitch_hint(images: Sequence[ImageObservations], board: BoardDesign) -> str:
    """Returns a hint on what to correct in the board file, empty if its pitch agrees with the images."""
    pitch = measured_pitch_mm(images, board)
    if pitch is None or abs(pitch / board.pitch_mm - 1) < MOST_OFF:
        return ""
    return (
        f"; dots of radius_mm {board.radius_mm:g} are {pitch:.3g} mm apart in the images, the board file says pitch_mm "
        f"{board.pitch_mm:g}: correct pitch_mm, or radius_mm"
    )
