"""A finished run read back from its folder, for every command that goes on from it."""

import csv
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from stcal.camera_file import read_camera
from stcal.design import BoardDesign, TargetDesign
from stcal.design_file import load_board, load_target
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.images import RUN_MARKER
from stcal.sfm.observations import ImageObservations, by_group
from stcal.sfm.options import RunOptions
from stcal.sfm.pairs import PairOptions

CAMERA, TARGET, BOARD = "cameras.txt", "target.toml", "board.toml"
"""Copies of what the run was given."""


COVARIANCE = ("var_x_px2", "cov_xy_px2", "var_y_px2")


@dataclass(frozen=True, slots=True, eq=False)
class SavedRun:
    """What a run's folder holds.

    ``images`` : the folder of photographs as the run was given it; ``observations`` : of all images, in the database's
    order, without the shapes of the ellipses (zero); ``corrected_px`` : by image, (n, 2), what the database holds;
    ``faces``, ``report`` : content of ``faces.json`` and ``report.json``.
    """

    folder: Path
    images: Path
    options: RunOptions
    camera: Camera
    colmap_model: str
    target: TargetDesign
    board: BoardDesign
    observations: tuple[ImageObservations, ...]
    corrected_px: tuple[np.ndarray, ...]
    faces: dict
    report: dict

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return self.folder / "database.db"

    def groups(self) -> dict[str, list[ImageObservations]]:
        """Observations by group, in order."""
        return by_group(self.observations)


def marker_json(images: str | Path, options: RunOptions | None) -> dict:
    """What ``stcal-run.json`` says of a run besides program and version."""
    return {"images": str(Path(images).absolute()), "options": None if options is None else asdict(options)}


def load_run(folder: str | Path) -> SavedRun:
    """Read a finished run.

    Raises
    ------
    InputError
        Not a run's folder, an unfinished one, or a damaged file in it.
    """
    folder = Path(folder)
    if not (folder / RUN_MARKER).is_file():
        raise InputError(f"run {folder}: not a run's folder (no {RUN_MARKER}); give the --out of a finished run")
    needed = (CAMERA, TARGET, BOARD, "labels.csv", "database.db", "report.json", "faces.json")
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise InputError(f"run {folder}: unfinished, or of another version: no {', '.join(missing)}; run it again")
    marker, faces, report = (_json(folder / name) for name in (RUN_MARKER, "faces.json", "report.json"))
    model = read_camera(folder / CAMERA)
    camera = model.sized(0, 0)
    try:
        options, images = _options(marker["options"]), Path(marker["images"])
        names = [(each["name"], each["group"]) for each in report["images"]]
    except (KeyError, TypeError) as error:
        raise InputError(f"run {folder}: of another version ({error}); run it again") from error
    observations, corrected = _labels(folder / "labels.csv", names, camera)
    target, board = load_target(folder / TARGET), load_board(folder / BOARD)
    return SavedRun(
        folder, images, options, camera, model.colmap_model, target, board, observations, corrected, faces, report
    )


def _options(stored: dict) -> RunOptions:
    pairs, ellipses = PairOptions(**stored["pairs"]), EllipseOptions(**stored["ellipses"])
    return RunOptions(**(stored | {"pairs": pairs, "ellipses": ellipses}))


def _json(path: Path) -> dict:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run it again") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a JSON object; run it again")
    return content


def _labels(path: Path, names: list[tuple[str, str]], camera: Camera):
    """Observations and corrected centres of ``labels.csv`` for the images (name, group) of the database."""
    rows: dict[str, list[dict]] = {name: [] for name, _ in names}
    try:
        with open(path, encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                rows[row["image"]].append(row)
        observations, corrected = [], []
        for name, group in names:
            own = rows[name]
            if [int(row["keypoint"]) for row in own] != list(range(len(own))):
                raise ValueError(f"image {name}: keypoints are not in the order of the database")
            xy, xy_corrected = (
                np.array([[row[f"{kind}x_px"], row[f"{kind}y_px"]] for row in own], float).reshape(-1, 2)
                for kind in ("", "corrected_")
            )
            xx, xy_, yy = (np.array([row[key] for row in own], float) for key in COVARIANCE)
            observations.append(
                ImageObservations(
                    name,
                    group,
                    tuple(row["label"] for row in own),
                    xy,
                    camera.normalised_from_pixel(xy),
                    np.zeros((len(own), 2, 2)),
                    np.stack([xx, xy_, xy_, yy], axis=1).reshape(-1, 2, 2),
                )
            )
            corrected.append(xy_corrected)
    except (OSError, KeyError, TypeError, ValueError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise InputError(f"{path}: cannot be read ({reason}); run it again") from error
    return tuple(observations), tuple(corrected)
