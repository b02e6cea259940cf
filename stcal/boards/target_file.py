"""Files of targets with faces of circles, boards or tags, and of several boards in one frame: readers and writers."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import (
    TAG_SIGMA_MM,
    AprilGridDesign,
    BoardSet,
    CharucoDesign,
    ChessboardDesign,
    FlatBoard,
    TagLayout,
)
from stcal.boards.board_file import (
    INIT,
    SET,
    TYPES,
    RimHeight,
    board_content,
    design_of,
    flat_board,
    keys_of,
    load_flat_board,
    number,
    tag_rows,
)
from stcal.design import (
    POINT_RADIUS_MM,
    BoardDesign,
    FaceDesign,
    KnownDistance,
    Polarity,
    TargetDesign,
    reference_target,
)
from stcal.errors import InputError, named
from stcal.geometry.plane import inside
from stcal.geometry.rigid import Rigid
from stcal.io.files import require_same, save
from stcal.io.toml import Finite, PoseEntry, Positive, Sized, Strict, load_toml, toml_string, validated
from stcal.lengths import radius, stated_unusual

ROUGH_KEYS = "rough_pose = { origin_mm, x, normal }"
"""Form of the entry in which a face of a target file may state its rough pose."""
MIN_DIRECTION = 1e-6
MAX_SKEW_DEG = 5.0  # largest deviation from a right angle between X and normal of a rough pose
INWARDS = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""Turns a frame whose Z points out of a body into that of a board or tag, whose Z points into it."""
Vector = tuple[Finite, Finite, Finite]
Outline = Annotated[list[tuple[Finite, Finite]], Field(min_length=3, max_length=1000)]
Name = Annotated[
    str,
    BeforeValidator(lambda v: str(v) if isinstance(v, int) and not isinstance(v, bool) else v),
    Field(min_length=1, pattern=r"^[^:,\s/\\\p{C}]+$"),
]


class _CircleFile(Strict):
    id: Name
    x_mm: Finite
    y_mm: Finite
    radius_mm: Positive
    rim_mm: RimHeight | None = None


class _RoughPoseFile(Strict):
    origin_mm: Vector
    x: Vector
    normal: Vector


class _CirclesFile(Strict):
    id: Name
    origin: Name
    x: Name
    y: Name
    rough_pose: _RoughPoseFile | None = None
    outline_mm: Outline | None = None
    rim_mm: RimHeight | None = None
    circles: list[_CircleFile] = Field(min_length=4)


class _PrintedFile(Strict):
    id: Name
    rough_pose: _RoughPoseFile | None = None
    outline_mm: Outline | None = None
    board: dict[str, Any] | None = None
    tags: list[dict[str, Any]] | None = Field(default=None, min_length=1)
    sigma_mm: Positive | None = None
    size_sigma_mm: Positive | None = None


def _kind_of_face(face: Any) -> str:
    return "<printed>" if isinstance(face, dict) and ("board" in face or "tags" in face) else "<circles>"


_FaceFile = Annotated[_CirclesFile, Tag("<circles>")] | Annotated[_PrintedFile, Tag("<printed>")]


class _ScaleFile(Strict):
    first: str = Field(alias="from")
    second: str = Field(alias="to")
    mm: Positive
    sigma_mm: Positive
    drawn: bool = False


class _TargetFile(Sized):
    name: Annotated[str, AfterValidator(lambda v: " ".join(v.split()))] = "target"
    polarity: Polarity
    face: list[Annotated[_FaceFile, Discriminator(_kind_of_face)]] = Field(min_length=1)
    scale: list[_ScaleFile] = Field(default=[])

    @model_validator(mode="before")
    @classmethod
    def _without_circles(cls, content: Any) -> Any:
        faces = content.get("face") if isinstance(content, dict) else None
        if isinstance(faces, list) and faces and all(_kind_of_face(face) == "<printed>" for face in faces):
            return {"polarity": "bright"} | content
        return content


