"""Reading of camera files of any kind, which is recognised by the content."""

import re
import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.io.cameras import forms, matlab, metashape
from stcal.io.cameras.foreign import ForeignLens, of_colmap, of_database, of_opencv, one_of
from stcal.io.cameras.model import (
    COLMAP_MODELS,
    CORRELATION,
    EQUIDISTANT,
    MAX_SIDE_PX,
    PARAMETER_NAMES,
    SIGMA,
    SQUARE_WITHIN,
    CameraModel,
    camera_from_opencv,
    camera_model,
    parameter_names,
)
from stcal.io.covariance import Rows, require_covariance
from stcal.io.files import SETTINGS_BYTES, read_bytes
from stcal.io.plain_yaml import load_yaml

SQLITE = b"SQLite format 3\0"
"""First bytes of an SQLite database."""


def read_camera(path: str | Path, name: str = "") -> CameraModel:
    """Read a camera file of any supported kind, which is recognised by the content.

    Parameters
    ----------
    path : str or Path
        COLMAP, OpenCV, ROS, ROS-Industrial, Kalibr, mrcal or Metashape (``data_layout.md``).
    name : str
        Name of the camera in a file of several.

    Raises
    ------
    InputError
        The file is missing or malformed, holds more than one camera, or a lens of an unsupported model.
    """
    lens = read_lens(path, name)
    if isinstance(lens, CameraModel):
        return lens
    raise InputError(
        "E-CAMERA-MODEL",
        f"camera file {path}: {lens.called} is none of {', '.join(COLMAP_MODELS)}; fit one of them to it with "
        "`stcal camera convert`",
    )


def read_lens(path: str | Path, name: str = "") -> CameraModel | ForeignLens:
    """Read the lens of a camera file, also of an unsupported model; arguments and errors as :func:`read_camera`."""
    path = Path(path)
    try:
        database = path.is_file() and _starts_with(path, SQLITE)
        content = b"" if database else read_bytes(path, SETTINGS_BYTES)
    except OSError as error:
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {path}: {error.strerror or error}; give a readable file"
        ) from error
    except ValueError as error:  # a NUL in the name
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {path}: not a text file; give cameras.txt, or OpenCV's YAML or XML"
        ) from error
    if database:
        return of_database(path, name)
    if matlab.is_mat(content):
        return matlab.from_mat(content, name, str(path))
    if content[:8] == struct.pack("<Q", content[0] if content else 0) and b"\0" in content:
        return forms.from_colmap_binary(content, name, str(path))
    try:
        text = content.decode("utf-8-sig")
    except ValueError as error:
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {path}: not a text file; give cameras.txt, or OpenCV's YAML or XML"
        ) from error
    try:
        if text.lstrip().startswith("<"):
            root = ElementTree.fromstring(text)
            if root.tag == "calibration":
                return metashape.from_calibration(root, str(path))
            if root.tag in metashape.ROOTS:
                return metashape.from_cameras(root, name, str(path))
            return _from_opencv(_xml_values(root), path)
        rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        if rows and rows[0][0].startswith("{") and "lensmodel" in text:
            return forms.from_mrcal(text, str(path))
        if rows and len(rows[0]) >= 5 and re.fullmatch(r"[A-Z][A-Z0-9_]+", rows[0][1]):
            lens = _from_colmap(rows, name, path)
            if isinstance(lens, ForeignLens):
                return lens
            return replace(lens, covariance=_stated_covariance(text, parameter_names(lens.colmap_model), path))
        if matlab.is_zhang(rows):
            return matlab.from_zhang(rows, str(path))
        values = _yaml_values(text)
        if matlab.STRUCTURE in values or "MappingCoefficients" in values:
            return matlab.from_structure(values, str(path))
        if any(isinstance(value, dict) and "camera_model" in value for value in values.values()):
            return forms.from_kalibr(values, name, str(path))
        return _from_opencv(values, path)
    except InputError:
        raise
    except (KeyError, ElementTree.ParseError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            "E-CAMERA-UNREADABLE",
            f"camera file {path}: neither COLMAP's cameras.txt nor OpenCV's YAML or XML ({reason}); check its form",
        ) from error


def _stated_covariance(text: str, names: list[str], path: Path) -> np.ndarray | None:
    """Return the covariance (q, q) in the comments of :func:`write_cameras_txt`; None if there are none."""
    stated = {
        key: [line.split()[2:] for line in text.splitlines() if line.startswith(key)] for key in (SIGMA, CORRELATION)
    }
    if not any(stated.values()):
        return None
    count = len(names)
    try:
        if len(stated[SIGMA]) != 1 or [len(row) for row in stated[CORRELATION]] != [count] * count:
            raise InputError("E-CAMERA-COVARIANCE", f"a line of {count} σ and {count}×{count} correlations needed")
        sigma, correlation = np.array(stated[SIGMA][0], float), np.array(stated[CORRELATION], float)
        if len(sigma) != count:
            raise InputError("E-CAMERA-COVARIANCE", f"{len(sigma)} σ, {count} needed")
        _require_sigmas(sigma, correlation, names)
        covariance = correlation * np.outer(sigma, sigma)
        require_covariance(covariance, count, Rows(tuple(names)), definite=True)
    except (InputError, ValueError) as error:
        raise InputError(
            "E-CAMERA-COVARIANCE",
            f"camera file {path}: SIGMA and CORRELATION state no covariance of its parameters: {error}; write it "
            "again, or remove these comments",
        ) from error
    return covariance


