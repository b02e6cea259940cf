"""The database for other versions of COLMAP: their schema, our content, and nothing done to our own file.

Only native COLMAP 3.8 and pycolmap 4.2 run here. The other schemas are compared with what was published: the data of
``stcal.sfm.interop.schema``, and a checksum of the description of the empty database that each version made when it was
run.
"""

import hashlib
import json
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError, StcalError
from stcal.sfm.interop import export_database as export
from stcal.sfm.interop.export_database import copy_database
from stcal.sfm.interop.schema import SCHEMAS
from stcal.sfm.mapping.incremental import pipeline_options
from tests.outcome import fails_with
from tests.shared import own_copy

PUBLISHED = {
    # First 16 digits of the SHA-256 of described(), recorded from the empty databases of the releases named.
    "3.9": "134164fdb10f3d6d",  # pycolmap 0.6.0 and 0.6.1, both of COLMAP 3.9.1
    "3.10": "59cc8b274258b8fa",  # pycolmap 3.10.0
    "3.11": "ac0d6fc65b124cd1",  # pycolmap 3.11.0 and 3.11.1
    "3.12": "86926880cabfe359",  # pycolmap 3.12.0 and 3.12.6
    "3.13": "86926880cabfe359",  # pycolmap 3.13.0
    "4.0": "ecd8940950a65b20",  # pycolmap 4.0.0 and 4.0.4; 4.1.0 and 4.1.1 differ in user_version only
}
PATCHES = 10_000
"""Of ``user_version`` from 4.0 on, the part that tells major and minor is a multiple of this."""


def read_only(path):
    return closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True))


def described(path) -> list[str]:
    """A database in SQLite's words: columns, keys, indices and conditions by table, and the stamp."""
    with read_only(path) as database:
        lines = []
        tables = "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name <> 'sqlite_sequence' ORDER BY name"
        for table, sql in database.execute(tables).fetchall():
            facts = [("column", *row) for row in database.execute(f"PRAGMA table_info({table})")]
            facts += sorted(("key", *row[2:]) for row in database.execute(f"PRAGMA foreign_key_list({table})"))
            for _, index, *kind in sorted(database.execute(f"PRAGMA index_list({table})").fetchall(), key=str):
                facts.append(("index", index, *kind, *database.execute(f"PRAGMA index_info({index})").fetchall()))
            facts += [("check", *re.findall(r"CHECK *\((.*?)\)", sql)), ("counts up", "AUTOINCREMENT" in sql)]
            lines += [f"{table}: {fact}" for fact in facts]
        (stamp,) = database.execute("PRAGMA user_version").fetchone()
    return [*sorted(lines), f"user_version {stamp // PATCHES * PATCHES if stamp >= PATCHES else stamp}"]


def rows_of(path, table, columns) -> list[tuple]:
    """Rows in stored order, with the type of every value."""
    kinds = ", ".join(f"typeof({column})" for column in columns)
    with read_only(path) as database:
        return database.execute(f"SELECT {', '.join(columns)}, {kinds} FROM {table} ORDER BY rowid").fetchall()


