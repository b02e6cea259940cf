"""What the report is made of: tables, the look of the page, and plots as SVG data URIs.

matplotlib is loaded when the first plot is drawn.
"""

import base64
import io
import math
import warnings
from html import escape

import numpy as np

from stcal.sfm.observations import face_of

# The palette of Okabe & Ito (2008), darkened where it would be faint on white; then shades for many groups.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b8559a", "#3d9bd1", "#c98a00", "#5b3f8c", "#555555", "#8c2d04", "#00606b")
INK, FAINT = "#333333", "#d5d9de"
AXIS_COLOURS = ("#c1272d", "#2e8b3d", "#2457a8")
SMALL = 7.5

NONE = "–"
PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}: calibration report</title>
<style>{style}</style>
</head>
<body>
<header>
{banner}<nav aria-label="Contents"><ol>{links}</ol></nav>
</header>
<main>
{body}</main>
</body>
</html>
"""
STYLE = """
:root { color-scheme: light; --ink: #1c2733; --soft: #556270; --line: #d9dee4; --tint: #f5f7f9; --link: #0b5394; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-padding-top: 1rem; }
body { margin: 0 auto; max-width: 76rem; padding: 2rem 1.5rem 4rem; background: #fff; color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .75rem; padding-bottom: .3rem; border-bottom: 2px solid var(--ink); }
h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; } h4 { font-size: .95rem; margin: .6rem 0 .3rem; }
p { margin: .4rem 0 .7rem; max-width: 50rem; } a { color: var(--link); }
.counts { font-size: 1.05rem; color: var(--soft); }
.alarm { max-width: none; padding: .9rem 1.1rem; background: #b3261e; color: #fff; border-radius: 4px;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
nav ol { display: flex; flex-wrap: wrap; gap: .15rem 1.2rem; list-style: none; margin: .9rem 0 0; padding: .6rem 0;
  border-top: 1px solid var(--line); border-bottom: 1px solid var(--line); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: .7rem; margin: 0 0 1rem; }
.tiles div { border: 1px solid var(--line); border-radius: 4px; padding: .6rem .8rem; }
.tiles b { font-size: 1.5rem; font-variant-numeric: tabular-nums; }
.tiles span { display: block; color: var(--soft); font-size: .88rem; line-height: 1.35; }
.scroll { overflow-x: auto; margin: .4rem 0 1rem; max-width: 100%; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums lining-nums; }
th, td { padding: .22rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { vertical-align: bottom; white-space: normal; color: var(--soft); font-weight: 600;
  line-height: 1.25; border-bottom: 1px solid #8b97a3; }
thead th.over { text-align: center; white-space: nowrap; border: 0; }
thead th.over:not(:empty) { border-bottom: 1px solid var(--line); }
tbody th { font-weight: 600; } .l { text-align: left; }
tbody th[scope=row] { position: sticky; left: 0; background: #fff; }
tbody tr:hover > * { background: var(--tint); }
.text .l { white-space: normal; overflow-wrap: break-word; min-width: 7.5rem; }
.facts thead { display: none; } .facts th { color: var(--soft); font-weight: 400; vertical-align: top; }
.facts tr:first-child > * { border-top: 1px solid var(--line); }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: 0 2rem; }
.columns > div { min-width: 0; }
.columns.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 1rem 1.5rem; }
figure { margin: 0; break-inside: avoid; } figure img { display: block; width: 100%; height: auto; }
figcaption { font-size: .88rem; color: var(--soft); }
.plots figcaption { text-align: center; } .plots img { max-width: 32rem; margin: 0 auto; }
.legend { font-size: .9rem; max-width: none; } .legend span { white-space: nowrap; margin-right: .6rem; }
.swatch { display: inline-block; width: .75em; height: .75em; margin: 0 .35em 0 .2em !important; border-radius: 2px;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
details { margin: .5rem 0; } summary { cursor: pointer; font-weight: 600; padding: .25rem 0; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); gap: 1rem; }
.cell { min-height: 8rem; } .photo img { border-radius: 3px; } .open { display: block; cursor: zoom-in; }
.photo figcaption { padding-top: .25rem; overflow-wrap: anywhere; } .photo b { color: var(--ink); }
.steps { display: none; }
.photo:target { position: fixed; inset: 0; z-index: 9; margin: 0; padding: .8rem; background: #fff; display: flex;
  flex-direction: column; align-items: center; justify-content: center; }
.photo:target .open { display: contents; cursor: default; }
.photo:target img { min-height: 0; max-width: 100%; max-height: calc(100% - 2.5rem); object-fit: contain; }
.photo:target .steps { display: inline; margin-left: 1rem; } .steps a { margin-left: .6rem; }
@media (max-width: 40rem) { body { padding: 1rem .8rem 3rem; } th, td { padding: .22rem .45rem; }
  .text td.l { min-width: 9.5rem; } .facts td.l { min-width: 0; }
  .wide { overflow-x: auto; } .wide img { min-width: 44rem; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; } nav { display: none; } h2 { margin-top: 1.4rem; }
  h2, h3, h4, summary { break-after: avoid; } .scroll { overflow: visible; } tr { break-inside: avoid; }
  table { font-size: 6.8pt; } th, td { padding: .1rem .28rem; } .grid, .plots { grid-template-columns: 1fr 1fr; }
  .cell { break-inside: avoid; } @page { margin: 14mm; } }
"""


class Html(str):
    """Text that is markup already; everything else is escaped."""

    __slots__ = ()


def number(value: float | None, digits: int) -> str:
    """Fixed digits; a dash where there is no value, and no minus before zero."""
    if value is None or not math.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


def table(columns: list[str], rows: list[list], over: list[tuple[str, int]] | None = None, css: str = "") -> Html:
    """A table that scrolls by itself. The first cell of a row is its head.

    Parameters
    ----------
    columns : heads; ``<`` in front aligns the column to the left
    rows : cells, text that is escaped or :class:`Html`
    over : a line of heads above, each with the number of columns it spans
    css : class of the table
    """
    left = [column.startswith("<") for column in columns]
    side = [' class="l"' if each else "" for each in left]
    head = "".join(f'<th scope="col"{s}>{escape(c.lstrip("<"))}</th>' for c, s in zip(columns, side, strict=True))
    if over:
        line = "".join(f'<th colspan="{span}" class="over">{escape(text)}</th>' for text, span in over)
        head = f"{line}</tr><tr>{head}"
    lines = []
    for row in rows:
        texts = [cell if isinstance(cell, Html) else escape(str(cell)) for cell in row]
        cells = "".join(f"<td{s}>{text}</td>" for text, s in zip(texts[1:], side[1:], strict=True))
        lines.append(f'<tr><th scope="row"{side[0]}>{texts[0]}</th>{cells}</tr>')
    body = "\n".join(lines)
    return Html(
        f'<div class="scroll"><table class="{css}"><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{body}\n</tbody></table></div>\n"
    )


def cells(row: dict, spec: str) -> list:
    """Values of a row by words of ``key``, or ``key:digits`` for numbers."""
    found = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in found]


def join(values) -> str:
    return ", ".join(str(value) for value in values) or NONE


def fold(summary: str, content: str) -> str:
    return f"<details><summary>{escape(summary)}</summary>\n{content}</details>\n"


def plot(uri: str, alt: str, caption: str = "", css: str = "") -> str:
    return f'<figure class="{css}"><img src="{uri}" alt="{escape(alt)}"><figcaption>{caption}</figcaption></figure>\n'


def swatch(name: str, colour: str) -> str:
    return f'<span class="swatch" style="background:{colour}"></span>{escape(name)}'


def legend(colours: dict[str, str]) -> str:
    entries = " ".join(f"<span>{swatch(name, colour)}</span>" for name, colour in colours.items())
    return f'<p class="legend">Groups: {entries}</p>\n'


def group_colours(names: list[str]) -> dict[str, str]:
    """A colour for each group, by its place in the list."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def round_below(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above ``value``; 1 where there is no value."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def board_residuals(residuals_um: dict[str, list[float]], reach_um: float, height_um: float) -> str:
    """Residual vectors of the board's dots on its grid, row 0 at the top; colour is the out-of-plane part.

    Parameters
    ----------
    residuals_um : by ``board:row:column``, (3,) each
    reach_um : the length drawn as the grid's pitch, and ``height_um`` the end of the colour scale for the out-of-plane
        part: the same for all groups so that they can be compared
    """
    cells = np.array([[int(v) for v in label.split(":")[1:]] for label in residuals_um], float).reshape(-1, 2)
    vectors = np.array(list(residuals_um.values()), float).reshape(-1, 3)
    per_cell = reach_um if reach_um > 0 else 1.0
    height_um = height_um if height_um > 0 else 1.0
    bar_um = round_below(per_cell)
    figure = _figure(4.3, 3.5)
    axes = figure.add_axes((0.08, 0.16, 0.76, 0.80))
    dots = axes.scatter(
        *cells[:, ::-1].T, c=vectors[:, 2], s=30, cmap="RdBu_r", vmin=-height_um, vmax=height_um, zorder=2
    )
    dots.set(edgecolor="#777777", linewidth=0.5)
    axes.quiver(
        *cells[:, ::-1].T, *(vectors[:, :2] / per_cell).T, angles="xy", scale_units="xy", scale=1, width=0.006, zorder=3
    )
    last = cells.max(0) if len(cells) else np.zeros(2)
    axes.set(xlim=(-1.2, last[1] + 1.2), ylim=(last[0] + 2.0, -1.2), aspect="equal")
    axes.plot([0, bar_um / per_cell], [last[0] + 1.45] * 2, color=INK, linewidth=2.5, solid_capstyle="butt")
    axes.text(bar_um / per_cell + 0.25, last[0] + 1.45, f"{bar_um:g} µm", va="center", fontsize=SMALL + 1)
    axes.set_xlabel("column", fontsize=SMALL)
    axes.set_ylabel("row", fontsize=SMALL)
    axes.set(xticks=np.arange(0, last[1] + 1, 2), yticks=np.arange(0, last[0] + 1, 2))
    _calm(axes)
    bar = figure.colorbar(dots, cax=figure.add_axes((0.88, 0.30, 0.022, 0.52)))
    bar.ax.tick_params(labelsize=SMALL - 1, length=2)
    bar.outline.set_visible(False)
    bar.ax.set_title("z, µm", fontsize=SMALL)
    return _uri(figure)


def image_bars(rows: list[dict], colours: dict[str, str]) -> str:
    """RMS residual of each image as a bar in its group's colour, its largest residual as a tick; all over their number
    in the table."""
    figure = _figure(10.5, 2.9)
    axes = figure.add_axes((0.055, 0.15, 0.935, 0.80))
    place = np.arange(1, len(rows) + 1)
    axes.bar(place, [row["rms_px"] for row in rows], 0.72, color=[colours.get(row["group"], INK) for row in rows])
    axes.plot(place, [row["max_px"] for row in rows], "_", color=INK, markersize=9, markeredgewidth=1.4)
    axes.set(xlim=(0.2, len(rows) + 0.8), ylim=(0, None))
    step = max(1, int(np.ceil(len(rows) / 40)))
    axes.set_xticks(place[::step])
    axes.set_xlabel("number of the image in the table below", fontsize=SMALL + 0.5)
    axes.set_ylabel("residual, px", fontsize=SMALL + 0.5)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    _calm(axes)
    return _uri(figure)


def scene_view(scene: dict, camera: dict, colours: dict[str, str], azimuth: float) -> str:
    """Cameras, boards and the target's circles, in the target frame."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    target = np.array(list(scene["circles"].values()), float).reshape(-1, 3)
    positions = np.array([each["position_mm"] for each in scene["cameras"]], float).reshape(-1, 3)
    boards = {name: np.array(xyz, float).reshape(-1, 3) for name, xyz in scene["boards"].items()}
    everything = np.vstack([target, positions, *boards.values()])
    depth = 0.07 * float(np.ptp(everything, axis=0).max()) if len(everything) else 1.0
    figure, axes = _space(everything, 5.4, 4.9, elevation=22, azimuth=azimuth)
    lines, ink = [], []
    for each in scene["cameras"]:
        frustum = _frustum(each, camera, depth)
        lines += frustum
        ink += [colours.get(each["group"], INK)] * len(frustum)
    axes.add_collection3d(Line3DCollection(lines, colors=ink, linewidths=0.9), autolim=False)
    for name, xyz in boards.items():
        axes.scatter(*xyz.T, s=2, color=colours.get(name, INK), depthshade=False)
    axes.scatter(*target.T, s=4, color="black", depthshade=False)
    return _uri(figure)


def target_view(circles: dict[str, list[float]], faces: dict[str, dict], azimuth: float) -> str:
    """The target's circles, and the frame of each face with its name at the end of the normal."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    xyz = np.array(list(circles.values()), float).reshape(-1, 3)
    reach = 0.2 * float(np.ptp(xyz, axis=0).max()) if len(xyz) else 1.0
    lines, ink, names, sheets = [], [], [], []
    for name, face in faces.items():
        own = np.array([p for label, p in circles.items() if face_of(label) == name], float).reshape(-1, 3)
        pose = np.array(face["target_from_face"], float)
        lines += [np.array([pose[:3, 3], pose[:3, 3] + reach * pose[:3, i]]) for i in range(3)]
        ink += AXIS_COLOURS
        sheets += _outline(own, pose)
        names.append((name, (own.mean(0) if len(own) else pose[:3, 3]) + 0.9 * reach * pose[:3, 2]))
    figure, axes = _space(np.vstack([xyz, *lines, *[at for _, at in names]]), 5.4, 4.9, elevation=24, azimuth=azimuth)
    axes.add_collection3d(Poly3DCollection(sheets, facecolors="#7f93a8", alpha=0.16), autolim=False)
    axes.scatter(*xyz.T, s=9, color=INK, depthshade=False)
    axes.add_collection3d(Line3DCollection(lines, colors=ink, linewidths=1.6), autolim=False)
    for name, at in names:
        axes.text(*at, name, fontsize=11, weight="bold", ha="center", va="center", parse_math=False)
    return _uri(figure)


def _outline(xyz: np.ndarray, target_from_face: np.ndarray) -> list[np.ndarray]:
    """The convex hull of a face's circles in its plane, or nothing where they span none."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return [xyz[ConvexHull((xyz - target_from_face[:3, 3]) @ target_from_face[:3, :2]).vertices]]
    except (QhullError, ValueError):
        return []


def _frustum(pose: dict, camera: dict, depth: float) -> list[np.ndarray]:
    """Lines of a camera's pyramid; rows of ``axes`` are the camera's axes, Z the way it looks."""
    at, axes = np.array(pose["position_mm"], float), np.array(pose["axes"], float)
    half = depth * np.array(camera["size_px"]) / (2 * np.array(camera["focal_px"]))
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    corners = [at + depth * axes[2] + sx * half[0] * axes[0] + sy * half[1] * axes[1] for sx, sy in around]
    sides = [np.array([at, corner]) for corner in corners]
    return [*sides, np.array([*corners, corners[0]]), np.array([at, at + 2.2 * depth * axes[2]])]


def _space(xyz: np.ndarray, width: float, height: float, elevation: float, azimuth: float):
    """Figure and axes in space, one scale for X, Y and Z, just large enough for the points."""
    from mpl_toolkits.mplot3d import Axes3D

    low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (-np.ones(3), np.ones(3))
    margin = 0.03 * max(float((high - low).max()), 1e-6)
    low, high = low - margin, high + margin
    figure = _figure(width, height)
    axes = figure.add_axes(Axes3D(figure, rect=(0.0, 0.03, 0.95, 0.94)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.08)
    axes.set_proj_type("ortho")
    axes.view_init(elevation, azimuth)
    for axis, name in ((axes.xaxis, "X"), (axes.yaxis, "Y"), (axes.zaxis, "Z")):
        axis.set_pane_color((0.955, 0.965, 0.975, 1))
        axis.set_label_text(f"{name}, mm", fontsize=SMALL + 0.5)
        axis.line.set_color("#9aa0a8")
        axis.set_major_locator(_locator())
    axes.tick_params(labelsize=SMALL - 0.5, pad=0)
    axes.grid(False)
    return figure, axes


def _locator():
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(5, steps=[1, 2, 5, 10])


def _figure(width: float, height: float):
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="none")
    FigureCanvasSVG(figure)
    return figure


def _calm(axes) -> None:
    axes.tick_params(labelsize=SMALL, length=2, color="#9aa0a8")
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa0a8")


def _uri(figure) -> str:
    """The figure as an SVG data URI, the same bytes for the same figure."""
    import matplotlib

    stream = io.BytesIO()
    settings = {"svg.fonttype": "path", "svg.hashsalt": "stcal"}
    with warnings.catch_warnings(), matplotlib.rc_context(settings):
        warnings.filterwarnings("ignore", "Glyph")  # a face may be named in any script
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode()
