"""Joint calibration of several cameras on one rig, from views of one board at the same instants."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial import KDTree

from stcal.boards.design import CornerBoard
from stcal.design import BoardDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Rigid
from stcal.parallel import one_thread
from stcal.sfm.camera.calibrate import CameraCalibration, rejudged, residual_rms_px
from stcal.sfm.camera.equations import Setting, State
from stcal.sfm.camera.intrinsics import (
    Adjusted,
    Intrinsics,
    SigmaFactors,
    adjusted,
    design_shapes,
    model_of_views,
    vague_prior,
)
from stcal.sfm.data.model import ImageObservations

LIMIT_TIMES, LEAST_LIMIT_PX = 6.0, 2.0
"""Largest deviation of a view of one instant, as a multiple of the median, and the smallest limit in px."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A view with the number of its camera, the camera's pose, and the current name of its instant."""

    view: ImageObservations
    camera: int
    camera_from_board: Rigid
    instant: str


@dataclass(frozen=True, slots=True)
class Apart:
    """A view that was not taken at its instant, and the reason."""

    camera: str
    image: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """Views of all cameras by instant.

    ``camera_from_first`` : approximate poses on the rig; ``sightings`` : views with consistently numbered dots, each at
    its instant; ``apart`` : views that were removed from their instant.
    """

    camera_from_first: tuple[Rigid, ...]
    sightings: tuple[Sighting, ...]
    apart: tuple[Apart, ...]


def instant_of(image: str) -> str:
    """Returns the name of an image's instant: its name in the camera's folder without the suffix."""
    return str(PurePosixPath(image).with_suffix(""))


def symmetries(board: BoardDesign) -> list[Rigid]:
    """Returns the symmetries of a board, board_from_board; the identity alone if its points are identified uniquely."""
    if board.unique():
        return [Rigid()]
    if isinstance(board, CornerBoard) and board.printed is not None:
        return [Rigid(), *board.printed.symmetries()]
    middle = np.append(board.pitch_mm * np.array([board.columns - 1, board.rows - 1]) / 2, 0.0)
    turns = []
    for quarter in range(0, 4, 1 if board.rows == board.columns else 2):
        turn = Rigid.exp([0, 0, quarter * np.pi / 2, 0, 0, 0]).rotation
        turns.append(Rigid(turn, middle - turn @ middle))
    return turns


def gathered(
    names: Sequence[str],
    cameras: Sequence[Camera],
    sightings: Sequence[Sighting],
    board: BoardDesign,
) -> Together:
    """Returns the poses of the cameras on the rig from views of the same instants.

    ``names``, ``cameras`` : cameras of the rig; ``sightings`` : views of all cameras, at most one of each camera and
    instant; ``board`` : board with its grid.

    Raises InputError: two images have the same camera and instant. Raises DegenerateError: a camera shares no instant
    with the others, or its instants do not determine how its board is numbered.
    """
    turns = symmetries(board)
    by_instant = _by_instant(names, sightings)
    pose_on_rig, final, apart = {0: Rigid()}, list(by_instant[0].values()), []
    placed = dict(by_instant[0])
    while len(pose_on_rig) < len(names):
        unplaced = [k for k in range(len(names)) if k not in pose_on_rig]
        k = max(unplaced, key=lambda k: len(by_instant[k].keys() & placed.keys()))
        shared = sorted(by_instant[k].keys() & placed.keys())
        if not shared:
            raise _alone(names, by_instant, [names[i] for i in pose_on_rig], k)
        first_from_board = [pose_on_rig[placed[t].camera].inverse() @ placed[t].camera_from_board for t in shared]
        relation = _where(names[k], cameras[k], board, turns, first_from_board, [by_instant[k][t] for t in shared])
        pose_on_rig[k] = relation.camera_from_first
        usual_turn = max(set(relation.choice), key=relation.choice.count)
        row = {t: i for i, t in enumerate(shared)}
        for t, each in by_instant[k].items():
            renumbered = _renumbered(each, board, turns[relation.choice[row[t]] if t in row else usual_turn])
            if t in row and relation.off_px[row[t]] > relation.limit_px:
                reason = (
                    f"the board is {relation.off_px[row[t]]:.1f} px RMS from where {names[placed[t].camera]} saw it, "
                    f"{relation.limit_px:.1f} px allowed"
                )
                apart.append(Apart(names[k], each.view.name, reason))
                renumbered = replace(renumbered, instant=f"{t} ({names[k]})")
            final.append(renumbered)
            placed.setdefault(renumbered.instant, renumbered)
    return Together(tuple(pose_on_rig[k] for k in range(len(names))), tuple(final), tuple(apart))


def _by_instant(names: Sequence[str], sightings: Sequence[Sighting]) -> list[dict[str, Sighting]]:
    """Returns the sightings of each camera by instant."""
    by_camera: list[dict[str, Sighting]] = [{} for _ in names]
    for each in sightings:
        if each.instant in by_camera[each.camera]:
            both = f"{by_camera[each.camera][each.instant].view.name} and {each.view.name}"
            raise InputError(
                "E-RIG-INSTANT",
                f"rig: camera {names[each.camera]}: {both} are both of one instant; one image of each camera and "
                "instant needed",
            )
        by_camera[each.camera][each.instant] = each
    return by_camera


