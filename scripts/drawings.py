"""The drawings of docs/explanation/, as SVG: each from the package's own formulas, none by hand.

.venv/bin/python scripts/drawings.py [NAME …] [--out FOLDER]

`eccentricity` : a circle seen obliquely, the centre of its ellipse and the image of its own centre, and how far they
are apart; `residuals` : the same simulated labels adjusted with and without the correction, residuals beside errors;
`chain` : groups of photographs that link the faces; `labelling` : how circles get their labels; `folders` : the folders
of the package by what they import, and the way of a photograph through `stcal/sfm`.
"""

import ast
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scripts.runner import ROOT, face_errors, script
from scripts.studies.noise_study import designs
from stcal.design import reference_target
from stcal.geometry.plane import circle_image_offset, circle_images
from stcal.geometry.rigid import Rigid, Similarity
from stcal.report.svg import COLOURS, FAINT, INK, LETTER, Axes, Drawing, arrows, limits, save
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import SceneOptions, make_scene

BLUE, RED, GREEN = COLOURS[:3]
FOCAL_PX = 24 / 36 * 5184
"""Of a 24 mm lens over 5184 px."""
NOISE_PX = 0.01
LAYERS = (
    ("errors", "explain", "cross_validation", "parallel"),
    ("geometry",),
    ("adjust",),
    ("labels", "design", "lookalikes"),
    ("io",),
    ("boards", "report"),
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


def eccentricity() -> Drawing:
    """Left: a large circle near the camera, where it can be seen; right: in px for radii and tilts at 1 m."""
    drawing = Drawing(8.4, 3.2)
    left, right = drawing.panels(2, left=8, right=30, top=22, gap=56)
    centre, shape, true = (a[0] for a in images_of(np.array([150.0]), 400.0, 60.0))
    turn = np.linspace(0, 2 * np.pi, 400)
    rim = (centre[:, None] + shape @ np.array([np.cos(turn), np.sin(turn)])).T
    axes = Axes.equal(drawing, left, rim)
    axes.lines([rim.T], INK, fill=FAINT)
    axes.marks(*centre, "dash", 11, RED)
    axes.marks(*centre, "bar", 11, RED)
    axes.marks(*true, "dot", 6, BLUE)
    drawing.words(((left[0] + left[2]) / 2, 9), "radius 150 mm at 400 mm, 60° oblique", 8.5)
    drawing.key((left[0], left[3] + 8), {"centre of the ellipse: what is measured": ("dot", RED)})
    drawing.key((left[0], left[3] + 20), {"image of the circle's centre: what is wanted": ("dot", BLUE)})
    radius = np.linspace(1, 10, 60)
    axes = Axes(drawing, right, (0.5, 10.2), (5e-4, 0.6), "y")
    axes.frame("radius of the circle, mm", "eccentricity, px", "y")
    for tilt, colour, up in zip((20.0, 40.0, 60.0), (GREEN, BLUE, RED), (5, -4, 3), strict=True):
        offset = np.stack([np.zeros_like(radius), np.zeros_like(radius), np.full_like(radius, 1000.0)], axis=1)
        normal = np.tile([-np.sin(np.radians(tilt)), 0.0, np.cos(np.radians(tilt))], (len(radius), 1))
        moved = circle_image_offset(offset, normal, radius)
        apart = FOCAL_PX * np.abs(moved[:, 0] / moved[:, 2])
        axes.lines([(radius, apart)], colour, 1.5)
        axes.words(radius[-1], apart[-1], f"{tilt:.0f}°", (5, up), anchor="start", colour=colour)
    axes.level(NOISE_PX, dash="1 2")
    axes.words(10, NOISE_PX, "noise of a good centre, 0.01 px", (0, 8), anchor="end")
    drawing.words(((right[0] + right[2]) / 2, 9), "24 mm lens, 18 megapixels, at 1 m", 8.5)
    return drawing


def residuals() -> Drawing:
    """Residuals and errors of the faces with and without the correction, for circles of several sizes."""
    sizes, rows = (0.5, 0.75, 1.0, 1.5), []
    for size in sizes:
        target, board = designs(size)
        scene = make_scene(SceneOptions(seed=1), target, board, reference_target().rough_poses())
        seen = observe(scene, NOISE_PX, np.random.default_rng(1))
        plain = [m.in_world(Similarity(1.0, Rigid())) for m in true_models(scene, seen)]
        radius = target.radius_of() | board.radius_of()
        corrected = [replace(m, shift_px=eccentricity_px(m, scene.camera, radius, 1.0)) for m in plain]
        for models, options in ((corrected, RunOptions()), (plain, RunOptions(eccentricity=False))):
            models = [adjust(m, scene.camera) for m in models]
            found = calibrate(models, scene.camera, target, board, options.adjustment(target))
            off = face_errors(found.target, scene.target_from_face).values()
            apart = [np.linalg.norm(each[3:]) for each in off]
            left = np.concatenate([m.residuals_px(scene.camera).ravel() for m in models])
            rows.append((float(np.sqrt((left**2).mean())), 1e3 * float(np.sqrt(np.mean(np.square(apart))))))
    values = np.array(rows).reshape(len(sizes), 2, 2)
    for size, ((left, apart), (plain_left, plain_apart)) in zip(sizes, values, strict=True):
        plain = f"uncorrected {plain_left:.4f} px, {plain_apart:.1f} µm"
        print(f"radii × {size:g}: residuals {left:.4f} px, faces {apart:.1f} µm; {plain}")
    drawing = Drawing(8.4, 2.9)
    titles = "residuals, px RMS", "error of the faces, µm RMS"
    for k, (box, title) in enumerate(zip(drawing.panels(2, top=36), titles, strict=True)):
        axes = Axes(drawing, box, limits(sizes), limits(values[..., k].ravel(), low=0))
        axes.frame("radius over the reference design's", "")
        for own, kind, colour in ((values[:, 1, k], "square", RED), (values[:, 0, k], "dot", BLUE)):
            axes.lines([(sizes, own)], colour, 1.5)
            axes.marks(sizes, own, kind, 5, colour)
        drawing.words(((box[0] + box[2]) / 2, 27), title, 8.5)
    drawing.key((46, 9), {"ellipse centres as they are": ("square", RED), "corrected, one adjustment": ("dot", BLUE)})
    return drawing


def boxed(drawing: Drawing, at, text: str, fill: str = "#ffffff", edge: str = INK, ink: str = INK) -> None:
    """Words in a box."""
    half = np.array([9 + LETTER * 4.5 * len(text), 11.0])
    corners = np.array(at) + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    drawing.lines([corners], edge, 1, fill)
    drawing.words(at, text, 9, colour=ink)


def chain() -> Drawing:
    """Faces and the groups that see two of them, each with the board."""
    drawing = Drawing(8.4, 2.5)
    axes = Axes(drawing, (0, 0, drawing.width, drawing.height), (-2.4, 5.4), (-1.5, 1.5))
    place = {"1": (0, 0), "2": (1.6, 0.9), "3": (3.6, 0.9), "4": (1.6, -0.9), "5": (-1.6, 0)}
    for one, two in (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3")):
        (x, y), (u, v) = place[one], place[two]
        axes.lines([((x, u), (y, v))], BLUE, 2)
        up = 0.2 if y == v else 0.34 if v > y else -0.34
        axes.words((x + u) / 2, (y + v) / 2 + up, f"group {one}{two}", size=8, colour=BLUE)
    for face, (x, y) in place.items():
        own = (BLUE, INK, "#ffffff") if face == "1" else ()
        boxed(drawing, axes.at(x, y)[0], f"face {face}", *own)
    axes.words(3.6, -0.75, "target_from_face 3 = (1 ← 2) · (2 ← 3)", size=8.5, colour=RED)
    axes.arrows(np.array([[3.6, -0.6]]), np.array([[0, 1.2]]), 1.2, RED)
    return drawing


def labelling() -> Drawing:
    """The four steps of ``stcal.sfm.detect.labelling``: what each decides, and what it leaves out with a note."""
    steps = {
        "one image": (("what each pattern", "may be"), ("a pattern seen twice:", "one is a reflection")),
        "its group": (("one arrangement", "of faces and board"), ("no reading fits it,", "or several do")),
        "all groups": (("one arrangement", "of the faces"), ("a face elsewhere than", "in most groups")),
        "second look": (("circles that must be", "in view are measured"), ("hidden, or of another", "size or place")),
    }
    drawing = Drawing(8.4, 2.4)
    axes = Axes(drawing, (0, 0, drawing.width, drawing.height), (-2.2, 2.2), (-2.2, 1.1))
    at = axes.at(1.12 * (np.arange(len(steps)) - 1.5), 0.7)
    for where, (name, (decided, left_out)) in zip(at, steps.items(), strict=True):
        boxed(drawing, where, name, "#e8f1f8", BLUE, BLUE)
        for lines, under, colour in ((decided, 34, INK), (left_out, 96, RED)):
            for k, line in enumerate(lines):
                drawing.words((where[0], where[1] + under + 13 * k), line, 8.5, colour=colour)
    beside, below, down = np.array([48.0, 0.0]), np.array([0.0, 54.0]), np.tile([0.0, 28.0], (len(at), 1))
    drawing.lines(arrows(at[:-1] + beside, at[1:] - at[:-1] - 2 * beside, 1.2), fill=BLUE)
    drawing.lines(arrows(at + below, down, 1.2), fill=RED)
    axes.words(0, -1.85, "red: left out, with a note; what stays has one label in all photographs", size=8.5)
    return drawing


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


def folders() -> Drawing:
    """Layers from what all rest on, below, to the commands, above; a line for each import between folders."""
    drawing = Drawing(8.4, 6.8)
    top = 1.25 * len(LAYERS)
    axes = Axes(drawing, (0, 0, drawing.width, drawing.height), (-6.2, 6.2), (-1.0, top + 0.8))
    place = {
        name: axes.at(2.0 * (k - (len(names) - 1) / 2), 1.25 * level)[0]
        for level, names in enumerate(LAYERS)
        for k, name in enumerate(names)
    }
    known = [(one, two) for one, two in sorted(imports()) if one in place and two in place]
    drawing.lines([np.array([place[one] - [0, 11], place[two] + [0, 11]]) for one, two in known], FAINT)
    for name, at in place.items():
        boxed(drawing, at, name, "#e8f1f8" if name == "sfm" else "#ffffff", "#9aa0a8")
    steps = ("photographs", "detect", "mapping", "adjust", "checks", "report", "faces.json")
    at = axes.at(1.55 * (np.arange(len(steps)) - (len(steps) - 1) / 2), top)
    for where, name in zip(at, steps, strict=True):
        boxed(drawing, where, name, *(() if name in (steps[0], steps[-1]) else ("#e8f1f8", BLUE, BLUE)))
    ends = [np.array([9 + LETTER * 4.5 * len(name), 0]) for name in steps]
    starts = at[:-1] + ends[:-1]
    drawing.lines(arrows(starts, at[1:] - ends[1:] - starts, 1.2), fill=BLUE)
    axes.words(0, top + 0.55, "a photograph's way through stcal/sfm", size=8.5)
    said = "each imports only what lies below it; the five systems never import each other"
    axes.words(0, -0.75, said, size=8.5)
    return drawing


DRAWINGS: dict[str, Callable] = {d.__name__: d for d in (eccentricity, residuals, chain, labelling, folders)}


@script({"names": list(DRAWINGS)}, out=ROOT / "docs" / "pictures")
def main(arguments) -> None:
    for name in arguments.names:
        path = arguments.out / f"{name}.svg"
        save(DRAWINGS[name](), path)
        print(path)
