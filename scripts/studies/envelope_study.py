"""Where the program's envelope ends: rendered sets degraded as photographs are, at five strengths of each kind.

.venv/bin/python scripts/studies/envelope_study.py [--sets FOLDER …] [--only KIND] [--strengths 1 3 5]

Where circles, faces and board lie in the photographs is taken from ``truth.json`` alone. Each degraded set is run, one
after another.

recall: circles found of those that must be found; what the degradation hides, cuts or mirrors must not. wrong: labels
farther than 1.5 px, or a quarter of the circle's radius, from the place of that circle's ellipse, or of circles that
are not in view. The board's numbers count up to its symmetry. Rolling shutter, rotation, mirroring and scale move the
true places with the pixels; the kernel of a motion is centred and moves nothing; halves of circles that are darker
leave the rims where they are, so that a shift is the program's own. µm, σ: the face that is farthest off, and
√(eᵀC⁻¹e/6), the largest of all faces, against the truth in the run's own reference face. silent: over 4 σ and no
check failed.
"""

import csv
import itertools
import re
import tempfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scripts.runner import SAMPLE, face_errors, normalised, script
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.read import save_camera
from stcal.labels import BOARD
from stcal.sfm.pipeline import run
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.saved import RunResult
from tests.support import degrade
from tests.support.degrade import Photograph, Plane, RenderedSet, read_set

NEAR_PX, NEAR_RADII = 1.5, 0.25
SILENT_SIGMA = 4.0
Place = Callable[[np.ndarray], np.ndarray]
Make = Callable[[Photograph, Any, "Case"], "Picture"]


@dataclass
class Picture:
    """A degraded photograph. ``pixels`` : grey values, or a JPEG file; ``hidden`` : labels no longer in view;
    ``waived`` : labels that may be found, and need not; ``place`` : where points of the photograph went."""

    pixels: np.ndarray | bytes
    hidden: set[str] = field(default_factory=set)
    waived: set[str] = field(default_factory=set)
    place: Place | None = None
    bits: int = 8
    mirrored: bool = False


@dataclass
class Case:
    """One kind at one strength on one set; ``shared`` keeps what its photographs have in common."""

    data: RenderedSet
    kind: str
    value: float
    shared: dict = field(default_factory=dict)

    def seed(self, *words) -> int:
        """Of random numbers: the same in every run."""
        return zlib.crc32(" ".join(map(str, (self.kind, self.data.folder.name, *words))).encode())

    def rng(self, *words) -> np.random.Generator:
        return np.random.default_rng(self.seed(*words))


@dataclass(frozen=True)
class Kind:
    """``unit`` : of ``values``; ``make`` : degrades a photograph; ``goal`` : number of strengths within the goals;
    ``camera`` : that of the degraded set; ``may_end`` : strengths at which no result can be wanted."""

    name: str
    unit: str
    values: tuple
    make: Make
    goal: int = 5
    camera: Callable[[Case], Camera] | None = None
    may_end: tuple[int, ...] = ()


def simple(function: Callable[..., np.ndarray | bytes], more: Callable | None = None) -> Make:
    """A kind that takes pixels, strength, and perhaps what ``more`` gives for a photograph."""
    return lambda photo, value, case: Picture(function(photo.grey, value, *([more(photo, case)] if more else [])))


def of_photo(function: Callable[[Photograph, float], np.ndarray]) -> Make:
    return lambda photo, value, case: Picture(function(photo, value))


def seeded(photo: Photograph, case: Case) -> int:
    return case.seed(photo.name)


def on_sensor(_: Photograph, case: Case) -> int:
    """The same places in all photographs."""
    return case.seed()


def angle(most: float) -> Callable[[Photograph, Case], float]:
    return lambda photo, case: case.rng(photo.name).uniform(0, most)


# ---------------------------------------------------------------- kinds


def dim_face(photo: Photograph, value: float, case: Case) -> Picture:
    """The face that most photographs need."""
    if "face" not in case.shared:
        wanted = [label.partition(":")[0] for p in case.data.photographs for label, must in p.must_find.items() if must]
        case.shared["face"] = max((face.id for face in case.data.target.faces), key=wanted.count)
    image = photo.grey.astype(np.float32)
    for face in photo.faces:
        if face.name == case.shared["face"]:
            image = degrade.brightened(image, photo.face_region(face), value)
    return Picture(image)


