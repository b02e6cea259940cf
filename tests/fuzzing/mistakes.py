"""Mistakes that people make with files that are in order by themselves, and whether they are told."""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import POSE, pose_cells
from tests.commands import CALLS, Call
from tests.fuzzing.judged import Outcome
from tests.shared import write_rows

Edit = Callable[[Path], None]
SAID = r"(?i)\b(warning|note|failed|suspicious|reject|layout does not have)\b"
INCH = 1 / 25.4
LENGTHS = ("target_from_face", "circles")  # keys of a faces file and a truth
TURNED = "a chessboard turned by a quarter is the same board"


@dataclass(frozen=True, slots=True)
class Mistake:
    """``edit`` of the folder of inputs; ``untold`` : why no program could tell it, else ""; ``says`` : what a line
    must have that the same call on good data has not, where the call goes through all the same."""

    name: str
    call: Call
    edit: Edit
    untold: str = ""
    says: str = SAID


def told(mistake: Mistake, outcome: Outcome, valid: Outcome) -> bool:
    """Whether a call fails, or says what is wrong in a line that the same call on good data does not have."""
    known = {_plain(line) for line in valid.said.splitlines()}
    return outcome.code != 0 or any(
        re.search(mistake.says, line) and _plain(line) not in known for line in outcome.said.splitlines()
    )


def _plain(line: str) -> str:
    """Without numbers; names that are numbers, of images and lines, count as one however many they are."""
    return re.sub(r"(#[a-z]*, )+#", "#", re.sub(r"[\d.]+", "#", re.sub(r"\s+", " ", line)))


def call_of(command: str, place: str) -> Call:
    """The first one of a command that has this input."""
    return next(call for call in CALLS if call.command == command and place in call.inputs)


def answer_of(command: str, place: str) -> Call:
    """The same without the files that it need not write: mistakes are told in what is printed."""
    call = call_of(command, place)
    return replace(call, words=re.sub(r" --(?!out)[a-z]+ >\S+", "", call.words))


def rewritten(place: str, change: Callable[[str], str]) -> Edit:
    return lambda read: (read / place).write_text(change((read / place).read_text()))


def columns(place: str, change: Callable[[dict[str, list[str]]], dict[str, list[str]]]) -> Edit:
    """Change a CSV file as columns."""

    def edit(read: Path) -> None:
        header, *rows = list(csv.reader((read / place).read_text().splitlines()))
        found = change(dict(zip(header, map(list, zip(*rows, strict=True)), strict=True)))
        write_rows(read / place, list(found), zip(*found.values(), strict=True))

    return edit


def cells(place: str, names: str, change: Callable[[list[str]], list[str]]) -> Edit:
    """Change the cells of the columns of these names."""
    return columns(place, lambda table: {n: change(c) if re.fullmatch(names, n) else c for n, c in table.items()})


def times(place: str, names: str, factor: float) -> Edit:
    return cells(place, names, lambda column: [repr(float(v) * factor) for v in column])


def named(place: str, old: str, new: str | Callable[[re.Match], str]) -> Edit:
    return columns(place, lambda table: {re.sub(old, new, n): c for n, c in table.items()})


def exchanged(place: str, a: str, b: str) -> Edit:
    return columns(place, lambda table: table | {a: table[b], b: table[a]})


def without(place: str, names: str) -> Edit:
    return columns(place, lambda table: {n: c for n, c in table.items() if not re.fullmatch(names, n)})


def moved(place: str, names: str, by: int = 1) -> Edit:
    return cells(place, names, lambda column: column[-by:] + column[:-by])


def shuffled(place: str, names: str) -> Edit:
    return cells(place, names, lambda column: np.random.default_rng(5).permutation(column).tolist())


def both(*edits: Edit) -> Edit:
    """One after another; without any the mistake is in the options."""

    def edit(read: Path) -> None:
        for each in edits:
            each(read)

    return edit


