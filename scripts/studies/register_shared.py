"""Registration of a real robot and a total station: the construction robot of Hilti's stationing data sets.

.venv/bin/python scripts/studies/register_shared.py [../shared/data/hilti_stationing] [--write FOLDER]

At each of seven stations the robot stood still, with its column at five heights; at each height and in two regions of
the arm a prism on its tool was measured at 7 or 8 places in a plane, to find where it stands, and at others to see how
well that holds. Fitted to the former and tried on the latter, height by height:
- a rigid transform, from the drawing's forward kinematics to the total station;
- the affine least squares of Liu et al. (2017): the places lie in a plane, off which it is free;
- a rigid transform again, with kinematics that were identified at one of the other stations (base and kinematics
  together, from all that was measured there).
Then, from all places of a station, held out in four folds: one rigid transform, and base and kinematics together.
--write FOLDER writes robot.toml and for each station a file of pairs with joint values, for `stcal register`.
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from scripts.runner import DATA, head, row, script
from stcal.cross_validation import dealt, held_out_errors
from stcal.errors import DegenerateError
from stcal.geometry.rigid import Poses, Rigid
from stcal.register import register
from stcal.register.registration import affine_least_squares
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_file import robot_toml
from stcal.robot.kinematics.robot_model import Chain, DHRow, Joint, Robot

TIP, BASE = "prism", "base_link"
COLUMN = "column_top_joint"
"""The column's two stages each move half of its value; together they are one prismatic joint."""
COLUMN_TIP_MM = 1442.0
"""The tip above the upper stage; the stages' offsets, 0.706 and 0.736 m, take it away again."""
FOLDS = 4
PARTIAL = IdentifyOptions("position", folds=0, partial=True)
HEADER = "ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm,q1_mm," + ",".join(f"q{i}_deg" for i in range(2, 8))


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Joint values (m, 7), mm and rad, and the prism (m, 3) mm as the total station saw it."""

    q: np.ndarray
    b: np.ndarray

    @classmethod
    def of(cls, rows: list[dict]) -> "Places":
        q = np.array([row["joint_states"] for row in rows]) * [1000.0, *[1.0] * 6]
        return cls(q, 1000.0 * np.array([row["prism_position"] for row in rows]))

    @classmethod
    def joined(cls, parts: Iterable["Places"]) -> "Places":
        parts = list(parts)
        return cls(np.vstack([p.q for p in parts]), np.vstack([p.b for p in parts]))

    def measurements(self, rows: np.ndarray | slice = slice(None)) -> Measurements:
        q = self.q[rows]
        return Measurements("stationing", range(1, len(q) + 1), q, ("",) * len(q), self.b[rows])


Station = list[tuple[Places, Places]]
"""For each height and region: the places to fit to, and those to try on."""


def stations(root: Path) -> dict[str, Station]:
    """By name, from the data sets' YAML files."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    found = {}
    for file in sorted((root / "data" / "datasets").glob("*.yaml")):
        content = yaml.load(file.read_text(), Loader=loader)
        regions = [r for h in content["column_heights"].values() for r in h["solution_spaces"].values()]
        found[file.stem] = [
            (Places.of(r["stationing_measurements"]), Places.of(r["evaluation_measurements"]))
            for r in regions
            if r["stationing_measurements"]
        ]
    return found


def urdf_joints(path: Path) -> list[tuple[str, str, Rigid]]:
    """(name, type, parent_from_joint) of the joints from the base to the prism."""
    by_child = {joint.find("child").get("link"): joint for joint in ElementTree.parse(path).getroot().iter("joint")}
    found, link = [], TIP
    while link != BASE:
        joint = by_child[link]
        origin = joint.find("origin")
        rpy, xyz = ([float(v) for v in origin.get(key).split()] for key in ("rpy", "xyz"))
        pose = Rigid(Rotation.from_euler("xyz", rpy).as_matrix(), 1000.0 * np.array(xyz))
        found.append((joint.get("name"), joint.get("type"), pose))
        link = joint.find("parent").get("link")
    return found[::-1]


def robot_of(path: Path) -> Robot:
    """The URDF's chain as modified D-H rows: a prismatic column and six joints; the prism is the tool."""
    gaps, gap, prismatic = [], Rigid(), []
    for name, kind, pose in urdf_joints(path):
        gap = gap @ pose
        if kind == "revolute" or name == COLUMN:
            gaps.append(gap)
            prismatic.append(kind != "revolute")
            gap = Rigid()
            if name == COLUMN:
                gap = Rigid(np.eye(3), [0.0, 0.0, -COLUMN_TIP_MM])
    placed = Poses.of(gaps)
    chain = Chain(placed.rotation, placed.translation, (Rigid(),) * 7, prismatic, np.eye(7))
    rows = tuple(DHRow(0.0, 0.0, 0.0, 0.0) for _ in gaps)
    joints = tuple(Joint("prismatic" if p else "revolute") for p in prismatic)
    return robot_from_chain(chain, {"": gap}, Robot("trailblazer", "modified", rows, joints))


