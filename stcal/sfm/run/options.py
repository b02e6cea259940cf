"""What a run is asked for."""

from dataclasses import asdict, dataclass, field, replace

from stcal.design import TargetDesign
from stcal.sfm.adjust.faces import FrameKind
from stcal.sfm.adjust.options import AdjustOptions, Solve
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.mapping.graph import GraphKind
from stcal.sfm.mapping.pairs import PairOptions


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What to do, the defaults of which some depend on others.

    ``solve``, ``frame``, ``eccentricity``, ``reference_face``, ``flatness_mm``, ``refine_camera`` : see
    :class:`~stcal.sfm.adjust.options.AdjustOptions`; where None, ``solve`` is ``joint`` and ``frame`` is ``plane``, but
    for the uncorrected control, which is chained with three-point frames as in Zhang & Wei (2017), and
    ``reference_face`` is the design's first one; ``graph`` : which pairs of images are matched, see
    :func:`stcal.sfm.mapping.graph.image_graph`; ``workers`` : processes, one per core where None.
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

    def adjustment(self, target: TargetDesign) -> AdjustOptions:
        """What of it the adjustment is asked for, decided.

        Raises
        ------
        InputError
            A choice that does not exist.
        """
        return AdjustOptions(
            target.face(self.reference_face or target.faces[0].id).id,
            self.solve or ("joint" if self.eccentricity else "chain"),
            self.frame or ("plane" if self.eccentricity else "three-point"),
            self.eccentricity,
            self.flatness_mm,
            self.refine_camera,
        )

    def settled(self, target: TargetDesign) -> "RunOptions":
        """The same options with every default decided.

        Raises
        ------
        InputError
            A choice that does not exist.
        """
        return replace(self, **asdict(self.adjustment(target)))
