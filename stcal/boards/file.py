"""Board files of every kind: dots (``stcal.io.design``), chessboards, ChArUco boards, tag layouts."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal, Self

import cv2
import numpy as np
from pydantic import AfterValidator, Field, model_validator

from stcal.boards.design import CharucoDesign, ChessboardDesign, FlatBoard, TagLayout
from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.io.covariance import Rows, require_covariance
from stcal.io.design import Count, load_board
from stcal.io.files import SETTINGS_BYTES, read_bytes
from stcal.io.json import mistake
from stcal.io.toml import Finite, Positive, Strict, load_toml

REMEDY = 'a file with type = "chessboard", "charuco" or "tags" needed, or one of dots, see data_layout.md'
OF_OTHERS = {"square_mm", "marker_mm", "dictionary", "tag"}
"""Keys that no board of dots has."""
KINDS = ("circles", "chessboard", "charuco", "tags")


def known_dictionary(name: str) -> str:
    """The name of a dictionary of ``cv2.aruco``, with or without ``DICT_``, in any case.

    Raises
    ------
    ValueError
        Unknown; the message lists what is alike.
    """
    plain = name.strip().upper()
    plain = plain if plain.startswith("DICT_") else f"DICT_{plain}"
    known = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    if plain not in known:
        alike = sorted(k for k in known if k[5:9] == plain[5:9]) or sorted(known)
        raise ValueError(f"unknown dictionary; one of {', '.join(alike)} needed")
    return known[plain]


Dictionary = Annotated[str, AfterValidator(known_dictionary)]


class _Chessboard(Strict):
    type: Literal["chessboard"]
    rows: Count
    columns: Count
    square_mm: Positive
    sigma_mm: Positive = 0.01


class _Charuco(Strict):
    type: Literal["charuco"]
    rows: Count
    columns: Count
    square_mm: Positive
    marker_mm: Positive
    dictionary: Dictionary
    legacy: bool = False
    sigma_mm: Positive = 0.01


class TagEntry(Strict):
    """One tag of a layout: ``x_mm``, ``y_mm`` of its middle, turned by ``angle_deg``; or its four corners as measured;
    or neither, when its place is to be found."""

    dictionary: Dictionary
    id: Annotated[int, Field(ge=0, strict=True)]
    size_mm: Positive | None = None
    x_mm: Finite | None = None
    y_mm: Finite | None = None
    angle_deg: Finite = 0.0
    corners_mm: list[Annotated[list[Finite], Field(min_length=2, max_length=2)]] | None = Field(
        default=None, min_length=4, max_length=4
    )

    def corners(self, where: str) -> np.ndarray | None:
        """(4, 2) mm in the layout's frame; None where the place is unknown."""
        if self.corners_mm is not None:
            return np.array(self.corners_mm)
        if self.x_mm is None and self.y_mm is None:
            return None
        if self.x_mm is None or self.y_mm is None or self.size_mm is None:
            raise InputError(f"{where}: tag {self.id}: x_mm, y_mm and size_mm needed together, or corners_mm")
        square = self.size_mm / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
        cosine, sine = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        return square @ np.array([[cosine, sine], [-sine, cosine]]) + [self.x_mm, self.y_mm]


class TagsFile(Strict):
    """A layout of tags; what ``stcal locate`` adds, a board does without."""

    type: Literal["tags"]
    name: str = "tags"
    sigma_mm: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    origin: Annotated[int, Field(ge=0, strict=True)] | None = None
    sigma_px: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    tag_sigma_px: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    covariance_mm2: list[list[Finite]] | None = None
    tag: list[TagEntry] = Field(min_length=1)

    def covariance(self) -> np.ndarray | None:
        """(8n, 8n) mm² of the corners' coordinates; None where the file states none."""
        if self.covariance_mm2 is None:
            return None
        full = np.zeros((len(self.covariance_mm2),) * 2)
        for k, row in enumerate(self.covariance_mm2):
            full[k, : k + 1] = full[: k + 1, k] = row
        return full

    @model_validator(mode="after")
    def _states_a_covariance(self) -> Self:
        lower, size = self.covariance_mm2, 8 * len(self.tag)
        if lower is not None and [len(row) for row in lower] != list(range(1, size + 1)):
            raise mistake(f"covariance_mm2: not the lower triangle of {size} rows, 8 for each tag; calibrate again")
        full = self.covariance()
        if full is not None:
            corners = [f"corner {corner} of tag {tag.id}" for tag in self.tag for corner in range(4)]
            try:
                require_covariance(full, size, Rows.of(corners, "xy"))
            except InputError as error:
                raise mistake(f"covariance_mm2: {error}; calibrate again") from error
        return self


def load_flat_board(path: str | Path) -> BoardDesign | FlatBoard:
    """Read a board file of any kind (form: ``data_layout.md``); one without ``type`` is of dots.

    Raises
    ------
    InputError
        Unreadable, or not as its kind needs it; the message names file, place and reason.
    """
    where = f"board file {path}"
    kind = _kind(path)
    if kind == "circles":
        return load_board(path)
    if kind == "chessboard":
        data = load_toml(path, _Chessboard, "board file", REMEDY)
        return ChessboardDesign(data.rows, data.columns, data.square_mm, data.sigma_mm)
    if kind == "charuco":
        data = load_toml(path, _Charuco, "board file", REMEDY)
        if data.marker_mm >= data.square_mm:
            raise InputError(
                f"{where}: marker_mm {data.marker_mm:g}, under square_mm {data.square_mm:g} needed; are they swapped?"
            )
        return CharucoDesign(
            data.rows,
            data.columns,
            data.square_mm,
            data.marker_mm,
            data.dictionary,
            data.legacy,
            data.sigma_mm,
        )
    if kind == "tags":
        data = load_toml(path, TagsFile, "board file", REMEDY)
        corners = [tag.corners(where) for tag in data.tag]
        for tag, place in zip(data.tag, corners, strict=True):
            if place is None:
                raise InputError(f"{where}: tag {tag.id}: no place; x_mm, y_mm and size_mm, or corners_mm needed")
        return TagLayout(tuple((tag.dictionary, tag.id) for tag in data.tag), np.array(corners), data.sigma_mm)
    raise InputError(f"{where}: type {kind!r}; one of {', '.join(KINDS)} needed")


def _kind(path: str | Path) -> str:
    """The file's ``type``; dots where it says nothing, or is no TOML: its own loader then says why."""
    try:
        content = tomllib.loads(read_bytes(path, SETTINGS_BYTES).decode("utf-8-sig"))
    except OSError as error:
        raise InputError(f"board file {path}: {error.strerror or error}; {REMEDY}") from error
    except (ValueError, RecursionError):
        return "circles"
    if "type" not in content and not OF_OTHERS.isdisjoint(content):
        raise InputError(f"board file {path}: no type; {REMEDY}")
    return str(content.get("type", "circles"))