def bright_board(photo: Photograph, value: float, case: Case) -> Picture:
    """The exposure is such that the board does not clip: the target gets darker instead."""
    share = photo.face_region(photo.board)
    brightest = float(np.percentile(photo.grey[share > 0.5], 99)) * value
    image = degrade.brightened(photo.grey, share, value)
    return Picture(image * min(1.0, 250 / brightest))


def glare(photo: Photograph, value: float, case: Case) -> Picture:
    rng = case.rng(photo.name)
    places = []
    for plane in photo.planes:
        outline = photo.outline_px(plane, 0.0)
        corners = outline[rng.integers(len(outline), size=(3, 3))]
        places += list((rng.dirichlet([1, 1, 1], 3)[..., None] * corners).sum(1))
    radius = float(np.median([r for _, r in photo.ellipses().values()]))
    image = degrade.glared(photo.grey, places, 1.5 * radius, value)
    whole, part = degrade.covered_labels(photo, np.minimum(image, 255), 40.0)
    return Picture(image, waived=whole | part)


def chosen(photo: Photograph, case: Case, count: float) -> list[str]:
    """Random circles of every face in view; ``count`` of each, or a share."""
    rng, found = case.rng(photo.name), []
    for face in photo.faces:
        n = int(count) if count >= 1 else int(np.ceil(count * len(face.labels)))
        found += list(rng.permutation(list(face.labels))[:n])
    return found


def hide(photo: Photograph, value: float, case: Case) -> Picture:
    labels = chosen(photo, case, value)
    return Picture(degrade.without_circles(photo, labels), hidden=set(labels))


