"""The database for other versions of COLMAP: their schema, and our content.

Only native COLMAP 3.8 and pycolmap 4.2 run here. The other schemas are compared with what was published: a checksum of
the description of the empty database that each version made when it was run.
"""

import hashlib
import re
import shutil
import sqlite3
import subprocess
from contextlib import closing
from importlib import import_module

import pycolmap
import pytest

from stcal.errors import InputError
from stcal.sfm.interop.export_colmap import SCHEMAS, export_database
from tests.outcome import fails_with

export = import_module("stcal.sfm.interop.export_colmap")
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
    export_database(small_run, tmp_path / "out.db", schema)
    assert described(tmp_path / "out.db") == described(tmp_path / "empty.db")


@pytest.mark.parametrize("schema", PUBLISHED, ids=[f"{schema} as published, not run here" for schema in PUBLISHED])
def test_the_schema_is_the_published_one(schema, small_run, tmp_path):
    """Against what was recorded when each version was run; the versions themselves are not here."""
    export_database(small_run, tmp_path / "out.db", schema)
    lines = described(tmp_path / "out.db")
    assert hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16] == PUBLISHED[schema], "\n".join(lines)


@pytest.mark.parametrize("schema", list(SCHEMAS)[::3])
def test_everything_is_kept(schema, small_run, tmp_path):
    """Every row and value of the run's own database, its type and its place."""
    own, before = small_run / "colmap/database.db", state_of(small_run / "colmap")
    written = export_database(small_run, tmp_path / "out.db", schema)
    assert (written.images, written.pairs, written.camera_models) == (8, 28, ("OPENCV",))
    ours, theirs = columns_of(own), columns_of(tmp_path / "out.db")
    for table, columns in theirs.items():
        shared = [column for column in columns if column in ours[table]]
        assert rows_of(tmp_path / "out.db", table, shared) == rows_of(own, table, shared)
        for column in set(columns) - {*ours[table]}:
            assert {row[0] for row in rows_of(tmp_path / "out.db", table, [column])} <= {None}
    assert len(rows_of(tmp_path / "out.db", "keypoints", ["data"])) == 8
    assert (tmp_path / "out.db").read_bytes()[18:20] == b"\1\1"  # rollback journal: one file is all of it
    with read_only(tmp_path / "out.db") as opened:
        assert opened.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert opened.execute("PRAGMA foreign_key_check").fetchall() == []
    assert state_of(small_run / "colmap") == before
    assert [path.name for path in tmp_path.iterdir()] == ["out.db"]


@pytest.fixture
def refused(saved, tmp_path):
    """The one line of a refused export, after which nothing new lies beside the output."""

    def message(schema="3.8", out="out.db") -> str:
        beside = state_of(tmp_path)
        with pytest.raises(InputError) as refusal:
            export_database(saved, tmp_path / out, schema)
        assert state_of(tmp_path) == beside
        assert "\n" not in str(refusal.value)
        return str(refusal.value)

    return message


def test_an_unknown_schema_and_a_folder_that_is_not_there(refused):
    assert refused(schema="3.7") == "schema 3.7: unknown; give one of 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0, 4.1, 4.2"
    assert re.search(r"out\.db: no folder .*/none; make it", refused(out="none/out.db"))


def test_nothing_is_overwritten(refused, tmp_path):
    (tmp_path / "out.db").write_text("mine")
    assert "out.db: exists, and nothing is overwritten" in refused()
    (tmp_path / "link.db").symlink_to(tmp_path / "nowhere")
    assert "link.db: exists" in refused(out="link.db")


def test_a_file_that_appears_meanwhile_is_not_overwritten(saved, tmp_path, monkeypatch):
    export_database(saved, tmp_path / "first.db", "3.8")
    assert (tmp_path / "first.db").is_file()
    write = export.write_copy

    def slow(*arguments):
        (tmp_path / "out.db").write_text("theirs")
        return write(*arguments)

    monkeypatch.setattr(export, "write_copy", slow)
    with fails_with("E-OUTPUT-EXISTS"):
        export_database(saved, tmp_path / "out.db", "3.8")
    assert (tmp_path / "out.db").read_text() == "theirs"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["first.db", "out.db"]
