"""The folder of a run: results are written into a hidden folder inside, which is renamed when they are complete, and
take the places of the earlier ones. Whoever opens the folder next finishes that if the process was killed. A marker
holds the input of the run, and the hashes of its files."""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import filelock
from pydantic import Field

import stcal
from stcal.errors import InputError, StcalError
from stcal.io import files
from stcal.io.json import ResultFile, checked, read_json, read_result

ByFile = Annotated[str, "file"]
AGAIN = "run it again"


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
    def of(cls, images: str | Path, options: Any) -> "MarkerFile":
        """Returns the marker of a run with these options, or of a detection alone, that begins."""
        plain, place = None if options is None else asdict(options), str(Path(images).absolute())
        return cls(program="stcal-sfm", version=stcal.__version__, images=place, options=plain)

    def sealed(self, digests: dict[str, str]) -> "MarkerFile":
        """Returns the marker of results with these hashes, which include its own."""
        others = {name: value for name, value in digests.items() if name != files.RUN_MARKER}
        content = self.model_copy(update={"sha256": others}).content()
        return self.model_copy(update={"sha256": {files.RUN_MARKER: files.own_digest(content), **others}})


STAGE, READY = f"{files.INTERNAL}/unfinished", f"{files.INTERNAL}/ready"  # results in the making, and complete
GONE = "gone.txt"  # names of the earlier results that complete ones lack
RESULTS = tuple(name for name in files.RUN_ENTRIES if name != files.INTERNAL)  # are replaced, or removed
LOOKED_AT = ("detections.csv", "overlays", "report.html")  # help to see why a run failed
LONGEST_DATABASE, MOST_DATABASE_BYTES = f"{STAGE}/scratch/mapping.db.partial-journal", 500
"""Longest path of a database below a run's folder, and the longest that SQLite takes (512, of which it keeps a few)."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Folder ``out`` of a run in progress: results are written to ``stage``, and ``cache`` is for later runs."""

    out: Path
    stage: Path
    cache: Path


@contextmanager
def run_folder(out: str | Path, content: MarkerFile, inputs: Mapping[str, object]) -> Iterator[RunFolder]:
    """Claims a run's folder; at the end of the block its results take the place of the earlier ones. If the block
    raises, earlier results stay; without them detections and overlays are left to be looked at. ``content``: the
    marker; ``inputs``: what the run reads, by the word for it; what is no path is ignored."""
    out = Path(out)
    length = len(os.fsencode(Path(files.real_place(out)) / LONGEST_DATABASE))
    if length > MOST_DATABASE_BYTES:
        fault = f"output folder {out}: databases in it have paths of {length} bytes, {MOST_DATABASE_BYTES} at most"
        raise InputError("E-OUTPUT-LENGTH", f"{fault}; give a shorter --out")
    require_ours(out)
    place, frames = files.real_place(out), files.real_place(frames_folder(out))  # the run itself has put frames there
    for word, given in inputs.items():
        read = files.real_place(given) if isinstance(given, str | Path) else frames
        if read != frames and place in (read, *read.parents):
            fault = f"{word} {given}: lies in the output folder {out}, whose files this run replaces"
            raise InputError("E-OUTPUT-IS-INPUT", f"{fault}; copy it elsewhere, or give another --out")
    with _staged(out) as stage:
        if not (out / files.RUN_MARKER).exists():
            files.save(out / files.RUN_MARKER, files.json_text(content.content()))
        earlier = is_finished(out)
        try:
            yield RunFolder(out, stage, out / files.CACHE)
        except BaseException as error:
            if earlier and isinstance(error, StcalError) and any(stage.iterdir()):
                error.append("; the earlier results stay")
            for name in () if earlier else RESULTS:
                remove(out / name)
                if name in LOOKED_AT and (stage / name).exists():
                    os.replace(stage / name, out / name)
            raise
        _exchange(out, content.sealed(_digests(stage)), [name for name in RESULTS if not (stage / name).exists()])


