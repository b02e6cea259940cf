"""The experiments of Zhang & Wei (2017) in simulation: five trials on the board (Table 1) and five faces (Table 2).

.venv/bin/python scripts/reproduce/reproduce_paper.py [--trials 5] [--width 5184] [--keep FOLDER] [--plot FILE.svg]

Every trial renders a scene of its own (target, board, camera, noise): four groups of ten photographs. It is solved
- by the paper's method: centres of the ellipses fitted to thresholded contours, all weighted alike, taken for the
  images of the circles' centres; group by group, scale from the first and last row, faces from three points, chained;
- by the same with this package's centres, to tell what the centres do from what the adjustment does;
- by this package with its defaults.
Prints the mean length of the board residuals per trial and their standard deviation (both columns of Table 1, in every
group by itself, against the design; the mean against the dots as they really are too), the errors of the faces against
the truth, and, for this package, their RMS over the trials beside the predicted σ and the goals. Labels are this
package's in all three. With --keep,
photographs and detections are used again.
"""

import argparse
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np

from stcal.geometry.align import align_rigid
from stcal.geometry.rigid import Rigid, Similarity
from stcal.labels import dot_cells
from stcal.parallel import one_thread
from stcal.report.figure import save
from stcal.sfm import run
from stcal.sfm.adjust.faces import faces_of_group
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.data.model import WorldModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.mapping.graph import image_graph
from stcal.sfm.run.options import RunOptions
from stcal.sfm.run.solve import solve_groups
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import Scene, SceneOptions, make_scene

PUBLISHED_UM = (33.879, 25.255, 35.691, 32.401, 38.982)
PUBLISHED_SPREAD_UM = (12.645, 12.979, 16.310, 11.595, 14.374)
"""Table 1 of the paper: average error, and what it calls mean square error; that is less than the average, so that it
can only be the lengths' standard deviation about it."""
PAPER, MIXED, OURS = "the paper's method", "the same, our centres", "ours"
COLOURS = {PAPER: "#d55e00", MIXED: "#c98a00", OURS: "#0072b2"}
GOALS = {"2": (2.0, 1.2), "3": (3.0, None), "4": (2.0, 1.2), "5": (2.0, 1.2)}
"""Position (µm) and rotation (mdeg), RMS."""
EQUAL_SIGMA_PX = 0.05
"""σ of every centre in the paper's method; only that it is the same for all matters."""
CONTOUR_REACH = 1.5
"""Side of the window about a circle, in diameters."""
MIN_CONTOUR_AREA = 0.5
"""Of the circle's image."""


@dataclass(frozen=True, slots=True)
class Errors:
    """One trial by one method: by face (position µm, rotation mdeg); length of the board's residuals, µm: mean against
    the design, mean against the true dots, standard deviation against the design; by face the predicted σ of position
    (µm), where there is one."""

    faces: dict[str, tuple[float, float]]
    board_um: tuple[float, float, float]
    predicted_um: dict[str, float]


def contour_observations(path: Path, image: ImageObservations, scene: Scene) -> ImageObservations:
    """The observations with the centres of ellipses fitted to contours; circles without a contour are left out."""
    grey = cv2.GaussianBlur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (5, 5), 0)
    shapes = image.shape * scene.camera.focal[:, None]
    found = [contour_centre(grey, xy, shape) for xy, shape in zip(image.centre_px, shapes, strict=True)]
    keep = [i for i, xy in enumerate(found) if xy is not None]
    xy = np.array([found[i] for i in keep])
    return replace(
        image.select(keep),
        centre_px=xy,
        centre=scene.camera.normalised_from_pixel(xy),
        covariance_px2=np.tile(EQUAL_SIGMA_PX**2 * np.eye(2), (len(keep), 1, 1)),
    )


