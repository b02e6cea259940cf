"""The robot experiment of Zhang & Wei (2017) in simulation: an arm calibrated by a camera that looks at its target.

.venv/bin/python scripts/reproduce/reproduce_robot.py [--draws 100] [--seed 0]

Every draw makes an arm of the size of the MH80 with errors of its own, a target bolted to its flange with the errors of
a calibration, and photographs of it by one camera that stands still. Then the published chain: single-joint sweeps give
the axes (axis method), these and further poses the complete minimal model (CMMK); 51 positions at one orientation are
commanded through the inverse kinematics of the drawing and of the two models; their distances from the first are
compared with the commanded ones. Labels are simulated, no pixels; the distances are the true ones, those that the same
camera measures, and the true ones of 51 other positions all over the arm's reach.
"""

import time
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.geometry.rigid import Poses, Rigid
from stcal.labels import parse_label
from stcal.robot.axes.axes_model import robot_from_sweeps
from stcal.robot.identification.adjustment import observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.kinematics.forward import forward, jacobian
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.measurements import Measurements, Targets
from stcal.robot.kinematics.robot_model import Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made, placed
from stcal.robot.use.compensation import compensate
from stcal.robot.use.evaluation import MeasuredPoses, SetResult, verify
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.measurement.pose import common_errors, pose_from_circles
from stcal.synthetic.scene import Scene, SceneOptions, make_scene
from tests.support.image_poses import KnownTarget, known_target, pose_error, see

PUBLISHED = {"mean": (0.6493, 0.4742), "std": (0.5596, 0.2967), "max": (2.1259, 1.3311)}
"""Table 3 of the paper, mm: before, after."""
MADE_MM, MADE_RAD = 0.3, 5e-4
"""σ of every axis's place, and of its direction and zero position: an assumption. Of the order that identification
finds of real arms (a tracked Rokae: lengths 0.2 mm, twists 0.45 mrad, zero positions far more)."""
MOUNT_MM, MOUNT_RAD = 0.5, 3e-3
"""σ of the target on the flange, and of where the camera is believed to stand, which matters to planning only."""
NOISE_PX, DISTANCE_MM = 0.01, 1500.0
"""σ per axis of a centre; camera to the middle of the working volume. Chosen so that the target is measured to about
the published 0.035 mm; what was reached is printed."""
MIDDLE_MM = np.array([1350.0, 0.0, 1100.0])
"""Of the working volume, base frame."""
SWEEP, POSES, VERIFIED, POOL = 15, 60, 51, 150
"""Positions in each joint's sweep; further poses; commanded positions, and how many every draw chooses its own from."""
ARM_BEHIND_RAD = np.radians(100)
"""The arm hides the target when the flange looks farther away from the camera."""
FACES, CIRCLES = 2, 8
"""A pose is taken where it shows so many faces with so many circles each."""
WITHIN = 0.85
"""Share of the image within which the target's origin is kept."""
FAR, NEAR = "all over the reach", "in the camera's view"
BOXES_MM = {
    FAR: np.array([[500.0, -1000.0, 200.0], [1900.0, 1000.0, 1800.0]]),
    NEAR: MIDDLE_MM + np.array([[-1.0], [1.0]]) * [350.0, 400.0, 250.0],
}
"""Corners of the boxes of the commanded positions, base frame; of these the reachable, or visible, ones are taken."""
MARGIN_RAD, REGULAR = np.radians(2), 0.05
"""Commanded positions keep so far from the joints' limits; and the smallest singular value of the Jacobian (lengths in
metres) over this, so that errors of milliradians do not put them out of reach."""
NOMINAL, AXES, CMMK = "nominal", "axis method", "axis method, CMMK"
REACH, TRUE, CAMERA = f"{FAR}, true", f"{NEAR}, true", f"{NEAR}, as it measures"


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """``nominal`` : by the drawing, with camera_from_base and the target as its tool; ``scene`` : camera and target;
    ``known`` : the target with the errors that its calibration leaves."""

    nominal: Robot
    scene: Scene
    known: KnownTarget


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """``sets`` : by kind of distance, the result of each model; ``pose_error`` : (m, 6) rad, mm, of the photographs;
    ``squared`` : (2,) squared error of the minimal model in units of its covariance, with the poses' common errors and
    as if they had none."""

    sets: dict[str, dict[str, SetResult]]
    pose_error: np.ndarray
    squared: np.ndarray


