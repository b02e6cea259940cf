"""Camera files of any kind, recognised by their content; the camera that a photograph's EXIF describes; and writers.

Pixel origins: the centre of the first pixel is at (0, 0) in OpenCV, ROS, Kalibr and mrcal, at (0.5, 0.5) in COLMAP and
Metashape; Metashape's principal point is relative to the middle of the image.
"""

import ast
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Literal, cast

import numpy as np
import yaml
from PIL import ExifTags, Image

from stcal.errors import InputError, held
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import COLMAP_MODELS, Camera, parameter_names
from stcal.io.cameras import foreign_lenses as foreign
from stcal.io.cameras import matlab, metashape
from stcal.io.cameras.camera_model import CameraModel, camera_from_opencv, cameras_txt, model_of, stated_covariance
from stcal.io.cameras.foreign_lenses import ForeignLens, chosen_of_colmap, of_colmap, of_database
from stcal.io.cameras.keyed import READ, from_ini, from_keys, is_ini, values_of
from stcal.io.cameras.keys import pass_over, reading, require_known
from stcal.io.cameras.matlab import mat
from stcal.io.decoding import heic_turns, is_heic, let_pillow_read_heic
from stcal.io.files import IMAGE_BYTES, SETTINGS_BYTES, read_bytes, require_written, save, text_of

HEADS = (b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"\x89PNG")  # first bytes of JPEG, TIFF and PNG
FILM_DIAGONAL_MM = 43.2666
"""Diagonal of 36 × 24 mm, by which CIPA DCG-001 states focal lengths; widths would differ by 4 % at 4 : 3."""
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Lengths, in mm, of the values of ``FocalPlaneResolutionUnit``."""
SIGMA_FOCAL, SIGMA_SQUARE = 0.05, 1e-3
"""Relative σ of the focal length, which EXIF states nominally and at infinity, and of the ratio of fx to fy."""
SIGMA_CENTRE = 0.02  # σ of the principal point, in image widths
SIGMA_RADIAL, SIGMA_TANGENTIAL = 0.2, 5e-3
"""σ of radial and tangential distortion, which EXIF does not state."""


def is_photograph(path: str | Path) -> bool:
    """Return True if a file begins with the bytes of an image."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(12)
            return head.startswith(HEADS) or is_heic(head)
    except (OSError, ValueError):
        return False


def camera_of_photograph(path: str | Path) -> tuple[Camera, str]:
    """Return the camera that the EXIF of a JPEG, TIFF, PNG or HEIC describes, OPENCV without distortion and with a
    covariance for what EXIF leaves open; and in words the entries used."""
    where = f"camera file {path}"
    try:
        data = read_bytes(path, IMAGE_BYTES)
        if is_heic(data):
            let_pillow_read_heic(where)
        with Image.open(BytesIO(data)) as image:
            (width, height), exif = image.size, image.getexif().get_ifd(ExifTags.IFD.Exif)
        if is_heic(data) and heic_turns(data) % 2:
            width, height = height, width
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = " ".join(str(error).split())[:100]
        fault = f"{where}: no photograph that can be read ({reason})"
        raise InputError("E-CAMERA-UNREADABLE", f"{fault}; give another") from error
    focal, told = _focal_px(exif, width, height)
    if focal is None:
        none = f"{where}: a photograph whose EXIF states {told}"
        raise InputError("E-CAMERA-EXIF", f"{none}; give a camera file, or `stcal-sfm calibrate-camera`")
    if (zoom := _positive(exif, "DigitalZoomRatio") or 1.0) != 1:
        zoomed = f"{where}: a photograph with a digital zoom of {zoom:g}; makers differ in whether the focal length"
        either = f"includes it, so that it is {focal:.0f} or {zoom * focal:.0f} px"
        raise InputError("E-CAMERA-EXIF", f"{zoomed} {either}; take one without zoom")
    if exif.get(ExifTags.Base.ExifImageWidth, width) not in (width, height):
        told += f", of {exif[ExifTags.Base.ExifImageWidth]} px before it was made {width} px wide"
    centre = [(width - 1) / 2, (height - 1) / 2]
    camera = camera_from_opencv([focal, focal, *centre], np.zeros(0), False, width, height).sized(width, height)
    sigma = np.array([1, 1, *[SIGMA_CENTRE * width] * 2, *[SIGMA_RADIAL] * 2, *[SIGMA_TANGENTIAL] * 2])
    covariance = np.diag(sigma**2)
    covariance[:2, :2] = SIGMA_FOCAL**2 * focal**2 * np.ones((2, 2)) + SIGMA_SQUARE**2 * focal**2 / 2 * np.eye(2)
    return Camera.of(camera, "OPENCV", covariance), told


