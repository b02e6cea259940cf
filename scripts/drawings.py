"""The drawings of docs/explanation/, as SVG: each from the package's own formulas, none by hand.

.venv/bin/python scripts/drawings.py [NAME …] [--out FOLDER]

`eccentricity` : a circle seen obliquely, the centre of its ellipse and the image of its own centre, and how far they
are apart; `residuals` : the same simulated labels adjusted with and without the correction, residuals beside errors;
`chain` : groups of photographs that link the faces; `folders` : the folders of the package by what they import, and the
way of a photograph through `stcal/sfm`.
"""

import argparse
import ast
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np

from stcal.design import reference_board, reference_target
from stcal.geometry.plane import circle_image_offset, circle_images
from stcal.geometry.rigid import Rigid, Similarity
from stcal.report.svg import COLOURS, FAINT, INK, calm, new_figure
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.options import RunOptions
from stcal.synthetic.scene import SceneOptions, make_scene

ROOT = Path(__file__).resolve().parents[1]
BLUE, RED, GREEN = COLOURS[:3]
FOCAL_PX = 24 / 36 * 5184
"""Of a 24 mm lens over 5184 px."""
NOISE_PX = 0.01
LAYERS = (
    ("errors", "cross_validation", "geometry"),
    ("labels", "design", "lookalikes", "io", "boards", "report"),
    ("synthetic", "drawing"),
    ("sfm", "robot", "register", "handeye", "locate"),
    ("workflows",),
    ("cli",),
)


def images_of(radius_mm: np.ndarray, distance_mm: float, tilt_deg: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of ellipses, their shapes and images of the circles' own centres, px from the principal point."""
    tilt = np.radians(tilt_deg)
    axes = np.array([[np.cos(tilt), 0], [0, 1], [np.sin(tilt), 0]])
    xyz = np.tile([0.0, 0.0, distance_mm], (len(radius_mm), 1))
    centre, shape = circle_images(xyz, axes, radius_mm)
    return FOCAL_PX * centre, FOCAL_PX * shape, FOCAL_PX * xyz[:, :2] / xyz[:, 2:]


def eccentricity():
    """Left: a large circle near the camera, where it can be seen; right: in px for radii and tilts at 1 m."""
    figure = new_figure(8.4, 3.2)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.15])
    centre, shape, true = (a[0] for a in images_of(np.array([150.0]), 400.0, 60.0))
    turn = np.linspace(0, 2 * np.pi, 400)
    rim = centre[:, None] + shape @ np.array([np.cos(turn), np.sin(turn)])
    left.fill(*rim, color=FAINT)
    left.plot(*rim, color=INK, lw=1)
    left.plot(*centre, "+", color=RED, ms=11, mew=2, label="centre of the ellipse: what is measured")
    left.plot(*true, "o", color=BLUE, ms=6, label="image of the circle's centre: what is wanted")
    left.set_aspect("equal")
    left.axis("off")
    left.set_title("radius 150 mm at 400 mm, 60° oblique", fontsize=8.5, color=INK)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02), fontsize=7.5, frameon=False)
    radius = np.linspace(1, 10, 60)
    for tilt, colour, up in zip((20.0, 40.0, 60.0), (GREEN, BLUE, RED), (-6, 3, -4), strict=True):
        offset = np.stack([np.zeros_like(radius), np.zeros_like(radius), np.full_like(radius, 1000.0)], axis=1)
        normal = np.tile([-np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))], (len(radius), 1))
        moved = circle_image_offset(offset, normal, radius)
        apart = FOCAL_PX * np.abs(moved[:, 0] / moved[:, 2])
        right.plot(radius, apart, color=colour)
        right.annotate(
            f"{tilt:.0f}°", (radius[-1], apart[-1]), (3, up), textcoords="offset points", fontsize=7.5, color=colour
        )
    right.axhline(NOISE_PX, color=INK, lw=0.8, ls=":")
    right.annotate("noise of a good centre, 0.01 px", (1, NOISE_PX), (2, 3), textcoords="offset points", fontsize=7.5)
    calm(right)
    right.set(xlabel="radius of the circle, mm", ylabel="eccentricity, px", yscale="log")
    right.set_title("24 mm lens, 18 megapixels, at 1 m", fontsize=8.5, color=INK)
    return figure


