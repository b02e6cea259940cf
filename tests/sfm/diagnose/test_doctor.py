"""What the doctor says of spoiled photographs is true: its gates, its values, and that its remedies let circles in."""

import csv
import json
import shutil
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel
from stcal.sfm import RunOptions, run
from stcal.sfm.data.patterns import Pattern, ideal_border, in_view
from stcal.sfm.detect.circles.candidates import EllipseOptions, find_ellipses
from stcal.sfm.diagnose.doctor import _depth_of_field, doctor, missing_circles
from stcal.sfm.diagnose.examine import LEAST_MIN_DIAMETER_PX, trace_outlines
from stcal.sfm.diagnose.findings import Diagnosis, Finding, GateCount, by_gate, in_order, table
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import read_model
from stcal.sfm.runs.saved import load_run
from tests.outcome import fails_with
from tests.shared import own_copy

pytestmark = pytest.mark.usefixtures("no_page")
IMAGES = FIRST, SECOND, THIRD, FOURTH = [f"12/IMG_100{i}.jpg" for i in range(4)]


class Patient:
    """Group 12 of the small set, to be spoiled; ``places`` : centres in the unspoiled images by image and label."""

    def __init__(self, folder: Path, dataset: Path, good_run: Path):
        self.folder, self.images = folder, folder / "images"
        own_copy(dataset / "images" / "12", self.images / "12")
        for name in ("cameras.txt", "target.toml", "board.toml"):
            own_copy(dataset / name, folder / name)
        own_copy(good_run / "cache", folder / "run" / "cache")
        own_copy(good_run / "stcal-run.json", folder / "run")
        self.good = dataset / "images"
        self.places = defaultdict(dict)
        for image, label, x, y in rows(good_run):
            self.places[image][label] = np.round([float(x), float(y)]).astype(int)

    def edit(self, name: str, change) -> None:
        """``change(image)`` in place."""
        image = cv2.imread(str(self.images / name), cv2.IMREAD_GRAYSCALE)
        change(image)
        assert cv2.imwrite(str(self.images / name), image, [cv2.IMWRITE_JPEG_QUALITY, 100])

    def patch(self, image: np.ndarray, name: str, label: str, half: int) -> np.ndarray:
        """The square around a circle."""
        x, y = self.places[name][label]
        return image[y - half : y + half + 1, x - half : x + half + 1]

    def hide(self, name: str, *labels: str, half: int = 14) -> None:
        """Paint over circles with what is around them."""

        def paint(image):
            for label in labels:
                patch = self.patch(image, name, label, half)
                cv2.circle(patch, (half, half), half - 1, float(np.median(patch[:, [0, -1]])), -1)

        self.edit(name, paint)

    def mend(self, name: str) -> None:
        """The good image again."""
        shutil.copy(self.good / name, self.images / name)

    def run(self, **options) -> Diagnosis:
        files = [self.folder / name for name in ("images", "cameras.txt", "run", "target.toml", "board.toml")]
        run(*files, RunOptions(workers=1, solve="chain", **options))
        return doctor(load_run(self.folder / "run"), workers=1)

    def arguments(self, command: str, *more) -> list:
        """Of ``stcal-sfm``."""
        out = self.folder / ("run" if command == "run" else "look")
        return [command, self.images, "--camera", self.folder / "cameras.txt", "--out", out, "--workers", 1, *more]

    def detected(self, folder: str = "look") -> set[tuple[str, str]]:
        return {(image, label) for image, label, _, _ in rows(self.folder / folder)}

    def mapped(self) -> tuple[set[str], set[str]]:
        """Images and circles of the model."""
        report = load_run(self.folder / "run").report
        residuals = report["residuals_by_image"], report["residuals_by_label"]
        return {row["image"] for row in residuals[0]}, {row["label"] for row in residuals[1]}


def rows(folder: Path) -> list[list[str]]:
    with open(folder / "detections.csv", newline="") as stream:
        return [row[:4] for row in csv.reader(stream)][1:]


@pytest.fixture
def patient(small_dataset, small_run, tmp_path) -> Patient:
    return Patient(tmp_path, small_dataset, small_run)


def of_images(diagnosis: Diagnosis) -> list[Finding]:
    """Findings of single images: that some faces are in no photograph of the group is said too."""
    return [finding for finding in diagnosis.findings if finding.image]


