#!/usr/bin/env python
"""Are σ true? Random halves of real photographs, two cameras of one body, and simulated views, against stated σ.

Printed is χ² per degree of freedom, 1 where σ are right. Cameras: the views of a set are drawn into two halves, each
calibrates by itself, and the difference of the two answers is over the sum of their covariances. Use: two cameras
measure a cube, as the first one calibrated it, and their poses say where the second stands from the first; a hand-eye
calibration and a robot by halves of their poses, compared where the robot's tool is. Simulated: errors against the
truth, `field` with errors of twice the noise that neighbouring places of a photograph have in common, `print` with
boards stretched, sheared and curved as printers do, `bad` with one photograph whose errors are eight times the noise.

.venv/bin/python scripts/studies/halves_study.py [--part all|cameras|use|simulated] [--draws N]
"""

import tempfile
from collections.abc import Iterator, Sequence
from itertools import compress
from pathlib import Path

import numpy as np
from camera_peers import NOISE_PX, TRUE, held, view_of
from real_bodies import pycamset_cube
from same_results import CHARUCO, prepare, robot_table

from scripts.runner import DATA, head, script
from scripts.runner import row as print_row
from stcal.boards.board_designs import ChessboardDesign
from stcal.boards.board_file import load_flat_board
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, reference_board
from stcal.errors import StcalError
from stcal.geometry.least_squares import block_diagonal
from stcal.geometry.print_modes import PrintModes
from stcal.geometry.rigid import Poses, skew
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.io.cameras.read import load_camera
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.measurements import read_measurements
from stcal.robot.kinematics.robot_file import load_robot
from stcal.sfm import measure, pipeline
from stcal.sfm.adjust.faces_file import read_target
from stcal.sfm.camera.calibrate import CameraCalibration, calibrate_camera
from stcal.sfm.camera.intrinsics import Intrinsics, adjust_intrinsics, model_parameters, of_some_views
from stcal.sfm.data.group_model import ImageObservations
from stcal.workflows.board_views import calibrate_camera_by_corners, corner_grid
from stcal.workflows.handeye_inputs import read_handeye

CAMERAS = {
    "ChArUco 1, real": ("real/pycamset_charuco/1", "real/pycamset_charuco/board.toml"),
    "ChArUco 2, real": ("real/pycamset_charuco/2", "real/pycamset_charuco/board.toml"),
    "chessboard, real": ("real/multidic_chessboard/201", "real/multidic_chessboard/board.toml"),
    "dots, rendered clean": ("stereo_target/clean/images", None),
    "dots, rendered exact": ("stereo_target/exact/images_png", None),
    "dots, rendered focus": ("stereo_target/focus/images_png", None),
}
GROUPS = {"f": slice(0, 2), "c": slice(2, 4), "lens": slice(4, None), "all": slice(None)}
KINDS = ("none", "field", "print", "few", "few print", "bad")
FIELD_PX = 250.0


def squares(off: np.ndarray, covariance: np.ndarray) -> list[float]:
    """χ² per degree of freedom of each group of parameters."""
    parts = [(off[own], covariance[own, own]) for own in GROUPS.values()]
    return [float(e @ np.linalg.solve(c, e) / len(e)) for e, c in parts]


def row(name: str, table: Sequence[Sequence[float]], *more: str) -> None:
    """Prints a row of the table: the mean of each column, and its standard error for the last."""
    values = np.array(table)
    error = values[:, -1].std(ddof=1) / np.sqrt(len(values))
    print_row(name, *(f"{v:.2f}" for v in values.mean(0)), f"{error:.2f}", *more)


def parameters(result: Intrinsics) -> np.ndarray:
    """Of the lens model, (q,)."""
    return model_parameters(result.camera, result.colmap_model)


def halves(calibration: CameraCalibration, board: BoardDesign, draws: int) -> Iterator[list[float]]:
    """χ² of the difference of random halves; a draw whose half does not determine the camera is left out."""
    views = calibration.views
    for parts in drawn_halves(len(views), draws):
        try:
            one, two = (of_some_views(calibration.intrinsics, [views[i] for i in part], board) for part in parts)
        except StcalError:
            continue
        yield squares(parameters(one) - parameters(two), one.covariance + two.covariance)


