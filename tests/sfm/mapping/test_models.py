"""COLMAP models read back with labels: made by the mapper, edited, damaged, or of something else."""

import json
import random
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError
from stcal.sfm.interop.crosscheck import calibrate_models, faces_from_models
from stcal.sfm.interop.export_colmap import export_database
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.incremental import seeded_mapping
from stcal.sfm.mapping.models import open_model, read_model, write_model
from tests.outcome import COMPUTATION, INPUT, assert_error, fails_with
from tests.shared import own_copy

FILES = ("cameras", "rigs", "frames", "images", "points3D")
SAME_MM = 1e-9
"""Between results of the same numbers: they are summed in another order at most."""


def read(path, saved):
    return read_model(path, saved.observations, image_ids(saved.observations), saved.corrected_px)


@pytest.fixture(scope="module")
def plain(saved):
    return calibrate_models(saved.folder / "colmap/models" / "12", saved)


class Model(pycolmap.Reconstruction):
    """The run's model of group 12, to be edited and written."""

    def __init__(self, saved, folder):
        super().__init__(str(saved.folder / "colmap/models" / "12"))
        self.folder = folder
        self.labels = {image.name: image.labels for image in saved.observations}

    def point(self, label: str) -> int:
        return next(i for i, _, found in self.seen() if found == label)

    def seen(self):
        for image_id, image in self.images.items():
            for k, each in enumerate(image.points2D):
                if each.has_point3D():
                    yield each.point3D_id, (image_id, k), self.labels[image.name][k]

    def as_binary(self, write=pycolmap.Reconstruction.write_binary):
        self.folder.mkdir()
        write(self, str(self.folder))
        return self.folder

    def as_text(self):
        return self.as_binary(pycolmap.Reconstruction.write_text)


@pytest.fixture
def model(saved, tmp_path):
    return Model(saved, tmp_path / "model")


def assert_same_faces(found, known) -> None:
    assert found.target.target_from_face.keys() == known.target.target_from_face.keys()
    for face, pose in found.target.target_from_face.items():
        assert np.allclose(pose.matrix(), known.target.target_from_face[face].matrix(), rtol=0, atol=SAME_MM), face


NOT_THERE = "group 14: in none of the models"


@pytest.fixture(scope="module")
def mapped(saved, tmp_path_factory):
    """Group 12 of a copy of the run's database, mapped by pycolmap as the run does; its folder."""
    folder = tmp_path_factory.mktemp("mapped")
    export_database(saved, folder / "copy.db", "4.2")
    ids = image_ids(saved.observations)
    pair = saved.report["groups"][0]["pairs"][0]
    names = [image.name for image in saved.groups()["12"]]
    made = seeded_mapping(folder / "copy.db", folder / "scratch", names, (ids[pair["first"]], ids[pair["second"]]))
    (folder / "model").mkdir()
    made.write_binary(str(folder / "model"))
    return folder


def test_the_model_read_back_has_our_float64_centres_by_label(saved, mapped):
    found = read(mapped / "model", saved)
    (group,) = found.groups
    of = {image.name: (image, xy) for image, xy in zip(saved.observations, saved.corrected_px, strict=True)}
    rows = [(*of[group.images[i]], k) for i, k in zip(group.image_index, group.keypoint, strict=True)]
    assert len(rows) > 300
    assert [image.labels[k] for image, _, k in rows] == [group.labels[point] for point in group.point_index]
    assert np.array_equal(group.measured_px, [image.centre_px[k] for image, _, k in rows])
    corrected = [xy[k] for _, xy, k in rows]
    assert np.allclose(group.corrected_px(), corrected, rtol=0, atol=1e-12)  # measured − (measured − corrected)
    assert (found.unlabelled, found.split, found.absent) == (0, 0, 0)
    assert found.camera.same_as(saved.camera)
    rms = np.sqrt((group.residuals_px(found.camera) ** 2).mean())
    assert 0.001 < rms < 0.02  # good edges reach 0.005 px