def poses(place: str, change: Callable[[Poses], Poses], prefix: str = "") -> Edit:
    """Poses of a CSV file by other conventions."""

    def edit_table(table):
        values = np.array([[float(v) for v in table[prefix + name]] for name in POSE]).T
        found = change(Poses.from_quaternions(values[:, 3:], values[:, :3]))
        cells = list(zip(*(pose_cells(p) for p in found), strict=True))
        return table | {prefix + name: list(c) for name, c in zip(POSE, cells, strict=True)}

    return columns(place, edit_table)


def rolled_quaternion(place: str, prefix: str = "") -> Edit:
    """x, y, z, w under the names of w, x, y, z."""

    def change(table):
        w, x, y, z = (table[prefix + name] for name in POSE[3:])
        return table | dict(zip((prefix + name for name in POSE[3:]), (x, y, z, w), strict=True))

    return columns(place, change)


def transposed(found: Poses) -> Poses:
    return Poses(np.swapaxes(found.rotation, 1, 2), found.translation)


def text(place: str, old: str, new: str | Callable[[re.Match], str]) -> Edit:
    def edit(before: str) -> str:
        after = re.sub(old, new, before)
        assert before != after, f"{place} has no {old}"
        return after

    return rewritten(place, edit)


def number_times(place: str, key: str, factor: float) -> Edit:
    return text(place, rf"\b({key}) = ([-\d.e]+)", lambda m: f"{m[1]} = {float(m[2]) * factor!r}")


def json_times(place: str, keys: tuple[str, ...], factor: float) -> Edit:
    """Translations of 4×4, and points, below these keys."""

    def scaled(value):
        if isinstance(value, dict):
            return {key: scaled(each) for key, each in value.items()}
        if len(value) == 4 and isinstance(value[0], list):
            return [[*row[:3], row[3] * (factor if i < 3 else 1)] for i, row in enumerate(value)]
        return [v * factor for v in value]

    return json_keys(place, keys, scaled)


def json_keys(place: str, keys: tuple[str, ...], change: Callable) -> Edit:
    def edit(text: str) -> str:
        content = json.loads(text)
        return json.dumps(content | {key: change(content[key]) for key in keys})

    return rewritten(place, edit)


def json_inverse(place: str, key: str) -> Edit:
    return json_keys(place, (key,), lambda value: Rigid.from_matrix(np.array(value)).inverse().matrix().tolist())


def decimal_commas(place: str) -> Edit:
    """As a spreadsheet of a country with decimal commas writes it."""
    return rewritten(place, lambda text: text.replace(",", ";").replace(".", ","))


def camera_times(place: str, size: float, focal: float = 1.0) -> Edit:
    """``cameras.txt`` of photographs of another size, or of another focal length."""

    def edit(content: str) -> str:
        *head, line = content.strip().splitlines()
        number, model, width, height, *rest = line.split()
        lengths = 1 if model.startswith("SIMPLE") else 2
        factors = [size * focal] * lengths + [size] * 2 + [1.0] * len(rest)
        values = [float(v) * factor for v, factor in zip(rest, factors, strict=False)]
        sides = round(int(width) * size), round(int(height) * size)
        return "\n".join([*head, " ".join(map(str, [number, model, *sides, *values]))]) + "\n"

    return rewritten(place, edit)