def cut(photo: Photograph, value: float, case: Case) -> Picture:
    """A third of the circles of every face, and a tenth of the board's dots."""
    dots = case.rng(photo.name, "dots").permutation(list(photo.board.labels))[: len(photo.board.labels) // 10]
    labels = [*chosen(photo, case, 0.33), *dots]
    return Picture(degrade.cut_circles(photo, labels, value, case.seed(photo.name)), waived=set(labels))


def cover_board(photo: Photograph, value: float, case: Case) -> Picture:
    image = degrade.board_covered(photo, value, case.seed(photo.name))
    whole, part = degrade.covered_labels(photo, image)
    return Picture(image, hidden=whole, waived=part)


def cover_one_board(photo: Photograph, value: float, case: Case) -> Picture:
    return cover_board(photo, value, case) if photo.number == 0 else Picture(photo.grey)


def rolling(photo: Photograph, value: float, case: Case) -> Picture:
    shift = value * case.rng(photo.name).choice([-1, 1])
    height = photo.grey.shape[0]
    return Picture(degrade.rolling_shutter(photo.grey, shift), place=lambda xy: degrade.rolled(xy, shift, height))


def small_camera(case: Case) -> Camera:
    """The camera with so few pixels that a small circle is ``value`` px across, in the median."""
    camera = case.data.camera
    if "size" not in case.shared:
        smallest = min(case.data.target.radius_of().values())
        small = {str(k) for k, r in case.data.target.radius_of().items() if r <= 1.01 * smallest}
        radii = [r for p in case.data.photographs for k, (_, r) in p.ellipses().items() if k in small]
        factor = min(1.0, case.value / (2 * float(np.median(radii))))
        case.shared["size"] = round(camera.width * factor), round(camera.height * factor)
    width, height = case.shared["size"]
    factors = np.array([width / camera.width, height / camera.height])
    return Camera(width, height, camera.focal * factors, (camera.centre + 0.5) * factors - 0.5, camera.distortion)


def small(photo: Photograph, value: float, case: Case) -> Picture:
    camera = small_camera(case)
    factors = np.array([camera.width / photo.camera.width, camera.height / photo.camera.height])
    image = degrade.shrunk(photo.grey, camera.width, camera.height)
    return Picture(image, place=lambda xy: (np.asarray(xy) + 0.5) * factors - 0.5)


MIRRORED = ("one image", "some", "1 a group", "a group", "all")
"""Images: one; one in every other group; one in each group; all of the last group; all."""


def mirror_images(photo: Photograph, value, case: Case) -> Picture:
    groups = list(case.data.truth["groups"])
    at = groups.index(photo.group)
    first, last = photo.number == 0, at == len(groups) - 1
    if not dict(zip(MIRRORED, (at == photo.number == 0, first and at % 2 == 0, first, last, True), strict=True))[value]:
        return Picture(photo.grey)
    width = photo.grey.shape[1]
    place = lambda xy: np.stack([width - 1 - np.asarray(xy)[..., 0], np.asarray(xy)[..., 1]], axis=-1)  # noqa: E731
    return Picture(photo.grey[:, ::-1], waived=set(photo.must_find), place=place, mirrored=True)


ROTATED = {"all 90°": 1, "all 180°": 2, "all 270°": 3, "one 90°": 1, "one 180°": 2}
"""Quarter turns; ``one`` : in each group, with the camera of the others."""


def rotated_camera(case: Case) -> Camera:
    """The camera turned with its images; where only some are turned, the file's own."""
    camera = case.data.camera
    for _ in range(ROTATED[case.value] if case.value.startswith("all") else 0):
        d = camera.distortion.copy()
        d[2], d[3] = -d[3], d[2]  # (p2, p1) turns as a vector
        centre = [camera.centre[1], camera.width - 1 - camera.centre[0]]
        camera = Camera(camera.height, camera.width, camera.focal[::-1], np.array(centre), d)
    return camera


def rotate(photo: Photograph, value, case: Case) -> Picture:
    if not value.startswith("all") and photo.number:
        return Picture(photo.grey)
    quarter, (height, width) = ROTATED[value], photo.grey.shape
    place = {
        1: lambda xy: np.stack([xy[..., 1], width - 1 - xy[..., 0]], axis=-1),
        2: lambda xy: np.stack([width - 1 - xy[..., 0], height - 1 - xy[..., 1]], axis=-1),
        3: lambda xy: np.stack([height - 1 - xy[..., 1], xy[..., 0]], axis=-1),
    }[quarter]
    waived = set() if value.startswith("all") else set(photo.must_find)
    return Picture(np.rot90(photo.grey, quarter), waived=waived, place=place)


# ---------------------------------------------------------------- kinds with something behind

Motion = tuple[np.ndarray, np.ndarray]
"""Matrix (3, 3), perhaps a reflection, and shift (3,) mm, in the target frame."""


def in_camera(photo: Photograph, motion: Motion) -> Motion:
    """The same motion in the camera frame."""
    r, t = photo.camera_from_target.rotation, photo.camera_from_target.translation
    matrix = r @ motion[0] @ r.T
    return matrix, r @ motion[1] + t - matrix @ t


def facing(photo: Photograph, planes: Iterable[Plane], motion: Motion) -> list[Plane]:
    """These planes moved, those that then face the camera, the farthest first."""
    matrix, shift = in_camera(photo, motion)
    found = []
    for plane in planes:
        outward = np.cross(plane.matrix[:, 0], plane.matrix[:, 1]) * (-1 if plane.name == BOARD else 1)
        moved = plane.moved(matrix, shift)
        middle = moved.xyz_camera(moved.xy_mm.mean(0))
        if (matrix @ outward) @ middle < 0 and (moved.xyz_camera(moved.outline_mm())[:, 2] > 50).all():
            found.append((float(np.linalg.norm(middle)), moved))
    return [plane for _, plane in sorted(found, key=lambda each: -each[0])]


def visible_share(photo: Photograph, planes: Iterable[Plane], free: np.ndarray) -> float:
    """Number of circles of these planes that fall on free pixels."""
    count = 0.0
    for plane in planes:
        x, y = np.rint(photo.camera.project(plane.xyz_camera(plane.xy_mm))).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < free.shape[1]) & (y < free.shape[0])
        count += free[y[inside], x[inside]].sum() / len(plane.labels)
    return count


def motions_behind(case: Case, group: list[Photograph], middle: np.ndarray, turn: float) -> list[Motion]:
    """Random motions to behind the target, as the group's cameras see it; ``middle`` of what moves, target frame;
    ``turn`` : about any axis, rad at most."""
    rng = case.rng(group[0].group)
    axes = np.mean([p.camera_from_target.rotation for p in group], axis=0)
    target, found = middle_of_target(case), []
    for _ in range(60):
        r = Rigid.exp([*(turn * rng.uniform(-1, 1, 3) / np.sqrt(3)), 0, 0, 0]).rotation
        to = target + rng.uniform(-350, 350) * axes[0] + rng.uniform(-250, 250) * axes[1]
        to = to + rng.uniform(200, 450) * axes[2]
        found.append((r, to - r @ middle))
    return found


def middle_of_target(case: Case) -> np.ndarray:
    """Middle of the target's circles, target frame."""
    return np.mean(list(case.data.truth["circles"].values()), axis=0)


def all_faces(photo: Photograph) -> tuple[Plane, ...]:
    return (*photo.faces, *photo.hidden_faces)


