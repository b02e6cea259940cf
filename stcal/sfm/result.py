"""What a run is asked for, and what it answers."""

from dataclasses import dataclass, field
from pathlib import Path

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.camera import Camera
from stcal.sfm.chain import CalibratedTarget, Chain
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.detection import DetectionResult
from stcal.sfm.faces import FaceInGroup, FrameKind
from stcal.sfm.joint import JointResult
from stcal.sfm.labels import LabelledImage
from stcal.sfm.metric import Scale
from stcal.sfm.observations import ImageObservations
from stcal.sfm.pairs import PairOptions
from stcal.sfm.solve import GroupSolution


@dataclass(frozen=True, slots=True)
class RunOptions:
    """``solve`` : ``joint`` (one adjustment over all groups) or ``chain`` (as in document 000, group by group);
    ``frame`` : Z from the plane of all circles, or frames from three points; ``eccentricity`` : off for the uncorrected
    control; ``reference_face`` : the design's first one where None; ``workers`` : processes, one per core where None.
    """

    solve: str = "joint"
    frame: FrameKind = "plane"
    eccentricity: bool = True
    reference_face: str | None = None
    pairs: PairOptions = field(default_factory=PairOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """Everything a run found; ``target`` is the answer."""

    out: Path
    camera: Camera
    colmap_model: str
    target_design: TargetDesign
    board_design: BoardDesign
    options: RunOptions
    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    solutions: tuple[GroupSolution, ...]
    scales: dict[str, Scale]
    faces: tuple[FaceInGroup, ...]
    target: CalibratedTarget
    chains: dict[str, tuple[Chain, ...]]
    joint: JointResult | None
    sigma_factor: float
    notes: tuple[str, ...]

    def observations(self) -> list[ImageObservations]:
        """Labelled centres of all images, in the database's order."""
        return [each.observations for each in self.labelled]
