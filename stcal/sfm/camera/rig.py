"""Joint calibration of several cameras on one rig, from views of one board at the same instants.

Each camera is calibrated by itself first. Then intrinsics, poses of the cameras on the rig, poses of the board and its
shape are adjusted together. The model is that of Furgale, Rehder & Siegwart (2013), Kalibr, plus the board's shape.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import intrinsic_basis
from stcal.parallel import one_thread
from stcal.sfm.camera.calibrate import CameraCalibration, rejudged, residual_rms_px
from stcal.sfm.camera.equations import Setting, State
from stcal.sfm.camera.instants import Apart, Sighting, Together, gathered, instant_of
from stcal.sfm.camera.intrinsics import (
    Adjusted,
    Intrinsics,
    SigmaFactors,
    adjusted,
    design_shapes,
    model_of_views,
    vague_prior,
)

FEW_INSTANTS = 5
"""Smallest advised number of instants that a camera shares with the others."""
LOOSE = 1.3
"""Largest factor by which residuals may grow in the joint adjustment without a warning."""


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """Result of calibrating c cameras of one rig.

    ``cameras`` : calibration of each camera, with the intrinsics of the joint adjustment; ``camera_from_first`` : (c,)
    poses and ``covariance`` : (c, 6, 6) their covariances, rad and mm, zero for the first; ``shared`` : (c,) number of
    instants in common with others; ``alone_rms_px`` : (c,) RMS of residuals before the joint adjustment; ``instants`` :
    image by camera, for each instant; ``rms_px`` : RMS of each instant; ``apart`` : views that do not belong to their
    instant; ``factor`` : ratio of residuals to those of the cameras alone; ``dots`` : factor of the board's σ.
    """

    names: tuple[str, ...]
    cameras: tuple[CameraCalibration, ...]
    camera_from_first: tuple[Rigid, ...]
    covariance: np.ndarray
    shared: tuple[int, ...]
    alone_rms_px: tuple[float, ...]
    instants: dict[str, dict[str, str]]
    rms_px: dict[str, float]
    apart: tuple[Apart, ...]
    factor: float
    dots: float
    redundancy: int
    warnings: tuple[str, ...]

    def rms_of_cameras(self) -> list[float]:
        """Returns the RMS of the residuals of each camera, per coordinate, px."""
        return [residual_rms_px(each.intrinsics) for each in self.cameras]


@one_thread()
def calibrate_rig(cameras: Mapping[str, CameraCalibration], board: BoardDesign, unique: bool = False) -> RigCalibration:
    """Adjusts the cameras of one rig together.

    Parameters
    ----------
    cameras : mapping
        Calibrations of the single cameras by name. Views of one instant have the same name except for the suffix.
    board : BoardDesign
        Board that all cameras saw.
    unique : bool
        Whether the board's points are identified uniquely, as on a ChArUco board.

    Returns
    -------
    RigCalibration
        Poses camera_from_first and intrinsics with covariances.

    Raises
    ------
    StcalError
        A camera shares no instant with the others, or no minimum is reached.
    """
    if len(cameras) < 2:
        raise InputError("E-RIG-CAMERAS", f"rig: {len(cameras)} camera, 2 needed; calibrate one without --rig")
    names, alone = tuple(cameras), tuple(cameras.values())
    sightings = [each for k, camera in enumerate(alone) for each in _sightings(k, camera)]
    together = gathered(names, [each.intrinsics.camera for each in alone], sightings, board, unique)
    joint = adjust_rig(alone, together, board)
    return _result(names, alone, together, joint, board)


def _sightings(k: int, camera: CameraCalibration) -> list[Sighting]:
    poses = {
        image: pose
        for model in camera.intrinsics.models
        for image, pose in zip(model.images, model.camera_from_model, strict=True)
    }
    return [Sighting(view, k, poses[view.name], instant_of(view.name)) for view in camera.views]


def adjust_rig(alone: tuple[CameraCalibration, ...], together: Together, board: BoardDesign) -> Adjusted:
    """Adjusts all unknowns, starting from the calibrations of the single cameras and with their σ of centres.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    cameras = tuple(each.intrinsics.camera for each in alone)
    models = [each.intrinsics.colmap_model for each in alone]
    state = _start(alone, together, board)
    setting = Setting(
        basis=tuple(intrinsic_basis(model) for model in models),
        weight=tuple(np.linalg.inv(vague_prior(c, model)) for c, model in zip(cameras, models, strict=True)),
        start=cameras,
        shape=design_shapes(state, board),
        sigma_mm=board.sigma_mm,
        huber=np.inf,
        rig=True,
    )
    return adjusted(state, setting, board)