def _focal_px(exif: dict, width: int, height: int) -> tuple[float | None, str]:
    """Return the focal length in px of this image, None if unknown, and in words the entries used, or the fault."""
    full = _positive(exif, "ExifImageWidth") or max(width, height)
    scale = max(width, height) / max(full, _positive(exif, "ExifImageHeight") or 0)
    focal_mm, per_unit = _positive(exif, "FocalLength"), _positive(exif, "FocalPlaneXResolution")
    unit_mm = UNIT_MM.get(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal_mm and per_unit and unit_mm:
        pitch_um = 1e3 * unit_mm / per_unit / scale
        sensor = "×".join(f"{1e-3 * pitch_um * side:.3g}" for side in (width, height))
        told = f"focal length {focal_mm:g} mm, pixels of {pitch_um:.3g} µm, so a sensor of {sensor} mm (check it)"
        return focal_mm / pitch_um * 1e3, told
    if film_mm := _positive(exif, "FocalLengthIn35mmFilm"):
        return film_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height)), f"{film_mm:g} mm in 35 mm film"
    return None, f"{focal_mm:g} mm, but no size of its pixels" if focal_mm else "no focal length"


def _positive(exif: dict, name: str) -> float | None:
    try:
        number = float(exif.get(ExifTags.Base[name], np.nan))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < np.inf else None


CameraForm = Literal[
    "colmap", "colmap-bin", "opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab"
]
"""Forms in which cameras are written."""
SUFFIXES = {
    ".txt": "colmap",
    ".bin": "colmap-bin",
    ".yaml": "opencv",
    ".yml": "opencv",
    ".cameramodel": "mrcal",
    ".xml": "metashape",
    ".mat": "matlab",
}
"""The form of a file by its suffix."""
MRCAL = {f"LENSMODEL_{name}": count for name, count in (("PINHOLE", 0), *((f"OPENCV{n}", n) for n in (4, 5, 8, 12)))}
"""Numbers of coefficients of those models of mrcal that are OpenCV's."""
MRCAL_HARMLESS = ("extrinsics", "icamintrinsics", "optimizationinputs", "rtcamref", "rtrefcam")
"""Keys of ``.cameramodel`` that say where a camera is, and from what it was calibrated."""
LEAST_CAMERA_BYTES = 48  # bytes of a camera of `cameras.bin` with three parameters


