"""Cases of a seed: which command, which of its files, and what is done to it; seed and number make a case."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.commands import CALLS, PLACES, Call, options_of
from tests.fuzzing.judged import Outcome, failures, hashes, in_process, lay_out
from tests.fuzzing.mutations import MAY_BE_READ, REFUSED, mutations_of, not_permitted, pick
from tests.shared import own_copy

UNREAD = ("report.html", "detections.csv", "overlays", "compare.json", "no-colmap", ".stcal/cache")
"""Of a run's folder: read by people alone, or by the next run alone."""
BRIEF_S = 1.0
"""Processor time of a call up to which it is made with any mutation where time counts; else with one of ``REFUSED``."""
OPTION_SHARE = 0.06  # of cases that change no file but an option
VALUES = (
    *("nan", "inf", "-1", "0", "1e308", "1e-308", "1e150", "1e-150", "-1e308", "abc"),
    *("", "\x1b[31m", "é", "1,5", "9" * 30, "x" * 3000),
)


@dataclass(frozen=True, slots=True)
class Judged:
    """``said`` : what was done to which command, ``failures`` : (kind, what), ``code``, ``seconds``."""

    name: str
    said: str
    failures: tuple[tuple[str, str], ...]
    code: int | None
    seconds: float
    command: str

    @classmethod
    def of(cls, name: str, said: str, failures, outcome: Outcome, call: Call) -> "Judged":
        return cls(name, said, tuple(failures), outcome.code, outcome.seconds, call.command)


def judged(stock: Path, folder: Path, seed: int, number: int, brief: bool = False) -> Judged:
    """Lay out, spoil and run case ``number``, and judge it; ``brief`` : without calls that take long."""
    rng = np.random.default_rng([seed, number])
    call, program = chosen(rng, brief)
    read, written = lay_out(stock, folder, call, earlier=rng.random() < 0.5)
    more, said, refused, plain = _spoilt(stock, read, written, call, rng, brief and call.seconds > BRIEF_S)
    before = hashes(folder)
    outcome = in_process(call, program, folder, more, plain)
    found = failures(call, folder, outcome, before, refused)
    _restore(folder)
    words = f"{program} {' '.join([call.command, *call.inputs])}: {said}"
    return Judged.of(f"c{number}", words, found, outcome, call)


def option_cases() -> list[tuple[str, str, str]]:
    """(command, option, value): every option that takes a number or a word, with everything that is none for it."""
    commands = dict.fromkeys(call.command for call in CALLS)
    return [(c, name, value) for c in commands for name in options_of(c) for value in VALUES]


def judged_option(stock: Path, folder: Path, number: int) -> Judged:
    """Run case ``number`` of :func:`option_cases` with the command's shortest call, and judge it."""
    command, name, value = option_cases()[number]
    call = min((c for c in CALLS if c.command == command), key=lambda c: (c.code, c.seconds))
    lay_out(stock, folder, call, earlier=False)
    before = hashes(folder)
    outcome = in_process(call, "stcal", folder, (f"{name}={value}",))
    found = failures(call, folder, outcome, before, refused=False)
    return Judged.of(f"o{number}", f"{command}: {name}={value[:20]!r}", found, outcome, call)


def chosen(rng: np.random.Generator, brief: bool) -> tuple[Call, str]:
    """Calls that take long are fewer; each command has its share."""
    calls = [call for call in CALLS if not (brief and call.seconds > BRIEF_S and not call.inputs)]
    same = np.array([sum(call.command == other.command for other in calls) for call in calls])
    share = 1 / (same * (0.3 + np.array([call.seconds for call in calls]))) ** (1 if brief else 0.5)
    call = calls[int(rng.choice(len(calls), p=share / share.sum()))]
    return call, str(pick(rng, ["stcal", PLACES[call.command]]))


def _spoilt(stock: Path, read: Path, written: Path, call: Call, rng: np.random.Generator, slow: bool):
    """Spoil one of the inputs, or an option: words more, what was done, whether it must be refused, as a plain user."""
    files = [] if rng.random() < OPTION_SHARE and not slow else _files(read) + _kept(written)
    files = [path for path in files if not slow or _comes_first(path, read, call)]
    if not files:
        return *_option(call, rng), False, False
    _other_camera(stock, read, rng)
    path = pick(rng, files)
    mutation = pick(rng, REFUSED if slow else mutations_of(path))
    said = mutation(path, rng)
    place = str(path.relative_to(written if written in path.parents else read))
    # Of a folder that is read a file may be skipped.
    refused = mutation in REFUSED and mutation not in MAY_BE_READ and place in call.inputs and call.code == 0
    return (), f"{place}: {said}", refused, mutation is not_permitted


def _files(read: Path) -> list[Path]:
    """Files that are read, those of one kind of a folder taken as one: photographs are many."""
    kinds: dict[tuple, list[Path]] = {}
    for path in sorted(read.rglob("*")):
        if path.is_file() and not set(path.relative_to(read).parts) & set(UNREAD):
            kinds.setdefault((path.parent.name in ("12", "14"), path.suffix), []).append(path)
    return [path for paths in kinds.values() for path in (paths * 12)[:12]]


def _kept(written: Path) -> list[Path]:
    """What an earlier run keeps for the next one."""
    return sorted(written.glob("*/.stcal/cache/*.npz"))


def _comes_first(path: Path, read: Path, call: Call) -> bool:
    """Whether a command that takes long says what is wrong with this file before its work."""
    own = read in path.parents and str(path.relative_to(read)) in call.inputs
    return own or path.name in ("run.json", "faces.json")


def _other_camera(stock: Path, read: Path, rng: np.random.Generator) -> None:
    """The same camera in another of its forms, in some of the cases; the name stays."""
    place = read / "data/cameras.txt"
    if place.exists() and rng.random() < 0.7:
        own_copy(pick(rng, sorted((stock / "cameras").iterdir())), place)


def _option(call: Call, rng: np.random.Generator) -> tuple[tuple[str, ...], str]:
    names = options_of(call.command)
    if not names:
        word = pick(rng, VALUES)
        return (word,), f"the word {word[:20]!r} more"
    name, value = pick(rng, names), pick(rng, VALUES)
    return (f"{name}={value}",), f"{name}={value[:20]!r}"


def _restore(folder: Path) -> None:
    for root, folders, files in os.walk(folder):
        for each in (*folders, *files):
            path = Path(root, each)
            if not path.is_symlink():
                path.chmod(0o755)
