"""Board files of Kalibr (YAML, ``target_type``; lengths in metres): AprilGrids, checkerboards, circle grids."""

from typing import Annotated, Any, Literal

import cv2
from pydantic import Field

from stcal.boards.design import AprilGridDesign, AsymmetricCirclesDesign, ChessboardDesign
from stcal.errors import InputError
from stcal.io.design import Count, Squares
from stcal.io.toml import Positive, Strict, validated

METRE_MM = 1000.0
MOST_M = 100.0
"""Longest tag, square or spacing, m; a larger value is a wrong unit."""
SAME_WITHIN = 1e-6
"""Largest relative difference between the sides of a square."""
FAMILY = "DICT_APRILTAG_36h11"
KINDS = ("aprilgrid", "checkerboard", "circlegrid")

Few = Annotated[int, Field(ge=1, le=1000, strict=True)]
Metres = Annotated[Positive, Field(le=MOST_M)]


class _AprilGrid(Strict):
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


def board_of(content: dict[str, Any], where: str) -> AprilGridDesign | ChessboardDesign | AsymmetricCirclesDesign:
    """Return the board of a file of Kalibr; the message of an InputError begins with ``where``.

    Kalibr's frame of an AprilGrid differs by half a turn about X (:class:`AprilGridDesign`). Its asymmetric circle
    grids do not state the radius of circles, which is determined from images.

    Raises
    ------
    InputError
        Keys are missing or unknown, the kind is another one, squares are oblong, or a grid of circles is not
        asymmetric.
    """
    kind = content["target_type"]
    if kind == "aprilgrid":
        data = validated(content, _AprilGrid, where)
        available = len(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).bytesList)
        if (count := data.codeOffset + data.tagRows * data.tagCols) > available:
            raise InputError(
                "E-TAG-ID-RANGE",
                f"{where}: tags up to {count - 1}, tag36h11 has 0 … {available - 1}; correct tagRows, tagCols",
            )
        size = METRE_MM * data.tagSize
        return AprilGridDesign(data.tagRows, data.tagCols, size, data.tagSpacing, None, data.codeOffset, FAMILY)
    if kind == "checkerboard":
        data = validated(content, _Checkerboard, where)
        across, down = data.colSpacingMeters, data.rowSpacingMeters
        if abs(across - down) > SAME_WITHIN * across:
            raise InputError(
                "E-BOARD-SPACING",
                f"{where}: colSpacingMeters {across:g}, rowSpacingMeters {down:g}; squares needed, both the same",
            )
        return ChessboardDesign(data.targetRows, data.targetCols, METRE_MM * across)
    if kind == "circlegrid":
        data = validated(content, _CircleGrid, where)
        if not data.asymmetricGrid:
            raise InputError(
                "E-BOARD-RADIUS",
                f"{where}: asymmetricGrid false, a grid whose circles have no radius; write a board.toml with rows, "
                "columns, pitch_mm, radius_mm and polarity",
            )
        spacing = METRE_MM * data.spacingMeters
        return AsymmetricCirclesDesign(data.targetRows, data.targetCols, spacing, None, "dark")
    raise InputError("E-BOARD-TYPE", f"{where}: target_type {kind!r}; one of {', '.join(KINDS)} needed")
