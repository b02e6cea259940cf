"""Export of the database for other versions of COLMAP: it is checked, and copied into that version's schema."""

import os
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.io.images import name_fault
from stcal.sfm.interop.schema import SCHEMAS, SOURCE, Column, Index, Reference, Schema, SchemaTable, find_schema
from stcal.sfm.mapping.database import colmap_camera, from_colmap_px, image_ids, match_labels
from stcal.sfm.mapping.models import KEYPOINT_TOLERANCE_PX, parameter_count
from stcal.sfm.mapping.pairs import image_graph, kind_of_graph
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run

PAIR_BASE = 2**31 - 1
"""Factor of the smaller image id in a pair's id, to which the larger one is added (COLMAP's ``kMaxNumImages``)."""
KEYPOINT_COLUMNS = (2, 4, 6)
"""Possible numbers of columns: x, y, and then nothing, scale and angle, or an affine shape."""
REAL = 8
MATRICES = {
    "two_view_geometries": {"F": 9, "E": 9, "H": 9, "qvec": 4, "tvec": 3},
    "pose_priors": {"position": 3, "position_covariance": 9, "gravity": 3},
    "rig_sensors": {"sensor_from_rig": 7},
}
"""Count of numbers in blobs that may also be empty, by table and column."""
PAIRED = ("matches", "two_view_geometries")


def damaged(path: Path, sign: str) -> InputError:
    """Returns the error of a damaged database."""
    return InputError("E-RUN-DAMAGED", f"{path}: damaged ({sign}); make the run again")


def require_whole(database: Path, copy: sqlite3.Connection) -> None:
    """Checks every name, blob and reference of the ``copy`` of a database, in our schema."""
    for fault in _faults(copy):
        raise damaged(database, fault)


def _faults(copy: sqlite3.Connection) -> Iterator[str]:
    for table, row, parent, _ in copy.execute("PRAGMA foreign_key_check"):
        yield f"row {row} of {table} refers to one that is not in {parent}"
    for image, name in copy.execute("SELECT image_id, name FROM images"):
        fault = name_fault(name) if isinstance(name, str) else "not a text"
        if fault:
            yield f"image {image}: name {str(name)[:80]!r}: {fault}"
    for camera, model, params in copy.execute("SELECT camera_id, model, params FROM cameras"):
        needed = REAL * parameter_count(model)
        if _size(params) != needed:
            yield f"camera {camera}: params of {_told(params)}, {needed} bytes needed for model {model}"
    for table, value, allowed in (
        ("keypoints", np.dtype(np.float32), KEYPOINT_COLUMNS),
        ("descriptors", np.dtype(np.uint8), None),
        ("matches", np.dtype(np.uint32), (2,)),
        ("two_view_geometries", np.dtype(np.uint32), (2,)),
    ):
        yield from _faulty_matrices(copy, table, value.itemsize, allowed)
    for table, columns in MATRICES.items():
        for column, numbers in columns.items():
            rows = copy.execute(f"SELECT rowid, {column} FROM {table} WHERE length({column}) > 0")
            for row, blob in rows:
                if _size(blob) != REAL * numbers:
                    yield f"{table} {row}: {column} of {_told(blob)}, {REAL * numbers} bytes or none needed"
    yield from _faulty_pairs(copy)


def _faulty_matrices(copy: sqlite3.Connection, table: str, width: int, allowed: Sequence[int] | None) -> Iterator[str]:
    """Yields the faults of rows whose ``data`` is not rows × cols numbers of ``width`` bytes."""
    key = copy.execute(f"SELECT name FROM pragma_table_info('{table}')").fetchone()[0]
    for row, rows, cols, data in copy.execute(f"SELECT {key}, rows, cols, data FROM {table}"):
        if not (isinstance(rows, int) and isinstance(cols, int) and rows >= 0 and cols >= 0):
            yield f"{table} {row}: {rows!r} × {cols!r} values, whole numbers needed"
        elif rows and allowed and cols not in allowed:
            yield f"{table} {row}: {cols} columns, {' or '.join(map(str, allowed))} needed"
        elif _size(data) != rows * cols * width:
            yield f"{table} {row}: data of {_told(data)}, {rows}×{cols}×{width} bytes needed"