@pytest.mark.parametrize("face_id", ["1", "2"])
def test_a_deleted_frame_circle_stands_where_the_design_has_it(saved, model, plain, face_id):
    """The circles are 20 µm off the design, each: so is a frame that rests on the design in one of its three."""
    circle = saved.target_design.face(face_id).x
    model.delete_point3D(model.point(f"{face_id}:{circle}"))
    found = calibrate_models(model.as_binary(), saved)
    assert found.target.target_from_face.keys() == plain.target.target_from_face.keys()
    apart = found.target.target_from_face["2"].translation - plain.target.target_from_face["2"].translation
    assert 1e-4 < np.linalg.norm(apart) < 0.2
    assert found.notes[0] == NOT_THERE
    assert found.notes[1].startswith(f"face {face_id}: frame circle {face_id}:{circle} not mapped; it stands where")


def test_a_reference_face_of_too_few_circles_is_named(saved, model, stcal_sfm, tmp_path):
    face = saved.target_design.face("1")
    for circle in [face.y, *[c for c in face.ids if c not in (face.origin, face.x, face.y)][:5]]:
        model.delete_point3D(model.point(f"1:{circle}"))
    model.delete_point3D(model.point(f"1:{face.origin}"))
    outcome = stcal_sfm("faces", model.as_binary(), "--run", saved.folder, "--out", tmp_path / "f.json")
    parts = ("reference face 1: not mapped in any group", f"frame circle 1:1 and 1:{face.y} not mapped", NOT_THERE)
    assert_error(outcome, COMPUTATION, "E-FACE-REFERENCE", *parts)
    assert not (tmp_path / "f.json").exists()


def merged(model):
    model.merge_points3D(model.point("2:4"), model.point("2:6"))
    return model.as_binary(), {"2:4", "2:6"}, "points left out, since their keypoints name no one circle: 1"


def split(model):
    """The one of the two points that more images see counts; the other one lies elsewhere."""
    point = model.point("2:1")
    first, xyz = next(where for i, where, _ in model.seen() if i == point), model.point3D(point).xyz
    model.delete_observation(*first)
    track = pycolmap.Track()
    track.add_element(*first)
    model.add_point3D(xyz + 0.02, track)
    return model.as_binary(), set(), "circles that are several points each, longest tracks taken: 1"


def deleted_by_hand(model):
    """From the text of the points: images then name points that are not there."""
    path, lost = model.as_text() / "points3D.txt", model.point("2:4")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if line.split()[0] != str(lost)))
    return path.parent, {"2:4"}, "points that keypoints name, but the model does not have: 1"


@pytest.mark.parametrize("edited", [merged, split, deleted_by_hand])
def test_points_that_were_edited_are_counted(saved, model, plain, edited):
    path, gone, note = edited(model)
    found = calibrate_models(path, saved)
    assert found.target.circles.keys() == plain.target.circles.keys() - gone
    assert found.notes == (f"model {path}: {note}", NOT_THERE)
    if not gone:
        assert_same_faces(found, plain)


def test_all_groups_in_one_world(saved, tmp_path):
    """As two models, and brought together as one, of another size, place and attitude: each group keeps its own points
    and faces, and has the scale of that world."""
    apart = calibrate_models(saved.folder / "colmap/models", saved)
    assert ([m.group for m in apart.models], apart.notes) == (["12", "14"], ())
    assert apart.target.target_from_face.keys() == saved.faces.target_from_face.keys()
    ids = image_ids(saved.observations)
    write_model(tmp_path / "one", apart.models, saved.observations, ids, saved.camera)
    model = pycolmap.Reconstruction(str(tmp_path / "one"))
    assert len(model.images) == 8
    turn = pycolmap.Rotation3d(np.array([0.5, -0.5, 0.5, 0.5]))
    model.transform(pycolmap.Sim3d(0.037, turn, np.array([3.0, -20.0, 7.0])))
    model.write_binary(str(tmp_path / "one"))
    together = calibrate_models(tmp_path / "one", saved)
    assert ([m.group for m in together.models], together.notes) == (["12", "14"], ())
    for group in ("12", "14"):
        assert together.scales[group].mm_per_unit == pytest.approx(1 / 0.037, rel=1e-9)
    for face, pose in together.target.target_from_face.items():
        known = apart.target.target_from_face[face].matrix()
        assert np.allclose(pose.matrix(), known, rtol=0, atol=1e-8), face  # as above: moved, and scaled to mm


