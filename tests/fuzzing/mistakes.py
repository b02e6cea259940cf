"""Mistakes that people make with files that are in order by themselves, and whether they are told."""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import POSE, pose_cells
from tests.commands import CALLS, Call
from tests.fuzzing.judged import Outcome
from tests.fuzzing.stock import table

Edit = Callable[[Path], object]
"""Of the folder of inputs."""
SAID = r"(?i)\b(warning|note|failed|suspicious|reject|layout does not have)\b"
INCH, M = 1 / 25.4, 1e-3
RAD = np.pi / 180
LENGTHS = ("target_from_face", "circles")  # keys of a faces file and a truth


@dataclass(frozen=True, slots=True)
class Mistake:
    """``edit`` of the folder of inputs; ``untold`` : why no program could tell it, else ""; ``says`` : what a line
    must have that the same call on good data has not, where the call goes through all the same."""

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


def both(*edits: Edit) -> Edit:
    """One after another; without any the mistake is in the options."""
    return lambda read: [edit(read) for edit in edits]


def rewritten(place: str, change: Callable[[str], str]) -> Edit:
    return lambda read: (read / place).write_text(change((read / place).read_text()))


def text(place: str, old: str, new: str | Callable[[re.Match], str]) -> Edit:
    def edit(before: str) -> str:
        after = re.sub(old, new, before)
        assert before != after, f"{place} has no {old}"
        return after

    return rewritten(place, edit)


def number_times(place: str, key: str, factor: float) -> Edit:
    return text(place, rf"\b({key}) = ([-\d.e]+)", lambda m: f"{m[1]} = {float(m[2]) * factor!r}")


def decimal_commas(place: str) -> Edit:
    """As a spreadsheet of a country with decimal commas writes it."""
    return rewritten(place, lambda text: text.replace(",", ";").replace(".", ","))


def json_keys(place: str, keys: tuple[str, ...], change: Callable) -> Edit:
    def edit(text: str) -> str:
        content = json.loads(text)
        return json.dumps(content | {key: change(content[key]) for key in keys})

    return rewritten(place, edit)


def in_metres(value):
    """Translations of 4×4, and points."""
    if isinstance(value, dict):
        return {key: in_metres(each) for key, each in value.items()}
    if len(value) == 4 and isinstance(value[0], list):
        return [[*row[:3], row[3] * (M if i < 3 else 1)] for i, row in enumerate(value)]
    return [v * M for v in value]


def inverse(matrix: list) -> list:
    return Rigid.from_matrix(np.array(matrix)).inverse().matrix().tolist()


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


Columns = dict[str, list[str]]


def columns(place: str, change: Callable[[Columns], Columns]) -> Edit:
    """Change a CSV file as columns."""

    def edit(read: Path) -> None:
        header, *rows = list(csv.reader((read / place).read_text().splitlines()))
        table(read / place, change(dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))))

    return edit


def cells(change: Callable[[list[str]], list[str]], place: str, names: str) -> Edit:
    """Change columns of these names."""
    return columns(place, lambda found: {n: change(c) if re.fullmatch(names, n) else c for n, c in found.items()})


moved = partial(cells, lambda column: [column[-1], *column[:-1]])
shuffled = partial(cells, lambda column: np.random.default_rng(5).permutation(column).tolist())


def times(place: str, names: str, factor: float) -> Edit:
    return cells(lambda column: [repr(float(v) * factor) for v in column], place, names)


def named(place: str, old: str, new: str | Callable[[re.Match], str]) -> Edit:
    return columns(place, lambda found: {re.sub(old, new, n): c for n, c in found.items()})


def exchanged(place: str, a: str, b: str) -> Edit:
    return named(place, f"^({a}|{b})$", lambda m: b if m[0] == a else a)


def xyzw(place: str, prefix: str = "") -> Edit:
    """x, y, z, w under the names of w, x, y, z."""
    return named(place, f"(?<=^{prefix}q)[wxyz]$", lambda m: "wxyz"["xyzw".index(m[0])])


def poses(place: str, change: Callable[[Poses], Poses], prefix: str = "") -> Edit:
    """Poses of a CSV file by other conventions."""

    def edit(table: Columns) -> Columns:
        values = np.array([[float(v) for v in table[prefix + name]] for name in POSE]).T
        found = change(Poses.from_quaternions(values[:, 3:], values[:, :3]))
        written = zip(*(pose_cells(p) for p in found), strict=True)
        return table | {prefix + name: list(c) for name, c in zip(POSE, written, strict=True)}

    return columns(place, edit)


