"""Where the commands begin: signals are answered in one line from the first moment, also while libraries load."""

import os
import signal
import sys
from importlib import import_module
from types import ModuleType

NO_MEMORY = "not enough memory"
USED_UP = (
    "allocate",
    "failed to map",
    "start new thread",
    "bad_alloc",
    "out of memory",
    "insufficient memory",
    "errno 12",
)
LOADING = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}


def main() -> None:
    """Entry point of ``stcal``."""
    _program().main()


def main_sfm() -> None:
    """Entry point of ``stcal-sfm``."""
    _program().main_sfm()


def lacks_memory(error: BaseException) -> bool:
    """Whether this is how Python, the loader of libraries, or a library says that memory or processes are used up."""
    chain: list[BaseException] = [error]
    while last := chain[-1].__cause__ or chain[-1].__context__:
        chain.append(last)
    return any(isinstance(e, MemoryError) or any(words in str(e).lower() for words in USED_UP) for e in chain)


def _program() -> ModuleType:
    """The commands, once they are loaded."""
    _answer()
    try:
        return import_module("stcal.cli.main")
    except Exception as error:
        if "--debug" in sys.argv or not lacks_memory(error):
            raise
        os.write(sys.stderr.fileno(), f"error: {NO_MEMORY} to load the program; allow it more\n".encode())
        sys.exit(3)


def _answer() -> None:
    for number in LOADING:
        signal.signal(number, _end)


def _end(number: int, _) -> None:
    """While nothing is done yet."""
    said, code = LOADING[signal.Signals(number)]
    os.write(sys.stderr.fileno(), f"{said}\n".encode())
    os._exit(code)
