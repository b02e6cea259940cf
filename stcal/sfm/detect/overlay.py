"""Overlay pictures: images with the measured circles drawn on them."""

import hashlib
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.io.cache import keep, kept, made_by
from stcal.labels import BOARD, CircleLabel, DotLabel, Label
from stcal.sfm.data.group_model import ImageObservations

# OpenCV's order: blue, green, red. The palette of Okabe & Ito (2008), for all kinds of colour vision.
PALETTE = [(0, 159, 230), (115, 158, 0), (66, 228, 240), (167, 121, 204), (0, 94, 213), (178, 114, 0)]
BOARD_COLOUR = (233, 180, 86)
CACHE_VERSION = 2
"""Version of the drawing, which increases with every change of it, so that older kept overlays are not used."""
QUALITY = 82
MIN_WIDTH_PX = 1000
LEFT_OUT = "left out of the adjustment"
LEAST_CROSS_PX = 15  # size of the cross on a circle that was left out, at least
MIN_LABEL_GAP = 70.0  # smallest distance between numbered dots, px at text size 1
NAME_ROOM = 100.0
"""Distance of a face's name from the nearest centre, in units of its letters, from which on it has room there."""


def kept_overlay(
    cache: Path,
    digest: str,
    thumbnail: bytes,
    scale: float,
    observations: ImageObservations,
    faces: list[str],
    focal_px: np.ndarray,
    notes: int,
    left_out: frozenset[Label] = frozenset(),
) -> bytes:
    """JPEG of :func:`draw_overlay`, or that of an earlier run if the ``cache`` has it by the image's ``digest``."""
    stated = CACHE_VERSION, made_by(), cv2.__version__, digest, scale, observations.name, observations.labels
    stated = *stated, faces, notes, sorted(left_out)
    hasher = hashlib.sha256("\0".join(map(repr, stated)).encode("utf-8", "backslashreplace"))
    for values in (observations.centre_px, observations.shape, focal_px):
        hasher.update(values.tobytes())
    path = cache / f"overlay-{hasher.hexdigest()[:40]}.npz"
    picture = kept(path, lambda arrays, _: arrays["jpeg"].tobytes())
    if picture is None:
        picture = draw_overlay(thumbnail, scale, observations, faces, focal_px, notes, left_out)
        keep(path, {"jpeg": np.frombuffer(picture, np.uint8)}, {})
    return picture


