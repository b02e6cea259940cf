"""What a report of a fault needs to know of the machine: versions of the program and of what it is built on."""

import platform
import shutil
from importlib import import_module

import stcal
from stcal.errors import InputError
from stcal.sfm.interop.native import find_colmap

LIBRARIES = {"pycolmap": "pycolmap", "OpenCV": "cv2", "NumPy": "numpy", "SciPy": "scipy"}
"""Module by name."""


def environment() -> dict[str, str]:
    """Versions by name, as loaded; of what is not there, or does not load, it is said.

    Returns
    -------
    versions : stcal, Python, system, the libraries, and the native COLMAP on the PATH
    """
    found = {"stcal": stcal.__version__, "Python": platform.python_version(), "system": platform.platform()}
    return found | {name: _library(module) for name, module in LIBRARIES.items()} | {"native colmap": _native()}


def _library(module: str) -> str:
    try:
        return str(import_module(module).__version__)
    except Exception as error:  # of a broken installation, which is what is looked for
        return f"does not load: {error}"


def _native() -> str:
    if shutil.which("colmap") is None:
        return "not found"
    try:
        return find_colmap().version
    except InputError as error:
        return str(error)
