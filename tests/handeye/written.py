"""Pose pairs written as other programs write them, by hand: nothing of the readers under test is used."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyePoses
from stcal.io.table import POSE, pose_cells
from tests.shared import written

Arguments = list[str]
"""Of ``stcal handeye``."""


def table(path: Path, sides: dict[str, Poses], edit: Callable | None = None, unit: str = "mm", **columns) -> Path:
    """A CSV file of ``columns``, and of poses with their names before their columns; ``edit`` changes the rows."""
    heads = [f"{name}_{c}".lstrip("_").replace("_mm", f"_{unit}") for name in sides for c in POSE]
    per_unit = {"mm": 1, "m": 1000}[unit]
    own = zip(*columns.values(), strict=True) if columns else [()] * len(next(iter(sides.values())))
    rows = [
        [*map(str, values), *(cell for p in poses for cell in pose_cells(Rigid(p.rotation, p.translation / per_unit)))]
        for values, *poses in zip(own, *sides.values(), strict=True)
    ]
    if edit:
        edit(rows)
    return written(path, "\n".join(",".join(line) for line in [[*columns, *heads], *rows]) + "\n")


def poses_file(path: Path, truth, edit: Callable | None = None) -> Path:
    return table(path, sides_of(truth.pairs), edit)


def sides_of(pairs: HandEyePoses) -> dict[str, Poses]:
    return {"base_from_flange": pairs.base_from_flange, "camera_from_board": pairs.camera_from_board}


def in_metres(poses: Poses) -> np.ndarray:
    return poses.matrix() * np.vstack([[[1, 1, 1, 1e-3]] * 3, [1] * 4])


def saved(folder: Path, pairs: HandEyePoses, metres: bool = True) -> str:
    """The board's poses as 4×4 matrices in a file."""
    path, poses = folder / "camera.npy", pairs.camera_from_board
    np.save(path, in_metres(poses) if metres else poses.matrix())
    return str(path)


def xyzw(matrix: np.ndarray) -> list[float]:
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()


def line(values, separator: str = " ") -> str:
    return separator.join(repr(float(value)) for value in values)


def message(matrix: np.ndarray) -> dict:
    """geometry_msgs/Transform."""
    at, turn = matrix[:3, 3].tolist(), xyzw(matrix)
    return {"translation": dict(zip("xyz", at, strict=True)), "rotation": dict(zip("xyzw", turn, strict=True))}


def opencv_arrays(folder: Path, pairs: HandEyePoses) -> Arguments:
    sides = {"gripper2base": pairs.base_from_flange, "target2cam": pairs.camera_from_board}
    turns = {f"R_{name}": poses.rotation for name, poses in sides.items()}
    np.savez(folder / "pairs.npz", **turns, **{f"t_{n}": poses.translation[:, :, None] for n, poses in sides.items()})
    return [str(folder / "pairs.npz")]


def stacks(folder: Path, pairs: HandEyePoses) -> Arguments:
    """npz in metres, of the inverse of one side, with names."""
    names = np.array([f"{i}.png" for i in range(len(pairs))])
    a, b = in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board.inverse())
    np.savez_compressed(folder / "pairs.npz", base_from_flange=a, board_from_camera=b, images=names)
    return [str(folder / "pairs.npz")]


def objects(folder: Path, pairs: HandEyePoses) -> Arguments:
    sides = {name: poses.matrix().tolist() for name, poses in sides_of(pairs).items()}
    rows = [{"image": f"{i}.png", **{n: side[i] for n, side in sides.items()}} for i in range(len(pairs))]
    return [str(written(folder / "pairs.json", json.dumps(rows)))]