def load_target(path: str | Path, printed: bool = True) -> TargetDesign:
    """Return the target of ``target.toml``: faces of circles, boards and tags in their own frames, mm.

    Parameters
    ----------
    path : The file (form: ``data_layout.md``).
    printed : False if faces with a board or tags are to be refused.

    Raises InputError: the file cannot be read or is no design, or has a tag on two faces; the message names file, place
    and reason.
    """
    data = load_toml(path, _TargetFile, "target file", INIT)
    where = f"target file {path}"
    faces: list[FaceDesign] = []
    face_of_tag: dict[tuple[str, int], str] = {}
    for face in data.face:
        of_face = f"{where}: face {face.id}"
        if isinstance(face, _CirclesFile):
            faces.append(_of_circles(face, of_face))
        elif printed:
            faces.append(_of_print(face, data.unusual_size, of_face))
        else:
            fault = f"{of_face}: a board or tags, which this command does not take yet"
            raise InputError("E-TARGET-PRINTED", f"{fault}; `stcal-sfm run`, `detect`, `measure` and `simulate` do")
    with named(where, f"target {data.name}"):
        target = TargetDesign(data.name, data.polarity, tuple(faces), data.unusual_size)
    known = {str(label): label for face in faces for label in face.labels()}
    distances = tuple(_distance(entry, known, where) for entry in data.scale)
    for face in faces:
        for tag in tags_on(face.printed):
            if tag in face_of_tag:
                fault = f"{where}: tag {tag[1]} of {tag[0]} is on faces {face_of_tag[tag]} and {face.id}"
                raise InputError("E-TAG-REPEATED", f"{fault}, each tag once needed; correct first_id or id")
            face_of_tag[tag] = face.id
    return replace(target, distances=distances)


def target_of(given: str | Path | TargetDesign | None, printed: bool = True) -> TargetDesign:
    """Return the given target, or the target of a file; the reference design if ``given`` is None."""
    if given is None or isinstance(given, TargetDesign):
        return given or reference_target()
    return load_target(given, printed)


def _distance(entry: _ScaleFile, known: dict[str, Any], where: str) -> KnownDistance:
    for name in (entry.first, entry.second):
        if name not in known:
            fault = f"{where}: scale from {entry.first} to {entry.second}: no point {name} on the target"
            raise InputError("E-TARGET-SCALE", f"{fault}; points are {', '.join(list(known)[:4])}, …")
    if entry.first == entry.second:
        raise InputError("E-TARGET-SCALE", f"{where}: scale from {entry.first} to itself; two points needed")
    return KnownDistance(known[entry.first], known[entry.second], entry.mm, entry.sigma_mm, entry.drawn)


def _of_circles(face: _CirclesFile, where: str) -> FaceDesign:
    """Return the face of an entry, whose places are in the frame of a drawing, in its own frame."""
    xy = np.array([[circle.x_mm, circle.y_mm] for circle in face.circles])
    ids, radii = tuple(circle.id for circle in face.circles), [circle.radius_mm for circle in face.circles]
    with named(where, f"face {face.id}"):
        drawn = FaceDesign(face.id, ids, xy, radii, face.origin, face.x, face.y)
    own, drawing_from_face = in_own_frame(drawn)
    placed: dict[str, Any] = {}
    if face.rough_pose is not None:
        placed["rough_target_from_face"] = _rough_pose(face.rough_pose, where) @ drawing_from_face
    if face.outline_mm is not None:
        outline = np.array(face.outline_mm)
        _require_inside(drawn, outline, where)
        placed["outline_mm"] = _flat_from(drawing_from_face, outline)
    rims = [face.rim_mm if circle.rim_mm is None else circle.rim_mm for circle in face.circles]
    if rims != [None] * len(rims):
        placed["rim_mm"] = np.array([rim or 0.0 for rim in rims])
    return replace(own, **placed)


