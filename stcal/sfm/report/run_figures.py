"""Figures of a run's report: residuals, the target in space, photographs with overlays."""

import base64
from collections.abc import Iterable, Mapping
from itertools import chain

import numpy as np

from stcal.labels import dot_cells, parse_label, parse_labels
from stcal.report.svg import (
    AXIS_COLOURS,
    COLOURS,
    INK,
    RED_BLUE,
    SMALL,
    Axes,
    Drawing,
    arrows,
    mixed_names,
    round_below,
)
from stcal.report.text import number


def group_colours(names: list[str]) -> dict[str, str]:
    """Returns a colour for each group, by its place in the list."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def board_residuals(residuals_um: dict[str, list[float]], reach_um: float, height_um: float) -> Drawing:
    """Draws residual vectors of the board's dots on its grid, row 0 at the top; colour is the out-of-plane part.
    ``residuals_um``: (3,) by ``board:row:column``; ``reach_um``: drawn as long as the pitch; ``height_um``: end of the
    colour scale."""
    cells = dot_cells(parse_labels(residuals_um)).astype(float).reshape(-1, 2)
    vectors = _points(residuals_um.values())
    per_cell = reach_um if reach_um > 0 else 1.0
    height_um = height_um if height_um > 0 else 1.0
    bar_um = round_below(per_cell)
    drawing = Drawing(4.3, 3.5)
    last = cells.max(0) if len(cells) else np.zeros(2)
    pitch = min(236 / (last[1] + 2.4), 202 / (last[0] + 3.2))  # pt
    box = (26.0, 10.0, 26 + pitch * (last[1] + 2.4), 10 + pitch * (last[0] + 3.2))
    axes = Axes(drawing, box, (-1.2, last[1] + 1.2), (last[0] + 2.0, -1.2))
    marks = [[float(i) for i in range(0, int(end) + 1, max(2, int(np.ceil((end + 1) / 12))))] for end in last]
    rows, columns = ((values, [f"{value:g}" for value in values]) for values in marks)
    axes.frame("column", "row", "", columns, rows, SMALL)
    places = axes.at(cells[:, 1], cells[:, 0])
    colours = mixed_names((1 + vectors[:, 2] / height_um) / 2, RED_BLUE)
    drawing.discs(places, min(2.75, 0.25 * pitch), colours, "#777777")
    drawing.lines(arrows(places, vectors[:, :2] * pitch / per_cell, 1.4), fill="#000000")
    bar = axes.at([0, bar_um / per_cell], last[0] + 1.45)
    drawing.lines([bar], INK, 2.5)
    drawing.words(bar[1] + [4, 0], f"{bar_um:g} µm", SMALL + 1, "start")
    drawing.scale((box[2] + 14, 50, box[2] + 21, 176), -height_um, height_um, "z, µm", RED_BLUE)
    return drawing


def _points(places: Iterable) -> np.ndarray:
    """Returns places as an array (n, 3), also if there are none."""
    return np.array(list(places), float).reshape(-1, 3)


def _length(share: float, points: np.ndarray) -> float:
    """Returns a share of the largest extent of points along an axis, mm; 1 if there are none."""
    return share * float(np.ptp(points, axis=0).max()) if len(points) else 1.0


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


DIGITS = 2
"""Number of decimals of coordinates in mm: far finer than a screen shows."""
AXIS = 0.2
"""Length of the faces' axes, as a share of the target's extent."""
CAMERA = 0.07
"""Depth of a camera's pyramid, as a share of the scene's extent."""
SHEET = "#7f93a8"


def space_parts(report: dict, colours: dict[str, str]) -> list[dict]:
    """Returns the parts to be drawn in the target frame: ``kind`` (``line``, ``sheet``, ``point``, ``text``), ``xyz``
    (mm), ``colour``, and for some ``name``, ``size`` (px) and ``target``: whether the part belongs to the target."""
    scene = report["scene"]
    parts = _faces(scene["circles"], report["faces"])
    for label, xyz in scene["circles"].items():
        parts.append(_part("point", [xyz], "#000000", name=label, size=2.2, target=True))
    for group, dots in scene["boards"].items():
        parts += [_part("point", [xyz], colours.get(group, INK), size=1.2) for xyz in dots]
        if len(dots):
            parts.append(_part("text", [np.mean(dots, axis=0)], colours.get(group, INK), name=f"group {group}"))
    places = [view["position_mm"] for view in scene["cameras"]]
    everything = np.array([*scene["circles"].values(), *chain.from_iterable(scene["boards"].values()), *places])
    depth = _length(CAMERA, everything)
    for camera in scene["cameras"]:
        lines = frustum(camera, report["camera"], depth)
        path = np.vstack([section for line in lines for section in (lines[0][:1], line)])  # back to the tip each time
        parts.append(_part("line", path, colours.get(camera["group"], INK), name=camera["image"], size=1.1))
    return parts


def _faces(circles: dict[str, list[float]], faces: dict[str, dict]) -> list[dict]:
    """Returns sheet, axes and name of each face."""
    xyz = _points(circles.values())
    reach = _length(AXIS, xyz)
    parts = []
    for name, face in faces.items():
        centres = _points(place for label, place in circles.items() if parse_label(label).plane == name)
        pose = np.array(face["target_from_face"], float)
        parts += [_part("sheet", corners, SHEET, target=True) for corners in outline(centres, pose)]
        origin = pose[:3, 3]
        for axis, colour in enumerate(AXIS_COLOURS):
            parts.append(_part("line", [origin, origin + reach * pose[:3, axis]], colour, size=1.6, target=True))
        middle = centres.mean(0) if len(centres) else origin
        parts.append(_part("text", [middle + 0.9 * reach * pose[:3, 2]], "#1c2733", name=name, target=True))
    return parts


def _part(kind: str, xyz, colour: str, **more) -> dict:
    return {"kind": kind, "xyz": np.round(np.asarray(xyz, float), DIGITS).tolist(), "colour": colour, **more}


FIRST_IMAGES = 100
"""Number of rows and overlays that the page has room for."""
LONGEST = 0.04
"""Length of the vector that nineteen of twenty residuals do not exceed, as a share of the image's width."""
Residuals = np.ndarray
"""Array (n, 4) of circles: centre x, y and residual x, y, px."""