@cache
def rig() -> Rig:
    """The same for all draws."""
    scene = make_scene(SceneOptions(seed=5))
    # the bottom of the box, opposite face 5, on the flange: the flange's z is the target's −Y
    turn = np.column_stack([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    bottom = np.array([40.0, 140.0, -99.0])
    tool = Rigid(turn, -turn @ bottom)
    azimuth = np.radians(20)
    back = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    across = np.cross(-back, [0, 0, 1.0])
    base_from_camera = Rigid(np.column_stack([across, np.cross(-back, across), -back]), MIDDLE_MM + DISTANCE_MM * back)
    nominal = placed(mh80(), base_from_camera.inverse(), {"": tool})
    return Rig(nominal, scene, known_target(scene, NOISE_PX))


def orientation() -> np.ndarray:
    """base_from_target of all commanded positions: the flange looks forward and down, an edge of the box up."""
    down, roll = np.radians(45), np.radians(45)
    z = np.array([np.cos(down), 0.0, -np.sin(down)])
    x = np.array([0.0, 1.0, 0.0]) * np.cos(roll) + np.cross(z, [0.0, 1.0, 0.0]) * np.sin(roll)
    return np.column_stack([x, np.cross(z, x), z]) @ rig().nominal.tool().rotation


def in_view(q: np.ndarray) -> np.ndarray:
    """(m,) whether the camera sees enough of the target there, by the drawing."""
    nominal, camera = rig().nominal, rig().scene.camera
    poses = nominal.world_from_base @ forward(nominal, q)
    to_camera = -poses.translation / np.linalg.norm(poses.translation, axis=1)[:, None]
    flange_z = poses.rotation @ nominal.tool().rotation[2]
    good = (to_camera * flange_z).sum(axis=1) > np.cos(ARM_BEHIND_RAD)
    half = np.array([camera.width, camera.height]) / 2 / camera.focal
    aside = np.abs(poses.translation[:, :2]) < WITHIN * half * poses.translation[:, 2:]
    good &= aside.all(axis=1) & (poses.translation[:, 2] > DISTANCE_MM / 2)
    for i in np.flatnonzero(good):
        image = see(rig().scene, poses[int(i)], tuple(rig().scene.target_from_face), 0.0, np.random.default_rng(0))
        good[i] = enough(image.labels)
    return good


def enough(labels) -> bool:
    """Two faces or more."""
    _, counts = np.unique([parse_label(label).plane for label in labels], return_counts=True)
    return (counts >= CIRCLES).sum() >= FACES


@cache
def sweeps() -> np.ndarray:
    """(6 · SWEEP, 6) joint values: each joint from the middle of the volume as far as the target stays in view."""
    nominal = rig().nominal
    rest = inverse(nominal, Poses(orientation()[None], MIDDLE_MM[None])).q[0]
    rows = []
    for j, (low, high) in enumerate(np.clip(nominal.limits(), rest[:, None] - np.pi, rest[:, None] + np.pi)):
        values = np.arange(low, high, np.radians(2))
        q = np.where(np.arange(6) == j, values[:, None], rest)
        seen = in_view(q)
        at = int(np.abs(values - rest[j]).argmin())
        first = at - int(np.append(~seen[at::-1], True).argmax()) + 1
        last = at + int(np.append(~seen[at:], True).argmax()) - 1
        way = np.linspace(values[first], values[last], SWEEP)
        rows.append(np.where(np.arange(6) == j, way[:, None], rest))
    return np.concatenate(rows)


def random_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 6) joint values at which the target is in view."""
    found = np.empty((0, 6))
    while len(found) < count:
        q = joint_vectors(rig().nominal, 1500, rng, 0.9)
        found = np.concatenate([found, q[in_view(q)]])
    return found[:count]


@cache
def commands(kind: str) -> Targets:
    """Random positions at the one orientation, which the drawing's arm reaches, with its joint values."""
    nominal, rng = rig().nominal, np.random.default_rng(1)
    inner = tuple(Joint("revolute", j.lower + MARGIN_RAD, j.upper - MARGIN_RAD) for j in nominal.joints)
    xyz, q = np.empty((0, 3)), np.empty((0, 6))
    while len(xyz) < POOL:
        drawn = rng.uniform(*BOXES_MM[kind], (POOL, 3))
        found = inverse(replace(nominal, joints=inner), Poses(np.tile(orientation(), (POOL, 1, 1)), drawn))
        slope = jacobian(nominal, found.q) / np.repeat([1.0, 1e3], 3)[:, None]
        good = found.usable & (np.linalg.svd(slope, compute_uv=False)[:, -1] > REGULAR)
        if kind == NEAR:
            good[good] = in_view(found.q[good])
        xyz, q = np.concatenate([xyz, drawn[good]])[:POOL], np.concatenate([q, found.q[good]])[:POOL]
    return Targets(kind, range(POOL), ("",) * POOL, Poses(np.tile(orientation(), (POOL, 1, 1)), xyz), q)


def commanded(kind: str, rng: np.random.Generator) -> Targets:
    """51 of these."""
    pool, rows = commands(kind), rng.choice(POOL, VERIFIED, replace=False)
    return Targets(kind, range(1, VERIFIED + 1), ("",) * VERIFIED, pool.poses[rows], pool.q[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """An arm as made, where the camera sees it. ``gears`` : (2, 2, 6) amplitude (rad) and phase of each joint's error
    of one and of two periods a turn."""

    robot: Robot
    gears: np.ndarray

    def poses(self, q: np.ndarray) -> Poses:
        """camera_from_target where the controller believes to be at q."""
        q = q + sum(size * np.sin(k * q + phase) for k, (size, phase) in enumerate(self.gears, 1))
        return self.robot.world_from_base @ forward(self.robot, q)


def made_arm(gears_rad: float, rng: np.random.Generator) -> Arm:
    """The drawing's arm with errors."""
    nominal = rig().nominal
    moved = [Rigid.exp(rng.normal(0, 1, 6) * np.repeat([MOUNT_RAD, MOUNT_MM], 3)) for _ in range(2)]
    real = made(nominal, rng, MADE_MM, MADE_RAD)
    gears = np.stack([rng.normal(0, gears_rad, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))], axis=1)
    return Arm(placed(real, moved[0] @ nominal.world_from_base, {"": nominal.tool() @ moved[1]}), gears)


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """``data`` : the poses measured, with covariance and their common errors; ``error`` : (m, 6) rad, mm of them;
    ``rows`` : (m,) of q, where the target shows enough."""

    data: Measurements
    error: np.ndarray
    rows: np.ndarray


def photograph(arm: Arm, target: TargetCircles, q: np.ndarray, rng: np.random.Generator) -> Photographs:
    """The target's pose in a photograph at each joint vector."""
    scene = rig().scene
    truth = arm.poses(q)
    found, rows = [], []
    for i, pose in enumerate(truth):
        image = see(scene, pose, tuple(scene.target_from_face), NOISE_PX, rng)
        if not enough(image.labels):
            continue
        seen = pose_from_circles(image, target, scene.camera)
        if seen.status == "certain":
            found.append(seen)
            rows.append(i)
    poses = Poses.of(pose.camera_from_target for pose in found)
    error = np.array([pose_error(pose, truth[i]) for pose, i in zip(poses, rows, strict=True)])
    covariance, common = np.array([pose.covariance for pose in found]), common_errors(found, target, None)
    seen = poses.translation, poses.rotation, covariance, common
    m = len(rows)
    return Photographs(Measurements("photographs", range(2, m + 2), q[rows], ("",) * m, *seen), error, np.array(rows))


def squared_error(found: Identified, arm: Arm, q: np.ndarray) -> float:
    """eᵀC⁻¹e over its degrees of freedom, of all parameters that such poses tell of the arm."""
    poses, m = arm.poses(q), len(q)
    exact = observed(Measurements("truth", range(m), q, ("",) * m, poses.translation, poses.rotation))
    slope = found.state.jacobian(exact).reshape(6 * m, -1)
    error = np.linalg.lstsq(slope, found.state.residuals(exact).ravel())[0]
    return float(error @ np.linalg.solve(found.covariance, error)) / len(error)


def one_draw(seed: int, index: int, gears_rad: float) -> Draw:
    """An arm made, photographed, identified, compensated and verified."""
    rng = np.random.default_rng([seed, index])
    arm, target = made_arm(gears_rad, rng), rig().known.measured(rng)
    q = np.concatenate([sweeps(), random_poses(POSES, rng)])
    every = photograph(arm, target, q, rng)
    # the middles of the faces, which every pose carries along, turn about the axes
    middles = np.array([plane.translation for plane in target.target_from_plane.values()])
    axes = robot_from_sweeps(every.data[every.rows < len(sweeps())], rig().nominal, places=middles).robot
    found = [identify(axes, data, IdentifyOptions(folds=0)) for data in (every.data, replace(every.data, common=None))]
    robots = {AXES: axes, CMMK: found[0].robot}
    squared = [squared_error(each, arm, q) for each in found]
    far, near = commanded(FAR, rng), commanded(NEAR, rng)
    q = joint_values(robots, near)
    seen = {name: photograph(arm, target, values, rng) for name, values in q.items()}
    rows = np.arange(VERIFIED)
    sets = {
        REACH: verified(far, {n: (rows, arm.poses(v).translation) for n, v in joint_values(robots, far).items()}),
        TRUE: verified(near, {n: (rows, arm.poses(v).translation) for n, v in q.items()}),
        CAMERA: verified(near, {n: (p.rows, p.data.positions) for n, p in seen.items()}),
    }
    return Draw(sets, every.error, np.array(squared))


def joint_values(robots: dict[str, Robot], targets: Targets) -> dict[str, np.ndarray]:
    """By every model the joint values for the commanded poses."""
    answers = {NOMINAL: targets.q}
    for name, robot in robots.items():
        answer = compensate(robot, targets, rig().nominal)
        if not answer.found.usable.all():
            raise SystemExit(f"error: {name}: {answer.notes()[0]}")
        answers[name] = answer.found.q
    return answers


def verified(targets: Targets, reached: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, SetResult]:
    """Distances from the first position against the commanded ones, by model, of rows and positions."""
    rows = np.concatenate([rows for rows, _ in reached.values()])
    sets = tuple(name for name, (own, _) in reached.items() for _ in own)
    xyz = np.concatenate([xyz for _, xyz in reached.values()])
    wanted = tuple(map(str, rows)), targets.poses.translation[rows]
    data = MeasuredPoses("commanded", range(len(rows)), sets, *wanted, xyz)
    return {each.name: each for each in verify(data).sets}


def print_table(draws: list[Draw]) -> None:
    """Markdown; beside the published figures ours, means over the draws."""
    reduced = "mean reduced by", "worst arm", "max by"
    head("51 positions", "model", "mean, mm", "std, mm", "max, mm", *reduced)
    cells = [f"{before:.4f} → {after:.4f}" for before, after in PUBLISHED.values()]
    mean, most = (f"{100 * (1 - PUBLISHED[key][1] / PUBLISHED[key][0]):.0f} %" for key in ("mean", "max"))
    print(f"| published, by laser tracker | {CMMK} | {' | '.join(cells)} | {mean} | | {most} |")
    for kind in draws[0].sets:
        before, *found = (
            np.array([(s.mean_mm, s.std_mm, s.max_mm) for s in (draw.sets[kind][model] for draw in draws)])
            for model in (NOMINAL, AXES, CMMK)
        )
        for model, after in zip((AXES, CMMK), found, strict=True):
            cells = [f"{b:.4f} → {a:.4f}" for b, a in zip(before.mean(0), after.mean(0), strict=True)]
            gain = 100 * (1 - after / before)
            reduced = f"{gain[:, 0].mean():.1f} ± {gain[:, 0].std(ddof=1):.1f} %", f"{gain[:, 0].min():.1f} %"
            row(kind, model, *cells, *reduced, f"{gain[:, 2].mean():.1f} %")


@script(draws=100, seed=0, gears=0.0, scheduler=str, limited=True)
def main(given) -> None:
    start = time.perf_counter()
    sweeps()  # once, before the processes part
    for kind in (FAR, NEAR):
        commands(kind)
    with executor_of(given.scheduler) as pool:
        count = given.draws
        draws = list(pool.map(one_draw, [given.seed] * count, range(count), [1e-3 * given.gears] * count))
    error = np.concatenate([draw.pose_error for draw in draws])
    turn, shift = (np.sqrt((part**2).sum(1).mean()) for part in (error[:, :3], error[:, 3:]))
    print(
        f"Simulated, {count} arms of the MH80's size; assumed σ of each joint's axis {MADE_MM:g} mm and "
        f"{1e3 * MADE_RAD:g} mrad, of its zero {1e3 * MADE_RAD:g} mrad, of its gears' errors {given.gears:g} mrad.\n"
        f"Target in {len(error) / count:.0f} photographs an arm from about {DISTANCE_MM / 1e3:g} m, σ of a centre "
        f"{NOISE_PX:g} px: origin off by {shift:.4f} mm, rotation by {1e3 * turn:.3f} mrad (RMS lengths).\n"
    )
    print_table(draws)
    told, untold = np.mean([draw.squared for draw in draws], axis=0)
    spread = np.std([draw.squared[0] for draw in draws]) / np.sqrt(count)
    print(
        f"\nParameters of the minimal model, eᵀC⁻¹e over their number, expected 1: {told:.2f} ± {spread:.2f}; "
        f"with the poses taken as independent {untold:.1f}."
    )
    print(f"\n{time.perf_counter() - start:.0f} s")