def test_points_of_all_groups_and_boards_of_two_groups_merged(saved, tmp_path):
    """In the run's final model the circles of face 1 are seen by both groups, the board of each is its own. The same
    dot merged, but the board was moved between the groups: the point is neither's."""
    path = saved.folder / "colmap/target_model"
    groups = {group.group: group for group in read(path, saved).groups}
    place = {g: dict(zip(m.labels, m.xyz_model.tolist(), strict=True)) for g, m in groups.items()}
    shared = [label for label in place["12"] if label in place["14"]]
    assert {label for label in shared if label.startswith("1:")} == {
        f"1:{c}" for c in saved.target_design.face("1").ids
    }
    for label in shared:
        same = place["12"][label] == place["14"][label]
        assert same != label.startswith("board:"), label
    assert [m.group for m in calibrate_models(path, saved).models] == ["12", "14"]
    target = pycolmap.Reconstruction(str(saved.folder / "colmap/target_model"))
    labels = {image.name: image.labels for image in saved.observations}
    dot = {}
    for point_id, point in target.points3D.items():
        element = point.track.elements[0]
        name = target.image(element.image_id).name
        if labels[name][element.point2D_idx] == "board:3:4":
            dot[name.split("/")[0]] = point_id
    target.merge_points3D(dot["12"], dot["14"])
    (tmp_path / "merged").mkdir()
    target.write_binary(str(tmp_path / "merged"))
    found = read(tmp_path / "merged", saved)
    assert (found.unlabelled, found.split) == (1, 0)
    assert all("board:3:4" not in group.labels and "board:3:5" in group.labels for group in found.groups)


def test_a_group_in_two_models_and_models_with_different_cameras(saved, model, plain, tmp_path):
    """As the mapper writes them: 0, 1, …; the larger one counts."""
    gone = next(iter(model.images.values())).frame_id
    model.deregister_frame(gone)
    model.folder = tmp_path / "sparse" / "0"
    model.folder.parent.mkdir()
    model.as_binary()
    own_copy(saved.folder / "colmap/models" / "12", tmp_path / "sparse" / "1")
    found = calibrate_models(tmp_path / "sparse", saved)
    assert_same_faces(found, plain)
    assert len(found.models[0].images) == 4
    assert found.notes == ("group 12: in several models; the one with the most images was taken", NOT_THERE)
    own_copy(saved.folder / "colmap/models" / "14", tmp_path / "both" / "1")
    model.cameras[1].params = model.cameras[1].params * (1 + 1e-9)
    model.folder = tmp_path / "both" / "0"
    model.as_binary()
    with fails_with("E-MODEL-CAMERAS … both/0"):
        calibrate_models(tmp_path / "both", saved)


def test_intrinsics_refined_elsewhere_are_used_and_said(saved, model, plain):
    """0.1 px more focal length and 0.02 px more of the centre: a little off, and no reason to refuse it."""
    params = np.array(model.cameras[1].params)
    model.cameras[1].params = params + np.array([0.1, 0.1, 0.02, 0.02, *np.zeros(len(params) - 4)])
    path = model.as_binary()
    found = calibrate_models(path, saved)
    note = found.notes[0]
    assert note.startswith(f"model {path}: its camera is up to 0.0")
    assert note.endswith("px off the run's at the keypoints; the model's is used")
    change = float(note.split("up to ")[1].split(" px")[0])
    assert 0.02 < change < 0.1  # the centre's 0.02, and less than the half image's 0.5 of 0.1
    assert found.target.target_from_face.keys() == plain.target.target_from_face.keys()


def keypoint_moved(model):
    image = next(i for i in model.images.values() if i.name == "12/IMG_1003.jpg")
    k = model.labels[image.name].index("2:5")
    image.points2D[k].xy = image.points2D[k].xy + np.array([0.0, 0.3])
    return f"E-MODEL-NOT-OF-RUN … 12/IMG_1003.jpg: keypoint {k} (2:5) … 0.3000 px … 0.002"


def another_image(model):
    image = next(i for i in model.images.values() if i.name == "12/IMG_1003.jpg")
    numbers = {name: len(labels) for name, labels in model.labels.items()}
    image.name = min(n for n, k in numbers.items() if n.startswith("14/") and k != len(image.points2D))
    return "E-MODEL-NOT-OF-RUN … 14/IMG_1003.jpg … 83"


