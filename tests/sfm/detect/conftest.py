"""Photographs of a group of the sample, read once, degraded, detected and labelled, what was found judged by their
truth; and what a group of images shows, without pixels."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from stcal.design import reference_board, reference_target
from stcal.io.cameras.read import read_camera
from stcal.io.images import find_images
from stcal.sfm.data.group_model import detections_csv
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import detect_files
from stcal.sfm.detect.labelling import LabelledImage, label_images
from tests.scripts import load_script
from tests.support.degrade import Photograph, RenderedSet, read_set

study = load_script("envelope_study")
KINDS = study.KINDS
Make = Callable[[Photograph, float, object], object]


@dataclass(frozen=True)
class Outcome:
    """``images`` : what was labelled, by name without suffix; ``pictures`` : what was done to them; ``counts`` :
    circles ``found`` of those that ``must`` be, ``dots`` of ``must_dots``, and ``wrong`` ones with ``examples``."""

    images: dict[str, LabelledImage]
    pictures: dict[str, object]
    counts: dict

    def labels(self, name: str, plane: str = "") -> set[str]:
        return {label for label in self.images[name].observations.labels if plane in ("", label.plane)}

    def notes(self) -> str:
        return "\n".join(note for image in self.images.values() for note in image.notes)

    def assert_all_found(self, share: float = 1.0) -> None:
        """None wrong; of all circles and dots that must be found this share at least."""
        assert self.counts["wrong"] == 0, self.counts["examples"]
        assert self.counts["must"] >= 10
        assert self.counts["found"] >= share * self.counts["must"], self.counts
        assert self.counts["dots"] >= share * self.counts["must_dots"], self.counts


class Bench:
    """Detection and labels of degraded groups; what was detected in the same pixels is kept."""

    def __init__(self, data: RenderedSet, folder: Path):
        self.data, self.folder = data, folder

    def groups(self, *names: str) -> RenderedSet:
        own = {name: self.data.truth["groups"][name] for name in names}
        photographs = tuple(p for p in self.data.photographs if p.group in names)
        return replace(self.data, truth=self.data.truth | {"groups": own}, photographs=photographs)

    def label(self, make: Make | str, value: float = 0.0, *groups: str) -> Outcome:
        """Degrade by a function of (photograph, value, case), or by a kind of the study of the envelope, and label;
        group 12 where no others are named."""
        data = self.groups(*groups or ("12",))
        kind = KINDS[make] if isinstance(make, str) else study.Kind("own", "", (value,), make)
        folder = self.folder / "set"
        shutil.rmtree(folder, ignore_errors=True)
        pictures = study.write_case(kind, study.Case(data, kind.name, value), folder)
        files, camera = find_images(folder / "images")[0], read_camera(folder / "cameras.txt")
        designs, options = (reference_target(), reference_board()), EllipseOptions()
        detection = detect_files(files, camera, *designs, options, self.folder / "cache", 1)
        assert not detection.skipped
        labelled = label_images(detection, *designs, options, self.folder / "cache", 1)
        (folder / "detections.csv").write_text(detections_csv([each.observations for each in labelled]))
        images = {each.observations.name.rpartition(".")[0]: each for each in labelled}
        return Outcome(images, pictures, study.judge_labels(data, pictures, folder))


@pytest.fixture(scope="module")
def group(scene, labels_only):
    """Observations of group 12, to 0.003 px."""
    return [o for o in labels_only.observations(scene, 0.003, np.random.default_rng(0)) if o.group == "12"]


@pytest.fixture(scope="session")
def bench(sample, tmp_path_factory) -> Bench:
    """Degrades, detects and labels groups of the sample."""
    return Bench(read_set(sample), tmp_path_factory.mktemp("bench"))
