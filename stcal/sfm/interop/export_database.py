"""Export of the database for other versions of COLMAP: written anew from the run's labels, in that version's schema."""

import os
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.sfm.interop.export_content import require_new
from stcal.sfm.interop.schema import Schema, find_schema
from stcal.sfm.mapping.database import write_database
from stcal.sfm.mapping.pairs import image_graph
from stcal.sfm.runs.run_result import AnyRun, SavedRun
from stcal.sfm.runs.saved import saved_run


@dataclass(frozen=True, slots=True)
class Exported:
    """Summary of an exported database."""

    path: Path
    schema: str
    images: int
    pairs: int  # of images with a two-view geometry
    camera_models: tuple[str, ...]  # COLMAP's names


@require_arguments
def export_database(run: AnyRun, out: str | Path, schema: str) -> Exported:
    """Writes the database of a run for another version of COLMAP, with the same ids, orders and values.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : str or Path
        New file; it appears complete or not at all.
    schema : str
        Version of COLMAP that is to open it: ``3.8`` to ``4.2``.

    Raises
    ------
    InputError
        The schema is unknown, or ``out`` exists or cannot be written.
    """
    run, out, wanted = saved_run(run), Path(out), find_schema(schema)
    require_new(out)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
        partial = Path(scratch) / out.name
        pairs = write_copy(run, partial, wanted)
        try:
            os.link(partial, out)  # which never overwrites a file that appeared meanwhile
        except OSError:  # that, or the file system has no hard links
            require_new(out)
            partial.rename(out)
    return Exported(out, wanted.name, len(run.observations), pairs, (run.camera.colmap_model,))


def write_copy(run: SavedRun, path: Path, wanted: Schema) -> int:
    """Writes a new database of a run's images and labels; returns the number of its pairs.

    It is in rollback-journal mode, which is a single file that any program opens.
    """
    own = path.with_name(f"own-{path.name}")
    pairs = image_graph(run.observations, run.board_design).pairs
    write_database(own, run.camera, run.observations, pairs, run.corrected_px)
    try:
        with closing(sqlite3.connect(path)) as copy, copy:
            for statement in wanted.statements():
                copy.execute(statement)
            copy.commit()
            copy.execute("ATTACH ? AS own", (str(own),))
            for table in wanted.tables:
                theirs, ours = (
                    [name for _, name, *_ in copy.execute(f"PRAGMA {database}.table_info({table})")]
                    for database in ("main", "own")
                )
                columns = ", ".join(name for name in theirs if name in ours)
                copy.execute(f"INSERT INTO {table} ({columns}) SELECT {columns} FROM own.{table} ORDER BY rowid")
    except sqlite3.Error as error:
        raise InputError(
            "E-OUTPUT-UNWRITABLE", f"{path}: cannot be written ({error}); check the folder's space and rights"
        ) from error
    return len(pairs)