def of_cameras(draws: int) -> None:
    """Print the table of halves."""
    head("photographs", "views", *GROUPS, "±", "photographs differ, × σ", "stretch, %")
    for name, (folder, file) in CAMERAS.items():
        if not (DATA / folder).is_dir():
            continue
        if file is None:
            board = reference_board()
            calibration = calibrate_camera(DATA / folder, target_of(None), board)
        else:
            flat = load_flat_board(DATA / file)
            board, calibration = corner_grid(flat), calibrate_camera_by_corners(DATA / folder, flat)
        result, table = calibration.intrinsics, list(halves(calibration, board, draws))
        stretch = ", ".join(f"{100 * own[0]:.3f}" for own in result.prints().values())
        row(f"{name} | {len(calibration.views)}", table, f"{result.differ:.2f}", stretch)


def of_measuring(run: Path, other: Path) -> None:
    """Print χ² of where one camera stands from the other, by the poses that both measure of one cube."""
    circles, poses, roots = read_target(run / "faces.json", pycamset_cube()), [], []
    for folder, camera in ((run, "cam0"), (other, "cam1")):
        lens = load_camera(folder / "colmap" / "refined_cameras.txt")
        found = measure(DATA / "real" / "pycamset_cube" / camera, lens, circles)
        poses.append({image.name: image.pose for image in found.images})
        roots.append(square_root(lens.covariance))
    shape, names = square_root(circles.covariance), sorted(poses[0].keys() & poses[1].keys())
    apart, own, common = [], [], []
    for name in names:
        (a, b), parts = (each[name] for each in poses), []
        between = a.camera_from_target @ b.camera_from_target.inverse()
        across = np.eye(6)  # of a motion of the second camera, seen from the first
        across[:3, :3] = across[3:, 3:] = -between.rotation
        shift = between.rotation @ b.camera_from_target.translation
        across[3:, :3] = -skew(shift) @ between.rotation
        to_first = np.eye(6)
        to_first[3:, :3] = -skew(between.translation - a.camera_from_target.translation)
        for pose, motion, root in ((a, to_first, roots[0]), (b, across, roots[1])):
            rows = (3 * np.array([circles.place[label] for label in pose.labels])[:, None] + np.arange(3)).ravel()
            parts.append((motion @ pose.by_circles @ shape[rows], motion @ pose.by_intrinsics @ root))
        own.append(sum(m @ p.parts["image"] @ m.T for p, m in ((a, to_first), (b, across))))
        common.append(np.hstack([parts[0][0] + parts[1][0], parts[0][1], parts[1][1]]))
        apart.append(between)
    full = block_diagonal(np.array([own]))[0] + np.vstack(common) @ np.vstack(common).T
    each, mean, weight = Poses.of(apart), apart[0], np.linalg.inv(full)
    motion = np.tile(np.eye(6), (len(names), 1))
    for _ in range(5):
        off = each.difference(Poses.of([mean] * len(names))).ravel()
        mean = mean.moved(np.linalg.solve(motion.T @ weight @ motion, motion.T @ weight @ off))
    off = each.difference(Poses.of([mean] * len(names))).ravel()
    print_row("measure: cube, two cameras, real", len(names), f"{off @ weight @ off / (len(off) - 6):.2f}")


