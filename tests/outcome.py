"""How calls end: errors by their codes, and what a command of the command line came to."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from stcal.errors import StcalError

INPUT, COMPUTATION, INTERRUPTED = 2, 3, 130
PROGRESS = re.compile(r"(\S+: )?[\w, ]+: (\d+ of \d+(, about \d+ (s|min) left)?|\d+ s)")
"""A line on what a command is at."""


class Outcome(tuple):
    """(exit code, standard output, standard error), and the ``error`` code of what ended the command, if any."""

    error: str

    def __new__(cls, ended: SystemExit, out: str, err: str) -> "Outcome":
        self = super().__new__(cls, (ended.code or 0, out, err))
        self.error = getattr(ended.__context__, "code", "") if isinstance(ended.__context__, StcalError) else ""
        return self


def ended(main: Callable[[], object], capture) -> Outcome:
    """What a program came to in this process; ``capture`` : pytest's ``capsys`` or ``capfd``."""
    with pytest.raises(SystemExit) as end:
        main()
    return Outcome(end.value, *capture.readouterr())


def program(*first: str):
    """A fixture that calls a program in this process, with these words before those of the call."""

    @pytest.fixture
    def call(monkeypatch, capsys) -> Callable[..., Outcome]:
        from stcal.cli.main import main

        def called(*words) -> Outcome:
            monkeypatch.setattr("sys.argv", [*first, *map(str, words)])
            return ended(main, capsys)

        return called

    return call


@contextmanager
def fails_with(error: str) -> Iterator[pytest.ExceptionInfo[StcalError]]:
    """Expect an error by its code and what it names, in this order: ``E-POINTS-FEW … 2 … 3``.

    What is named are places, values and remedies.
    """
    code, *parts = error.split(" … ")
    with pytest.raises(StcalError) as caught:
        yield caught
    message, start = str(caught.value), 0
    assert caught.value.code == code, message
    for part in parts:
        assert part in message[start:], f"{part!r} not in {message[start:]!r}"
        start = message.index(part, start) + len(part)


def refuses(error: str, function: Callable, *arguments, **options) -> None:
    """Expect :func:`fails_with` of a call."""
    with fails_with(error):
        function(*arguments, **options)


def lines_of(stderr: str) -> list[str]:
    return [line for line in stderr.splitlines() if not PROGRESS.fullmatch(line)]


def assert_error(outcome, code: int, *parts: str) -> str:
    """One line besides progress, this exit code, and every part in the line; returns the line.

    A first part like ``E-POINTS-FEW`` is the code of the error, of an :class:`Outcome`.
    """
    found, out, err = outcome
    lines = lines_of(err)
    assert len(lines) == 1, err
    (line,) = lines
    assert line.startswith("error: ")
    assert "Traceback" not in out + err
    if parts and parts[0].startswith("E-"):
        assert outcome.error == parts[0], line
        parts = parts[1:]
    for part in parts:
        assert part in line
    assert found == code, line
    return line