def from_mrcal(text: str, _: str) -> CameraModel | ForeignLens:
    """Return the camera of a ``.cameramodel`` whose lens model is OpenCV's, CAHVOR, or splined."""
    try:
        values = ast.literal_eval(text.strip())
        lens, numbers = values["lensmodel"], [float(v) for v in values["intrinsics"]]
        width, height = (float(v) for v in values["imagersize"])
    except (SyntaxError, ValueError, TypeError, KeyError, RecursionError, MemoryError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError("E-CAMERA-UNREADABLE", f"not mrcal's form ({reason}); write it anew with mrcal") from error
    stated = values.get("valid_intrinsics_region")
    try:
        region = None if stated is None or not np.size(stated) else np.array(stated, float)
    except (TypeError, ValueError):
        region = np.full(1, np.nan)  # refused below
    if region is not None and (region.ndim != 2 or region.shape[-1] != 2 or not np.isfinite(region).all()):
        raise InputError("E-CAMERA-CONTENT", "valid_intrinsics_region is no list of pixels; remove it")
    taken = ("lensmodel", "intrinsics", "imagersize", "valid_intrinsics_region")
    require_known({key: value for key, value in values.items() if key not in taken}, MRCAL_HARMLESS)
    if str(lens).startswith("LENSMODEL_SPLINED"):
        made = foreign.of_splines(lens, numbers, width, height)
    elif lens == "LENSMODEL_CAHVOR":
        made = foreign.of_cahvor(numbers, width, height)
    elif lens in MRCAL and len(numbers) == 4 + MRCAL[lens]:
        made = foreign.of_opencv(numbers[:4], np.array(numbers[4:]), width, height)
    else:
        known = f"{', '.join(MRCAL)}, CAHVOR and splined ones are read: mrcal-convert-lensmodel makes one of another"
        raise InputError("E-CAMERA-MODEL", f"{lens} with {len(numbers)} intrinsics; {known}")
    if isinstance(made, ForeignLens):
        return replace(made, region=region)
    pass_over([] if region is None else ["valid_intrinsics_region"])
    return made


def is_colmap_binary(content: bytes) -> bool:
    """Return True if a file begins with a number of cameras that it is long enough for; a text states a huge one."""
    count = int.from_bytes(content[:8], "little")
    return len(content) >= 8 and count <= (len(content) - 8) // LEAST_CAMERA_BYTES


def from_colmap_binary(content: bytes, choice: str) -> CameraModel | ForeignLens:
    """Return the camera of ``cameras.bin``, or the one of number ``choice``."""
    try:
        (count,) = struct.unpack_from("<Q", content, 0)
        at, cameras = 8, {}
        for _ in range(min(count, len(content) // 24)):
            number, kind, width, height = struct.unpack_from("<IiQQ", content, at)
            model = foreign.NUMBERS[kind]
            _, length = foreign.COLMAP_FOREIGN.get(model) or (0, len(parameter_names(model)))
            cameras[str(number)] = model, width, height, struct.unpack_from(f"<{length}d", content, at + 24)
            at += 24 + 8 * length
    except (struct.error, KeyError) as error:
        raise InputError("E-CAMERA-UNREADABLE", "neither text nor a cameras.bin of known models; check it") from error
    if at != len(content) or not cameras:
        raise InputError("E-CAMERA-UNREADABLE", "neither text nor COLMAP's cameras.bin; check it")
    return of_colmap(*chosen_of_colmap(cameras, choice))


def name_to_write(name: str) -> str:
    """Return a name that every form can hold: ``Cam_B_35mm`` of ``Cam B (35mm)``, ``cam1`` of 1, ``cam0`` of none."""
    word = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "cam0"
    return word if word[0].isalpha() else f"cam{word}"


def _colmap_binary(camera: Camera, _: str) -> bytes:
    params = camera.colmap_params()
    number = next(number for number, name in foreign.NUMBERS.items() if name == camera.colmap_model)
    head = struct.pack("<QIiQQ", 1, 1, number, camera.width, camera.height)
    return head + struct.pack(f"<{len(params)}d", *params)


def _coefficients(camera: Camera, form: str) -> list[float]:
    """Return k1 … k4 of an equidistant camera, and refuse one with others; else the first 5 or, if needed, 8."""
    if not camera.fisheye:
        return camera.distortion[: 8 if camera.distortion[5:8].any() else 5].tolist()
    if camera.distortion[2:4].any() or camera.distortion[8:].any():
        raise foreign.refused(camera, form, "p1, p2 and prisms")
    return camera.distortion[[0, 1, 4, 5]].tolist()


def _matrix(camera: Camera) -> list[float]:
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _opencv(camera: Camera, _: str) -> str:
    values = _coefficients(camera, "opencv")
    node = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
    kind = "distortion_model: equidistant\n" if camera.fisheye else ""
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f"camera_matrix: {node.format(3, 3, _matrix(camera))}{kind}"
        f"distortion_coefficients: {node.format(1, len(values), values)}"
    )


def _ros(camera: Camera, name: str) -> str:
    values = _coefficients(camera, "ros")
    kind = "equidistant" if camera.fisheye else "rational_polynomial" if len(values) == 8 else "plumb_bob"
    k, eye = _matrix(camera), np.eye(3).ravel().tolist()
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]

    def node(rows: int, data: list[float]) -> str:
        return f"\n  rows: {rows}\n  cols: {len(data) // rows}\n  data: {data}\n"

    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {name}\n"
        f"camera_matrix:{node(3, k)}distortion_model: {kind}\ndistortion_coefficients:{node(1, values)}"
        f"rectification_matrix:{node(3, eye)}projection_matrix:{node(3, p)}"
    )


