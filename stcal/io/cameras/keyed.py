"""Camera files of keys and values, of many programs, by one table of their keys.

A file is read by the names of its keys. ``ROLES`` of :mod:`stcal.io.cameras.keys` has the names in use, and
:data:`TABLES` those that have another meaning in one program. What is left goes through
:func:`stcal.io.cameras.keys.require_known`.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stcal.errors import InputError, InputNote
from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, MAX_SIDE_PX
from stcal.io.cameras.foreign import SQUARE, ForeignLens, of_kalibr, of_opencv, of_parts, one_of
from stcal.io.cameras.keys import CONTAINERS, ROLES, is_neutral, leaves, numbers_of, plain, require_known, role_of
from stcal.io.cameras.model import EQUIDISTANT, CameraModel, camera_from_opencv, camera_model
from stcal.io.cameras.several import NEAR, cameras_of, is_fundamental, shallow

RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PERSPECTIVE = {
    *("plumbbob", "rationalpolynomial", "radtan", "radialtangential", "brown", "brownconrady", "opencv", "fullopencv"),
    *("distortionbrownconrady", "thinprism", "tilted", "opencvstandard", "pinholeradtan", "standard"),
    *("pinholefull", "rectilinear", "radtan4", "radtan5", "radtan8", "pinholeradtan8"),
}
"""Values of a model that mean OpenCV's perspective lens."""
UNDISTORTED = {
    *("none", "", "null", "false", "camera", "pinhole", "rectified", "simplepinhole", "perspective", "opengl"),
    *("distortionnone", "nodistortion", "perspectiveprojwithdistortion", "perspectiveprojwithoutdistortion"),
}
"""Values of a model that mean no distortion."""
COLOURS = frozenset(("rgb", "bgr", "gray", "grey", "mono", "monochrome", "color", "colour", "depth", "infrared"))
"""Types of cameras that do not specify a lens model."""
FISHEYE = frozenset([*map(plain, EQUIDISTANT), "kannalabrandt8", "kannalabrandt4", "kb4", "opencvfisheye"])
FISHEYE_ALSO = frozenset(["distortionkannalabrandt4", "fisheyeopencv", "pinholeequi", "equi", "equid4", "equidistant4"])
UNIFIED = frozenset(["omni", "omnidir", "omnidirectional", "mei", "unified"])
INVERSE = frozenset(["inversebrownconrady", "distortioninversebrownconrady", "modifiedbrownconrady"])
"""Models that are read only if their coefficients are zero: their polynomials are not OpenCV's."""
BY_COLUMNS = "intrinsicmatrix"
"""Key of Open3D and MATLAB, whose matrices are stored column by column."""
OTHER_WAY = "its coefficients are those of another formula, and under another name they make a wrong camera"
MOST_ALIKE = 2
"""Largest number of equal cameras that are a rig; more are one camera, stated for each image, as BOP does."""
MOST_TANGENTIAL = 0.02
"""Largest tangential coefficient of real lenses: 0.02 is a sensor tilted by 2° behind the lens."""
IGNORED = "label"
"""Role of keys that name a camera or a lens in words."""


@dataclass(frozen=True, slots=True)
class Table:
    """The keys of one program, where they mean something else than in :data:`ROLES`.

    ``needs`` : keys that tell the program; ``roles`` : its keys; ``model`` : its lens, where no key says it;
    ``origin`` : coordinate of the first pixel's centre; ``relative`` : True if lengths are in units of the longer side,
    from the middle of the image; ``harmless`` : further keys, as in :func:`stcal.io.cameras.keys.require_known`.
    """

    called: str
    needs: frozenset[str]
    roles: Mapping[str, str] = field(default_factory=dict)
    model: str = ""
    origin: float = 0.0
    relative: bool = False
    harmless: tuple[str, ...] = ()


