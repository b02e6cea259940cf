"""Figures of a run's report: residuals, the target in space, photographs with overlays."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from stcal.labels import dot_cells, parse_label, parse_labels
from stcal.report.figure import AXIS_COLOURS, COLOURS, INK, SMALL, calm, locator, new_figure, round_below, uri
from stcal.report.text import number


def group_colours(names: list[str]) -> dict[str, str]:
    """Returns a colour for each group, by its place in the list."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def board_residuals(residuals_um: dict[str, list[float]], reach_um: float, height_um: float) -> str:
    """Draws residual vectors of the board's dots on its grid, row 0 at the top; colour is the out-of-plane part.

    Parameters
    ----------
    residuals_um : by ``board:row:column``, (3,) each
    reach_um : residual that is drawn as long as the grid's pitch
    height_um : end of the colour scale for the out-of-plane part; both are the same for all groups, to compare them
    """
    cells = dot_cells(parse_labels(residuals_um)).astype(float)
    vectors = np.array(list(residuals_um.values()), float).reshape(-1, 3)
    per_cell = reach_um if reach_um > 0 else 1.0
    height_um = height_um if height_um > 0 else 1.0
    bar_um = round_below(per_cell)
    figure = new_figure(4.3, 3.5)
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
    calm(axes)
    bar = figure.colorbar(dots, cax=figure.add_axes((0.88, 0.30, 0.022, 0.52)))
    bar.ax.tick_params(labelsize=SMALL - 1, length=2)
    bar.outline.set_visible(False)
    bar.ax.set_title("z, µm", fontsize=SMALL)
    return uri(figure)


def image_bars(rows: list[dict], colours: dict[str, str]) -> str:
    """Draws the RMS residual of each image as a bar in its group's colour, and its largest residual as a tick.

    The horizontal axis is the number of the image in the table.
    """
    figure = new_figure(10.5, 2.9)
    axes = figure.add_axes((0.055, 0.16, 0.935, 0.75))
    place = np.arange(1, len(rows) + 1)
    axes.bar(place, [row["rms_px"] for row in rows], 0.72, color=[colours.get(row["group"], INK) for row in rows])
    axes.plot(place, [row["max_px"] for row in rows], "_", color=INK, markersize=9, markeredgewidth=1.4)
    axes.set(xlim=(0.2, len(rows) + 0.8), ylim=(0, None))
    groups = [row["group"] for row in rows]
    for i, group in enumerate(
        groups
    ):  # the name of each group stands over its first image, so that colour is not needed
        if group not in groups[:i]:
            axes.annotate(group, (i + 0.6, 1.0), xycoords=("data", "axes fraction"), va="bottom", fontsize=SMALL,
                          color=colours.get(group, INK), parse_math=False)  # fmt: skip
    step = max(1, int(np.ceil(len(rows) / 40)))
    axes.set_xticks(place[::step])
    calm(axes, "number of the image in the table below", "residual, px", "y")
    return uri(figure)


def scene_view(scene: dict, camera: dict, colours: dict[str, str], azimuth: float) -> str:
    """Draws cameras, boards and the target's circles in the target frame."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    target = np.array(list(scene["circles"].values()), float).reshape(-1, 3)
    positions = np.array([view["position_mm"] for view in scene["cameras"]], float).reshape(-1, 3)
    boards = {name: np.array(xyz, float).reshape(-1, 3) for name, xyz in scene["boards"].items()}
    everything = np.vstack([target, positions, *boards.values()])
    depth = 0.07 * float(np.ptp(everything, axis=0).max()) if len(everything) else 1.0
    figure, axes = _space(everything, 5.4, 4.9, elevation=22, azimuth=azimuth)
    lines, ink = [], []
    for view in scene["cameras"]:
        pyramid = frustum(view, camera, depth)
        lines += pyramid
        ink += [colours.get(view["group"], INK)] * len(pyramid)
    axes.add_collection3d(Line3DCollection(lines, colors=ink, linewidths=0.9), autolim=False)
    for name, xyz in boards.items():
        axes.scatter(*xyz.T, s=2, color=colours.get(name, INK), depthshade=False)
    axes.scatter(*target.T, s=4, color="black", depthshade=False)
    return uri(figure)


def target_view(circles: dict[str, list[float]], faces: dict[str, dict], azimuth: float) -> str:
    """Draws the target's circles, and the frame of each face with its name at the end of the normal."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    xyz = np.array(list(circles.values()), float).reshape(-1, 3)
    reach = 0.2 * float(np.ptp(xyz, axis=0).max()) if len(xyz) else 1.0
    lines, ink, names, sheets = [], [], [], []
    for name, face in faces.items():
        centres = np.array([p for label, p in circles.items() if parse_label(label).plane == name], float).reshape(
            -1, 3
        )
        pose = np.array(face["target_from_face"], float)
        lines += [np.array([pose[:3, 3], pose[:3, 3] + reach * pose[:3, i]]) for i in range(3)]
        ink += AXIS_COLOURS
        sheets += outline(centres, pose)
        names.append((name, (centres.mean(0) if len(centres) else pose[:3, 3]) + 0.9 * reach * pose[:3, 2]))
    figure, axes = _space(np.vstack([xyz, *lines, *[at for _, at in names]]), 5.4, 4.9, elevation=24, azimuth=azimuth)
    axes.add_collection3d(Poly3DCollection(sheets, facecolors="#7f93a8", alpha=0.16), autolim=False)
    axes.scatter(*xyz.T, s=9, color=INK, depthshade=False)
    axes.add_collection3d(Line3DCollection(lines, colors=ink, linewidths=1.6), autolim=False)
    for name, at in names:
        axes.text(*at, name, fontsize=11, weight="bold", ha="center", va="center", parse_math=False)
    return uri(figure)


