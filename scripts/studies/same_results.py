"""Whether two versions of the program compute the same: every command on real and rendered data, number by number.

.venv/bin/python scripts/studies/same_results.py collect BEFORE [--bin FOLDER] [--only TEXT]
.venv/bin/python scripts/studies/same_results.py compare BEFORE AFTER

`collect` runs the commands on ../shared/data and on simulated data through the command line alone, so that it can drive
any version (`--bin`: the folder that holds its `stcal`), and keeps their outputs. `compare` names, for each output
file, the largest difference of a number, and every line of text that differs.
"""

import argparse
import csv
import json
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
KEPT = {".json", ".csv", ".toml", ".txt", ".out"}
PASSED_OVER = {".stcal", "overlays", "points3D.txt", "images.txt", "frames.txt"}
LAYOUT_TAGS = range(17)
NESTS = ("N1", "N2", "N3")
PAIRS = ("base_from_flange", "camera_from_board")

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
FANUC = ((312, -90, 0, 0), (1075, 180, 0, -90), (225, -90, 0, 0), (0, 90, -1280, 0), (0, -90, 0, 0), (0, 180, -215, 0))


def table(header: str, rows) -> str:
    """CSV of texts and numbers."""
    cells = ([cell if isinstance(cell, str) else repr(float(cell)) for cell in row] for row in rows)
    return "\n".join([header, *map(",".join, cells)]) + "\n"


def wxyz(turn: Rotation) -> np.ndarray:
    return turn.as_quat()[[3, 0, 1, 2]]


def robot_toml(name: str, convention: str, rows, coupling: str = "") -> str:
    """A robot file of D-H rows (a mm, alpha deg, d mm, theta deg)."""
    text = f'name = "{name}"\nconvention = "{convention}"\n{coupling}'
    for a, alpha, d, theta in rows:
        text += f"\n[[joint]]\na_mm = {float(a)!r}\nalpha_deg = {float(alpha)!r}\n"
        text += f"d_mm = {float(d)!r}\ntheta_deg = {float(theta)!r}\n"
    return text


