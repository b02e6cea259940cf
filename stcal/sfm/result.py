"""What a run is asked for, and what it answers."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError
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

Solve = Literal["joint", "chain"]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What to do.

    ``solve`` : ``joint`` (one adjustment over all groups) or ``chain`` (as in Zhang & Wei (2017), group by group);
    ``frame`` : ``plane`` (Z from the plane of all circles of a face) or ``three-point`` (as in Zhang & Wei (2017));
    ``eccentricity`` : off for the uncorrected control, which then is chained with three-point frames as in the
    document unless the two are given; ``reference_face`` : the design's first one where None; ``workers`` :
    processes, one per core where None.
    """

    solve: Solve | None = None
    frame: FrameKind | None = None
    eccentricity: bool = True
    reference_face: str | None = None
    pairs: PairOptions = field(default_factory=PairOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None

    def settled(self, target: TargetDesign) -> "RunOptions":
        """The same options with every default decided.

        Raises
        ------
        InputError
            A choice that does not exist.
        """
        chosen = replace(
            self,
            solve=self.solve or ("joint" if self.eccentricity else "chain"),
            frame=self.frame or ("plane" if self.eccentricity else "three-point"),
            reference_face=target.face(self.reference_face or target.faces[0].id).id,
        )
        for what, value, choices in (
            ("solve", chosen.solve, get_args(Solve)),
            ("frame", chosen.frame, get_args(FrameKind)),
        ):
            if value not in choices:
                raise InputError(f"{what} {value!r}: not a choice; use {' or '.join(choices)}")
        return chosen


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
