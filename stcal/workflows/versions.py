"""Versions of the program, of this machine and of the libraries, for the report of a fault."""

import platform
import shutil
from importlib import import_module

import stcal
from stcal.errors import InputError
from stcal.sfm.interop.native import find_colmap

LIBRARIES = {"pycolmap": "pycolmap", "OpenCV": "cv2", "NumPy": "numpy", "SciPy": "scipy"}
"""Module of each library, by name."""


def environment() -> dict[str, str]:
    """Returns the versions by name, as loaded. A library that is missing or does not load is reported as such.

    Returns
    -------
    versions : stcal, Python, system, the libraries, and the native COLMAP on the PATH
    """
    version_of = {"stcal": stcal.__version__, "Python": platform.python_version(), "system": platform.platform()}
    return version_of | {name: _library(module) for name, module in LIBRARIES.items()} | {"native colmap": _native()}


def _library(module: str) -> str:
    try:
        return str(import_module(module).__version__)
    except Exception as error:  # raised by a broken installation, which this report is to reveal
        return f"does not load: {error}"


def _native() -> str:
    if shutil.which("colmap") is None:
        return "not found"
    try:
        return find_colmap().version
    except InputError as error:
        return str(error)