def three_point_frame(origin: np.ndarray, on_x: np.ndarray, on_y: np.ndarray) -> Rigid:
    """Returns a_from_face of the frame through three points of frame a: X through ``on_x``, ``on_y`` on Y's side."""
    x = (on_x - origin) / np.linalg.norm(on_x - origin)
    z = np.cross(x, on_y - origin)
    z /= np.linalg.norm(z)
    return Rigid(np.column_stack([x, np.cross(z, x), z]), origin)


def in_own_frame(drawn: FaceDesign) -> tuple[FaceDesign, Rigid]:
    """Returns a face that is given in any drawing frame in its own: origin at circle ``origin``, X through circle
    ``x``, Y on the side of circle ``y``; and drawing_from_face."""
    frame = (drawn.xy_mm[drawn.ids.index(circle)] for circle in (drawn.origin, drawn.x, drawn.y))
    drawing_from_face = three_point_frame(*(np.append(xy, 0.0) for xy in frame))
    return replace(drawn, xy_mm=_flat_from(drawing_from_face, drawn.xy_mm)), drawing_from_face


def _flat_from(drawing_from_face: Rigid, xy_mm: np.ndarray) -> np.ndarray:
    """Returns places (n, 2) of a drawing in the frame of its face."""
    return (xy_mm - drawing_from_face.translation[:2]) @ drawing_from_face.rotation[:2, :2]


def _require_inside(face: FaceDesign, outline: np.ndarray, where: str) -> None:
    side = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(side, axis=1)
    if length.min() == 0:
        fault = f"{where}: outline_mm has the same corner twice"
        raise InputError("E-TARGET-OUTLINE", f"{fault}; each once, in order, needed")
    from_corner = face.xy_mm[:, None] - outline
    along = ((from_corner * side).sum(2) / length**2).clip(0, 1)
    gap = np.linalg.norm(from_corner - along[..., None] * side, axis=2).min(1) - face.radius_mm
    for i in np.flatnonzero(~inside(outline, face.xy_mm) | (gap < 0))[:1]:
        fault = f"{where}: circle {face.ids[i]} reaches beyond outline_mm"
        raise InputError("E-TARGET-OUTLINE", f"{fault}; corners in order around all circles needed")


def _rough_pose(pose: _RoughPoseFile, where: str) -> Rigid:
    """Return target_from_drawing; X is made perpendicular to the normal."""
    x, z = np.array(pose.x), np.array(pose.normal)
    for key, direction in (("x", x), ("normal", z)):
        if (length := float(np.linalg.norm(direction))) < MIN_DIRECTION:
            fault = f"{where}: rough_pose: {key} {direction.tolist()}"
            raise InputError("E-TARGET-ROUGH-POSE", f"{fault}; a direction needed")
        direction /= length
    angle = float(np.degrees(np.arccos(np.clip(x @ z, -1, 1))))
    if abs(angle - 90) > MAX_SKEW_DEG:
        askew = f"{where}: rough_pose: {angle:.0f}° between x and normal, 90° needed (to {MAX_SKEW_DEG:g}°)"
        remedy = "x is the direction of the drawing's X along the face, normal points out of it"
        raise InputError("E-TARGET-ROUGH-POSE", f"{askew}; {remedy}")
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return Rigid(np.column_stack([x, np.cross(z, x), z]), pose.origin_mm)