def _alone(names: Sequence[str], own: Sequence[Mapping[str, Sighting]], rest: list[str], k: int) -> DegenerateError:
    return DegenerateError(
        "E-RIG-UNLINKED",
        f"rig: camera {names[k]} shares no instant with {', '.join(rest)}: its images, such as {next(iter(own[k]))}, "
        "show the board when theirs do not, or have other names; add images of the same instants that show the board, "
        "with the same names in both folders",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Where:
    """Pose of a camera on the rig.

    For each shared instant, ``choice`` is the index of the board's symmetry and ``off_px`` the deviation of the board
    with this choice; ``limit_px`` is the largest allowed deviation.
    """

    camera_from_first: Rigid
    choice: list[int]
    off_px: list[float]
    limit_px: float


def _where(
    name: str,
    camera: Camera,
    board: BoardDesign,
    turns: list[Rigid],
    first_from_board: list[Rigid],
    seen: list[Sighting],
) -> _Where:
    """Returns the relation of least median deviation (Rousseeuw 1984) among those from one instant and one symmetry."""
    xyz = board.places_mm(board.labels())
    diagonals = (xyz[:, 0] + xyz[:, 1], xyz[:, 0] - xyz[:, 1])
    corners = xyz[[int(pick(along)) for along in diagonals for pick in (np.argmin, np.argmax)]]
    relations = [
        each.camera_from_board @ turn.inverse() @ pose.inverse()
        for each, pose in zip(seen, first_from_board, strict=True)
        for turn in turns
    ]
    observed = np.array([[(s.camera_from_board @ t.inverse()) @ corners for t in turns] for s in seen])
    expected = np.array([pose @ corners for pose in first_from_board])
    deviation = np.array([_off_px(camera, relation @ expected, observed) for relation in relations])
    least = deviation.min(axis=2)  # (relation, instant)
    median = np.median(least, axis=1)
    best = int(median.argmin())
    limit = max(LEAST_LIMIT_PX, LIMIT_TIMES * float(median[best]))
    predicted = relations[best] @ expected
    as_good = [relations[i] for i in np.flatnonzero(median < limit)]
    if len(turns) > 1 and any(
        np.median(_off_px(camera, each @ expected, predicted[:, None])) > limit for each in as_good
    ):
        raise DegenerateError(
            "E-RIG-TURNED",
            f"rig: camera {name}: {len(seen)} shared instants do not determine the orientation in which it saw the "
            "board, which looks the same after a turn; add instants with the board turned and tilted, or use a board "
            "with one "
            "larger dot",
        )
    return _Where(relations[best], deviation[best].argmin(axis=1).tolist(), least[best].tolist(), limit)


def _off_px(camera: Camera, expected: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Returns the RMS distance, px, (instant, turn), of points (instant, 4, 3) from points (instant, turn, 4, 3)."""
    ideal, seen = expected[:, None, :, :2] / expected[:, None, :, 2:], observed[..., :2] / observed[..., 2:]
    px = np.linalg.norm((ideal - seen) * camera.focal, axis=-1)
    px = np.where((expected[:, None, :, 2] > 0) & (observed[..., 2] > 0), px, np.inf)
    return np.sqrt((px**2).mean(axis=-1))


def _renumbered(each: Sighting, board: BoardDesign, turn: Rigid) -> Sighting:
    """Returns the sighting with its dots numbered after a turn of the board."""
    labels = board.labels()
    _, nearest = KDTree(board.places_mm(labels)).query(turn @ board.places_mm(each.view.labels))
    view = replace(each.view, labels=tuple(labels[i] for i in np.ravel(nearest).tolist()))
    return replace(each, view=view, camera_from_board=each.camera_from_board @ turn.inverse())


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
def rig_of(cameras: Mapping[str, CameraCalibration], board: BoardDesign) -> RigCalibration:
    """Adjusts the cameras of one rig together.

    Parameters
    ----------
    cameras : calibrations of the single cameras by name. Views of one instant have the same name except for the suffix.
    board : board that all cameras saw

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
    together = gathered(names, [each.intrinsics.camera for each in alone], sightings, board)
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

    Raises ConvergenceError: no minimum is reached.
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
    adjusted: Adjusted,
    board: BoardDesign,
) -> RigCalibration:
    state, setting = adjusted.state, adjusted.setting
    covariance = np.linalg.inv(adjusted.last.normal)
    covariance = (covariance + covariance.T) / 2
    pose_covariance = np.zeros((len(names), 6, 6))
    for k in range(1, len(names)):
        pose_covariance[k] = covariance[setting.sits(k), setting.sits(k)]
    members: dict[str, dict[str, str]] = {}
    for each in together.sightings:
        members.setdefault(each.instant, {})[names[each.camera]] = each.view.name
    shared = tuple(sum(len(m) > 1 and name in m for m in members.values()) for name in names)
    intrinsics = [_of_camera(k, alone[k].intrinsics, adjusted, covariance) for k in range(len(names))]
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
        factor=adjusted.factors.centres,
        dots=adjusted.factors.dots,
        redundancy=state.redundancy(setting.kept),
        warnings=tuple(_warnings(names, shared, together, adjusted)),
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