def by_label(diagnosis: Diagnosis, image: str) -> dict[str, Finding]:
    return {label: f for f in diagnosis.findings if f.image == image for label in f.labels}


def unlabelled(diagnosis: Diagnosis) -> set[tuple[str, str]]:
    """Circles in view without a label."""
    labelled = ("views", "ray_angle", "residual")
    return {(f.image, label) for f in of_images(diagnosis) for label in f.labels if f.gate not in labelled}


def let_in(diagnosis: Diagnosis, option: str) -> set[tuple[str, str]]:
    """Of :func:`unlabelled` those that an option is said to let in."""
    return {(f.image, x) for f in of_images(diagnosis) for x in f.labels if option in f.options} & unlabelled(diagnosis)


def test_a_good_run_lacks_no_circle(small_run):
    diagnosis = doctor(load_run(small_run), workers=1)
    assert unlabelled(diagnosis) == set()
    assert {f.gate for f in diagnosis.findings} == {"views"}
    never = {f.labels[0].split(":")[0] for f in diagnosis.findings if not f.image and f.value == 0}
    assert never == {"3"}
    assert (diagnosis.files, diagnosis.images, diagnosis.mapped) == (8, 8, 8)
    assert diagnosis.circles == json.loads((small_run / "report.json").read_text())["summary"]["observations"]


def test_in_view_is_what_the_simulation_wants_found(small_run, small_dataset):
    """With all labels taken away what is missing is what the truth wants found: faces of the group, tilt to 70°."""
    saved = load_run(small_run)
    ids = image_ids(saved.observations)
    models = read_model(small_run / "target_model", saved.observations, ids, saved.corrected_px).in_mm()
    truth = json.loads((small_dataset / "truth.json").read_text())["groups"]
    blind = {image.name: image.select([]) for image in saved.observations}
    circles = {label: np.array(xyz) for label, xyz in saved.faces.circles.items()}
    assert len(models) == 2
    for model in models:
        expected = missing_circles(model, circles, blind, saved.camera, saved.target_design, saved.board_design)
        for name in model.images:
            seen = truth[model.group]["images"][name]["circles"]
            wanted = [label for label in seen if seen[label]["must_find"]]
            found = {each.pattern.plane: np.array(each.pattern.labels)[each.missing] for each in expected[name]}
            for face in model.group:
                assert found[face].tolist() == [label for label in wanted if label.startswith(f"{face}:")]
            assert len(found["board"]) == sum(label.startswith("board:") for label in wanted) > 50


def test_in_view_faces_the_camera_whole_and_in_front(small_run):
    """A plane of three circles 20 mm apart at 500 mm, f = 1395 px: tilted, at the border, behind, and upside down."""
    camera = load_run(small_run).camera
    xy, radius = np.array([[-20.0, 0], [0, 0], [20, 0]]), np.full(3, 8.0)
    labels = [CircleLabel("1", str(i)) for i in range(3)]

    def seen(tilt_deg=0.0, xyz=(0.0, 0.0, 500.0), side=1):
        turned = Rigid.exp([np.pi, 0, 0, 0, 0, 0]) @ Rigid.exp([0, np.radians(tilt_deg), 0, 0, 0, 0])
        pose = Rigid(turned.rotation, xyz)
        pattern = Pattern("1", labels, xy, radius, "bright", side)
        return in_view(pattern, pose, camera, ideal_border(camera)).tolist()

    assert seen() == [True] * 3
    assert seen(side=-1) == [False] * 3
    assert seen(66) == [True] * 3
    assert seen(74) == [False] * 3
    assert seen(xyz=(0, 0, -500)) == [False] * 3
    # The image's right border is 645 px from the principal point: 231 mm, and 0.6 mm more by the distortion.
    assert seen(xyz=(202, 0, 500)) == [True, True, True]
    assert seen(xyz=(206, 0, 500)) == [True, True, False]
    assert seen(xyz=(226, 0, 500)) == [True, False, False]