def errors_by_part(station: Station, robot: Robot, affine: bool = False) -> np.ndarray:
    """Errors (m,) of the places to try on, each by the fit to its own height and region, mm."""
    found = []
    for fit, tried in station:
        a, new = (forward(robot, p.q).translation for p in (fit, tried))
        b_from_a = (
            affine_least_squares(a, fit.b) if affine else register(a, fit.b, method="least-squares", folds=0).b_from_a
        )
        found.append(np.linalg.norm(tried.b - b_from_a @ new, axis=1))
    return np.concatenate(found)


def identified(robot: Robot, places: Places, rows: np.ndarray | slice = slice(None)) -> Robot:
    """Base and kinematics together; what the places leave open stays nominal."""
    return identify(robot, places.measurements(rows), PARTIAL).robot


def everything(station: Station) -> Places:
    return Places.joined(p for parts in station for p in parts)


def held_out(places: Places, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Errors (m,) by one rigid transform, and by base and kinematics, of places in none of their fits, mm."""
    a = forward(robot, places.q).translation

    def by_transform(rest: np.ndarray, own: np.ndarray) -> np.ndarray:
        b_from_a = register(a[rest], places.b[rest], method="least-squares", folds=0).b_from_a
        return np.linalg.norm(places.b[own] - b_from_a @ a[own], axis=1)

    def by_kinematics(rest: np.ndarray, own: np.ndarray) -> np.ndarray:
        real = identified(robot, places, rest)
        predicted = real.world_from_base @ forward(real, places.q[own]).translation
        return np.linalg.norm(places.b[own] - predicted, axis=1)

    folds = dealt(len(a), FOLDS, np.random.default_rng(0))
    _, _, (rigid, together) = held_out_errors([by_transform, by_kinematics], folds)
    return rigid, together


def figures(errors: np.ndarray, unit: float = 1.0) -> str:
    return f"{errors.mean() / unit:.1f}, {np.percentile(errors, 95) / unit:.1f}"


def print_tables(found: dict[str, Station], robot: Robot) -> None:
    """Markdown."""
    real = {name: identified(robot, everything(station)) for name, station in found.items()}
    print("Fitted to the 7 or 8 places of each height and region, errors of the others: mean, 95 % within\n")
    head("station", "places", "rigid, mm", "affine least squares, m", "rigid, kinematics of another station, mm")
    for name, station in found.items():
        rigid, affine = errors_by_part(station, robot), errors_by_part(station, robot, affine=True)
        others = [errors_by_part(station, real[other]) for other in found if other != name]
        spread = f"{min(e.mean() for e in others):.1f} … {max(e.mean() for e in others):.1f}"
        by_others = f"{figures(np.concatenate(others))} ({spread})"
        row(name, len(rigid), figures(rigid), figures(affine, 1000.0), by_others)
    print("\nAll places of a station, held out in four folds, mm\n")
    head("station", "places", "one rigid transform", "base and kinematics together")
    for name, station in found.items():
        places = everything(station)
        row(name, len(places.q), *map(figures, held_out(places, robot)))
    name, station = next(iter(found.items()))
    try:
        identify(robot, Places.joined(fit for fit, _ in station).measurements(), replace(PARTIAL, partial=False))
    except DegenerateError as error:
        print(f"\nThe places to fit to alone ({name}) do not tell the kinematics: {error}")


def write(folder: Path, found: dict[str, Station], robot: Robot) -> None:
    """robot.toml, and pairs with joint values of every station."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.toml").write_text(robot_toml(robot, ["From the URDF of the data sets."]))
    for name, station in found.items():
        places = everything(station)
        a = forward(robot, places.q).translation
        q = np.column_stack([places.q[:, 0], np.degrees(places.q[:, 1:])])
        np.savetxt(
            folder / f"{name}.csv", np.hstack([a, places.b, q]), "%.6f", delimiter=",", header=HEADER, comments=""
        )


@script({"root": DATA / "hilti_stationing"}, write=Path)
def main(arguments) -> None:
    if not arguments.root.is_dir():
        sys.exit(f"error: {arguments.root} is missing; give the folder of the data sets")
    found, robot = stations(arguments.root), robot_of(arguments.root / "data" / "trailblazer.urdf")
    if arguments.write:
        write(arguments.write, found, robot)
    else:
        print_tables(found, robot)
