"""Readers of ``target.toml`` and ``board.toml`` that name every mistake, and writers that add comments for editing."""

import re
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator

from stcal.design import (
    DOTS_SIGMA_MM,
    BoardDesign,
    FaceDesign,
    KnownDistance,
    Polarity,
    StatedSize,
    TargetDesign,
    board_lengths,
    reference_board,
    reference_target,
)
from stcal.errors import InputError, named
from stcal.geometry.plane import inside
from stcal.geometry.rigid import Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_same, save, text_of
from stcal.io.toml import Finite, Positive, Sized, Strict, load_toml, toml_string
from stcal.lengths import radius, stated_unusual

REMEDY = "`stcal-sfm init DIR` writes one"
ROUGH_KEYS = "rough_pose = { origin_mm, x, normal }"
"""Form of the entry in which a face of a target file may state its rough pose."""
MIN_DIRECTION = 1e-6
MAX_SKEW_DEG = 5.0
"""Largest deviation from a right angle between X and normal of a rough pose."""

INWARDS = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""Turns a frame whose Z points out of a body into that of a board or tag, whose Z points into it."""

Vector = tuple[Finite, Finite, Finite]
Count = Annotated[int, Field(ge=2, le=1000, strict=True)]
Squares = Annotated[int, Field(ge=3, le=1000, strict=True)]
"""Number in a row of a chessboard. A grid with fewer inner corners is not recognised as a chessboard; fewer squares
have all inner corners on one line."""
Index = Annotated[int, Field(ge=0, strict=True)]
Name = Annotated[
    str,
    BeforeValidator(lambda v: str(v) if isinstance(v, int) and not isinstance(v, bool) else v),
    Field(min_length=1, pattern=r"^[^:,\s/\\\p{C}]+$"),
]


RimHeight = Annotated[float, Field(ge=-20, le=20)]
"""Height in mm of a rim in front of a circle; negative for a disc that is raised from its plate."""


class _CircleFile(Strict):
    id: Name
    x_mm: Finite
    y_mm: Finite
    radius_mm: Positive
    rim_mm: RimHeight | None = None


class _RoughPoseFile(Strict):
    """Rough pose of a face's drawing, in a frame that all faces share."""

    origin_mm: Vector
    x: Vector
    normal: Vector


class _FaceFile(Strict):
    id: Name
    origin: Name
    x: Name
    y: Name
    rough_pose: _RoughPoseFile | None = None
    outline_mm: list[tuple[Finite, Finite]] | None = Field(default=None, min_length=3, max_length=1000)
    rim_mm: RimHeight | None = None
    circles: list[_CircleFile] = Field(min_length=4)


class PrintedFaceFile(Strict):
    """A face with a board or tags; their keys are those of a board file, and of a tag in a layout."""

    id: Name
    rough_pose: _RoughPoseFile | None = None
    outline_mm: list[tuple[Finite, Finite]] | None = Field(default=None, min_length=3, max_length=1000)
    board: dict[str, Any] | None = None
    tags: list[dict[str, Any]] | None = Field(default=None, min_length=1)
    sigma_mm: Positive | None = None
    size_sigma_mm: Positive | None = None

    def rough(self, where: str) -> Rigid | None:
        """Return the rough pose, None if none is stated: its normal points out of the body, the face's Z into it."""
        return None if self.rough_pose is None else _rough_pose(self.rough_pose, where) @ INWARDS


def _kind_of_face(face: Any) -> str:
    return "<printed>" if isinstance(face, dict) and ("board" in face or "tags" in face) else "<circles>"


class _ScaleFile(Strict):
    first: str = Field(alias="from")
    second: str = Field(alias="to")
    mm: Positive
    sigma_mm: Positive
    drawn: bool = False


class _TargetFile(Sized):
    name: Annotated[str, AfterValidator(lambda v: " ".join(v.split()))] = "target"
    polarity: Polarity
    face: list[
        Annotated[
            Annotated[_FaceFile, Tag("<circles>")] | Annotated[PrintedFaceFile, Tag("<printed>")],
            Discriminator(_kind_of_face),
        ]
    ] = Field(min_length=1)
    scale: list[_ScaleFile] = Field(default=[])

    @model_validator(mode="before")
    @classmethod
    def _without_circles(cls, content: Any) -> Any:
        """Adds a polarity where no face has circles that could have one."""
        faces = content.get("face") if isinstance(content, dict) else None
        if isinstance(faces, list) and faces and all(_kind_of_face(face) == "<printed>" for face in faces):
            return {"polarity": "bright"} | content
        return content


