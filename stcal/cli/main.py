"""The command ``stcal`` and its shortcut ``stcal-sfm``. Errors become one line and an exit code."""

import json
import os
import platform
import shutil
import signal
import sys
import threading
from importlib import import_module
from io import TextIOWrapper
from itertools import pairwise
from typing import Any, NoReturn

import typer
from typer._completion_classes import completion_init

import stcal
from stcal.cli import handeye, instruments, robot, sfm
from stcal.cli.help import group
from stcal.cli.options import protect_outputs
from stcal.cli.terminal import printable, say
from stcal.errors import NO_MEMORY, InputError, StcalError, at_command_line, lacks_memory

INTERRUPTED, TERMINATED = 130, 143
AGAIN_S = 0.02  # time after which a signal is sent again, s
MESSAGE_CHARACTERS = 600
"""Largest length of an error's line. Texts from files, which it may quote, can have any length."""
LIBRARIES = {"pycolmap": "pycolmap", "OpenCV": "cv2", "NumPy": "numpy", "SciPy": "scipy"}
"""Module of each library, by name."""
RESUMED = {"run", "detect"}  # commands that keep finished detections when they are interrupted
# The class is Click's, which newer versions of Typer contain.
UsageError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
app = group("stcal", "Calibrate stereo targets from photographs of a single camera, and measure with them.")
app.add_typer(sfm.app, name="sfm")
app.add_typer(robot.app, name="robot")
app.add_typer(instruments.app, name="locate")
app.add_typer(instruments.camera_app, name="camera")
app.add_typer(handeye.app)
app.command("register")(instruments.register)
protect_outputs(app)


@sfm.app.callback(invoke_without_command=True)
@app.callback(invoke_without_command=True)
def _version(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
    versions: bool = typer.Option(
        False, "--versions", help="Print the versions of stcal and of the packages that it uses, and exit."
    ),
) -> None:
    if version:
        print(stcal.__version__)
        raise typer.Exit
    if versions:
        versions_by_name = environment()
        width = max(map(len, versions_by_name))
        for name, installed in versions_by_name.items():
            say(f"{name:{width}}  {installed}")
        raise typer.Exit


def environment() -> dict[str, str]:
    """Returns versions by name: stcal, Python, system, libraries, and the native COLMAP on the PATH."""
    from stcal.sfm.interop.crosscheck import find_colmap

    version_of = {"stcal": stcal.__version__, "Python": platform.python_version(), "system": platform.platform()}
    for name, module in LIBRARIES.items():
        try:
            version_of[name] = str(import_module(module).__version__)
        except Exception as error:  # raised by a broken installation, which this report is to reveal
            version_of[name] = f"does not load: {error}"
    try:
        version_of["native colmap"] = find_colmap().version if shutil.which("colmap") else "not found"
    except InputError as error:
        version_of["native colmap"] = str(error)
    return version_of


def main() -> None:
    _guarded(app)


def main_sfm() -> None:
    _guarded(sfm.app)


@at_command_line()
def _guarded(application: typer.Typer) -> None:
    debug = "--debug" in sys.argv
    if any(name.startswith("_STCAL") and name.endswith("_COMPLETE") for name in os.environ):
        completion_init()  # a shell asks what may stand next, docs/howto/install.md
    signal.signal(signal.SIGTERM, _terminate)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal that has no µ must not end a run
            stream.reconfigure(errors="replace")
    try:
        # Not standalone: Typer hands its errors on in place of drawing a box of several lines.
        code = application(args=arguments, prog_name=application.info.name, standalone_mode=False)
        if code == INTERRUPTED:  # Typer makes this of a KeyboardInterrupt
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except StcalError as error:
        if "--json=-" in arguments or ["--json", "-"] in map(list, pairwise(arguments)):
            print(json.dumps({"error": str(error), "code": error.code}, ensure_ascii=False))
        if debug:
            error.add_note(error.code)
            raise
        _fail(str(error), error.exit_code)
    except UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # the answer is the help text
            error.show()
            sys.exit(error.exit_code)
        where = error.ctx.command_path if error.ctx else application.info.name
        _fail(f"{error.format_message().rstrip('.')}; `{where} --help` lists what there is", error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        kept = "; finished detections are kept, run the same command again to go on"
        print("interrupted" + kept * bool(RESUMED & set(arguments[:2])), file=sys.stderr)
        sys.exit(INTERRUPTED)
    except _Terminated:
        print("terminated", file=sys.stderr)
        sys.exit(TERMINATED)
    except OSError as error:
        if debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}; check the path, its rights and the free space", 2)
    except Exception as error:
        if debug or not lacks_memory(error):
            raise
        _fail(f"{NO_MEMORY}; use fewer --workers, smaller images or fewer of them at a time", 3)


def _terminate(*_) -> NoReturn:
    """Ends a command at SIGTERM as at Ctrl-C: existing results stay, and no process is left behind."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _Terminated


def again(lost: "sys.UnraisableHookArgs") -> None:
    """Sends a signal again if its exception was raised where Python only prints it, such as in a finaliser."""
    number = {KeyboardInterrupt: signal.SIGINT, _Terminated: signal.SIGTERM}.get(lost.exc_type)  # type: ignore[arg-type]
    if number is None:
        sys.__unraisablehook__(lost)
        return
    signal.signal(signal.SIGTERM, _terminate)
    main_thread = threading.main_thread().ident
    if sys.platform == "win32" or main_thread is None:
        threading.Timer(AGAIN_S, signal.raise_signal, (number,)).start()
    else:  # to the main thread: that ends what it waits for
        threading.Timer(AGAIN_S, signal.pthread_kill, (main_thread, number)).start()


class _Terminated(BaseException):
    """The exception that SIGTERM raises."""


def _fail(message: str, code: int) -> NoReturn:
    line = " ".join(printable(message).split())
    half = (MESSAGE_CHARACTERS - len("error:  … ")) // 2
    if len(line) > 2 * half:
        line = f"{line[:half]} … {line[-half:]}"
    print(f"error: {line}", file=sys.stderr)
    sys.exit(code)
