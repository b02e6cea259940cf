"""Hand-eye calibration of two real data sets, as `stcal handeye` does it: the figures of docs/accuracy.

.venv/bin/python scripts/studies/handeye_shared.py [../shared/data]

charuco_handeye: 16 photographs of a ChArUco board on a robot, static camera; each method on the same 15 splits with 5
of the 16 held out, with the camera and the board as their files have them, and as adjusted to all photographs.
dotgrid_handeye: 15 photographs of a dot board by a camera on a robot; the pitch of the dots from the robot's motion.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

from stcal.geometry.camera import Camera
from stcal.handeye import HandEyeOptions
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.handeye_page import outcome_report
from stcal.io.cameras.camera_model import write_cameras_txt
from stcal.io.cameras.read import read_camera
from stcal.workflows.handeye_inputs import read_handeye
from stcal.workflows.handeye_run import ALL, calibrate_handeye

CHARUCO = """type = "charuco"
rows = 7
columns = 5
square_mm = 36.195
marker_mm = 18.256
dictionary = "DICT_6X6_250"
"""
DOTS = """# As the label on the sheet has it; target.yaml says 25.4 mm.
rows = 10
columns = 10
pitch_mm = 20.0
radius_mm = 5.0
polarity = "dark"
sigma_mm = 0.1

[corner]
row = 9
column = 0
radius_mm = 10.0
"""
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
    write_cameras_txt(scratch / "cameras.txt", Camera.of(camera, "OPENCV", covariance))
    return scratch / "cameras.txt"


def robot_table(folder: Path, path: Path) -> Path:
    """Writes the robot's poses of ROS-Industrial's files, one for each image, as a table."""
    names = [f"base_from_flange_{name}" for name in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
    rows = [["image", *names]]
    for file in sorted(folder.glob("*.yaml")):
        pose = yaml.safe_load(file.read_text(encoding="utf-8"))
        rows.append([file.stem, *(repr(float(pose[key])) for key in ("x", "y", "z", "qw", "qx", "qy", "qz"))])
    path.write_text("".join(",".join(row) + "\n" for row in rows), encoding="utf-8")
    return path


def _handeye(
    folder: Path,
    scratch: Path,
    camera: Path,
    board: str,
    setup: str,
    method: str | None,
    splits: dict,
    adjust: bool,
) -> tuple[dict, str]:
    """One data set; ``adjust`` : camera and size of the board too."""
    scratch.mkdir(parents=True, exist_ok=True)
    (scratch / "board.toml").write_text(board)
    poses = robot_table(folder / "poses", scratch / "poses.csv")
    files, workers = (folder / "images", poses, camera, scratch / "board.toml"), splits.get("workers")
    given = read_handeye(*files, setup=setup, workers=workers)
    outcome = calibrate_handeye(given, method, HandEyeOptions(with_scale=adjust), refine_camera=adjust, **splits)
    return HandEyeFile.of(outcome, whole=True).content(), outcome_report(outcome).text()


def by_split(data: dict) -> np.ndarray:
    """3-D error at the board of each split, mean over the poses held out, mm."""
    return np.mean(data["splits"]["board_mm"], axis=1)


def _side_by_side(rows: dict[str, dict]) -> None:
    """Mean 3-D error at the board of the methods shown, by what they were given."""
    print(f"\n| 3-D error at the board, mm | {' | '.join(SHOWN)} |\n|{'---|' * (len(SHOWN) + 1)}")
    for name, found in rows.items():
        of = {row["method"]: by_split(row).mean() for row in found["methods"]}
        print(f"| {name} | {' | '.join(f'{of[each]:.3f}' for each in SHOWN)} |")


def _compare(found: dict) -> None:
    park, ours = by_split(next(row for row in found["methods"] if row["method"] == "park-martin")), by_split(found)
    print("3-D error at the board by split:")
    for name, errors in ((found["method"], ours), ("park-martin", park)):
        print(f"  {name}: mean {errors.mean():.3f}, {errors.min():.3f} to {errors.max():.3f} mm")
    print(f"  {found['method']} worse than park-martin on {(ours >= park).sum()} of {len(ours)} splits")


def main() -> None:
    """Both data sets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(__file__).resolve().parents[3] / "shared" / "data"
    parser.add_argument("data", nargs="?", type=Path, default=shared, help="folder of the data sets")
    data = parser.parse_args().data
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


if __name__ == "__main__":
    main()