def _of_print(entry: _PrintedFile, unusual_size: bool, where: str) -> FaceDesign:
    if (entry.board is None) == (entry.tags is None):
        raise InputError("E-TARGET-PRINTED", f"{where}: board and tags; one of them needed")
    content: dict[str, Any] = {"type": "tags", "tag": entry.tags} if entry.board is None else dict(entry.board)
    if unusual_size:
        content.setdefault("unusual_size", True)
    board = flat_board(content, f"{where}: {'tags' if entry.board is None else 'board'}")
    if not isinstance(board, CharucoDesign | AprilGridDesign | TagLayout):
        needed = "charuco or aprilgrid needed, as a face must differ from the others"
        fault = f"{where}: board: type {content.get('type', 'circles')}; {needed}"
        raise InputError("E-TARGET-PRINTED", f"{fault}; give tags with `tags`, and dots as circles")
    rough = None if entry.rough_pose is None else _rough_pose(entry.rough_pose, where) @ INWARDS
    outline = None if entry.outline_mm is None else np.array(entry.outline_mm)
    more = {"rough_target_from_face": rough, "outline_mm": outline}
    return printed_face(entry.id, board, entry.sigma_mm, entry.size_sigma_mm or 0.0, **more)


def printed_face(
    face_id: str, board: FlatBoard, sigma_mm: float | None = None, size_sigma_mm: float = 0.0, **more: Any
) -> FaceDesign:
    """Return the face of a board or tags; ``sigma_mm`` : σ of a corner, else the board's; ``more`` : pose, outline."""
    ids, xy = corner_ids(board), board.xy_mm()
    first = int(np.linalg.norm(xy - xy.mean(0), axis=1).argmax())
    second = int(np.linalg.norm(xy - xy[first], axis=1).argmax())
    along = (xy[second] - xy[first]) / np.linalg.norm(xy[second] - xy[first])
    across = (xy - xy[first]) @ np.array([-along[1], along[0]])
    third = int(across.argmax()) if across.max() >= -across.min() else int(across.argmin())
    if across[third] < 0:  # as seen along Z, X to Y must turn like the axes
        first, second = second, first
    frame = ids[first], ids[second], ids[third]
    own = board.sigma_mm or TAG_SIGMA_MM
    more |= {"printed": board, "sigma_mm": own if sigma_mm is None else sigma_mm}
    more |= {"size_sigma": size_sigma_mm / _size_mm(board), "of_tags": not isinstance(board, CharucoDesign)}
    return FaceDesign(face_id, ids, xy, np.full(len(ids), POINT_RADIUS_MM), *frame, **more)


def tags_on(printed: Any) -> Sequence[tuple[str, int]]:
    """Return dictionary and id of every tag of a board or layout; a chessboard, or a board of circles, has none."""
    if isinstance(printed, CharucoDesign | AprilGridDesign):
        return [(printed.dictionary, tag) for tag in printed.tag_ids()]
    return printed.tags if isinstance(printed, TagLayout) else ()


def corner_ids(board: FlatBoard) -> tuple[str, ...]:
    """Return the ids of a board's corners: row.column of an inner corner, tag.corner of a tag."""
    if isinstance(board, CharucoDesign):
        return tuple(f"{i}.{j}" for i in range(board.rows - 1) for j in range(board.columns - 1))
    tags = tags_on(board)
    count = Counter(tag for _, tag in tags)
    names = [f"{name.removeprefix('DICT_')}.{tag}" if count[tag] > 1 else f"{tag}" for name, tag in tags]
    return tuple(f"{name}.{corner}" for name in names for corner in range(4))


def _size_mm(board: FlatBoard) -> float:
    """Return the size that is measured on the print: the side of a square, or of the first tag."""
    if isinstance(board, CharucoDesign):
        return board.square_mm
    first, second = board.xy_mm()[:2]
    return float(np.linalg.norm(second - first))