def _kalibr(camera: Camera, name: str) -> str:
    if not camera.fisheye and camera.distortion[4:].any():
        raise foreign.refused(camera, "kalibr", "more than k1, k2, p1, p2")
    kind = "equidistant" if camera.fisheye else "radtan"
    values = _coefficients(camera, "kalibr")[:4]
    return (
        f"{name}:\n  camera_model: pinhole\n  intrinsics: {camera.parameters()[:4].tolist()}\n"
        f"  distortion_model: {kind}\n  distortion_coeffs: {values}\n"
        f"  resolution: [{camera.width}, {camera.height}]\n"
    )


def _mrcal(camera: Camera, _: str) -> str:
    if camera.fisheye:
        raise foreign.refused(camera, "mrcal", "the equidistant projection")
    values = _coefficients(camera, "mrcal") if camera.distortion.any() else []
    values = values[:4] if len(values) == 5 and not values[4] else values
    lens = next(name for name, count in MRCAL.items() if count == len(values))
    return (
        f"{{\n    'lensmodel': '{lens}',\n    'intrinsics': {[*camera.parameters()[:4].tolist(), *values]},\n"
        f"    'extrinsics': [0, 0, 0, 0, 0, 0],\n    'imagersize': [{camera.width}, {camera.height}]\n}}\n"
    )


WRITERS: Mapping[str, Callable[[Camera, str], str | bytes]] = {
    "colmap": lambda camera, _: cameras_txt(camera),
    "colmap-bin": _colmap_binary,
    "opencv": _opencv,
    "ros": _ros,
    "kalibr": _kalibr,
    "mrcal": _mrcal,
    "metashape": lambda camera, _: metashape.calibration(camera),
    "metashape-cameras": metashape.cameras,
    "matlab": mat,
}
"""Writers by form: each returns the file of a camera and its name."""
SQLITE = b"SQLite format 3\0"  # first bytes of an SQLite database
COLMAP_LINE = re.compile(r"\A(?:[ \t]*(?:#[^\r\n]*)?[\r\n])*[ \t]*[^\s{<]+[ \t]+[A-Z][A-Z0-9_]+(?:[ \t]+\S+){3}")
"""First line of COLMAP's ``cameras.txt`` : a number, a model, and at least three numbers."""
_chosen: ContextVar[str] = ContextVar("_chosen", default="")
"""Name of the camera that is read of a file of several, where the reader is given none."""


camera_chosen = partial(held, _chosen)
"""Read the camera of a name from files of several; for a command's option, which applies to all it reads."""


def read_camera(path: str | Path, name: str = "") -> CameraModel:
    """Read a camera file of any kind (``data_layout.md``), recognised by its content; ``name`` : chooses of several."""
    lens = read_lens(path, name)
    if isinstance(lens, CameraModel):
        return lens
    raise unsupported(lens, path)