def _faulty_pairs(copy: sqlite3.Connection) -> Iterator[str]:
    """Yields the faults of pairs of images or keypoints that do not exist."""
    count = dict(copy.execute("SELECT image_id, rows FROM keypoints"))
    images = {image for (image,) in copy.execute("SELECT image_id FROM images")}
    for table in PAIRED:
        for first, second, matches in _matches(copy, table):
            if not (first in images and second in images and first < second):
                yield f"{table}: a pair of images {first} and {second}, two images of the database needed"
            beyond = matches.max(axis=0, initial=-1) >= [count.get(first, 0), count.get(second, 0)]
            if beyond.any():
                yield f"{table}: images {first} and {second}: a keypoint beyond the last is matched"


def _matches(copy: sqlite3.Connection, table: str) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yields the ids of two images, and their matched keypoints (n, 2)."""
    for pair, data in copy.execute(f"SELECT pair_id, data FROM {table}"):
        yield pair // PAIR_BASE, pair % PAIR_BASE, np.frombuffer(data or b"", np.uint32).reshape(-1, 2).astype(int)


def _size(blob: object) -> int:
    """Returns the number of bytes of a blob; −1 for a value of another kind."""
    return len(blob) if isinstance(blob, bytes) else 0 if blob is None else -1


def _told(blob: object) -> str:
    return "another kind" if _size(blob) < 0 else f"{_size(blob)} bytes"


def require_of_run(database: Path, copy: sqlite3.Connection, run: SavedRun) -> None:
    """Checks that a whole database holds the run's camera, images, centres, and the matches of their labels."""
    ids = image_ids(run.observations)
    for faults in (_other_camera(copy, run), _other_keypoints(copy, run, ids), _other_matches(copy, run, ids)):
        for fault in faults:
            raise InputError("E-RUN-DATABASE", f"{database}: {fault}; run again")


def _other_camera(copy: sqlite3.Connection, run: SavedRun) -> Iterator[str]:
    camera = colmap_camera(run.camera)
    wanted = (camera.model.value, camera.width, camera.height, np.asarray(camera.params, float).tobytes())
    if copy.execute("SELECT model, width, height, params FROM cameras").fetchall() != [wanted]:
        yield f"its camera is not that of {run.folder / 'cameras.txt'}"


def _other_keypoints(copy: sqlite3.Connection, run: SavedRun, ids: dict[str, int]) -> Iterator[str]:
    """Yields the images whose keypoints are not the labelled centres of the image of that name."""
    names = dict(copy.execute("SELECT name, image_id FROM images"))
    keypoints = {image: content for image, *content in copy.execute("SELECT image_id, cols, data FROM keypoints")}
    labels = f"not those of {run.folder / 'labels.csv'}"
    for image, expected in zip(run.observations, run.corrected_px, strict=True):
        cols, data = keypoints.get(ids[image.name], (2, b""))
        xy = from_colmap_px(np.frombuffer(data or b"", np.float32).reshape(-1, cols or 2)[:, :2])
        if names.get(image.name) != ids[image.name] or len(xy) != len(expected):
            yield f"its keypoints of {image.name} are {labels}"
        off_px = np.abs(xy - expected).max(initial=0)
        if not off_px <= KEYPOINT_TOLERANCE_PX:
            off = f"up to {off_px:.3g} px off, {KEYPOINT_TOLERANCE_PX:g} allowed"
            yield f"its keypoints of {image.name} are {labels} ({off})"
    if len(names) > len(ids):
        unknown = next(name for name in names if name not in ids)
        yield f"its images, with {unknown}, are {labels}"


def _other_matches(copy: sqlite3.Connection, run: SavedRun, ids: dict[str, int]) -> Iterator[str]:
    """Yields the pairs that do not match circles of the same label, and tables of a small set that lack a pair."""
    images = {ids[image.name]: image for image in run.observations}
    all_pairs = kind_of_graph(len(run.observations)) == "all"
    graph = image_graph(run.observations, run.board_design, "all") if all_pairs else None
    wanted = set() if graph is None else {(i + 1, j + 1) for i, j in graph.pairs.tolist()}
    for table in PAIRED:
        pairs = set()
        for first, second, matches in _matches(copy, table):
            pairs.add((first, second))
            a, b = images[first], images[second]
            if not np.array_equal(matches, match_labels(a, b)):
                wrong = [f"{a.labels[i]} with {b.labels[j]}" for i, j in matches.tolist() if a.labels[i] != b.labels[j]]
                fault = f"match {wrong[0]}" if wrong else "do not match all that have the same label"
                yield f"{table}: {a.name} and {b.name} {fault}"
        if all_pairs and pairs != wanted:
            needed = f"the {len(wanted)} of {run.folder / 'labels.csv'} needed"
            yield f"{table}: {len(pairs)} pairs of images, {needed}"