class _CornerFile(Strict):
    row: Index
    column: Index
    radius_mm: Positive


Ppm = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False, strict=True)]
LEAST_PPM = 1e-3
"""Smallest expansion in ppm/K that anyone can state: less is one in 1/K."""
LEAST_PITCH_PPM = 0.1
"""Smallest σ of a pitch in ppm that anyone can state, 5 nm of 50 mm: less is a fraction, per cent, or mm."""
LEAST_C, MOST_C = -100.0, 200.0


def _in_ppm(value: float, per: str = "/K", fraction: str = " 1/K", least: float = LEAST_PPM) -> float:
    if 0 < abs(value) < least:
        percent = "" if per else f", and in % {1e4 * value:g}"
        raise ValueError(
            f"in ppm{per}, so that {value:g}{fraction} is {1e6 * value:g}{percent}; 0 or at least {least:g} needed"
        )
    return value


def _in_celsius(value: float) -> float:
    if not LEAST_C <= value <= MOST_C:
        kelvin = f"; {value:g} K are {value - 273.15:g} °C" if LEAST_C <= value - 273.15 <= MOST_C else ""
        raise ValueError(f"in °C, {LEAST_C:g} to {MOST_C:g} possible{kelvin}")
    return value


Expansion = Annotated[float, Field(ge=-100, le=1000, allow_inf_nan=False, strict=True), AfterValidator(_in_ppm)]
ExpansionSigma = Annotated[Ppm, AfterValidator(_in_ppm)]
PitchSigma = Annotated[Ppm, AfterValidator(lambda value: _in_ppm(value, "", " as a fraction", LEAST_PITCH_PPM))]
Celsius = Annotated[float, Field(allow_inf_nan=False, strict=True), AfterValidator(_in_celsius)]
Kelvin = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False, strict=True)]


class SizeEntry(Strict):
    """The keys of :class:`StatedSize` without the pitch, for any body."""

    expansion_ppm_per_k: Expansion | None = None
    expansion_sigma_ppm_per_k: ExpansionSigma | None = None
    temperature_c: Celsius | None = None
    temperature_sigma_k: Kelvin | None = None
    reference_temperature_c: Celsius | None = None

    def stated(self) -> StatedSize:
        """Return the values as a :class:`StatedSize`, the input of the error budget."""
        return StatedSize(**self.model_dump(include={entry.name for entry in fields(StatedSize)}))


Place = Annotated[int, Field(ge=0, le=999, strict=True)]
Rings = Annotated[tuple[tuple[Place, Place], ...], Field(max_length=1000)]
"""Row and column, or place in the row, of each dot with a hole."""


def rings_of(rings: Sequence[Sequence[int]], rows: int, columns: int, quarters: bool, where: str) -> tuple:
    """Return the dots with a hole, as (row, column); ``quarters`` : True if rows and columns are alike."""
    told = {(row, column) for row, column in rings}
    for row, column in told:
        if row >= rows or column >= columns:
            raise InputError(
                "E-BOARD-RINGS",
                f"{where}: rings has [{row}, {column}] of {rows} rows of {columns} dots, counted from 0; correct it",
            )
    half = {(rows - 1 - row, columns - 1 - column) for row, column in told}
    quarter = {(column, rows - 1 - row) for row, column in told} if quarters and rows == columns else set()
    if told and told in (half, quarter):
        raise InputError(
            "E-BOARD-RINGS",
            f"{where}: {len(told)} rings that look the same after a turn of the board; choose rings that distinguish "
            "its ends, or leave rings out",
        )
    return tuple(sorted(told))


class BoardSizeEntry(SizeEntry):
    """All keys of :class:`StatedSize`."""

    pitch_sigma_ppm: PitchSigma | None = None


class BoardEntry(BoardSizeEntry):
    """A board of dots; ``type`` is optional."""

    type: Literal["circles"] = "circles"
    rows: Count
    columns: Count
    pitch_mm: Positive
    radius_mm: Positive
    polarity: Polarity
    sigma_mm: Positive = DOTS_SIGMA_MM
    corner: _CornerFile | None = None
    rim_mm: RimHeight = 0.0
    unusual_size: bool = False
    rings: Rings = ()


