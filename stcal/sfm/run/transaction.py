"""A run's folder as a transaction: it holds the results of one run, the earlier or the new one, each complete.

A run writes beside the earlier results, in ``unfinished/``; when all is there, that folder is renamed to ``ready/``,
which is the moment that counts, and its entries take their places. A run that is killed before leaves the earlier
results, one that is killed after is completed by whoever opens the folder next.
"""

import os
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import filelock

from stcal.errors import InputError, StcalError
from stcal.io.saving import CACHE, READY, RUN_ENTRIES, RUN_MARKER, UNFINISHED, json_text, save
from stcal.sfm.run.marker import MarkerFile

RESULTS = (*RUN_ENTRIES, "compare.json")
"""What new results replace, or take away where they have none of it."""
HOLDER, ENTRIES, LOCK = "holder.txt", "entries.txt", "lock"
DATABASE_SIDES = ("-wal", "-shm", "-journal")


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of a run that is going on: ``out`` as it was asked for; ``stage`` : where results are written;
    ``cache`` : what later runs take up."""

    out: Path
    stage: Path
    cache: Path


@contextmanager
def run_folder(out: str | Path, content: MarkerFile, inputs: Mapping[str, object]) -> Iterator[RunFolder]:
    """Claim a run's folder; at the end of the block its results take the earlier ones' place.

    Where the block raises, earlier results stay, and what it made is left in ``unfinished/``; without earlier results
    it takes its place all the same, to be looked at.

    Parameters
    ----------
    out : new, empty, or of an earlier run
    content : the marker
    inputs : what the run reads, by the word for it; what is no path is let pass

    Raises
    ------
    InputError
        The folder holds something else, an input, or a run that is going on.
    """
    out = Path(out)
    folder = RunFolder(out, out / UNFINISHED, out / CACHE)
    _require_ours(out)
    _require_no_inputs(out, inputs)
    with _writable(out):
        folder.cache.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        with _writable(out):
            complete(out)
            if not (out / RUN_MARKER).exists():
                save(out / RUN_MARKER, json_text(content.content()))
            remove(folder.stage)
            folder.stage.mkdir()
            save(folder.stage / HOLDER, _me())
        try:
            yield folder
        except BaseException as error:
            _leave(folder, content, error)
            raise
        with _writable(out):
            save(folder.stage / RUN_MARKER, json_text(content.content()))
            save(folder.stage / ENTRIES, "\n".join(path.name for path in folder.stage.iterdir()))
            os.replace(folder.stage, out / READY)
            complete(out)


@contextmanager
def _writable(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise _unwritable(out, error) from error


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError(f"output folder {out}: {error.strerror or error}; give a writable folder")


def complete_interrupted(out: Path) -> None:
    """Before a finished run is read: complete one that was ended from outside while its results took their places.

    Raises
    ------
    InputError
        Another process is writing there.
    """
    if (out / READY).exists():
        with _locked(out), _writable(out):
            complete(out)


def complete(out: Path) -> None:
    """Put results that are ready into their places, with the folder locked."""
    ready = out / READY
    if ready.is_symlink() or not (ready / ENTRIES).is_file():
        return
    new = (ready / ENTRIES).read_text(encoding="utf-8").split()
    for name in RESULTS:
        if (ready / name).exists():
            if (ready / name).is_dir() or not (out / name).is_file():
                remove(out / name)
            os.replace(ready / name, out / name)
        elif name not in new:
            remove(out / name)
    for side in DATABASE_SIDES:
        remove(out / f"database.db{side}")
    remove(ready)


def remove(path: Path) -> None:
    """Remove a file, a folder with all in it, or a link, never what the link leads to."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.is_dir():
        shutil.rmtree(path)


def _require_ours(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"output {out}: not a folder; give a new folder with --out")
    ours = (CACHE, UNFINISHED)  # of a run that was ended while it claimed the folder
    if (
        out.is_dir()
        and not (out / RUN_MARKER).exists()
        and any(path.name not in ours and not path.name.startswith(RUN_MARKER) for path in out.iterdir())
    ):
        raise InputError(f"output folder {out}: not empty and not of an earlier run; give a new folder with --out")
    for name in (UNFINISHED, READY, CACHE):
        if (out / name).is_symlink():
            raise InputError(f"output folder {out}: {name} in it is a link; remove it, a run writes through none")


def _require_no_inputs(out: Path, inputs: Mapping[str, object]) -> None:
    """What a run reads must not lie where it writes."""
    place = out.resolve()
    for word, given in inputs.items():
        if isinstance(given, str | Path) and place in (own := Path(given).resolve(), *own.parents):
            raise InputError(
                f"{word} {given}: lies in the output folder {out}, whose files this run replaces; copy it elsewhere, "
                "or give another --out"
            )


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder against other runs; the system lets go of the lock with the process."""
    lock = filelock.FileLock(out / CACHE / LOCK)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        try:
            holder = (out / UNFINISHED / HOLDER).read_text(encoding="utf-8").strip()
        except OSError:
            holder = "another process"
        raise InputError(
            f"output folder {out}: {holder} is writing a run there; wait for its end, or give another --out"
        ) from error
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        yield
    finally:
        lock.release()


def _me() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}\n"


def _leave(folder: RunFolder, content: MarkerFile, error: BaseException) -> None:
    """What a run that failed has made: in place where no earlier run's result is, else beside it."""
    remove(folder.stage / HOLDER)
    remove(folder.stage / "scratch")
    if not (folder.out / "faces.json").exists():
        save(folder.stage / RUN_MARKER, json_text(content.content()))
        for name in RESULTS:
            if name != RUN_MARKER:
                remove(folder.out / name)
            if (folder.stage / name).exists():
                os.replace(folder.stage / name, folder.out / name)
        remove(folder.stage)
    elif not any(folder.stage.iterdir()):
        remove(folder.stage)
    elif isinstance(error, StcalError):
        error.args = (f"{error}; the earlier results stay, {folder.stage} holds what this run made",)
