"""Approximate camera from a photograph's EXIF, as the start of a refinement."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import camera_from_opencv
from stcal.io.decoding import heic_turns, is_heic, let_pillow_read_heic
from stcal.io.files import IMAGE_BYTES, read_bytes

HEADS = (b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"\x89PNG")
"""First bytes of JPEG, TIFF and PNG."""
FILM_DIAGONAL_MM = 43.2666
"""Diagonal of 36 × 24 mm. CIPA DCG-001 states focal lengths "in 35 mm film" by the diagonal, some makers by the width;
the two differ by 4 % in an image of 4 : 3."""
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Lengths, in mm, of the values of ``FocalPlaneResolutionUnit``."""
SIGMA_FOCAL, SIGMA_SQUARE = 0.05, 1e-3
"""Relative σ of the focal length, which EXIF states nominally and at infinity, and of the ratio of fx to fy."""
SIGMA_CENTRE = 0.02
"""σ of the principal point, in image widths."""
SIGMA_RADIAL, SIGMA_TANGENTIAL = 0.2, 5e-3
"""σ of radial and tangential distortion, which EXIF does not state."""


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """The camera of a photograph, OPENCV without distortion and with a covariance for what EXIF leaves open, and
    ``told``, the EXIF entries that were used, in words."""

    camera: Camera
    told: str


def is_photograph(path: str | Path) -> bool:
    """Return True if a file begins with the bytes of an image."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(12)
            return head.startswith(HEADS) or is_heic(head)
    except (OSError, ValueError):
        return False


def camera_of_photograph(path: str | Path) -> Photograph:
    """Return the camera that the EXIF of a JPEG, TIFF, PNG or HEIC describes."""
    try:
        data = read_bytes(path, IMAGE_BYTES)
        if is_heic(data):
            let_pillow_read_heic(f"camera file {path}")
        with Image.open(BytesIO(data)) as image:
            (width, height), exif = image.size, image.getexif().get_ifd(ExifTags.IFD.Exif)
        if is_heic(data) and heic_turns(data) % 2:
            width, height = height, width
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(
            "E-CAMERA-UNREADABLE", f"camera file {path}: no photograph that can be read ({reason}); give another"
        ) from error
    focal, source = _focal_px(exif, width, height)
    if focal is None:
        focal_mm = _positive(exif.get(ExifTags.Base.FocalLength))
        what = f"{focal_mm:g} mm, but no size of its pixels" if focal_mm else "no focal length"
        raise InputError(
            "E-CAMERA-EXIF",
            f"camera file {path}: a photograph whose EXIF states {what}; give a camera file, or "
            "`stcal-sfm calibrate-camera`",
        )
    zoom = _positive(exif.get(ExifTags.Base.DigitalZoomRatio)) or 1.0
    if zoom != 1:
        raise InputError(
            "E-CAMERA-EXIF",
            f"camera file {path}: a photograph with a digital zoom of {zoom:g}; makers differ in whether the focal "
            f"length includes it, so that it is {focal:.0f} or {zoom * focal:.0f} px; take one without zoom",
        )
    if exif.get(ExifTags.Base.ExifImageWidth, width) not in (width, height):
        source += f", of {exif[ExifTags.Base.ExifImageWidth]} px before it was made {width} px wide"
    centre = [(width - 1) / 2, (height - 1) / 2]
    camera = camera_from_opencv([focal, focal, *centre], np.zeros(0), False, width, height).sized(width, height)
    sigma = np.array([1, 1, *[SIGMA_CENTRE * width] * 2, *[SIGMA_RADIAL] * 2, *[SIGMA_TANGENTIAL] * 2])
    covariance = np.diag(sigma**2)
    covariance[:2, :2] = SIGMA_FOCAL**2 * focal**2 * np.ones((2, 2)) + SIGMA_SQUARE**2 * focal**2 / 2 * np.eye(2)
    return Photograph(Camera.of(camera, "OPENCV", covariance), source)


def _focal_px(exif: dict, width: int, height: int) -> tuple[float | None, str]:
    """Return the focal length in px of this image, None if unknown, and the EXIF entries used, in words."""
    full = _positive(exif.get(ExifTags.Base.ExifImageWidth)) or max(width, height)
    scale = max(width, height) / max(full, _positive(exif.get(ExifTags.Base.ExifImageHeight)) or 0)
    focal_mm = _positive(exif.get(ExifTags.Base.FocalLength))
    per_unit = _positive(exif.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = UNIT_MM.get(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal_mm and per_unit and unit_mm:
        pitch_um = 1e3 * unit_mm / per_unit / scale
        sensor = "×".join(f"{1e-3 * pitch_um * side:.3g}" for side in (width, height))
        told = f"focal length {focal_mm:g} mm, pixels of {pitch_um:.3g} µm, so a sensor of {sensor} mm (check it)"
        return focal_mm / pitch_um * 1e3, told
    film_mm = _positive(exif.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if film_mm:
        return film_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height)), f"{film_mm:g} mm in 35 mm film"
    return None, ""


def _positive(value) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < np.inf else None