def _require_sigmas(sigma: np.ndarray, correlation: np.ndarray, names: list[str]) -> None:
    """Refuse invalid σ, and correlations of a parameter with itself other than 1: the covariance hides such errors."""
    for name, sigma_of_name, self_correlation in zip(names, sigma, np.diagonal(correlation), strict=True):
        if not 0 < sigma_of_name <= MAX_SIDE_PX:
            raise InputError(
                "E-CAMERA-COVARIANCE", f"σ of {name} is {sigma_of_name:g}, a positive number up to {MAX_SIDE_PX} needed"
            )
        if not abs(self_correlation - 1) <= SQUARE_WITHIN:
            raise InputError(
                "E-CAMERA-COVARIANCE", f"correlation of {name} with itself is {self_correlation:g}, 1 needed"
            )


def _starts_with(path: Path, head: bytes) -> bool:
    with open(path, "rb") as stream:
        return stream.read(len(head)) == head


def _from_colmap(rows: list[list[str]], name: str, path: Path) -> CameraModel | ForeignLens:
    cameras = {row[0]: row[1:] for row in rows}
    if len(cameras) < len(rows):
        raise InputError("E-CAMERA-REPEATED", f"camera file {path}: two cameras of one number; correct it")
    model, *values = cameras[one_of(list(cameras), name if name.isdigit() else "", str(path))]
    try:
        width, height, *params = (float(value) for value in values)
    except ValueError as error:
        raise InputError(
            "E-CAMERA-CONTENT", f"camera file {path}: {' '.join(str(error).split())[:150]}; numbers needed"
        ) from error
    return of_colmap(model, width, height, params, str(path))


def _from_opencv(values: dict, path: Path) -> CameraModel | ForeignLens:
    names = {"K": "camera_matrix", "cameraMatrix": "camera_matrix", "D": "distortion_coefficients"}
    names |= {"distCoeffs": "distortion_coefficients", "dist_coeffs": "distortion_coefficients"}
    values = {names.get(key, key): value for key, value in values.items()}
    if "camera_matrix" not in values:
        if isinstance(values.get("intrinsics"), dict):
            return _from_industrial(values["intrinsics"], path)
        raise InputError(
            "E-CAMERA-CONTENT",
            f"camera file {path}: no camera_matrix; write it with cv2.FileStorage or as ROS camera_info",
        )
    matrix = np.asarray(values["camera_matrix"], float)
    if matrix.size != 9:
        raise InputError(
            "E-CAMERA-COEFFICIENTS", f"camera file {path}: camera_matrix of {matrix.size} numbers; 3×3 needed"
        )
    matrix = matrix.reshape(3, 3)
    if (matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != [0, 0, 0, 1]).any():
        raise InputError(
            "E-CAMERA-MATRIX", f"camera file {path}: camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; is it transposed?"
        )
    if not abs(matrix[0, 1]) <= 1e-9 * abs(matrix[0, 0]) and np.isfinite(matrix[0, 0]):
        raise InputError(
            "E-CAMERA-SKEW", f"camera file {path}: skew {matrix[0, 1]:g} is not supported; calibrate without skew"
        )
    model = values.get("distortion_model", "plumb_bob")
    given = np.asarray(values.get("distortion_coefficients", []), float).ravel()
    lens = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    # A missing size, or 0, means that the file states none.
    sides = [values.get(f"image_{side}") for side in ("width", "height")]
    if any(isinstance(side, bool) for side in sides):
        raise InputError(
            "E-CAMERA-SIZE", f"camera file {path}: image_width and image_height are {sides}; numbers of pixels needed"
        )
    if model not in ("plumb_bob", "rational_polynomial", *EQUIDISTANT):
        raise InputError(
            "E-CAMERA-MODEL", f"camera file {path}: distortion model {model!r} is not supported; use plumb_bob"
        )
    width, height = (float(side or 0) for side in sides)
    if model in EQUIDISTANT:
        return camera_from_opencv(lens, given, True, width, height, path)
    return of_opencv(lens, given, width, height, str(path))


def _from_industrial(values: dict, path: Path) -> CameraModel:
    """Return the camera of a ROS-Industrial file as OPENCV: the lens may have distortion, though the form has not."""
    missing = [key for key in PARAMETER_NAMES[:4] if key not in values]
    if missing:
        raise InputError(
            "E-CAMERA-CONTENT", f"camera file {path}: intrinsics without {', '.join(missing)}; fx, fy, cx, cy needed"
        )
    flat = np.concatenate([np.array([values[key] for key in PARAMETER_NAMES[:4]], float), np.zeros(8)])
    return camera_model(flat, "OPENCV", None, None, path)


def _yaml_values(text: str) -> dict:
    values = load_yaml(text)
    if not isinstance(values, dict):
        raise ValueError("no keys")
    return {k: v["data"] if isinstance(v, dict) and "data" in v else v for k, v in values.items()}


def _xml_values(root: ElementTree.Element) -> dict:
    values = {}
    for node in root:
        data = node.find("data")
        if data is not None:
            values[node.tag] = [float(word) for word in (data.text or "").split()]
        elif node.text and not len(node):
            values[node.tag] = node.text.strip().strip('"')
    return values