def transposed(found: Poses) -> Poses:
    return Poses(np.swapaxes(found.rotation, 1, 2), found.translation)


Q, XYZ, DH = r"q\d_deg", "[xyz]_mm", "(?:a|d)_mm"
BASE, CAMERA = "base_from_flange_", "camera_from_board_"
_PAIRS, _IMAGES = answer_of("handeye", "handeye/poses.csv"), answer_of("handeye", "handeye/images")
_SIX_BY_EIGHT = "rows = 6\ncolumns = 8"
ALONE = columns("robot/targets.csv", lambda found: {name: found[name] for name in POSE})
CALLED = {
    "identify": answer_of("robot identify", "robot/poses.csv"),
    "axes": answer_of("robot axes", "robot/sweeps.csv"),
    "compensate": answer_of("robot compensate", "robot/targets.csv"),
    "verify": answer_of("robot verify", "robot/verify.csv"),
    "handeye, poses": _PAIRS,
    "handeye": replace(_PAIRS, words=f"{_PAIRS.words} --setup eye-to-hand"),
    "handeye, images": replace(_IMAGES, words=_IMAGES.words.replace("checker.yaml", "board.toml")),
    "locate run": answer_of("locate run", "locate/scenes"),
    "locate calibrate": answer_of("locate calibrate", "locate/images"),
    "register": answer_of("register", "register/pairs.csv"),
    "register, arm": answer_of("register", "register/arm.csv"),
    "run": next(call for call in CALLS if call.command == "sfm run" and "+" in call.words),
    "measure": call_of("sfm measure", "shots"),
    "compare": call_of("sfm compare", "run"),
}
EDITS: dict[str, Edit] = {
    "identify: metres as mm": times("robot/poses.csv", XYZ, M),
    "identify: inches as mm": times("robot/poses.csv", XYZ, INCH),
    "identify: rad as deg": times("robot/poses.csv", Q, RAD),
    "identify: deg as rad": named("robot/poses.csv", r"(q\d)_deg", r"\1_rad"),
    "identify: x y z w": xyzw("robot/poses.csv"),
    "identify: conjugated": poses("robot/poses.csv", transposed),
    "identify: tool_from_base": poses("robot/poses.csv", Poses.inverse),
    "identify: x and y exchanged": exchanged("robot/poses.csv", "x_mm", "y_mm"),
    "identify: z down": times("robot/poses.csv", "z_mm", -1),
    "identify: joints 2 and 3 exchanged": exchanged("robot/poses.csv", "q2_deg", "q3_deg"),
    "identify: joint 4 the other way": times("robot/poses.csv", "q4_deg", -1),
    "identify: rows shuffled": shuffled("robot/poses.csv", Q),
    "identify: rows one late": moved("robot/poses.csv", Q),
    "identify: decimal commas": decimal_commas("robot/poses.csv"),
    "identify: robot in metres": number_times("robot/robot.toml", DH, M),
    "identify: robot in inches": number_times("robot/robot.toml", DH, INCH),
    "identify: nominal robot 4.1 m off": text("robot/robot.toml", r"d_mm = 1025\.0", "d_mm = 5125.0"),
    "identify: modified for standard": text("robot/robot.toml", '"standard"', '"modified"'),
    "identify: alpha in rad": number_times("robot/robot.toml", "alpha_deg", RAD),
    "identify: theta of joint 2 left out": text("robot/robot.toml", r"theta_deg = -90\.0", "theta_deg = 0.0"),
    "axes: metres as mm": times("robot/sweeps.csv", XYZ, M),
    "axes: rad as deg": times("robot/sweeps.csv", Q, RAD),
    "axes: joints 2 and 3 exchanged": exchanged("robot/sweeps.csv", "q2_deg", "q3_deg"),
    "axes: left-handed": times("robot/sweeps.csv", "y_mm", -1),
    "axes: rows one late": moved("robot/sweeps.csv", Q),
    "axes: joint 4 the other way": times("robot/sweeps.csv", "q4_deg", -1),
    "axes: robot in metres": number_times("robot/robot.toml", DH, M),
    "compensate: metres as mm": times("robot/targets.csv", XYZ, M),
    "compensate: inches as mm": times("robot/targets.csv", XYZ, INCH),
    "compensate: x y z w": xyzw("robot/targets.csv"),
    "compensate: conjugated": poses("robot/targets.csv", transposed),
    "compensate: tool_from_base": poses("robot/targets.csv", Poses.inverse),
    "compensate: rad as deg": times("robot/targets.csv", Q, RAD),
    "compensate: joints one row late": moved("robot/targets.csv", Q),
    "compensate: robot in metres": number_times("robot/made.toml", DH, M),
    "compensate: nominal robot in metres": number_times("robot/robot.toml", DH, M),
    "compensate: nominal robot 4.1 m off": text("robot/robot.toml", r"d_mm = 1025\.0", "d_mm = 5125.0"),
    "compensate: poses alone, metres as mm": both(ALONE, times("robot/targets.csv", XYZ, M)),
    "compensate: poses alone, inches as mm": both(ALONE, times("robot/targets.csv", XYZ, INCH)),
    "verify: commanded in metres": times("robot/verify.csv", "commanded_[xyz]_mm", M),
    "verify: measured in metres": times("robot/verify.csv", XYZ, M),
    "verify: measured in inches": times("robot/verify.csv", XYZ, INCH),
    "verify: rows shuffled": shuffled("robot/verify.csv", XYZ),
    "verify: x and y exchanged": exchanged("robot/verify.csv", "x_mm", "y_mm"),
    "verify: left-handed": times("robot/verify.csv", "z_mm", -1),
    "verify: commanded and measured exchanged": named(
        "robot/verify.csv", "^(commanded_)?(?=[xyz]_mm)", lambda m: "" if m[1] else "commanded_"
    ),
    "handeye, poses: robot in metres": times("handeye/poses.csv", BASE + XYZ, M),
    "handeye, poses: camera in metres": times("handeye/poses.csv", CAMERA + XYZ, M),
    "handeye, poses: both in metres": times("handeye/poses.csv", f".*{XYZ}", M),
    "handeye, poses: robot in inches": times("handeye/poses.csv", BASE + XYZ, INCH),
    "handeye, poses: robot x y z w": xyzw("handeye/poses.csv", BASE),
    "handeye, poses: camera x y z w": xyzw("handeye/poses.csv", CAMERA),
    "handeye, poses: flange_from_base": poses("handeye/poses.csv", Poses.inverse, BASE),
    "handeye, poses: board_from_camera": poses("handeye/poses.csv", Poses.inverse, CAMERA),
    "handeye, poses: both inverse": both(*(poses("handeye/poses.csv", Poses.inverse, side) for side in (BASE, CAMERA))),
    "handeye, poses: robot conjugated": poses("handeye/poses.csv", transposed, BASE),
    "handeye, poses: rows one late": moved("handeye/poses.csv", f"{BASE}.*"),
    "handeye, poses: rows shuffled": shuffled("handeye/poses.csv", f"{BASE}.*"),
    "handeye, poses: decimal commas": decimal_commas("handeye/poses.csv"),
    "handeye: other setup": both(),
    "handeye, images: squares in inches": number_times("handeye/board.toml", "square_mm", INCH),
    "handeye, images: squares in metres": number_times("handeye/board.toml", "square_mm", M),
    "handeye, images: squares of 21 mm": number_times("handeye/board.toml", "square_mm", 1.05),
    "handeye, images: rows and columns exchanged": text("handeye/board.toml", _SIX_BY_EIGHT, "rows = 8\ncolumns = 6"),
    "handeye, images: squares counted, not corners": text("handeye/board.toml", _SIX_BY_EIGHT, "rows = 7\ncolumns = 9"),
    "handeye, images: robot in metres": times("handeye/robot.csv", f".*{XYZ}", M),
    "handeye, images: robot x y z w": xyzw("handeye/robot.csv", BASE),
    "handeye, images: flange_from_base": poses("handeye/robot.csv", Poses.inverse, BASE),
    "handeye, images: rows one late": moved("handeye/robot.csv", f"{BASE}.*"),
    "handeye, images: camera of double size": camera_times("handeye/cameras.txt", 2),
    "locate run: camera of double size": camera_times("locate/cameras.txt", 2),
    "locate run: camera of another lens": text("locate/cameras.txt", r"1300\.0", "2600.0"),
    "locate run: other dictionary": text("locate/layout.toml", "6X6_250", "5X5_250"),
    "locate run: robot in metres": times("locate/robot.csv", XYZ, M),
    "locate run: robot x y z w": xyzw("locate/robot.csv"),
    "locate run: flange_from_base": poses("locate/robot.csv", Poses.inverse),
    "locate run: robot of another scene": text("locate/robot.csv", r"\na,", "\nb,"),
    "locate run: hand-eye in metres": json_keys("locate/handeye.json", ("flange_from_camera",), in_metres),
    "locate run: hand-eye inverse": json_keys("locate/handeye.json", ("flange_from_camera",), inverse),
    "locate run: offset in metres": json_keys("locate/offset.json", ("obj_from_goal",), in_metres),
    "locate calibrate: camera of double size": camera_times("locate/cameras.txt", 2),
    "locate calibrate: squares in inches": number_times("locate/board.toml", "square_mm", INCH),
    "locate calibrate: other dictionary": text("locate/plan.toml", "36h11", "25h9"),
    "locate calibrate: board of another shape": text(
        "locate/board.toml", "rows = 4\ncolumns = 9", "rows = 9\ncolumns = 4"
    ),
    "register: a in metres": times("register/pairs.csv", "a[xyz]_mm", M),
    "register: a in inches": times("register/pairs.csv", "a[xyz]_mm", INCH),
    "register: b left-handed": times("register/pairs.csv", "bz_mm", -1),
    "register: x and y of b exchanged": exchanged("register/pairs.csv", "bx_mm", "by_mm"),
    "register: rows shuffled": shuffled("register/pairs.csv", "b[xyz]_mm"),
    "register: rows one late": moved("register/pairs.csv", "b[xyz]_mm"),
    "register: decimal commas": decimal_commas("register/pairs.csv"),
    "register: both in metres": times("register/pairs.csv", ".*_mm", M),
    "register, arm: arm in metres": times("register/arm.csv", "a[xyz]_mm", M),
    "register, arm: rad as deg": times("register/arm.csv", Q, RAD),
    "register, arm: robot in metres": number_times("robot/robot.toml", DH, M),
    "run: camera of double size": camera_times("data/cameras.txt", 2),
    "run: camera of half the focal length": camera_times("data/cameras.txt", 1, 0.5),
    "run: focal length off by 3 %": camera_times("data/cameras.txt", 1, 1.03),
    "run: target in cm": number_times("data/target.toml", "(?:x|y|radius)_mm", 0.1),
    "run: target in inches": number_times("data/target.toml", "(?:x|y|radius)_mm", INCH),
    "run: target mirrored": number_times("data/target.toml", "x_mm", -1),
    "run: pitch of 31 mm": number_times("data/board.toml", "pitch_mm", 31 / 30),
    "run: board in inches": number_times("data/board.toml", ".*_mm", INCH),
    "run: rows and columns exchanged": text(
        "data/board.toml", r"rows = (\d+)\ncolumns = (\d+)", r"rows = \2\ncolumns = \1"
    ),
    "run: other polarity": text("data/target.toml", '"bright"', '"dark"'),
    "measure: camera of double size": camera_times("data/cameras.txt", 2),
    "measure: camera of half the focal length": camera_times("data/cameras.txt", 1, 0.5),
    "measure: faces in metres": json_keys("run/faces.json", LENGTHS, in_metres),
    "measure: target in inches": number_times("data/target.toml", "(?:x|y|radius)_mm", INCH),
    "compare: truth in metres": json_keys("data/truth.json", LENGTHS, in_metres),
    "compare: truth of another unit": text("data/truth.json", '"unit": "mm"', '"unit": "m"'),
}
TURNED = "a chessboard turned by a quarter is the same board"
NO_HAND = "distances alone are compared; they have no hand"
ONE = "one pose and no other source: any place within reach may be meant"
UNTOLD = {
    "verify: x and y exchanged": NO_HAND,
    "verify: left-handed": NO_HAND,
    "handeye, images: rows and columns exchanged": TURNED,
    "locate run: robot x y z w": ONE,
    "locate run: flange_from_base": ONE,
    "locate run: hand-eye inverse": ONE,
    "locate run: offset in metres": ONE,
    "locate calibrate: board of another shape": TURNED,
    "run: rows and columns exchanged": "its dots have the same distances, and so has the target the same scale",
}
OF_TARGETS = {
    "nominal": "mm apart",
    "alone, metres": "metres",
    "alone, inches": "inches",
    "robot in metres": "unit",
    "metres as mm": "metres|unit",
    "inches as mm": "inch|unit",
    "x y z w|conjugated": "quaternion|convention",
    "tool_from_base": "inverse|convention",
    "rad as deg": "degrees|joint values of",
    "one row late": "order|joint values of",
}
"""Part of the mistake's name, and what the warnings of ``robot compensate`` must name; the first that fits."""


def _mistake(name: str, edit: Edit) -> Mistake:
    of = name.partition(":")[0]
    says = next(words for cause, words in OF_TARGETS.items() if re.search(cause, name)) if of == "compensate" else SAID
    return Mistake(CALLED[of], edit, UNTOLD.get(name, ""), says)


MISTAKES = {name: _mistake(name, edit) for name, edit in EDITS.items()}