def _robot() -> list[Mistake]:
    data, places, robot = "robot/poses.csv", "[xyz]_mm", "robot/robot.toml"
    identify = answer_of("robot identify", data)
    found = [
        Mistake(f"identify: {name}", identify, edit)
        for name, edit in {
            "metres as mm": times(data, places, 1e-3),
            "inches as mm": times(data, places, INCH),
            "rad as deg": times(data, r"q\d_deg", np.pi / 180),
            "deg as rad": named(data, r"(q\d)_deg", r"\1_rad"),
            "x y z w": rolled_quaternion(data),
            "conjugated": poses(data, transposed),
            "tool_from_base": poses(data, Poses.inverse),
            "x and y exchanged": exchanged(data, "x_mm", "y_mm"),
            "z down": times(data, "z_mm", -1),
            "joints 2 and 3 exchanged": exchanged(data, "q2_deg", "q3_deg"),
            "joint 4 the other way": times(data, "q4_deg", -1),
            "rows shuffled": shuffled(data, r"q\d_deg"),
            "rows one late": moved(data, r"q\d_deg"),
            "decimal commas": decimal_commas(data),
            "robot in metres": number_times(robot, "(?:a|d)_mm", 1e-3),
            "robot in inches": number_times(robot, "(?:a|d)_mm", INCH),
            "nominal robot 4.1 m off": text(robot, r"d_mm = 1025\.0", "d_mm = 5125.0"),
            "modified for standard": text(robot, '"standard"', '"modified"'),
            "alpha in rad": number_times(robot, "alpha_deg", np.pi / 180),
            "theta of joint 2 left out": text(robot, r"theta_deg = -90\.0", "theta_deg = 0.0"),
        }.items()
    ]
    sweeps = "robot/sweeps.csv"
    found += [
        Mistake(f"axes: {name}", answer_of("robot axes", sweeps), edit)
        for name, edit in {
            "metres as mm": times(sweeps, places, 1e-3),
            "rad as deg": times(sweeps, r"q\d_deg", np.pi / 180),
            "joints 2 and 3 exchanged": exchanged(sweeps, "q2_deg", "q3_deg"),
            "left-handed": times(sweeps, "y_mm", -1),
            "rows one late": moved(sweeps, r"q\d_deg"),
            "joint 4 the other way": times(sweeps, "q4_deg", -1),
            "robot in metres": number_times(robot, "(?:a|d)_mm", 1e-3),
        }.items()
    ]
    targets = "robot/targets.csv"
    found += [
        Mistake(f"compensate: {name}", answer_of("robot compensate", targets), edit, says=says)
        for name, edit, says in (
            ("metres as mm", times(targets, places, 1e-3), "metres|unit"),
            ("inches as mm", times(targets, places, INCH), "inch|unit"),
            ("x y z w", rolled_quaternion(targets), "quaternion|convention"),
            ("conjugated", poses(targets, transposed), "quaternion|convention"),
            ("tool_from_base", poses(targets, Poses.inverse), "inverse|convention"),
            ("rad as deg", times(targets, r"q\d_deg", np.pi / 180), "degrees|joint values of"),
            ("joints one row late", moved(targets, r"q\d_deg"), "order|joint values of"),
            ("robot in metres", number_times("robot/made.toml", "(?:a|d)_mm", 1e-3), "unit"),
            ("nominal robot in metres", number_times(robot, "(?:a|d)_mm", 1e-3), "mm apart"),
            ("nominal robot 4.1 m off", text(robot, r"d_mm = 1025\.0", "d_mm = 5125.0"), "mm apart"),
            ("poses alone, metres as mm", both(without(targets, r"q\d_deg"), times(targets, places, 1e-3)), "metres"),
            ("poses alone, inches as mm", both(without(targets, r"q\d_deg"), times(targets, places, INCH)), "inches"),
        )
    ]
    verify, before, after = "robot/verify.csv", "commanded_[xyz]_mm", "[xyz]_mm"
    return found + [
        Mistake(f"verify: {name}", answer_of("robot verify", verify), edit, why)
        for name, edit, why in (
            ("commanded in metres", times(verify, before, 1e-3), ""),
            ("measured in metres", times(verify, after, 1e-3), ""),
            ("measured in inches", times(verify, after, INCH), ""),
            ("rows shuffled", shuffled(verify, after), ""),
            ("x and y exchanged", exchanged(verify, "x_mm", "y_mm"), "distances alone are compared; they have no hand"),
            ("left-handed", times(verify, "z_mm", -1), "distances alone are compared; they have no hand"),
            (
                "commanded and measured exchanged",
                named(verify, "^(commanded_)?(?=[xyz]_mm)", lambda m: "" if m[1] else "commanded_"),
                "",
            ),
        )
    ]