def unknown_lens(model):
    of = {"camera_id": 1, "width": 1296, "height": 864}
    model.cameras[1] = pycolmap.Camera(model="FOV", params=[1393.0, 1393, 648, 432, 0.1], **of)
    return "E-CAMERA-MODEL … FOV"


def another_focal_length(model):
    """A file can be whole and its numbers damaged."""
    model.cameras[1].params = np.array([239.3, *model.cameras[1].params[1:]])
    return "E-MODEL-MISFIT … 12 … 4"


def no_points(model):
    for point in list(model.points3D):
        model.delete_point3D(point)
    return "E-MODEL-EMPTY"


def few_dots(model):
    for point in {i for i, _, x in model.seen() if x.startswith("board:") and (x[-1] > "2" or x[6] > "0")}:
        model.delete_point3D(point)
    return "E-SCALE-FEW-DOTS … group 12 … scale: 3 … 4"


EDITED = keypoint_moved, another_image, unknown_lens, another_focal_length, no_points, few_dots


@pytest.mark.parametrize("edited", EDITED)
def test_a_model_that_is_not_of_the_run_or_lacks_what_scales_it_is_refused(saved, model, edited):
    with fails_with(edited(model)):
        calibrate_models(model.as_binary(), saved)


def test_a_name_with_a_space_in_a_text(saved, model):
    """COLMAP writes it whole and reads it up to the space."""
    renamed = [replace(i, name=f"12/zwei Flächen {k}.jpg") for k, i in enumerate(saved.observations)]
    of = {i.name: j.name for i, j in zip(saved.observations, renamed, strict=True)}
    for image in model.images.values():
        image.name = of[image.name]
    (group,) = read_model(model.as_binary(), renamed, image_ids(renamed), saved.corrected_px).groups
    assert group.images[2] == "12/zwei Flächen 2.jpg"
    model.folder = model.folder.with_name("text")
    with fails_with("E-MODEL-NOT-OF-RUN … 12/zwei … spaces"):
        read_model(model.as_text(), renamed, image_ids(renamed), saved.corrected_px)


@pytest.mark.parametrize(
    ("name", "places", "words"),
    [("points3D", [1], ["1e300"]), ("frames", [6], ["nan"]), ("frames", range(2, 6), "0000")],
)
def test_points_and_poses_that_are_no_places(saved, model, name, places, words):
    path = model.as_text() / f"{name}.txt"
    *lines, last = path.read_text().splitlines(keepends=True)
    cells = last.split(" ")
    for place, word in zip(places, words, strict=True):
        cells[place] = word
    path.write_text("".join([*lines, " ".join(cells)]))
    with pytest.raises(InputError, match=f"model {path.parent}: "):
        read(path.parent, saved)


READ_ALL = """
import json, resource, sys, time
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from stcal.errors import InputError
from stcal.sfm.mapping.models import open_model
for folder in json.load(sys.stdin):
    start = time.process_time()
    try:
        open_model(folder)
        said = "read"
    except InputError as error:
        said = str(error)
    print(json.dumps([folder, said, time.process_time() - start]), flush=True)
"""


