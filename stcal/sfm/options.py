"""What a run is asked for."""

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from stcal.design import TargetDesign
from stcal.errors import InputError
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.faces import FrameKind
from stcal.sfm.graph import GraphKind
from stcal.sfm.pairs import PairOptions

Solve = Literal["joint", "chain"]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What to do.

    ``solve`` : ``joint`` (one adjustment over all groups) or ``chain`` (as in Zhang & Wei (2017), group by group);
    ``frame`` : ``plane`` (Z from the plane of all circles of a face) or ``three-point`` (as in Zhang & Wei (2017));
    ``eccentricity`` : off for the uncorrected control, which then is chained with three-point frames as in the
    document unless the two are given; ``reference_face`` : the design's first one where None; ``flatness_mm`` : σ of a
    circle about the plane of its face, None for no such knowledge; ``refine_camera`` : adjust the intrinsics, the
    given ones being observations; ``graph`` : which pairs of images are matched, see
    :func:`stcal.sfm.graph.image_graph`; ``workers`` : processes, one per core where None.
    """

    solve: Solve | None = None
    frame: FrameKind | None = None
    eccentricity: bool = True
    reference_face: str | None = None
    graph: GraphKind | None = None
    pairs: PairOptions = field(default_factory=PairOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None
    flatness_mm: float | None = 0.02
    refine_camera: bool = False

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
        if chosen.refine_camera and chosen.solve != "joint":
            raise InputError("--refine-camera: part of the joint adjustment, the solve is chain; use --solve joint")
        return chosen
