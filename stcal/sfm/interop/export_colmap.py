"""Export to COLMAP and viewers of its models: the database in the schema of any version, and the final model.

The schemas of the database, as SQL, were read from the empty database that each version itself makes: 3.8 from the
native program, 3.9 (3.9.1) to 4.2 (4.2.1) from pycolmap. Releases of one version differ in nothing but the last digits
of ``user_version``, which 4.x stamps as major, minor and patch. The tables of 4.1 are those of 4.0.
"""

import os
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import TARGET_MODEL, require_unchanged
from stcal.io.table import csv_text
from stcal.labels import DotLabel
from stcal.sfm.interop.export import BOARD_RGB, colours, require_free, require_new
from stcal.sfm.mapping.database import pycolmap, write_database
from stcal.sfm.mapping.models import open_model, require_keypoints, write_reconstruction
from stcal.sfm.mapping.pairs import image_graph
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run


@dataclass(frozen=True, slots=True)
class Schema:
    name: str
    user_version: int  # the stamp of the version's first release
    tables: dict[str, str]  # declaration by name
    indices: dict[str, str]  # table and columns of unique indices by name


_MATRIX = "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
_IMAGE_KEY = "image_id INTEGER NOT NULL PRIMARY KEY"
_OF_IMAGE = "FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE"
_OF_RIG = "FOREIGN KEY (rig_id) REFERENCES rigs (rig_id) ON DELETE CASCADE"
_SENSOR = "sensor_id INTEGER NOT NULL, sensor_type INTEGER NOT NULL"
_PAIRS = f"pair_id INTEGER NOT NULL PRIMARY KEY, {_MATRIX}"
_GEOMETRIES = f"{_PAIRS}, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB"
_IMAGES = (
    "image_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL, camera_id INTEGER NOT NULL{}, "
    "UNIQUE (name), CHECK (image_id >= 0 and image_id < 2147483647), "
    "FOREIGN KEY (camera_id) REFERENCES cameras (camera_id)"
)
_PRIOR_POSES = "".join(f", prior_{name} REAL" for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz"))
_PRIORS = f"{_IMAGE_KEY}, position BLOB, coordinate_system INTEGER NOT NULL"

_CHANGES: dict[str, tuple[int, dict[str, str], dict[str, str]]] = {
    "3.8": (
        3800,
        {
            "cameras": "camera_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, model INTEGER NOT NULL, "
            "width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL",
            "images": _IMAGES.format(_PRIOR_POSES),
            "keypoints": f"{_IMAGE_KEY}, {_MATRIX}, {_OF_IMAGE}",
            "descriptors": f"{_IMAGE_KEY}, {_MATRIX}, {_OF_IMAGE}",
            "matches": _PAIRS,
            "two_view_geometries": _GEOMETRIES,
        },
        {"index_name": "images (name)"},
    ),
    "3.9": (3900, {}, {}),
    "3.10": (3900, {"images": _IMAGES.format(""), "pose_priors": f"{_PRIORS}, {_OF_IMAGE}"}, {}),
    "3.11": (3900, {"pose_priors": f"{_PRIORS}, position_covariance BLOB, {_OF_IMAGE}"}, {}),
    "3.12": (
        3900,
        {
            "rigs": "rig_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, ref_sensor_id INTEGER NOT NULL, "
            "ref_sensor_type INTEGER NOT NULL",
            "rig_sensors": f"rig_id INTEGER NOT NULL, {_SENSOR}, sensor_from_rig BLOB, {_OF_RIG}",
            "frames": f"frame_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, rig_id INTEGER NOT NULL, {_OF_RIG}",
            "frame_data": f"frame_id INTEGER NOT NULL, data_id INTEGER NOT NULL, {_SENSOR}, "
            "FOREIGN KEY (frame_id) REFERENCES frames (frame_id) ON DELETE CASCADE",
        },
        {
            "rig_ref_sensor_assignment": "rigs (ref_sensor_id, ref_sensor_type)",
            "rig_sensor_assignment": "rig_sensors (sensor_id, sensor_type)",
            "frame_sensor_assignment": "frame_data (data_id, sensor_type)",
        },
    ),
    "3.13": (3900, {}, {}),
    "4.0": (
        4_00_00_00,
        {
            "descriptors": f"{_IMAGE_KEY}, type INTEGER NOT NULL, {_MATRIX}, {_OF_IMAGE}",
            "pose_priors": "pose_prior_id INTEGER NOT NULL PRIMARY KEY, corr_data_id INTEGER NOT NULL, "
            "corr_sensor_id INTEGER NOT NULL, corr_sensor_type INTEGER NOT NULL, position BLOB, "
            "position_covariance BLOB, gravity BLOB, coordinate_system INTEGER NOT NULL",
        },
        {"pose_prior_data_assignment": "pose_priors (corr_data_id, corr_sensor_id, corr_sensor_type)"},
    ),
    "4.1": (4_01_00_00, {}, {}),
    "4.2": (4_02_00_00, {"two_view_geometries": f"{_GEOMETRIES}, camera1 BLOB, camera2 BLOB"}, {}),
}
"""Stamp of each version's first release, and the tables and indices that it added or changed, the oldest first."""

SCHEMAS: dict[str, Schema] = {}
"""All published schemas by name, the oldest first."""
_tables, _indices = {}, {}
for _name, (_stamp, _new_tables, _new_indices) in _CHANGES.items():
    _tables, _indices = _tables | _new_tables, _indices | _new_indices
    SCHEMAS[_name] = Schema(_name, _stamp, _tables, _indices)


def find_schema(name: str) -> Schema:
    if name not in SCHEMAS:
        raise InputError("E-OPTION-VALUE", f"schema {name}: unknown; give one of {', '.join(SCHEMAS)}")
    return SCHEMAS[name]


def schema_of_version(version: str) -> Schema:
    """Returns the schema that a COLMAP program of ``version`` (``3.8``, ``3.11.1``, ``4.0.3``) reads and writes."""
    release = re.fullmatch(r"(\d+\.\d+)(\.\d+)?", version)
    if release is None or release[1] not in SCHEMAS:
        versions = ", ".join(SCHEMAS)
        fault = f"COLMAP {version}: its database schema is not known"
        raise InputError("E-COLMAP-VERSION", f"{fault}; use a release of {versions}")
    return SCHEMAS[release[1]]


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
    with _complete(out) as made:
        pairs = write_copy(run, made, wanted)
    return Exported(out, wanted.name, len(run.observations), pairs, (run.camera.colmap_model,))


@contextmanager
def _complete(place: Path) -> Iterator[Path]:
    """Yield the path of a new file or folder, which appears at its place complete or not at all."""
    try:
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.partial-", dir=place.parent) as scratch:
            yield (made := Path(scratch) / place.name)
            require_free(place, folder=place.is_dir())
            if place.is_dir():
                place.rmdir()  # empty; not every system lets a folder take its place
            made.rename(place)
    except OSError as error:  # a full disk names no file
        error.filename = error.filename or str(place)
        raise


def write_copy(run: SavedRun, path: Path, wanted: Schema) -> int:
    """Writes a new database of a run's images and labels; returns the number of its pairs. It is in rollback-journal
    mode, which is a single file that any program opens."""
    own = path.with_name(f"own-{path.name}")
    pairs = image_graph(run.observations, run.board_design).pairs
    write_database(own, run.camera, run.observations, pairs, run.corrected_px)
    try:
        with closing(sqlite3.connect(path)) as copy, copy:
            for table, declaration in wanted.tables.items():
                copy.execute(f"CREATE TABLE {table} ({declaration})")
            for index, columns in wanted.indices.items():
                copy.execute(f"CREATE UNIQUE INDEX {index} ON {columns}")
            copy.execute(f"PRAGMA user_version = {wanted.user_version}")
            copy.commit()
            copy.execute("ATTACH ? AS own", (str(own),))
            for table in wanted.tables:
                main, ours = (copy.execute(f"PRAGMA {name}.table_info({table})").fetchall() for name in ("main", "own"))
                known = {name for _, name, *_ in ours}
                columns = ", ".join(name for _, name, *_ in main if name in known)
                copy.execute(f"INSERT INTO {table} ({columns}) SELECT {columns} FROM own.{table} ORDER BY rowid")
    except sqlite3.Error as error:
        fault = f"{path}: cannot be written ({error})"
        raise InputError("E-OUTPUT-UNWRITABLE", f"{fault}; check the folder's space and rights") from error
    return len(pairs)


def database_text(written: Exported) -> str:
    """Returns a text on the contents of the copied database, and how to open it."""
    content = f"{written.images} images, {written.pairs} pairs, camera model {', '.join(written.camera_models)}"
    how = f"colmap gui --database_path {written.path} --image_path IMAGES"
    return f"schema {written.schema}, checked: {content}\nopen it with: {how}"


FORMATS = ("colmap-bin", "colmap-txt")  # formats of a model, which is a folder
LABELS = "labels.csv"
LABEL_COLUMNS = ["point", "group", "label", "x_mm", "y_mm", "z_mm", "sigma_x_um", "sigma_y_um", "sigma_z_um"]


@dataclass(frozen=True, slots=True)
class ExportedModel:
    """Summary of an exported model."""

    path: Path
    labels: Path
    images: int
    points: int


@require_arguments
def export_model(run: AnyRun, out: str | Path, form: str) -> ExportedModel:
    """Writes the final model of a run in COLMAP's binary or text format: mm, target frame, labels beside it.

    It appears complete or not at all. The model's files must be as the run wrote them.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : str or Path
        New or empty folder; missing parent folders are made.
    form : {"colmap-bin", "colmap-txt"}
        The format.

    Raises
    ------
    InputError
        Not a finished run, a damaged or changed model, an unknown format, a name that it cannot hold, or ``out``
        exists.
    """
    out = Path(out)
    if form not in FORMATS:
        raise InputError("E-OPTION-FORM", f"format {form}: unknown; give one of {', '.join(FORMATS)}")
    existing = next(folder for folder in out.absolute().parents if os.path.lexists(folder))
    if not existing.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: {existing} is a file; give another place")
    require_free(out, folder=True)
    saved = saved_run(run)
    reconstruction, rows = _labelled_points(saved)
    spaced = [image.name for image in saved.observations if " " in image.name]
    if spaced and form == "colmap-txt":
        fault = f"format {form}: image {spaced[0]} has a space in its name, at which readers end it"
        raise InputError("E-MODEL-NAMES", f"{fault}; use colmap-bin, or rename the image and run again")
    out.parent.mkdir(parents=True, exist_ok=True)
    with _complete(out) as folder:
        folder.mkdir()
        (folder / LABELS).write_text(csv_text([LABEL_COLUMNS, *rows]), encoding="utf-8")
        write_reconstruction(reconstruction, folder, text=form == "colmap-txt")
    return ExportedModel(out, out / LABELS, len(reconstruction.reg_image_ids()), len(rows))


def _labelled_points(run: SavedRun) -> tuple[pycolmap.Reconstruction, list[Sequence]]:
    """Returns the run's model with coloured points, and the rows of ``labels.csv`` by the points' ascending ids."""
    path = run.folder / TARGET_MODEL
    if not path.is_dir():
        raise InputError("E-RUN-VERSION", f"run {run.folder}: of another version, no {TARGET_MODEL}; run it again")
    for file in path.iterdir():
        require_unchanged(file)
    reconstruction = open_model(path)
    observations = {image.name: (image, xy) for image, xy in zip(run.observations, run.corrected_px, strict=True)}
    image_of = {}
    for image_id, image in reconstruction.images.items():
        if image.name not in observations:
            fault = f"image {image.name} is not as in the run's labels.csv"
            raise InputError("E-MODEL-NOT-OF-RUN", f"model {path}: {fault}; run it again")
        image_of[image_id], corrected_px = observations[image.name]
        require_keypoints(path, image, image_of[image_id].labels, corrected_px)
    rgb, covariance, rows = colours(run), run.faces.circle_covariance_mm2, []
    for point_id, point in sorted(reconstruction.points3D.items()):
        views = tuple((element.image_id, element.point2D_idx) for element in point.track.elements)
        names = {image_of[image_id].labels[k] for image_id, k in views}
        if len(names) != 1:
            fault = f"point {point_id} is of {len(names)} labels, 1 needed"
            raise InputError("E-MODEL-NOT-OF-RUN", f"model {path}: {fault}; run it again")
        label = names.pop()
        groups = {image_of[image_id].group for image_id, _ in views}
        colour = BOARD_RGB if isinstance(label, DotLabel) else rgb[label.face]
        point.color = np.array(colour, np.uint8)
        sigma = [f"{1e3 * s:.3f}" for s in np.sqrt(np.diag(covariance[label]))] if label in covariance else [""] * 3
        group = groups.pop() if len(groups) == 1 else ""  # empty if several groups share the point
        rows.append([point_id, group, label, *map(repr, point.xyz.tolist()), *sigma])
    return reconstruction, rows


def model_text(written: ExportedModel) -> str:
    counts = f"{written.images} images and {written.points} points"
    return f"{counts}; mm, target frame: {written.path}\nlabels: {written.labels}"
