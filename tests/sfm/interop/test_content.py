"""A database goes out whole and as the run has labelled it, or not at all."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stcal.errors import InputError
from stcal.sfm.interop.export_database import copy_database, export_database
from tests.outcome import fails_with
from tests.shared import own_copy


@pytest.fixture
def spoilt(small_run, tmp_path):
    def copy(statement: str) -> Path:
        database = own_copy(small_run / "colmap/database.db", tmp_path)
        with closing(sqlite3.connect(database)) as opened, opened:
            opened.execute("PRAGMA journal_mode = DELETE")
            opened.execute(statement)
        return database

    return copy


FIRST = "WHERE rowid = (SELECT min(rowid) FROM {})"
MATCHES, PAIRS = FIRST.format("matches"), FIRST.format("two_view_geometries")
NAME = "UPDATE images SET name = {} WHERE image_id = 1"
OUT = "leads out of the folder of images"
NOT_WHOLE = {
    "matches short": (
        f"UPDATE matches SET data = x'0001' {MATCHES}",
        r"matches 2147483649: data of 2 bytes, \d+×2×4 b",
    ),
    "matches cut": (f"UPDATE matches SET data = substr(data, 2) {MATCHES}", r"matches 2147483649: data of \d+ bytes"),
    "matches of three": (f"UPDATE matches SET cols = 3 {MATCHES}", "matches 2147483649: 3 columns, 2 needed"),
    "a text": (f"UPDATE matches SET data = 'abc' {MATCHES}", "data of another kind"),
    "no rows": (f"UPDATE matches SET rows = -1 {MATCHES}", "-1 × 2 values, whole numbers needed"),
    "rows a word": (f"UPDATE matches SET rows = 'many' {MATCHES}", "'many' × 2 values, whole numbers needed"),
    "beyond the last": (f"UPDATE matches SET rows = 1, data = x'ffff000000000000' {MATCHES}", "images 1 and 2: a keyp"),
    "pair of none": (f"UPDATE matches SET pair_id = 999999999999 {MATCHES}", "a pair of images 465 and"),
    "pair of one": (f"UPDATE matches SET pair_id = 2147483648 {MATCHES}", "a pair of images 1 and 1, two images"),
    "inliers short": (
        f"UPDATE two_view_geometries SET data = x'' {PAIRS}",
        "two_view_geometries 2147483649: data of 0",
    ),
    "F short": (f"UPDATE two_view_geometries SET F = x'00' {PAIRS}", "F of 1 bytes, 72 bytes or none needed"),
    "qvec long": (f"UPDATE two_view_geometries SET qvec = zeroblob(40) {PAIRS}", "qvec of 40 bytes, 32 bytes or none"),
    "keypoints short": (
        "UPDATE keypoints SET data = x'00' WHERE image_id = 2",
        r"keypoints 2: data of 1 bytes, \d+×2×4",
    ),
    "keypoints gone": ("UPDATE keypoints SET data = NULL WHERE image_id = 2", r"keypoints 2: data of 0 bytes"),
    "keypoints of one": (
        "UPDATE keypoints SET cols = 1, rows = 2 * rows",
        "keypoints 1: 1 columns, 2 or 4 or 6 needed",
    ),
    "descriptors short": (
        "INSERT INTO descriptors VALUES (1, 0, 5, 128, x'00')",
        "descriptors 1: data of 1 bytes, 5×128",
    ),
    "params short": ("UPDATE cameras SET params = x'0011'", "camera 1: params of 2 bytes, 64 bytes needed for model 4"),
    "another model": ("UPDATE cameras SET model = 6", "camera 1: params of 64 bytes, 96 bytes needed for model 6"),
    "no such camera": ("UPDATE images SET camera_id = 7 WHERE image_id = 1", "row 1 of images refers to .* in cameras"),
    "a name up": (NAME.format("'../../../x.jpg'"), f"image 1: name '../../../x.jpg': {OUT}"),
    "a name up inside": (NAME.format("'12/../../x.jpg'"), OUT),
    "an absolute name": (NAME.format("'/etc/x.jpg'"), OUT),
    "a drive": (NAME.format("'C:x.jpg'"), OUT),
    "a share": (NAME.format(r"'\\host\share\x.jpg'"), OUT),
    "up with backslashes": (NAME.format(r"'12\..\..\x.jpg'"), OUT),
    "an escape": (NAME.format("'12/a' || char(27) || '[31m.jpg'"), r"'12/a\\x1b\[31m.jpg': holds a control character"),
    "a number": (NAME.format("x'2e2e2f78'"), "not a text"),
}


@pytest.mark.parametrize("case", NOT_WHOLE)
def test_what_is_not_whole_is_refused(spoilt, tmp_path, case):
    statement, message = NOT_WHOLE[case]
    with pytest.raises(InputError, match=rf"database\.db: damaged \(.*{message}.*\); make the run again$") as caught:
        copy_database(spoilt(statement), tmp_path / "out.db", "4.2")
    assert len(str(caught.value).splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db"]


NOT_OF_THE_RUN = {
    "keypoints elsewhere": (
        "UPDATE keypoints SET data = zeroblob(8 * rows) WHERE image_id = 2",
        "E-RUN-DATABASE … database.db … 12/IMG_1001.jpg",
    ),
    "another name": (NAME.format("'12/IMG_2000.jpg'"), "E-RUN-DATABASE … database.db … 12/IMG_1000.jpg … not those of"),
    "one image more": (
        "INSERT INTO images VALUES (9, '12/more.jpg', 1)",
        "E-RUN-DATABASE … database.db … 12/more.jpg … not those of",
    ),
    "params": ("UPDATE cameras SET params = zeroblob(64)", "E-RUN-DATABASE … database.db"),
    "size": ("UPDATE cameras SET width = 10", "E-RUN-DATABASE … database.db"),
    "no pairs": ("DELETE FROM two_view_geometries", "E-RUN-DATABASE … database.db … two_view_geometries"),
    "a pair less": (f"DELETE FROM matches {MATCHES}", "E-RUN-DATABASE … database.db … matches … 27 … 28"),
    "a match less": (
        f"UPDATE matches SET rows = rows - 1, data = substr(data, 9) {MATCHES}",
        "E-RUN-DATABASE … database.db … matches … 12/IMG_1000.jpg … 12/IMG_1001.jpg",
    ),
    "a wrong match": (
        f"UPDATE matches SET rows = 1, data = x'0000000001000000' {MATCHES}",
        "E-RUN-DATABASE … database.db … 12/IMG_1000.jpg … 12/IMG_1001.jpg",
    ),
}


@pytest.mark.parametrize("case", NOT_OF_THE_RUN)
def test_what_the_run_did_not_label_is_refused(spoilt, saved, tmp_path, case):
    statement, message = NOT_OF_THE_RUN[case]
    database = spoilt(statement)
    with fails_with(message) as caught:
        copy_database(database, tmp_path / "out.db", "4.2", saved)
    assert len(str(caught.value).splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db"]


def test_the_export_of_a_run_compares_with_it(small_run, tmp_path):
    own = own_copy(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("cache", "overlays"))
    with closing(sqlite3.connect(own / "colmap/database.db")) as opened, opened:
        opened.execute("PRAGMA journal_mode = DELETE")
        opened.execute("UPDATE keypoints SET data = zeroblob(8 * rows) WHERE image_id = 2")
    with fails_with("E-RUN-DATABASE … 12/IMG_1001.jpg"):
        export_database(own, tmp_path / "out.db", "3.8")
