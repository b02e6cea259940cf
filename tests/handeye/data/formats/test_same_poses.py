"""The same poses, written in each format, are read as the same poses; other formats are refused."""

from pathlib import Path

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.handeye.data.record import Said
from stcal.workflows.handeye_inputs import Files, one_source, read_robot_poses
from tests.handeye.written import FORMATS, REFUSED
from tests.support.handeye import simulated

PAIRS = simulated(np.random.default_rng(5), 7).pairs
ROUNDING = 1e-9
"""rad and mm: rotations go through quaternions and angles, lengths of a metre through metres."""


def read(arguments, path=None):
    options = {"--rotation": [], "--length-unit": [], "--poses-are": [], "--a": [], "--b": []}
    own = list(arguments)
    source = own.pop(0) if not own[0].startswith("--") else None
    for name, value in zip(own[::2], own[1::2], strict=True):
        options[name].append(value)
    said = Said.of_options(options["--rotation"], options["--length-unit"], options["--poses-are"])
    if source is not None:
        return Files(Path(source), statements=said).read()
    told, _ = one_source(Path(options["--a"][0]), Path(options["--b"][0]), "image", said)
    return Files(told, statements=said).read()


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_poses(name, tmp_path):
    found = read(FORMATS[name](tmp_path, PAIRS))
    for wanted, got in (
        (PAIRS.base_from_flange, found.pairs.base_from_flange),
        (PAIRS.camera_from_board, found.pairs.camera_from_board),
    ):
        assert np.abs(got.difference(wanted)).max() < ROUNDING
    assert len(found.understood) >= 2
    assert found.left_out == ()


@pytest.mark.parametrize("name", REFUSED)
def test_other_formats_are_refused_in_a_line(name, tmp_path):
    """As the robot's poses beside images, as one of two files, and as pairs."""
    path = tmp_path / "poses"
    path.write_text(REFUSED[name])
    np.save(tmp_path / "b.npy", np.array([pose.matrix() for pose in PAIRS.camera_from_board])[:1])
    for call in (
        lambda: read_robot_poses(path),
        lambda: one_source(path, tmp_path / "b.npy", "image", Said(rotation="rotvec-rad", length_unit="m")),
        Files(path).read,
    ):
        with pytest.raises(InputError) as caught:
            call()
        message = str(caught.value)
        assert "\n" not in message
        assert str(path) in message