def _handeye() -> list[Mistake]:
    data, images = "handeye/poses.csv", "handeye/images"
    robot, board = "handeye/robot.csv", "handeye/board.toml"
    flange, camera = "base_from_flange_", "camera_from_board_"
    found = [
        Mistake(f"handeye, poses: {name}", answer_of("handeye", data), edit, why)
        for name, edit, why in (
            ("robot in metres", times(data, flange + "[xyz]_mm", 1e-3), ""),
            ("camera in metres", times(data, camera + "[xyz]_mm", 1e-3), ""),
            ("both in metres", times(data, ".*[xyz]_mm", 1e-3), ""),
            ("robot in inches", times(data, flange + "[xyz]_mm", INCH), ""),
            ("robot x y z w", rolled_quaternion(data, flange), ""),
            ("camera x y z w", rolled_quaternion(data, camera), ""),
            ("flange_from_base", poses(data, Poses.inverse, flange), ""),
            ("board_from_camera", poses(data, Poses.inverse, camera), ""),
            ("both inverse", both(poses(data, Poses.inverse, flange), poses(data, Poses.inverse, camera)), ""),
            ("robot conjugated", poses(data, transposed, flange), ""),
            ("rows one late", moved(data, flange + ".*"), ""),
            ("rows shuffled", shuffled(data, flange + ".*"), ""),
            ("decimal commas", decimal_commas(data), ""),
        )
    ]
    chessboard, pairs = answer_of("handeye", images), answer_of("handeye", data)
    chessboard = replace(chessboard, words=chessboard.words.replace("checker.yaml", "board.toml"))
    found.append(Mistake("handeye: other setup", replace(pairs, words=f"{pairs.words} --setup eye-to-hand"), both()))
    return found + [
        Mistake(f"handeye, images: {name}", chessboard, edit, TURNED if name.startswith("rows and") else "")
        for name, edit in {
            "squares in inches": number_times(board, "square_mm", INCH),
            "squares in metres": number_times(board, "square_mm", 1e-3),
            "squares of 21 mm": number_times(board, "square_mm", 1.05),
            "rows and columns exchanged": text(board, "rows = 6\ncolumns = 8", "rows = 8\ncolumns = 6"),
            "squares counted, not corners": text(board, "rows = 6\ncolumns = 8", "rows = 7\ncolumns = 9"),
            "robot in metres": times(robot, ".*[xyz]_mm", 1e-3),
            "robot x y z w": rolled_quaternion(robot, flange),
            "flange_from_base": poses(robot, Poses.inverse, flange),
            "rows one late": moved(robot, flange + ".*"),
            "camera of double size": camera_times("handeye/cameras.txt", 2),
        }.items()
    ]


def _locate() -> list[Mistake]:
    scenes, images = answer_of("locate run", "locate/scenes"), answer_of("locate calibrate", "locate/images")
    layout, robot, camera = "locate/layout.toml", "locate/robot.csv", "locate/cameras.txt"
    one = "one pose and no other source: any place within reach may be meant"
    return [
        Mistake(f"locate {name}", call, edit, why)
        for name, call, edit, why in (
            ("run: camera of double size", scenes, camera_times(camera, 2), ""),
            ("run: camera of another lens", scenes, text(camera, r"1300\.0", "2600.0"), ""),
            ("run: other dictionary", scenes, text(layout, "6X6_250", "5X5_250"), ""),
            ("run: robot in metres", scenes, times(robot, "[xyz]_mm", 1e-3), ""),
            ("run: robot x y z w", scenes, rolled_quaternion(robot), one),
            ("run: flange_from_base", scenes, poses(robot, Poses.inverse), one),
            ("run: robot of another scene", scenes, text(robot, r"\na,", "\nb,"), ""),
            ("run: hand-eye in metres", scenes, json_times("locate/handeye.json", ("flange_from_camera",), 1e-3), ""),
            ("run: hand-eye inverse", scenes, json_inverse("locate/handeye.json", "flange_from_camera"), one),
            ("run: offset in metres", scenes, json_times("locate/offset.json", ("obj_from_goal",), 1e-3), one),
            ("calibrate: camera of double size", images, camera_times(camera, 2), ""),
            ("calibrate: squares in inches", images, number_times("locate/board.toml", "square_mm", INCH), ""),
            ("calibrate: other dictionary", images, text("locate/plan.toml", "36h11", "25h9"), ""),
            (
                "calibrate: board of another shape",
                images,
                text("locate/board.toml", "rows = 4\ncolumns = 9", "rows = 9\ncolumns = 4"),
                TURNED,
            ),
        )
    ]


