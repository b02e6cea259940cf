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
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
KEPT = {".json", ".csv", ".toml", ".txt", ".out"}
PASSED_OVER = {".stcal", "overlays", "points3D.txt", "images.txt", "frames.txt"}
LAYOUT_TAGS = range(17)

CHARUCO = """type = "charuco"
rows = 7
columns = 5
square_mm = 36.195
marker_mm = 18.256
dictionary = "DICT_6X6_250"
"""
DOTS = """rows = 10
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
    lines = ["target,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"]
    for row in np.loadtxt(DATA / "fanuc_sweeps" / "N1N2N3Jval.csv"):
        for k, target in enumerate(("N1", "N2", "N3")):
            lines.append(",".join([target, *map(repr, [*row[15:].tolist(), *row[3 * k : 3 * k + 3].tolist()])]))
    (folder / "fanuc.csv").write_text("\n".join(lines) + "\n")
    coupling = np.eye(6)
    coupling[2, 1] = 1
    rows = ", ".join(str(row) for row in coupling.tolist())
    (folder / "fanuc.toml").write_text(robot_toml("R-2000", "standard", FANUC, f"coupling = [{rows}]\n"))
    rokae = DATA / "rokae_tracker" / "data"
    dh = np.loadtxt(rokae / "dh.csv", delimiter=",", skiprows=1)
    (folder / "rokae.toml").write_text(robot_toml("Rokae", "modified", [(a, al, d, t) for al, a, d, t in dh]))
    joints = [re.search(r"j:\{([^}]*)\}", line) for line in (rokae / "joint_angle.csv").read_text().splitlines()]
    q = [[cell.strip() for cell in found.group(1).split(",")[:6]] for found in joints if found]
    pose = [line.split()[7:13] for line in (rokae / "laser_pos.csv").read_text().splitlines() if line.strip()]
    turn = Rotation.from_euler("xyz", [[float(v) for v in p[3:]] for p in pose], degrees=True).as_quat()[
        :, [3, 0, 1, 2]
    ]
    lines = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
    for own, place, wxyz in zip(q, pose, turn, strict=True):
        lines.append(",".join([*own, *place[:3], *[repr(float(v)) for v in wxyz]]))
    (folder / "rokae.csv").write_text("\n".join(lines) + "\n")
    targets = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg", *[",".join(own) for own in q[:10]]]
    (folder / "targets.csv").write_text("\n".join(targets) + "\n")
    rng = np.random.default_rng(5)
    commanded = rng.uniform(-500, 500, (40, 3))
    header = "set,commanded_x_mm,commanded_y_mm,commanded_z_mm,x_mm,y_mm,z_mm"
    lines = [header]
    for name, size in (("before", 0.5), ("after", 0.05)):
        for row in commanded:
            lines.append(",".join([name, *map(repr, [*row.tolist(), *(row + rng.normal(0, size, 3)).tolist()])]))
    (folder / "measured.csv").write_text("\n".join(lines) + "\n")
    a = rng.uniform(-300, 300, (60, 3))
    turn = Rotation.from_rotvec([0.3, -0.5, 1.0])
    b = turn.apply(a) + np.array([1000, -400, 250]) + rng.normal(0, 0.1, (60, 3))
    b[:12] += rng.normal(0, 20, (12, 3))
    lines = ["ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"]
    lines += [",".join(map(repr, [*p.tolist(), *r.tolist()])) for p, r in zip(a, b, strict=True)]
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    names = ["hand", "pose"]
    truth = [Rotation.from_rotvec([0.1, 0.2, 1.5]), Rotation.from_rotvec([2.0, 0.3, -0.4])]
    places = [np.array([30.0, -20.0, 80.0]), np.array([900.0, 200.0, 50.0])]
    head = [f"base_from_flange_{k}" for k in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")]
    head += [k.replace("base_from_flange", "camera_from_board") for k in head]
    lines = [",".join(["name", *head])]
    for i in range(24):
        hand = Rotation.from_rotvec(rng.normal(0, 0.8, 3))
        where = rng.uniform(-300, 300, 3) + np.array([600, 0, 500])
        # camera_from_board = (base_from_flange @ flange_from_camera)^-1 @ base_from_board
        camera = hand * truth[0]
        origin = hand.apply(places[0]) + where
        board = camera.inv() * truth[1]
        seen = camera.inv().apply(places[1] - origin) + rng.normal(0, 0.1, 3)
        board = Rotation.from_rotvec(rng.normal(0, 2e-4, 3)) * board
        cells = []
        for rotation, t in ((hand, where), (board, seen)):
            cells += [*t.tolist(), *rotation.as_quat()[[3, 0, 1, 2]].tolist()]
        lines.append(",".join([f"{names[0]}{i}", *map(repr, cells)]))
    (folder / "handeye.csv").write_text("\n".join(lines) + "\n")
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
    """(name, arguments of ``stcal``); outputs of a command go into the folder of its name."""
    target = DATA / "stereo_target"
    found = []

    def add(name: str, *words) -> Path:
        found.append((name, [str(word).replace("@", str(out / name)) for word in words]))
        return out / name

    def run(name: str, images: Path, camera: Path, *more) -> Path:
        return add(name, "sfm", "run", images, "--camera", camera, "--out", "@/run", *more) / "run"

    demo = add("demo", "sfm", "demo", "--out", "@/demo") / "demo"
    sets = {name: target / name / "images" for name in ("sample", "clean", "clutter", "exact", "white_block")}
    sets["exact_png"] = target / "exact" / "images_png"
    for name, images in sets.items():
        folder = images.parent
        more = [f"--{k}={folder / f'{k}.toml'}" for k in ("target", "board") if (folder / f"{k}.toml").exists()]
        done = run(f"run_{name}", images, folder / "cameras.txt", *more)
        if name != "exact_png":
            add(f"compare_{name}", "sfm", "compare", done, folder / "truth.json", "--json", "@/compare.json")
    images, camera = sets["sample"], target / "sample" / "cameras.txt"
    sample = out / "run_sample" / "run"
    run("run_chain", images, camera, "--solve", "chain")
    run("run_refined", images, camera, "--refine-camera")
    run("run_control", images, camera, "--no-eccentricity")
    add("detect", "sfm", "detect", images, "--camera", camera, "--out", "@/detect")
    files = ["--out", "@/poses.csv", "--json", "@/poses.json", "--report", "@/p.html"]
    add("measure", "sfm", "measure", images, "--camera", camera, "--faces", sample / "faces.json", *files)
    add("calibrate_camera", "sfm", "calibrate-camera", images, "--out", "@/cameras.txt")
    add("advise", "sfm", "advise", sample, "--count", "2", "--json", "@/advice.json")
    add("plan", "sfm", "plan", "--images", "6", "--json", "@/plan.json")
    for kind in ("colmap-txt", "nvm", "bundler"):
        add(f"export_{kind}", "sfm", "export-model", sample, "@/model", "--format", kind)
    add("faces", "sfm", "faces", demo / "run" / "colmap" / "models", "--run", demo / "run", "--out", "@/faces.json")
    add("crosscheck", "sfm", "crosscheck", demo / "run")

    add(
        "axes",
        "robot",
        "axes",
        inputs / "fanuc.csv",
        "--robot",
        inputs / "fanuc.toml",
        "--out",
        "@/axes.toml",
        "--json",
        "@/axes.json",
        "--report",
        "@/p.html",
    )
    rokae = inputs / "rokae.toml"
    for kind in ("pose", "position", "distance"):
        add(
            f"identify_{kind}",
            "robot",
            "identify",
            inputs / "rokae.csv",
            "--robot",
            rokae,
            "--observe",
            kind,
            "--out",
            "@/robot.toml",
            "--json",
            "@/robot.json",
            "--report",
            "@/p.html",
        )
    identified = out / "identify_pose" / "robot.toml"
    add(
        "compensate",
        "robot",
        "compensate",
        inputs / "targets.csv",
        "--robot",
        identified,
        "--nominal",
        rokae,
        "--out",
        "@/joints.csv",
        "--json",
        "@/all.json",
        "--report",
        "@/p.html",
    )
    add("verify", "robot", "verify", inputs / "measured.csv", "--json", "@/all.json", "--report", "@/p.html")
    add(
        "design",
        "robot",
        "design",
        "--robot",
        rokae,
        "--count",
        "24",
        "--candidates",
        "200",
        "--out",
        "@/poses.csv",
        "--json",
        "@/all.json",
        "--report",
        "@/p.html",
    )

    register = ["--out", "@/all.json", "--report", "@/p.html"]
    for model in ("rigid", "similarity", "affine"):
        add(f"register_{model}", "register", inputs / "pairs.csv", "--model", model, *register)
    add("register_least", "register", inputs / "pairs.csv", "--method", "least-squares", *register)
    add("register_liu", "register", inputs / "pairs.csv", "--method", "liu2017", *register)
    hilti = inputs / "hilti"
    for name in ("flat", "outdoor"):
        add(f"register_{name}", "register", hilti / f"{name}.csv", *register)
    add(
        "register_robot",
        "register",
        hilti / "flat.csv",
        "--robot",
        hilti / "robot.toml",
        "--identified",
        "@/robot.toml",
        *register,
    )

    add(
        "handeye_poses",
        "handeye",
        inputs / "handeye.csv",
        "--method",
        "all",
        "--splits",
        "3",
        "--out",
        "@/hand.json",
        "--json",
        "@/all.json",
        "--report",
        "@/p.html",
    )
    folder = DATA / "charuco_handeye" / "test_set_charuco"
    given = [
        "handeye",
        folder / "images",
        "--poses",
        inputs / "charuco_poses.csv",
        "--camera",
        folder / "cal_data.yaml",
        "--board",
        inputs / "charuco.toml",
        "--setup",
        "eye-to-hand",
        "--held-out",
        "5",
        "--splits",
        "3",
        "--json",
        "@/all.json",
        "--report",
        "@/p.html",
    ]
    add("handeye_charuco", *given)
    add("handeye_charuco_all", *given, "--method", "all")
    add("handeye_charuco_refined", *given, "--refine-camera", "--with-scale", "--camera-out", "@/cameras.txt")
    folder = DATA / "dotgrid_handeye"
    given = [
        "handeye",
        folder / "images",
        "--poses",
        inputs / "dots_poses.csv",
        "--camera",
        folder / "camera_intr_calibrated.yaml",
        "--board",
        inputs / "dots.toml",
        "--with-scale",
        "--splits",
        "2",
        "--json",
        "@/all.json",
    ]
    add("handeye_dots", *given)

    folder = DATA / "charuco_handeye" / "test_set_charuco"
    camera = ["--camera", folder / "cal_data.yaml"]
    add(
        "locate_calibrate",
        "locate",
        "calibrate",
        folder / "images",
        *camera,
        "--board",
        inputs / "charuco.toml",
        "--layout",
        inputs / "layout.toml",
        "--out",
        "@/layout.toml",
        "--json",
        "@/all.json",
    )
    for method in ("joint", "patent"):
        add(
            f"locate_{method}",
            "locate",
            "run",
            folder / "images",
            *camera,
            "--layout",
            out / "locate_calibrate" / "layout.toml",
            "--method",
            method,
            "--out",
            "@/poses.csv",
            "--json",
            "@/all.json",
            "--report",
            "@/p.html",
        )
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