OF_DESIGN = {"rows", "columns", "pitch_mm", "radius_mm", "polarity", "sigma_mm", "unusual_size", "rim_mm"}
"""Keys of a board file that are fields of the design."""
PrintedReader = Callable[[PrintedFaceFile, bool, str], FaceDesign]
"""Makes a face from its entry; ``True`` if the file states an unusual size; and the beginning of messages."""


def load_target(path: str | Path, printed: PrintedReader | None = None) -> TargetDesign:
    """Read ``target.toml`` (form: ``data_layout.md``).

    ``printed`` : reads faces with a board or tags, which :func:`stcal.boards.target.load_body` does; they are refused
    if it is None. The message of an InputError names the file and the place.
    """
    data = load_toml(path, _TargetFile, "target file", REMEDY)
    where = f"target file {path}"
    faces = []
    for face in data.face:
        of_face = f"{where}: face {face.id}"
        if isinstance(face, _FaceFile):
            faces.append(_face(face, of_face))
        elif printed is None:
            raise InputError(
                "E-TARGET-PRINTED",
                f"{of_face}: a board or tags, which this command does not take yet; `stcal-sfm run`, `detect`, "
                "`measure` and `simulate` do",
            )
        else:
            faces.append(printed(face, data.unusual_size, of_face))
    with named(where, f"target {data.name}"):
        target = TargetDesign(data.name, data.polarity, tuple(faces), data.unusual_size)
    return replace(target, distances=tuple(_distance(entry, faces, where) for entry in data.scale))


def _distance(entry: _ScaleFile, faces: Sequence[FaceDesign], where: str) -> KnownDistance:
    """Return the known distance of an entry, of whose points the target has both."""
    known = {str(label): label for face in faces for label in face.labels()}
    for name in (entry.first, entry.second):
        if name not in known:
            raise InputError(
                "E-TARGET-SCALE",
                f"{where}: scale from {entry.first} to {entry.second}: no point {name} on the target; points are "
                f"{', '.join(map(str, faces[0].labels()[:4]))}, …",
            )
    if entry.first == entry.second:
        raise InputError("E-TARGET-SCALE", f"{where}: scale from {entry.first} to itself; two points needed")
    return KnownDistance(known[entry.first], known[entry.second], entry.mm, entry.sigma_mm, entry.drawn)


def load_board(path: str | Path) -> BoardDesign:
    """Read ``board.toml`` (form: ``data_layout.md``); errors as :func:`load_target`."""
    _require_dots(path)
    return board_design(load_toml(path, BoardEntry, "board file", REMEDY), f"board file {path}")


def _require_dots(path: str | Path) -> None:
    """Refuse a file that names another kind of board; one that cannot be read is left to the reader."""
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
    except (OSError, ValueError):
        return
    named = re.search(r"(?m)^\s*(?:type\s*=|target_type\s*:)\s*[\"']?([\w-]+)", text.split("[[")[0])
    if named and named[1] != "circles":
        raise InputError(
            "E-BOARD-TYPE",
            f"board file {path}: {named[1]}; a board of dots needed here: `calibrate-camera`, `handeye` and `locate` "
            "take others",
        )


def board_design(data: BoardEntry, where: str) -> BoardDesign:
    """Return the board of an entry; the message of an InputError begins with ``where``."""
    corner = data.corner
    same = data.model_dump(include=OF_DESIGN)
    rings = rings_of(data.rings, data.rows, data.columns, True, where)
    with named(where, "board"):
        return BoardDesign(
            **same,
            corner=corner and (corner.row, corner.column),
            corner_radius_mm=corner and corner.radius_mm,
            stated=data.stated(),
            rings=rings,
        )


def target_of(given: str | Path | TargetDesign | None) -> TargetDesign:
    """Return the given target, or the target of a file; the reference design if ``given`` is None."""
    return reference_target() if given is None else given if isinstance(given, TargetDesign) else load_target(given)


def board_of(given: str | Path | BoardDesign | None) -> BoardDesign:
    """Return the given board, or the board of a file; the reference board if ``given`` is None."""
    return reference_board() if given is None else given if isinstance(given, BoardDesign) else load_board(given)