HEADER = b"SQLite format 3\0"
WAL_MODE = b"\2\2"
"""Bytes 18 and 19 of a database in write-ahead-log mode."""
SIDE_FILES = ("-wal", "-shm", "-journal")
CAMERA_SENSOR = 0
"""COLMAP's number of the sensor type camera."""


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
    """Copies the database of a run for another version of COLMAP; ids, orders and values stay.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : str or Path
        New file; it appears complete and checked, or not at all.
    schema : str
        Version of COLMAP that is to open it: ``3.8`` to ``4.2``.

    Returns
    -------
    Exported
        ``path``, name of the ``schema``, and counts of ``images`` and ``pairs``.

    Raises
    ------
    InputError
        The schema is unknown; ``out`` exists or cannot be written; the database is in use, damaged, of another version
        or not as the run left it; or it holds something that has no place in the schema.
    StcalError
        The written copy differs from the database or the schema.
    """
    run = saved_run(run)
    return copy_database(run.database, Path(out), schema, run)


def copy_database(database: Path, out: Path, schema: str, run: SavedRun | None = None) -> Exported:
    """Writes the content of ``database`` to ``out`` in the schema of another COLMAP version; ids, order and blobs stay.
    All of it must be valid and, with ``run``, of the run's labels. ``out`` is compared with both before it appears."""
    database, out = Path(database), Path(out)
    wanted = find_schema(schema)
    if os.path.lexists(out):
        raise _exists(out)
    if not out.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: no folder {out.parent}; make it, or give another place")
    with closing(_open_unchanged(database)) as source, closing(sqlite3.connect("")) as copy:
        _copy(database, source, copy)
        _require_expressible(database, copy, wanted)
        require_whole(database, copy)
        if run is not None:
            require_of_run(database, copy, run)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
            partial = Path(scratch) / out.name
            try:
                _write(copy, partial, wanted)
            except sqlite3.Error as error:
                raise InputError(
                    "E-OUTPUT-UNWRITABLE", f"{out}: cannot be written ({error}); check the folder's space and rights"
                ) from error
            with closing(_open_unchanged(partial)) as written:
                _require_schema(written, wanted)
                _require_same_content(source, written, wanted)
            _publish(partial, out)
        return _summary(copy, out, wanted)


def read_tables(connection: sqlite3.Connection) -> dict[str, SchemaTable]:
    """Returns the tables of a database as SQLite describes them, by name."""
    listing = "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
    return {name: _read_table(connection, name, sql) for name, sql in connection.execute(listing).fetchall()}


def _read_table(connection: sqlite3.Connection, name: str, sql: str) -> SchemaTable:
    def pragma(what: str, columns: str, of: str = name) -> list[tuple]:
        return connection.execute(f"SELECT {columns} FROM pragma_{what}(?)", (of,)).fetchall()

    references = pragma("foreign_key_list", '"from", "table", on_delete')
    indices = pragma("index_list", "name, origin")
    check = re.search(r"CHECK\s*\((.*?)\)", sql)
    return SchemaTable(
        name,
        tuple(
            Column(column, kind, bool(not_null), bool(key), default)
            for column, kind, not_null, key, default in pragma("table_info", 'name, type, "notnull", pk, dflt_value')
        ),
        frozenset(Reference(column, to, rule == "CASCADE") for column, to, rule in references),
        frozenset(
            Index(index if origin == "c" else None, tuple(column for (column,) in pragma("index_info", "name", index)))
            for index, origin in indices
        ),
        "AUTOINCREMENT" in sql,
        check[1] if check else None,
    )


def _open_unchanged(path: Path) -> sqlite3.Connection:
    """Opens a database for reading, without any trace. Beside one in WAL mode SQLite makes side files even for a
    reader. ``immutable`` prevents it; it also skips the locks, which in WAL mode nobody holds while there are no side
    files."""
    try:
        with path.open("rb") as stream:
            header = stream.read(20)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{path}: {error.strerror or error}; give a readable database") from error
    if not header.startswith(HEADER):
        raise damaged(path, "not an SQLite database")
    beside = [name for name in (f"{path.name}{suffix}" for suffix in SIDE_FILES) if path.with_name(name).exists()]
    if beside:
        raise _in_use(path, f"{', '.join(beside)} beside it")
    unlocked = "&immutable=1" if header[18:20] == WAL_MODE else ""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{unlocked}", uri=True, timeout=0)


