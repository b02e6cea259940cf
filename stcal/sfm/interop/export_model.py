"""Export of the final model for other programs: COLMAP's two forms, NVM and Bundler."""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import camera_from_colmap
from stcal.io.files import TARGET_MODEL, require_unchanged
from stcal.io.table import csv_text
from stcal.labels import DotLabel, Label
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.interop.export_content import BOARD_RGB, colours
from stcal.sfm.mapping.database import from_colmap_px, pycolmap
from stcal.sfm.mapping.models import open_model, require_keypoints, rigid_from_colmap, write_reconstruction
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run

ModelFormat = Literal["colmap-bin", "colmap-txt", "nvm", "bundler"]
FOLDERS = ("colmap-bin", "colmap-txt", "bundler")
"""Formats of several files, for which OUT is a folder. The others are a file, with ``OUT.labels.csv`` beside it."""
LABEL_COLUMNS = ["point", "group", "label", "x_mm", "y_mm", "z_mm", "sigma_x_um", "sigma_y_um", "sigma_z_um"]


@dataclass(frozen=True, slots=True)
class ExportedModel:
    """Summary of an exported model."""

    path: Path
    labels: Path
    images: int
    points: int
    focal_px: float | None  # of an ideal camera in place of the run's; None if the format holds the run's camera
    centre_px: tuple[float, float] | None  # OpenCV pixel origin


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    id: int
    group: str  # empty if several groups share it
    label: Label
    xyz: list[float]  # (3,), target frame, mm
    rgb: tuple[int, int, int]
    views: tuple[tuple[int, int], ...]  # (image id, keypoint)


@require_arguments
def export_model(run: AnyRun, out: str | Path, form: str) -> ExportedModel:
    """Writes the final model of a run in another program's format: mm, target frame, labels beside it.

    It appears complete or not at all. The model's files must be as the run wrote them.

    NVM and Bundler support one focal length, little distortion and a centred principal point. They get an ideal camera
    without distortion, and the keypoints as this camera sees them. This is exact, but photographs have to be
    undistorted to match.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    out : str or Path
        New file for ``nvm``, new or empty folder for the others; missing parent folders are made.
    form : {"colmap-bin", "colmap-txt", "nvm", "bundler"}
        The format.

    Raises
    ------
    InputError
        Not a finished run, a damaged or changed model, an unknown format, a name that it cannot hold, or ``out``
        exists.
    """
    out, kind = Path(out), form
    if kind not in get_args(ModelFormat):
        raise InputError("E-OPTION-FORM", f"format {kind}: unknown; give one of {', '.join(get_args(ModelFormat))}")
    labels = out / "labels.csv" if kind in FOLDERS else out.with_name(f"{out.name}.labels.csv")
    _require_free(out, labels, kind)
    saved = saved_run(run)
    reconstruction, points = _labelled_points(saved)
    (native,) = reconstruction.cameras.values()
    camera = camera_from_colmap(
        native.model.name, native.width, native.height, list(native.params), saved.folder
    ).sized(0, 0)
    spaced = [image.name for image in saved.observations if " " in image.name]
    if spaced and kind in ("colmap-txt", "bundler"):
        raise InputError(
            "E-MODEL-NAMES",
            f"format {kind}: image {spaced[0]} has a space in its name, at which readers end it; use colmap-bin, "
            "or rename the image and run again",
        )
    ideal = kind in ("nvm", "bundler")
    focal_px = float(camera.focal.mean())
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.partial-", dir=out.parent) as scratch:
            partial = Path(scratch) / out.name
            partial_labels = partial / labels.name if kind in FOLDERS else Path(scratch) / labels.name
            if kind in FOLDERS:
                partial.mkdir()
            partial_labels.write_text(_labels_csv(points, saved.faces, kind), encoding="utf-8")
            match kind:
                case "colmap-bin" | "colmap-txt":
                    write_reconstruction(reconstruction, partial, text=kind == "colmap-txt")
                case "nvm":
                    partial.write_text(_nvm(reconstruction, points, camera, focal_px), encoding="utf-8")
                case "bundler":
                    bundle, names = _bundler(reconstruction, points, camera, focal_px)
                    (partial / "bundle.out").write_text(bundle, encoding="utf-8")
                    (partial / "list.txt").write_text(names, encoding="utf-8")
            if kind not in FOLDERS:
                os.replace(partial_labels, labels)
            elif out.exists():
                out.rmdir()  # empty; not every system lets a folder take its place
            os.replace(partial, out)
    except OSError as error:  # a full disk names no file
        error.filename = error.filename or str(out)
        raise
    optics = (focal_px, ((camera.width - 1) / 2, (camera.height - 1) / 2)) if ideal else (None, None)
    return ExportedModel(out, labels, reconstruction.num_reg_images(), len(points), *optics)


