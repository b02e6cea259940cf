"""One arrangement of faces and board in all images of a group: the board's numbering, and what does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.design import reference_target
from stcal.sfm.data.model import Centres
from stcal.sfm.detect.labels import label_groups
from stcal.sfm.detect.sightings import BoardSighting, FaceSighting, ImageDetection

FOCAL_PX = 5000.0


@pytest.fixture(scope="module")
def group(scene, labels_only):
    return [o for o in labels_only.observations(scene, 0.003, np.random.default_rng(0)) if o.group == "12"]


def detection(image, turn=False, certain=False, shift=None, faces=True):
    """What detection hands over for one image: the plain board in both numberings, in either order."""
    target = [i for i, label in enumerate(image.labels) if not label.startswith("board:")] if faces else []
    dots = [i for i, label in enumerate(image.labels) if label.startswith("board:")]
    keep = [*target, *dots]
    n = len(keep)
    centres = Centres(
        image.centre_px[keep],
        image.centre[keep],
        image.shape[keep],
        image.covariance_px2[keep],
        np.ones(n),
        np.ones(n),
        np.ones(n),
        np.ones(n),
        np.zeros((n, 2)),
        np.ones(n, bool),
    )
    cells = np.array([[int(v) for v in image.labels[i].split(":")[1:]] for i in dots])
    numberings = [cells, [6, 8] - cells]
    if shift is not None:
        numberings += [cells + shift, [6, 8] - cells - shift]
    if turn:
        numberings = numberings[::-1]
    if certain:
        numberings = numberings[:1]
    board = BoardSighting(np.arange(len(target), n), np.stack(numberings))
    return ImageDetection(centres, sightings([image.labels[i] for i in target]), (board,) * bool(len(dots)))


def sightings(labels):
    """Of circles that are named face by face."""
    found = []
    for face_id in dict.fromkeys(label.split(":")[0] for label in labels):
        rows = [i for i, label in enumerate(labels) if label.split(":")[0] == face_id]
        circles = [reference_target().face(face_id).ids.index(labels[i].split(":")[1]) for i in rows]
        found.append(FaceSighting(face_id, np.array(rows), np.array(circles)))
    return tuple(found)


def labelled(scene, detections):
    named = [(f"12/{i}", "12", d) for i, d in enumerate(detections)]
    return label_groups([named], scene.target, scene.board, FOCAL_PX)[0][0]


def is_truth(image, result, turned):
    """Whether the result's board labels are the truth's, after half a turn or not."""
    truth = dict(zip(image.labels, map(tuple, image.centre_px), strict=True))
    for label, centre in zip(result.observations.labels, result.observations.centre_px, strict=True):
        if label.startswith("board:"):
            row, column = (int(v) for v in label.split(":")[1:])
            if truth[f"board:{6 - row}:{8 - column}" if turned else label] != tuple(centre):
                return False
    return True


@pytest.mark.parametrize("seed", range(4))
def test_all_images_agree_on_one_numbering(scene, group, seed):
    turns = np.random.default_rng(seed).integers(0, 2, len(group)).astype(bool)
    results = labelled(scene, [detection(o, turn) for o, turn in zip(group, turns, strict=True)])
    assert all(len(r.observations) == len(o) for r, o in zip(results, group, strict=True))
    assert all(is_truth(o, r, turns[0]) for o, r in zip(group, results, strict=True))


def test_a_certain_image_speaks_for_the_group(scene, group):
    detections = [detection(o, turn=True) for o in group]
    detections[3] = detection(group[3], certain=True)
    results = labelled(scene, detections)
    assert all(is_truth(o, r, turned=False) for o, r in zip(group, results, strict=True))


def test_a_numbering_shifted_by_a_column_is_seen_through(scene, group):
    detections = [detection(o) for o in group]
    detections[2] = detection(group[2], turn=True, shift=np.array([0, 1]))
    results = labelled(scene, detections)
    assert all(is_truth(o, r, turned=False) for o, r in zip(group, results, strict=True))


def test_an_image_without_a_face_keeps_no_uncertain_board(scene, group):
    detections = [detection(o) for o in group]
    detections[1] = detection(group[1], faces=False)
    results = labelled(scene, detections)
    assert len(results[1].observations) == 0
    assert any("left out: 2 numberings fit" in note for note in results[1].notes)


def test_a_target_that_was_moved_within_the_group_loses_the_board(scene, group):
    """The third image shows the faces where a target turned by 20° about its own axis would be."""
    other = group[2]
    face = [i for i, label in enumerate(other.labels) if not label.startswith("board:")]
    moved = other.centre.copy()
    moved[face] = (moved[face] - moved[face].mean(0)) * 0.8 + moved[face].mean(0)
    detections = [detection(o) for o in group]
    detections[2] = detection(replace(other, centre=moved))
    results = labelled(scene, detections)
    assert not any(label.startswith("board:") for label in results[2].observations.labels)
    assert any("was moved" in note for note in results[2].notes)


def test_without_a_board_the_target_is_labelled_all_the_same(scene, group):
    ((results, _),) = label_groups([[("12/0", "12", detection(group[0]))]], scene.target, None, FOCAL_PX)
    assert {label.split(":")[0] for label in results[0].observations.labels} == {"1", "2"}
