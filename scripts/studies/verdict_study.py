"""Planted causes at three strengths on three sets: does the first sentence of the answer name them, is an error silent?

    .venv/bin/python scripts/studies/verdict_study.py [--only WORD] [--sets NAMES] [--sound DRAWS]

Sets: the sample and `../shared/data/stereo_target/white_block` with the circles that were found in their photographs,
and a simulated one of three faces with noise of 0.02 px. What is planted changes centres, camera file or designs, and
mapping begins at the true geometry. `named`: of the runs that are not "Yes", the share whose first sentence (cause of
the whole set, or first of the failed or suspicious checks) names the planted cause. `yes`: runs that answer "Yes", and
the largest error of their faces, √(eᵀC⁻¹e/6). `silent`: "Yes" with an error over 4 σ. A run that loses a
group is not "Yes"; an error names a cause only by what it says as the likely cause. Sound sets: exact
centres of the same sets with new noise of the σ of each centre.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from scripts.runner import DATA, SAMPLE, executor_of, face_errors, normalised, script
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset
from stcal.geometry.rigid import Rigid, Similarity, align_rigid
from stcal.io.cameras.read import read_camera
from stcal.io.images import find_images
from stcal.labels import CircleLabel, DotLabel
from stcal.parallel import one_thread
from stcal.report.text import text_table
from stcal.sfm.adjust.calibration import AdjustOptions, calibrate
from stcal.sfm.adjust.refine import Refined
from stcal.sfm.checks.significance import MOST_SIGMAS, Evidence
from stcal.sfm.checks.suite import run_checks
from stcal.sfm.data.group_model import ImageObservations, WorldModel
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import detect_files
from stcal.sfm.detect.labelling import label_images
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.report.check import CAUSE, ranked
from stcal.sfm.runs.stages import LIKELY, explained, refine_or_explain, wrong_file
from stcal.synthetic.designs import second_design
from stcal.synthetic.scene import Group, Scene, SceneOptions, image_circles, make_scene
from tests.support.areas import circle_conic, ellipse_of_conic
from tests.support.degrade import read_set

NOISE_PX = 0.02
SILENT_SIGMA = 4.0


@dataclass(frozen=True)
class Case:
    """What a run is given; ``scene`` : the truth."""

    scene: Scene
    images: list[ImageObservations]
    camera: Camera
    target: TargetDesign
    board: BoardDesign

    def file(self, **change) -> "Case":
        """The case with another camera file."""
        values = {key: getattr(self.camera, key) for key in ("width", "height", "focal", "centre", "distortion")}
        camera = Camera(**values | change)
        return replace(self, camera=Camera.of(camera, "FULL_OPENCV"))

    def centres(self, change: Callable[[ImageObservations, int], np.ndarray]) -> "Case":
        """The case with other centres, px, made from each image and its number."""
        return replace(self, images=[_moved(i, change(i, k), self.scene.camera) for k, i in enumerate(self.images)])

    @property
    def last(self) -> str:
        """Group that changes where one group alone does."""
        return list(self.scene.groups)[-1]


def _moved(image: ImageObservations, centre_px: np.ndarray, camera: Camera) -> ImageObservations:
    return replace(image, centre_px=centre_px, centre=camera.normalised_from_pixel(centre_px))


# ---------------------------------------------------------------- sets


def photographed(folder: Path) -> Case:
    """A rendered set with the circles found in its photographs."""
    data = read_set(folder)
    groups = {}
    for name, truth in data.truth["groups"].items():
        poses = tuple(Rigid.from_matrix(image["camera_from_target"]) for image in truth["images"].values())
        dots = np.array(truth["board_circles_target"])
        target_from_board = align_rigid(dots, np.pad(data.board.xy_mm(), ((0, 0), (0, 1))))
        groups[name] = Group(name, (), np.eye(3), target_from_board, dots, poses)
    frames = {face: Rigid.from_matrix(m) for face, m in data.truth["target_from_face"].items()}
    circles = {CircleLabel(*label.split(":")): np.array(xyz) for label, xyz in data.truth["circles"].items()}
    camera = Camera.of(data.camera, "FULL_OPENCV")
    scene = Scene(data.target, data.board, camera, frames, circles, groups, 0)
    with tempfile.TemporaryDirectory() as scratch:
        designs, options = (data.target, data.board), EllipseOptions()
        file = read_camera(folder / "cameras.txt")
        found = detect_files(find_images(folder / "images")[0], file, *designs, options, Path(scratch), 1)
        labelled = [each.observations for each in label_images(found, *designs, options, Path(scratch), 1)]
    names = {name.rpartition(".")[0]: k for g in data.truth["groups"].values() for k, name in enumerate(g["images"])}
    images = [replace(i, name=f"{i.group}/{names[i.name.rpartition('.')[0]]:04d}") for i in labelled]
    return Case(scene, _seen_twice(_numbered(scene, images)), camera, data.target, data.board)


def number(image: ImageObservations) -> int:
    """Of an image in its group."""
    return int(image.name.rpartition("/")[2])


def _seen_twice(images: list[ImageObservations]) -> list[ImageObservations]:
    """The images without circles that one image of their group alone shows, as mapping would leave them out."""
    count = Counter((image.group, label) for image in images for label in image.labels)
    return [i.select([k for k, label in enumerate(i.labels) if count[i.group, label] > 1]) for i in images]


def _numbered(scene: Scene, images: list[ImageObservations]) -> list[ImageObservations]:
    """The images with the true numbers of the board's dots, which are known up to its symmetry."""

    def off_px(image: ImageObservations) -> float:
        group = scene.groups[image.group]
        place = dict(zip(scene.board.labels(), group.board_circles_target, strict=True))
        dots = np.flatnonzero(~on_face(image))
        xyz = group.camera_from_target[number(image)] @ np.array([place[image.labels[k]] for k in dots])
        return float(np.linalg.norm(scene.camera.project(xyz) - image.centre_px[dots], axis=1).sum())

    numbered = []
    for name in scene.groups:
        own = [image for image in images if image.group == name]
        turned = [replace(i, labels=tuple(_turned(x, scene.board) for x in i.labels)) for i in own]
        numbered += min(own, turned, key=lambda tried: sum(map(off_px, tried)))
    return numbered


