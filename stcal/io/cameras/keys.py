"""The rule for keys of camera files: each is taken, known to be harmless, or named; one that may change the projection
is taken or refused."""

import re
import warnings
from collections.abc import Collection, Iterator, Mapping

from stcal.errors import InputError, InputNote

_HARMLESS = """
alphacerror boardheight boardsize boardwidth calibdate calibrationdate calibrationtime calibtime cameraid cameraindex
cameraname cameraserial camoverlaps comment cornerdist createdate createdby data date description fileversion flags fps
frameid framescount framescounter generatedon header hostname id imagename imagetopic label make name nframes notes
nrofframes nrofimages p pattern patternsize projectionmatrix r ratehz rectificationmatrix rms rostopic sensortype serial
serialnumber source squaresize stamp t target tbs tcamimu tcncnm1 time timeshiftcamimu timestamp topic units version
"""
HARMLESS = frozenset(_HARMLESS.split())
"""Keys, in small letters and digits alone, that say nothing of how a ray becomes a pixel of the photograph. ``R`` and
``P`` of ROS and KITTI are for images that are rectified afterwards."""
HARMLESS_BEGINNINGS = (
    *("header", "rectificationmatrix", "projectionmatrix", "extrinsic", "perview", "imagepoints", "gridpoints"),
    *("objectpoints", "board", "imu", "tcam", "timu", "orbextractor", "viewer", "stereo", "system", "loopclosing"),
    *("fixaspect", "fixprincipal", "zerotangent", "zeroprincipal", "avg", "mean", "reproj", "rect", "rvec", "tvec"),
    *(
        "date",
        "calib",
        "totalavg",
        "num",
        "acc",
        "gyr",
        "frames",
        "tbc",
        "bodyt",
        "estimate",
        "prect",
        "rrect",
        "srect",
    ),
)
"""Beginnings of such keys: of poses, observations and settings of other programs."""
HARMLESS_ENDS = ("stddev", "std", "error", "errors", "sigma", "uncertainty", "covariance", "rms", "topic")
"""Ends of such keys: uncertainties."""
SUSPECT = re.compile(
    r"(xi|alpha|alphac|beta|gamma[12]?|skew|shear|tau[xy]?|[kpsbt]\d\d?|mu|mv|mx|my|f|fx|fy|cx|cy|u0|v0|ppx|ppy)"
)
"""Names of parameters of lenses, of which a reader takes those of its format."""
SUSPECT_PART = re.compile(
    r"model|distort|fisheye|omni|mirror|radial|tangent|prism|tilt|rational|coef|projecti|intrinsic|focal|principal"
    r"|crop|binning|roi|scal|flip|zoom|resiz|affin|poly|cameratype|lens(type|param)|cameramatrix|undist"
)
"""Parts of names of keys that may change the projection."""
SHOWN = 6
"""Largest number of keys that a message names."""


def plain(key: object) -> str:
    """Return a key in small letters and digits alone: programs differ in capitals, dots and underscores."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def is_neutral(value: object) -> bool:
    """Return True for a value that says nothing: 0, a list of zeros, false, an empty text, or none."""
    if isinstance(value, Mapping):
        return all(is_neutral(each) for each in value.values())
    if isinstance(value, list | tuple):
        return all(is_neutral(each) for each in value)
    if isinstance(value, str):
        words = value.lower().split()
        return all(word in ("none", "null", "false", "no") or _is_zero(word) for word in words)
    return value is None or not value


def _is_zero(word: str) -> bool:
    try:
        return float(word) == 0
    except ValueError:
        return False


def leaves(values: Mapping, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    """Yield the path and the value of every key that holds no further keys."""
    for key, value in values.items():
        inner = (*path, str(key))
        if isinstance(value, Mapping) and value:
            yield from leaves(value, inner)
        else:
            yield inner, value


def require_known(unread: Mapping, source: str, harmless: Collection[str] = ()) -> None:
    """Name the keys of a camera file that its reader did not take.

    Harmless ones pass in silence, others with an :class:`InputNote`.

    Parameters
    ----------
    unread : Mapping
        Keys and values; values may hold further keys.
    source : str
        Camera file, for messages.
    harmless : collection of str
        Further harmless keys of the format, or beginnings of them that end in ``*``; as :func:`plain` writes them.

    Raises
    ------
    InputError
        A key may change the projection, and its value is not 0 or empty.
    """
    beginnings = (*HARMLESS_BEGINNINGS, *(word[:-1] for word in harmless if word.endswith("*")))
    unknown = []
    for keys, value in leaves(unread):
        path = [part for key in keys for part in key.split(".")]
        names = [*map(plain, path), plain("".join(path))]
        if not (HARMLESS | set(harmless)).isdisjoint(names):
            continue
        of_a_lens = bool(SUSPECT.fullmatch(plain(path[-1])))
        if not of_a_lens and (plain(path[-1]).endswith(HARMLESS_ENDS) or any(n.startswith(beginnings) for n in names)):
            continue
        if not of_a_lens and not any(SUSPECT_PART.search(name) for name in names):
            unknown.append(".".join(path))
        elif not is_neutral(value):
            raise InputError(
                "E-CAMERA-KEY",
                f"camera file {source}: {'.'.join(path)[:80]} = {_short(value)} may change the projection and is not "
                "taken here; remove it if the lens is right without it, or calibrate without it",
            )
    if unknown:
        more = f" and {len(unknown) - SHOWN} more" if len(unknown) > SHOWN else ""
        named = ", ".join(key[:40] for key in unknown[:SHOWN])
        warnings.warn(f"camera file {source}: not known, and passed over: {named}{more}", InputNote, stacklevel=2)


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 40 else f"{text[:40]} …"