TABLES = (
    Table(
        "camodocal's KANNALA_BRANDT",
        frozenset(["mu", "mv"]),
        {"mu": "fx", "mv": "fy", "k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4"},
        model="equidistant",
    ),
    Table(
        "Nerfstudio",
        frozenset(["flx"]),
        origin=COLMAP_PIXEL_ORIGIN,
        harmless=("cameraanglex", "cameraangley", "plyfilepath", "orientationoverride", "aabbscale", "scale", "offset"),
    ),
    Table(
        "stella_vslam",
        frozenset(["cols", "rows", "fx"]),
        {"cols": "width", "rows": "height"},
        harmless=("setup", "colororder", "focalxbaseline", "depththreshold", "keyframe*", "mapping*", "feature*"),
    ),
    Table(
        "Meshroom",
        frozenset(["intrinsicid"]),
        harmless=(
            *("initial*", "px*", "sensor*", "locked", "pixelratio*", "distortioninit*", "distortionlocked"),
            *("scalelocked", "offsetlocked", "intrinsicid"),
        ),
    ),
    Table("DepthAI", frozenset(["spechfovdeg"]), {"cameratype": "fisheye"}, harmless=("spechfovdeg", "lensposition")),
    Table(
        "MC-Calib",
        frozenset(["distortiontype", "cameragroup"]),
        {"distortiontype": "fisheye"},
        harmless=("cameragroup", "cameraposematrix"),
    ),
    Table(
        "Gyroflow",
        frozenset(["calibratorversion"]),
        {"cameramodel": IGNORED, "lensmodel": IGNORED, "w": "width", "h": "height"},
        model="equidistant",
        harmless=("origdimension*", "outputdimension*", "rmserror", "cameramodel", "lensmodel"),
    ),
    Table(
        "rpg_vikit",
        frozenset(["camfx"]),
        {"camd0": "k1", "camd1": "k2", "camd2": "p1", "camd3": "p2", "camd4": "k3", "camheight": "height"},
    ),
    Table("PhotonVision", frozenset(["cameraintrinsics", "cameraextrinsics"]), {"cameraextrinsics": "distortion"}),
    Table(
        "PhotonVision",
        frozenset(["calobjectspacing"]),
        {"lensmodel": IGNORED},
        harmless=("calobject*", "observations"),
    ),
    Table("ViSP", frozenset(["px", "py", "u0"]), {"px": "fx", "py": "fy", "kud": "k1"}, harmless=("kdu",)),
    Table("OpenSfM", frozenset(["projectiontype"]), {"focal": "f"}, relative=True, harmless=("focalprior*",)),
    Table("a file", frozenset()),
)
SLAM_SETTINGS = ("camerabf", "cameranew*", "camerargb", "thdepth", "depthmapfactor", "cameraimagescale", "rgbd*")
"""Settings of ORB-SLAM: its images are resized after reading, and its intrinsics are those of the original images."""
NEUTRAL = {
    **dict.fromkeys(("binningx", "binningy", "binning"), (0, 1)),
    **dict.fromkeys(("inputhorizontalstretch", "inputverticalstretch"), (1,)),
}
"""Keys of ROS that are harmless with these values alone: the image is not the one that the intrinsics are for."""


def from_keys(values: dict, choice: str, source: str) -> CameraModel | ForeignLens:
    """Return a camera of keys and values; ``choice`` : its name or number if there are several.

    Raises InputError: there is no camera, several and no choice, an unsupported lens, a key that may change the
    projection, or a value is impossible.
    """
    cameras = cameras_of(values)
    if not cameras:
        raise InputError(
            "E-CAMERA-CONTENT",
            f"camera file {source}: no camera_matrix, K, intrinsics or fx; write it with cv2.FileStorage or as ROS "
            "camera_info",
        )
    names = list(cameras)
    if not choice and len(names) > MOST_ALIKE and all(each == cameras[names[0]] for each in cameras.values()):
        names, cameras = [""], {"": cameras[names[0]]}
    chosen = cameras[names[0] if names == [""] else one_of(names, choice, source)]
    return _Reading.of(chosen, source).lens()


def _role_of(path: tuple[str, ...], table: Table) -> str | None:
    """Return the role of a key. Containers around the key do not count, nor does ORB-SLAM's prefix ``Camera.``."""
    parts = [part for key in path for part in key.split(".")]
    while len(parts) > 1 and CONTAINERS.match(plain(parts[0])):
        parts = parts[1:]
    if len(path) > 1 and (joined := plain("".join(path[-2:]))) in ROLES:  # distortion: {type: …, parameters: …}
        return table.roles.get(joined) or ROLES[joined]
    if len(parts) > 1:
        return None
    return table.roles.get(plain(parts[0])) or role_of(parts[0])


