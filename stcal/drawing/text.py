"""Text about a drawing for the terminal."""

import numpy as np

from stcal.drawing.draw import OWN, Drawn
from stcal.drawing.shapes import said_mm


def drawn_text(drawn: Drawn) -> str:
    """Return the parts and sheets of a drawing, and how to use them, as text."""
    lines = []
    for part in drawn.parts:
        width, height = np.ptp(part.outline, axis=0).tolist()
        lines.append(f"{part.name}: {said_mm(width)} × {said_mm(height)} mm")
    sheets = len(drawn.sheets)
    kind = "of its own size" if drawn.paper == OWN else drawn.paper
    lines.append(f"{drawn.path}: {sheets} sheet{'s' if sheets > 1 else ''} {kind}")
    if drawn.path.suffix.lower() == ".dxf":
        lines.append("lengths are mm; PATTERN and GROUND are inked or milled, CUT is cut, the other layers are to read")
    else:
        lines.append("print at 100 %, not fitted to the page, and measure the scale bars")
    if drawn.paper != OWN and sheets > len(drawn.parts):
        lines.append(
            "parts that are glued of several sheets are off at the seams: state it in sigma_mm, or print larger"
        )
    return "\n".join(lines)