def _copy(database: Path, source: sqlite3.Connection, copy: sqlite3.Connection) -> None:
    """Copies all pages of ``source`` in one step, and checks them."""
    try:
        source.execute("BEGIN")
        source.execute(
            "SELECT 1 FROM sqlite_master"
        ).fetchone()  # takes the read lock, for which a backup would wait for ever
        source.backup(copy)
        faults = [fault for (fault,) in copy.execute("PRAGMA integrity_check(1)") if fault != "ok"]
        differences = table_differences(read_tables(copy), SOURCE)
    except sqlite3.DatabaseError as error:
        if error.sqlite_errorcode in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise _in_use(database, str(error)) from error
        raise damaged(database, str(error)) from error
    if faults:
        raise damaged(database, faults[0])
    if differences:
        raise damaged(database, f"not as COLMAP {SOURCE.name} writes it: {differences[0]}")


def _in_use(path: Path, sign: str) -> InputError:
    return InputError("E-FILE-IN-USE", f"{path}: in use by another program ({sign}); close it, or make the run again")


def table_differences(found: dict[str, SchemaTable], wanted: Schema) -> list[str]:
    """Returns the differences of the tables ``found`` from the schema, table by table and column by column."""
    names = [*wanted.tables, *(name for name in found if name not in wanted.tables)]
    return [line for name in names for line in _differences(name, found.get(name), wanted.tables.get(name))]


def _differences(name: str, found: SchemaTable | None, wanted: SchemaTable | None) -> list[str]:
    if found is None or wanted is None:
        return [f"table {name} is {'missing' if found is None else 'not in the schema'}"]
    lines = [
        f"table {name} has {theirs or 'no column'} in place of {ours or 'no column'}"
        for theirs, ours in zip_longest(found.columns, wanted.columns)
        if theirs != ours
    ]
    if not lines and found != wanted:
        lines.append(f"table {name} has other constraints: {found.statements()} in place of {wanted.statements()}")
    return lines


def _require_expressible(database: Path, copy: sqlite3.Connection, wanted: Schema) -> None:
    """Raises InputError for the first content of the database that has no place in the schema."""
    for what, since in _inexpressible(copy, wanted):
        remedy = f"give --schema {since} or later" if since else "no version known here has it"
        raise InputError("E-SCHEMA-NO-PLACE", f"{database}: {what}: schema {wanted.name} has no place for it; {remedy}")


def _inexpressible(copy: sqlite3.Connection, wanted: Schema) -> Iterator[tuple[str, str | None]]:
    """Yields content that has no place in the schema, and the first later schema with a place for it."""
    yield from _unknown(copy, wanted, "camera", "cameras", "model", "camera_models")
    yield from _unknown(copy, wanted, "pair", "two_view_geometries", "config", "pair_configurations")
    yield from _unknown(copy, wanted, "image", "descriptors", "type", "descriptor_types")
    priors = _count(copy, "SELECT 1 FROM pose_priors")
    if priors and wanted.tables.get("pose_priors") != SOURCE.tables["pose_priors"]:
        yield f"{priors} pose priors; they are of another kind there", "4.0"
    pairs = _count(copy, "SELECT 1 FROM two_view_geometries WHERE camera1 NOT NULL OR camera2 NOT NULL")
    if pairs and "camera1" not in wanted.tables["two_view_geometries"].column_names():
        yield f"{pairs} pairs of images with cameras of their own", "4.2"
    if "rigs" not in wanted.tables:
        for fault in _own_rigs(copy):
            yield fault, "3.12"


def _unknown(
    copy: sqlite3.Connection, wanted: Schema, what: str, table: str, column: str, enumeration: str
) -> Iterator[tuple[str, str | None]]:
    """Yields the numbers in ``column`` that have no meaning in the schema."""
    key = SOURCE.tables[table].columns[0].name
    meanings = getattr(wanted, enumeration)
    for first, number in copy.execute(f"SELECT min({key}), {column} FROM {table} GROUP BY {column}"):
        if number not in meanings:
            having = (name for name, schema_with in SCHEMAS.items() if number in getattr(schema_with, enumeration))
            name = getattr(SOURCE, enumeration).get(number, "unknown")
            yield f"{what} {first} with {column} {number} ({name})", next(having, None)