def target_toml(target: TargetDesign) -> str:
    """Return the text of a ``target.toml`` for ``target``, with comments."""
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
        f"  {{ from = {toml_string(known.first)}, to = {toml_string(known.second)}, mm = {number(known.mm)}, "
        f"sigma_mm = {number(known.sigma_mm)}{', drawn = true' * known.drawn} }},"
        for known in target.distances
    ]
    lines += ["scale = [", *scales, "]"] if scales else []
    for face in target.faces:
        lines += ["", "[[face]]", f"id = {toml_string(face.id)}"]
        pose, outline = face.rough_target_from_face, []
        if face.outline_mm is not None:
            corners = ", ".join(f"[{number(x)}, {number(y)}]" for x, y in face.outline_mm.tolist())
            outline = [f"outline_mm = [{corners}]  # corners of its plate, for `draw`"]
        if face.printed is not None:
            lines += [*(_rough_lines(pose @ INWARDS) if pose else []), *outline, *_printed_lines(face)]
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
        rims = [""] * len(face.ids) if face.rim_mm is None else [f", rim_mm = {number(rim)}" for rim in face.rim_mm]
        lines += [
            f"  {{ id = {toml_string(circle)}, x_mm = {number(x)}, y_mm = {number(y)}, radius_mm = {number(r)}{rim} }},"
            for circle, (x, y), r, rim in zip(face.ids, face.xy_mm, face.radius_mm, rims, strict=True)
        ]
        lines += ["]"]
    return "\n".join(lines) + "\n"


def _rough_lines(pose: Rigid | None) -> list[str]:
    about = [
        "# Where the drawing's (0, 0) is, its X and the outward normal, to a few mm and degrees, in a frame that all",
        "# faces share: for `plan` and `simulate`; `run` only tells by it that a face is on another side.",
    ]
    if pose is None:
        return [*about, "# rough_pose = { origin_mm = [0.0, 0.0, 0.0], x = [1.0, 0.0, 0.0], normal = [0.0, 0.0, 1.0] }"]
    vectors = pose.translation, pose.rotation[:, 0], pose.rotation[:, 2]
    place, x, normal = (f"[{', '.join(map(number, values))}]" for values in vectors)
    return [*about, f"rough_pose = {{ origin_mm = {place}, x = {x}, normal = {normal} }}"]


def _printed_lines(face: FaceDesign) -> list[str]:
    board = face.printed
    assert isinstance(board, CharucoDesign | AprilGridDesign | TagLayout)
    lines = [f"sigma_mm = {face.sigma_mm!r}  # of a corner about the design, per axis"]
    if face.size_sigma:
        lines.append(f"size_sigma_mm = {face.size_sigma * _size_mm(board)!r}  # of the side of a square or tag")
    else:
        lines.append("# size_sigma_mm = 0.03  # of the side of a square or tag, where you measured it")
    if isinstance(board, TagLayout):
        return [*lines, "tags = [", *tag_rows(board), "]"]
    return [*lines, f"board = {{ type = {toml_string(TYPES[type(board)])}, {', '.join(keys_of(board))} }}"]


def save_target(path: str | Path, target: TargetDesign) -> None:
    """Write the file of a target, and require that it is read as the same design.

    Parameters
    ----------
    path : ``target.toml`` to write.
    target : Faces of circles, boards and tags.
    """
    text = target_toml(target)
    save(Path(path), text)
    require_same(path, lambda: target_toml(load_target(path)), text)


MOST_BOARDS = 100


class _BoardsFile(Strict):
    type: Literal["boards"]
    board: list[dict[str, Any]] = Field(min_length=1, max_length=MOST_BOARDS)


class _Place(PoseEntry):
    """The pose of a board: position and quaternion, or ``rpy_deg`` about the fixed axes X, Y, Z; or a 4×4 matrix."""

    rpy_deg: list[Finite] | None = Field(default=None, min_length=3, max_length=3)
    common_from_board: list[list[Finite]] | None = None

    def common(self, where: str) -> Rigid:
        """Return common_from_board."""
        given_keys = self.model_fields_set
        if self.common_from_board is not None:
            if further := given_keys - {"common_from_board"}:
                conflict = f"{where}: common_from_board and {min(further)}; give one of them"
                raise InputError("E-BOARD-KEY-CONFLICT", conflict)
            if [len(row) for row in self.common_from_board] != [4] * 4:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: 4 rows of 4 numbers needed")
            try:
                return Rigid.from_matrix(self.common_from_board)
            except InputError as error:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: {error}") from error
        if self.rpy_deg is None:
            return self.rigid(where)
        if given_keys & {"qw", "qx", "qy", "qz"}:
            raise InputError("E-BOARD-KEY-CONFLICT", f"{where}: rpy_deg and a quaternion; one of them needed")
        turn = Rotation.from_euler("xyz", self.rpy_deg, degrees=True)
        return Rigid(turn.as_matrix(), [self.x_mm, self.y_mm, self.z_mm])