def _require_free(out: Path, labels: Path, kind: str) -> None:
    existing = next(folder for folder in out.absolute().parents if os.path.lexists(folder))
    if not existing.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: {existing} is a file; give another place")
    empty = kind in FOLDERS and out.is_dir() and not any(out.iterdir())
    for path in (out, labels):
        if os.path.lexists(path) and not (path == out and empty):
            wanted = "a new or empty folder" if kind in FOLDERS else "a new file"
            raise InputError("E-OUTPUT-EXISTS", f"{path}: exists, and nothing is overwritten; give {wanted} for {kind}")


def _labelled_points(run: SavedRun) -> tuple[pycolmap.Reconstruction, list[_Point]]:
    """Returns the run's model with coloured points, and the points by ascending id."""
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
    rgb = colours(run)
    points = []
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
        group = groups.pop() if len(groups) == 1 else ""
        points.append(_Point(point_id, group, label, point.xyz.tolist(), colour, views))
    return reconstruction, points


def _labels_csv(points: Sequence[_Point], faces: FacesFile, kind: str) -> str:
    """Returns ``labels.csv``. Its first column is the point's id in COLMAP's files, in others its index from 0."""
    covariance = faces.circle_covariance_mm2
    rows: list[Sequence] = [LABEL_COLUMNS]
    for place, point in enumerate(points):
        sigma = [""] * 3
        if point.label in covariance:
            sigma = [f"{1e3 * s:.3f}" for s in np.sqrt(np.diag(covariance[point.label]))]
        name = point.id if kind.startswith("colmap") else place
        rows.append([name, point.group, point.label, *map(repr, point.xyz), *sigma])
    return csv_text(rows)


def _nvm(reconstruction: pycolmap.Reconstruction, points: Sequence[_Point], camera: Camera, focal_px: float) -> str:
    """Returns the model in VisualSFM's format (ccwu.me/vsfm/doc.html#nvm): y down, z forward, principal point zero.
    MeshLab needs the spaces at the ends of the first lines. A space in a name is written as a quotation mark."""
    images = _images(reconstruction)
    lines = ["NVM_V3 ", " ", f"{len(images)}  "]
    for image in images:
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat.tolist()
        centre = image.projection_center().tolist()
        lines.append(f"{image.name.replace(' ', chr(34))} {_numbers(focal_px, w, x, y, z, *centre, 0, 0)}")
    lines += ["", str(len(points))]
    for point, views in zip(points, _ideal_views(reconstruction, points, camera, focal_px), strict=True):
        lines.append(_numbers(*point.xyz, *point.rgb, len(views), *(value for view in views for value in view)))
    return "\n".join([*lines, "", "0", ""])


def _bundler(
    reconstruction: pycolmap.Reconstruction, points: Sequence[_Point], camera: Camera, focal_px: float
) -> tuple[str, str]:
    """``bundle.out`` and ``list.txt`` (Bundler's manual, section VI): y up, view along −z, image centre zero."""
    images = _images(reconstruction)
    lines = ["# Bundle file v0.3", f"{len(images)} {len(points)}"]
    up_from_down = np.diag([1.0, -1.0, -1.0])
    for image in images:
        pose = rigid_from_colmap(image.cam_from_world())
        rows = [*(up_from_down @ pose.rotation), up_from_down @ pose.translation]
        lines += [_numbers(focal_px, 0, 0), *(_numbers(*row.tolist()) for row in rows)]
    for point, views in zip(points, _ideal_views(reconstruction, points, camera, focal_px), strict=True):
        lines += [_numbers(*point.xyz), _numbers(*point.rgb)]
        lines.append(_numbers(len(views), *(value for i, k, x, y in views for value in (i, k, x, -y))))
    return "\n".join([*lines, ""]), "".join(f"{image.name}\n" for image in images)


def _images(reconstruction: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [reconstruction.image(image_id) for image_id in sorted(reconstruction.reg_image_ids())]


def _ideal_views(
    reconstruction: pycolmap.Reconstruction, points: Sequence[_Point], camera: Camera, focal_px: float
) -> list[list[tuple[int, int, float, float]]]:
    """Returns the views of every point in the ideal camera: place of the image, keypoint, and x and y, px, relative to
    the principal point, y down."""
    place = {image.image_id: i for i, image in enumerate(_images(reconstruction))}
    xy_px = [[reconstruction.image(i).points2D[k].xy for i, k in point.views] for point in points]
    counts = np.cumsum([len(views) for views in xy_px])
    ideal = focal_px * camera.normalised_from_pixel(from_colmap_px(np.concatenate(xy_px)))
    return [
        [(place[i], k, x, y) for (i, k), (x, y) in zip(point.views, xy.tolist(), strict=True)]
        for point, xy in zip(points, np.split(ideal, counts[:-1]), strict=True)
    ]


def _numbers(*values: float) -> str:
    """Returns the shortest text that reads back as the same numbers."""
    return " ".join(map(repr, values))