def prepare(folder: Path) -> None:
    """Input files in the project's own forms, from the shared data as they were published."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "charuco.toml").write_text(CHARUCO)
    (folder / "dots.toml").write_text(DOTS)
    joints = ",".join(f"q{k}_deg" for k in range(1, 7))
    sweeps = np.loadtxt(DATA / "fanuc_sweeps" / "N1N2N3Jval.csv")
    rows = [[target, *each[15:], *each[3 * k : 3 * k + 3]] for each in sweeps for k, target in enumerate(NESTS)]
    (folder / "fanuc.csv").write_text(table(f"target,{joints},x_mm,y_mm,z_mm", rows))
    coupling = np.eye(6)
    coupling[2, 1] = 1
    coupled = ", ".join(str(row) for row in coupling.tolist())
    (folder / "fanuc.toml").write_text(robot_toml("R-2000", "standard", FANUC, f"coupling = [{coupled}]\n"))
    rokae = DATA / "rokae_tracker" / "data"
    dh = np.loadtxt(rokae / "dh.csv", delimiter=",", skiprows=1)
    (folder / "rokae.toml").write_text(robot_toml("Rokae", "modified", [(a, al, d, t) for al, a, d, t in dh]))
    measured = [re.search(r"j:\{([^}]*)\}", line) for line in (rokae / "joint_angle.csv").read_text().splitlines()]
    q = [[cell.strip() for cell in found.group(1).split(",")[:6]] for found in measured if found]
    pose = [line.split()[7:13] for line in (rokae / "laser_pos.csv").read_text().splitlines() if line.strip()]
    turn = Rotation.from_euler("xyz", [[float(v) for v in p[3:]] for p in pose], degrees=True)
    rows = [[*own, *place[:3], *wxyz(one)] for own, place, one in zip(q, pose, turn, strict=True)]
    (folder / "rokae.csv").write_text(table(f"{joints},x_mm,y_mm,z_mm,qw,qx,qy,qz", rows))
    (folder / "targets.csv").write_text(table(joints, q[:10]))
    rng = np.random.default_rng(5)
    commanded = rng.uniform(-500, 500, (40, 3))
    sizes = {"before": 0.5, "after": 0.05}.items()
    rows = [[name, *row, *(row + rng.normal(0, size, 3))] for name, size in sizes for row in commanded]
    head = "set,commanded_x_mm,commanded_y_mm,commanded_z_mm,x_mm,y_mm,z_mm"
    (folder / "measured.csv").write_text(table(head, rows))
    a = rng.uniform(-300, 300, (60, 3))
    turn = Rotation.from_rotvec([0.3, -0.5, 1.0])
    b = turn.apply(a) + np.array([1000, -400, 250]) + rng.normal(0, 0.1, (60, 3))
    b[:12] += rng.normal(0, 20, (12, 3))
    (folder / "pairs.csv").write_text(table("ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm", np.hstack([a, b])))
    truth = [Rotation.from_rotvec([0.1, 0.2, 1.5]), Rotation.from_rotvec([2.0, 0.3, -0.4])]
    places = [np.array([30.0, -20.0, 80.0]), np.array([900.0, 200.0, 50.0])]
    rows = []
    for i in range(24):
        hand = Rotation.from_rotvec(rng.normal(0, 0.8, 3))
        where = rng.uniform(-300, 300, 3) + np.array([600, 0, 500])
        # camera_from_board = (base_from_flange @ flange_from_camera)^-1 @ base_from_board
        camera = hand * truth[0]
        origin = hand.apply(places[0]) + where
        seen = camera.inv().apply(places[1] - origin) + rng.normal(0, 0.1, 3)
        board = Rotation.from_rotvec(rng.normal(0, 2e-4, 3)) * (camera.inv() * truth[1])
        rows.append([f"hand{i}", *where, *wxyz(hand), *seen, *wxyz(board)])
    head = [f"{pair}_{k}" for pair in PAIRS for k in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")]
    (folder / "handeye.csv").write_text(table(",".join(["name", *head]), rows))
    (folder / "charuco_poses.csv").write_text(robot_table(DATA / "charuco_handeye" / "test_set_charuco" / "poses"))
    (folder / "dots_poses.csv").write_text(robot_table(DATA / "dotgrid_handeye" / "poses"))
    tags = "".join(f'\n[[tag]]\ndictionary = "DICT_6X6_250"\nid = {k}\nsize_mm = 18.256\n' for k in LAYOUT_TAGS)
    (folder / "layout.toml").write_text(f'type = "tags"\nname = "charuco"\norigin = 8\n{tags}')


def robot_table(folder: Path) -> str:
    """The robot's poses of ROS-Industrial's files, one for each image, as a table."""
    text = "image,x_m,y_m,z_m,qw,qx,qy,qz\n".replace(",", ",base_from_flange_")
    for file in sorted(folder.glob("*.yaml")):
        pose = dict(line.split(": ") for line in file.read_text().splitlines() if ": " in line)
        text += ",".join([file.stem, *(pose[key] for key in ("x", "y", "z", "qw", "qx", "qy", "qz"))]) + "\n"
    return text


def tasks(inputs: Path, out: Path) -> list[tuple[str, list]]:
    """(name, arguments of ``stcal``); outputs of a command go into the folder of its name, ``@``."""
    found = []
    places = {"data": DATA, "inputs": inputs, "out": out, "set": DATA / "stereo_target"}

    def add(name: str, command: str) -> None:
        found.append((name, [word.replace("@", str(out / name)).format(**places) for word in command.split()]))

    add("demo", "sfm demo --out @/demo")
    for name in ("sample", "clean", "clutter", "exact", "white_block", "exact_png"):
        folder = name.removesuffix("_png")
        designs = [k for k in ("target", "board") if (places["set"] / folder / f"{k}.toml").exists()]
        more = " ".join(f"--{k}={{set}}/{folder}/{k}.toml" for k in designs)
        images = "images_png" if name == "exact_png" else "images"
        add(
            f"run_{name}", f"sfm run {{set}}/{folder}/{images} --camera {{set}}/{folder}/cameras.txt --out @/run {more}"
        )
        if name != "exact_png":
            add(
                f"compare_{name}", f"sfm compare {{out}}/run_{name}/run {{set}}/{name}/truth.json --json @/compare.json"
            )
    sample, images, camera = "{out}/run_sample/run", "{set}/sample/images", "--camera {set}/sample/cameras.txt"
    for name, option in (
        ("chain", "--solve chain"),
        ("refined", "--refine-camera"),
        ("control", "--no-eccentricity"),
    ):
        add(f"run_{name}", f"sfm run {images} {camera} --out @/run {option}")
    add("detect", f"sfm detect {images} {camera} --out @/detect")
    files = "--out @/poses.csv --json @/all.json --report @/p.html"
    measured = files.replace("all.json", "poses.json")
    add("measure", f"sfm measure {images} {camera} --faces {sample}/faces.json {measured}")
    add("calibrate_camera", f"sfm calibrate-camera {images} --out @/cameras.txt")
    add("advise", f"sfm advise {sample} --count 2 --json @/advice.json")
    add("plan", "sfm plan --images 6 --json @/plan.json")
    add("export", f"sfm export-model {sample} @/model --format colmap-txt")
    add("faces", "sfm faces {out}/demo/demo/run/colmap/models --run {out}/demo/demo/run --out @/faces.json")
    add("crosscheck", "sfm crosscheck {out}/demo/demo/run")

    page = "--json @/all.json --report @/p.html"
    robot, rokae = "--out @/robot.toml --json @/robot.json --report @/p.html", "--robot {inputs}/rokae.toml"
    axes = robot.replace("robot", "axes")
    add("axes", f"robot axes {{inputs}}/fanuc.csv --robot {{inputs}}/fanuc.toml {axes}")
    for kind in ("pose", "position", "distance"):
        add(f"identify_{kind}", f"robot identify {{inputs}}/rokae.csv {rokae} --observe {kind} {robot}")
    models = "--robot {out}/identify_pose/robot.toml --nominal {inputs}/rokae.toml"
    add("compensate", f"robot compensate {{inputs}}/targets.csv {models} --out @/joints.csv {page}")
    add("verify", f"robot verify {{inputs}}/measured.csv {page}")
    add("design", f"robot design {rokae} --count 24 --candidates 200 {files}")

    result = "--out @/all.json --report @/p.html"
    for model in ("rigid", "similarity", "affine"):
        add(f"register_{model}", f"register {{inputs}}/pairs.csv --model {model} {result}")
    add("register_least", f"register {{inputs}}/pairs.csv --method least-squares {result}")
    add("register_liu", f"register {{inputs}}/pairs.csv --method liu2017 {result}")
    for name in ("flat", "outdoor"):
        add(f"register_{name}", f"register {{inputs}}/hilti/{name}.csv {result}")
    known = "--robot {inputs}/hilti/robot.toml --identified @/robot.toml"
    add("register_robot", f"register {{inputs}}/hilti/flat.csv {known} {result}")

    add("handeye_poses", f"handeye {{inputs}}/handeye.csv --method all --splits 3 --out @/hand.json {page}")
    charuco = "{data}/charuco_handeye/test_set_charuco"
    camera, board = f"--camera {charuco}/cal_data.yaml", "--board {inputs}/charuco.toml"
    poses = "--poses {inputs}/charuco_poses.csv --setup eye-to-hand --held-out 5"
    given = f"handeye {charuco}/images {poses} {camera} {board}"
    for name, options in (
        ("", ""),
        ("_all", "--method all"),
        ("_refined", "--refine-camera --with-scale --camera-out @/cameras.txt"),
    ):
        add(f"handeye_charuco{name}", f"{given} --splits 3 {page} {options}")
    dots = "{data}/dotgrid_handeye"
    known = f"--camera {dots}/camera_intr_calibrated.yaml --poses {{inputs}}/dots_poses.csv"
    add(
        "handeye_dots",
        f"handeye {dots}/images {known} --board {{inputs}}/dots.toml --with-scale --splits 2 --json @/all.json",
    )

    layout = "--layout {inputs}/layout.toml --out @/layout.toml --json @/all.json"
    add("locate_calibrate", f"locate calibrate {charuco}/images {camera} {board} {layout}")
    for method in ("joint", "patent"):
        layout = f"--layout {{out}}/locate_calibrate/layout.toml --method {method}"
        add(f"locate_{method}", f"locate run {charuco}/images {camera} {layout} {files}")
    return found


def collect(out: Path, program: Path, only: str, inputs: Path) -> None:
    """Run the commands; what they print goes to ``printed.out`` beside their files."""
    for name, arguments in tasks(inputs, out):
        if not re.search(only, name) or (out / name / "printed.out").exists():
            continue
        (out / name).mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        done = subprocess.run([program / "stcal", *arguments], capture_output=True, text=True, check=False)
        said = [line for line in done.stderr.splitlines() if not re.fullmatch(r"[\w ]+: \d+ of \d+", line)]
        text = done.stdout + "".join(f"stderr: {line}\n" for line in said) + f"exit code {done.returncode}\n"
        (out / name / "printed.out").write_text(text.replace(str(out), "OUT").replace(str(inputs), "IN"))
        last = f"; {said[-1][:150]}" if done.returncode and said else ""
        print(f"{name}: exit code {done.returncode}, {time.monotonic() - start:.1f} s{last}", flush=True)


def numbers(value, where: str = "") -> dict[str, float | str]:
    """Leaves of a JSON or TOML value by their path."""
    if isinstance(value, dict):
        return {k: v for key, each in value.items() for k, v in numbers(each, f"{where}.{key}").items()}
    if isinstance(value, list):
        return {k: v for i, each in enumerate(value) for k, v in numbers(each, f"{where}[{i}]").items()}
    return {where: value}


def leaves(path: Path) -> dict[str, float | str]:
    """Numbers and texts of a file by place."""
    text = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".json":
        return numbers(json.loads(text))
    if path.suffix == ".toml":
        return numbers(tomllib.loads(text))
    if path.suffix == ".csv":
        rows = list(csv.reader(text.splitlines()))
        return {f"{i}:{j}": _cell(cell) for i, row in enumerate(rows) for j, cell in enumerate(row)}
    return {f"line {i}": line for i, line in enumerate(text.splitlines(), 1)}


def _cell(text: str):
    try:
        return float(text)
    except ValueError:
        return text


def compare(before: Path, after: Path, most: int) -> int:
    """Print what differs; the number of files that differ by more than rounding."""
    files = {
        str(path.relative_to(folder)) for folder in (before, after) for path in folder.rglob("*")
        if path.suffix in KEPT and not PASSED_OVER & set(path.relative_to(folder).parts)
        and "inputs" not in path.relative_to(folder).parts
    }  # fmt: skip
    differ = 0
    for name in sorted(files):
        a, b = before / name, after / name
        if not a.exists() or not b.exists():
            print(f"{name}: only {'after' if b.exists() else 'before'}")
            differ += 1
            continue
        old, new = leaves(a), leaves(b)
        apart, worst, place = [], 0.0, ""
        for key in [*old, *(k for k in new if k not in old)]:
            x, y = old.get(key, "–"), new.get(key, "–")
            if isinstance(x, int | float) and isinstance(y, int | float) and not isinstance(x, bool):
                if x != y and not (x != x and y != y) and abs(x - y) > worst:
                    worst, place = abs(x - y), f"{key}: {x!r} → {y!r}"
            elif str(x).replace(str(before), "OUT") != str(y).replace(str(after), "OUT"):
                apart.append(f"{key}: {x!r} → {y!r}")
        if worst or apart:
            differ += 1
            print(f"{name}: largest difference {worst:.3g} at {place}" if worst else f"{name}:")
            for line in apart[:most]:
                print(f"  {line[:300]}")
            if len(apart) > most:
                print(f"  … and {len(apart) - most} more")
    print(f"{len(files)} files compared, {differ} differ")
    return differ


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser("collect")
    collecting.add_argument("out", type=Path)
    collecting.add_argument("--bin", type=Path, default=Path(sys.executable).parent)
    collecting.add_argument("--only", default="", help="regular expression of names")
    collecting.add_argument("--inputs", type=Path, help="folder of prepared inputs; made in OUT if not given")
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument("--most", type=int, default=6)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        sys.exit(compare(arguments.before, arguments.after, arguments.most) > 0)
    inputs = (arguments.inputs or arguments.out / "inputs").resolve()
    prepare(inputs)
    hilti = next(Path(__file__).resolve().parents[1].rglob("register_shared.py"))
    if not (inputs / "hilti").exists():
        data = DATA / "hilti_stationing"
        subprocess.run([sys.executable, str(hilti), str(data), "--write", str(inputs / "hilti")], check=True)
    collect(arguments.out.resolve(), arguments.bin.resolve(), arguments.only, inputs)


if __name__ == "__main__":
    main()