@contextmanager
def added_results(out: Path) -> Iterator[Path]:
    """Provides a folder for files that are added to a finished run at the end of the block, while no other command
    writes. The PDF of a report that is replaced is removed."""
    with _staged(out) as stage:
        yield stage
        marker = read_marker(out)
        page, pdf = (stage / name for name in ("report.html", files.REPORT_PDF))
        gone = [files.REPORT_PDF] if page.exists() and not pdf.exists() else []
        if marker.sha256 is not None:
            kept = {name: digest for name, digest in marker.sha256.items() if name not in gone}
            marker = marker.sealed(kept | _digests(stage))
        _exchange(out, marker, gone)


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """Locks the folder against other commands until the block ends, and provides an empty folder for new results."""
    _require_no_link(out)
    lock = filelock.FileLock(out / files.INTERNAL / "lock")  # the system releases it when the process ends
    try:
        (out / files.CACHE).mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        _complete(out)
        remove(out / STAGE)
        (out / STAGE).mkdir()
    except filelock.Timeout as error:
        fault = f"output folder {out}: another process is writing a run there"
        raise InputError("E-OUTPUT-IN-USE", f"{fault}; wait for its end, or give another --out") from error
    except OSError as error:
        lock.release()
        raise _unwritable(out, error) from error
    try:
        yield out / STAGE
    finally:
        remove(out / STAGE)
        lock.release()