def draw_overlay(
    thumbnail: bytes,
    scale: float,  # size of the thumbnail over the image's
    observations: ImageObservations,
    faces: list[str],  # all face ids, for colours that stay the same over the images
    focal_px: np.ndarray,
    notes: int,  # number of things left out, for the caption
    left_out: Collection[Label] = (),  # crossed by a white ×: the adjustment does not use them
) -> bytes:
    """Returns a JPEG with every measured ellipse and its label, and the name of each face."""
    picture = cv2.imdecode(np.frombuffer(thumbnail, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        damaged = f"{observations.name}: its small picture in cache/ is damaged; remove that folder, run again"
        raise InputError("E-RUN-DAMAGED", damaged)
    if picture.shape[1] < MIN_WIDTH_PX:  # room for the labels of small circles
        picture, scale = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2 * scale
    size = max(0.4, picture.shape[1] / 2800)
    colours = {face: PALETTE[i % len(PALETTE)] for i, face in enumerate(faces)} | {BOARD: BOARD_COLOUR}
    numbered = _numbered_dots(observations, MIN_LABEL_GAP * size / scale)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])  # lens distortion within an ellipse is not visible
    for label, centre, shape in zip(observations.labels, observations.centre_px, observations.shape, strict=True):
        key = label.plane
        rim = centre + circle @ (shape * focal_px[:, None]).T
        rim = np.round(((rim + 0.5) * scale - 0.5) * 16).astype(np.int32)  # 1/16 px
        cv2.polylines(picture, [rim], True, colours[key], 1, cv2.LINE_AA, shift=4)
        at = ((centre + 0.5) * scale - 0.5).round().astype(int)
        cv2.drawMarker(picture, at.tolist(), colours[key], cv2.MARKER_CROSS, 5, 1, cv2.LINE_AA)
        text = f"{label.row},{label.column}" if isinstance(label, DotLabel) else label.circle
        if label in numbered or isinstance(label, CircleLabel):
            reach = np.abs(shape * focal_px[:, None]).sum(1).max() * scale
            _text(picture, text, (at[0] + int(0.75 * reach) + 1, at[1] - int(0.75 * reach)), size, colours[key])
        if label in left_out:
            _cross(picture, at, max(LEAST_CROSS_PX, int(1.4 * np.ptp(rim, axis=0).max() / 16)))
    _name_faces(picture, observations, scale, colours, size)
    extended = observations.shape.any(axis=(1, 2))
    kind = "circles" if extended.all() else "circles and corners" if extended.any() else "corners"
    counts = f"{observations.name}: {len(observations)} {kind} labelled"
    counts += f", {notes} note{'s' * (notes > 1)}" if notes else ""
    _text(picture, counts, (8, picture.shape[0] - 10), 1.2 * size, (255,) * 3)
    if crossed := sum(label in left_out for label in observations.labels):
        at = np.array([8 + LEAST_CROSS_PX // 2, picture.shape[0] - 10 - int(60 * size)])
        _cross(picture, at, LEAST_CROSS_PX)
        _text(picture, f"{LEFT_OUT}: {crossed}", (at[0] + LEAST_CROSS_PX, at[1] + 5), 1.2 * size, (255,) * 3)
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return jpeg.tobytes()


def _numbered_dots(observations: ImageObservations, gap_px: float) -> set[DotLabel]:
    """Returns the numbered dots of the first row and column: the first and last, and all if there is room."""
    place = {x: p for x, p in zip(observations.labels, observations.centre_px, strict=True) if isinstance(x, DotLabel)}
    chosen: set[DotLabel] = set()
    for side in ("row", "column"):
        line = sorted((x for x in place if getattr(x, side) == 0), key=lambda x: (x.row, x.column))
        steps = np.linalg.norm(np.diff([place[x] for x in line], axis=0), axis=1) if len(line) > 1 else np.zeros(1)
        chosen |= set(line if np.median(steps) > gap_px else (*line[:1], *line[-1:]))
    return chosen


def _name_faces(picture, observations: ImageObservations, scale: float, colours: dict, size: float) -> None:
    for face in observations.face_ids():
        members = [i for i, x in enumerate(observations.labels) if isinstance(x, CircleLabel) and x.face == face]
        circles = observations.centre_px[members]
        between = (circles[:, None] + circles).reshape(-1, 2) / 2
        room = np.linalg.norm(between[:, None] - observations.centre_px, axis=2).min(1)
        place = between[np.argmax(room)]
        if room.max() * scale < NAME_ROOM * size:
            place = np.array([circles[:, 0].mean(), circles[:, 1].min() - 57 * size / scale])
        at = (place * scale).astype(int)
        _text(picture, f"face {face}", (at[0] - int(45 * size), at[1] + int(12 * size)), 1.5 * size, colours[face])


def _cross(picture, at: np.ndarray, reach: int) -> None:
    """Draws a ×, white with a black edge: no other mark has its shape, and it is seen on any ground."""
    for thickness, ink in ((4, (0, 0, 0)), (2, (255,) * 3)):
        cv2.drawMarker(picture, at.tolist(), ink, cv2.MARKER_TILTED_CROSS, reach, thickness, cv2.LINE_AA)


def _text(picture, text: str, at: tuple[int, int], size: float, colour) -> None:
    text = text.encode("ascii", "replace").decode()
    for thickness, ink in ((3, (0, 0, 0)), (1, colour)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)