def _face(face: _FaceFile, where: str) -> FaceDesign:
    """Return the face of an entry, whose places are in the frame of a drawing, in its own frame."""
    xy = np.array([[circle.x_mm, circle.y_mm] for circle in face.circles])
    rims = [face.rim_mm if circle.rim_mm is None else circle.rim_mm for circle in face.circles]
    with named(where, f"face {face.id}"):
        drawn = FaceDesign(
            face.id,
            tuple(circle.id for circle in face.circles),
            xy,
            [circle.radius_mm for circle in face.circles],
            face.origin,
            face.x,
            face.y,
        )
    origin, x = xy[drawn.ids.index(face.origin)], xy[drawn.ids.index(face.x)]
    along = (x - origin) / np.linalg.norm(x - origin)
    face_from_drawing = np.array([along, [-along[1], along[0]]])
    rough = outline = None
    if face.rough_pose is not None:
        drawing_from_face = np.eye(3)
        drawing_from_face[:2, :2] = face_from_drawing.T
        rough = _rough_pose(face.rough_pose, where) @ Rigid(drawing_from_face, np.append(origin, 0.0))
    if face.outline_mm is not None:
        outline = np.array(face.outline_mm)
        _require_inside(drawn, outline, where)
        outline = (outline - origin) @ face_from_drawing.T
    placed = replace(drawn, xy_mm=(xy - origin) @ face_from_drawing.T, rough_target_from_face=rough, outline_mm=outline)
    return placed if rims == [None] * len(rims) else replace(placed, rim_mm=np.array([rim or 0.0 for rim in rims]))


def _require_inside(face: FaceDesign, outline: np.ndarray, where: str) -> None:
    """Refuse circles that extend beyond the outline of their plate."""
    side = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(side, axis=1)
    if length.min() == 0:
        raise InputError(
            "E-TARGET-OUTLINE",
            f"{where}: outline_mm has the same corner twice; corners in order around the plate needed",
        )
    from_corner = face.xy_mm[:, None] - outline
    along = ((from_corner * side).sum(2) / length**2).clip(0, 1)
    gap = np.linalg.norm(from_corner - along[..., None] * side, axis=2).min(1) - face.radius_mm
    for i in np.flatnonzero(~inside(outline, face.xy_mm) | (gap < 0))[:1]:
        raise InputError(
            "E-TARGET-OUTLINE",
            f"{where}: circle {face.ids[i]} reaches beyond outline_mm; corners in order around all circles needed",
        )


def _rough_pose(pose: _RoughPoseFile, where: str) -> Rigid:
    """Return target_from_drawing; X is made perpendicular to the normal."""
    directions = []
    for key in ("x", "normal"):
        direction = np.array(getattr(pose, key))
        length = float(np.linalg.norm(direction))
        if length < MIN_DIRECTION:
            raise InputError(
                "E-TARGET-ROUGH-POSE",
                f"{where}: rough_pose: {key} {list(getattr(pose, key))}; a direction needed, not zero",
            )
        directions.append(direction / length)
    x, z = directions
    angle = float(np.degrees(np.arccos(np.clip(x @ z, -1, 1))))
    if abs(angle - 90) > MAX_SKEW_DEG:
        raise InputError(
            "E-TARGET-ROUGH-POSE",
            f"{where}: rough_pose: {angle:.0f}° between x and normal, 90° needed (to {MAX_SKEW_DEG:g}°); x is the "
            "direction of the drawing's X along the face, normal points out of it",
        )
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return Rigid(np.column_stack([x, np.cross(z, x), z]), pose.origin_mm)


