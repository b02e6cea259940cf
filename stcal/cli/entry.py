"""Where the commands begin: signals are answered in one line from the first moment, also while libraries load."""

import os
import signal
import sys

LOADING = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}


def main() -> None:
    """Entry point of ``stcal``."""
    _answer()
    from stcal.cli import main as program

    program.main()


def main_sfm() -> None:
    """Entry point of ``stcal-sfm``."""
    _answer()
    from stcal.cli import main as program

    program.main_sfm()


def _answer() -> None:
    for number in LOADING:
        signal.signal(number, _end)


def _end(number: int, _) -> None:
    """While nothing is done yet."""
    said, code = LOADING[signal.Signals(number)]
    os.write(sys.stderr.fileno(), f"{said}\n".encode())
    os._exit(code)
