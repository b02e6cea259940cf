"""Pose pairs written as other programs write them, by hand: nothing of the readers under test is used."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.handeye import HandEyePoses

Arguments = list[str]
"""Of ``stcal handeye``."""
MODEL_MM = 37.0
"""Of a unit of the model of COLMAP."""


def matrices(poses) -> np.ndarray:
    return np.array([pose.matrix() for pose in poses])


def in_metres(poses) -> np.ndarray:
    found = matrices(poses)
    found[:, :3, 3] /= 1000
    return found


def xyzw(matrix: np.ndarray) -> list[float]:
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()


def line(values, separator: str = " ") -> str:
    return separator.join(repr(float(value)) for value in values)


def message(matrix: np.ndarray) -> dict:
    """geometry_msgs/Transform."""
    at, turn = matrix[:3, 3].tolist(), xyzw(matrix)
    return {"translation": dict(zip("xyz", at, strict=True)), "rotation": dict(zip("xyzw", turn, strict=True))}


def zivid(matrix: np.ndarray) -> str:
    rows = ",\n".join(f"      {row}" for row in matrix.tolist())
    return f"__version__:\n  serializer: 1\n  data: 1\nFloatMatrix:\n  Data:\n    [\n{rows}\n    ]\n"


def opencv_arrays(folder: Path, pairs: HandEyePoses) -> Arguments:
    a, b = matrices(pairs.base_from_flange), matrices(pairs.camera_from_board)
    np.savez(
        folder / "pairs.npz",
        R_gripper2base=a[:, :3, :3],
        t_gripper2base=a[:, :3, 3:],
        R_target2cam=b[:, :3, :3],
        t_target2cam=b[:, :3, 3:],
    )
    return [str(folder / "pairs.npz")]


def rotation_vectors(folder: Path, pairs: HandEyePoses) -> Arguments:
    """OpenCV's other way, in JSON."""
    found = {}
    for name, poses in (("gripper2base", pairs.base_from_flange), ("target2cam", pairs.camera_from_board)):
        found[f"R_{name}"] = Rotation.from_matrix(np.array(poses.rotation)).as_rotvec().tolist()
        found[f"t_{name}"] = poses.translation.tolist()
    (folder / "pairs.json").write_text(json.dumps(found))
    return [str(folder / "pairs.json")]


def stacks(folder: Path, pairs: HandEyePoses) -> Arguments:
    """npz in metres, of the inverse of one side, with names."""
    names = np.array([f"{i}.png" for i in range(len(pairs))])
    a, b = in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board.inverse())
    np.savez_compressed(folder / "pairs.npz", base_from_flange=a, board_from_camera=b, images=names)
    return [str(folder / "pairs.npz")]


def objects(folder: Path, pairs: HandEyePoses) -> Arguments:
    both = zip(matrices(pairs.base_from_flange), matrices(pairs.camera_from_board), strict=True)
    rows = [
        {"image": f"{i}.png", "base_from_flange": a.tolist(), "camera_from_board": b.tolist()}
        for i, (a, b) in enumerate(both)
    ]
    (folder / "pairs.json").write_text(json.dumps(rows))
    return [str(folder / "pairs.json")]


def json_lines(folder: Path, pairs: HandEyePoses) -> Arguments:
    both = zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)
    rows = [json.dumps({"T_base_gripper": a.tolist(), "T_cam_target": b.tolist()}) for a, b in both]
    (folder / "pairs.jsonl").write_text("\n".join(rows) + "\n")
    return [str(folder / "pairs.jsonl")]


