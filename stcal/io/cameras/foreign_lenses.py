"""Lenses of unsupported models: their projection, to which a supported model can be fitted."""

import re
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, Camera, opencv_lens
from stcal.geometry.plane import inside
from stcal.io.cameras.camera_model import CameraModel, camera_from_colmap, camera_from_opencv
from stcal.io.cameras.keys import pass_over

COLMAP_FOREIGN = {
    "FOV": (7, 5),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
}
"""COLMAP's unsupported models: their numbers in binary files, and their numbers of parameters."""
SPLINED = re.compile(r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=([23])_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)")
"""Pattern of mrcal's name of a splined lens model, which includes its configuration."""
NUMBERS = {
    **dict(
        enumerate(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"))
    ),
    **{8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE"},
    **{number: name for name, (number, _) in COLMAP_FOREIGN.items()},
}
"""The names of COLMAP's models by their numbers in binary files and databases."""
WRITE_AHEAD = b"\2\2"
"""Bytes 18 and 19 of a database in SQLite's mode of a write-ahead log (sqlite.org/fileformat.html, 1.3)."""
SQUARE = 1e-9  # largest ratio of skew to focal length that counts as no skew
MARGIN = {2: 1, 3: 2}  # number of intervals beyond the stated field of view, by the order of the spline


@dataclass(frozen=True, slots=True, eq=False)
class ForeignLens:
    """A lens that is known by its projection only, of a model that is ``called`` so. ``project`` : returns pixels
    (n, 2) of rays (n, 3), z > 0, centre of the first pixel at (0, 0); ``width``, ``height`` : px, or None if the
    file states none; ``region`` : polygon (n, 2), px, within which it was determined, or None."""

    called: str
    project: Callable[[np.ndarray], np.ndarray]
    width: int | None
    height: int | None
    region: np.ndarray | None = None

    def __post_init__(self):  # a number beyond all numbers is no pixel, and no warning
        object.__setattr__(self, "project", np.errstate(all="ignore")(self.project))

    @classmethod
    def of(
        cls, called: str, lens, distorted: Callable[[np.ndarray], np.ndarray], size: Sequence[float], skew: float = 0.0
    ) -> "ForeignLens":
        """Return the lens of fx, fy, cx, cy, px, with ``skew`` as of :func:`of_opencv`. ``distorted`` : returns the
        distorted normalised coordinates (n, 2) of rays (n, 3); ``size`` : width and height, 0 if not stated."""
        fx, fy, cx, cy = lens
        transposed, centre = np.array([[fx, 0], [skew, fy]]), np.array([cx, cy])
        width, height = (int(side) or None for side in size)
        return cls(called, lambda rays: distorted(rays) @ transposed + centre, width, height)

    def determined(self, pixels: np.ndarray) -> np.ndarray:
        """Return which pixels (n, 2) lie in the region, (n,) bool; all of them if the file states none."""
        return np.ones(len(pixels), bool) if self.region is None else inside(self.region, pixels)


def of_colmap(model: str, width: float, height: float, params) -> CameraModel | ForeignLens:
    """Return the camera of any of COLMAP's models but EQUIRECTANGULAR; ``params`` in its order and pixel origin.
    COLMAP 4, ``sensor/models.h``. A. Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens
    distortion", CVPR 2001 (DIVISION). J. Engel et al., "Project Aria", 2023 (RAD_TAN_THIN_PRISM_FISHEYE)."""
    numbers = [float(value) for value in params]
    if model not in COLMAP_FOREIGN:
        return camera_from_colmap(model, width, height, numbers)
    _, count = COLMAP_FOREIGN[model]
    if len(numbers) != count:
        raise InputError("E-CAMERA-COEFFICIENTS", f"{len(numbers)} parameters for {model}, {count} needed")
    double = model.startswith("SIMPLE_")
    focal, others = (numbers[:1] * 2, numbers[1:]) if double else (numbers[:2], numbers[2:])
    if model in ("SIMPLE_FISHEYE", "FISHEYE"):  # without distortion
        return camera_from_colmap("OPENCV_FISHEYE", width, height, [*focal, *others, 0, 0, 0, 0])
    camera_from_colmap("PINHOLE", width, height, [*focal, *others[:2]])  # refuses impossible values
    coefficients, centre = np.array(others[2:]), np.array(others[:2]) - COLMAP_PIXEL_ORIGIN
    require_finite(coefficients)
    distorted = partial(_colmap_normalised, model.removeprefix("SIMPLE_"), coefficients)
    return ForeignLens.of(f"COLMAP's {model}", [*focal, *centre], distorted, (width, height))


def _colmap_normalised(model: str, own: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the distorted normalised coordinates (n, 2) of rays (n, 3); ``own`` : parameters of the model."""
    if model == "EUCM":
        return _on_plane("eucm", own, rays)
    xy = rays[:, :2] / rays[:, 2:]
    if model == "FOV":
        return _of_fov(own[0], xy)
    r2 = (xy**2).sum(axis=1)
    if model == "DIVISION":  # ideal = distorted / (1 + k r²)
        return xy * (2 / (1 + np.sqrt(1 - 4 * own[0] * r2)))[:, None]
    k, p, s = own[:6], own[6:8], own[8:]
    angle = np.arctan(np.sqrt(r2))
    even = angle[:, None] ** (2 * np.arange(1, 7))
    xy = xy * (np.where(r2 > 0, angle / np.where(r2 > 0, np.sqrt(r2), 1), 1) * (1 + even @ k))[:, None]
    r2 = (xy**2).sum(axis=1)[:, None]
    return xy + 2 * xy * (xy @ p)[:, None] + p * r2 + s[[0, 2]] * r2 + s[[1, 3]] * r2**2


def of_database(path: Path, choice: str) -> CameraModel | ForeignLens:
    """Return the camera of a COLMAP database, or the one of number ``choice``; the file is opened read-only."""
    try:
        # Without its log a database is read as it stands: SQLite would write files beside it.
        how = "mode=ro" if _has_log(path) else "mode=ro&immutable=1"
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_PARAMETERS)
            if not database.execute(STORED_TABLE).fetchone():  # a view is a program, which may not end
                raise sqlite3.DatabaseError("no such table: cameras")
            rows = database.execute("SELECT camera_id, model, width, height, params FROM cameras").fetchall()
        cameras = {str(number): (NUMBERS[model], *rest) for number, model, *rest in rows}
        model, width, height, params = chosen_of_colmap(cameras, choice)
        return of_colmap(model, width, height, np.frombuffer(params, "<f8"))
    except (sqlite3.Error, KeyError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:100]
        with open(path, "rb") as stream:
            head = stream.read(20)
        if isinstance(error, sqlite3.Error) and head[18:] == WRITE_AHEAD and not _has_log(path):
            fault = f"a database whose newest content is in {path.name}-wal, which is missing or empty ({reason})"
            remedy = "copy both, or close the program that has it open and copy again"
            raise InputError("E-CAMERA-UNREADABLE", f"{fault}; {remedy}") from error
        raise InputError("E-CAMERA-UNREADABLE", f"no database of COLMAP ({reason}); check it") from error


STORED_TABLE = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'cameras' AND sql NOT LIKE '%VIRTUAL%'"
MOST_PARAMETERS = 100_000
"""Most bytes of a value: of a camera's parameters there are some hundred."""


def _has_log(path: Path) -> bool:
    log = path.with_name(f"{path.name}-wal")
    return log.is_file() and log.stat().st_size > 0


def chosen_of_colmap(cameras: Mapping[str, Any], choice: str) -> Any:
    """Return a numbered camera's values; of a single one, a word is the name to write, and chooses nothing."""
    return cameras[one_of(list(cameras), choice if choice.isdigit() or len(cameras) > 1 else "")]


def one_of(names: list[str], choice: str) -> str:
    """Return the name of the camera ``choice`` of a file, or of its only camera."""
    if not names:
        raise InputError("E-CAMERA-NONE", "no camera in it, 1 needed")
    if choice not in names and (choice or len(names) > 1):
        asked = f"no camera {choice}" if choice else f"{len(names)} cameras, 1 needed"
        shown = ", ".join(names[:12]) + (" …" if len(names) > 12 else "")
        raise InputError("E-CAMERA-SEVERAL", f"{asked}; choose of {shown} with --camera-name, or `stcal camera` --name")
    others = [name for name in names if name != (choice or names[0])]
    pass_over(others, "the other cameras, " if len(others) > 1 else "the other camera, ")
    return choice or names[0]


def require_finite(numbers) -> None:
    """Refuse parameters of a camera that are not finite."""
    if not np.isfinite(numbers).all():
        raise InputError("E-CAMERA-NOT-FINITE", "a camera parameter is not a finite number; correct it")


def of_opencv(lens, given: np.ndarray, width: float, height: float, skew: float = 0.0) -> CameraModel | ForeignLens:
    """Return the perspective camera of fx, fy, cx, cy and OpenCV's coefficients, also thin prisms and tilted sensor;
    with ``skew``, px, u = fx x + skew y + cx."""
    if not abs(skew) <= SQUARE * abs(lens[0]):
        return of_parts(lens, skew, given, "perspective", width, height)
    if len(given) not in (12, 14) or not given[8:].any():
        return camera_from_opencv(lens, given, False, width, height)
    camera_from_opencv(lens, given[:8], False, width, height)  # refuses impossible values
    require_finite(given)
    still = np.zeros(3)

    def distorted(rays: np.ndarray) -> np.ndarray:
        return cv2.projectPoints(np.array(rays, float), still, still, np.eye(3), given)[0].reshape(-1, 2)

    tilted = len(given) == 14 and given[12:].any()
    called = "OpenCV's lens with a tilted sensor" if tilted else "OpenCV's lens with thin prisms"
    return ForeignLens.of(called, lens, distorted, (width, height))


def of_parts(
    lens, skew: float, given: np.ndarray, kind: str, width: float, height: float, xi: float = 0.0
) -> ForeignLens:
    """Return a lens of a projection, OpenCV's distortion (k,), and a matrix of fx, fy, cx, cy with skew as of
    :func:`of_opencv`. ``kind`` : perspective, equidistant (k1 to k4), or unified: Mei's projection with ``xi``, of
    OpenCV's omnidir, Kalibr's omni and camodocal's MEI; sides of 0 px if the file states none."""
    camera = camera_from_opencv(lens, given, kind == "equidistant", width, height)
    if not abs(skew) < abs(camera.focal[0]):
        raise InputError("E-CAMERA-SKEW", f"skew {skew:g} px, less than fx needed; correct it")
    if not (np.isfinite(xi) and xi >= 0):
        raise InputError("E-CAMERA-CONTENT", f"xi {xi:g}; a number from 0 needed")
    distort = without_matrix(camera.distortion, kind == "equidistant")
    called = f"a unified lens with ξ = {xi:g}" if kind == "unified" else "a lens with skewed axes"
    return ForeignLens.of(
        called, lens, lambda rays: distort(_on_plane("omni", np.array([xi]), rays)), (width, height), skew
    )


def without_matrix(distortion: np.ndarray, fisheye: bool) -> Callable[[np.ndarray], np.ndarray]:
    """Return :meth:`Camera.distort` of a camera with this distortion (12,)."""
    return Camera(1, 1, [1, 1], [0, 0], distortion, fisheye).distort


def of_kalibr(lens: str, distortion: str, numbers: np.ndarray, given: np.ndarray, size) -> ForeignLens:
    """Return the lens of Kalibr's models omni, eucm, ds or pinhole with radtan, equidistant, fov or no distortion.
    C. Mei, P. Rives, "Single View Point Omnidirectional Camera Calibration from Planar Grids", ICRA 2007. B.
    Khomutenko et al., "An Enhanced Unified Camera Model", RA-L 2016. V. Usenko et al., "The Double Sphere Camera
    Model", 3DV 2018. F. Devernay, O. Faugeras, "Straight lines have to be straight", Machine Vision and Applications
    13, 2001."""
    first = {"omni": 1, "eucm": 2, "ds": 2, "pinhole": 0}[lens]
    count = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}[distortion]
    coefficients = given if count else np.zeros(0)
    of_model = numbers.shape == (first + 4,) and coefficients.shape == (count,)
    if not of_model or not np.isfinite([*numbers, *coefficients]).all():
        fault = f"{lens} with {distortion} has {first + 4} intrinsics and {count} coefficients, finite numbers"
        raise InputError("E-CAMERA-COEFFICIENTS", f"{fault}; {numbers.size} and {coefficients.size} found")
    shape, matrix = numbers[:first], numbers[first:]
    if (matrix[:2] <= 0).any():
        raise InputError("E-CAMERA-FOCAL", f"focal length {matrix[:2].tolist()}; positive numbers needed")
    if distortion == "fov":
        distort = partial(_of_fov, coefficients[0])
    else:
        fisheye = distortion == "equidistant"
        distort = without_matrix(opencv_lens(coefficients, fisheye)[0], fisheye)
    called = f"Kalibr's {lens} with {distortion}"
    return ForeignLens.of(called, matrix, lambda rays: distort(_on_plane(lens, shape, rays)), size)


def _on_plane(lens: str, shape: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the normalised coordinates (n, 2) of rays (n, 3); nan where a ray has none."""
    below, r2, length = rays[:, 2], (rays[:, :2] ** 2).sum(axis=1), np.linalg.norm(rays, axis=1)
    if lens in ("omni", "ds"):
        below = below + shape[0] * length
    if lens in ("eucm", "ds"):
        alpha, beta = (shape[0], shape[1]) if lens == "eucm" else (shape[1], 1.0)
        below = alpha * np.sqrt(beta * r2 + below**2) + (1 - alpha) * below
    return rays[:, :2] / np.where(below > 0, below, np.nan)[:, None]


def _of_fov(omega: float, xy: np.ndarray) -> np.ndarray:
    r = np.maximum(np.sqrt((xy**2).sum(axis=1)), 1e-12)  # below this radius the model is linear
    return xy * (np.arctan(2 * r * np.tan(omega / 2)) / (omega * r))[:, None]


def of_splines(name: str, numbers: list[float], width: float, height: float) -> ForeignLens:
    """Return mrcal's splined stereographic lens: pixels are f · (u + B-spline of u), |u| = 2 tan(θ / 2)."""
    match = SPLINED.fullmatch(name)
    if match is None:
        raise InputError("E-CAMERA-MODEL", f"{name[:80]} is no splined model of mrcal's form; write it again")
    order, columns, rows, wide = (int(word) for word in match.groups())
    needed = 4 + 2 * columns * rows
    if columns <= MARGIN[order] + 1 or len(numbers) != needed or not 0 < wide < 360:
        size = f"{len(numbers)} intrinsics of {columns}×{rows} points; {needed} needed"
        raise InputError("E-CAMERA-COEFFICIENTS", size)
    control = np.array(numbers[4:]).reshape(rows, columns, 2)
    per_u = (columns - 1 - MARGIN[order]) / (4 * np.tan(np.radians(wide) / 4))
    middle = np.array([(columns - 1) / 2, (rows - 1) / 2])

    def distorted(rays: np.ndarray) -> np.ndarray:
        u = 2 * rays[:, :2] / (np.linalg.norm(rays, axis=1) + rays[:, 2])[:, None]
        at = (u * per_u + middle).T[::-1]
        settings = {"order": order, "prefilter": False, "mode": "nearest"}
        from scipy.ndimage import map_coordinates  # of this model alone; a tenth of the start of a run

        moved = [map_coordinates(c, at, **settings) for c in np.moveaxis(control, 2, 0)]
        return u + np.column_stack(moved)

    return ForeignLens.of(f"mrcal's splines of {columns}×{rows} points", numbers[:4], distorted, (width, height))


def refused(camera: Camera, form: str, why: str) -> InputError:
    """Return the error for a camera with a property ``why`` that a form cannot hold."""
    return InputError("E-CAMERA-FORM", f"{form} has no place for {why} of {camera.colmap_model}; write --form colmap")


def of_cahvor(numbers, width: float, height: float) -> CameraModel | ForeignLens:
    """Return the camera of mrcal's ``LENSMODEL_CAHVOR`` : fx, fy, cx, cy, two angles of the optical axis, r0, r1,
    r2; a supported model if both angles are zero. A ray P is bent to P + μ (P − ζ o), with ζ = P · o, τ = |P|² / ζ²
    − 1 and μ = r0 + r1 τ + r2 τ² (D. Gennery, "Generalized camera calibration including fish-eye lenses", IJCV 68,
    2006)."""
    if len(numbers) != 9:
        raise InputError("E-CAMERA-COEFFICIENTS", f"{len(numbers)} intrinsics of LENSMODEL_CAHVOR; 9 needed")
    (fx, fy, cx, cy), (alpha, beta, *r) = numbers[:4], numbers[4:]
    require_finite(numbers)
    if alpha == beta == 0:
        grown = 1 + r[0]
        k1, k2 = (r[1] / grown, r[2] / grown) if grown else (0.0, 0.0)
        return of_opencv([fx * grown, fy * grown, cx, cy], np.array([k1, k2, 0.0, 0.0]), width, height)
    camera_from_opencv([fx, fy, cx, cy], np.zeros(4), False, width, height)  # refuses impossible values
    axis = np.array([np.sin(alpha) * np.cos(beta), np.sin(beta), np.cos(alpha) * np.cos(beta)])

    def distorted(rays: np.ndarray) -> np.ndarray:
        along = rays @ axis
        tau = (rays**2).sum(axis=1) / along**2 - 1
        bent = rays + (r[0] + tau * (r[1] + tau * r[2]))[:, None] * (rays - along[:, None] * axis)
        inside = (along > 0) & (bent[:, 2] > 0)
        return np.where(inside[:, None], bent[:, :2] / bent[:, 2:], np.nan)

    return ForeignLens.of("mrcal's CAHVOR", numbers[:4], distorted, (width, height))
