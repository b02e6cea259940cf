"""What a command of the command line came to: (exit code, standard output, standard error)."""

import re

INPUT, COMPUTATION, INTERRUPTED = 2, 3, 130
_PROGRESS = re.compile(r"\w+: \d+ of \d+(, about \d+ (s|min) left)?")


def lines_of(stderr: str) -> list[str]:
    """Standard error without progress."""
    return [line for line in stderr.splitlines() if not _PROGRESS.fullmatch(line)]


def assert_error(outcome, code: int, *parts: str) -> str:
    """One line besides progress, this exit code, and every part in the line; returns the line."""
    found, out, err = outcome
    lines = lines_of(err)
    assert len(lines) == 1, err
    (line,) = lines
    assert line.startswith("error: ")
    assert "Traceback" not in out + err
    for part in parts:
        assert part in line
    assert found == code, line
    return line