def _start(alone: tuple[CameraCalibration, ...], together: Together, board: BoardDesign) -> State:
    models, folders, camera_numbers, instants = [], [], [], []
    poses: dict[str, tuple[Rigid, ...]] = {}
    for folder in dict.fromkeys(each.view.group for each in together.sightings):
        members = [each for each in together.sightings if each.view.group == folder]
        labels = tuple(sorted({label for each in members for label in each.view.labels}))
        pose_of_instant = {}
        for each in members:
            pose_of_instant.setdefault(
                each.instant, together.camera_from_first[each.camera].inverse() @ each.camera_from_board
            )
        place = {instant: i for i, instant in enumerate(pose_of_instant)}
        poses[folder] = tuple(pose_of_instant.values())
        for k in sorted({each.camera for each in members}):
            of_camera, scale = [each for each in members if each.camera == k], alone[k].intrinsics.factors.centres ** 2
            views = [replace(each.view, covariance_px2=scale * each.view.covariance_px2) for each in of_camera]
            models.append(model_of_views(folder, labels, views, board, alone[k].intrinsics.camera))
            folders.append(folder)
            camera_numbers.append(k)
            instants.append(np.array([place[each.instant] for each in of_camera]))
    cameras = tuple(each.intrinsics.camera for each in alone)
    state = State(
        tuple(models),
        tuple(folders),
        tuple(camera_numbers),
        tuple(instants),
        poses,
        cameras,
        together.camera_from_first,
    )
    return state.seen()


def _result(
    names: tuple[str, ...],
    alone: tuple[CameraCalibration, ...],
    together: Together,
    found: Adjusted,
    board: BoardDesign,
) -> RigCalibration:
    state, setting = found.state, found.setting
    covariance = np.linalg.inv(found.last.normal)
    covariance = (covariance + covariance.T) / 2
    pose_covariance = np.zeros((len(names), 6, 6))
    for k in range(1, len(names)):
        pose_covariance[k] = covariance[setting.sits(k), setting.sits(k)]
    members: dict[str, dict[str, str]] = {}
    for each in together.sightings:
        members.setdefault(each.instant, {})[names[each.camera]] = each.view.name
    shared = tuple(sum(len(m) > 1 and name in m for m in members.values()) for name in names)
    intrinsics = [_of_camera(k, alone[k].intrinsics, found, covariance) for k in range(len(names))]
    return RigCalibration(
        names=names,
        cameras=tuple(rejudged(a, own, board) for a, own in zip(alone, intrinsics, strict=True)),
        camera_from_first=state.camera_from_first,
        covariance=pose_covariance,
        shared=shared,
        alone_rms_px=tuple(residual_rms_px(each.intrinsics) for each in alone),
        instants=dict(sorted(members.items())),
        rms_px=_rms_by_instant(state, together),
        apart=together.apart,
        factor=found.factors.centres,
        dots=found.factors.dots,
        redundancy=state.redundancy(setting.kept),
        warnings=tuple(_warnings(names, shared, together, found)),
    )


def _of_camera(k: int, alone: Intrinsics, found: Adjusted, covariance: np.ndarray) -> Intrinsics:
    """Returns the intrinsics of one camera from the joint adjustment."""
    state, place = found.state, found.setting.intrinsics(k)
    models = tuple(m for m, camera in zip(state.models, state.camera_of, strict=True) if camera == k)
    return Intrinsics(
        cameras=(state.cameras[k],),
        colmap_model=alone.colmap_model,
        covariance=covariance[place, place],
        models=models,
        camera_of=(0,) * len(models),
        factors=SigmaFactors(alone.factors.centres * found.factors.centres, found.factors.dots),
        huber=found.setting.huber,
        redundancy=state.redundancy(found.setting.kept),
        settled=found.settled,
    )


def _rms_by_instant(state: State, together: Together) -> dict[str, float]:
    """Returns the RMS of all residuals of each instant, per coordinate, px."""
    instant = {(each.camera, each.view.name): each.instant for each in together.sightings}
    squares: dict[str, list[np.ndarray]] = {}
    for model, k in zip(state.models, state.camera_of, strict=True):
        residual = model.residuals_px(state.cameras[k])
        for image, rows in zip(model.images, model.rows_by_image(), strict=True):
            squares.setdefault(instant[k, image], []).append(residual[rows].ravel() ** 2)
    return {name: float(np.sqrt(np.concatenate(each).mean())) for name, each in sorted(squares.items())}


def _warnings(names: tuple[str, ...], shared: tuple[int, ...], together: Together, found: Adjusted) -> list[str]:
    warnings = [
        f"camera {name} shares {count} instants with the others, {FEW_INSTANTS} advised; add instants that show the "
        "board to both"
        for name, count in zip(names, shared, strict=True)
        if count < FEW_INSTANTS
    ]
    if found.factors.centres > LOOSE:
        warnings.append(
            f"residuals are {found.factors.centres:.1f} times those of the cameras alone: σ are scaled by it, but the "
            "cameras were not triggered at once, or moved against each other"
        )
    if together.apart:
        warnings.append(
            f"{len(together.apart)} views are none of their instant: check that the cameras were triggered at once"
        )
    if not found.settled:
        warnings.append("the σ of centres and dots still change when the rounds end; look at the outliers")
    return warnings
