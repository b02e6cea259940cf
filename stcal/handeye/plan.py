"""Robot poses to take next: those that would lower the worst σ of a hand-eye transform most, and their report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid, by_pose
from stcal.handeye.data.pose_pairs import HandEyePoses, Loop
from stcal.handeye.handeye_problem import HandEye
from stcal.io.json import Pose, ResultFile, Vector
from stcal.io.table import POSE, csv_text, pose_cells
from stcal.report.document import Document, Section, Table
from stcal.report.text import NONE, number

CANDIDATES = 2000  # number of candidate views of the board for each pose that is planned
ASKED = 64  # number of poses per call of ``reachable``
MOST_TILT = np.radians(40)
"""Largest tilt of the board against the line of sight, in rad. Beyond it dots and corners lose accuracy."""
MARGIN = 0.1  # margin that the board's outermost points keep from the image border, as a share of the image's sides
ABOUT = 0.25
"""Distance from the board's mean place to the other points at which σ is judged, as a share of its distance."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class NextPoses(Brief):
    """The k poses to take next, in order.

    Parameters
    ----------
    base_from_flange : planned poses of the flange, mm
    camera_from_board : poses of the board that the camera would see, mm
    sigma_mm : (k + 1,), worst σ of a point at the board due to the transform: now, and after each planned pose
    turn_rad : (k,), smallest rotation of the flange against any earlier pose, planned poses included
    """

    base_from_flange: Poses
    camera_from_board: Poses
    sigma_mm: np.ndarray
    turn_rad: np.ndarray

    def __post_init__(self):
        k = len(self.base_from_flange)
        freeze(self, "sigma_mm", (k + 1,), "σ")
        freeze(self, "turn_rad", (k,), "turns")


@require_arguments
def plan_poses(
    pairs: HandEyePoses,
    result: HandEye,
    count: int = 3,
    outline: np.ndarray | None = None,
    camera: Camera | None = None,
    reachable: Callable[[Poses], np.ndarray] | None = None,
    seed: int = 0,
) -> NextPoses:
    """Plans the poses that lower the worst σ of a point at the board most, one after the other.

    Candidates show the board at the distances at which it was seen, tilted by up to 40° and turned about the line of
    sight at random. Each candidate adds its information to that of the poses taken, with the σ of robot and camera that
    the result states or estimated; the wide rotations of Tsai & Lenz 1989 follow from this. The σ cover independent
    errors of the poses only. They contain neither errors of the camera file nor the scatter of
    :func:`~stcal.handeye.validate.scatter`, which further poses do not lower alike.

    Parameters
    ----------
    pairs : poses taken so far
    result : result from these poses
    count : number of poses to plan
    outline : (n, 3), points of the board that must be in the image, mm; the board's origin if None
    camera : camera whose image must hold the outline. If None, the board is placed along lines of sight on which its
        origin was seen.
    reachable : returns for n poses base_from_flange whether the robot reaches them, (n,) bool; all are reachable if
        None. It is called with :data:`ASKED` poses at a time, the best first.
    seed : seed of the random candidates

    Raises InputError: the result has no covariance, or no candidate is reachable with the board in view.
    """
    if result.covariance is None:
        raise InputError("E-PLAN-NO-SIGMA", f"plan: {result.method} gives no σ; give a result of pose or reprojection")
    inliers = np.flatnonzero(~result.outliers)
    loop = Loop.of(pairs, result.setup)[inliers]
    errors, rng = _errors(loop, result), np.random.default_rng(seed)
    x, z = result.mount_from_camera, result.stand_from_board
    normal = _information(loop, errors, result).sum(0)
    board_poses = loop.camera_from_board
    seen_views = Poses(board_poses.rotation, result.scale * board_poses.translation)
    outline = np.zeros((1, 3)) if outline is None else result.scale * np.asarray(outline, float)
    points = judged_at(seen_views.rotation @ outline.mean(0) + seen_views.translation)
    sigma, flanges, views, turns = [worst_sigma(normal, x, points)], [], [], []
    taken = pairs.base_from_flange.rotation[inliers]
    for _ in range(count):
        candidate_views = _views(rng, seen_views, outline, camera)
        stand_from_mount = z @ candidate_views.inverse() @ x.inverse()
        flange = stand_from_mount.inverse() if loop.inverted else stand_from_mount
        if not len(flange):
            said = f"plan: none of {CANDIDATES} views at the distances at which the board was seen shows all of it and "
            said += f"{MARGIN:.0%} of the image around; take it from farther away, or give a smaller board"
            raise InputError("E-PLAN-NO-VIEW", said)
        unscaled = Poses(candidate_views.rotation, candidate_views.translation / result.scale)
        normals = normal + _information(Loop(flange, unscaled, result.setup), errors, result)
        sigma_after = np.array([worst_sigma(candidate, x, points) for candidate in normals])
        order = np.argsort(sigma_after)
        batches = [order[start : start + ASKED] for start in range(0, len(order), ASKED)]
        able = (batch if reachable is None else batch[reachable(flange[batch])] for batch in batches)
        row = next((int(batch[0]) for batch in able if len(batch)), None)
        if row is None:
            said = f"plan: none of {len(flange)} views of the whole board is in the robot's reach"
            raise InputError("E-PLAN-OUT-OF-REACH", f"{said}; check robot file, board and setup")
        normal = normals[row]
        sigma.append(float(sigma_after[row]))
        flanges.append(flange[row])
        views.append(candidate_views[row])
        cosine = (np.einsum("mab,ab->m", taken, flange.rotation[row]) - 1) / 2
        turns.append(float(np.arccos(np.clip(cosine, -1, 1)).min()))
        taken = np.concatenate([taken, flange.rotation[row][None]])
    return NextPoses(Poses.of(flanges), Poses.of(views), np.array(sigma), np.array(turns))