@pytest.mark.slow
def test_too_small_circles(patient, stcal_sfm):
    """9 px asked for: an option finds those circles that it is said to let in, and no others."""
    diagnosis = patient.run(ellipses=EllipseOptions(min_diameter_px=9.0))
    small = [f for f in of_images(diagnosis) if f.gate == "min_diameter"]
    assert len(small) >= 3
    assert all(LEAST_MIN_DIAMETER_PX < f.value < 9.0 == f.limit and f.unit == "px" for f in small)
    assert let_in(diagnosis, "--min-diameter 4") == unlabelled(diagnosis) != set()
    options = {option for f in small for option in f.options}
    assert len(options) == 2
    for option in options:
        assert stcal_sfm(*patient.arguments("detect", *option.split()))[0] == 0
        assert let_in(diagnosis, option) == unlabelled(diagnosis) & patient.detected()
    seen_once = [f for f in diagnosis.findings if f.gate == "views"]
    helped = {label for f in seen_once for label in f.labels if "--min-diameter 4" in f.options}
    assert helped
    assert stcal_sfm(*patient.arguments("run", "--min-diameter", 4))[0] == 0
    images, labels = patient.mapped()
    assert images == set(IMAGES)
    assert helped <= labels


def test_the_least_diameter_tried_is_what_the_command_takes(patient, stcal_sfm):
    for name in IMAGES[1:]:
        (patient.images / name).unlink()
    code, _, error = stcal_sfm(*patient.arguments("detect", "--min-diameter", LEAST_MIN_DIAMETER_PX - 0.01))
    assert code == 2
    assert "min-diameter" in error
    assert stcal_sfm(*patient.arguments("detect", "--min-diameter", LEAST_MIN_DIAMETER_PX))[0] == 0


@pytest.mark.slow
def test_too_large_circles(patient, stcal_sfm):
    diagnosis = patient.run(ellipses=EllipseOptions(max_diameter_px=21.0))
    large = [f for f in of_images(diagnosis) if f.gate == "max_diameter"]
    assert len(large) >= 20
    assert all(21.0 == f.limit < f.value < 28.0 for f in large)
    assert let_in(diagnosis, "--max-diameter 30") == unlabelled(diagnosis)
    assert stcal_sfm(*patient.arguments("detect", "--max-diameter", 30))[0] == 0
    numbered = {(image, label) for image, label in unlabelled(diagnosis) if not label.startswith("board:")}
    assert numbered <= patient.detected()


@pytest.mark.slow
def test_spoiled_circles(patient):
    """In one set: hidden, seen once, moved, and a rim without an edge; each is told from the others. Faint ones are
    found where the group has them."""
    patient.hide(FIRST, "2:2", "board:3:4")
    for name in IMAGES[1:]:
        patient.hide(name, "1:a", half=11)

    def move(image):
        for label in ("2:1", "board:2:2"):
            patch = patient.patch(image, SECOND, label, 13)
            patch[:, 1:] = patch[:, :-1].copy()

    faint = {"2:7": 14, "1:1": 12, "board:3:4": 11}

    def dim(image):
        for label, contrast in faint.items():
            patch = patient.patch(image, THIRD, label, 14)
            around, disc = np.median(patch[[0, -1]]), np.hypot(*np.mgrid[-14:15, -14:15]) < 14
            patch[disc] = np.round(around + (patch[disc] - around) * contrast / (patch[14, 14] - around))

    def disturb(image):
        y, x = np.mgrid[-15:16, -15:16]
        half = (np.hypot(x, y) > 6) & (np.hypot(x, y) < 13) & (x > 0)
        for label in ("2:3", "board:3:4"):
            patch = patient.patch(image, FOURTH, label, 15)
            patch[half] = np.clip(patch[half] + 60.0 * (1 - 2 * ((x + y)[half] % 2)), 0, 255)

    patient.edit(SECOND, move)
    patient.edit(THIRD, dim)
    patient.edit(FOURTH, disturb)
    diagnosis = patient.run()
    first, second, third, fourth = (by_label(diagnosis, name) for name in IMAGES)

    assert {label: f.gate for label, f in first.items()} == {"2:2": "hidden", "board:3:4": "hidden", "1:a": "views"}
    assert all(abs(first[label].value) < 0.02 < first[label].limit for label in ("2:2", "board:3:4"))
    assert (first["1:a"].value, first["1:a"].limit, first["1:a"].options) == (1, 2, ())
    assert second["1:a"].gate == "hidden"

    # One pixel off: the group's other images contradict them before anything is mapped.
    assert {"2:1", "board:2:2"} <= second.keys(), {x: f.gate for x, f in second.items()}

    assert not faint.keys() & third.keys()  # the limit of the first look is 14 of a range of about 180 grey values

    assert {label: f.gate for label, f in fourth.items()} == {"2:3": "rim", "board:3:4": "rim", "1:a": "hidden"}
    # Half of 16 sectors have no edge to follow.
    assert all(0.35 < fourth[x].value < 0.7 < fourth[x].limit == 0.8 for x in ("2:3", "board:3:4"))

    for name in IMAGES:
        patient.mend(name)
    assert unlabelled(patient.run()) == set()
    assert {"1:a", "2:1", "2:3", "2:7", "board:2:2", "board:3:4"} <= patient.mapped()[1]


