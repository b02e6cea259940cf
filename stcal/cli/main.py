"""``stcal``, the umbrella command, and ``stcal-sfm``, its shortcut: errors become one line and an exit code."""

import sys

import typer

import stcal
from stcal.cli import sfm
from stcal.errors import StcalError

app = typer.Typer(
    name="stcal",
    help="Calibrate stereo targets from photographs of a single camera, and use them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(sfm.app, name="sfm")


@app.callback(invoke_without_command=True)
def _version(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if version:
        print(stcal.__version__)
        raise typer.Exit


def main() -> None:
    """Entry point of ``stcal``."""
    _guarded(app)


def main_sfm() -> None:
    """Entry point of ``stcal-sfm``."""
    _guarded(sfm.app)


def _guarded(application: typer.Typer) -> None:
    debug = "--debug" in sys.argv
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    try:
        application(args=arguments)
    except StcalError as error:
        if debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("interrupted; finished detections are kept, run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except OSError as error:
        if debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        print(
            f"error: {where}{error.strerror or error}; check the path, its rights and the free space", file=sys.stderr
        )
        sys.exit(2)
