"""Entry points of the commands. Signals are answered in one line from the first moment, also while libraries load."""

import os
import signal
import sys
from importlib import import_module
from types import ModuleType

import stcal
from stcal.errors import NO_MEMORY, lacks_memory

ADDRESS_SPACE = 800 << 20
"""Address space that loading needs, bytes. NumPy, SciPy, OpenCV and pycolmap take 740 MB of it (`VmPeak`)."""
LOADING = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}


def main() -> None:
    """Entry point of ``stcal``."""
    _run("main")


def main_sfm() -> None:
    """Entry point of ``stcal-sfm``."""
    _run("main_sfm")


def _run(name: str) -> None:
    """Runs a program. ``--version`` alone is answered at once, before the commands are loaded. Signals after the end
    of the program do not change its exit code: Python removes handlers while it ends, and a signal would then end a
    command as if it had failed, although its results are in place."""
    _replace_closed_streams()
    try:
        if sys.argv[1:] == ["--version"]:
            _print_version()
        else:
            program = _program()
            sys.unraisablehook = program.again
            getattr(program, name)()
    finally:
        for number in LOADING:
            signal.signal(number, signal.SIG_IGN)


def _replace_closed_streams() -> None:
    """Opens the null device in place of closed standard streams (`>&-`), into which C libraries would print."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115


def _print_version() -> None:
    try:
        print(stcal.__version__, flush=True)
    except BrokenPipeError:  # the reader has gone, as with `--help`
        os._exit(1)
    except OSError as error:
        os.write(sys.stderr.fileno(), f"error: {error.strerror}; standard output takes nothing\n".encode())
        os._exit(2)


def _program() -> ModuleType:
    """Loads and returns the module of the commands, with one thread of OpenBLAS: it may hang where memory is short."""
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
    """Ends the program if `ulimit -v` is below what loading needs: C libraries would end it, or hang, silently."""
    if sys.platform == "win32" or {"-h", "--help", "--version"} & set(sys.argv):
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < ADDRESS_SPACE:
        message = f"error: {NO_MEMORY}: {limit >> 20} MB of address space allowed, {ADDRESS_SPACE >> 20} MB needed; "
        os.write(sys.stderr.fileno(), f"{message}raise the limit (`ulimit -v`)\n".encode())
        sys.exit(3)


def _answer() -> None:
    for number in LOADING:
        signal.signal(number, _end)


def _end(number: int, _) -> None:
    word, code = LOADING[signal.Signals(number)]
    os.write(sys.stderr.fileno(), f"{word}\n".encode())
    os._exit(code)
