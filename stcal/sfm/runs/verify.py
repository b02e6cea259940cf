"""Verification that a run's folder holds what the run wrote: ``verify``."""

from collections.abc import Collection, Sequence
from typing import Literal

from pydantic import Field

import stcal
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import ADDED, CACHE, READY, RUN_MARKER, UNFINISHED, digest_of, own_digest
from stcal.io.json import ResultFile, checked, read_json
from stcal.sfm.runs.saved import AnyRun, folder_of
from stcal.sfm.runs.transaction import (
    DATABASE_SIDES,
    RESULTS,
    MarkerFile,
    complete_interrupted,
    files_below,
)

SHOWN = 20
"""Number of files of a kind that are listed on the terminal."""
NO_RESULTS = (CACHE, UNFINISHED, ADDED, READY)
OWN = (*RESULTS, *(f"database.db{side}" for side in DATABASE_SIDES))
"""Entries of the folder in which a foreign file would be taken for a result, or would change one."""
AGAIN = "run it again"
FAULTS = ("missing", "changed", "added")


class VerifyFile(ResultFile):
    """Result of ``verify``."""

    format: Literal["stcal verify 1"] = Field(description="the file's form and its version")
    run: str = Field(description="the folder")
    version: str = Field(description="of stcal that made it")
    stcal: str = Field(description="version that verified it")
    files: int = Field(description="of the results, whose hashes are kept in `stcal-run.json`")
    missing: list[str] = Field(description="paths below the folder of files that are gone")
    changed: list[str] = Field(description="whose content is another, or in whose place is no file")
    added: list[str] = Field(description="that the run did not make, among its results")
    beside: list[str] = Field(description="that lie beside the results; nothing is wrong with these")
    whole: bool = Field(description="whether nothing is missing, changed or added")

    def said(self, but: Collection[str] = ()) -> list[str]:
        """Returns one note if files of the run are missing, changed or added, for results that are made of all files
        ``but`` some."""
        kinds = {kind: [name for name in getattr(self, kind) if name not in but] for kind in FAULTS}
        faults = self.model_copy(update=kinds).faults()
        return [f"the run's folder is not as the run left it: {'; '.join(faults)}"] if any(kinds.values()) else []

    def faults(self) -> list[str]:
        """Returns the faults, one clause each; none for a whole run of this version."""
        kinds = {kind: getattr(self, kind) for kind in FAULTS}
        clauses = [
            f"{len(names)} {kind} ({names[0]}{' …' * (len(names) > 1)})" for kind, names in kinds.items() if names
        ]
        return clauses + [f"made by stcal {self.version}, this is {self.stcal}"] * (self.version != self.stcal)


@require_arguments
def verify(run: AnyRun) -> VerifyFile:
    """Compares the hashes of all files of a finished run with those that were kept when it ended.

    Nothing is written, and files may be damaged.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.

    Returns
    -------
    VerifyFile
        Names of the files that are ``missing``, ``changed`` or ``added``; ``whole`` if there are none.

    Raises
    ------
    InputError
        Not a run's folder, or one without hashes: unfinished, or of a version that kept none.
    """
    run = folder_of(run)
    if not (run / RUN_MARKER).is_file():
        raise InputError(
            "E-RUN-FOLDER", f"run {run}: not a run's folder (no {RUN_MARKER}); give the --out of a finished run"
        )
    complete_interrupted(run)
    before = digest_of(run / RUN_MARKER)
    content = read_json(run / RUN_MARKER, "run", AGAIN)
    try:
        marker = checked(content, MarkerFile)
    except InputError as error:
        raise InputError(
            "E-RUN-DAMAGED", f"run {run / RUN_MARKER}: damaged, or of another version ({error}); {AGAIN}"
        ) from error
    if marker.sha256 is None:
        raise InputError(
            "E-RUN-UNFINISHED",
            f"run {run}: no hashes in {RUN_MARKER}, it is unfinished or of a version that kept none "
            f"(stcal {marker.version}); {AGAIN}",
        )
    present = {name for name in files_below(run) if name.split("/")[0] not in NO_RESULTS}
    missing = sorted(marker.sha256.keys() - present)
    changed = sorted(
        name
        for name, known in marker.sha256.items()
        if name in present and known != (own_digest(content) if name == RUN_MARKER else digest_of(run / name))
    )
    if digest_of(run / RUN_MARKER) != before:
        raise InputError("E-RUN-REPLACED", f"run {run}: its results were replaced meanwhile; verify it again")
    others = sorted(_printable(name) for name in present - marker.sha256.keys())
    added = [name for name in others if name.split("/")[0] in OWN]
    return VerifyFile(
        format="stcal verify 1",
        run=str(run),
        version=marker.version,
        stcal=stcal.__version__,
        files=len(marker.sha256),
        missing=missing,
        changed=changed,
        added=added,
        beside=[name for name in others if name not in added],
        whole=not (missing or changed or added),
    )


def verified_text(result: VerifyFile) -> str:
    """Returns the result as text, one file per line."""
    lines = [f"{result.files} files by stcal {result.version}: {'whole' if result.whole else 'not whole'}"]
    for kind in ("missing", "changed", "added", "beside"):
        lines += _listed(kind, getattr(result, kind))
    return "\n".join(lines)


def require_whole(result: VerifyFile) -> None:
    """Refuses a run that is not as it ended, or that was made by another version.

    Raises
    ------
    InputError
        The run has faults; the message names them in one line.
    """
    if faults := result.faults():
        remedy = "verify it with that version" if result.whole else "take a copy that is whole"
        raise InputError("E-RUN-CHANGED", f"run {result.run}: {'; '.join(faults)}; {AGAIN}, or {remedy}")


def _listed(kind: str, names: Sequence[str]) -> list[str]:
    surplus = [f"{kind}: and {len(names) - SHOWN} more"] if len(names) > SHOWN else []
    return [f"{kind}: {name}" for name in names[:SHOWN]] + surplus


def _printable(name: str) -> str:
    """Returns a name that may not be UTF-8 as text that is."""
    return name.encode("utf-8", "backslashreplace").decode()