@pytest.mark.slow
def test_another_view_lets_in_a_circle_seen_once(patient):
    for name in IMAGES[2:]:
        patient.hide(name, "2:7", half=16)
    patient.hide(SECOND, "2:7", half=16)
    found = {f.image: f.gate for f in of_images(patient.run()) if "2:7" in f.labels}
    assert found == dict.fromkeys(IMAGES[1:], "hidden") | {FIRST: "views"}
    patient.mend(SECOND)
    patient.run()
    assert "2:7" in patient.mapped()[1]


@pytest.mark.slow
def test_spoiled_faces_and_boards(patient):
    """A face with 4 of 10 circles, 6 needed to name it, one at 0.4 of its brightness, and a board of 20 of 63 dots, 23
    needed: what is hidden costs nothing but itself."""
    hidden = {"2:2", "2:6", "2:7", "2:1", "2:3", "2:5"}
    patient.hide(FIRST, *hidden)
    face = [f"2:{circle}" for circle in "1234567abc"]

    def dim(image):
        (x, y), radius = cv2.minEnclosingCircle(np.array([patient.places[SECOND][label] for label in face]))
        mask = cv2.circle(np.zeros_like(image), (int(x), int(y)), int(radius) + 12, 255, -1) > 0
        around = np.median(image)
        image[mask] = np.clip(around + 0.4 * (image[mask] - around), 0, 255)

    patient.edit(SECOND, dim)
    shown = {f"board:{row}:{column}" for row in range(5) for column in range(4)}
    dots = {label for label in patient.places[THIRD] if label.startswith("board:")}
    patient.hide(THIRD, *dots - shown, half=12)
    diagnosis = patient.run()
    first, second, third = (by_label(diagnosis, name) for name in (FIRST, SECOND, THIRD))
    assert {label for label, f in first.items() if f.gate == "hidden"} == hidden
    assert first.keys() == hidden
    assert not second.keys() & set(face)
    dark = ("hidden", "min_contrast")  # some of what is painted over differs a little from what is around it
    assert {label for label, f in third.items() if f.gate in dark and abs(f.value) < 0.04} == dots - shown
    assert not shown & third.keys()


