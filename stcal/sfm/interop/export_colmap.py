"""Export to COLMAP and viewers of its models: the database, and the final model.

The database has the form that COLMAP 3.8 itself makes, the oldest. All later versions open it, bring it to their own
form, and make the same model of it to the last digit as of one in their own form (pycolmap of 3.9.1, 3.10.0, 3.11.1,
3.12.6, 3.13.0, 4.0.4, 4.1.1 and 4.2.1).
"""

import os
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import TARGET_MODEL, require_unchanged
from stcal.io.table import csv_text
from stcal.labels import DotLabel
from stcal.sfm.interop.export import BOARD_RGB, Exported, colours, require_free, require_new
from stcal.sfm.mapping.database import pycolmap, write_database
from stcal.sfm.mapping.models import open_model, require_keypoints, write_reconstruction
from stcal.sfm.mapping.pairs import image_graph
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run

VERSIONS = ("3.8", "3.9", "3.10", "3.11", "3.12", "3.13", "4.0", "4.1", "4.2")
"""Versions of COLMAP that open an exported database."""
FORM, USER_VERSION = VERSIONS[0], 3800  # version whose form it has, and the stamp of that
_MATRIX = "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
_OF_IMAGE = "FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE"
_ARRAY = f"image_id INTEGER NOT NULL PRIMARY KEY, {_MATRIX}, {_OF_IMAGE}"
_PAIRS = f"pair_id INTEGER NOT NULL PRIMARY KEY, {_MATRIX}"
TABLES = {
    "cameras": "camera_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, model INTEGER NOT NULL, width INTEGER NOT NULL, "
    "height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL",
    "images": "image_id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL, camera_id INTEGER NOT NULL, "
    "prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL, prior_tx REAL, prior_ty REAL, prior_tz REAL, "
    "UNIQUE (name), CHECK (image_id >= 0 and image_id < 2147483647), "
    "FOREIGN KEY (camera_id) REFERENCES cameras (camera_id)",
    "keypoints": _ARRAY,
    "descriptors": _ARRAY,
    "matches": _PAIRS,
    "two_view_geometries": f"{_PAIRS}, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB",
}
"""Declaration of each table."""


def require_version(version: str) -> None:
    """Refuses a COLMAP program of a ``version`` (``3.8``, ``3.11.1``, ``4.0.3``) that is not known to open it."""
    if ".".join(version.split(".")[:2]) not in VERSIONS:
        fault = f"COLMAP {version}: not known to open the database"
        raise InputError("E-COLMAP-VERSION", f"{fault}; use a release of {', '.join(VERSIONS)}")


@require_arguments
def export_database(run: AnyRun, out: str | Path, schema: str) -> Exported:
    """Writes the database of a run for any version of COLMAP, with the same ids, orders and values.

    Parameters
    ----------
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : New file; it appears complete or not at all.
    schema : Version of COLMAP that is to open it: ``3.8`` to ``4.2``. The form is that of 3.8 for all.

    Raises
    ------
    InputError
        The version is unknown, or ``out`` exists or cannot be written.
    """
    run, out = saved_run(run), Path(out)
    if schema not in VERSIONS:
        raise InputError("E-OPTION-VALUE", f"schema {schema}: unknown; give one of {', '.join(VERSIONS)}")
    require_new(out)
    with _complete(out) as made:
        pairs = write_copy(run, made)
    content = f"{len(run.observations)} images, {pairs} pairs, camera model {run.camera.colmap_model}"
    how = f"colmap gui --database_path {out} --image_path IMAGES"
    return Exported(out, f"for COLMAP {schema}: {content}\nopen it with: {how}")


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


def write_copy(run: SavedRun, path: Path) -> int:
    """Writes a new database of a run's images and labels; returns the number of its pairs. It is in rollback-journal
    mode, which is a single file that any program opens."""
    own = path.with_name(f"own-{path.name}")
    pairs = image_graph(run.observations, run.board_design).pairs
    write_database(own, run.camera, run.observations, pairs, run.corrected_px)
    try:
        with closing(sqlite3.connect(path)) as copy, copy:
            for table, declaration in TABLES.items():
                copy.execute(f"CREATE TABLE {table} ({declaration})")
            copy.execute("CREATE UNIQUE INDEX index_name ON images (name)")
            copy.execute(f"PRAGMA user_version = {USER_VERSION}")
            copy.commit()
            copy.execute("ATTACH ? AS own", (str(own),))
            for table in TABLES:
                main, ours = (copy.execute(f"PRAGMA {name}.table_info({table})").fetchall() for name in ("main", "own"))
                known = {name for _, name, *_ in ours}
                columns = ", ".join(name for _, name, *_ in main if name in known)
                copy.execute(f"INSERT INTO {table} ({columns}) SELECT {columns} FROM own.{table} ORDER BY rowid")
    except sqlite3.Error as error:
        fault = f"{path}: cannot be written ({error})"
        raise InputError("E-OUTPUT-UNWRITABLE", f"{fault}; check the folder's space and rights") from error
    return len(pairs)


FORMATS = ("colmap-bin", "colmap-txt")  # formats of a model, which is a folder
LABELS = "labels.csv"
LABEL_COLUMNS = ["point", "group", "label", "x_mm", "y_mm", "z_mm", "sigma_x_um", "sigma_y_um", "sigma_z_um"]


@require_arguments
def export_model(run: AnyRun, out: str | Path, form: str) -> Exported:
    """Writes the final model of a run in COLMAP's binary or text format: mm, target frame, labels beside it.

    It appears complete or not at all. The model's files must be as the run wrote them.

    Parameters
    ----------
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : New or empty folder; missing parent folders are made.
    form : ``colmap-bin`` or ``colmap-txt``.

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
    counts = f"{len(reconstruction.reg_image_ids())} images and {len(rows)} points"
    return Exported(out, f"{counts}; mm, target frame: {out}\nlabels: {out / LABELS}")


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
