"""The folder of a run as a transaction, with the marker that holds the hashes of its files."""

import os
import shutil
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import filelock
from pydantic import Field

import stcal
from stcal.errors import InputError, StcalError
from stcal.io.files import (
    ADDED,
    CACHE,
    READY,
    REPORT_PDF,
    RUN_ENTRIES,
    RUN_MARKER,
    UNFINISHED,
    digest_of,
    json_text,
    own_digest,
    real_place,
    save,
)
from stcal.io.json import ResultFile, read_result
from stcal.sfm.runs.options import RunOptions

ByFile = Annotated[str, "file"]


class MarkerFile(ResultFile):
    """Marker of a run's folder: the input of the run, and the hashes of its files."""

    program: Literal["stcal-sfm"] = Field(description="that made the folder")
    version: str = Field(description="of stcal")
    images: str = Field(description="the folder of photographs")
    options: dict[str, Any] | None = Field(description="of the run; null for `detect`")
    sha256: dict[ByFile, str] | None = Field(
        default=None,
        description="path below the folder → SHA-256 (hex) of every file of the results, and of this one without its "
        "own entry; absent until the run has ended well",
    )

    @classmethod
    def of(cls, images: str | Path, options: RunOptions | None) -> "MarkerFile":
        """Returns the marker of a run, or of a detection alone, that begins."""
        return cls(
            program="stcal-sfm",
            version=stcal.__version__,
            images=str(Path(images).absolute()),
            options=None if options is None else asdict(options),
        )

    def sealed(self, digests: dict[str, str]) -> "MarkerFile":
        """Returns the marker of results with these hashes, which include its own."""
        others = {name: value for name, value in digests.items() if name != RUN_MARKER}
        content = self.model_copy(update={"sha256": others}).content()
        return self.model_copy(update={"sha256": {RUN_MARKER: own_digest(content), **others}})


def files_below(folder: Path) -> Iterator[str]:
    """Yields the paths of all files and links below a folder, with forward slashes; links are not followed."""
    for place, folders, files in os.walk(folder):
        for name in (*files, *(subfolder for subfolder in folders if os.path.islink(os.path.join(place, subfolder)))):
            yield (Path(place) / name).relative_to(folder).as_posix()


COMPARISON = "compare.json"
RESULTS = (*RUN_ENTRIES, COMPARISON)
"""Entries that new results replace, or remove if the new results lack them."""
HOLDER, ENTRIES, LOCK = "holder.txt", "entries.txt", "lock"
LONGEST_DATABASE, MOST_DATABASE_BYTES = "scratch/mapping.db.partial-journal", 500
"""Longest path of a database below the folder of an unfinished run, and the longest that SQLite takes (512, of which it
keeps a few)."""
LOOKED_AT = ("detections.csv", "overlays")
"""Results of a run that fails which help to see why, and claim nothing."""
DATABASE_SIDES = ("-wal", "-shm", "-journal")


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Folder of a run in progress.

    ``out`` : the folder as requested; ``stage`` : folder to which results are written; ``cache`` : folder of results
    that later runs use again.
    """

    out: Path
    stage: Path
    cache: Path


@contextmanager
def run_folder(out: str | Path, content: MarkerFile, inputs: Mapping[str, object]) -> Iterator[RunFolder]:
    """Claims a run's folder; at the end of the block its results take the place of the earlier ones.

    If the block raises, earlier results stay, and the files that it made are left in ``unfinished/``. If there are no
    earlier results, the detections and their overlays take their places all the same, to be looked at.

    Parameters
    ----------
    out : folder that is new, empty, or of an earlier run
    content : the marker
    inputs : what the run reads, by the word for it; values that are no paths are ignored

    Raises
    ------
    InputError
        The folder holds something else, an input, or a run in progress.
    """
    out = Path(out)
    _require_short(out)
    folder = RunFolder(out, out / UNFINISHED, out / CACHE)
    require_ours(out)
    _require_no_inputs(out, inputs)
    with _locked(out):
        with _writable(out):
            complete(out)
            if not (out / RUN_MARKER).exists():
                save(out / RUN_MARKER, json_text(content.content()))
            _make_empty(folder.stage)
        try:
            yield folder
        except BaseException as error:
            _leave(folder, content, error)
            raise
        with _writable(out):
            _exchange(folder.stage, out, content.sealed(_digests(folder.stage)), [])


@contextmanager
def added_results(out: Path) -> Iterator[Path]:
    """Provides a folder for files that are added to a finished run, or that replace some of its own.

    At the end of the block the files take their places, and the marker gets their hashes. No other command writes
    meanwhile. The PDF of a report that is replaced is removed.

    Raises
    ------
    InputError
        Another process is writing there, or the folder is read-only.
    """
    stage = out / ADDED
    with _locked(out):
        with _writable(out):
            complete(out)
            _make_empty(stage)
        try:
            yield stage
            marker = read_result(out / RUN_MARKER, MarkerFile, "run", "run it again")
            gone = {REPORT_PDF} if (stage / "report.html").exists() else set()
            if marker.sha256 is not None:  # None in a version that kept no hashes
                others = {name: digest for name, digest in marker.sha256.items() if name not in gone}
                marker = marker.sealed(others | _digests(stage))
            with _writable(out):
                kept_names = [name for name in RESULTS if name not in gone and os.path.lexists(out / name)]
                _exchange(stage, out, marker, kept_names)
        finally:
            remove(stage)


def _exchange(stage: Path, out: Path, marker: MarkerFile, kept: Sequence[str]) -> None:
    """Moves the files of a complete folder to their places; ``kept`` : earlier results that stay if not replaced."""
    save(stage / RUN_MARKER, json_text(marker))
    save(stage / ENTRIES, "\n".join([*kept, *(path.name for path in stage.iterdir())]))
    os.replace(stage, out / READY)
    complete(out)


def _digests(stage: Path) -> dict[str, str]:
    """Returns the hashes of all results in a folder."""
    names = sorted(name for name in files_below(stage) if name.split("/")[0] in RESULTS)
    return {name: digest_of(stage / name) for name in names}


@contextmanager
def _writable(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise _unwritable(out, error) from error


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError("E-OUTPUT-UNWRITABLE", f"output folder {out}: {error.strerror or error}; give a writable folder")


def complete_interrupted(out: Path) -> None:
    """Completes a finished run that was killed while its results took their places; call it before the run is read.

    Raises
    ------
    InputError
        Another process is writing there.
    """
    if (out / READY).exists():
        with _locked(out), _writable(out):
            complete(out)


def complete(out: Path) -> None:
    """Moves results that are ready to their places; the folder must be locked."""
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
    """Removes a file, a folder with all its content, or a link, but never the target of a link."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.is_dir():
        shutil.rmtree(path)