def unsupported(lens: ForeignLens, path: str | Path) -> InputError:
    """Return the error of a lens whose model is not supported."""
    none = f"camera file {path}: {lens.called} is none of {', '.join(COLMAP_MODELS)}"
    return InputError("E-CAMERA-MODEL", f"{none}; fit one of them to it with `stcal camera convert`")


def camera_model(camera: str | Path | Camera | CameraModel) -> CameraModel:
    """Return a camera as a file states it; it may be given as a file, or as either class."""
    if isinstance(camera, str | Path):
        return read_camera(camera)
    return model_of(camera) if isinstance(camera, Camera) else camera


@require_arguments
def load_camera(path: str | Path, name: str = "", size: tuple[int, int] | None = None) -> Camera:
    """Load a camera from a file of any supported kind, which is recognised by the content, with any covariance.

    Parameters
    ----------
    path : File of COLMAP, OpenCV, ROS, Kalibr, EuRoC, MATLAB, Bouguet, Metashape, mrcal or camodocal
        (``data_layout.md``).
    name : Name of the camera in a file of several, such as ``cam1``.
    size : (int, int). Width and height of the images, px, for a file that does not state them.

    Raises InputError: no such file, a malformed one, one of several cameras or an unsupported lens, or no size.
    """
    return sized_camera(read_camera(path, name), path, size)


def sized_camera(model: CameraModel | ForeignLens, path: str | Path, size: tuple[int, int] | None) -> Camera:
    """Return the camera of a file; ``size`` is taken where the file states none."""
    width, height = size or (0, 0)
    if not (model.width or width) or not (model.height or height):
        raise InputError("E-CAMERA-SIZE", f"camera file {path}: states no image size; give it (--size), px")
    if isinstance(model, ForeignLens):
        raise unsupported(model, path)
    return model.calibrated(width, height)


def _from_colmap(text: str, name: str) -> CameraModel | ForeignLens:
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    cameras = {row[0]: row[1:] for row in rows}
    if len(cameras) < len(rows):
        raise InputError("E-CAMERA-REPEATED", "two cameras of one number; correct it")
    model, *values = chosen_of_colmap(cameras, name)
    try:
        width, height, *params = (float(value) for value in values)
    except ValueError as error:
        raise InputError("E-CAMERA-CONTENT", f"{' '.join(str(error).split())[:150]}; numbers needed") from error
    lens = of_colmap(model, width, height, params)
    if isinstance(lens, ForeignLens):
        return lens
    return replace(lens, covariance=stated_covariance(text, parameter_names(lens.colmap_model)))


def read_lens(path: str | Path, name: str = "") -> CameraModel | ForeignLens:
    """Read the lens of a camera file, also of an unsupported model; arguments and errors as :func:`read_camera`."""
    path = Path(path)
    with reading(f"camera file {path}"):
        lens = _read(path, name or _chosen.get())
    return replace(lens, source=str(path)) if isinstance(lens, CameraModel) else lens