def photographs(report: dict, overlays: dict[str, bytes], residuals: Mapping[str, Residuals]) -> dict:
    """Returns all photographs that the page shows, with vectors on one scale.

    ``each`` : of each its ``name``, what was found in it, its JPEG as a data URI, and the path of its ``vectors``;
    ``box`` : the images' place in px, pixel centres integer; ``aspect`` : width by height; ``factor`` : by which all
    vectors are lengthened, 0 if there are none; ``stroke`` : width of their lines, px; ``bar`` : path of a bar, as long
    as the vector of a residual of ``bar_px``.
    """
    width, height = report["camera"]["size_px"]
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    lengths = np.concatenate([np.zeros(0), *(np.hypot(*entry[:, 2:].T) for entry in residuals.values())])
    usual = float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0
    factor = round_below(LONGEST * width / usual) if usual > 0 else 0.0
    bar_px = round_below(LONGEST * width / factor) if factor else 0.0
    each = []
    for name, jpeg in overlays.items():
        entry = mapped.get(name)
        says = f"{entry['observations']} centres, {number(entry['rms_px'], 4)} px RMS" if entry else "not mapped"
        lines = residuals.get(name, np.zeros((0, 4))).tolist()
        vectors = "".join(f"M{x:.1f} {y:.1f}l{factor * dx:.1f} {factor * dy:.1f}" for x, y, dx, dy in lines)
        uri = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        each.append({"name": name, "says": says, "jpeg": uri, "vectors": vectors})
    return {
        "each": each,
        "box": f"-0.5 -0.5 {width} {height}",
        "aspect": round(width / height, 5),
        "factor": factor,
        "stroke": round(width / 450, 2),
        "bar": f"M{0.98 * width:.1f} {0.97 * height:.1f}h{-factor * bar_px:.1f}",
        "bar_px": bar_px,
    }


def shown_overlays(report: dict) -> list[str]:
    """Returns the names of the images whose overlays the page shows; of a large set, those that deserve a look."""
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    noted = {note["image"] for note in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in noted, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]
