"""What a database holds must be whole before it goes out: every blob as long as its row says, every name below the
folder of images, and all of it what the run has labelled."""

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.io.images import name_fault
from stcal.sfm.mapping.database import colmap_camera, from_colmap_px, image_ids, match_labels
from stcal.sfm.mapping.graph import image_graph, kind_of_graph
from stcal.sfm.mapping.models import KEYPOINT_TOLERANCE_PX, parameter_count
from stcal.sfm.runs.saved import SavedRun

PAIR_BASE = 2**31 - 1
"""A pair's id is this times the smaller image id, plus the larger one (COLMAP's ``kMaxNumImages``)."""
KEYPOINT_COLUMNS = (2, 4, 6)
"""x, y; and scale and angle, or an affine shape."""
REAL = 8
MATRICES = {
    "two_view_geometries": {"F": 9, "E": 9, "H": 9, "qvec": 4, "tvec": 3},
    "pose_priors": {"position": 3, "position_covariance": 9, "gravity": 3},
    "rig_sensors": {"sensor_from_rig": 7},
}
"""Numbers in blobs that may also be empty."""
PAIRED = ("matches", "two_view_geometries")


def damaged(path: Path, sign: str) -> InputError:
    """A database that is not as it should be."""
    return InputError("E-RUN-DAMAGED", f"{path}: damaged ({sign}); make the run again")


def require_whole(database: Path, copy: sqlite3.Connection) -> None:
    """Every name, blob and reference of a database, by the schema alone.

    Parameters
    ----------
    database : Path
        For messages.
    copy : sqlite3.Connection
        Of what it holds, in the schema of our own database.

    Raises
    ------
    InputError
        Names the first row that is not whole.
    """
    for fault in _faults(copy):
        raise damaged(database, fault)


def _faults(copy: sqlite3.Connection) -> Iterator[str]:
    yield from _faulty_references(copy)
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


def _faulty_references(copy: sqlite3.Connection) -> Iterator[str]:
    for table, row, parent, _ in copy.execute("PRAGMA foreign_key_check"):
        yield f"row {row} of {table} refers to one that is not in {parent}"


def _faulty_matrices(copy: sqlite3.Connection, table: str, width: int, allowed: Sequence[int] | None) -> Iterator[str]:
    """Rows whose ``data`` is not rows × cols numbers of ``width`` bytes."""
    key = copy.execute(f"SELECT name FROM pragma_table_info('{table}')").fetchone()[0]
    for row, rows, cols, data in copy.execute(f"SELECT {key}, rows, cols, data FROM {table}"):
        if not (isinstance(rows, int) and isinstance(cols, int) and rows >= 0 and cols >= 0):
            yield f"{table} {row}: {rows!r} × {cols!r} values, whole numbers needed"
        elif rows and allowed and cols not in allowed:
            yield f"{table} {row}: {cols} columns, {' or '.join(map(str, allowed))} needed"
        elif _size(data) != rows * cols * width:
            yield f"{table} {row}: data of {_told(data)}, {rows}×{cols}×{width} bytes needed"


def _faulty_pairs(copy: sqlite3.Connection) -> Iterator[str]:
    """Pairs of images that are not there, or of keypoints that they do not have."""
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
    """Ids of two images, and the keypoints (n, 2) matched."""
    for pair, data in copy.execute(f"SELECT pair_id, data FROM {table}"):
        yield pair // PAIR_BASE, pair % PAIR_BASE, np.frombuffer(data or b"", np.uint32).reshape(-1, 2).astype(int)


def _size(blob: object) -> int:
    """Bytes of a blob; −1 where it is another kind of value."""
    return len(blob) if isinstance(blob, bytes) else 0 if blob is None else -1


def _told(blob: object) -> str:
    return "another kind" if _size(blob) < 0 else f"{_size(blob)} bytes"


def require_of_run(database: Path, copy: sqlite3.Connection, run: SavedRun) -> None:
    """The database must hold the run's camera, its images, their centres, and what their labels match.

    Parameters
    ----------
    database, copy :
        As of :func:`require_whole`, which must have passed it.
    run : SavedRun
        Camera, labelled and corrected centres.

    Raises
    ------
    InputError
        Names the first difference from the run's files.
    """
    _require_camera(database, copy, run)
    ids = image_ids(run.observations)
    _require_keypoints(database, copy, run, ids)
    _require_matches(database, copy, run, ids)


def _require_camera(database: Path, copy: sqlite3.Connection, run: SavedRun) -> None:
    own = colmap_camera(run.camera)
    wanted = (own.model.value, own.width, own.height, np.asarray(own.params, float).tobytes())
    if copy.execute("SELECT model, width, height, params FROM cameras").fetchall() != [wanted]:
        raise InputError(
            "E-RUN-DATABASE", f"{database}: its camera is not that of {run.folder / 'cameras.txt'}; run again"
        )


def _require_keypoints(database: Path, copy: sqlite3.Connection, run: SavedRun, ids: dict[str, int]) -> None:
    """The keypoints that the labels are of, under the images' names."""
    names = dict(copy.execute("SELECT name, image_id FROM images"))
    keypoints = {image: own for image, *own in copy.execute("SELECT image_id, cols, data FROM keypoints")}
    labels = f"not those of {run.folder / 'labels.csv'}"
    for image, expected in zip(run.observations, run.corrected_px, strict=True):
        cols, data = keypoints.get(ids[image.name], (2, b""))
        xy = from_colmap_px(np.frombuffer(data or b"", np.float32).reshape(-1, cols or 2)[:, :2])
        if names.get(image.name) != ids[image.name] or len(xy) != len(expected):
            raise InputError("E-RUN-DATABASE", f"{database}: its keypoints of {image.name} are {labels}; run again")
        off = np.abs(xy - expected).max(initial=0)
        if not off <= KEYPOINT_TOLERANCE_PX:
            raise InputError(
                "E-RUN-DATABASE",
                f"{database}: its keypoints of {image.name} are {labels} (up to {off:.3g} px off, "
                f"{KEYPOINT_TOLERANCE_PX:g} allowed); run again",
            )
    if len(names) > len(ids):
        other = next(name for name in names if name not in ids)
        raise InputError("E-RUN-DATABASE", f"{database}: its images, with {other}, are {labels}; run again")


def _require_matches(database: Path, copy: sqlite3.Connection, run: SavedRun, ids: dict[str, int]) -> None:
    """Each pair matches what has the same label; of small sets every pair is there."""
    images = {ids[image.name]: image for image in run.observations}
    whole = kind_of_graph(len(run.observations), run.options.graph) == "all"
    wanted = (
        {(i + 1, j + 1) for i, j in image_graph(run.observations, run.board, "all").pairs.tolist()} if whole else set()
    )
    for table in PAIRED:
        found = set()
        for first, second, matches in _matches(copy, table):
            found.add((first, second))
            a, b = images[first], images[second]
            if not np.array_equal(matches, match_labels(a, b)):
                wrong = [f"{a.labels[i]} with {b.labels[j]}" for i, j in matches.tolist() if a.labels[i] != b.labels[j]]
                what = f"match {wrong[0]}" if wrong else "do not match all that have the same label"
                raise InputError("E-RUN-DATABASE", f"{database}: {table}: {a.name} and {b.name} {what}; run again")
        if whole and found != wanted:
            count = f"{len(found)} pairs of images, the {len(wanted)} of {run.folder / 'labels.csv'} needed"
            raise InputError("E-RUN-DATABASE", f"{database}: {table}: {count}; run again")