@pytest.mark.parametrize("mended", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_files_and_images_left_out_whole(patient, mended):
    """The last of them shows five circles: six must be known, and a face is known by eight. Mended, they are mapped."""
    image = cv2.imread(str(patient.images / THIRD), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(patient.images / THIRD), image[:800])
    (patient.images / "12" / "notes.txt").write_text("none")
    shutil.copy(patient.images / FIRST, patient.images / "12" / "copy.jpg")
    good = cv2.imread(str(patient.images / SECOND), cv2.IMREAD_GRAYSCALE)
    bare = np.full_like(good, int(np.median(good)))
    labels = [f"1:{circle}" for circle in "1234567abc"]

    def show(*shown: str) -> None:
        for label in shown:
            patient.patch(bare, SECOND, label, 14)[:] = patient.patch(good, SECOND, label, 14)
        cv2.imwrite(str(patient.images / SECOND), bare)

    show(*labels[:5])
    diagnosis = patient.run()
    found = {f.image: f for f in of_images(diagnosis)}
    assert {name.removeprefix("12/"): f.gate for name, f in found.items()} == {
        "IMG_1001.jpg": "known_circles",
        "IMG_1002.jpg": "image_size",
        "notes.txt": "file_type",
        "copy.jpg": "copy",
    }
    assert (found[THIRD].value, found[THIRD].limit) == ("1296×800 px", "1296×864 px")
    assert (found[SECOND].value, found[SECOND].limit, found[SECOND].options) == (0, 6, ())
    assert {f.image for f in diagnosis.findings[:2]} == {SECOND, THIRD}
    assert (diagnosis.files, diagnosis.images, diagnosis.mapped) == (6, 3, 2)
    if mended:
        show(*labels[5:])
        patient.mend(THIRD)
        patient.run()
        assert patient.mapped()[0] == set(IMAGES)


@pytest.mark.slow
def test_images_that_moved_or_are_gone(patient, tmp_path):
    patient.hide(FIRST, "2:7")
    patient.run()
    saved = load_run(patient.folder / "run")
    moved = patient.images.rename(tmp_path / "elsewhere")

    def found(images=None) -> Finding:
        return by_label(doctor(saved, images, workers=1), FIRST)["2:7"]

    assert (found().gate, found().unit) == ("not_examined", "px")
    assert 10 < found().value < 30
    assert "No such file" in found().remedy
    assert "--images" in found().remedy
    assert found(moved).gate == "hidden"
    shutil.copy(patient.good / FIRST, moved / FIRST)
    assert found(moved).gate == "found_now"
    with pytest.raises(InputError, match="not a folder; give the folder of the run's images with --images"):
        found(tmp_path / "nowhere")


@pytest.mark.slow
def test_the_command(patient, stcal_sfm, tmp_path):
    patient.hide(FIRST, "2:2", "2:7", "board:3:4", "board:3:5")
    patient.run()
    code, text, _ = stcal_sfm("doctor", patient.folder / "run", "--json", tmp_path / "found.json", "--workers", 1)
    assert code == 0
    assert text.startswith("4 of 4 images mapped, ")
    assert "left out: 0 files, 0 images, 4 circles of 1 image\n" in text
    assert f"{FIRST}  2:2, 2:7  hidden " in text
    assert f"{FIRST}  board:3:4–5  hidden " in text
    content = json.loads((tmp_path / "found.json").read_text())
    assert content["format"] == "stcal doctor 1"
    assert content["gates"] == {"hidden": {"circles": 4, "images": 1, "by_option": 0}}
    assert [f["labels"] for f in content["findings"] if f["image"]] == [["2:2"], ["2:7"], ["board:3:4"], ["board:3:5"]]


@pytest.mark.parametrize(("shift_px", "times"), [(0.0, 0), (0.4, 1), (64.0, 4)])
def test_depth_of_field_is_said_where_it_moves_centres_by_more_than_their_sigma(small_run, shift_px, times):
    """64 σ: eight times the f-number, six stops, or four times the distance."""
    run = load_run(small_run)
    sigma = float(np.median(np.concatenate([image.sigma_px() for image in run.observations])))
    row = {"image": "12/IMG_1000.jpg", "shift_px": shift_px * sigma}
    notes = _depth_of_field(replace(run, report=run.report | {"focus": [row]}))
    if times < 2:
        assert notes == []
    else:
        assert "from 8.0 times the f-number (6 stops), or from 4.0 times the distance" in notes[0]
        assert "12/IMG_1000.jpg), 64 times" in notes[0]


def test_a_report_of_another_version_is_refused(small_run):
    saved = load_run(small_run)
    del saved.report["left_out"]["files"]
    with fails_with("E-RUN-VERSION … 'files'"):
        doctor(saved, workers=1)


@pytest.mark.parametrize(("key", "wrong"), [("limit", []), ("value", {}), ("gate", 7), ("unit", None), ("label", 1.5)])
def test_a_damaged_report_is_refused(small_run, key, wrong):
    saved = load_run(small_run)
    good = {"image": FIRST, "label": "2:7", "gate": "rim", "value": 0.5, "limit": 0.8, "unit": "px"}
    saved.report["left_out"]["circles"] = [good, good | {key: wrong}]
    with fails_with("E-RUN-VERSION"):
        doctor(saved, workers=1)


def test_the_table():
    assert table(Diagnosis(4, 4, 4, 90, ())).startswith("nothing was left out: 4 of 4 images mapped, 90 circles")
    findings = in_order(
        [
            Finding("b", ("2:1",), "hidden", 0.0, 0.08, "", "uncover it"),
            Finding("b", ("1:1",), "min_diameter", 8.1, 9.0, "px", "come 10 % closer", ("--min-diameter 8",)),
            Finding("b", ("1:2",), "min_diameter", 8.9996, 9.0, "px", "come 1 % closer", ("--min-diameter 8",)),
            Finding("a", (), "image_size", "3×2 px", "6×4 px", "", "give the right one"),
            Finding("d", ("4:1",), "min_diameter", 8.9996, 9.0, "px", "come 1 % closer"),
            *(Finding("c", (f"3:{i}",), "rim", 0.5, 0.8, "of the rim", "uncover it") for i in range(20)),
        ]
    )
    diagnosis = Diagnosis(2, 2, 1, 50, findings)
    lines = table(diagnosis).splitlines()
    assert lines[0].endswith("left out: 0 files, 1 image, 24 circles of 3 images")
    assert "--min-diameter 8 lets in 2 circles of 1 image" in lines
    assert lines[-5:] == [
        "a  image_size 3×2 px, 6×4 px needed: give the right one",
        "b  1:1, 1:2  min_diameter 8.1 to 9, 9 px needed: --min-diameter 8 lets them in",
        f"c  {', '.join(f'3:{i}' for i in range(12))} … (20 circles)  rim 0.5, 0.8 of the rim needed: uncover it",
        "d  4:1  min_diameter 8.9996, 9 px needed: come 1 % closer",
        "b  2:1  hidden 0, 0.08 needed: uncover it",
    ]
    assert table(diagnosis, lines=1).splitlines()[-1] == "… 4 more lines with --all"
    assert by_gate(findings)["min_diameter"] == GateCount(circles=3, images=2, by_option=2)


def outline(draw, centre=(300.0, 200.0), diameter=30.0, **options):
    """Where a circle expected in a drawing ends; detection does not find it either."""
    image = np.full((400, 600), 40, np.uint8)
    draw(image)
    image = cv2.GaussianBlur(image, (5, 5), 0.8)
    found = find_ellipses(image, "bright", EllipseOptions(**options)).centre_px
    assert not (np.linalg.norm(found - centre, axis=1) < 0.15 * diameter).any()
    shape = np.eye(2)[None] * diameter / 2
    return trace_outlines(image, "bright", EllipseOptions(**options), np.array([centre]), shape)[0]


def disc(radius, centre=(300, 200), value=200):
    return lambda image: cv2.circle(image, centre, radius, value, -1, cv2.LINE_AA)


def test_gates_of_outlines():
    end = outline(disc(15, centre=(300, 14)), centre=(300.0, 14.0))
    assert (end.gate, end.value, end.unit) == ("border", 0, "px")
    end = outline(disc(15), min_diameter_px=40)
    assert (end.gate, end.limit, end.cause) == ("min_diameter", 40, "")
    assert end.value == pytest.approx(31, abs=1.5)
    end = outline(disc(60), diameter=120, max_diameter_px=100)
    assert (end.gate, end.limit, end.cause) == ("max_diameter", 100, "")
    assert end.value == pytest.approx(121, abs=3)
    end = outline(lambda image: cv2.ellipse(image, (300, 200), (60, 8), 0, 0, 360, 200, -1, cv2.LINE_AA))
    assert (end.gate, end.limit) == ("min_axis_ratio", 0.2)
    assert end.value == pytest.approx(8 / 60, abs=0.03)
    end = outline(lambda image: cv2.rectangle(image, (285, 185), (315, 215), 200, -1))
    assert (end.gate, end.cause) == ("outline_deviation", "")
    assert 1 < end.value < 3
    end = outline(lambda image: (disc(15)(image), cv2.line(image, (300, 200), (420, 260), 200, 8)))
    assert end.cause == "merged"
    # Beside a bright sheet only the smaller window sees the disc, and it judges no disc of that size.
    end = outline(lambda image: (disc(10, value=75)(image), cv2.rectangle(image, (326, 0), (600, 400), 230, -1)))
    assert (end.gate, end.value) == ("outline", None)
    end = outline(disc(12, centre=(309, 200)), diameter=40)
    assert (end.gate, end.unit) == ("position", "radii")
    assert end.value == pytest.approx(9 / 20, abs=0.02)


@pytest.mark.parametrize(("contrast", "gate"), [(14, ""), (11, "min_contrast"), (5, "min_contrast"), (1, "hidden")])
def test_gates_of_contrast(contrast, gate):
    """A range of 160 grey values: 12.8 are needed, and under 3.2 nothing is there."""

    def draw(image):
        disc(15, value=40 + contrast)(image)
        disc(30, centre=(100, 100))(image)

    if not gate:
        with pytest.raises(AssertionError):
            outline(draw)
        return
    end = outline(draw)
    assert end.gate == gate
    assert end.value == pytest.approx(contrast / 160, abs=0.004)
    assert end.limit == pytest.approx(0.08, abs=0.001)
