"""Faces of simulated bodies are drawn where their design has them."""

import numpy as np
import pytest

from stcal.synthetic.body import BLACK, WHITE, drawing_of
from stcal.synthetic.designs import tag_cube

TIE_MM = 70.0
"""Side of a cube whose tags have edges in the middle between two pixels of their drawing."""


@pytest.mark.parametrize("size_mm", [45.0, 60.0, TIE_MM])
def test_the_border_of_a_tag_is_drawn_where_it_is(size_mm):
    """Along the middle of the upper and of the left border, all ink: areas are exact, in single precision."""
    face = tag_cube(size_mm).faces[0]
    drawing = drawing_of(face)
    ink = (WHITE - drawing.grey) / (WHITE - BLACK)
    low, high = face.xy_mm.min(0), face.xy_mm.max(0)
    cell = (high - low)[0] / 8  # of APRILTAG_36h11
    for axis, lines in ((0, ink), (1, ink.T)):
        number = round(float((low[1 - axis] + cell / 2 - drawing.origin[1 - axis]) * drawing.px_mm - 0.5))
        line = lines[number].astype(float)
        middle = (line * (np.arange(len(line)) + 0.5)).sum() / line.sum() / drawing.px_mm + drawing.origin[axis]
        most = 1e-3 / drawing.px_mm
        assert middle == pytest.approx((low + high)[axis] / 2, abs=most)
        assert line.sum() / drawing.px_mm == pytest.approx((high - low)[axis], abs=2 * most)
