"""Exceptions of stcal, and the codes of errors.

Every message is one line: what, where, measured, needed, what to do. The command line prints it and exits with the
class's ``exit_code`` (2: the input is at fault; 3: the computation could not deliver; 4: the result failed its checks,
and the user asked for this exit code).

Every error also has a short code such as ``E-CAMERA-MODEL``, which stays the same when its sentence is reworded. One
code names one kind of mistake, wherever it is found. ``--debug`` and JSON show the code; the site of the
documents lists all codes with their sentences.
"""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

COMMAND_LINE = "STCAL_COMMAND_LINE"
"""Environment variable that a program sets for itself and its processes: errors then speak of ``--options``."""
OPTION = re.compile(r"`stcal[^`]*`|(?<![\w-])--(?P<no>no-)?(?P<name>[a-z][a-z-]*[a-z])")
"""An option of the command line, or a whole command in quotes, which stays as it is."""
PYTHON_NAMES = {"flatness": "flatness_mm", "max_angle": "pairs.max_angle_rad"}
"""Arguments and fields of options in Python whose names are not those of the command line."""


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Sets variables of the environment within the context, and leaves them as they were."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@contextmanager
def at_command_line() -> Iterator[None]:
    """Lets errors speak of options of the command line, in this process and in those that it starts."""
    with environment({COMMAND_LINE: "1"}):
        yield


def in_python(message: str) -> str:
    """Returns a message with the names that arguments have in Python: ``refine_camera`` for ``--refine-camera``."""

    def named(option: re.Match) -> str:
        if option["name"] is None:
            return option[0]
        name = option["name"].replace("-", "_")
        return f"{PYTHON_NAMES.get(name, name)}{'=False' if option['no'] else ''}"

    return OPTION.sub(named, message)


class StcalError(Exception):
    """Base of every error that stcal raises on purpose: ``code``, its kind, and ``message``, one line."""

    exit_code = 3

    def __init__(self, code: str, message: str):
        super().__init__(code, message)  # both in ``args``, so that the error can be pickled between processes

    @property
    def code(self) -> str:
        """Kind of the mistake, like ``E-CAMERA-MODEL``."""
        return self.args[0]

    def __str__(self) -> str:
        return self.args[1] if COMMAND_LINE in os.environ else in_python(self.args[1])

    @property
    def fault(self) -> str:
        """What is wrong, measured and needed: the message up to its first semicolon."""
        return str(self).partition("; ")[0]

    @property
    def remedy(self) -> str:
        """What to do: the message behind its first semicolon."""
        return str(self).partition("; ")[2]

    def append(self, text: str) -> None:
        """Appends text to the message."""
        self.args = (self.code, f"{self.args[1]}{text}")


class InputError(StcalError):
    """A file, an option or a folder cannot be used as it is."""

    exit_code = 2


class InputNote(UserWarning):
    """A part of an input was passed over, or work was done another way; the result is the same as far as is known."""


class DetectionError(StcalError):
    """Circles, faces or boards are not found, or not found uniquely."""


class MappingError(StcalError):
    """A group gives no model, or is not linked to the others."""


class ScaleError(StcalError):
    """The model cannot be scaled to millimetres."""


class DegenerateError(StcalError):
    """The geometry does not determine the answer."""


class ConvergenceError(StcalError):
    """An iteration did not reach its tolerance."""


class ChecksFailed(StcalError):
    """The result exists, but did not pass its own checks."""

    exit_code = 4


@contextmanager
def named(where: str, instead: str = "") -> Iterator[None]:
    """Lets messages of errors begin with ``where``, what they are about; ``instead`` : their beginning so far."""
    try:
        yield
    except StcalError as error:
        error.args = error.code, f"{where}: {error.args[1].removeprefix(f'{instead}: ')}"
        raise


T = TypeVar("T")


@contextmanager
def held(variable: ContextVar[T], value: T) -> Iterator[None]:
    """Gives a context variable a value within the context."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


NO_MEMORY = "not enough memory"
USED_UP = re.compile("(?i)allocate|failed to map|start new thread|bad_alloc|out of memory|insufficient memory|errno 12")


def lacks_memory(error: BaseException) -> bool:
    """True if the error, or one of its causes, says in one of many ways that memory or processes are used up."""
    chain: list[BaseException] = [error]
    while last := chain[-1].__cause__ or chain[-1].__context__:
        chain.append(last)
    return any(isinstance(e, MemoryError) or USED_UP.search(str(e)) for e in chain)


OTHER = "stcal-*.dist-info"
"""What another project named ``stcal`` on the package index leaves beside the package, whose files it overwrites."""


def fault(package: Path) -> str:
    """Returns in one line that another distribution shares the folder of the package, or an empty string."""
    for other in sorted(package.parent.glob(OTHER)):
        name, version = other.name.removesuffix(".dist-info").split("-", 1)
        return (
            f"{package}: the distribution {name} {version}, another project or an early release of this one, shares "
            "this folder; `pip uninstall stcal`, then `pip install --force-reinstall --no-deps "
            "stereo-target-calibration`, or give each its own environment"
        )
    return ""
