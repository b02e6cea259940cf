"""Comparison of a run's files with the hashes that the run stored at its end."""

from dataclasses import dataclass

from stcal.errors import InputError
from stcal.io.files import RUN_MARKER, digest_of, own_digest
from stcal.io.json import checked, read_json
from stcal.sfm.runs.marker import MarkerFile
from stcal.sfm.runs.saved import AnyRun, folder_of
from stcal.sfm.runs.transaction import RESULTS, complete_interrupted, files_below


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


def verify(run: AnyRun) -> Verified:
    """Compares the files of a finished run with the hashes that were kept when it ended.

    Raises InputError: not a run's folder, or one without hashes.
    """
    run = folder_of(run)
    if not (run / RUN_MARKER).is_file():
        raise InputError(
            "E-RUN-FOLDER", f"run {run}: not a run's folder (no {RUN_MARKER}); give the --out of a finished run"
        )
    complete_interrupted(run)
    content = read_json(run / RUN_MARKER, "run", "run it again")
    try:
        marker = checked(content, MarkerFile)
    except InputError as error:
        raise InputError(
            "E-RUN-DAMAGED", f"run {run / RUN_MARKER}: damaged, or of another version ({error}); run it again"
        ) from error
    if marker.sha256 is None:
        raise InputError(
            "E-RUN-UNFINISHED",
            f"run {run}: no hashes in {RUN_MARKER}, it is unfinished or of another version (stcal {marker.version}); "
            "run it again",
        )
    present = {name for name in files_below(run) if name == RUN_MARKER or name.split("/")[0] in RESULTS}
    changed = [
        name
        for name, known in marker.sha256.items()
        if name in present and known != (own_digest(content) if name == RUN_MARKER else digest_of(run / name))
    ]
    added = (name.encode("utf-8", "backslashreplace").decode() for name in present - marker.sha256.keys())
    missing = marker.sha256.keys() - present
    return Verified(marker.version, tuple(sorted(missing)), tuple(sorted(changed)), tuple(sorted(added)))