def outline(xyz: np.ndarray, target_from_face: np.ndarray) -> list[np.ndarray]:
    """Returns the convex hull of a face's circles in its plane, or nothing if they do not span the plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return [xyz[ConvexHull((xyz - target_from_face[:3, 3]) @ target_from_face[:3, :2]).vertices]]
    except (QhullError, ValueError):
        return []


def frustum(pose: dict, camera: dict, depth: float) -> list[np.ndarray]:
    """Returns the lines of a camera's pyramid; rows of ``axes`` are the camera's axes, with Z as viewing direction."""
    at, axes = np.array(pose["position_mm"], float), np.array(pose["axes"], float)
    half = depth * np.array(camera["size_px"]) / (2 * np.array(camera["focal_px"]))
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    corners = [at + depth * axes[2] + sx * half[0] * axes[0] + sy * half[1] * axes[1] for sx, sy in around]
    sides = [np.array([at, corner]) for corner in corners]
    return [*sides, np.array([*corners, corners[0]]), np.array([at, at + 2.2 * depth * axes[2]])]


def _space(xyz: np.ndarray, width: float, height: float, elevation: float, azimuth: float):
    """Returns figure and axes in space, with one scale for X, Y and Z, just large enough for the points."""
    from mpl_toolkits.mplot3d import Axes3D

    low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (-np.ones(3), np.ones(3))
    margin = 0.03 * max(float((high - low).max()), 1e-6)
    low, high = low - margin, high + margin
    figure = new_figure(width, height)
    axes: Any = figure.add_axes(Axes3D(figure, rect=(0.0, 0.03, 0.95, 0.94)))  # has no types of its own
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.08)
    axes.set_proj_type("ortho")
    axes.view_init(elevation, azimuth)
    for axis, name in ((axes.xaxis, "X"), (axes.yaxis, "Y"), (axes.zaxis, "Z")):
        axis.set_pane_color((0.955, 0.965, 0.975, 1))
        axis.set_label_text(f"{name}, mm", fontsize=SMALL + 0.5)
        axis.line.set_color("#9aa0a8")
        axis.set_major_locator(locator())
    axes.tick_params(labelsize=SMALL - 0.5, pad=0)
    axes.grid(False)
    return figure, axes


DIGITS = 2
"""Number of decimals of coordinates in mm: far finer than a screen shows."""
AXIS = 0.2
"""Length of the faces' axes, as a share of the target's extent."""
CAMERA = 0.07
"""Depth of a camera's pyramid, as a share of the scene's extent."""
SHEET = "#7f93a8"


def space_parts(report: dict, colours: dict[str, str]) -> list[dict]:
    """Returns the parts to be drawn, in the target frame.

    Parameters
    ----------
    report : content of ``report.json``
    colours : by group

    Returns
    -------
    list of dict
        ``kind`` (``line``, ``sheet``, ``point``, ``text``), ``xyz`` (points, mm), ``colour``, and for some parts
        ``name``, ``size`` (px) and ``target``: whether the part belongs to the target.
    """
    scene = report["scene"]
    parts = _faces(scene["circles"], report["faces"])
    for label, xyz in scene["circles"].items():
        parts.append(_part("point", [xyz], "#000000", name=label, size=2.2, target=True))
    for group, dots in scene["boards"].items():
        parts += [_part("point", [xyz], colours.get(group, INK), size=1.2) for xyz in dots]
        if dots:
            parts.append(_part("text", [np.mean(dots, axis=0)], colours.get(group, INK), name=f"group {group}"))
    places = [view["position_mm"] for view in scene["cameras"]]
    everything = np.array([*scene["circles"].values(), *chain.from_iterable(scene["boards"].values()), *places])
    depth = CAMERA * float(np.ptp(everything, axis=0).max()) if len(everything) else 1.0
    for camera in scene["cameras"]:
        path = _traced(frustum(camera, report["camera"], depth))
        parts.append(_part("line", path, colours.get(camera["group"], INK), name=camera["image"], size=1.1))
    return parts


def _faces(circles: dict[str, list[float]], faces: dict[str, dict]) -> list[dict]:
    """Returns sheet, axes and name of each face."""
    xyz = np.array(list(circles.values()), float).reshape(-1, 3)
    reach = AXIS * float(np.ptp(xyz, axis=0).max()) if len(xyz) else 1.0
    parts = []
    for name, face in faces.items():
        centres = np.array([p for label, p in circles.items() if parse_label(label).plane == name], float).reshape(
            -1, 3
        )
        pose = np.array(face["target_from_face"], float)
        parts += [_part("sheet", corners, SHEET, target=True) for corners in outline(centres, pose)]
        origin = pose[:3, 3]
        for axis, colour in enumerate(AXIS_COLOURS):
            parts.append(_part("line", [origin, origin + reach * pose[:3, axis]], colour, size=1.6, target=True))
        middle = centres.mean(0) if len(centres) else origin
        parts.append(_part("text", [middle + 0.9 * reach * pose[:3, 2]], "#1c2733", name=name, target=True))
    return parts


def _traced(lines: list[np.ndarray]) -> np.ndarray:
    """Returns the pyramid's lines as one path from its tip, which goes back to the tip after each line."""
    tip = lines[0][:1]
    return np.vstack([section for line in lines for section in (tip, line)])