def moveit(folder: Path, pairs: HandEyePoses) -> Arguments:
    both = zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)
    rows = [{"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()} for a, b in both]
    (folder / "samples.yaml").write_text(yaml.safe_dump(rows))
    return [str(folder / "samples.yaml")]


def easy_handeye(folder: Path, pairs: HandEyePoses, kind: str = "eye_in_hand") -> Arguments:
    """For another setup the robot's poses are written inverted."""
    flange = pairs.base_from_flange if kind == "eye_in_hand" else pairs.base_from_flange.inverse()
    both = zip(in_metres(flange), in_metres(pairs.camera_from_board), strict=True)
    samples = [{"robot": message(a), "tracking": message(b)} for a, b in both]
    content = {"parameters": {"name": "", "calibration_type": kind, "move_group": "manipulator"}, "samples": samples}
    (folder / "demo.samples").write_text(yaml.safe_dump(content, sort_keys=False))
    return [str(folder / "demo.samples")]


def easy_handeye_of_ros1(folder: Path, pairs: HandEyePoses) -> Arguments:
    lists = {}
    sides = (("hand_world_samples", pairs.base_from_flange), ("camera_marker_samples", pairs.camera_from_board))
    for name, poses in sides:
        lists[name] = {"header": {"seq": 0}, "transforms": [message(m) for m in in_metres(poses)]}
    (folder / "samples.yaml").write_text(yaml.safe_dump({"samples": lists}))
    return [str(folder / "samples.yaml")]


def two(folder: Path, a: str | bytes, b: str | bytes, suffix: str = "txt") -> Arguments:
    paths = [folder / f"{name}.{suffix}" for name in ("robot", "camera")]
    for path, content in zip(paths, (a, b), strict=True):
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return ["--a", str(paths[0]), "--b", str(paths[1])]


def text_blocks(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Four lines for each matrix; the camera's with brackets and commas, as numpy and people print them."""
    a = "\n\n".join("\n".join(line(row) for row in m) for m in matrices(pairs.base_from_flange))
    b = "\n".join("\n".join(f"[{line(row, ', ')}]," for row in m) for m in matrices(pairs.camera_from_board))
    return two(folder, a, b)


def text_rows(folder: Path, pairs: HandEyePoses) -> Arguments:
    """A name and 16 numbers; the camera's in another order, with an ending."""
    a = [f"pos{i:02d} {line(m.ravel())}" for i, m in enumerate(matrices(pairs.base_from_flange))]
    b = [f"img{i:02d}.png {line(m.ravel())}" for i, m in enumerate(matrices(pairs.camera_from_board))]
    return two(folder, "\n".join(a), "\n".join(b[::-1]))


def npy(folder: Path, pairs: HandEyePoses) -> Arguments:
    for name, poses in (("robot", pairs.base_from_flange), ("camera", pairs.camera_from_board)):
        np.save(folder / f"{name}.npy", in_metres(poses))
    return ["--a", str(folder / "robot.npy"), "--b", str(folder / "camera.npy")]


def tum(folder: Path, pairs: HandEyePoses) -> Arguments:
    """The camera's trajectory is board_from_camera, and its stamps are written otherwise."""
    head = "# timestamp tx ty tz qx qy qz qw\n"
    a = [f"{100.5 + i:.4f} {line([*m[:3, 3], *xyzw(m)])}" for i, m in enumerate(in_metres(pairs.base_from_flange))]
    inverse = in_metres(pairs.camera_from_board.inverse())
    b = [f"{100.5 + i:.1f} {line([*m[:3, 3], *xyzw(m)])}" for i, m in enumerate(inverse)]
    return two(folder, head + "\n".join(a), head + "\n".join(b))


def ros_csv(folder: Path, pairs: HandEyePoses) -> Arguments:
    """``rostopic echo -p`` of a PoseStamped and a TransformStamped; stamps that a float cannot tell apart."""
    files = []
    for parts, poses in (
        (("pose.position", "pose.orientation"), pairs.base_from_flange),
        (("transform.translation", "transform.rotation"), pairs.camera_from_board),
    ):
        names = [f"field.{parts[0]}.{c}" for c in "xyz"] + [f"field.{parts[1]}.{c}" for c in "xyzw"]
        rows = [",".join(["%time", "field.header.seq", "field.header.stamp", *names])]
        for i, m in enumerate(in_metres(poses)):
            rows.append(f"17,{i},160906036346935{i:04d},{line([*m[:3, 3], *xyzw(m)], ',')}")
        files.append("\n".join(rows) + "\n")
    return two(folder, *files, suffix="csv")


def plotjuggler(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Both topics in one file."""
    topics = ("/robot_pose/pose", "/aruco/marker/pose")
    names = [
        f"{t}/{part}/{c}" for t in topics for part, axes in (("position", "xyz"), ("orientation", "xyzw")) for c in axes
    ]
    rows = [",".join(["__time", *names])]
    for i, (a, b) in enumerate(zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)):
        rows.append(f"{i}.5,{line([*a[:3, 3], *xyzw(a), *b[:3, 3], *xyzw(b)], ',')}")
    (folder / "bag.csv").write_text("\n".join(rows) + "\n")
    return [str(folder / "bag.csv")]


def rostopic_echo(folder: Path, pairs: HandEyePoses) -> Arguments:
    """YAML documents, a message each."""
    files = []
    for poses in (pairs.base_from_flange, pairs.camera_from_board):
        messages = [
            {"header": {"seq": i, "stamp": {"secs": 100 + i, "nsecs": 5}, "frame_id": "base"}, "transform": message(m)}
            for i, m in enumerate(in_metres(poses))
        ]
        files.append("".join(f"{yaml.safe_dump(each)}---\n" for each in messages))
    return two(folder, *files, suffix="yaml")


def euler_columns(folder: Path, pairs: HandEyePoses) -> Arguments:
    """One file with both sides, its conventions in the columns."""
    a, b = pairs.base_from_flange, pairs.camera_from_board
    angles = Rotation.from_matrix(np.array(a.rotation)).as_euler("ZYX", degrees=True)
    vectors = Rotation.from_matrix(np.array(b.rotation)).as_rotvec()
    head = [f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", *(f"euler_ZYX_{i}_deg" for i in (1, 2, 3)))]
    head += [f"camera_from_board_{c}" for c in ("x_m", "y_m", "z_m", *(f"rotvec_{c}_rad" for c in "xyz"))]
    table = np.hstack([a.translation, angles, b.translation / 1000, vectors])
    (folder / "euler.csv").write_text("\n".join([",".join(head), *(line(row, ",") for row in table)]) + "\n")
    return [str(folder / "euler.csv")]


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
        (folder / "robot.csv").write_text("\n".join([head, *(line(row, ",") for row in table)]) + "\n")
        np.save(folder / "camera.npy", matrices(pairs.camera_from_board))
        return ["--a", str(folder / "robot.csv"), "--b", str(folder / "camera.npy"), "--rotation", f"robot={name}"]

    return write


def of_ur(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Lines p[x, y, z, rx, ry, rz] in metres."""
    turns = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_rotvec()
    rows = [f"p[{line([*t / 1000, *w], ', ')}]" for t, w in zip(pairs.base_from_flange.translation, turns, strict=True)]
    b = "\n".join(line(m.ravel(), "\t") for m in in_metres(pairs.camera_from_board))
    return [*two(folder, "\n".join(rows), b), "--rotation", "ur-rotvec"]


def kuka_export(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Semicolons, decimal commas, a number for each row, units in brackets, and a separator behind the last column."""
    angles = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_euler("ZYX", degrees=True)
    table = np.hstack([pairs.base_from_flange.translation, angles])
    rows = [f"{i};{line(row, ';')};".replace(".", ",") for i, row in enumerate(table, 1)]
    (folder / "robot.csv").write_text("\n".join(["Nr;X [mm];Y [mm];Z [mm];A [deg];B [deg];C [deg];", *rows]) + "\n")
    named = {f"img{i:02d}.png": m.tolist() for i, m in enumerate(matrices(pairs.camera_from_board), 1)}
    (folder / "camera.json").write_text(json.dumps(named))
    return ["--a", str(folder / "robot.csv"), "--b", str(folder / "camera.json")]


def tab_export(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Tabs and decimal commas, a line of Excel before them; KUKA's names without a unit."""
    angles = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_euler("ZYX", degrees=True)
    rows = [line(row, "\t").replace(".", ",") for row in np.hstack([pairs.base_from_flange.translation, angles])]
    (folder / "robot.txt").write_text("\n".join(["sep=\t", "X\tY\tZ\tA\tB\tC", *rows]) + "\n")
    np.save(folder / "camera.npy", matrices(pairs.camera_from_board))
    given = ["--rotation", "robot=kuka-abc", "--length-unit", "robot=mm"]
    return ["--a", str(folder / "robot.txt"), "--b", str(folder / "camera.npy"), *given]


def capital_columns(folder: Path, pairs: HandEyePoses) -> Arguments:
    turns = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_rotvec()
    rows = [line(row, ",") for row in np.hstack([pairs.base_from_flange.translation, turns])]
    (folder / "robot.csv").write_text("\n".join(["X_mm,Y_mm,Z_mm,RX,RY,RZ", *rows]) + "\n")
    np.save(folder / "camera.npy", matrices(pairs.camera_from_board))
    return ["--a", str(folder / "robot.csv"), "--b", str(folder / "camera.npy"), "--rotation", "robot=ur-rotvec"]


def kinova(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Angles about the fixed axes X, Y, Z, in this order, degrees; places in metres."""
    angles = Rotation.from_matrix(np.array(pairs.base_from_flange.rotation)).as_euler("xyz", degrees=True)
    rows = [line(row, ",") for row in np.hstack([pairs.base_from_flange.translation / 1000, angles])]
    head = "x_m,y_m,z_m,theta_x_deg,theta_y_deg,theta_z_deg"
    (folder / "robot.csv").write_text("\n".join([head, *rows]) + "\n")
    np.save(folder / "camera.npy", matrices(pairs.camera_from_board))
    return ["--a", str(folder / "robot.csv"), "--b", str(folder / "camera.npy")]


def both_in_a_row(commas: bool = False) -> Callable:
    """Six numbers of the robot's pose and six of the camera's in each line, metres, with decimal commas or without."""

    def write(folder: Path, pairs: HandEyePoses) -> Arguments:
        sides = [
            np.hstack([p.translation / 1000, Rotation.from_matrix(np.array(p.rotation)).as_rotvec()])
            for p in (pairs.base_from_flange, pairs.camera_from_board)
        ]
        rows = [line(row, ";" if commas else ",") for row in np.hstack(sides)]
        text = "# both\n" + "\n".join(rows) + "\n"
        (folder / "both.csv").write_text(text.replace(".", ",") if commas else text)
        return [str(folder / "both.csv"), "--rotation", "rotvec-rad"]

    return write


def quaternions_in_a_row(folder: Path, pairs: HandEyePoses) -> Arguments:
    both = zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)
    rows = [line([*a[:3, 3], *xyzw(a), *b[:3, 3], *xyzw(b)]) for a, b in both]
    (folder / "both.txt").write_text("\n".join(rows) + "\n")
    return [str(folder / "both.txt"), "--rotation", "xyzw"]


def counted(folder: Path, pairs: HandEyePoses) -> Arguments:
    """The number of matrices before them, and a number before each."""
    parts = [str(len(pairs))]
    for i, m in enumerate(matrices(pairs.camera_from_board)):
        parts += [str(i), *(line(row) for row in m)]
    (folder / "camera.txt").write_text("\n".join(parts) + "\n")
    named = {str(i): m.tolist() for i, m in enumerate(matrices(pairs.base_from_flange))}
    (folder / "robot.json").write_text(json.dumps(named))
    return ["--a", str(folder / "robot.json"), "--b", str(folder / "camera.txt")]


def count_alone(folder: Path, pairs: HandEyePoses) -> Arguments:
    blocks = [str(len(pairs)), *(line(row) for m in matrices(pairs.base_from_flange) for row in m)]
    rows = [str(len(pairs)), *(line(m.ravel()) for m in matrices(pairs.camera_from_board))]
    return two(folder, "\n".join(blocks), "\n".join(rows))


def camodocal(folder: Path, pairs: HandEyePoses) -> Arguments:
    """What handeye_calib_camodocal records, by OpenCV's FileStorage."""
    storage = cv2.FileStorage(str(folder / "pairs.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("frameCount", len(pairs))
    both = zip(in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board), strict=True)
    for i, (tip, tag) in enumerate(both):
        storage.write(f"T1_{i}", tip)
        storage.write(f"T2_{i}", tag)
    storage.release()
    return [str(folder / "pairs.yml")]


def zivid_folders(folder: Path, pairs: HandEyePoses) -> Arguments:
    """A file for each pose: Zivid's for the robot, OpenCV's FileStorage for the camera."""
    for name in ("robot", "camera"):
        (folder / name).mkdir()
    for i, m in enumerate(matrices(pairs.base_from_flange)):
        (folder / "robot" / f"pos{i + 1:02d}.yaml").write_text(zivid(m))
    for i, m in enumerate(matrices(pairs.camera_from_board)):
        numbers = f"rows: 4\n   cols: 4\n   dt: d\n   data: [ {line(m.ravel(), ', ')} ]"
        (folder / "camera" / f"board_{i + 1}.yml").write_text(f"%YAML:1.0\n---\nPose: !!opencv-matrix\n   {numbers}\n")
    return ["--a", str(folder / "robot"), "--b", str(folder / "camera")]


def colmap_lines(pairs: HandEyePoses, unit_mm: float) -> str:
    rows = ["# Image list with two lines of data per image:"]
    for i, m in enumerate(matrices(pairs.camera_from_board)):
        x, y, z, w = xyzw(m)
        rows += [f"{i + 1} {line([w, x, y, z, *m[:3, 3] / unit_mm])} 1 a/{i} b.png", "" if i % 2 else "1.5 2.5 -1"]
    return "\n".join(rows) + "\n"


def colmap_text(folder: Path, pairs: HandEyePoses, unit_mm: float = 1000.0) -> Arguments:
    (folder / "model").mkdir()
    (folder / "model" / "images.txt").write_text(colmap_lines(pairs, unit_mm))
    rows = [f"a/{i} b.png {line(m.ravel())}" for i, m in enumerate(matrices(pairs.base_from_flange))]
    (folder / "robot.txt").write_text("\n".join(rows).replace(" b.png", ".png"))
    named = {f"a/{i} b.png": m.tolist() for i, m in enumerate(matrices(pairs.base_from_flange))}
    (folder / "robot.json").write_text(json.dumps(named))
    return ["--a", str(folder / "robot.json"), "--b", str(folder / "model"), "--length-unit", "camera=m"]


def colmap_binary(folder: Path, pairs: HandEyePoses, unit_mm: float = 1000.0) -> Arguments:
    arguments = colmap_text(folder, pairs, unit_mm)
    (folder / "model" / "images.txt").unlink()
    parts = [struct.pack("<Q", len(pairs))]
    for i, m in enumerate(matrices(pairs.camera_from_board)):
        x, y, z, w = xyzw(m)
        parts.append(struct.pack("<I7dI", i + 1, w, x, y, z, *(m[:3, 3] / unit_mm), 1))
        parts.append(f"a/{i} b.png".encode() + b"\0" + struct.pack("<Q", i) + struct.pack("<2dq", 1.5, 2.5, -1) * i)
    (folder / "model" / "images.bin").write_bytes(b"".join(parts))
    return arguments


def kitti(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Twelve numbers in a row, as KITTI's odometry has them."""
    both = (in_metres(pairs.base_from_flange), in_metres(pairs.camera_from_board))
    return two(folder, *("\n".join(line(m[:3].ravel()) for m in side) for side in both))


def named_elements(folder: Path, pairs: HandEyePoses) -> Arguments:
    """Columns T[0][0] … T[3][3] of the robot, and r11 … r33, t1 … t3 of the camera, mm."""
    heads = (
        [f"T[{i}][{j}]" for i in range(4) for j in range(4)],
        [
            *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
            *("t1", "t2", "t3"),
        ],
    )
    a = [line(m.ravel(), ",") for m in matrices(pairs.base_from_flange)]
    b = [line([*m[:3, :3].ravel(), *m[:3, 3]], ",") for m in matrices(pairs.camera_from_board)]
    return two(folder, "\n".join([",".join(heads[0]), *a]), "\n".join([",".join(heads[1]), *b]), "csv")


FORMATS: dict[str, Callable[[Path, HandEyePoses], Arguments]] = {
    "OpenCV's arrays": opencv_arrays,
    "OpenCV's rotation vectors": rotation_vectors,
    "npz": stacks,
    "JSON": objects,
    "JSON lines": json_lines,
    "MoveIt": moveit,
    "easy_handeye": easy_handeye,
    "easy_handeye of ROS 1": easy_handeye_of_ros1,
    "text": text_blocks,
    "rows of text": text_rows,
    "npy": npy,
    "TUM": tum,
    "ROS bag": ros_csv,
    "PlotJuggler": plotjuggler,
    "rostopic": rostopic_echo,
    "columns of angles": euler_columns,
    "KUKA": robots("kuka-abc", "ZYX", ("a", "b", "c")),
    "Fanuc": robots("fanuc-wpr", "xyz", ("w", "p", "r")),
    "Stäubli": robots("staubli", "XYZ", ("rx", "ry", "rz")),
    "Yaskawa": robots("yaskawa", "xyz", ("rx", "ry", "rz"), "deg"),
    "Kawasaki": robots("kawasaki-oat", "ZYZ", ("o", "a", "t")),
    "roll, pitch, yaw": robots("rpy", "xyz", ("roll", "pitch", "yaw"), "rad"),
    "zyx by axis": robots("zyx", "zyx", ("rx", "ry", "rz"), "rad"),
    "rotation vector": robots("rotvec", "rotvec", ("rx", "ry", "rz"), "rad"),
    "UR": of_ur,
    "KUKA's export": kuka_export,
    "tabs and decimal commas": tab_export,
    "columns in capitals": capital_columns,
    "Kinova": kinova,
    "rows of 6 + 6": both_in_a_row(),
    "rows of 6 + 6, decimal commas": both_in_a_row(commas=True),
    "rows of 7 + 7": quaternions_in_a_row,
    "numbered matrices": counted,
    "count of matrices": count_alone,
    "camodocal": camodocal,
    "KITTI": kitti,
    "columns of matrices": named_elements,
    "Zivid and OpenCV folders": zivid_folders,
    "COLMAP text": colmap_text,
    "COLMAP binary": colmap_binary,
}