def columns_of(path) -> dict[str, list[str]]:
    with read_only(path) as database:
        names = [n for (n,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()]
        return {n: [row[1] for row in database.execute(f"PRAGMA table_info({n})")] for n in names if "sqlite" not in n}


def state_of(folder) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


@pytest.fixture
def database(small_run, tmp_path):
    (tmp_path / "run").mkdir()
    return own_copy(small_run / "colmap/database.db", tmp_path / "run")


def change(database, *statements) -> None:
    with closing(sqlite3.connect(database)) as opened, opened:
        for statement in statements:
            opened.execute(statement)


DESCRIBE = "INSERT INTO descriptors SELECT image_id, {type}, rows, 128, randomblob(128 * rows) FROM keypoints"


@pytest.fixture
def full_database(database):
    """With all that every version can hold: descriptors, matrices, keypoints of six columns."""
    change(
        database,
        DESCRIBE.format(type=0),
        "UPDATE keypoints SET cols = 6, data = randomblob(24 * rows) WHERE image_id > 4",
        "UPDATE two_view_geometries SET F = randomblob(72), E = randomblob(72), qvec = randomblob(32),"
        " tvec = x'' WHERE pair_id IN (SELECT pair_id FROM two_view_geometries LIMIT 3)",
    )
    return database


def empty_database(schema, path) -> None:
    """Made by the program itself, where it runs here."""
    if schema == "4.2":
        pycolmap.Database.open(str(path)).close()
        return
    colmap = native_colmap()
    subprocess.run([colmap, "database_creator", "--database_path", path], check=True, capture_output=True)


def native_colmap() -> str:
    colmap = shutil.which("colmap")
    if colmap is None:
        pytest.skip("native colmap is not on PATH")
    version = subprocess.run([colmap, "help"], capture_output=True, text=True, check=True).stdout
    if not version.startswith("COLMAP 3.8"):
        pytest.skip("native colmap is not 3.8")
    return colmap


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")


@pytest.mark.parametrize("schema", ["3.8", "4.2"])
def test_the_schema_is_what_the_program_itself_makes(schema, small_run, tmp_path):
    """Against an empty database of native COLMAP 3.8 and of pycolmap 4.2, made here and now."""
    empty_database(schema, tmp_path / "empty.db")
    copy_database(small_run / "colmap/database.db", tmp_path / "out.db", schema)
    assert described(tmp_path / "out.db") == described(tmp_path / "empty.db")


@pytest.mark.parametrize("schema", PUBLISHED, ids=[f"{schema} as published, not run here" for schema in PUBLISHED])
def test_the_schema_is_the_published_one(schema, small_run, tmp_path):
    """Against what was recorded when each version was run; the versions themselves are not here."""
    copy_database(small_run / "colmap/database.db", tmp_path / "out.db", schema)
    lines = described(tmp_path / "out.db")
    assert hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16] == PUBLISHED[schema], "\n".join(lines)


@pytest.mark.parametrize("schema", SCHEMAS)
def test_everything_is_kept(schema, full_database, tmp_path):
    """Every row and value, its type and its place; what a version has no column for was empty."""
    written = copy_database(full_database, tmp_path / "out.db", schema)
    assert (written.images, written.pairs, written.camera_models) == (8, 28, ("OPENCV",))
    ours, theirs = columns_of(full_database), columns_of(tmp_path / "out.db")
    for table, columns in theirs.items():
        shared = [column for column in columns if column in ours[table]]
        assert rows_of(tmp_path / "out.db", table, shared) == rows_of(full_database, table, shared)
    assert len(rows_of(tmp_path / "out.db", "keypoints", ["data"])) == 8
    gone = {(table, column) for table in ours for column in ours[table] if column not in theirs.get(table, ())}
    for table, column in gone:
        if table in theirs and table != "pose_priors":
            assert {row[0] for row in rows_of(full_database, table, [column])} <= {None, 0}  # 0: SIFT
    added = {(table, column) for table in theirs for column in theirs[table] if column not in ours[table]}
    for table, column in added:
        assert {row[0] for row in rows_of(tmp_path / "out.db", table, [column])} <= {None}
    assert (tmp_path / "out.db").read_bytes()[18:20] == b"\1\1"  # rollback journal: one file is all of it
    with read_only(tmp_path / "out.db") as opened:
        assert opened.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert opened.execute("PRAGMA foreign_key_check").fetchall() == []


def test_our_database_is_only_read(database, tmp_path, monkeypatch):
    """Its bytes and its folder stay, it is not opened for writing, and what is written comes from a backup of it."""
    opened, backed_up = [], []

    class Watched(sqlite3.Connection):
        def backup(self, target, **options):
            backed_up.append(self)
            super().backup(target, **options)

    def connect(path, **options):
        opened.append(str(path))
        return Watched(path, **options)

    before, since = state_of(database.parent), database.stat().st_mtime_ns
    monkeypatch.setattr(export.sqlite3, "connect", connect)
    for schema in SCHEMAS:
        copy_database(database, tmp_path / f"{schema}.db", schema)
    assert state_of(database.parent) == before
    assert database.stat().st_mtime_ns == since
    own = [path for path in opened if str(database) in path]
    assert len(own) == len(backed_up) == len(SCHEMAS)
    assert all(path.endswith("?mode=ro&immutable=1") for path in own)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["run", *(f"{schema}.db" for schema in SCHEMAS)])


