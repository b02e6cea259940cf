"""Options of a run."""

import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.boards.board_designs import CornerBoard
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, InputNote
from stcal.geometry.arrays import require_fields
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.toml import LEAST
from stcal.sfm.adjust.calibration import FLATNESS_MM, AdjustOptions, Solve
from stcal.sfm.adjust.chain import FrameKind
from stcal.sfm.data.group_model import faces_in_name
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.mapping.pairs import PairOptions

Compare = Literal["paper"]
VAGUE = 0.01  # relative σ of a camera file's focal length above which the boards tell it better


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of a run; some defaults depend on other options.

    Parameters
    ----------
    solve : One adjustment over all groups; or group by group; or Zhang & Wei (2017) as published, from detection on,
        which also decides ``frame`` and ``eccentricity``. If None, ``joint``, or ``chain`` for the uncorrected control.
    frame : Frame of a face: Z from the plane of all its circles, or as in Zhang & Wei (2017). If None, ``plane``, or
        ``three-point`` for the uncorrected control.
    eccentricity : Whether it is corrected; if not, the run is the uncorrected control.
    reference_face : Id of the face whose frame is the target frame; the first face of the design if None.
    pairs : Options of the initial pair.
    ellipses : Options of detection.
    workers : Number of processes; one per core if None.
    flatness_mm : σ of a circle about the plane of its face, mm; None if it is unknown.
    refine_camera : Whether to adjust the intrinsics, with the given ones as observations.
    rim : Whether to estimate the height of a rim in front of the faces' circles, and to give the faces of their
        luminous surface; if None, where the radii show a rim for certain and the design states none.
    board_only : bool
        Whether the board alone was photographed, so that λ and its residuals are the result. If False, the images tell.
    compare : Also solve the same photographs as published, and step by step from there, for the report.
    exclude : Images that are not used, by their names in results, such as ``12/IMG_1003.jpg``.
    expect_faces : Faces that the photographs were to show: the command ends with 4 where one is missing. If empty, the
        names of the groups tell, where all of them are made of ids of faces, such as ``12`` or ``front-right``.

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
        reference = target.face(self.reference_face or target.faces[0].id).id
        solve = self.solve or ("joint" if eccentricity else "chain")
        frame = self.frame or ("plane" if eccentricity else "three-point")
        return AdjustOptions(reference, solve, frame, eccentricity, self.flatness_mm, self.refine_camera)

    def settled(self, target: TargetDesign) -> "RunOptions":
        """Returns the same options with every default decided. Raises InputError: no such choice."""
        for face in self.expect_faces:
            target.face(face)
        settled = replace(self, **asdict(self.adjustment(target)))
        if settled.solve != "joint" and (self.rim or any(target.rim_of().values())):
            given = f"--solve {settled.solve} with {'--rim' if self.rim else 'rim_mm of the target'}"
            fault = f"{given}: only the joint adjustment corrects rims"
            raise InputError("E-RIM-SOLVE", f"{fault}; use --solve joint, or leave the rims out")
        return settled

    def for_run(self, camera: CameraModel | None, target: TargetDesign, board: BoardDesign) -> "RunOptions":
        """Returns the options settled for a run of these inputs; refuses those that camera file and designs forbid."""
        printed, options = target.with_faces(printed=True).faces, self
        if camera is None:
            options = replace(options, refine_camera=True)
        elif is_vague(camera) and not (options.refine_camera or options.compare):
            options = replace(options, refine_camera=True)
            known = f"camera file {camera.source}: states its focal length to ±{focal_sigma_px(camera):.3g} px only"
            warnings.warn(f"{known}; intrinsics are adjusted, as with --refine-camera", InputNote, stacklevel=2)
        of_circles = {"--solve paper": options.solve == "paper", "--compare paper": options.compare is not None}
        of_circles["--board-only"] = options.board_only
        for name in (name for name, is_given in of_circles.items() if printed and is_given):
            fault = f"{name}: only for targets of circles, and faces of this one have boards or tags"
            raise InputError("E-OPTION-CONFLICT", f"{fault}; leave it out")
        if camera is None and not (board.rows or printed):
            fault = "circles without a board of dots need a camera file, which `stcal-sfm calibrate-camera` makes"
            remedy = "the camera is also found if a board is in view, or if faces have a board or tags"
            raise InputError("E-CAMERA-NEEDED", f"missing option '--camera': {fault}; {remedy}")
        options = options.settled(target)
        if options.compare:
            require_dots(board, f"--compare {options.compare}")
            if options.solve != "joint" or not options.eccentricity:
                given = f"--solve is {options.solve}{'' if options.eccentricity else ' without eccentricity'}"
                fault = f"--compare paper: compares with the joint adjustment, but {given}"
                raise InputError("E-OPTION-CONFLICT", f"{fault}; leave --solve and --no-eccentricity out")
        return options

    def faces_expected(self, groups: Iterable[str], target: TargetDesign) -> list[str]:
        """Returns the faces that the photographs of all ``groups``, also of lost ones, were to show."""
        if self.board_only:
            return []
        ids = [face.id for face in target.faces]
        if self.expect_faces:
            return [face for face in ids if face in self.expect_faces]
        named = [faces_in_name(name, ids) for name in groups]
        return [face for face in ids if all(named) and any(face in faces for faces in named)]


def is_vague(camera: CameraModel) -> bool:
    """Returns whether a camera file, as of EXIF, states its focal length less well than the boards tell it."""
    return camera.colmap_model == "OPENCV" and focal_sigma_px(camera) > VAGUE * camera.focal[0]


def focal_sigma_px(camera: CameraModel) -> float:
    """Returns the σ of a focal length, 0 if the file states none."""
    return 0.0 if camera.covariance is None else float(np.sqrt(camera.covariance[0, 0]))


def require_dots(board: BoardDesign | None, option: str) -> None:
    """Refuses a board of corners for an option whose method finds dots."""
    if isinstance(board, CornerBoard):
        fault = f"{option}: finds boards of dots, and --board is one of squares or tags"
        raise InputError("E-OPTION-CONFLICT", f"{fault}; leave it out")