def drawn_behind(
    photo: Photograph, value: float, case: Case, planes_of: Callable, middle_of: Callable, turn: float
) -> Picture:
    """The photograph with planes that stand behind, ``value`` times as bright as the first of them where it really is.
    They move alike in all photographs of a group: of random motions, that of which the group shows most is taken."""
    if photo.group not in case.shared:
        group = [p for p in case.data.photographs if p.group == photo.group]
        frees = [1 - p.foreground() for p in group]
        scores, motions = [], motions_behind(case, group, middle_of(group[0]), turn)
        for motion in motions:
            shown = [(p, facing(p, planes_of(p), motion), free) for p, free in zip(group, frees, strict=True)]
            scores.append(sum(visible_share(*each) for each in shown))
        case.shared[photo.group] = motions[int(np.argmax(scores))]
    planes = facing(photo, planes_of(photo), case.shared[photo.group])
    circle, plate = photo.levels(planes_of(photo)[0])
    return Picture(degrade.behind(photo, planes, [(value * circle, value * plate)] * len(planes), 15.0))


def second_target(photo: Photograph, value: float, case: Case) -> Picture:
    return drawn_behind(photo, value, case, all_faces, lambda _: middle_of_target(case), 1.0)


def second_board(photo: Photograph, value: float, case: Case) -> Picture:
    def middle(p: Photograph) -> np.ndarray:
        return p.camera_from_target.inverse() @ p.board.xyz_camera(p.board.xy_mm.mean(0))

    return drawn_behind(photo, value, case, lambda p: [p.board], middle, 0.6)


KINDS = {
    kind.name: kind
    for kind in (
        Kind("plain", "as it is", (0,), lambda p, _, c: Picture((c.data.folder / "images" / p.name).read_bytes())),
        Kind("defocus", "px radius", (1, 2.5, 5, 8, 12), simple(degrade.defocused), goal=3),
        Kind("motion", "px", (2, 5, 9, 14, 20), simple(degrade.motion_blurred, angle(np.pi))),
        Kind("noise", "grey levels", (2, 8, 15, 30, 40), simple(degrade.noisy, seeded), goal=4),
        Kind("underexposed", "×", (0.7, 0.5, 0.35, 0.25, 0.15), simple(degrade.exposed)),
        Kind("overexposed", "×", (1.3, 1.6, 2.0, 2.5, 3.0), simple(degrade.exposed)),
        Kind("gamma", "exponent 1/", (1.25, 0.8, 1.6, 0.6, 2.2), simple(degrade.toned)),
        Kind("jpeg", "quality", (95, 80, 60, 40, 20), simple(degrade.jpeg)),
        Kind("vignetting", "lost in the corners", (0.3, 0.45, 0.6, 0.75, 0.85), simple(degrade.vignetted)),
        Kind("gradient", "brightest : darkest", (1.5, 2.5, 4, 6, 8), simple(degrade.graded, angle(2 * np.pi))),
        Kind("face dimmed", "×", (0.7, 0.5, 0.35, 0.2, 0.15), dim_face),
        Kind("board brighter", "×", (1.5, 2, 3, 4, 5), bright_board),
        Kind("unevenly lit", "brightest : darkest", (1.5, 2.5, 4, 6, 8), of_photo(degrade.unevenly_lit)),
        Kind("glare", "grey levels", (40, 80, 150, 250, 400), glare),
        Kind("haze", "share", (0.15, 0.3, 0.45, 0.6, 0.75), simple(degrade.hazy, seeded)),
        Kind("circles hidden", "per face", (1, 2, 3, 4, 6), hide),
        Kind("circles cut", "share of area", (0.05, 0.1, 0.2, 0.3, 0.4), cut),
        Kind("board covered", "share", (0.1, 0.2, 0.3, 0.4, 0.5), cover_board),
        Kind("one board covered", "share, one image a group", (0.1, 0.2, 0.3, 0.4, 0.5), cover_one_board),
        Kind("halves darker", "share", (0.05, 0.1, 0.15, 0.2, 0.3), of_photo(degrade.half_darker)),
        Kind("hot pixels", "share", (1e-4, 3e-4, 1e-3, 3e-3, 1e-2), simple(degrade.hot_pixels, on_sensor)),
        Kind("dust", "spots", (5, 15, 40, 80, 150), simple(degrade.dusty, on_sensor)),
        Kind("second board", "× brightness", (0.4, 0.6, 0.8, 1.0, 1.3), second_board),
        Kind("second target", "× brightness", (0.4, 0.6, 0.8, 1.0, 1.3), second_target),
        Kind("mirrored", "", MIRRORED, mirror_images, may_end=(5,)),
        Kind("small circles", "px across", (12, 9, 7.5, 6, 5), small, camera=small_camera),
        Kind("rolling shutter", "px", (0.5, 1, 2, 4, 8), rolling),
        Kind("rotated", "", tuple(ROTATED), rotate, camera=rotated_camera),
        # sensors of 10 to 16 bits, their values kept as they are
        Kind("deep", "bits", (10, 12, 14, 15, 16), lambda p, v, _: Picture(p.grey.astype(np.float32), bits=int(v))),
    )
}  # fmt: skip


