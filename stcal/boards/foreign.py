"""Board files of other programs: Kalibr's targets, and tags as apriltag_ros lists them.

apriltag_ros has bundles with a place for each tag, and standalone tags with their sizes alone.
"""

from collections.abc import Collection
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, ConfigDict, Field

from stcal.boards.board_designs import AprilGridDesign, AsymmetricCirclesDesign, ChessboardDesign, FlatBoard
from stcal.boards.dictionaries import count_of
from stcal.errors import InputError
from stcal.io.rotations import of_quaternions
from stcal.io.toml import Finite, Positive, Strict, load_yaml, validated
from stcal.lengths import LEAST_SIDE_MM, MOST_SIDE_MM

KEYS = frozenset(("tag_bundles", "standalone_tags"))
Few = Annotated[int, Field(ge=1, le=1000, strict=True)]
Count = Annotated[int, Field(ge=2, le=1000, strict=True)]
Squares = Annotated[int, Field(ge=3, le=1000, strict=True)]
"""Number in a row of a chessboard. Smaller grids are not recognised, or have all inner corners on one line."""
FAMILY = "tag36h11"  # the family where the file names none: settings.yaml of apriltag_ros does
METRE_MM = 1000.0
FLAT_MM, FLAT_RAD = 0.01, 1e-3
"""Largest deviation of tags from one plane: what a file rounds off."""
CORNERS = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2
"""Corners of a tag of side 1 (X right, Y up), in the order of OpenCV, which draws this family half a turn round."""
UPRIGHT = np.roll(CORNERS, 2, axis=0)
"""The same of a tag that stands as OpenCV draws it."""


class _Tag(Strict):
    id: Annotated[int, Field(ge=0, strict=True)]
    size: Positive
    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    qw: Finite = 1.0
    qx: Finite = 0.0
    qy: Finite = 0.0
    qz: Finite = 0.0
    name: str = ""


class _Bundle(Strict):
    name: str
    layout: list[_Tag] = Field(min_length=1)


class _BundlesFile(Strict):
    # settings.yaml may be in the same file: its other keys say how to detect tags.
    model_config = ConfigDict(extra="ignore", frozen=True)
    tag_family: str = FAMILY
    upright: bool = False
    tag_bundles: list[_Bundle] = Field(default_factory=list)
    standalone_tags: list[_Tag] = Field(default_factory=list)


def yaml_content(text: str, keys: Collection[str]) -> dict[str, Any] | None:
    """Return the keys and values of a YAML file with one of these keys; None for any other text."""
    if not any(key in text for key in keys):
        return None
    try:
        content = load_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and any(key in content for key in keys) else None


