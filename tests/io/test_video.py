"""Frames of a video: sharp ones that differ in their view, and a run on them."""

import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stcal.errors import InputNote
from stcal.geometry.rigid import Rigid
from stcal.io.device import AUTO, MOVED, chosen_frames, sharpness, write_frames
from stcal.io.files import json_text
from stcal.io.images import find_images
from stcal.sfm import pipeline
from stcal.sfm.report.compare import compare
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.body_scene import BodyOptions, body_camera, make_body_scene, render_body
from stcal.synthetic.dataset import TruthFile
from stcal.synthetic.designs import tag_cube
from tests.outcome import refuses

WIDTH, STEP_PX = 480, 5
PER_VIEW = int(np.ceil(MOVED * WIDTH / STEP_PX))
"""Frames in which a picture that moves evenly by STEP_PX becomes another view."""


def moving(count: int, blurred=()) -> list[np.ndarray]:
    """A random picture that moves evenly past the camera; ``blurred`` : frames that are smeared along the rows."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (320, WIDTH + count * STEP_PX)).astype(np.float32), (0, 0), 1.0)
    frames = []
    for k in range(count):
        frame = wide[:, k * STEP_PX : k * STEP_PX + WIDTH]
        frames.append((cv2.blur(frame, (9, 1)) if k in blurred else frame).clip(0, 255).astype(np.uint8))
    return frames


def clip_of(frames: list[np.ndarray], path: Path) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, frames[0].shape[::-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_smear_in_any_direction_is_less_sharp_and_a_picture_at_rest_is_one_view():
    sharp = moving(1)[0]
    for size in ((7, 1), (1, 7), (3, 3)):
        assert sharpness(cv2.blur(sharp, size)) < 0.7 * sharpness(sharp)
    assert sharpness(sharp // 2) == pytest.approx(sharpness(sharp), rel=0.05)  # brightness does not count
    assert sharpness(np.zeros((40, 40), np.uint8)) == 0
    still = moving(1)[0]
    rng = np.random.default_rng(1)
    noisy = [np.clip(still + rng.normal(0, 3, still.shape), 0, 255).astype(np.uint8) for _ in range(20)]
    assert len(list(chosen_frames(iter(noisy), AUTO))) == 1
    numbers = [frame.number for frame in chosen_frames(iter(moving(20, {0, 2, 3, 4, 7})), 5)]
    assert numbers[0] == 1
    assert [number // 5 for number in numbers] == [0, 1, 2, 3]


@pytest.mark.slow
def test_frames_are_sharp_and_apart_and_replace_earlier_ones(tmp_path):
    count, blurred = 40, set(range(0, 40, 3))
    numbers = [frame.number for frame in chosen_frames(iter(moving(count, blurred)), AUTO)]
    assert not blurred & set(numbers)
    assert (np.diff(numbers) >= PER_VIEW / 2).all()
    assert 0.5 * count / PER_VIEW < len(numbers) <= np.ceil(count / PER_VIEW) + 1
    video = clip_of(moving(40), tmp_path / "clip.mp4")
    with pytest.warns(InputNote, match=r"clip.mp4: \d+ frames chosen.*rolling shutter"):
        first = write_frames(video, tmp_path / "frames", 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputNote)
        second = write_frames(video, tmp_path / "frames", 10)
    assert (len(first), len(second)) == (10, 4)
    assert [file.path for file in find_images(tmp_path / "frames")[0]] == second


@pytest.mark.parametrize(
    ("every", "error"),
    [
        ("often", "E-OPTION-VALUE … --every often"),
        ("0", "E-OPTION-VALUE … --every 0"),
        ("30", "E-VIDEO-VIEWS … clip.mp4 … 1 … 3"),
    ],
)
def test_mistakes_are_named(tmp_path, every, error):
    refuses(error, write_frames, clip_of(moving(20), tmp_path / "clip.mp4"), tmp_path / "frames", every)


def test_what_is_no_video_is_refused_and_touches_no_folder_of_others(tmp_path):
    video, other = tmp_path / "clip.mp4", tmp_path / "other"
    video.write_bytes(b"no video")
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    for source, out, every, error in (
        (video, tmp_path / "run", None, "E-VIDEO-UNREADABLE … clip.mp4"),
        (video, other, None, "E-OUTPUT-EXISTS … other"),
        (tmp_path, tmp_path / "run", AUTO, "E-OPTION-VALUE … --every auto"),
    ):
        refuses(error, pipeline.run, source, None, out, tag_cube(60), every=every)
    assert [path.name for path in other.iterdir()] == ["mine.txt"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::stcal.errors.InputNote")
def test_a_cube_that_turns_before_a_camera_is_calibrated(tmp_path):
    """A cube that turns from one of eight poses to the next in six frames each; every third frame is smeared."""
    count = 8
    scene = make_body_scene(tag_cube(60), body_camera(576), BodyOptions(images=count, distance_mm=300, seed=2))
    in_view = {face.id for k in range(count) for face in scene.faces_in_view(k)}
    assert in_view == {face.id for face in scene.target.faces}
    turns = Rotation.from_matrix([pose.rotation for pose in scene.camera_from_target])
    places, at = np.array([pose.translation for pose in scene.camera_from_target]), np.arange(6 * count - 5) / 6
    between = Slerp(np.arange(count), turns)(at).as_matrix()
    shifts = np.stack([np.interp(at, np.arange(count), place) for place in places.T], axis=1)
    poses = [Rigid(turn, shift) for turn, shift in zip(between, shifts, strict=True)]
    moving_scene, drawings = replace(scene, camera_from_target=tuple(poses)), scene.drawings()
    frames = [render_body(moving_scene, k, drawings) for k in range(len(poses))]
    frames = [cv2.blur(frame, (9, 1)) if k % 3 == 0 else frame for k, frame in enumerate(frames)]
    video, truth = clip_of(frames, tmp_path / "clip.mp4"), TruthFile.of(replace(scene, camera_from_target=()))
    (tmp_path / "truth.json").write_text(json_text(truth), encoding="utf-8")
    result = pipeline.run(video, scene.camera, tmp_path / "run", scene.target, options=RunOptions(workers=1))
    numbers = [int(path.stem[-6:]) for path in sorted((tmp_path / "run/.stcal/cache/frames").iterdir())]
    assert 15 < len(numbers) < len(frames)
    assert all(number % 3 for number in numbers)
    assert len(result.target.target_from_face) == 6
    assert truth.reference_face == result.target.reference_face
    errors = compare(tmp_path / "run", tmp_path / "truth.json").faces.values()
    assert max(face.translation_um for face in errors) < 300  # 0.1 px of compression at 300 mm are 40 µm
    assert max(face.rotation_mdeg for face in errors) < 300
