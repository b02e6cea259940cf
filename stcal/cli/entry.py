"""Where the commands begin: signals are answered in one line from the first moment, also while libraries load."""

import os
import signal
import sys
from importlib import import_module
from types import ModuleType

import stcal
from stcal.errors import NO_MEMORY, lacks_memory

ADDRESS_SPACE = 800 << 20
"""Bytes; NumPy, SciPy, OpenCV and pycolmap take 740 MB of it when they are loaded (`VmPeak`)."""
LOADING = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}


def main() -> None:
    """Entry point of ``stcal``."""
    _run("main")


def main_sfm() -> None:
    """Entry point of ``stcal-sfm``."""
    _run("main_sfm")


def _run(name: str) -> None:
    """A program, or its version alone, for which scripts need not wait until the commands are loaded.

    Once it has its exit code, signals change it no more. Python takes handlers away while it ends, and a signal would
    then end a command, whose results are in place, as if it had failed.
    """
    try:
        if sys.argv[1:] == ["--version"]:
            _print_version()
        else:
            getattr(_program(), name)()
    finally:
        for number in LOADING:
            signal.signal(number, signal.SIG_IGN)


def _print_version() -> None:
    try:
        print(stcal.__version__, flush=True)
    except BrokenPipeError:  # the reader has gone, as with `--help`
        os._exit(1)
    except OSError as error:
        os.write(sys.stderr.fileno(), f"error: {error.strerror}; standard output takes nothing\n".encode())
        os._exit(2)


def _program() -> ModuleType:
    """The commands, once they are loaded.

    OpenBLAS starts its threads when it is loaded, and sends its own process SIGINT, or tries for ever, where memory is
    too little for them; the commands use one.
    """
    _answer()
    _require_address_space()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        return import_module("stcal.cli.main")
    except Exception as error:
        if "--debug" in sys.argv or not lacks_memory(error):
            raise
        os.write(sys.stderr.fileno(), f"error: {NO_MEMORY} to load the program; allow it more\n".encode())
        sys.exit(3)


def _require_address_space() -> None:
    """End where a limit of the system (`ulimit -v`) is below what loading takes: C libraries end the process then
    without a word, or hang. Help and version load none of them."""
    if sys.platform == "win32" or {"-h", "--help", "--version"} & set(sys.argv):
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < ADDRESS_SPACE:
        said = f"error: {NO_MEMORY}: {limit >> 20} MB of address space allowed, {ADDRESS_SPACE >> 20} MB needed; "
        os.write(sys.stderr.fileno(), f"{said}raise the limit (`ulimit -v`)\n".encode())
        sys.exit(3)


def _answer() -> None:
    for number in LOADING:
        signal.signal(number, _end)


def _end(number: int, _) -> None:
    """While nothing is done yet."""
    said, code = LOADING[signal.Signals(number)]
    os.write(sys.stderr.fileno(), f"{said}\n".encode())
    os._exit(code)
