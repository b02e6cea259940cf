"""The native ``colmap`` program: find it, ask its version, map a group of an exported database with our thresholds."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

from stcal.errors import InputError, MappingError

INSTALL = "install it with `sudo apt-get install colmap` (Debian, Ubuntu) or `brew install colmap` (macOS)"
ASK_SECONDS = 60.0
"""For an answer about itself; loading its libraries takes a second or two."""
LAST_WORDS = 200


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
        There is none, or it is not COLMAP.
    MappingError
        It fails or hangs when asked for its version.
    """
    found = shutil.which("colmap" if path is None else str(path))
    if found is None:
        where = "on the PATH" if path is None else f"at {path} that can be executed"
        raise InputError(f"native COLMAP: no program {where}; {INSTALL}, or give its path with --colmap")
    program = Path(found)
    text = _run([str(program), "help"], ASK_SECONDS, program)
    version = re.search(r"COLMAP\s+v?(\d+\.\d+(?:\.\d+)?)", text)
    if version is None:
        raise InputError(f"native COLMAP: {program} does not say a COLMAP version; {INSTALL}, or give another --colmap")
    options = re.findall(r"--([\w.]+)", _run([str(program), "mapper", "-h"], ASK_SECONDS, program))
    return NativeColmap(program, version[1], frozenset(options))


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
    text = _run(command, timeout_s, native.program)
    (folder / "mapper.log").write_text(text, encoding="utf-8")


def _run(command: list[str], timeout_s: float, program: Path) -> str:
    """What a command prints; it needs no screen, and takes its children with it when it hangs."""
    what = f"{program} {command[1]}"
    environment = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
    except OSError as error:
        raise InputError(f"native COLMAP: {program} cannot be started ({error.strerror}); {INSTALL}") from error
    try:
        output = process.communicate(timeout=timeout_s)[0].decode(errors="replace")
    except subprocess.TimeoutExpired as error:
        raise MappingError(
            f"native COLMAP: `{what}` still runs after {timeout_s:g} s; raise --timeout, or look at the program"
        ) from error
    finally:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if process.returncode != 0:
        words = " ".join(output.split())[-LAST_WORDS:] or "no message"
        raise MappingError(f"native COLMAP: `{what}` ended with code {process.returncode}: {words}; check the program")
    return output
