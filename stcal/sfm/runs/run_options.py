"""Options of a run."""

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

from stcal.design import TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.io.toml import LEAST
from stcal.sfm.adjust.calibration import FLATNESS_MM, AdjustOptions, Solve
from stcal.sfm.adjust.faces import FrameKind
from stcal.sfm.data.as_drawn import faces_in_name
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.mapping.pairs import PairOptions

Compare = Literal["paper"]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of a run; some defaults depend on other options.

    Parameters
    ----------
    solve : {"joint", "chain", "paper"}, optional
        One adjustment over all groups; or group by group; or Zhang & Wei (2017) as published, from detection on, which
        also decides ``frame`` and ``eccentricity``. If None, ``joint``, or ``chain`` for the uncorrected control.
    frame : {"plane", "three-point"}, optional
        Frame of a face: Z from the plane of all its circles, or as in Zhang & Wei (2017). If None, ``plane``, or
        ``three-point`` for the uncorrected control.
    eccentricity : bool
        Whether it is corrected; if not, the run is the uncorrected control.
    reference_face : str, optional
        Id of the face whose frame is the target frame; the first face of the design if None.
    pairs : PairOptions
        Options of the initial pair.
    ellipses : EllipseOptions
        Options of detection.
    workers : int, optional
        Number of processes; one per core if None.
    flatness_mm : float, optional
        σ of a circle about the plane of its face, mm; None if it is unknown.
    refine_camera : bool
        Whether to adjust the intrinsics, with the given ones as observations.
    rim : bool, optional
        Whether to estimate the height of a rim in front of the faces' circles, and to give the faces of their luminous
        surface; if None, where the radii show a rim for certain and the design states none.
    board_only : bool
        Whether the board alone was photographed, so that λ and its residuals are the result. If False, the images tell.
    compare : {"paper"}, optional
        Also solve the same photographs as published, and step by step from there, for the report.
    exclude : tuple of str
        Images that are not used, by their names in results, such as ``12/IMG_1003.jpg``.
    expect_faces : tuple of str
        Faces that the photographs were to show: the command ends with 4 where one is missing. If empty, the names of
        the groups tell, where all of them are made of ids of faces, such as ``12`` or ``front-right``.

    Raises
    ------
    InputError
        A choice that does not exist.
    """

    solve: Solve | None = None
    frame: FrameKind | None = None
    eccentricity: bool = True
    reference_face: str | None = None
    pairs: PairOptions = field(default_factory=PairOptions)
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None
    flatness_mm: float | None = FLATNESS_MM
    refine_camera: bool = False
    rim: bool | None = None
    board_only: bool = False
    compare: Compare | None = None
    exclude: tuple[str, ...] = ()
    expect_faces: tuple[str, ...] = ()

    def __post_init__(self):
        require_fields(self, "options", workers=1, flatness_mm=LEAST)

    def adjustment(self, target: TargetDesign) -> AdjustOptions:
        """Returns the options of the adjustment, with every default decided. Raises InputError: no such choice."""
        eccentricity = self.eccentricity and self.solve != "paper"
        return AdjustOptions(
            target.face(self.reference_face or target.faces[0].id).id,
            self.solve or ("joint" if eccentricity else "chain"),
            self.frame or ("plane" if eccentricity else "three-point"),
            eccentricity,
            self.flatness_mm,
            self.refine_camera,
        )

    def settled(self, target: TargetDesign) -> "RunOptions":
        """Returns the same options with every default decided. Raises InputError: no such choice."""
        for face in self.expect_faces:
            target.face(face)
        settled = replace(self, **asdict(self.adjustment(target)))
        if settled.solve != "joint" and (self.rim or any(target.rim_of().values())):
            raise InputError(
                "E-RIM-SOLVE",
                f"--solve {settled.solve} with {'--rim' if self.rim else 'rim_mm of the target'}: only the joint "
                "adjustment corrects rims; use --solve joint, or leave the rims out",
            )
        return settled

    def faces_expected(self, groups: Iterable[str], target: TargetDesign) -> list[str]:
        """Returns the faces that the photographs of all ``groups``, also of lost ones, were to show."""
        if self.board_only:
            return []
        ids = [face.id for face in target.faces]
        if self.expect_faces:
            return [face for face in ids if face in self.expect_faces]
        groups = list(groups)
        named = [faces_in_name(name, [*ids, *unknown_faces(groups, target)]) for name in groups]
        return [face for face in ids if all(named) and any(face in faces for faces in named)]


def unknown_faces(groups: Iterable[str], target: TargetDesign) -> dict[str, str]:
    """Returns what seem to be faces that the target lacks, with their group: beside a face in a name of two words, if
    another group is named after two faces."""
    ids, groups = [face.id for face in target.faces], list(groups)
    found: dict[str, str] = {}
    for group in groups if any(faces_in_name(name, ids) for name in groups) else ():
        words = re.split("[-_+ ]", group)
        parts = words if len(words) > 1 else list(group)
        match [part for part in parts if part not in ids]:
            case [other] if len(parts) == 2 and not faces_in_name(other, ids):
                found.setdefault(other, group)
    return found