def contour_centre(grey: np.ndarray, centre_px: np.ndarray, shape_px: np.ndarray) -> np.ndarray | None:
    """Centre of the ellipse through the thresholded contour about a circle that is known to be near."""
    half = CONTOUR_REACH * np.linalg.norm(shape_px, axis=1)
    low = np.maximum(np.floor(centre_px - half), 0).astype(int)
    high = np.minimum(np.ceil(centre_px + half).astype(int) + 1, grey.shape[::-1])
    window = grey[low[1] : high[1], low[0] : high[0]]
    if np.ptp(window) == 0:
        return None
    _, binary = cv2.threshold(window, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    least = MIN_CONTOUR_AREA * np.pi * abs(np.linalg.det(shape_px))
    centres = [low + cv2.fitEllipse(c)[0] for c in contours if len(c) >= 5 and cv2.contourArea(c) > least]
    return min(centres, key=lambda xy: np.linalg.norm(xy - centre_px), default=None)


def by_the_paper(observations: list[ImageObservations], scene: Scene, out: Path) -> Errors:
    """Group by group, without eccentricity and weights."""
    options = RunOptions(solve="chain", frame="three-point", eccentricity=False).settled(scene.target)
    graph = image_graph(observations, scene.board, options.graph)
    (out / "cache").mkdir(parents=True, exist_ok=True)
    folders, designs = (out / "scratch", out / "cache"), (scene.target, scene.board)
    solutions, _ = solve_groups(observations, graph, *folders, scene.camera, *designs, options, lambda *_: None)
    frames, boards = {}, []
    for model in (s.model for s in solutions):
        scale = find_scale(model, scene.board).rows_mm_per_unit
        faces, _ = faces_of_group(model.metric(Similarity(scale, Rigid())), scene.camera, scene.target, options.frame)
        frames[model.group] = {each.face: each.group_from_face for each in faces}
        boards.append(board_errors(model, scale, scene))
    return errors(chained(frames, scene), boards, scene)


def chained(frames: dict[str, dict[str, Rigid]], scene: Scene) -> dict[str, Rigid]:
    """target_from_face by the groups' own two faces, in their order: eq. 11 of the paper."""
    target_from_face = {scene.reference_face: Rigid()}
    for name, group in scene.groups.items():
        known, new = group.faces
        target_from_face[new] = target_from_face[known] @ frames[name][known].inverse() @ frames[name][new]
    return target_from_face


def by_us(data: Path, scene: Scene, out: Path) -> tuple[Errors, list[ImageObservations]]:
    """The package's defaults; and its labelled centres."""
    result = run(data / "images", data / "cameras.txt", out, data / "target.toml", data / "board.toml")
    calibration = result.calibration
    boards = [board_errors(s.model, calibration.scales[s.model.group].mm_per_unit, scene) for s in result.solutions]
    sigma = {f: 1e3 * float(np.sqrt(np.trace(c[3:, 3:]))) for f, c in calibration.target.face_covariance.items()}
    return errors(calibration.target.target_from_face, boards, scene, sigma), result.observations()


def board_errors(model: WorldModel, mm_per_unit: float, scene: Scene) -> tuple[float, float, float]:
    """Length of the scaled board's residuals, µm, as :class:`Errors` has it."""
    rows, columns = scene.board.rows, scene.board.columns
    members = model.points_by_face()["board"]
    cells = dot_cells(model.labels[i] for i in members)
    numbers = cells[:, 0] * columns + cells[:, 1]
    design = np.column_stack([scene.board.xy_mm(), np.zeros(rows * columns)])
    answers = []
    for dots in (design, scene.groups[model.group].board_circles_target):
        lengths = []
        for chosen in (dots[numbers], dots[::-1][numbers]):  # a plain board may be numbered from either end
            found = mm_per_unit * model.xyz_model[members]
            lengths.append(1e3 * np.linalg.norm(align_rigid(chosen, found) @ found - chosen, axis=1))
        answers.append(min(lengths, key=np.mean))
    return float(answers[0].mean()), float(answers[1].mean()), float(answers[0].std())


def errors(target_from_face: dict[str, Rigid], boards, scene: Scene, predicted_um=None) -> Errors:
    """Errors against the scene."""
    faces = {}
    for face, true in scene.target_from_face.items():
        if face != scene.reference_face:
            pose = target_from_face[face]
            turn = Rigid(pose.rotation @ true.rotation.T).angle_rad()
            shift = np.linalg.norm(pose.translation - true.translation)
            faces[face] = (1e3 * float(shift), 1e3 * float(np.degrees(turn)))
    return Errors(faces, tuple(np.mean(boards, axis=0)), predicted_um or {})


def trial(seed: int, width: int, folder: Path) -> dict[str, Errors]:
    """Render (unless the folder has it) and solve by all methods."""
    scene = make_scene(SceneOptions(seed=seed, width=width, height=round(width / 1.5)))
    data = folder / "data"
    if not data.is_dir():
        with tempfile.TemporaryDirectory(dir=folder) as partial:
            write_dataset(Path(partial) / "data", scene)
            (Path(partial) / "data").rename(data)
    ours, observations = by_us(data, scene, folder / "run")
    alike = [replace(o, covariance_px2=np.tile(EQUAL_SIGMA_PX**2 * np.eye(2), (len(o), 1, 1))) for o in observations]
    with ThreadPoolExecutor() as pool:
        contours = list(pool.map(lambda o: contour_observations(data / "images" / o.name, o, scene), observations))
    return {
        PAPER: by_the_paper(contours, scene, folder / "paper"),
        MIXED: by_the_paper(alike, scene, folder / "mixed"),
        OURS: ours,
    }


def print_tables(trials: list[dict[str, Errors]]) -> None:
    """Markdown."""
    methods, faces = list(COLOURS), list(trials[0][OURS].faces)
    boards = np.array([[each[m].board_um for m in methods] for each in trials])
    poses = np.array([[[each[m].faces[f] for f in faces] for m in methods] for each in trials])
    predicted = np.array([[each[OURS].predicted_um[f] for f in faces] for each in trials])
    print(
        "\nTable 1: length of the board residuals, µm: mean ± standard deviation against the design (mean against the"
    )
    print("true dots)\n")
    print(f"| trial | published | {' | '.join(methods)} |\n|---|---|{'---|' * len(methods)}")
    both = zip(PUBLISHED_UM, PUBLISHED_SPREAD_UM, strict=True)
    published = [f"{um:.1f} ± {spread:.1f}" for um, spread in both] + [""] * len(trials)
    rows = [(f"{i + 1}", published[i], row) for i, row in enumerate(boards)]
    known = f"{np.mean(PUBLISHED_UM):.1f} ± {np.mean(PUBLISHED_SPREAD_UM):.1f}"
    for name, shown, row in (*rows, ("mean", known, boards.mean(0))):
        cells = " | ".join(f"{design:.1f} ± {spread:.1f} ({true:.1f})" for design, true, spread in row)
        print(f"| {name} | {shown} | {cells} |")
    print("\nTable 2: errors of target_from_face, mean over the trials\n")
    print(f"| face | {' | '.join(methods)} |\n|---|{'---|' * len(methods)}")
    for face, row in zip(faces, poses.mean(0).swapaxes(0, 1), strict=True):
        print(f"| {face} | {' | '.join(f'{um:.1f} µm, {mdeg:.1f} mdeg' for um, mdeg in row)} |")
    print("\nOurs, RMS over the trials (goal)\n")
    print("| face | position, µm | predicted σ, µm | rotation, mdeg |\n|---|---|---|---|")
    own = np.sqrt((poses[:, methods.index(OURS)] ** 2).mean(0))
    for face, (um, mdeg), sigma in zip(faces, own, np.sqrt((predicted**2).mean(0)), strict=True):
        goal_um, goal_mdeg = GOALS[face]
        print(f"| {face} | {um:.2f} ({goal_um:g}) | {sigma:.2f} | {mdeg:.2f} ({goal_mdeg or '–'}) |")


def draw(trials: list[dict[str, Errors]], path: Path, width: int) -> None:
    """Face errors and board residuals of all trials, logarithmic."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), width_ratios=(3, 2), layout="constrained")
    faces, offsets = list(trials[0][OURS].faces), np.linspace(-0.22, 0.22, 3)
    for (method, colour), offset in zip(COLOURS.items(), offsets, strict=True):
        values = np.array([[each[method].faces[f][0] for f in faces] for each in trials])
        x, size = np.arange(len(faces)) + offset, 9 if method == MIXED else 5  # it lies under ours
        left.plot(np.tile(x, (len(trials), 1)), values, "o", color=colour, ms=4, alpha=0.55, mew=0)
        left.plot(x, values.mean(0), "_", color=colour, ms=17, mew=2.5, label=method)
        board = [each[method].board_um[0] for each in trials]
        right.plot(np.arange(1, len(trials) + 1), board, "o-", color=colour, ms=size, label=method)
    board = [each[OURS].board_um[1] for each in trials]
    right.plot(np.arange(1, len(trials) + 1), board, "o:", color=COLOURS[OURS], mfc="w", label="ours, to true dots")
    left.set(yscale="log", ylabel="position error, µm", xticks=range(len(faces)), title="Faces (Table 2)")
    left.set_xticklabels([f"face {f}" for f in faces])
    left.legend(frameon=False, fontsize=9, loc="lower center", ncols=3, columnspacing=1, handletextpad=0.3)
    left.set_ylim(bottom=left.get_ylim()[0] / 2.2)
    shown = PUBLISHED_UM[: len(trials)]
    right.plot(np.arange(1, len(shown) + 1), shown, "s--", color="#333333", ms=5, label="published (measured)")
    right.set(ylabel="mean board residual, µm", xlabel="trial", xticks=range(1, len(trials) + 1), ylim=(0, 60))
    right.set_title("Board against its design (Table 1)")
    right.legend(frameon=False, fontsize=9, loc="upper right")
    for axes in (left, right):
        axes.grid(axis="y", which="both", color="#d5d9de", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.set_major_formatter("{x:g}")
    figure.suptitle(f"Simulated photographs, {width} px wide, 10 a group, {len(trials)} trials", fontsize=11)
    save(figure, path)


@one_thread()
def main() -> None:
    """Run the trials; print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--width", type=int, default=5184, help="of the images, px")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep photographs and runs here, or use those")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw into FILE.svg or .png")
    arguments = parser.parse_args()
    trials = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(1, arguments.trials + 1):
            folder = (arguments.keep or Path(scratch)) / f"{arguments.width}-{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            trials.append(trial(seed, arguments.width, folder))
            print(f"trial {seed} of {arguments.trials} done", flush=True)
    print(f"\nSimulated photographs, {arguments.width} px wide, 10 a group, board σ 5 µm")
    print_tables(trials)
    if arguments.plot:
        draw(trials, arguments.plot, arguments.width)


if __name__ == "__main__":
    main()