def test_a_database_in_rollback_mode_is_read_with_its_locks(database, tmp_path):
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("PRAGMA journal_mode = DELETE")
    before = state_of(database.parent)
    copy_database(database, tmp_path / "out.db", "3.8")
    assert state_of(database.parent) == before
    assert (tmp_path / "out.db").is_file()


def first_group(run) -> tuple[list[str], tuple[int, int]]:
    """Names of the first group's images, and the ids of its initial pair."""
    pair = json.loads((run / "report.json").read_text())["groups"][0]["pairs"][0]
    with read_only(run / "colmap/database.db") as opened:
        ids = {name: i for i, name in opened.execute("SELECT image_id, name FROM images")}
    group = pair["first"].split("/")[0]
    return [name for name in ids if name.startswith(f"{group}/")], (ids[pair["first"]], ids[pair["second"]])


def mapped(database, folder, names, pair) -> pycolmap.Reconstruction:
    folder.mkdir()
    own = own_copy(database, folder / "database.db")  # pycolmap changes what it opens
    models = pycolmap.incremental_mapping(str(own), str(folder), str(folder), pipeline_options(names, pair))
    assert len(models) == 1
    return models[0]


def points_by_track(model) -> dict[tuple, np.ndarray]:
    return {
        tuple(sorted((element.image_id, element.point2D_idx) for element in point.track.elements)): point.xyz
        for point in model.points3D.values()
    }


def test_pycolmap_makes_the_same_model_of_the_export(small_run, tmp_path):
    """Exactly the same: pycolmap brings the older schema back to its own, and finds the same numbers in it."""
    names, pair = first_group(small_run)
    own = small_run / "colmap/database.db"
    ours = points_by_track(mapped(own, tmp_path / "ours", names, pair))
    assert len(ours) >= 80
    for schema in ("3.8", "3.13"):
        copy_database(own, tmp_path / f"{schema}.db", schema)
        model = mapped(tmp_path / f"{schema}.db", tmp_path / schema, names, pair)
        assert model.num_reg_images() == len(names)
        theirs = points_by_track(model)
        assert theirs.keys() == ours.keys()
        assert all(np.array_equal(ours[track], theirs[track]) for track in ours)