def load_boards(path: str | Path) -> BoardDesign | FlatBoard | BoardSet:
    """Read a board file of any kind, of one board or several (form: ``data_layout.md``)."""
    content = board_content(path)
    if content is None or content.get("type") != SET:
        return design_of(path, content)
    where = f"board file {path}"
    names, boards, places = [], [], []
    for count, entry in enumerate(validated(content, _BoardsFile, where).board, 1):
        entry_place = f"{where}: board {count}"
        place = {key: value for key, value in entry.items() if key in _Place.model_fields}
        entry_board = {key: value for key, value in entry.items() if key not in place}
        places.append(validated(place, _Place, entry_place).common(entry_place))
        boards.append(_board(Path(path), entry_board, entry_place))
        names.append(f"board {count}" + (f" ({Path(entry_board['file']).name})" if "file" in entry_board else ""))
    for name, board in zip(names, boards, strict=True):
        if not board.unique() if isinstance(board, BoardDesign) else board.symmetries():
            fault = f"{name} looks the same when turned, so that its points cannot be numbered in the common frame"
            needed = "a chessboard of an odd and an even side, a larger corner dot, or tags needed"
            raise InputError("E-BOARD-AMBIGUOUS", f"{where}: {fault}; {needed}")
    for (first_name, first), (second_name, second) in combinations(zip(names, boards, strict=True), 2):
        if reason := _alike(first, second):
            raise InputError("E-BOARD-AMBIGUOUS", f"{where}: {first_name} and {second_name} look alike: {reason}")
    return BoardSet(tuple(names), tuple(boards), tuple(places))


def _board(path: Path, entry: dict[str, Any], where: str) -> BoardDesign | FlatBoard:
    if "file" not in entry:
        return flat_board(entry, where)
    if not isinstance(entry["file"], str):
        raise InputError("E-BOARD-FILE-KEY", f"{where}: file: a string needed")
    if extra := sorted(set(entry) - {"file"}):
        beside = f"{where}: {', '.join(extra)} beside file; the board's file says what the board is"
        raise InputError("E-BOARD-KEY-CONFLICT", beside)
    with named(where):
        return load_flat_board(path.parent / entry["file"])


def _alike(first: BoardDesign | FlatBoard, second: BoardDesign | FlatBoard) -> str:
    if (colour := getattr(first, "polarity", "")) and colour == getattr(second, "polarity", ""):
        return f"both have {colour} circles; one of them bright and one dark, or tags, needed"
    for whole, part in ((first, second), (second, first)):
        if not isinstance(part, ChessboardDesign) or not isinstance(whole, ChessboardDesign | CharucoDesign):
            continue
        outer = int(isinstance(whole, CharucoDesign))  # whose rows and columns are those of squares
        inner = whole.rows - outer, whole.columns - outer
        if all(a <= b for a, b in zip(sorted((part.rows, part.columns)), sorted(inner), strict=True)):
            seen = f"{part.rows}×{part.columns} inner corners are seen in {inner[0]}×{inner[1]} too"
            return f"{seen}; one with more rows and fewer columns, or tags, needed"
    if common := sorted(set(tags_on(first)) & set(tags_on(second))):
        return f"both have tag {common[0][1]} of {common[0][0]}; other ids (first_id) or another dictionary needed"
    return ""