def square_root(covariance: np.ndarray) -> np.ndarray:
    """A matrix whose product with its transpose is the covariance."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0))


def drawn_halves(count: int, draws: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Random halves of numbers."""
    rng = np.random.default_rng(0)
    for _ in range(draws):
        drawn = rng.permutation(count)
        yield np.sort(drawn[: count // 2]), np.sort(drawn[count // 2 :])


def of_use(draws: int) -> None:
    """Print χ² of what a target is used for."""
    print()
    head("use", "poses", "χ²")
    with tempfile.TemporaryDirectory() as name:
        scratch, cube = Path(name), DATA / "real" / "pycamset_cube"
        for camera in ("cam0", "cam1"):
            pipeline.run(cube / camera, None, scratch / camera, pycamset_cube())
        of_measuring(scratch / "cam0", scratch / "cam1")
        folder = DATA / "charuco_handeye" / "test_set_charuco"
        (scratch / "board.toml").write_text(CHARUCO)
        (scratch / "poses.csv").write_text(robot_table(folder / "poses"))
        files = folder / "images", scratch / "poses.csv", folder / "cal_data.yaml", scratch / "board.toml"
        given = read_handeye(*files, workers=1)
        assert given.views is not None
        values = []
        for parts in drawn_halves(len(given.pairs), draws):
            halves = (HandEyeProblem(given.pairs[own], "eye-to-hand", given.views[own]) for own in parts)
            one, two = (half.solved("reprojection").result for half in halves)
            (off,) = Poses.of([one.mount_from_camera]).difference(Poses.of([two.mount_from_camera]))
            values.append(float(off @ np.linalg.solve(one.covariance + two.covariance, off) / 6))
        print_row("hand-eye: ChArUco by corners, real", len(given.pairs), f"{np.mean(values):.2f}")
        prepare(scratch)
        robot = load_robot(scratch / "rokae.toml")
        data = read_measurements(scratch / "rokae.csv", robot)
        for kind in ("pose", "position"):
            values = []
            for parts in drawn_halves(len(data), draws):
                ends = []
                for own in parts:
                    found = identify(robot, data[own], IdentifyOptions(kind, folds=0, partial=True))
                    at, motion = found.state.tip_jacobian(data.q, data.targets, found.seen.kind)
                    motion = motion[:, 3:, : len(found.names)]
                    ends.append((at.translation, motion @ found.covariance @ np.swapaxes(motion, 1, 2)))
                off, covariance = ends[0][0] - ends[1][0], ends[0][1] + ends[1][1]
                square = np.einsum("mi,mi->m", off, np.linalg.solve(covariance, off[..., None])[..., 0])
                values.append(float(square.mean() / 3))
            print_row(f"robot: Rokae by {kind}s, real", len(data), f"{np.mean(values):.2f}")


def simulated(rng: np.random.Generator, kind: str) -> list[ImageObservations]:
    """Views of the reference board, held by hand 0.3 to 0.6 m away."""
    board, views = reference_board(), []
    count = 5 if "few" in kind else 14
    places = np.column_stack([board.xy_mm(), np.zeros(63)]) + board.sigma_mm * rng.standard_normal((63, 3))
    if "print" in kind:
        modes = PrintModes.of(board.xy_mm())
        places += (modes.modes @ (modes.spread_mm * rng.standard_normal(len(modes.spread_mm)))).reshape(63, 3)
    size = np.array([TRUE.width, TRUE.height])
    while len(views) < count:
        rotation, middle = held(rng, 600, 0.35)
        xy = TRUE.project((places - [120.0, 90.0, 0.0]) @ rotation.T + middle)
        seen = ((xy > 20) & (xy < size - 20)).all(1)
        if seen.sum() < 30:
            continue
        xy, n = xy[seen], int(seen.sum())
        common = {"field": 2.0, "bad": 8.0 * (len(views) == 3)}.get(kind, 0.0) * NOISE_PX
        apart = ((xy[:, None] - xy) ** 2).sum(2)
        root = np.linalg.cholesky(np.exp(-apart / 2 / FIELD_PX**2) + 1e-9 * np.eye(n))
        xy = xy + common * root @ rng.standard_normal((n, 2)) + NOISE_PX * rng.standard_normal((n, 2))
        views.append(view_of(len(views), compress(board.labels(), seen.tolist()), xy))
    return views


def of_simulated(draws: int) -> None:
    """Print χ² of errors, and σ over those of independent errors of pixels."""
    print()
    head("simulated", *GROUPS, "±", "σ over those of independent pixels")
    board = corner_grid(ChessboardDesign(7, 9, 30.0, 0.005))  # the places of the dots, without their extent
    for kind in KINDS:
        table, larger = [], []
        for seed in range(draws):
            result = adjust_intrinsics(simulated(np.random.default_rng(seed), kind), board, TRUE, "OPENCV")
            off = parameters(result) - model_parameters(TRUE, "OPENCV")
            table.append(squares(off, result.covariance))
            larger.append(np.sqrt(np.diag(result.covariance) / np.diag(result.independent)).mean())
        row(kind, table, f"{np.mean(larger):.2f}")


@script(part="all", draws=20)
def main(arguments) -> None:
    for part, needed, print_part in (
        ("cameras", ".", of_cameras),
        ("use", "rokae_tracker", of_use),
        ("simulated", ".", of_simulated),
    ):
        if arguments.part in ("all", part) and (DATA / needed).is_dir():
            print_part(arguments.draws)