def worst_sigma(normal: np.ndarray, mount_from_camera: Rigid, points: np.ndarray) -> float:
    """Returns the largest σ in any direction, mm, of ``points`` (n, 3) in the camera's frame, moved to the mount's."""
    covariance = generalised_inverse(normal)[:6, :6]
    jacobian = by_pose(np.tile(np.eye(3), (len(points), 1, 1)), points @ mount_from_camera.rotation.T)
    return float(np.sqrt(np.linalg.eigvalsh(jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)).max()))


def _errors(loop: Loop, result: HandEye) -> tuple[np.ndarray, np.ndarray]:
    """Returns covariances (6, 6) of a pose of flange and board: the mean of the stated, or from the result's σ."""
    sigma = result.sigma
    robot, camera = (
        np.diag(np.square(np.repeat([sigma.get(f"{side}_{unit}", 0.0) for unit in ("rad", "mm")], 3)))
        for side in ("robot", "camera")
    )
    if loop.robot_covariance is not None and "robot_rad" not in sigma:
        robot = loop.robot_covariance.mean(0)
    if loop.camera_covariance is not None:
        camera = sigma.get("camera_factor", 1.0) ** 2 * loop.camera_covariance.mean(0)
    return robot, camera


def _information(loop: Loop, errors: tuple[np.ndarray, np.ndarray], result: HandEye) -> np.ndarray:
    """Returns the information of each pose about X and Z, (m, 12, 12)."""
    x, scale = result.mount_from_camera, result.scale
    robot, camera = loop.by_robot(x, scale), loop.by_camera(x, scale)
    spread = robot @ errors[0] @ np.swapaxes(robot, 1, 2) + camera @ errors[1] @ np.swapaxes(camera, 1, 2)
    jacobian = loop.jacobian(x, scale)
    return np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(spread, jacobian)


def judged_at(board_mm: np.ndarray) -> np.ndarray:
    """Returns seven points in the camera's frame at which σ is judged: the mean of ``board_mm``, and six about it."""
    middle = board_mm.mean(0)
    reach = ABOUT * float(np.linalg.norm(board_mm, axis=1).mean())
    return middle + reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


def _views(rng: np.random.Generator, earlier: Poses, outline: np.ndarray, camera: Camera | None) -> Poses:
    """Returns random views of the board (camera_from_board): at the distances seen so far, tilted and turned."""
    middle = outline.mean(0)
    places = earlier.rotation @ middle + earlier.translation
    distance = np.linalg.norm(places, axis=1)
    if camera is None:
        sight = places[rng.integers(len(places), size=CANDIDATES)]
    else:
        size = np.array([camera.width, camera.height])
        pixel = rng.uniform(MARGIN * size, (1 - MARGIN) * size, (CANDIDATES, 2))
        sight = np.column_stack([camera.normalised_from_pixel(pixel), np.ones(CANDIDATES)])
    sight = sight / np.linalg.norm(sight, axis=1)[:, None]
    place = rng.uniform(distance.min(), distance.max(), (CANDIDATES, 1)) * sight
    # Start from a view that was seen, turn it to face the camera, roll it about the line of sight, then tilt it.
    base = rng.integers(len(earlier), size=CANDIDATES)
    facing = earlier.rotation[base, :, 2]
    facing = facing * np.sign(np.einsum("ma,ma->m", facing, places[base]))[:, None]
    axis = np.cross(facing, sight)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ma,ma->m", facing, sight))
    onto = Rotation.from_rotvec(axis / np.maximum(sine, 1e-300)[:, None] * angle[:, None])
    roll = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (CANDIDATES, 1)) * sight)
    across = np.cross(sight, rng.normal(size=(CANDIDATES, 3)))
    across /= np.linalg.norm(across, axis=1)[:, None]
    tilt = Rotation.from_rotvec(rng.uniform(0, MOST_TILT, (CANDIDATES, 1)) * across)
    rotation = (tilt * roll * onto).as_matrix() @ earlier.rotation[base]
    poses = Poses(rotation, place - rotation @ middle)
    if camera is None:
        return poses
    points = np.einsum("mab,nb->mna", poses.rotation, outline) + poses.translation[:, None]
    front = (points[..., 2] > 0).all(1)
    pixels = camera.project(points[front].reshape(-1, 3)).reshape(-1, len(outline), 2)
    inside = ((pixels >= MARGIN * size) & (pixels <= (1 - MARGIN) * size)).all((1, 2))
    return poses[np.flatnonzero(front)[inside]]