def _turned(label, board: BoardDesign):
    if not isinstance(label, DotLabel):
        return label
    return DotLabel(board.rows - 1 - label.row, board.columns - 1 - label.column)


def simulated(seed: int = 7) -> Case:
    """A set of another target and board, four images in each of three groups, without photographs."""
    options = SceneOptions(seed=seed, width=2400, height=1600, images_per_group=4)
    scene = make_scene(options, *second_design())
    camera = Camera.of(scene.camera, "FULL_OPENCV")
    images = observe(scene, NOISE_PX, np.random.default_rng(seed))
    case = Case(scene, images, camera, scene.target, scene.board)
    return replace(case, images=[shaped(case, i) for i in images])


def shaped(case: Case, image: ImageObservations) -> ImageObservations:
    """The image with the true shapes of its ellipses."""
    conics = map(circle_conic, *_seen(case, image))
    return replace(image, shape=np.array([ellipse_of_conic(conic)[1] for conic in conics]))


def drawn(case: Case, seed: int) -> Case:
    """The set with exact centres and new noise of the σ of each centre."""
    rng = np.random.default_rng(seed)

    def change(image: ImageObservations, _: int) -> np.ndarray:
        xyz, normal, radius = _seen(case, image)
        exact = case.scene.camera.project(circle_image_offset(xyz, normal, radius))
        noise = np.linalg.cholesky(image.covariance_px2) @ rng.standard_normal((len(exact), 2, 1))
        return exact + noise[..., 0]

    return case.centres(change)


