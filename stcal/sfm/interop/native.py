"""The native ``colmap`` program: find it, ask its version, map a group of an exported database with our thresholds."""

import contextlib
import os
import re
import selectors
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from stcal.errors import InputError, MappingError

INSTALL = "install it with `sudo apt-get install colmap` (Debian, Ubuntu) or `brew install colmap` (macOS)"
ASK_SECONDS = 60.0
"""For an answer about itself; loading its libraries takes a second or two."""
LAST_WORDS = 200
MAX_OUTPUT = 1 << 20
"""Bytes kept of what a program prints, the last ones: it may print without end."""
LOOK_SECONDS = 0.1
"""Between two looks whether a program that prints nothing has ended."""


@dataclass(frozen=True, slots=True)
class NativeColmap:
    """``program`` ; ``version`` as it says itself, ``3.8`` ; ``mapper_options`` : the options its mapper has."""

    program: Path
    version: str
    mapper_options: frozenset[str]


def find_colmap(path: Path | None = None) -> NativeColmap:
    """The program at ``path``, or the one on the PATH.

    Raises
    ------
    InputError
        There is none, it is not COLMAP, or it fails or hangs when asked for its version.
    """
    found = shutil.which("colmap" if path is None else str(path))
    if found is None:
        where = "on the PATH" if path is None else f"at {path} that can be executed"
        raise InputError(
            "E-COLMAP-PROGRAM", f"native COLMAP: no program {where}; {INSTALL}, or give its path with --colmap"
        )
    program = Path(found)
    text = _answer(program, "help")
    version = re.search(r"COLMAP\s+v?(\d+\.\d+(?:\.\d+)?)", text)
    if version is None:
        raise InputError(
            "E-COLMAP-PROGRAM",
            f"native COLMAP: {program} does not say a COLMAP version; {INSTALL}, or give another --colmap",
        )
    options = re.findall(r"--([\w.]+)", _answer(program, "mapper", "-h"))
    return NativeColmap(program, version[1], frozenset(options))


def require_listable(names: list[str]) -> None:
    """Refuse names that do not survive COLMAP's list of images, whose lines are stripped.

    Raises
    ------
    InputError
        A name begins or ends with a space.
    """
    for name in names:
        if name != name.strip(" "):
            raise InputError(
                "E-IMAGE-NAME-SPACES",
                f"image {name!r}: native COLMAP lists images without the spaces at their names' ends and would not "
                "find it; rename the image or its folder, and run again",
            )


def map_natively(
    native: NativeColmap, database: Path, folder: Path, names: list[str], options: dict[str, str], timeout_s: float
) -> None:
    """Run the mapper on the named images of a database, into ``folder/models``.

    Parameters
    ----------
    folder : new; what the mapper says goes to ``mapper.log`` there
    options : values by name without dashes; a name that this version does not have is an error of the caller

    Raises
    ------
    MappingError
        The program fails, or does not end in ``timeout_s`` seconds.
    """
    models, images = folder / "models", folder / "images"
    for each in (models, images):
        each.mkdir(parents=True)
    listing = folder / "images.txt"
    listing.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    fixed = {"database_path": database, "image_path": images, "image_list_path": listing, "output_path": models}
    command = [str(native.program), "mapper"]
    for name, value in (fixed | options).items():
        command += [f"--{name}", str(value)]
    code, output = _run(command, timeout_s, TMPDIR=str(folder))  # where it leaves its logs
    (folder / "mapper.log").write_text(output, encoding="utf-8")
    what = f"native COLMAP: `{native.program} mapper`"
    if code is None:
        raise MappingError(
            "E-COLMAP-TIMEOUT", f"{what} still runs after {timeout_s:g} s; raise --timeout, or look at the program"
        )
    if code != 0:
        raise MappingError("E-COLMAP-FAILED", f"{what} {_end(code, output)}; check the program")


def _answer(program: Path, *words: str) -> str:
    """What the program says of itself."""
    code, output = _run([str(program), *words], ASK_SECONDS)
    if code != 0:
        how = f"does not end in {ASK_SECONDS:g} s" if code is None else _end(code, output)
        raise InputError(
            "E-COLMAP-PROGRAM",
            f"native COLMAP: `{program} {' '.join(words)}` {how}; {INSTALL}, or give another --colmap",
        )
    return output


def _end(code: int, output: str) -> str:
    how = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
    return f"{how}: {' '.join(output.split())[-LAST_WORDS:] or 'no message'}"


def _run(command: list[str], timeout_s: float, **environment: str) -> tuple[int | None, str]:
    """The exit code, None where the time was over, and the last that a command printed; ``environment`` is added.

    It needs no screen, and nothing that it started outlives it.
    """
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"QT_QPA_PLATFORM": "offscreen"} | environment,
            start_new_session=True,
        )
    except OSError as error:
        raise InputError(
            "E-COLMAP-PROGRAM", f"native COLMAP: {command[0]} cannot be started ({error.strerror}); {INSTALL}"
        ) from error
    pipe = process.stdout
    assert pipe is not None  # it was asked for
    try:
        output = _listen(process, pipe, time.monotonic() + timeout_s)
        code = process.poll()
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: not permitted on what has ended
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        pipe.close()
    return code, output.decode(errors="replace")


def _listen(process: subprocess.Popen, pipe: IO[bytes], until: float) -> bytes:
    """The last that a process prints, till it ends or the time is over; a child of it may keep the pipe open."""
    kept = b""
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while (left := until - time.monotonic()) > 0:
            ended = process.poll() is not None
            if selector.select(0 if ended else min(left, LOOK_SECONDS)):
                chunk = os.read(pipe.fileno(), 1 << 16)
                if not chunk:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(left)
                    break
                kept = (kept + chunk)[-MAX_OUTPUT:]
            elif ended:
                break
    return kept
