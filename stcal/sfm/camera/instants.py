"""Instants of a rig's cameras from image names, and approximate poses of the cameras on the rig.

A plain board looks the same after half a turn, so each camera may number its dots from either end. The relative pose of
two cameras is the same at every instant for one choice of the ends only. Views of an instant that agrees with no choice
were not taken at the same time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from stcal.design import BoardDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import DotLabel
from stcal.sfm.data.observations import ImageObservations

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


def symmetries(board: BoardDesign, unique: bool) -> list[Rigid]:
    """Returns the symmetries of a board, board_from_board; only the identity if ``unique``."""
    if unique or board.corner is not None:
        return [Rigid()]
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
    unique: bool = False,
) -> Together:
    """Returns the poses of the cameras on the rig from views of the same instants.

    Parameters
    ----------
    names, cameras : cameras of the rig
    sightings : views of all cameras, at most one of each camera and instant
    board : board with its grid
    unique : whether the board's points are identified uniquely

    Raises
    ------
    InputError
        Two images have the same camera and instant.
    DegenerateError
        A camera shares no instant with the others, or its instants do not determine how its board is numbered.
    """
    turns = symmetries(board, unique)
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
        "show the board when theirs do not, or have other names; add images of one instant, named alike in both "
        "folders, that show the board",
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
    corners = board.places_mm([board.labels()[i] for i in (0, board.columns - 1, -board.columns, -1)])
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
            f"rig: camera {name}: {len(seen)} shared instants do not tell which way round it saw the board, which "
            "looks the same after a turn; add instants with the board turned and tilted, or use a board with one "
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
    places = turn @ board.places_mm(each.view.labels)
    cells = np.round(places[:, 1::-1] / board.pitch_mm).astype(int)
    view = replace(each.view, labels=tuple(DotLabel(row, column) for row, column in cells.tolist()))
    return replace(each, view=view, camera_from_board=each.camera_from_board @ turn.inverse())