def tags_of_bundle(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return keys and values of a layout of tags, in mm and with Y down; standalone tags have sizes and no places."""
    data = validated(content, _BundlesFile, where)
    if len(data.tag_bundles) > 1:
        names = ", ".join(bundle.name for bundle in data.tag_bundles)
        raise InputError("E-LAYOUT-BUNDLES", f"{where}: bundles {names}: one needed; leave only that one in the file")
    if not data.tag_bundles:
        tags = [{"dictionary": data.tag_family, "id": t.id, "size_mm": METRE_MM * t.size} for t in data.standalone_tags]
        return {"type": "tags", "tag": tags}
    [bundle] = data.tag_bundles
    places = tuple(f"tag {tag.id}" for tag in bundle.layout)
    wxyz = np.array([[tag.qw, tag.qx, tag.qy, tag.qz] for tag in bundle.layout])
    turn, at = of_quaternions(wxyz, places, where), METRE_MM * np.array([[t.x, t.y, t.z] for t in bundle.layout])
    tilt = np.arccos(np.clip(turn[:, 2, 2], -1, 1))
    off = np.abs(at[:, 2] - at[0, 2])
    for place, angle, height in zip(places, tilt, off, strict=True):
        if angle > FLAT_RAD or height > FLAT_MM:
            fault = f"{place}: {np.degrees(angle):.3g}° and {height:.3g} mm from the plane of the bundle"
            remedy = "none allowed: targets are flat here; give the tags of one plane"
            raise InputError("E-LAYOUT-FLAT", f"{where}: {fault}, {remedy}")
    corners_of_one = UPRIGHT if data.upright else CORNERS
    tags = []
    for tag, rotation, middle in zip(bundle.layout, turn, at, strict=True):
        corners = METRE_MM * tag.size * corners_of_one @ rotation[:2, :2].T + middle[:2]
        tags.append({"dictionary": data.tag_family, "id": tag.id, "corners_mm": (corners * [1, -1]).tolist()})
    return {"type": "tags", "name": bundle.name, "tag": tags}


def _metres(value: float) -> float:
    least, most = LEAST_SIDE_MM / METRE_MM, MOST_SIDE_MM / METRE_MM
    if not least <= value <= most:
        raise ValueError(f"{least:g} … {most:g} m needed: Kalibr's lengths are metres, not mm")
    return value


LEAST_GAP = 0.1
"""Smallest gap between tags over their side that grids have: with less white about them tags are not found."""
SAME_WITHIN = 1e-6  # largest relative difference between the sides of a square
KALIBR_FAMILY = "DICT_APRILTAG_36h11"
KALIBR_KINDS = ("aprilgrid", "checkerboard", "circlegrid")
Metres = Annotated[Positive, AfterValidator(_metres)]


class _KalibrAprilGrid(Strict):
    target_type: Literal["aprilgrid"]
    tagCols: Few
    tagRows: Few
    tagSize: Metres
    tagSpacing: Annotated[float, Field(gt=0, le=10, strict=True)]
    codeOffset: Annotated[int, Field(ge=0, strict=True)] = 0


class _Checkerboard(Strict):
    target_type: Literal["checkerboard"]
    targetCols: Squares
    targetRows: Squares
    rowSpacingMeters: Metres
    colSpacingMeters: Metres


class _CircleGrid(Strict):
    target_type: Literal["circlegrid"]
    targetCols: Count
    targetRows: Count
    spacingMeters: Metres
    asymmetricGrid: bool


def kalibr_board_of(content: dict[str, Any], where: str) -> FlatBoard:
    """Return the board of a file of Kalibr; its circle grids do not state the radius, which images determine."""
    kind = content["target_type"]
    if kind == "aprilgrid":
        data = validated(content, _KalibrAprilGrid, where)
        available = count_of(KALIBR_FAMILY)
        if (count := data.codeOffset + data.tagRows * data.tagCols) > available:
            fault = f"{where}: tags up to {count - 1}, tag36h11 has 0 … {available - 1}"
            raise InputError("E-TAG-ID-RANGE", f"{fault}; correct them")
        size = METRE_MM * data.tagSize
        if data.tagSpacing < LEAST_GAP <= (ratio := data.tagSpacing / data.tagSize) <= 1:
            usual = f"at least {LEAST_GAP:g} usual: it is the gap divided by tagSize, not a length"
            same = f"of a gap of {data.tagSpacing:g} m it is {ratio:.4g}"
            raise InputError("E-BOARD-SPACING", f"{where}: tagSpacing {data.tagSpacing:g}, {usual}; {same}")
        return AprilGridDesign(data.tagRows, data.tagCols, size, data.tagSpacing, None, data.codeOffset, KALIBR_FAMILY)
    if kind == "checkerboard":
        data = validated(content, _Checkerboard, where)
        across, down = data.colSpacingMeters, data.rowSpacingMeters
        if abs(across - down) > SAME_WITHIN * across:
            fault = f"{where}: colSpacingMeters {across:g}, rowSpacingMeters {down:g}"
            raise InputError("E-BOARD-SPACING", f"{fault}; squares needed")
        return ChessboardDesign(data.targetRows, data.targetCols, METRE_MM * across)
    if kind == "circlegrid":
        data = validated(content, _CircleGrid, where)
        if not data.asymmetricGrid:
            fault = f"{where}: asymmetricGrid false: a grid whose circles have no radius"
            remedy = "write a board.toml with rows, columns, pitch_mm, radius_mm and polarity"
            raise InputError("E-BOARD-RADIUS", f"{fault}; {remedy}")
        spacing = METRE_MM * data.spacingMeters
        return AsymmetricCirclesDesign(data.targetRows, data.targetCols, spacing, None, "dark")
    raise InputError("E-BOARD-TYPE", f"{where}: target_type {kind!r}; one of {', '.join(KALIBR_KINDS)} needed")