@contextmanager
def as_written(file: Path | str) -> Iterator[None]:
    """Raises InputError that names the file if it is not as a run of this version writes it."""
    try:
        yield
    except OSError as error:
        fault = f"{error.filename}: {error.strerror or error}"
        raise InputError("E-RUN-DAMAGED", f"{fault}; the run needs it, run it again") from error
    except (LookupError, TypeError, ValueError, AttributeError, StcalError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise InputError("E-RUN-DAMAGED", f"{file}: damaged, or of another version ({reason}); run it again") from error


def is_finished(out: Path) -> bool:
    """True if the folder holds the results of a run, or of a detection alone, that came to its end."""
    with suppress(InputError):
        if read_marker(out).sha256 is not None:
            return True
    return (out / "faces.json").exists()


def read_marker(out: Path) -> MarkerFile:
    return read_result(out / files.RUN_MARKER, MarkerFile, "run", AGAIN)


def _digests(stage: Path) -> dict[str, str]:
    return {name: files.digest_of(stage / name) for name in sorted(files_below(stage)) if name.split("/")[0] in RESULTS}


def _exchange(out: Path, marker: MarkerFile, gone: Sequence[str]) -> None:
    """Puts new results in place of earlier ones; ``gone`` : earlier results that the new ones lack."""
    files.save(out / STAGE / Path(files.RUN_MARKER).name, files.json_text(marker))
    files.save(out / STAGE / GONE, "\n".join(gone))
    try:
        os.replace(out / STAGE, out / READY)
        _complete(out)
    except OSError as error:
        raise _unwritable(out, error) from error


def _complete(out: Path) -> None:
    """Moves results that are ready to their places, and at last their marker; the folder must be locked."""
    ready = out / READY
    if (ready / GONE).is_file():
        gone = (ready / GONE).read_text(encoding="utf-8").split()
        for name in RESULTS:
            if os.path.lexists(ready / name) or name in gone:
                remove(out / name)
            if os.path.lexists(ready / name):
                os.replace(ready / name, out / name)
        with suppress(FileNotFoundError):  # moved already
            os.replace(ready / Path(files.RUN_MARKER).name, out / files.RUN_MARKER)
    remove(ready)


def complete_interrupted(out: Path) -> None:
    """Completes a finished run that was killed while its results took their places; call it before the run is read."""
    if (out / READY).exists():
        with _staged(out):
            pass  # as every command that writes does


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError("E-OUTPUT-UNWRITABLE", f"output folder {out}: {error.strerror or error}; give a writable folder")


def remove(path: Path) -> None:
    """Removes a file, a folder with all its content, or a link, but never the target of a link."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.is_dir():
        shutil.rmtree(path)


def files_below(folder: Path) -> Iterator[str]:
    """Yields the paths of all files and links below a folder, with forward slashes; links are not followed."""
    for place, folders, names in os.walk(folder):
        for name in (*names, *(below for below in folders if os.path.islink(os.path.join(place, below)))):
            yield (Path(place) / name).relative_to(folder).as_posix()


def frames_folder(out: str | Path) -> Path:
    """Returns the folder of the frames of a video, in the folder of a run."""
    return Path(out) / files.CACHE / "frames"


def require_ours(out: Path) -> None:
    """Raises an error if a folder is neither new, nor empty, nor of an earlier run."""
    if out.exists() and not out.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"output {out}: not a folder; give a new folder with --out")
    _require_no_link(out)
    is_unmarked = out.is_dir() and not (out / files.RUN_MARKER).exists()
    if is_unmarked and any(path.name != files.INTERNAL for path in out.iterdir()):
        fault = f"output folder {out}: not empty and not of an earlier run"
        raise InputError("E-OUTPUT-EXISTS", f"{fault}; give a new folder with --out")


def _require_no_link(out: Path) -> None:
    for name in (files.INTERNAL, files.CACHE, STAGE, READY):
        if (out / name).is_symlink():
            link = f"output folder {out}: {name} in it is a link"
            raise InputError("E-OUTPUT-LINK", f"{link}; remove it, a run writes through none")


def require_run(folder: Path) -> None:
    """Refuses a folder that is not of a run."""
    if not (folder / files.RUN_MARKER).is_file():
        fault = f"run {folder}: not a run's folder (no {files.RUN_MARKER})"
        raise InputError("E-RUN-FOLDER", f"{fault}; give the --out of a finished run")


@dataclass(frozen=True, slots=True)
class Verified:
    """Differences of a run's folder from what the run of ``version`` wrote, as paths below the folder."""

    version: str
    missing: tuple[str, ...]  # files that are gone
    changed: tuple[str, ...]
    added: tuple[str, ...]  # files among the results that the run did not make

    def notes(self, but: tuple[str, ...] = ()) -> list[str]:
        """Returns one note on all files but some that differ, or none."""
        kinds = {kind: [n for n in getattr(self, kind) if n not in but] for kind in ("missing", "changed", "added")}
        clauses = [
            f"{len(names)} {kind} ({names[0]}{' …' * (len(names) > 1)})" for kind, names in kinds.items() if names
        ]
        return [f"the run's folder is not as the run left it: {'; '.join(clauses)}"] if clauses else []


def verify(run: Path) -> Verified:
    """Compares the files of a finished run's folder with the hashes that were kept when it ended. Raises InputError:
    not a run's folder, or one without hashes."""
    require_run(run)
    complete_interrupted(run)
    content = read_json(run / files.RUN_MARKER, "run", AGAIN)
    with as_written(f"run {run / files.RUN_MARKER}"):
        marker = checked(content, MarkerFile)
    if marker.sha256 is None:
        fault = f"run {run}: no hashes in {files.RUN_MARKER}, it is unfinished or of another version"
        raise InputError("E-RUN-UNFINISHED", f"{fault} (stcal {marker.version}); run it again")
    present = {name for name in files_below(run) if name == files.RUN_MARKER or name.split("/")[0] in RESULTS}
    known = marker.sha256
    common = known.keys() & present
    now = {name: files.digest_of(run / name) for name in common} | {files.RUN_MARKER: files.own_digest(content)}
    added = (name.encode("utf-8", "backslashreplace").decode() for name in present - known.keys())
    changed = (name for name in common if now[name] != known[name])
    return Verified(marker.version, *(tuple(sorted(names)) for names in (known.keys() - present, changed, added)))