PAIR = "UPDATE two_view_geometries SET {} WHERE pair_id = (SELECT max(pair_id) FROM two_view_geometries)"
SECOND_CAMERA = "INSERT INTO cameras SELECT 2, model, width, height, params, prior_focal_length FROM cameras"
REFUSALS = {
    "EUCM": (["UPDATE cameras SET model = 16, params = zeroblob(48)"], "4.0", "E-SCHEMA-NO-PLACE … 1 … 16", "4.2"),
    "division": (
        ["UPDATE cameras SET model = 12, params = zeroblob(32)"],
        "3.13",
        "E-SCHEMA-NO-PLACE … 1 … 12 … SIMPLE_DIVISION",
        "4.0",
    ),
    "thin prism": (
        ["UPDATE cameras SET model = 11, params = zeroblob(128)"],
        "3.10",
        "E-SCHEMA-NO-PLACE … model 11 (RAD_TAN_THIN_PRISM_FISHEYE)",
        "3.11",
    ),
    "rig pair": ([PAIR.format("config = 9")], "3.12", "E-SCHEMA-NO-PLACE", "3.13"),
    "LoMa": ([DESCRIBE.format(type=3)], "4.0", "E-SCHEMA-NO-PLACE … 1 … 3 … LOMA_B", "4.2"),
    "ALIKED": ([DESCRIBE.format(type=1)], "3.13", "E-SCHEMA-NO-PLACE … 1 … 1 … ALIKED_N16ROT", "4.0"),
    "prior": (
        ["INSERT INTO pose_priors VALUES (1, 1, 1, 0, zeroblob(24), NULL, NULL, 1)"],
        "3.13",
        "E-SCHEMA-NO-PLACE … 1",
        "4.0",
    ),
    "pair camera": ([PAIR.format("camera2 = x'00'")], "4.0", "E-SCHEMA-NO-PLACE … 1", "4.2"),
    "two sensors": (
        [SECOND_CAMERA, "INSERT INTO rig_sensors VALUES (1, 2, 0, NULL)"],
        "3.11",
        "E-SCHEMA-NO-PLACE … 1",
        "3.12",
    ),
    "IMU": (["UPDATE rigs SET ref_sensor_type = 1"], "3.11", "E-SCHEMA-NO-PLACE … 1", "3.12"),
    "frame of two": (
        [
            SECOND_CAMERA,
            "UPDATE frame_data SET frame_id = 1 WHERE data_id = 2",
            "DELETE FROM frames WHERE frame_id = 2",
        ],
        "3.8",
        "E-SCHEMA-NO-PLACE … 2",
        "3.12",
    ),
    "frame without data": (
        ["DELETE FROM frame_data WHERE data_id = 2"],
        "3.9",
        "E-SCHEMA-NO-PLACE … 1 frames that are not",
        "3.12",
    ),
    "image without frame": (
        ["DELETE FROM frame_data WHERE data_id = 2", "DELETE FROM frames WHERE frame_id = 2"],
        "3.10",
        "E-SCHEMA-NO-PLACE … 1 frames that are not",
        "3.12",
    ),
    "other frame ids": (
        ["UPDATE frame_data SET frame_id = 100 + data_id", "UPDATE frames SET frame_id = 100 + frame_id"],
        "3.11",
        "E-SCHEMA-NO-PLACE … 16 frames that are not",
        "3.12",
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_what_has_no_place_is_refused_with_the_version_that_has_it(what, database, tmp_path):
    statements, older, message, newer = REFUSALS[what]
    change(database, *statements)
    with fails_with(message) as refusal:
        copy_database(database, tmp_path / "out.db", older)
    assert f"schema {older} has no place for it; give --schema {newer} or later" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    copy_database(database, tmp_path / "out.db", newer)
    assert (tmp_path / "out.db").is_file()


def test_an_unknown_camera_model_has_no_place_anywhere(database, tmp_path):
    change(database, "UPDATE cameras SET model = 99")
    with fails_with("E-SCHEMA-NO-PLACE … 1 … 99"):
        copy_database(database, tmp_path / "out.db", "4.2")


@pytest.fixture
def refused(tmp_path):
    """The one line of a refused export, after which nothing new lies beside the database or the output."""

    def message(database, schema="3.8", out="out.db", error=InputError) -> str:
        before, beside = state_of(database.parent), state_of(tmp_path)
        with pytest.raises(error) as refusal:
            copy_database(database, tmp_path / out, schema)
        assert state_of(database.parent) == before
        assert state_of(tmp_path) == beside
        assert "\n" not in str(refusal.value)
        return str(refusal.value)

    return message


def test_an_unknown_schema_and_a_folder_that_is_not_there(database, refused):
    assert refused(database, schema="3.7") == (
        "schema 3.7: unknown; give one of 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0, 4.2"
    )
    assert re.search(r"out\.db: no folder .*/none; make it", refused(database, out="none/out.db"))


def test_nothing_is_overwritten(database, refused, tmp_path):
    (tmp_path / "out.db").write_text("mine")
    assert "out.db: exists, and is not overwritten" in refused(database)
    (tmp_path / "link.db").symlink_to(tmp_path / "nowhere")
    assert "link.db: exists" in refused(database, out="link.db")
    assert "exists" in refused(database, out="run/database.db")
    assert "out.db: exists" in refused(database.parent / "none.db")  # told before anything is read


def test_a_database_in_use_or_left_with_side_files(database, refused):
    with closing(pycolmap.Database.open(str(database))):
        assert "database.db: in use by another program (database.db-wal, database.db-shm" in refused(database)
    assert "Exported" in repr(copy_database(database, database.parent / "out.db", "3.8"))
    Path(f"{database}-journal").write_bytes(b"")
    assert "in use by another program (database.db-journal beside it); close it" in refused(database)


def test_a_database_that_is_locked(database, refused):
    """In rollback mode there are no side files to tell. From another process: locks do not stop one's own."""
    code = (
        "import sqlite3, sys\n"
        "opened = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "opened.execute('PRAGMA journal_mode = DELETE')\n"
        "opened.execute('BEGIN EXCLUSIVE')\n"
        "print('locked', flush=True)\n"
        "sys.stdin.read()\n"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code, database], stdin=pipe, stdout=pipe, text=True) as other:
        assert other.stdout.readline() == "locked\n"
        assert "database.db: in use by another program (database is locked); close it" in refused(database)
        other.stdin.close()


DAMAGE = {
    "text": lambda data: b"this is not a database",
    "empty": lambda data: b"",
    "cut short": lambda data: data[: len(data) // 2],
    "overwritten": lambda data: data[: 4096 * 5] + b"\xff" * (4096 * 15) + data[4096 * 20 :],
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_database(how, database, refused):
    database.write_bytes(DAMAGE[how](database.read_bytes()))
    assert re.search(r"database\.db: damaged \(.+\); make the run again", refused(database))


def test_a_database_whose_index_says_otherwise(database, refused):
    """Readable row by row; only the integrity check finds it."""
    with closing(sqlite3.connect(database)) as opened:
        index = opened.execute("SELECT * FROM sqlite_master WHERE name = 'frame_sensor_assignment'").fetchone()
    change(database, "PRAGMA writable_schema = ON", "DELETE FROM sqlite_master WHERE name = 'frame_sensor_assignment'")
    change(database, "UPDATE frame_data SET sensor_type = 5 WHERE data_id = 8")
    values = ", ".join(repr(value) for value in index)
    change(database, "PRAGMA writable_schema = ON", f"INSERT INTO sqlite_master VALUES ({values})")
    assert "database.db: damaged (row 8 missing from index frame_sensor_assignment)" in refused(database, "4.2")


def test_no_database(database, refused):
    database.unlink()
    assert "database.db: No such file or directory; give a readable database" in refused(database)


@pytest.mark.parametrize(
    ("statement", "sign"),
    [
        ("DROP TABLE matches", "table matches is missing"),
        ("CREATE TABLE depths (image_id INTEGER)", "table depths is not in the schema"),
        ("ALTER TABLE matches ADD COLUMN score REAL", "table matches has score REAL in place of no column"),
        ("ALTER TABLE frames RENAME COLUMN rig_id TO rig", "table frames has rig INTEGER NOT NULL in place of rig_id"),
        ("DROP INDEX frame_sensor_assignment", "table frame_data has other constraints"),
    ],
)
def test_a_database_of_another_version(statement, sign, database, refused):
    change(database, statement)
    message = refused(database, schema="4.2")
    assert "not as COLMAP 4.2 writes it" in message
    assert sign in message


LOSSES = {
    "row": ("DELETE FROM images WHERE image_id = 8", "row 8 of images differs"),
    "more": ("INSERT INTO matches VALUES (7, 0, 2, x'')", "row 1 of matches differs"),
    "bit": ("UPDATE keypoints SET data = zeroblob(length(data)) WHERE image_id = 3", "row 3 of keypoints differs"),
    "id": ("UPDATE images SET image_id = 9 WHERE image_id = 8", "row 8 of images differs"),
    "filled": ("UPDATE images SET prior_tx = 0 WHERE image_id = 1", "images.prior_tx is not empty"),
    "column": ("ALTER TABLE images DROP COLUMN prior_tz", "no column in place of prior_tz REAL"),
    "table": ("DROP TABLE descriptors", "table descriptors is missing"),
    "index": ("DROP INDEX index_name", "table images has other constraints"),
    "stamp": ("PRAGMA user_version = 3900", "user_version is 3900 in place of 3800"),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_a_copy_that_is_not_the_same_does_not_appear(loss, database, refused, monkeypatch):
    """What is written is read back: a lost row, bit or column, or a wrong stamp, stops the export."""
    statement, sign = LOSSES[loss]
    write = export._write

    def lossy(copy, path, wanted):
        write(copy, path, wanted)
        change(path, statement)

    monkeypatch.setattr(export, "_write", lossy)
    assert sign in refused(database, error=StcalError)


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "no hard links"])
def test_a_file_that_appears_meanwhile_is_not_overwritten(links, database, tmp_path, monkeypatch):
    def no_links(*_):
        raise PermissionError("no hard links here")

    if not links:
        monkeypatch.setattr(export.os, "link", no_links)
    copy_database(database, tmp_path / "first.db", "3.8")
    assert (tmp_path / "first.db").is_file()
    check = export._require_same_content

    def slow(*arguments):
        check(*arguments)
        (tmp_path / "out.db").write_text("theirs")

    monkeypatch.setattr(export, "_require_same_content", slow)
    with fails_with("E-OUTPUT-EXISTS"):
        copy_database(database, tmp_path / "out.db", "3.8")
    assert (tmp_path / "out.db").read_text() == "theirs"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["first.db", "out.db", "run"]