def _read(path: Path, name: str) -> CameraModel | ForeignLens:
    try:
        if path.is_file():
            with open(path, "rb") as stream:
                is_database = stream.read(len(SQLITE)) == SQLITE
            if is_database:
                return of_database(path, name)
        content = read_bytes(path, SETTINGS_BYTES)
        for recognised, read in BINARY_FORMATS:
            if recognised(content):
                return read(content, name)
        text = text_of(content)
        return next(read for recognised, read in TEXT_FORMATS if recognised(text))(text, name)
    except OSError as error:
        raise InputError("E-CAMERA-UNREADABLE", f"{error.strerror or error}; give a readable file") from error
    except UnicodeDecodeError as error:
        reason = f"neither text nor a binary file of COLMAP or MATLAB; give a camera file of {READ}"
        if is_photograph(path):
            convert = f"`stcal camera convert {path.name} cameras.txt`"
            reason = f"a photograph; {convert} makes a start for --refine-camera from its EXIF"
        raise InputError("E-CAMERA-UNREADABLE", reason) from error
    except (KeyError, ElementTree.ParseError, yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError("E-CAMERA-UNREADABLE", f"no camera of {READ} ({reason}); check it, or convert it") from error


BINARY_FORMATS = (
    (lambda content: content.startswith(matlab.HEADS), matlab.from_mat),
    (is_colmap_binary, from_colmap_binary),
)
"""For each binary format a test of the content and a reader, which is given the content and a name."""
TEXT_FORMATS: tuple[tuple[Callable[[str], bool], Callable[[str, str], CameraModel | ForeignLens]], ...] = (
    (lambda text: COLMAP_LINE.search(text) is not None, _from_colmap),
    (metashape.is_metashape, metashape.from_metashape),
    (lambda text: "lensmodel" in text and "imagersize" in text, from_mrcal),  # PhotonVision has the former, too
    (matlab.is_script, matlab.from_script),
    (is_ini, from_ini),
    (lambda text: True, lambda text, name: from_keys(values_of(text), name)),
)
"""For each text format the same; what no other test recognises has keys and values."""
WRITTEN_PX = 1e-6
"""Largest difference of a projected point, px. Forms with few decimals, such as OpenCV's, round by 1e-8 px."""
ACROSS = 9  # number of points across the image, and down it, by which cameras are compared


@require_arguments
def save_camera(path: str | Path, camera: Camera, form: CameraForm | None = None, name: str = "") -> tuple[str, ...]:
    """Save a camera in a form of this or another program, and return what it has no place for, such as σ.

    Parameters
    ----------
    path : File to write; it is required to be read as the same camera.
    camera : Camera to save, with its covariance if it has one.
    form : ``colmap``, ``opencv``, ``ros``, ``kalibr``, ``mrcal``, ``metashape`` …; if None, that of the suffix:
        ``.txt`` colmap, ``.yaml`` opencv, ``.cameramodel`` mrcal, ``.xml`` metashape, ``.mat`` matlab.
    name : Name of the camera, for forms that have a place for it.

    Raises InputError: no form of this suffix, a form that cannot hold the lens, or a file that cannot be written.
    """
    kind = form_of(path, form)
    save(Path(path), WRITERS[kind](camera, name_to_write(name)))
    require_camera_written(path, camera)
    if camera.covariance is None or kind == "colmap":
        return ()
    if kind == "metashape-cameras":
        return tuple(metashape.without_sigma(camera))
    return ("σ and correlations of the parameters",)


def form_of(path: str | Path, form: str | None) -> CameraForm:
    """Return the form of a camera file to write: ``form``, or that of the suffix if it is None."""
    suffix = Path(path).suffix.lower()
    kind = SUFFIXES.get(suffix) if form is None else form
    if kind not in WRITERS:
        unknown = f"form {form} unknown" if form else f"no form of suffix {suffix or 'none'}"
        known = f"the form (--form), one of {', '.join(WRITERS)}, or one of the suffixes {', '.join(SUFFIXES)}"
        raise InputError("E-OPTION-FORM", f"{path}: {unknown}; give {known}")
    return cast(CameraForm, kind)


def require_camera_written(path: str | Path, camera: Camera) -> None:
    """Read a written camera file again, and require that it projects points all over the image to the same pixels."""
    size = np.array([camera.width, camera.height])
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, ACROSS)]), axis=-1) * size
    rays = camera.normalised_from_pixel(grid)
    rays = rays[np.isfinite(rays).all(axis=-1)]

    def again() -> np.ndarray:
        return read_camera(path).sized(*size).pixel_from_normalised(rays)

    require_written(path, again, camera.pixel_from_normalised(rays), WRITTEN_PX, "px")