def _part(kind: str, xyz, colour: str, **more) -> dict:
    return {"kind": kind, "xyz": np.round(np.asarray(xyz, float), DIGITS).tolist(), "colour": colour, **more}


FIRST_IMAGES = 100
"""Number of rows and overlays that the page has room for."""
LONGEST = 0.04
"""Length of the vector that nineteen of twenty residuals do not exceed, as a share of the image's width."""
Residuals = np.ndarray
"""Array (n, 4) of circles: centre x, y and residual x, y, px."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """One photograph.

    ``says`` : what was found in it; ``jpeg`` : as a data URI; ``vectors`` : path of an SVG in px of the image.
    """

    name: str
    says: str
    jpeg: str
    vectors: str


@dataclass(frozen=True, slots=True)
class Photographs:
    """All photographs that the page shows, with the common scale of their vectors.

    ``box`` : the images' place in px, pixel centres integer; ``aspect`` : width by height; ``factor`` : by which all
    vectors are lengthened, 0 if there are none; ``stroke`` : width of their lines, px; ``bar`` : path of a bar, as long
    as the vector of a residual of ``bar_px``.
    """

    each: tuple[Photograph, ...]
    box: str
    aspect: float
    factor: float
    stroke: float
    bar: str
    bar_px: float


def photographs(report: dict, overlays: dict[str, bytes], residuals: Mapping[str, Residuals]) -> Photographs:
    """Returns all photographs that the page shows, with vectors on one scale.

    Parameters
    ----------
    report : content of ``report.json``
    overlays : JPEG by image name
    residuals : by image name
    """
    width, height = report["camera"]["size_px"]
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    lengths = np.concatenate([np.zeros(0), *(np.hypot(*entry[:, 2:].T) for entry in residuals.values())])
    usual = float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0
    factor = round_below(LONGEST * width / usual) if usual > 0 else 0.0
    bar_px = round_below(LONGEST * width / factor) if factor else 0.0
    shown = []
    for name, jpeg in overlays.items():
        entry = mapped.get(name)
        says = f"{entry['observations']} centres, {number(entry['rms_px'], 4)} px RMS" if entry else "not mapped"
        uri = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        shown.append(Photograph(name, says, uri, _path(residuals.get(name, np.zeros((0, 4))), factor)))
    box = f"-0.5 -0.5 {width} {height}"
    bar = f"M{0.98 * width:.1f} {0.97 * height:.1f}h{-factor * bar_px:.1f}"
    return Photographs(tuple(shown), box, round(width / height, 5), factor, round(width / 450, 2), bar, bar_px)


def _path(residuals: Residuals, factor: float) -> str:
    """Returns a path of lines from each centre along its residual."""
    return "".join(f"M{x:.1f} {y:.1f}l{factor * dx:.1f} {factor * dy:.1f}" for x, y, dx, dy in residuals.tolist())


def shown_overlays(report: dict) -> list[str]:
    """Returns the names of the images whose overlays the page shows.

    These are all images, or in a large set those that most deserve a look.
    """
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    noted = {note["image"] for note in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in noted, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]