# ---------------------------------------------------------------- runs


def write_case(kind: Kind, case: Case, folder: Path) -> dict[str, Picture]:
    """The degraded set in a folder; its pictures without pixels, by name without suffix."""
    pictures = {}
    for photo in case.data.photographs:
        picture = kind.make(photo, case.value, case)
        path = folder / "images" / photo.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(picture.pixels, bytes):
            path.with_suffix(".jpg").write_bytes(picture.pixels)
        else:
            pixels = degrade.stored(picture.pixels, picture.bits)
            cv2.imwrite(str(path.with_suffix(".png")), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        picture.pixels = b""
        pictures[photo.name.rpartition(".")[0]] = picture
    camera = kind.camera(case) if kind.camera else case.data.camera
    save_camera(folder / "cameras.txt", Camera.of(camera, case.data.camera.colmap_model))
    return pictures


# ---------------------------------------------------------------- judgement


def read_detections(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Measured places by image (without suffix) and label."""
    found: dict[str, dict[str, np.ndarray]] = {}
    if path.exists():
        with open(path, encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                place = np.array([float(row["x_px"]), float(row["y_px"])])
                found.setdefault(row["image"].rpartition(".")[0], {})[row["label"]] = place
    return found


def board_turns(data: RenderedSet, mirrored: bool) -> list[np.ndarray]:
    """Numbers of the board's dots by row and column, as its own symmetry lets them be; ``mirrored`` : in all images."""
    grid = np.arange(data.board.rows * data.board.columns).reshape(data.board.rows, -1)
    grid = grid[:, ::-1] if mirrored else grid
    if data.board.corner is not None:
        return [grid]
    square = [np.rot90(grid), np.rot90(grid, 3)] if data.board.rows == data.board.columns else []
    return [grid, np.rot90(grid, 2), *square]


def judge_labels(data: RenderedSet, pictures: dict[str, Picture], run: Path) -> dict:
    """Counts of circles and dots found, of those that must be, and of wrong labels, with examples."""
    measured = read_detections(run / "labels.csv") or read_detections(run / "detections.csv")
    total = dict.fromkeys(("found", "must", "dots", "must_dots", "wrong"), 0)
    examples: list[str] = []
    for group in data.truth["groups"]:
        photos = {p.name.rpartition(".")[0]: p for p in data.photographs if p.group == group}
        tried = []
        for turn in board_turns(data, all(pictures[name].mirrored for name in photos)):
            counts, bad = dict.fromkeys(total, 0), []
            for name, photo in photos.items():
                _count(photo, pictures[name], measured.get(name, {}), turn, counts, bad)
            tried.append((counts["wrong"], -counts["dots"], len(tried), counts, bad))
        *_, counts, bad = min(tried)
        total = {key: total[key] + counts[key] for key in total}
        examples += bad
    return total | {"examples": examples[:8]}


def _count(photo: Photograph, picture: Picture, measured: dict, turn: np.ndarray, counts: dict, bad: list) -> None:
    ellipses = photo.ellipses()
    must = {k for k, m in photo.must_find.items() if m} - picture.hidden - picture.waived
    counts["must"] += sum(not k.startswith(BOARD) for k in must)
    counts["must_dots"] += sum(k.startswith(BOARD) for k in must)
    scale = 1.0
    if picture.place:  # a set of other size has other radii
        ends = picture.place(np.array([[0.0, 0.0], [1000.0, 1000.0]]))
        scale = float(np.linalg.norm(ends[1] - ends[0]) / np.hypot(1000, 1000))
    for label, xy in measured.items():
        key = label
        if label.startswith(f"{BOARD}:"):
            row, column = map(int, label.split(":")[1:])
            inside = row < turn.shape[0] and column < turn.shape[1]
            key = f"{BOARD}:{turn[row, column]}" if inside else label
        if key not in ellipses or key in picture.hidden:
            counts["wrong"] += 1
            bad.append(f"{photo.name} {label}: not in view")
            continue
        centre, radius = ellipses[key]
        away = float(np.linalg.norm(xy - (picture.place(centre) if picture.place else centre)))
        if away > max(NEAR_PX, NEAR_RADII * radius * scale):
            counts["wrong"] += 1
            bad.append(f"{photo.name} {label}: {away:.1f} px off")
        elif key in must:
            counts["dots" if key.startswith(BOARD) else "found"] += 1


def judge_faces(data: RenderedSet, run: RunResult) -> dict:
    """Faces found, and the largest errors: µm and in σ."""
    known = {face: Rigid.from_matrix(matrix) for face, matrix in data.truth["target_from_face"].items()}
    shown = {k.partition(":")[0] for p in data.photographs for k, must in p.must_find.items() if must}
    off = face_errors(run.target, known)
    um = max((1e3 * float(np.linalg.norm(each[3:])) for each in off.values()), default=0.0)
    sigma = float(np.sqrt(normalised(run.target, off).max(initial=0.0)))
    faces = len(run.target.target_from_face.keys() & known.keys())
    return {"faces": faces, "of": len(shown & known.keys()), "um": um, "sigma": sigma}


def run_case(kind: Kind, strength: int, data: RenderedSet, workers: int) -> dict:
    """The row of one case."""
    case = Case(data, kind.name, kind.values[strength - 1])
    row = {"set": data.folder.name, "kind": kind.name, "strength": strength, "value": case.value}
    with tempfile.TemporaryDirectory(prefix="envelope-") as scratch:
        folder = Path(scratch)
        pictures = write_case(kind, case, folder)
        try:
            designs = (data.target, data.board)
            options = RunOptions(workers=workers)
            result = run(folder / "images", folder / "cameras.txt", folder / "run", *designs, options)
            row |= judge_faces(data, result) | {"failed": [c.key for c in result.checks if c.verdict == "failed"]}
        except StcalError as error:
            row["error"] = str(error).replace(str(folder), "…")
        return row | judge_labels(data, pictures, folder / "run")


# ---------------------------------------------------------------- results


def silent(row: dict) -> bool:
    """Wrong without a word: over 4 σ, and no check failed."""
    return row.get("sigma", 0) > SILENT_SIGMA and not row["failed"]


def share(rows: Sequence[dict], found: str, of: str) -> str:
    return f"{100 * sum(r[found] for r in rows) / max(1, sum(r[of] for r in rows)):.1f}"


def line_of(row: dict) -> str:
    kind = KINDS[row["kind"]]
    beyond = "*" if row["strength"] > kind.goal or row["strength"] in kind.may_end else " "
    text = f"{row['set'][:11]:<11} {row['kind']:<17} {row['value']!s:>8}{beyond} {share([row], 'found', 'must'):>6} "
    text += f"{share([row], 'dots', 'must_dots'):>6} {row['wrong']:>5} "
    if "error" in row:
        return text + row["error"][:110]
    text += f"{row['faces']}/{row['of']} {row['um']:>8.1f} {row['sigma']:>6.1f} {len(row['failed']):>4}"
    return text + ("  SILENT" if silent(row) else "")


@script(sets=[SAMPLE], only="", strengths=[1, 2, 3, 4, 5], workers=2)
def main(given) -> None:
    print(f"{'':40}{'circ %':>6} {'dots %':>6} {'wrong':>5} face {'µm':>7} {'σ':>6} {'bad':>4}", flush=True)
    rows = []
    for folder, kind in itertools.product(given.sets, KINDS.values()):
        data = read_set(folder.resolve())
        for strength in given.strengths if re.search(given.only, kind.name) else []:
            if strength <= len(kind.values):
                rows.append(run_case(kind, strength, data, given.workers))
                print(line_of(rows[-1]), flush=True)
    quiet, ended = [r for r in rows if silent(r)], [r for r in rows if "error" in r]
    inside = [r for r in ended if r["strength"] <= KINDS[r["kind"]].goal]
    print(f"{len(rows)} cases: {sum(r['wrong'] for r in rows)} wrong labels, {len(quiet)} silent")
    print(f"{len(ended)} runs ended, {len(inside)} of them within the goals (*: beyond them)")
    print(f"faces lost in {sum(r['faces'] < r['of'] for r in rows if 'error' not in r)} runs")
    print(f"{share(rows, 'found', 'must')} % of circles, {share(rows, 'dots', 'must_dots')} % of dots found")