def residuals():
    """Residuals and errors of the faces with and without the correction, for circles of several sizes."""
    sizes, rows = (0.5, 0.75, 1.0, 1.5), []
    for size in sizes:
        target, board = reference_target(), reference_board()
        target = replace(target, faces=tuple(replace(face, radius_mm=size * face.radius_mm) for face in target.faces))
        board = replace(board, radius_mm=size * board.radius_mm)
        scene = make_scene(SceneOptions(seed=1), target, board, reference_target().rough_poses())
        plain = [
            m.in_world(Similarity(1.0, Rigid()))
            for m in true_models(scene, observe(scene, NOISE_PX, np.random.default_rng(1)))
        ]
        radius = target.radius_of() | board.radius_of()
        corrected = [replace(m, shift_px=eccentricity_px(m, scene.camera, radius, 1.0)) for m in plain]
        for models, options in ((corrected, RunOptions()), (plain, RunOptions(eccentricity=False))):
            models = [adjust(m, scene.camera) for m in models]
            found = calibrate(models, scene.camera, target, board, options.adjustment(target))
            apart = [
                np.linalg.norm(found.target.target_from_face[face].translation - pose.translation)
                for face, pose in scene.target_from_face.items()
                if face != scene.reference_face
            ]
            left = np.concatenate([m.residuals_px(scene.camera).ravel() for m in models])
            rows.append((float(np.sqrt((left**2).mean())), 1e3 * float(np.sqrt(np.mean(np.square(apart))))))
    values = np.array(rows).reshape(len(sizes), 2, 2)
    for size, ((left, apart), (plain_left, plain_apart)) in zip(sizes, values, strict=True):
        print(
            f"radii × {size:g}: residuals {left:.4f} px, faces {apart:.1f} µm; uncorrected {plain_left:.4f} px, "
            f"{plain_apart:.1f} µm"
        )
    figure = new_figure(8.4, 2.9)
    for axes, k, title in zip(
        figure.subplots(1, 2), (0, 1), ("residuals, px RMS", "error of the faces, µm RMS"), strict=True
    ):
        axes.plot(sizes, values[:, 1, k], "s--", color=RED, label="ellipse centres as they are")
        axes.plot(sizes, values[:, 0, k], "o-", color=BLUE, label="corrected, one adjustment")
        calm(axes)
        axes.set(xlabel="radius over the reference design's", ylim=(0, None))
        axes.set_title(title, fontsize=8.5, color=INK)
    axes.legend(fontsize=7.5, frameon=False)
    return figure