def frames_folder(out: str | Path) -> Path:
    """Returns the folder of the frames of a video, in the folder of a run."""
    return Path(out) / CACHE / "frames"


def require_ours(out: Path) -> None:
    """Raises an error if a folder is neither new, nor empty, nor of an earlier run."""
    if out.exists() and not out.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"output {out}: not a folder; give a new folder with --out")
    ours = (CACHE, UNFINISHED)  # left by a run that was killed while it claimed the folder
    if (
        out.is_dir()
        and not (out / RUN_MARKER).exists()
        and any(path.name not in ours and not path.name.startswith(RUN_MARKER) for path in out.iterdir())
    ):
        raise InputError(
            "E-OUTPUT-EXISTS", f"output folder {out}: not empty and not of an earlier run; give a new folder with --out"
        )
    _require_no_links(out)


def _require_short(out: Path) -> None:
    """Refuses a path that SQLite cannot open a database below."""
    length = len(os.fsencode(Path(real_place(out)) / UNFINISHED / LONGEST_DATABASE))
    if length > MOST_DATABASE_BYTES:
        raise InputError(
            "E-OUTPUT-LENGTH",
            f"output folder {out}: databases in it have paths of {length} bytes, {MOST_DATABASE_BYTES} at most; give a "
            "shorter --out",
        )


def _require_no_links(out: Path) -> None:
    for name in (UNFINISHED, ADDED, READY, CACHE):
        if (out / name).is_symlink():
            raise InputError(
                "E-OUTPUT-LINK", f"output folder {out}: {name} in it is a link; remove it, a run writes through none"
            )


def _require_no_inputs(out: Path, inputs: Mapping[str, object]) -> None:
    """Refuses inputs that lie where the run writes."""
    place, frames = real_place(out), real_place(frames_folder(out))
    for word, given in inputs.items():
        if isinstance(given, str | Path) and real_place(given) == frames:
            continue  # the run itself has put them there
        if isinstance(given, str | Path) and place in (own := real_place(given), *own.parents):
            raise InputError(
                "E-OUTPUT-IS-INPUT",
                f"{word} {given}: lies in the output folder {out}, whose files this run replaces; copy it elsewhere, "
                "or give another --out",
            )


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Locks the folder against other commands; the system releases the lock when the process ends."""
    _require_no_links(out)
    cache = out / CACHE
    lock = filelock.FileLock(cache / LOCK)
    try:
        cache.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        try:
            holder = (cache / HOLDER).read_text(encoding="utf-8").strip()
        except (OSError, ValueError):
            holder = "another process"
        raise InputError(
            "E-OUTPUT-IN-USE",
            f"output folder {out}: {holder} is writing a run there; wait for its end, or give another --out",
        ) from error
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        with suppress(StcalError):  # it only says to others who writes here
            save(cache / HOLDER, _me())
        yield
    finally:
        lock.release()


def _make_empty(folder: Path) -> None:
    remove(folder)
    folder.mkdir()


def _me() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}\n"


def _finished(out: Path) -> bool:
    """True if the folder holds the results of a run, or of a detection alone, that came to its end."""
    try:
        marker = read_result(out / RUN_MARKER, MarkerFile, "run", "run it again")
    except InputError:
        marker = None
    return (out / "faces.json").exists() or (marker is not None and marker.sha256 is not None)


def _leave(folder: RunFolder, content: MarkerFile, error: BaseException) -> None:
    """Moves the files of a failed run to their places if there are no earlier results; else leaves them aside."""
    remove(folder.stage / "scratch")
    if not _finished(folder.out):
        with suppress(StcalError):  # where there is no space, that of the beginning stays
            save(folder.out / RUN_MARKER, json_text(content.content()))
        for name in RESULTS:
            if name != RUN_MARKER:
                remove(folder.out / name)
            if name in LOOKED_AT and (folder.stage / name).exists():
                os.replace(folder.stage / name, folder.out / name)
        remove(folder.stage)
    elif not any(folder.stage.iterdir()):
        remove(folder.stage)
    elif isinstance(error, StcalError):
        error.append(f"; the earlier results stay, {folder.stage} holds what this run made")
