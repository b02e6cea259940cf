"""The figures of a run's page: residuals of the board, over the image, by photograph, and over their σ."""

import numpy as np

from stcal.labels import dot_cells, parse_labels
from stcal.report import svg
from stcal.report.camera_figures import mean_residuals_figure, means_of_cells
from stcal.report.svg import Axes, Drawing

CELLS = (12, 8)  # number of cells of the image, in x and y, of which the mean residuals are drawn
MOST, STEP = 4.0, 0.5  # largest residual over its σ that the histogram shows, and the width of its bars


def board_residuals(residuals_um: dict[str, list[float]], reach_um: float, height_um: float) -> Drawing:
    """Draws residual vectors of the board's dots on its grid, row 0 at the top; colour is the out-of-plane part.
    ``residuals_um``: (3,) by ``board:row:column``; ``reach_um``: drawn as long as the pitch; ``height_um``: end of the
    colour scale."""
    cells = dot_cells(parse_labels(residuals_um)).astype(float).reshape(-1, 2)
    vectors = np.array(list(residuals_um.values()), float).reshape(-1, 3)
    per_cell, height_um = (value if value > 0 else 1.0 for value in (reach_um, height_um))
    bar_um, drawing = svg.round_below(per_cell), Drawing(4.3, 3.5)
    last = cells.max(0) if len(cells) else np.zeros(2)
    pitch = min(236 / (last[1] + 2.4), 202 / (last[0] + 3.2))  # pt
    box = (26.0, 10.0, 26 + pitch * (last[1] + 2.4), 10 + pitch * (last[0] + 3.2))
    axes = Axes(drawing, box, (-1.2, last[1] + 1.2), (last[0] + 2.0, -1.2))
    marks = [range(0, int(end) + 1, max(2, int(np.ceil((end + 1) / 12)))) for end in last]
    rows, columns = ((values, [str(value) for value in values]) for values in marks)
    axes.frame("column", "row", "", columns, rows, svg.SMALL)
    places = axes.at(cells[:, 1], cells[:, 0])
    colours = svg.mixed_names((1 + vectors[:, 2] / height_um) / 2, svg.RED_BLUE)
    drawing.discs(places, min(2.75, 0.25 * pitch), colours, "#777777")
    drawing.lines(svg.arrows(places, vectors[:, :2] * pitch / per_cell, 1.4), fill="#000000")
    bar = axes.at([0, bar_um / per_cell], last[0] + 1.45)
    drawing.lines([bar], svg.INK, 2.5)
    drawing.words(bar[1] + [4, 0], f"{bar_um:g} µm", svg.SMALL + 1, "start")
    drawing.scale((box[2] + 14, 50, box[2] + 21, 176), -height_um, height_um, "z, µm", svg.RED_BLUE)
    return drawing


def residual_field(residuals: np.ndarray, size_px: tuple[int, int]) -> Drawing:
    """Draws mean residuals over the image; ``residuals`` : (n, 4), centre and residual, px."""
    means = means_of_cells(residuals[:, :2], residuals[:, 2:4], CELLS, size_px)
    return mean_residuals_figure(*means, CELLS, size_px)


def by_photograph(rows: list[dict]) -> Drawing:
    """Draws the RMS of each photograph of ``residuals_by_image``, and names the largest."""
    rms, drawing = np.array([row["rms_px"] for row in rows]), Drawing(4.3, 2.6)
    axes = Axes(drawing, drawing.panels(top=18)[0], (0, len(rms) + 1), svg.limits(rms, 0.1, low=0))
    number, worst = 1 + np.arange(len(rms)), int(np.argmax(rms))
    axes.frame("photograph", "RMS, px", "y")
    axes.lines([([n, n], [0, value]) for n, value in zip(number, rms, strict=True)], svg.FAINT, 1.5)
    axes.marks(number, rms, "dot", 4, svg.INK)
    axes.marks(number[[worst]], rms[[worst]], "dot", 5, svg.COLOURS[1])
    end = "end" if worst > len(rms) / 2 else "start"
    axes.words(number[worst], rms[worst], rows[worst]["image"], (0, -8), anchor=end, colour=svg.COLOURS[1])
    return drawing


def normalised_residuals(values: np.ndarray) -> Drawing:
    """Draws a histogram of residuals over their σ with the normal distribution."""
    edges = np.arange(-MOST, MOST + STEP, STEP)
    share = np.histogram(np.clip(values, -MOST, MOST), edges)[0] / max(len(values), 1) / STEP
    x = np.linspace(-MOST, MOST, 121)
    normal = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    drawing = Drawing(4.3, 2.6)
    axes = Axes(drawing, drawing.panels(top=18)[0], (-MOST, MOST), svg.limits([*share, normal.max()], low=0))
    corners = ([a, a, a + STEP, a + STEP] for a in edges[:-1])
    axes.lines([(own, [0, h, h, 0]) for own, h in zip(corners, share, strict=True)], svg.AXIS, 0.7, fill=svg.FAINT)
    axes.lines([(x, normal)], svg.COLOURS[0], 1.5)
    axes.frame("residual over its σ", "share per σ")
    beyond = 100 * float((np.abs(values) > 3).mean())
    said = f"{len(values)} coordinates, {beyond:.2f} % beyond 3 σ; line: N(0, 1), 0.27 %"
    drawing.words(((axes.box[0] + axes.box[2]) / 2, 9), said, svg.SMALL)
    return drawing