def moveit(folder: Path, pairs: HandEyePoses) -> Arguments:
    both = zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)
    rows = [{"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()} for a, b in both]
    return [str(written(folder / "samples.yaml", yaml.safe_dump(rows)))]


def easy_handeye(folder: Path, pairs: HandEyePoses, kind: str = "eye_in_hand") -> Arguments:
    """For another setup the robot's poses are written inverted."""
    flange = pairs.base_from_flange if kind == "eye_in_hand" else pairs.base_from_flange.inverse()
    both = zip(in_metres(flange), in_metres(pairs.camera_from_board), strict=True)
    samples = [{"robot": message(a), "tracking": message(b)} for a, b in both]
    content = {"parameters": {"name": "", "calibration_type": kind, "move_group": "manipulator"}, "samples": samples}
    return [str(written(folder / "demo.samples", yaml.safe_dump(content, sort_keys=False)))]


def easy_handeye_of_ros1(folder: Path, pairs: HandEyePoses) -> Arguments:
    lists = {}
    sides = (("hand_world_samples", pairs.base_from_flange), ("camera_marker_samples", pairs.camera_from_board))
    for name, poses in sides:
        lists[name] = {"header": {"seq": 0}, "transforms": [message(m) for m in in_metres(poses)]}
    return [str(written(folder / "samples.yaml", yaml.safe_dump({"samples": lists})))]


def two(folder: Path, a: str | bytes, b: str | bytes, suffix: str = "txt") -> Arguments:
    files = (written(folder / f"{name}.{suffix}", text) for name, text in (("robot", a), ("camera", b)))
    return [word for option, path in zip(("--a", "--b"), files, strict=True) for word in (option, str(path))]


def columns_in_metres(folder: Path, pairs: HandEyePoses) -> Arguments:
    """A table with quaternions, of the inverses of both sides."""
    inverses = pairs.base_from_flange.inverse(), pairs.camera_from_board.inverse()
    sides = dict(zip(("flange_from_base", "board_from_camera"), inverses, strict=True))
    return [str(table(folder / "poses.csv", sides, unit="m"))]


def npy(folder: Path, pairs: HandEyePoses) -> Arguments:
    np.save(folder / "robot.npy", in_metres(pairs.base_from_flange))
    return ["--a", str(folder / "robot.npy"), "--b", saved(folder, pairs)]


def trajectory(stamps: list[str], poses: Poses) -> str:
    """The text of a TUM trajectory."""
    rows = [f"{t} {line([*m[:3, 3], *xyzw(m)])}\n" for t, m in zip(stamps, in_metres(poses), strict=True)]
    return "# timestamp tx ty tz qx qy qz qw\n" + "".join(rows)


def tum(folder: Path, pairs: HandEyePoses) -> Arguments:
    """The camera's trajectory is board_from_camera, and its stamps are written otherwise."""
    a, b = ([f"{100.5 + i:.{digits}f}" for i in range(len(pairs))] for digits in (4, 1))
    texts = trajectory(a, pairs.base_from_flange), trajectory(b, pairs.camera_from_board.inverse())
    return two(folder, *texts)


def euler_columns(folder: Path, pairs: HandEyePoses) -> Arguments:
    """One file with both sides, its conventions in the columns."""
    a, b = pairs.base_from_flange, pairs.camera_from_board
    angles = Rotation.from_matrix(np.array(a.rotation)).as_euler("ZYX", degrees=True)
    vectors = Rotation.from_matrix(np.array(b.rotation)).as_rotvec()
    head = [f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", *(f"euler_ZYX_{i}_deg" for i in (1, 2, 3)))]
    head += [f"camera_from_board_{c}" for c in ("x_m", "y_m", "z_m", *(f"rotvec_{c}_rad" for c in "xyz"))]
    table = np.hstack([a.translation, angles, b.translation / 1000, vectors])
    return [str(written(folder / "euler.csv", "\n".join([",".join(head), *(line(row, ",") for row in table)]) + "\n"))]


def robots(name: str, order: str, columns: tuple[str, str, str], unit: str = "") -> Callable:
    """A table as a robot of that name shows it, beside matrices of the camera. ``order`` of turning about axes, small
    for fixed ones; the values of the columns in that order."""

    def write(folder: Path, pairs: HandEyePoses) -> Arguments:
        turns = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation))
        values = turns.as_rotvec() if order == "rotvec" else turns.as_euler(order, degrees=unit != "rad")
        by_axis = ["xyz".index(c) for c in order.lower()] if order != "rotvec" and columns[0] == "rx" else [0, 1, 2]
        named = np.empty_like(values)
        named[:, by_axis] = values
        table = np.hstack([pairs.base_from_flange.translation, named])
        head = ",".join(["x_mm", "y_mm", "z_mm", *(f"{c}_{unit}" if unit else c for c in columns)])
        text = "\n".join([head, *(line(row, ",") for row in table)]) + "\n"
        robot, camera = str(written(folder / "robot.csv", text)), saved(folder, pairs, metres=False)
        return ["--a", robot, "--b", camera, "--rotation", f"robot={name}"]

    return write


def of_ur(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Lines p[x, y, z, rx, ry, rz] in metres."""
    turns = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_rotvec()
    rows = [f"p[{line([*t / 1000, *w], ', ')}]" for t, w in zip(pairs.base_from_flange.translation, turns, strict=True)]
    (folder / "robot.txt").write_text("\n".join(rows))
    return ["--a", str(folder / "robot.txt"), "--b", saved(folder, pairs), "--rotation", "robot=ur-rotvec"]


def file_storage(folder: Path, pairs: HandEyePoses) -> Arguments:
    for name, poses in (("robot", pairs.base_from_flange), ("camera", pairs.camera_from_board)):
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        for i, matrix in enumerate(poses.matrix()):
            storage.write(f"image_{i}", matrix)
        storage.release()
    return ["--a", str(folder / "robot.yml"), "--b", str(folder / "camera.yml")]


FORMATS: dict[str, Callable[[Path, HandEyePoses], Arguments]] = {
    "OpenCV's arrays": opencv_arrays,
    "npz": stacks,
    "columns in metres": columns_in_metres,
    "JSON": objects,
    "MoveIt": moveit,
    "easy_handeye": easy_handeye,
    "easy_handeye of ROS 1": easy_handeye_of_ros1,
    "npy": npy,
    "OpenCV's FileStorage": file_storage,
    "TUM": tum,
    "columns of angles": euler_columns,
    "KUKA": robots("kuka-abc", "ZYX", ("a", "b", "c")),
    "roll, pitch, yaw": robots("rpy", "xyz", ("roll", "pitch", "yaw"), "rad"),
    "rotation vector in capitals": robots("ur-rotvec", "rotvec", ("RX", "RY", "RZ")),
    "UR": of_ur,
}
EYE = "1 0 0 0.1\n0 1 0 0.2\n0 0 1 0.3\n0 0 0 1\n"
LISTED = [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
MESSAGE = "{translation: {x: 0.1, y: 0.2, z: 0.3}, rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}}"
SIX = "0.1 0.2 0.3 0.1 0.2 0.3"
REFUSED = {
    "matrices as text": EYE,
    "a name and six numbers": f"a.png {SIX}",
    "decimal commas": SIX.replace(" ", ";").replace(".", ","),
    "EuRoC's ground truth": f"#timestamp [ns]\n1403636579763555584,{SIX.replace(' ', ',')},0,0,0,0",
    "JSON lines": f'{{"base_from_flange": {LISTED}, "camera_from_board": {LISTED}}}\n' * 2,
    "rotation vectors in JSON": '{"R_gripper2base": [[0.1,0.2,0.3]], "t_gripper2base": [[1,2,3]]}',
    "rostopic echo": f"transform: {MESSAGE}\n---\ntransform: {MESSAGE}\n---\n",
    "ROS bag": "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,field.pose.orientation.x,"
    "field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w\n1,0.1,0.2,0.3,0,0,0,1\n",
    "FANUC's program": "/PROG  A\n/POS\nP[1]{\n   GP1:\n\tX = 1.0  mm,\tY = 2.0  mm,\tZ = 3.0  mm,\n};\n/END\n",
}
"""Poses in formats that are not read."""