def _register() -> list[Mistake]:
    pairs, call = "register/pairs.csv", answer_of("register", "register/pairs.csv")
    arm = answer_of("register", "register/arm.csv")
    found = {
        "a in metres": times(pairs, "a[xyz]_mm", 1e-3),
        "a in inches": times(pairs, "a[xyz]_mm", INCH),
        "b left-handed": times(pairs, "bz_mm", -1),
        "x and y of b exchanged": exchanged(pairs, "bx_mm", "by_mm"),
        "rows shuffled": shuffled(pairs, "b[xyz]_mm"),
        "rows one late": moved(pairs, "b[xyz]_mm"),
        "decimal commas": decimal_commas(pairs),
    }
    return [Mistake(f"register: {name}", call, edit) for name, edit in found.items()] + [
        Mistake("register: both in metres", call, times(pairs, ".*_mm", 1e-3)),
        Mistake("register: arm in metres", arm, times("register/arm.csv", "a[xyz]_mm", 1e-3)),
        Mistake("register: rad as deg", arm, times("register/arm.csv", r"q\d_deg", np.pi / 180)),
        Mistake("register: robot in metres", arm, number_times("robot/robot.toml", "(?:a|d)_mm", 1e-3)),
    ]


def _sfm() -> list[Mistake]:
    run = next(call for call in CALLS if call.command == "sfm run" and "+" in call.words)
    measure, compare = call_of("sfm measure", "shots"), call_of("sfm compare", "run")
    target, board, camera = "data/target.toml", "data/board.toml", "data/cameras.txt"
    exchanged_sides = r"rows = (\d+)\ncolumns = (\d+)", r"rows = \2\ncolumns = \1"
    turned = "its dots have the same distances, and so has the target the same scale"
    return [
        Mistake(name, call, edit, why)
        for name, call, edit, why in (
            ("run: camera of double size", run, camera_times(camera, 2), ""),
            ("run: camera of half the focal length", run, camera_times(camera, 1, 0.5), ""),
            ("run: focal length off by 3 %", run, camera_times(camera, 1, 1.03), ""),
            ("run: target in cm", run, number_times(target, "(?:x|y|radius)_mm", 0.1), ""),
            ("run: target in inches", run, number_times(target, "(?:x|y|radius)_mm", INCH), ""),
            ("run: target mirrored", run, number_times(target, "x_mm", -1), ""),
            ("run: pitch of 31 mm", run, number_times(board, "pitch_mm", 31 / 30), ""),
            ("run: board in inches", run, number_times(board, ".*_mm", INCH), ""),
            ("run: rows and columns exchanged", run, text(board, *exchanged_sides), turned),
            ("run: other polarity", run, text(target, '"bright"', '"dark"'), ""),
            ("measure: camera of double size", measure, camera_times(camera, 2), ""),
            ("measure: camera of half the focal length", measure, camera_times(camera, 1, 0.5), ""),
            ("measure: faces in metres", measure, json_times("run/faces.json", LENGTHS, 1e-3), ""),
            ("measure: target in inches", measure, number_times(target, "(?:x|y|radius)_mm", INCH), ""),
            ("compare: truth in metres", compare, json_times("data/truth.json", LENGTHS, 1e-3), ""),
            ("compare: truth of another unit", compare, text("data/truth.json", '"unit": "mm"', '"unit": "m"'), ""),
        )
    ]  # fmt: skip


MISTAKES = {each.name: each for each in (*_robot(), *_handeye(), *_locate(), *_register(), *_sfm())}
