"""The native ``colmap`` program: finding it, its version, and mapping of a group of an exported database."""

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
"""Time limit for an answer of the program about itself, s. Loading its libraries takes a second or two."""
LAST_WORDS = 200
MAX_OUTPUT = 1 << 20
"""Number of bytes kept of a program's output. The last ones are kept, as a program may print without end."""
LOOK_SECONDS = 0.1
"""Interval at which a silent program is checked for its end, s."""


@dataclass(frozen=True, slots=True)
class NativeColmap:
    """A native COLMAP program.

    ``version`` : as the program states it, like ``3.8``; ``mapper_options`` : options of its mapper.
    """

    program: Path
    version: str
    mapper_options: frozenset[str]


def find_colmap(path: str | Path | None = None) -> NativeColmap:
    """Returns the program at ``path``, or the one on the PATH.

    Raises InputError if there is none, it is not COLMAP, or it fails or hangs when asked for its version.
    """
    executable = shutil.which("colmap" if path is None else str(path))
    if executable is None:
        where = "on the PATH" if path is None else f"at {path} that can be executed"
        raise InputError(
            "E-COLMAP-PROGRAM", f"native COLMAP: no program {where}; {INSTALL}, or give its path with --colmap"
        )
    program = Path(executable)
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
    """Refuses names that COLMAP's list of images would change, as its lines are stripped.

    Raises InputError if a name begins or ends with a space.
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
    """Runs the mapper on the named images of a database and writes to ``folder/models``.

    ``folder`` : new folder; the mapper's output goes to ``mapper.log`` there; ``options`` : values by name without
    dashes; this version must have all of the names.

    Raises MappingError if the program fails, or does not end in ``timeout_s`` seconds.
    """
    models, images = folder / "models", folder / "images"
    for subfolder in (models, images):
        subfolder.mkdir(parents=True)
    listing = folder / "images.txt"
    listing.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    fixed = {"database_path": database, "image_path": images, "image_list_path": listing, "output_path": models}
    command = [str(native.program), "mapper"]
    for name, value in (fixed | options).items():
        command += [f"--{name}", str(value)]
    code, output = _run(command, timeout_s, TMPDIR=str(folder))  # COLMAP writes its logs there
    (folder / "mapper.log").write_text(output, encoding="utf-8")
    program = f"native COLMAP: `{native.program} mapper`"
    if code is None:
        raise MappingError(
            "E-COLMAP-TIMEOUT",
            f"{program} is still running after {timeout_s:g} s; raise --timeout, or check the program",
        )
    if code != 0:
        raise MappingError("E-COLMAP-FAILED", f"{program} {_end(code, output)}; check the program")


def _answer(program: Path, *words: str) -> str:
    """Returns the output of the program for a question about itself."""
    code, output = _run([str(program), *words], ASK_SECONDS)
    if code != 0:
        ending = f"does not end in {ASK_SECONDS:g} s" if code is None else _end(code, output)
        raise InputError(
            "E-COLMAP-PROGRAM",
            f"native COLMAP: `{program} {' '.join(words)}` {ending}; {INSTALL}, or give another --colmap",
        )
    return output


def _end(code: int, output: str) -> str:
    ending = f"ended with code {code}" if code >= 0 else f"was ended by signal {-code}"
    return f"{ending}: {' '.join(output.split())[-LAST_WORDS:] or 'no message'}"


def _run(command: list[str], timeout_s: float, **environment: str) -> tuple[int | None, str]:
    """Returns the exit code of a command, None after the time limit, and the last part of its output.

    ``environment`` : added variables. The command needs no screen, and no process that it started outlives it.
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
    assert pipe is not None  # as stdout=PIPE
    try:
        output = _listen(process, pipe, time.monotonic() + timeout_s)
        code = process.poll()
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: not permitted for an ended process
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        pipe.close()
    return code, output.decode(errors="replace")


def _listen(process: subprocess.Popen, pipe: IO[bytes], until: float) -> bytes:
    """Returns the last part of a process's output, until it ends or the time is over.

    The end of the process is watched, too, as a child of it may keep the pipe open.
    """
    output = b""
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while (remaining_s := until - time.monotonic()) > 0:
            ended = process.poll() is not None
            if selector.select(0 if ended else min(remaining_s, LOOK_SECONDS)):
                chunk = os.read(pipe.fileno(), 1 << 16)
                if not chunk:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(remaining_s)
                    break
                output = (output + chunk)[-MAX_OUTPUT:]
            elif ended:
                break
    return output