def target_toml(target: TargetDesign, printed: Callable[[FaceDesign], list[str]] | None = None) -> str:
    """Return the text of a ``target.toml`` with comments; ``printed`` : returns the lines of a board or tags."""
    of_circles = any(face.printed is None for face in target.faces)
    lines = ["# A body with tags or boards on its faces. Lengths in mm."]
    if of_circles:
        lines = [
            "# A stereo target: faces with circles. Positions in mm, in any right-handed drawing frame of the face,",
            "# seen from outside with y up. Circle ids are free (no spaces, colons or commas), unique within a face.",
        ]
    lines += ["# Faces of tags or boards: seen from outside X to the right, Y down."] * target.has_printed
    lines += [f"name = {toml_string(target.name)}", f'polarity = "{target.polarity}"']
    lines[-1] += '  # circles are "bright" or "dark" against what surrounds them' * of_circles
    lines += stated_unusual(radius("", float(r)) for face in target.with_faces(False).faces for r in face.radius_mm)
    scales = [
        f"  {{ from = {toml_string(known.first)}, to = {toml_string(known.second)}, mm = {_number(known.mm)}, "
        f"sigma_mm = {_number(known.sigma_mm)}{', drawn = true' * known.drawn} }},"
        for known in target.distances
    ]
    lines += ["scale = [", *scales, "]"] if scales else []
    for face in target.faces:
        lines += ["", "[[face]]", f"id = {toml_string(face.id)}"]
        pose, outline = face.rough_target_from_face, []
        if face.outline_mm is not None:
            corners = ", ".join(f"[{_number(x)}, {_number(y)}]" for x, y in face.outline_mm.tolist())
            outline = [f"outline_mm = [{corners}]  # corners of its plate, for `draw`"]
        if face.printed is not None:
            assert printed is not None, "faces with a board or tags are written by stcal.boards.target"
            lines += [*(_rough_lines(pose @ INWARDS) if pose else []), *outline, *printed(face)]
            continue
        lines += [
            "# The face frame: origin at one circle, X through a second one, Y on the side of a third, Z outwards.",
            f"origin = {toml_string(face.origin)}",
            f"x = {toml_string(face.x)}",
            f"y = {toml_string(face.y)}",
            *_rough_lines(pose),
            *outline,
            "circles = [",
        ]
        rims = [""] * len(face.ids) if face.rim_mm is None else [f", rim_mm = {_number(rim)}" for rim in face.rim_mm]
        lines += [
            f"  {{ id = {toml_string(circle)}, x_mm = {_number(x)}, y_mm = {_number(y)}, "
            f"radius_mm = {_number(r)}{rim} }},"
            for circle, (x, y), r, rim in zip(face.ids, face.xy_mm, face.radius_mm, rims, strict=True)
        ]
        lines += ["]"]
    return "\n".join(lines) + "\n"


def _rough_lines(pose: Rigid | None) -> list[str]:
    about = [
        "# Where the drawing's (0, 0) is, its X and the outward normal, to a few mm and degrees, in a frame that all",
        "# faces share: for `plan` and `simulate`; a calibration does not use it.",
    ]
    if pose is None:
        return [*about, "# rough_pose = { origin_mm = [0.0, 0.0, 0.0], x = [1.0, 0.0, 0.0], normal = [0.0, 0.0, 1.0] }"]
    vectors = pose.translation, pose.rotation[:, 0], pose.rotation[:, 2]
    place, x, normal = (f"[{', '.join(map(_number, values))}]" for values in vectors)
    return [*about, f"rough_pose = {{ origin_mm = {place}, x = {x}, normal = {normal} }}"]


def board_toml(board: BoardDesign) -> str:
    """Return the text of a ``board.toml`` for ``board``, with comments."""
    corner = board.corner or (0, 0)
    corner_radius = board.corner_radius_mm or 1.5 * board.radius_mm
    prefix = "" if board.corner else "# "
    sizes = {entry.name: getattr(board.stated, entry.name) for entry in fields(StatedSize)}
    lines = [
        "# A rectangular grid of dots. Dot (row 0, column 0) is the origin, columns run along X, rows along Y.",
        f"rows = {board.rows}",
        f"columns = {board.columns}",
        f"pitch_mm = {_number(board.pitch_mm)}",
        f"radius_mm = {_number(board.radius_mm)}",
        f'polarity = "{board.polarity}"  # dots are "bright" or "dark" against the board',
        f"sigma_mm = {_number(board.sigma_mm)}  # standard deviation of the dots' positions, per axis",
        *([f"rim_mm = {_number(board.rim_mm)}  # height of rims before the dots"] if board.rim_mm else []),
        *(f"{key} = {_number(value)}" for key, value in sizes.items() if value is not None),
        *([f"rings = {list(map(list, board.rings))}  # dots with a hole"] if board.rings else []),
        *stated_unusual(board_lengths(board.pitch_mm, board.radius_mm)),
        "",
        "# One larger dot in a corner of the grid tells the orientation; without it the board looks the",
        "# same after half a turn, which a run settles by comparing the images of a group.",
        f"{prefix}[corner]",
        f"{prefix}row = {corner[0]}",
        f"{prefix}column = {corner[1]}",
        f"{prefix}radius_mm = {_number(corner_radius)}",
    ]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return repr(round(float(value), 9) + 0.0)


def save_design(path: str | Path, design: TargetDesign | BoardDesign) -> None:
    """Write the file of a target or a board, and require that it is read as the same design."""
    target = isinstance(design, TargetDesign)
    text = target_toml(design) if target else board_toml(design)
    save(Path(path), text)
    require_same(path, lambda: target_toml(load_target(path)) if target else board_toml(load_board(path)), text)
