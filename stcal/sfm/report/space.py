"""Parts that the page's script draws and turns (``report/templates/space.js``): target, boards and cameras."""

from itertools import chain

import numpy as np

from stcal.labels import parse_label
from stcal.report.figure import AXIS_COLOURS, INK
from stcal.sfm.report.figures import frustum, outline

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