@pytest.mark.slow
def test_damaged_files_neither_crash_nor_hang_nor_eat_memory(saved, tmp_path):
    """Each file cut at its start, its end and at random places, and with counts of up to 2⁶⁴, of its records or inside
    of one: pycolmap alone reads on behind the end, for hours or into all memory. In a process of its own, with a limit
    on both."""
    source, rng, cases = saved.folder / "colmap/models" / "12", random.Random(1), []
    for name in FILES:
        data = (source / f"{name}.bin").read_bytes()
        cuts = [0, 1, 8, len(data) - 1, *(rng.randrange(8, len(data)) for _ in range(8))]
        spoilt = [data[:cut] for cut in cuts] + [data + b"\0", data + data]
        spoilt += [n.to_bytes(8, "little") + data[8:] for n in (0, 2, 2**31, 2**40, 2**64 - 1)]
        at = {"points3D": 8 + 43, "images": 8 + 64 + len("12/IMG_1000.jpg\0")}.get(name)  # its track, its keypoints
        if at is not None:
            spoilt.append(data[: at + 5] + b"\1" + data[at + 6 :])
        for i, content in enumerate(spoilt):
            if content == data:
                continue
            folder = tmp_path / f"{name}{i}"
            own_copy(source, folder)
            (folder / f"{name}.bin").write_bytes(content)
            cases.append((str(folder), name, i == len(cuts) + 2 + 5))
    command, folders = [sys.executable, "-c", READ_ALL], json.dumps([folder for folder, *_ in cases])
    done = subprocess.run(command, input=folders, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(cases) > 80
    for (folder, name, is_inside), (_, said, seconds) in zip(cases, answers, strict=True):
        assert said.startswith(f"model {folder}: damaged or incomplete ({name}.bin"), said
        assert said.endswith("; write or copy it again")
        assert "ends too soon" in said or not is_inside, said
        assert seconds < 5, said


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_another_one_or_missing(saved, plain, tmp_path, name):
    for other in set(FILES) - {name}:
        folder = own_copy(saved.folder / "colmap/models" / "12", tmp_path / other)
        shutil.copy(folder / f"{other}.bin", folder / f"{name}.bin")
        with pytest.raises(InputError, match=rf"damaged or incomplete \({name}.bin"):
            open_model(folder)
    folder = own_copy(saved.folder / "colmap/models" / "12", tmp_path / "missing")
    if name in ("rigs", "frames"):  # as native 3.8 writes them: three files
        for each in ("rigs", "frames"):
            (folder / f"{each}.bin").unlink()
        assert_same_faces(calibrate_models(folder, saved), plain)
    else:
        (folder / f"{name}.bin").unlink()
        with pytest.raises(InputError, match="damaged or incomplete" if name != "images" else "no COLMAP model"):
            calibrate_models(folder, saved)


def test_a_model_without_a_camera_and_one_without_the_group_of_the_reference_face(saved, stcal_sfm, tmp_path):
    """Group 14 alone has no face 2; group 12 is missing and named."""
    pycolmap.Reconstruction().write_binary(str(tmp_path))
    assert_error(stcal_sfm("faces", tmp_path, "--run", saved.folder), INPUT, "E-MODEL-CAMERAS", "0")
    options = replace(saved.options, reference_face="2")
    only = read(saved.folder / "colmap/models" / "14", saved)
    with fails_with("E-FACE-REFERENCE … 2"):
        faces_from_models([only], replace(saved, options=options))


FULL_DISK = """
import resource, sys
from pathlib import Path
import pycolmap
from stcal.errors import InputError
from stcal.sfm.mapping.models import write_reconstruction
reconstruction = pycolmap.Reconstruction(sys.argv[1])
for place in map(Path, sys.argv[2:]):
    kind, limit = place.name.split("-")
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.RLIM_INFINITY))
    try:
        write_reconstruction(reconstruction, place, text=kind == "text")
        print(place.name, "written")
    except InputError as error:
        print(place.name, error)
"""


@pytest.mark.slow
def test_a_model_that_the_disk_does_not_take_is_said(small_run, tmp_path):
    """No file may grow beyond a limit: COLMAP's writers go on without a word."""
    places = [tmp_path / f"{kind}-{limit}" for kind in ("binary", "text") for limit in (1000, 10_000_000)]
    for place in places:
        place.mkdir()
    command = [sys.executable, "-c", FULL_DISK, small_run / "colmap/target_model", *places]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    for place, line in zip(places, done.stdout.splitlines(), strict=True):
        expected = (
            "differ from what was written; check the folder's space" if place.name.endswith("-1000") else "written"
        )
        assert line.startswith(place.name)
        assert expected in line


@pytest.mark.parametrize("fault", ["no empty lines", "no last line", "two cells"])
def test_images_without_their_second_lines_are_named(tmp_path, fault):
    """COLMAP passes over every other image without a word, or tells a place in its own source."""
    a, b = (f"{i} 1 0 0 0 0 0 {i} 1 {i}.jpg\n" for i in (1, 2))
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "points3D.txt").write_text("")
    (tmp_path / "images.txt").write_text(f"{a}\n{b}\n")
    assert len(open_model(tmp_path).images) == 2
    text = {"no empty lines": a + b, "no last line": f"{a}\n{b}", "two cells": f"{a}1 2\n{b}\n"}[fault]
    (tmp_path / "images.txt").write_text(text)
    with fails_with("E-MODEL-UNREADABLE … images.txt … line") as caught:
        open_model(tmp_path)
    assert "Check failed" not in str(caught.value)
