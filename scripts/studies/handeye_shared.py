"""Hand-eye calibration of two real data sets, as `stcal handeye` does it: the figures of docs/accuracy.

.venv/bin/python scripts/studies/handeye_shared.py [../shared/data]

charuco_handeye: 16 photographs of a ChArUco board on a robot, static camera; each method on the same 15 splits with 5
of the 16 held out, with the camera and the board as their files have them, and as adjusted to all photographs.
dotgrid_handeye: 15 photographs of a dot board by a camera on a robot; the pitch of the dots from the robot's motion.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from scripts.runner import DATA, head, row, script
from scripts.studies.same_results import CHARUCO, DOTS, robot_table
from stcal.geometry.camera import Camera
from stcal.handeye import HandEyeOptions
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.handeye_page import outcome_report
from stcal.handeye.handeye_pipeline import ALL
from stcal.io.cameras.read import read_camera, save_camera
from stcal.workflows.handeye_inputs import read_handeye
from stcal.workflows.handeye_run import calibrate_handeye

# The two camera files of the data set differ by 8 and 14 px, and have no distortion.
DOTS_CAMERA_SIGMA = (10.0, 10.0, 15.0, 15.0, 0.1, 0.1, 0.01, 0.01)
SHOWN = ("reprojection", "pose", "shah", "park-martin", "tsai-lenz", "daniilidis", "zhao")
SPLITS, DEFAULT = {"held_out": 5}, {}


def charuco(
    data: Path, scratch: Path, splits: dict = SPLITS, method: str | None = None, adjusted: dict | None = None
) -> tuple[dict, str]:
    """What ``stcal handeye`` writes of charuco_handeye, and what it prints.

    The camera file of the data set has no distortion, which the lens has: it is adjusted; or camera and board are those
    of an output, ``adjusted``.
    """
    folder = data / "charuco_handeye" / "test_set_charuco"
    file, board = folder / "cal_data.yaml", CHARUCO
    if adjusted is not None:
        camera = Camera(1600, 1200, np.full(2, 1600.0), np.array([800.0, 600.0]), np.zeros(8))
        camera = camera.with_parameters(np.array(list(adjusted["camera"]["parameters"].values())))
        file = _camera_file(scratch, camera)
        board = board.replace("36.195", repr(adjusted["board"]["pitch_mm"]))
    return _handeye(folder, scratch, file, board, "eye-to-hand", method, splits, adjusted is None)


def dots(data: Path, scratch: Path, splits: dict = DEFAULT) -> tuple[dict, str]:
    """The same on dotgrid_handeye."""
    folder = data / "dotgrid_handeye"
    camera = read_camera(folder / "camera_intr_calibrated.yaml").sized(640, 480)
    file = _camera_file(scratch, camera, np.diag(np.square(DOTS_CAMERA_SIGMA)))
    return _handeye(folder, scratch, file, DOTS, "eye-in-hand", None, splits, True)


def _camera_file(scratch: Path, camera: Camera, covariance: np.ndarray | None = None) -> Path:
    scratch.mkdir(parents=True, exist_ok=True)
    save_camera(scratch / "cameras.txt", Camera.of(camera, "OPENCV", covariance))
    return scratch / "cameras.txt"


def _handeye(folder, scratch: Path, camera: Path, board: str, setup: str, method, splits, adjust) -> tuple[dict, str]:
    """One data set; ``adjust`` : camera and size of the board too."""
    scratch.mkdir(parents=True, exist_ok=True)
    (scratch / "board.toml").write_text(board)
    (scratch / "poses.csv").write_text(robot_table(folder / "poses"))
    files = folder / "images", scratch / "poses.csv", camera, scratch / "board.toml"
    given = read_handeye(*files, setup=setup, workers=splits.get("workers"))
    outcome = calibrate_handeye(given, method, HandEyeOptions(with_scale=adjust), refine_camera=adjust, **splits)
    return HandEyeFile.of(outcome, whole=True).content(), outcome_report(outcome).text()


def by_split(data: dict) -> np.ndarray:
    """3-D error at the board of each split, mean over the poses held out, mm."""
    return np.mean(data["splits"]["board_mm"], axis=1)


def _side_by_side(rows: dict[str, dict]) -> None:
    """Mean 3-D error at the board of the methods shown, by what they were given."""
    print()
    head("3-D error at the board, mm", *SHOWN)
    for name, found in rows.items():
        of = {each["method"]: by_split(each).mean() for each in found["methods"]}
        row(name, *(f"{of[each]:.3f}" for each in SHOWN))


def _compare(found: dict) -> None:
    park, ours = by_split(next(m for m in found["methods"] if m["method"] == "park-martin")), by_split(found)
    print("3-D error at the board by split:")
    for name, errors in ((found["method"], ours), ("park-martin", park)):
        print(f"  {name}: mean {errors.mean():.3f}, {errors.min():.3f} to {errors.max():.3f} mm")
    print(f"  {found['method']} worse than park-martin on {(ours >= park).sum()} of {len(ours)} splits")


@script({"data": DATA})
def main(given) -> None:
    data = given.data
    for name in ("charuco_handeye", "dotgrid_handeye"):
        if not (data / name).is_dir():
            sys.exit(f"error: {data / name} is missing; give the folder that holds it")
    with tempfile.TemporaryDirectory() as scratch:
        found, text = charuco(data, Path(scratch) / "charuco", method=ALL)
        print(f"charuco_handeye\n\n{text}")
        _compare(found)
        as_filed = found
        found, text = charuco(data, Path(scratch) / "adjusted", method=ALL, adjusted=found)
        print(f"\ncharuco_handeye, camera and board as adjusted\n\n{text[text.index('Methods') :]}")
        _compare(found)
        _side_by_side({"camera and board as filed": as_filed, "camera and board as adjusted": found})
        many, _ = charuco(data, Path(scratch) / "many", SPLITS | {"repeats": 60})
        print(f"reprojection over 60 splits, all adjusted: mean {by_split(many).mean():.3f} mm")
        found, text = dots(data, Path(scratch) / "dots")
        print(f"\ndotgrid_handeye\n\n{text}")
        board = found["board"]
        sigma = board["scale_sigma"] * board["pitch_mm"] / board["scale"]
        print(f"pitch found: {board['pitch_mm']:.2f} ± {sigma:.2f} mm; 20 mm on the label, 25.4 mm in target.yaml")