def _seen(case: Case, image: ImageObservations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, normals and radii of the true circles of an image, camera frame."""
    circles = image_circles(case.scene, image.group, number(image))
    place = {label: k for k, label in enumerate(circles.labels)}
    own = [place[label] for label in image.labels]
    return circles.xyz_camera[own], circles.normal_camera[own], circles.radius_mm[own]


# ---------------------------------------------------------------- causes


def on_face(image: ImageObservations) -> np.ndarray:
    return np.array([isinstance(label, CircleLabel) for label in image.labels])


def through(case: Case, distortion: np.ndarray) -> Case:
    """The photographs as a lens of another distortion takes them."""
    own = case.scene.camera
    other = Camera(own.width, own.height, own.focal, own.centre, distortion)
    return case.centres(lambda image, _: other.pixel_from_normalised(own.normalised_from_pixel(image.centre_px)))


LENS = np.array([-0.12, 0.06, 4e-4, -3e-4, 0, 0, 0, 0, 0, 0, 0, 0])


def lens(strength: float, taken: float, stated: float) -> Callable[[Case, float], Case]:
    """A lens of some distortion: ``taken`` of it is in the photographs, ``stated`` in the camera file."""
    return lambda case, value: through(case, strength * taken * value * LENS).file(distortion=stated * value * LENS)


def zoomed(by: Callable[[Case, ImageObservations, int], float]) -> Callable[[Case, float], Case]:
    def plant(case: Case, value: float) -> Case:
        middle = case.scene.camera.centre
        return case.centres(lambda image, k: middle + (1 + value * by(case, image, k)) * (image.centre_px - middle))

    return plant


def spread(k: int, n: int = 2) -> np.ndarray:
    return np.random.default_rng([5, k]).normal(size=n)


def moved(which: Callable[[Case, ImageObservations, int], bool], faces: Callable[[str], bool] = lambda _: True):
    """The target, or some of its faces, stands elsewhere (mm) against the board in some images."""

    def plant(case: Case, value: float) -> Case:
        def shift(image: ImageObservations, k: int) -> np.ndarray:
            hit = [which(case, image, k) and isinstance(x, CircleLabel) and faces(x.face) for x in image.labels]
            return np.outer(hit, value * np.array([0.6, -0.5, 0.62]))

        return shifted_points(case, shift)

    return plant


def shifted_points(case: Case, shift_mm: Callable[[ImageObservations, int], np.ndarray]) -> Case:
    """Circles (n,) that stand elsewhere, by (n, 3) mm in the frame of the target."""

    def change(image: ImageObservations, k: int) -> np.ndarray:
        xyz, normal, radius = _seen(case, image)
        pose = case.scene.groups[image.group].camera_from_target[number(image)]
        shift = shift_mm(image, k) @ pose.rotation.T
        before, after = (circle_image_offset(at, normal, radius) for at in (xyz, xyz + shift))
        return image.centre_px + case.scene.camera.project(after) - case.scene.camera.project(before)

    return case.centres(change)


def board_shifted(at: Callable[[np.ndarray, BoardDesign], np.ndarray]) -> Callable[[Case, float], Case]:
    """Dots of the board off their places: ``at`` gives (n, 3) of unit size, board frame, from (n, 2) cells, −1 to 1."""

    def plant(case: Case, value: float) -> Case:
        def shift(image: ImageObservations, _: int) -> np.ndarray:
            dots = case.scene.groups[image.group].board_circles_target.reshape(case.board.rows, case.board.columns, 3)
            axes = np.array([dots[0, -1] - dots[0, 0], dots[-1, 0] - dots[0, 0]])
            axes = axes / np.linalg.norm(axes, axis=1)[:, None]
            axes = np.vstack([axes, np.cross(*axes)])
            out = np.zeros((len(image.labels), 3))
            for k, label in enumerate(image.labels):
                if isinstance(label, DotLabel):
                    most = np.array([case.board.columns, case.board.rows]) - 1
                    cell = 2 * np.array([label.column, label.row]) / most - 1
                    out[k] = value * at(cell, case.board) @ axes
            return out

        return shifted_points(case, shift)

    return plant


def rolling(case: Case, value: float) -> Case:
    height = case.camera.height
    return case.centres(lambda i, k: i.centre_px + value * spread(k) * (i.centre_px[:, 1:] / height - 0.5))


def exchanged(case: Case, value: float) -> Case:
    """Exchanged labels of ``value`` pairs of circles of a face in one image."""

    def change(image: ImageObservations, k: int) -> np.ndarray:
        centre = image.centre_px.copy()
        own = np.flatnonzero(on_face(image))
        for pair in range(int(value) if k == 1 else 0):
            centre[own[[2 * pair, 2 * pair + 1]]] = centre[own[[2 * pair + 1, 2 * pair]]]
        return centre

    return case.centres(change)


def noisy(case: Case, value: float) -> Case:
    """One image whose centres have ``value`` times the noise that they state."""

    def change(image: ImageObservations, k: int) -> np.ndarray:
        noise = np.random.default_rng(3).normal(size=image.centre_px.shape) * image.sigma_px()[:, None]
        return image.centre_px + (value * noise if k == 4 else 0)

    return case.centres(change)


def radii(which: Callable[[Case, CircleLabel | DotLabel], bool]) -> Callable[[Case, float], Case]:
    """Circles of other radii than their design, seen from the same places."""

    def plant(case: Case, value: float) -> Case:
        factors = [np.array([1 + value * which(case, x) for x in i.labels]) for i in case.images]
        pairs = zip(case.images, factors, strict=True)
        return replace(case, images=[replace(i, shape=i.shape * own[:, None, None]) for i, own in pairs])

    return plant


def behind_rims(case: Case, value: float) -> Case:
    """Discs of the faces behind a rim of ``value`` mm: half of it higher, and narrower by h tan τ/π."""
    normals = {face: pose.rotation[:, 2] for face, pose in case.scene.target_from_face.items()}
    normals["board"] = np.zeros(3)
    raised = shifted_points(case, lambda i, _: value / 2 * np.array([normals[x.plane] for x in i.labels]))
    images = []
    for image in raised.images:
        xyz, normal, radius = _seen(case, image)
        cosine = np.abs((xyz * normal).sum(1)) / np.linalg.norm(xyz, axis=1)
        lost = value * np.sqrt(1 / cosine**2 - 1) / np.pi / radius * on_face(image)
        images.append(replace(image, shape=image.shape * (1 - lost)[:, None, None]))
    return replace(raised, images=images)


def centroids(case: Case, value: float) -> Case:
    """Centres without a share of the eccentricity, as of the images of the circles' centres."""

    def change(image: ImageObservations, _: int) -> np.ndarray:
        xyz, normal, radius = _seen(case, image)
        project = case.scene.camera.project
        return image.centre_px - value * (project(circle_image_offset(xyz, normal, radius)) - project(xyz))

    return case.centres(change)


def pitch(sign: int) -> Callable[[Case, float], Case]:
    return lambda c, v: replace(c, board=replace(c.board, pitch_mm=c.board.pitch_mm * (1 + sign * v)))


def half_a_group(case: Case, image: ImageObservations, k: int) -> bool:
    own = [i.name for i in case.images if i.group == case.last]
    return image.name in own[len(own) // 2 :]


def first_circle(case: Case) -> CircleLabel:
    return case.target.faces[0].labels()[3]


def lifted_circle(case: Case, value: float) -> Case:
    label, normal = first_circle(case), case.scene.target_from_face[first_circle(case).face].rotation[:, 2]
    return shifted_points(case, lambda i, _: np.array([value * normal * (x == label) for x in i.labels]))


def turned_by_180(case: Case, value: float) -> Case:
    """A camera whose principal point is ``value`` px off the middle, its photographs turned."""
    middle = (np.array([case.camera.width, case.camera.height]) - 1) / 2
    by = middle + np.array([value / 2, -value / 3]) - case.camera.centre
    own = case.centres(lambda i, _: i.centre_px + by)  # as the lens would have them behind a shifted sensor
    at = 2 * middle - (case.camera.centre + by)
    return own.file(centre=at)


def seen_in_last(case: Case) -> str:
    """A face of the last group that other groups show, too."""
    elsewhere = {face for image in case.images if image.group != case.last for face in image.face_ids()}
    own = [face for image in case.images if image.group == case.last for face in image.face_ids() if face in elsewhere]
    return max(set(own), key=own.count)


Plant = Callable[[Case, float], Case]
MUCH, TENTHS, MOVES = (0.001, 0.004, 0.02), (0.1, 0.3, 1), (0.05, 0.2, 1)
FOCAL, RADII, BOTH = (0.002, 0.005, 0.02), (0.03, 0.08, 0.2), "board; board-lines"
CAUSES: dict[str, tuple[tuple[float, float, float], Plant, str]] = {
    "focal length long": (FOCAL, lambda c, v: c.file(focal=c.camera.focal * (1 + v)), "the focal length"),
    "focal length short": (FOCAL, lambda c, v: c.file(focal=c.camera.focal * (1 - v)), "the focal length"),
    "fx over fy": (MUCH, lambda c, v: c.file(focal=c.camera.focal * [1 + v, 1]), "width and height"),
    "cropped": (
        (5, 20, 80),
        lambda c, v: c.file(centre=c.camera.centre + np.array([v, -0.6 * v])),
        "the principal point; turned by 180°",
    ),
    "another camera": (
        (0.3, 1, 3),
        lambda c, v: c.file(
            focal=c.camera.focal * [1 + 0.01 * v, 1 + 0.007 * v],
            centre=c.camera.centre + np.array([9 * v, 5 * v]),
            distortion=c.camera.distortion + 0.02 * v * np.eye(12)[0],
        ),
        "the intrinsics; the focal length; scaled; the principal point; width and height",
    ),
    "distortion": (
        (0.02, 0.1, 0.5),
        lambda c, v: through(c, LENS).file(distortion=LENS * (1 - v)),
        "the distortion; undistorted",
    ),
    "no distortion in the file": (TENTHS, lens(1, 1, 0), "the distortion"),
    "distortion negated": (TENTHS, lens(1, 1, -1), "negated; reversed"),
    "already undistorted": (TENTHS, lens(1, 0, 1), "already undistorted"),
    "scaled": (
        FOCAL,
        lambda c, v: c.centres(lambda i, _: (1 + v) * (i.centre_px + 0.5) - 0.5),
        "photographs are scaled; the focal length",
    ),
    "turned by 180°": ((6, 20, 60), turned_by_180, "turned by 180°; the principal point"),
    "zoom by group": (MUCH, zoomed(lambda c, i, _: list(c.scene.groups).index(i.group) - 1), "between the groups"),
    "autofocus": (MUCH, zoomed(lambda c, i, k: spread(k, 1)[0]), "from image to image"),
    "rolling shutter": ((0.5, 2, 6), rolling, "rolling shutter"),
    "pitch long": (MUCH, pitch(1), "pitch"),
    "pitch short": (MUCH, pitch(-1), "pitch"),
    "board stretched": (
        (3e-4, 1e-3, 5e-3),
        board_shifted(lambda c, b: np.array([c[0], 0, 0]) * b.pitch_mm * (b.columns - 1) / 2),
        f"{BOTH}; stretched",
    ),
    "board bent": (MOVES, board_shifted(lambda c, b: np.array([0, 0, c @ c])), "board; bent"),
    "column of dots off": (MOVES, board_shifted(lambda c, b: np.array([c[0] > 0.99, 0, 0])), BOTH),
    "radii of the board": (RADII, radii(lambda c, x: isinstance(x, DotLabel)), "radius-design"),
    "radii of the target": (RADII, radii(lambda c, x: isinstance(x, CircleLabel)), "radius-design"),
    "radius of one circle": (RADII, radii(lambda c, x: x == first_circle(c)), "radius"),
    "circle out of plane": ((0.2, 0.5, 2), lifted_circle, "flatness"),
    "rim": ((0.05, 0.15, 0.4), behind_rims, "rim"),
    "centroids": ((0.3, 0.6, 1), centroids, "control; eccentricity"),
    "target moved, one image": (MOVES, moved(lambda c, i, k: k == 2), "moved"),
    "target moved, half a group": (MOVES, moved(half_a_group), "moved"),
    "a face moved, one group": (
        MOVES,
        lambda c, v: moved(lambda c, i, _: i.group == c.last, lambda f: f == seen_in_last(c))(c, v),
        "groups; loops; agreement",
    ),
    "one image of another focus": (
        FOCAL,
        zoomed(lambda c, i, k: k == 2),
        "moved; image-residuals; image of another focus",
    ),
    "one noisy image": ((4, 8, 20), noisy, "image-residuals"),
    "labels exchanged": ((1, 2, 3), exchanged, "labels"),
}
"""By name: strengths, what is planted, and keys of checks or words of causes that name it."""


# ---------------------------------------------------------------- runs


def refined_groups(case: Case, starts: list[WorldModel]) -> tuple[list[Refined], list[StcalError]]:
    """The groups that can be solved, and why others cannot; as in a run, these are left out whole."""
    refined, errors = [], []
    for model in starts:
        try:
            refined.append(refine_or_explain(model, case.camera, case.target, case.board))
        except StcalError as error:
            errors.append(error)
    if not refined:
        raise errors[0]
    return refined, errors


def answer(case: Case) -> dict:
    """Verdict, the check that the first sentence names, and the largest error of a face in σ."""
    try:
        world = Similarity(1, Rigid.exp([0.3, -0.2, 0.5, 40, -30, 900]))
        starts = [model.in_world(world) for model in true_models(case.scene, case.images)]
        with explained(case.images, case.camera, case.board):
            refined, lost = refined_groups(case, starts)
        options = AdjustOptions(case.target.faces[0].id, "joint")
        models = tuple(each.model for each in refined)
        calibration = calibrate(models, case.camera, case.target, case.board, options)
        outliers = tuple(o for each in refined for o in each.outliers)
        evidence = Evidence(
            models, outliers, tuple(case.images), case.camera, case.target, case.board, options, calibration, None, {}
        )
        if lost or calibration.sigma_factors.all > MOST_SIGMAS:
            evidence = replace(evidence, cause=wrong_file(case.images, case.camera, case.board))
        checks = run_checks(evidence)
    except StcalError as error:
        return {"verdict": "error", "first": _named_by(error), "sigma": 0.0, "bad": []}
    first = ranked(checks, frozenset(image.name for image in case.images))[0]
    verdict = {"failed": "no", "suspicious": "care"}.get(first.verdict, "care" if lost else "yes")
    words = f"{first.key}: {first.title}" if first.verdict in ("failed", "suspicious") else ""
    bad = [check.key for check in checks if check.verdict in ("failed", "suspicious")]
    if lost and not words:
        words = _named_by(lost[0])
    return {"verdict": verdict, "first": words, "sigma": worst_sigma(case, calibration.target), "bad": bad}


def _named_by(error: StcalError) -> str:
    """What an error says as the cause, its symptom if it says none."""
    symptom, _, cause = str(error).partition(LIKELY)
    return f"{CAUSE}: {cause.partition(' (')[0].partition(', as ')[0]}" if cause else symptom


def worst_sigma(case: Case, target) -> float:
    """√(eᵀC⁻¹e/6), the largest of all faces."""
    return float(np.sqrt(normalised(target, face_errors(target, case.scene.target_from_face)).max(initial=0.0)))


def names_it(first: str, words: str) -> bool:
    """Whether a first sentence names a planted cause: by the key of a check, or by words of a whole set's cause."""
    key, _, title = first.partition(": ")
    return key in words.split("; ") or (key == CAUSE and any(word in title for word in words.split("; ")))


@cache
def case_of(name: str) -> Case:
    """The set of this name; detection takes seconds, once in each process."""
    if name == "own":
        return simulated()
    return photographed({"sample": SAMPLE, "block": DATA / "stereo_target" / "white_block"}[name])


@one_thread()
def planted(cause: str, where: str) -> list[dict]:
    """The answers to a cause at all strengths in one set."""
    strengths, plant, words = CAUSES[cause]
    runs = []
    for value in strengths:
        found = answer(plant(case_of(where), value))
        runs.append(found | {"named": names_it(found["first"], words)})
    return runs


@one_thread()
def sound(where: str, seed: int) -> dict:
    """The answer to a sound draw of a set."""
    return answer(drawn(case_of(where), seed))


def counts(runs: list[dict]) -> tuple[int, list[dict], list[dict], int]:
    """Number of runs that name the cause, those that are not Yes, those that are, and number of silent ones."""
    asked, quiet = ([r for r in runs if (r["verdict"] == "yes") == yes] for yes in (False, True))
    return sum(r["named"] for r in asked), asked, quiet, sum(r["sigma"] > SILENT_SIGMA for r in quiet)


@script(only="", sets="sample,block,own", sound=40)
def main(given) -> None:
    sets = given.sets.split(",")
    causes = [name for name in CAUSES if given.only in name]
    draws = [(where, seed) for where in sets for seed in range(given.sound)]
    with executor_of() as pool:
        answers = pool.map(planted, *zip(*[(name, where) for name in causes for where in sets], strict=True))
        runs = {name: [run for _ in sets for run in next(answers)] for name in causes}
        drawn_sound = list(pool.map(sound, *zip(*draws, strict=True))) if draws else []
    rows = []
    for name, own in runs.items():
        named, asked, quiet, silent = counts(own)
        others = sorted({r["first"].partition(": ")[2] for r in asked if not r["named"]})
        worst = f" ({max(r['sigma'] for r in quiet):.1f} σ)" if quiet else ""
        cells = f"{named}/{len(asked)}", f"{len(quiet)}{worst}", str(silent)
        rows.append([name, *cells, "; ".join(text[:60] for text in others)])
    print("\n".join(text_table([["<planted cause", "named", "yes", "silent", "<named instead"], *rows])))
    every = [run for own in runs.values() for run in own]
    named, asked, _, silent = counts(every)
    print(f"named: {named} of {len(asked)} runs that are not Yes, {100 * named / max(len(asked), 1):.0f} %")
    print(f"silent: {silent} of {len(every)} runs")
    wrong = [r for r in drawn_sound if r["verdict"] != "yes"]
    listed = ", ".join(sorted({key for r in wrong for key in r["bad"]}))
    share = f"{100 * len(wrong) / max(len(draws), 1):.1f} %{': ' * bool(listed)}{listed}"
    print(f"sound sets: {len(wrong)} of {len(draws)} answered No or With care, {share}")