class HandEyePlanFile(ResultFile):
    """Result file of ``handeye plan``."""

    format: Literal["stcal handeye plan 1"] = Field(description="the file's form and its version")
    setup: str = Field(description="`eye-in-hand` or `eye-to-hand`")
    method: str = Field(description="that solved for the poses taken")
    taken: list[str] = Field(description="names of the poses taken that the solution rests on")
    sigma_mm: Vector = Field(
        description="largest σ, in any direction, of a point at the board: now, and after each of the poses"
    )
    base_from_flange: list[Pose] = Field(description="poses to take, in order")
    camera_from_board: list[Pose] = Field(description="how the board is seen there")
    turn_rad: Vector = Field(description="of each pose against the nearest pose taken")
    joints: dict[str, Vector] = Field(description="values of the poses by column, deg or mm; empty without a robot")

    @classmethod
    def of(cls, result: HandEye, planned: NextPoses, joints: dict[str, np.ndarray]) -> "HandEyePlanFile":
        taken = [name for name, out in zip(result.names, result.outliers, strict=True) if not out]
        known: dict[str, Any] = {"setup": result.setup, "method": result.method, "taken": taken, "joints": joints}
        known |= {name: getattr(planned, name) for name in ("sigma_mm", "turn_rad")}
        known |= {name: list(getattr(planned, name)) for name in ("base_from_flange", "camera_from_board")}
        return cls(format="stcal handeye plan 1", **known)


def planned_report(result: HandEye, planned: NextPoses, joints: dict[str, np.ndarray]) -> Document:
    taken = int((~result.outliers).sum())
    heads = ["<pose", "worst σ, mm", "turn, °", "x, mm", "y, mm", "z, mm", "rx, °", "ry, °", "rz, °"]
    rows, cells = [[f"{taken} taken", number(planned.sigma_mm[0], 3), *[NONE] * 7]], []
    for k, (sigma, turn) in enumerate(zip(planned.sigma_mm[1:], planned.turn_rad, strict=True)):
        flange = planned.base_from_flange[k]
        place = [f"{value:.2f}" for value in (*flange.translation, *np.degrees(flange.log()[:3]))]
        rows.append([f"next {k + 1}", number(sigma, 3), f"{np.degrees(turn):.0f}", *place])
        cells.append([f"next {k + 1}", *(f"{values[k]:.3f}" for values in joints.values())])
    last = "joint limits and the image" if joints else "the image; give --robot for joint limits"
    blocks = [
        Table(heads, rows),
        Table(["<joints", *joints], cells if joints else []),
        "turn: relative to the nearest pose taken; rx, ry, rz: rotation vector. σ include only independent errors of "
        f"the poses. Collisions are not checked, only {last}",
    ]
    about = f"{result.setup}, method {result.method}: poses of the flange in the base, in order, and the worst σ of a "
    about += "point at the board with each"
    return Document("Poses to take next", about, [Section("Poses", blocks, terminal=True)])


@require_arguments
def planned_csv(planned: NextPoses, joints: dict[str, np.ndarray] | None = None) -> str:
    """Returns the table of the poses to take next.

    Parameters
    ----------
    planned : of :func:`~stcal.handeye.plan_poses`, k poses
    joints : (k,), joint values of the poses by the name of their column, ``q1_deg`` …, degrees or mm

    Returns
    -------
    str : CSV with base_from_flange and camera_from_board, mm (form: ``data_layout.md``).
    """
    joints = joints or {}
    frames = {"base_from_flange": planned.base_from_flange, "camera_from_board": planned.camera_from_board}
    heads = ["pose", "worst_sigma_mm", "turn_deg", *joints, *(f"{name}_{c}" for name in frames for c in POSE)]
    rows: list[Sequence] = [heads]
    for k, turn in enumerate(planned.turn_rad):
        values = [planned.sigma_mm[k + 1], np.degrees(turn), *(of[k] for of in joints.values())]
        poses = (cell for each in frames.values() for cell in pose_cells(each[k]))
        rows.append([k + 1, *(repr(float(value)) for value in values), *poses])
    return csv_text(rows)