def chain():
    """Faces and the groups that see two of them, each with the board."""
    figure = new_figure(8.4, 2.5)
    axes = figure.subplots()
    place = {"1": (0, 0), "2": (1.6, 0.9), "3": (3.6, 0.9), "4": (1.6, -0.9), "5": (-1.6, 0)}
    for one, two in (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3")):
        (x, y), (u, v) = place[one], place[two]
        axes.plot([x, u], [y, v], color=BLUE, lw=2, zorder=1)
        axes.text(
            (x + u) / 2,
            (y + v) / 2 + (0.16 if y == v else 0.34 if v > y else -0.42),
            f"group {one}{two}",
            ha="center",
            fontsize=8,
            color=BLUE,
        )
    for face, (x, y) in place.items():
        axes.text(
            x,
            y,
            f"face {face}",
            ha="center",
            va="center",
            fontsize=9,
            color="white" if face == "1" else INK,
            bbox={"boxstyle": "round,pad=0.5", "fc": BLUE if face == "1" else "white", "ec": INK},
        )
    axes.annotate(
        "target_from_face 3 = (1 ← 2) · (2 ← 3)",
        (3.6, 0.45),
        (3.6, -0.75),
        ha="center",
        fontsize=8.5,
        color=RED,
        arrowprops={"arrowstyle": "->", "color": RED},
    )
    axes.set(xlim=(-2.4, 5.4), ylim=(-1.4, 1.5))
    axes.axis("off")
    return figure


def imports() -> set[tuple[str, str]]:
    """Pairs of folders (or files) of stcal/, the first of which imports the second."""
    found = set()
    for path in (ROOT / "stcal").rglob("*.py"):
        own = path.relative_to(ROOT / "stcal").parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            names += [a.name for a in node.names] if isinstance(node, ast.Import) else []
            found |= {(own, name.split(".")[1]) for name in names if name.startswith("stcal.")}
    return {(one, two) for one, two in found if one != two}


def folders():
    """Layers from what all rest on, below, to the commands, above; a line for each import between folders."""
    figure = new_figure(8.4, 5.2)
    axes = figure.subplots()
    place = {}
    for level, names in enumerate(LAYERS):
        for k, name in enumerate(names):
            place[name] = (2.0 * (k - (len(names) - 1) / 2), 1.25 * level)
    for one, two in sorted(imports()):
        if one in place and two in place:
            (x, y), (u, v) = place[one], place[two]
            axes.annotate("", (u, v + 0.24), (x, y - 0.24), arrowprops={"arrowstyle": "-", "color": FAINT, "lw": 1})
    for name, (x, y) in place.items():
        axes.text(
            x,
            y,
            name,
            ha="center",
            va="center",
            fontsize=9,
            color=INK,
            bbox={"boxstyle": "round,pad=0.4", "fc": "#e8f1f8" if name == "sfm" else "white", "ec": "#9aa0a8"},
        )
    steps = ("photographs", "detect", "mapping", "adjust", "checks", "report", "faces.json")
    top = 1.25 * len(LAYERS)
    at = [1.55 * (k - (len(steps) - 1) / 2) for k in range(len(steps))]
    for x, name in zip(at, steps, strict=True):
        inside = name not in (steps[0], steps[-1])
        axes.text(
            x,
            top,
            name,
            ha="center",
            va="center",
            fontsize=8.5,
            color=BLUE if inside else INK,
            bbox={
                "boxstyle": "round,pad=0.35",
                "fc": "#e8f1f8" if inside else "white",
                "ec": BLUE if inside else "none",
            },
        )
    for one, two in pairwise(at):
        axes.annotate(
            "",
            (two - 0.55, top),
            (one + (0.72 if one == at[0] else 0.55), top),
            arrowprops={"arrowstyle": "->", "color": BLUE},
        )
    axes.text(0, top + 0.5, "a photograph's way through stcal/sfm", ha="center", fontsize=8.5, color=INK)
    axes.text(
        0,
        -0.75,
        "each imports only what lies below it; the five systems never import each other",
        ha="center",
        fontsize=8.5,
        color=INK,
    )
    axes.set(xlim=(-6.2, 6.2), ylim=(-1.0, top + 0.8))
    axes.axis("off")
    return figure


DRAWINGS: dict[str, Callable] = {d.__name__: d for d in (eccentricity, residuals, chain, folders)}


def main() -> None:
    """Draw those that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(DRAWINGS)}; all if none")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    arguments = parser.parse_args()
    mpl.rcParams["svg.hashsalt"] = "stcal"
    for name in arguments.names or DRAWINGS:
        path = arguments.out / f"{name}.svg"
        DRAWINGS[name]().savefig(path, bbox_inches="tight", facecolor="white", metadata={"Date": None})
        print(path)


if __name__ == "__main__":
    main()