@dataclass(frozen=True, slots=True, eq=False)
class _Reading:
    """``known`` : values by role, each with the ``keys`` it was read from; ``table`` : their program."""

    known: Mapping[str, object]
    keys: Mapping[str, str]
    table: Table
    source: str
    industrial: bool

    @classmethod
    def of(cls, values: dict, source: str) -> "_Reading":
        names = {plain(path[-1].split(".")[-1]) for path, _ in shallow(values)}
        table = next(each for each in TABLES if each.needs <= names)
        known, keys, unread = {}, {}, {}
        for path, value in leaves(values):
            role, key = _role_of(path, table), ".".join(path)
            if role == "lens" and numbers_of(value).size == 9:
                role = "matrix"
            if role == "distortion" and isinstance(value, str) and value.strip() and not numbers_of(value).size:
                role = "model"
            if is_fundamental(plain(path[-1]), value) or (role == "camera model" and plain(value) in COLOURS):
                continue
            if role is None:
                unread[key] = value
            elif role in known and known[role] != value and role != IGNORED:
                raise InputError(
                    "E-CAMERA-REPEATED",
                    f"camera file {source}: {keys[role]} and {key} mean the same and differ; leave one in",
                )
            else:
                known[role], keys[role] = value, key
        for key in list(unread):
            allowed, of_roi = NEUTRAL.get(plain(key.split(".")[-1])), plain(key).startswith("roi")
            unscaled = plain(key.split(".")[-1]) == "scale" and unread[key] == 1
            if unscaled or (allowed and unread[key] in allowed) or (of_roi and _full_image(key, unread, known)):
                del unread[key]
            elif allowed or of_roi:
                raise InputError(
                    "E-CAMERA-KEY",
                    f"camera file {source}: {key} = {unread[key]}, so that K is for a larger image of which yours is "
                    "a part; set it to 0 if your images have the file's full size, else calibrate at their size",
                )
        if "f" in known and "fy" not in known:  # else f, or K, has both
            for key in [each for each in unread if plain(each.split(".")[-1]) in ("aspectratio", "pixelaspectratio")]:
                if not (is_neutral(unread[key]) or unread.pop(key) == 1):
                    raise InputError(
                        "E-CAMERA-KEY",
                        f"camera file {source}: {key} gives fy, but one program multiplies by it and another divides; "
                        "write fx and fy",
                    )
        undistorted = known.keys().isdisjoint(("distortion", *RADIAL_TANGENTIAL))
        require_known(unread, source, (*table.harmless, *SLAM_SETTINGS), undistorted)
        industrial = {"fx", "cx"} & known.keys() != set() and keys.get("fx", keys.get("cx", "")).startswith(
            "intrinsics"
        )
        return cls(known, keys, table, source, industrial)

    def fault(self, code: str, text: str) -> InputError:
        return InputError(code, f"camera file {self.source}: {text}")

    def number(self, role: str) -> float:
        """Return one number; 0 if the file has none."""
        value = self.known.get(role)
        if isinstance(value, bool):
            raise self.fault("E-CAMERA-CONTENT", f"{self.keys[role]} is {value}; a number needed")
        if value is None:
            return 0.0
        numbers = np.asarray(value, float).ravel()
        if numbers.size != 1:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys[role]} of {numbers.size} numbers; 1 needed")
        return float(numbers[0])

    def pair(self, role: str) -> tuple[float, float]:
        """Return two numbers; one stands for both."""
        numbers = numbers_of(self.known[role])
        if numbers.size not in (1, 2):
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys[role]} of {numbers.size} numbers; 2 needed")
        return float(numbers[0]), float(numbers[-1])

    def size(self) -> tuple[float, float]:
        """Return width and height, px; 0 if the file states none."""
        stated = [self.known.get(side) for side in ("width", "height")]
        if any(isinstance(side, bool) for side in stated):
            raise self.fault("E-CAMERA-SIZE", f"image_width and image_height are {stated}; numbers of pixels needed")
        width, height = (float(side or 0) for side in stated)  # type: ignore[arg-type]
        if (both := self.known.get("size")) is None or is_neutral(both):
            return width, height
        numbers = np.asarray(both.replace("x", " ").split() if isinstance(both, str) else both, float).ravel()
        if numbers.size != 2:
            raise self.fault("E-CAMERA-SIZE", f"{self.keys['size']} of {numbers.size} numbers; width and height needed")
        if width and height and (width, height) != tuple(numbers):
            raise self.fault(
                "E-CAMERA-SIZE",
                f"{self.keys['size']} {numbers[0]:g}×{numbers[1]:g} px, but {self.keys['width']} and "
                f"{self.keys['height']} {width:g}×{height:g} px; correct one of them",
            )
        return float(numbers[0]), float(numbers[1])

    def require_order(self, flat: list[float]) -> None:
        """Refuse a list of height and width, by the principal point, which is near the middle."""
        if "size" not in self.known:
            return
        size = np.array(self.size())
        near = [(np.abs(np.array(flat[2:]) - each / 2) < NEAR * each).all() for each in (size, size[::-1])]
        if not near[0] and near[1]:
            raise self.fault(
                "E-CAMERA-SIZE",
                f"{self.keys['size']} {size[0]:g}×{size[1]:g} px, but the principal point ({flat[2]:g}, {flat[3]:g}) "
                "px is near the middle of the sides exchanged; width first needed",
            )

    def intrinsics(self) -> tuple[list[float], float]:
        """Return fx, fy, cx, cy and the skew, px."""
        if "matrix" in self.known:
            return self._of_matrix()
        if "f" in self.known and "fx" not in self.known:
            fx, fy = self.pair("f")
        else:
            fx = self.number("fx")
            fy = self.number("fy") if "fy" in self.known or self.table.called != "Nerfstudio" else fx
        if "centre" in self.known:
            return [fx, fy, *self.pair("centre")], self.number("skew")
        wanted = ["cx", "cy"] if "f" in self.known and "fx" not in self.known else ["fx", "fy", "cx", "cy"]
        missing = [] if self.table.relative else [role for role in wanted if role not in self.known]
        if self.table.called == "Nerfstudio":
            missing = [role for role in missing if role != "fy"]
        if missing:
            raise self.fault("E-CAMERA-CONTENT", f"intrinsics without {', '.join(missing)}; fx, fy, cx, cy needed")
        cx, cy = self.number("cx") - self.table.origin, self.number("cy") - self.table.origin
        if self.table.relative:
            sides = self.size()
            if not all(0 < side <= MAX_SIDE_PX for side in sides):
                raise self.fault("E-CAMERA-SIZE", f"size {sides[0]:g}×{sides[1]:g} px; width and height needed")
            unit, (x, y) = max(sides), ((side - 1) / 2 for side in sides)
            return [unit * fx, unit * fy, unit * cx + x, unit * cy + y], 0.0
        return [fx, fy, cx, cy], self.number("skew")

    def _of_matrix(self) -> tuple[list[float], float]:
        value = self.known["matrix"]
        matrix = np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float)
        if matrix.size != 9:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys['matrix']} of {matrix.size} numbers; 3×3 needed")
        matrix = matrix.reshape(3, 3)
        if not matrix.any():
            raise self.fault(
                "E-CAMERA-UNCALIBRATED",
                f"{self.keys['matrix']} is all zero, as published by a driver for an uncalibrated camera; "
                "calibrate it with `stcal-sfm calibrate-camera`, or load its calibration into the driver",
            )
        if (matrix[[1, 2, 2, 2], [0, 0, 1, 2]] != [0, 0, 0, 1]).any():
            turned = (matrix.T[[1, 2, 2, 2], [0, 0, 1, 2]] == [0, 0, 0, 1]).all()
            if turned and plain(self.keys["matrix"]) == BY_COLUMNS:
                return [matrix[0, 0], matrix[1, 1], matrix[2, 0], matrix[2, 1]], float(matrix[1, 0])
            raise self.fault(
                "E-CAMERA-MATRIX",
                "camera_matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; "
                + ("it is transposed: write it row by row" if turned else "write it row by row, with 0 0 1 last"),
            )
        if not np.isfinite(matrix).all() and np.isfinite(matrix[[0, 1], [0, 1]]).all() and np.isnan(matrix[0, 1]):
            raise self.fault("E-CAMERA-SKEW", f"skew {matrix[0, 1]:g}; a finite number needed")
        stated = {"fx": (0, 0), "f": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2), "skew": (0, 1)}
        for role, place in stated.items():
            if role in self.known and self.number(role) != matrix[place]:
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['matrix']} has {matrix[place]:g} for {role}, but {self.keys[role]} is "
                    f"{self.number(role):g}; leave one in",
                )
        return [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], float(matrix[0, 1])

    def model(self) -> str:
        """Return the kind of lens: perspective, equidistant, unified, or Kalibr's own.

        Raises
        ------
        InputError
            It is another one, or two keys contradict each other.
        """
        said = {role: self.known[role] for role in ("camera model", "model") if role in self.known}
        kinds = {}
        for role, value in said.items():
            word = plain("" if value is None else value)
            if word in UNDISTORTED or (role == "camera model" and word in PERSPECTIVE and "model" in said):
                continue
            kind = next(
                (
                    kind
                    for kind, words in (
                        ("perspective", PERSPECTIVE | {"simpleradial", "radial"}),
                        ("equidistant", FISHEYE | FISHEYE_ALSO),
                        ("unified", UNIFIED),
                        ("fov", {"fov"}),
                        ("eucm", {"eucm"}),
                        ("ds", {"ds"}),
                    )
                    if word in words
                ),
                None,
            )
            if kind is None and word in INVERSE and not self.coefficients("perspective").any():
                kind = "perspective"
            if kind is None:
                why = OTHER_WAY if word in INVERSE else "calibrate with plumb_bob or equidistant, or convert it there"
                raise self.fault(
                    "E-CAMERA-MODEL",
                    f"{self.keys[role]} {' '.join(str(value).split())[:60]!r} is not supported; {why}"
                    + ("; calibrate anew" if word in INVERSE else ""),
                )
            kinds[self.keys[role]] = kind
        if "fisheye" in self.known:
            yes = not is_neutral(self.known["fisheye"])
            kinds[self.keys["fisheye"]] = "equidistant" if yes else "perspective"
        if "xi" in self.known and self.number("xi") and "unified" not in kinds.values():
            kinds[self.keys["xi"]] = "unified"
        if self.table.model and not kinds:
            kinds[self.table.called] = self.table.model
        both = set(kinds.values())
        if {"unified", "perspective"} == both or {"eucm", "perspective"} == both or {"ds", "perspective"} == both:
            both -= {"perspective"}  # distortion after the projection
        if len(both) > 1:
            words = ", ".join(f"{key} says {kind}" for key, kind in kinds.items())
            raise self.fault("E-CAMERA-MODEL", f"{words}; correct one of them")
        return both.pop() if both else "perspective"

    def coefficients(self, kind: str) -> np.ndarray:
        """Return the distortion coefficients in OpenCV's order; zeros beyond those of the model are left out."""
        single = [role for role in RADIAL_TANGENTIAL if role in self.known]
        if "distortion" in self.known:
            value = self.known["distortion"]
            given = np.asarray(value.replace(",", " ").split() if isinstance(value, str) else value, float).ravel()
            extra = [role for role in single if not is_neutral(self.known[role])]
            if extra:
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['distortion']} and {self.keys[extra[0]]} both state distortion; leave one in",
                )
            if (
                kind == "perspective"
                and given.size == 4
                and {"model", "camera model", "fisheye"}.isdisjoint(self.known)
            ):
                self._say_no_model(given)
            last = 4 if kind == "equidistant" else 5
            given = given[:last] if last < len(given) < 8 and not given[last:].any() else given
            if kind == "equidistant" and len(given) not in (0, 4):
                why = next((self.keys[r] for r in ("fisheye", "model", "camera model") if r in self.known), "a key")
                raise self.fault(
                    "E-CAMERA-COEFFICIENTS",
                    f"{len(given)} coefficients in {self.keys['distortion']}, but by {why} the lens is equidistant; k1 "
                    "to k4 needed",
                )
            return given
        if not single:
            return np.zeros(0)
        if kind == "equidistant":
            tangential = [role for role in ("p1", "p2", "k5", "k6") if self.number(role)]
            if tangential:
                raise self.fault(
                    "E-CAMERA-COEFFICIENTS",
                    f"{self.keys[tangential[0]]} of a fisheye lens (equidistant); k1 to k4 are possible",
                )
            return np.array([self.number(role) for role in ("k1", "k2", "k3", "k4")])
        if self.number("k4") and not {"k5", "k6"} <= self.known.keys():
            raise self.fault(
                "E-CAMERA-COEFFICIENTS",
                f"k4 = {self.number('k4'):g} of a perspective lens without k5 and k6: in OpenCV it is in the "
                "denominator, in other programs a term in r⁸; calibrate without it",
            )
        given = np.array([self.number(role) for role in RADIAL_TANGENTIAL])
        return given if given[5:].any() else given[:5]

    def _say_no_model(self, given: np.ndarray) -> None:
        """Name four coefficients without a model, as OpenCV's fisheye has; refuse those that must be a fisheye's."""
        key, model = self.keys["distortion"], "distortion_model: equidistant"
        if np.abs(given[2:]).max() > MOST_TANGENTIAL:
            raise self.fault(
                "E-CAMERA-MODEL",
                f"{key} has 4 coefficients without a lens model: for a perspective lens, the tangential ones "
                f"{given[2]:g} and "
                f"{given[3]:g} are larger than {MOST_TANGENTIAL:g}; add {model} if the lens is OpenCV's fisheye, else "
                "distortion_model: plumb_bob",
            )
        if given.any():
            said = f"{key}: 4 coefficients without a model, taken as k1, k2, p1, p2; of OpenCV's fisheye, add {model}"
            warnings.warn(f"camera file {self.source}: {said}", InputNote, stacklevel=2)

    def lens(self) -> CameraModel | ForeignLens:
        """Return the camera."""
        if "lens" in self.known:
            return self._of_kalibr()
        kind = self.model()
        flat, skew = self.intrinsics()
        given, (width, height) = self.coefficients(kind), self.size()
        self.require_order(flat)
        if kind not in ("perspective", "equidistant", "unified"):
            raise self.fault("E-CAMERA-MODEL", f"{kind!r} needs the intrinsics as one list, as Kalibr writes them")
        if kind == "perspective" and self.industrial and "distortion" not in self.known and not given.size:
            # The lens may have distortion, though the form has none.
            numbers = np.concatenate([flat, np.zeros(8)])
            return camera_model(numbers, "OPENCV", width or None, height or None, Path(self.source))
        if kind == "unified":
            return self._unified(flat, skew, given, width, height)
        if not abs(skew) <= SQUARE * abs(flat[0]):
            return of_parts(flat, skew, given, kind, width, height, self.source)
        if kind == "equidistant":
            return camera_from_opencv(flat, given, True, width, height, self.source)
        return of_opencv(flat, given, width, height, self.source)

    def _unified(self, flat, skew: float, given: np.ndarray, width: float, height: float) -> ForeignLens:
        if "xi" not in self.known:
            raise self.fault("E-CAMERA-CONTENT", "a unified lens without xi; add it")
        values = {"xi": self.number("xi")}
        return of_parts(flat, skew, given, "unified", width, height, self.source, values["xi"])

    def _of_kalibr(self) -> CameraModel | ForeignLens:
        numbers = numbers_of(self.known["lens"])
        for role in ("matrix", "f", "fx", "fy", "cx", "cy", "skew", "xi", "fisheye"):
            if role in self.known and not is_neutral(self.known[role]):
                raise self.fault(
                    "E-CAMERA-REPEATED",
                    f"{self.keys['lens']} is a list of all intrinsics, and {self.keys[role]} stands beside it; leave "
                    "one in",
                )
        lens = plain(self.known.get("camera model", "pinhole") or "pinhole")
        word = plain(self.known.get("model", "none") or "none")
        radtan = word in PERSPECTIVE
        distortion = "radtan" if radtan else "equidistant" if word in FISHEYE | FISHEYE_ALSO else word
        if lens not in ("pinhole", "omni", "eucm", "ds") or distortion not in ("radtan", "equidistant", "fov", "none"):
            raise self.fault(
                "E-CAMERA-MODEL",
                f"{lens} with {distortion}; pinhole, omni, eucm, ds with radtan, equidistant, fov or none are read",
            )
        width, height = self.size()
        given = self.coefficients("equidistant" if distortion == "equidistant" else "perspective")
        if lens != "pinhole" or distortion == "fov":
            values = {"intrinsics": numbers, "distortion_coeffs": given, "resolution": (width, height)}
            return of_kalibr(lens, distortion, values, self.source)
        if numbers.size != 4:
            raise self.fault("E-CAMERA-COEFFICIENTS", f"{self.keys['lens']} of {numbers.size} numbers; 4 needed")
        if distortion == "none" and given.any():
            raise self.fault(
                "E-CAMERA-MODEL", f"{self.keys['distortion']} without a distortion model; add distortion_model"
            )
        self.require_order(numbers.tolist())
        coefficients = given if distortion != "none" else np.zeros(0)
        return camera_from_opencv(
            numbers.tolist(), coefficients, distortion == "equidistant", width, height, self.source
        )


def _full_image(key: str, unread: dict, known: dict) -> bool:
    """Return True if a key of ROS's region of interest says that it is the whole image."""
    last = plain(key.split(".")[-1])
    if last in ("width", "height"):
        return is_neutral(unread[key]) or unread[key] == known.get(last)
    return last in ("dorectify", "xoffset", "yoffset") and is_neutral(unread[key])