def _own_rigs(copy: sqlite3.Connection) -> Iterator[str]:
    """Yields what shows that not every rig is one camera and every frame one image, as versions after 3.11 make of
    older databases."""
    if sensors := _count(copy, "SELECT 1 FROM rig_sensors"):
        yield f"a rig of more than one sensor ({sensors} beside the first)"
    if rigs := _count(
        copy,
        "SELECT 1 FROM rigs WHERE ref_sensor_type <> :camera OR rig_id <> ref_sensor_id"
        " OR ref_sensor_id NOT IN (SELECT camera_id FROM cameras)",
    ):
        yield f"{rigs} rigs that are not each one camera of the same id"
    if frames := _count(
        copy,
        "SELECT frame_id FROM frames LEFT JOIN frame_data USING (frame_id) LEFT JOIN images ON image_id = data_id"
        " GROUP BY frame_id HAVING count(*) <> 1 OR sensor_type IS NOT :camera OR frame_id IS NOT image_id"
        " OR sensor_id IS NOT camera_id OR rig_id IS NOT camera_id"
        " UNION ALL SELECT image_id FROM images WHERE image_id NOT IN (SELECT frame_id FROM frames)",
    ):
        yield f"{frames} frames that are not each one image of the same id"


def _count(connection: sqlite3.Connection, select: str) -> int:
    (number,) = connection.execute(f"SELECT count(*) FROM ({select})", {"camera": CAMERA_SENSOR}).fetchone()
    return number


def _shared_columns(table: SchemaTable) -> str:
    """Returns the columns that the table shares with our own database, as SQL."""
    return ", ".join(name for name in table.column_names() if name in SOURCE.tables[table.name].column_names())


def _rows(connection: sqlite3.Connection, table: SchemaTable) -> sqlite3.Cursor:
    return connection.execute(f"SELECT {_shared_columns(table)} FROM {table.name} ORDER BY rowid")


def _write(copy: sqlite3.Connection, path: Path, wanted: Schema) -> None:
    """Writes a new file in rollback-journal mode, which is a single file that any program opens."""
    with closing(sqlite3.connect(path)) as out, out:
        for table in wanted.tables.values():
            for statement in table.statements():
                out.execute(statement)
        for table in wanted.tables.values():
            columns = _shared_columns(table)
            places = ", ".join("?" for _ in columns.split(", "))
            out.executemany(f"INSERT INTO {table.name} ({columns}) VALUES ({places})", _rows(copy, table))
        out.execute(f"PRAGMA user_version = {wanted.user_version}")


def _require_schema(written: sqlite3.Connection, wanted: Schema) -> None:
    differences = table_differences(read_tables(written), wanted)
    (version,) = written.execute("PRAGMA user_version").fetchone()
    if version != wanted.user_version:
        differences.append(f"user_version is {version} in place of {wanted.user_version}")
    if differences:
        raise StcalError(
            "E-EXPORT-READ-BACK", f"export for {wanted.name}: {differences[0]}; nothing is written; please report this"
        )


def _require_same_content(source: sqlite3.Connection, written: sqlite3.Connection, wanted: Schema) -> None:
    """Compares every value with our own database, and checks that columns it does not have are empty."""
    for table in wanted.tables.values():
        for row, (ours, theirs) in enumerate(zip_longest(_rows(source, table), _rows(written, table)), start=1):
            if ours != theirs:
                raise StcalError(
                    "E-EXPORT-READ-BACK",
                    f"export for {wanted.name}: row {row} of {table.name} differs from the database; nothing is "
                    "written; check that no other program uses the database, and try again",
                )
        for name in table.column_names():
            if name not in SOURCE.tables[table.name].column_names():
                filled = _count(written, f"SELECT 1 FROM {table.name} WHERE {name} NOT NULL")
                if filled:
                    raise StcalError(
                        "E-EXPORT-LOST",
                        f"export for {wanted.name}: {table.name}.{name} is not empty in {filled} rows",
                    )


def _publish(partial: Path, out: Path) -> None:
    """Gives the finished file its name by a link, which never overwrites a file that appeared meanwhile."""
    try:
        os.link(partial, out)
    except FileExistsError as error:
        raise _exists(out) from error
    except OSError:  # the file system has no hard links
        if os.path.lexists(out):
            raise _exists(out) from None
        partial.rename(out)


def _exists(out: Path) -> InputError:
    return InputError("E-OUTPUT-EXISTS", f"{out}: exists, and is not overwritten; move it away, or give another name")


def _summary(copy: sqlite3.Connection, out: Path, wanted: Schema) -> Exported:
    models = copy.execute("SELECT DISTINCT model FROM cameras ORDER BY model").fetchall()
    return Exported(
        out,
        wanted.name,
        _count(copy, "SELECT 1 FROM images"),
        _count(copy, "SELECT 1 FROM two_view_geometries"),
        tuple(wanted.camera_models[model] for (model,) in models),
    )
