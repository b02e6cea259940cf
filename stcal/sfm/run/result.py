"""What a run answers."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.io.camera import CalibratedCamera, CameraPrior
from stcal.sfm.adjust.calibration import Calibration
from stcal.sfm.adjust.chain import FaceChain
from stcal.sfm.checks.suite import Evidence
from stcal.sfm.checks.verdict import Check
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.detect.files import DetectionResult
from stcal.sfm.detect.labels import LabelledImage
from stcal.sfm.mapping.graph import ImageGraph
from stcal.sfm.run.options import RunOptions
from stcal.sfm.run.solve import GroupSolution


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """Everything a run found; ``calibration.target`` is the answer, ``camera`` the file's."""

    out: Path
    camera: CalibratedCamera
    target_design: TargetDesign
    board_design: BoardDesign
    options: RunOptions
    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    graph: ImageGraph
    solutions: tuple[GroupSolution, ...]
    calibration: Calibration
    chains: dict[str, tuple[FaceChain, ...]]
    notes: tuple[str, ...]
    checks: tuple[Check, ...] = ()

    @property
    def target(self):
        """The calibrated target."""
        return self.calibration.target

    def observations(self) -> list[ImageObservations]:
        """Labelled centres of all images, in the database's order."""
        return [each.observations for each in self.labelled]

    def evidence(self, prior: CameraPrior) -> Evidence:
        """What the checks look at; ``prior`` : of the intrinsics, where they were refined."""
        blur = {i.file.name: i.detection.centres.blur_px for i in self.detection.images}
        return Evidence(
            models=tuple(s.model for s in self.solutions),
            outliers=tuple(o for s in self.solutions for o in s.outliers),
            images=tuple(self.observations()),
            camera=self.camera,
            target=self.target_design,
            board=self.board_design,
            options=self.options.adjustment(self.target_design),
            calibration=self.calibration,
            prior=prior if self.options.refine_camera else None,
            blur_px={name: float(np.median(each)) for name, each in blur.items() if len(each)},
        )
