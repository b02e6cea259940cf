"""Which views of a rig's cameras belong together: instants by name, and where each camera sits, to begin with.

A plain board looks the same after half a turn, so that each camera may number its dots from another end. Two cameras
that do not move against each other see the board alike at every instant with one choice of the ends alone; an instant
that agrees with no choice was not one.
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
"""Views of one instant may be off where the others have them by so many times the median, and by so much at least."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A view, its camera (number) and the camera's pose; ``instant`` : by its name, as of now."""

    view: ImageObservations
    camera: int
    camera_from_board: Rigid
    instant: str


@dataclass(frozen=True, slots=True)
class Apart:
    """A view that is none of its instant, and why."""

    camera: str
    image: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """``camera_from_first`` : where each camera sits, about; ``sightings`` with dots numbered alike, each at its
    instant; ``apart`` : views that were taken out of theirs."""

    camera_from_first: tuple[Rigid, ...]
    sightings: tuple[Sighting, ...]
    apart: tuple[Apart, ...]


def instant_of(image: str) -> str:
    """Its name in the camera's folder, but for the suffix."""
    return str(PurePosixPath(image).with_suffix(""))


def symmetries(board: BoardDesign, unique: bool) -> list[Rigid]:
    """Turns of a board, board_from_board, after which it looks the same; ``unique`` : none does."""
    if unique or board.corner is not None:
        return [Rigid()]
    middle = np.append(board.pitch_mm * np.array([board.columns - 1, board.rows - 1]) / 2, 0.0)
    found = []
    for quarter in range(0, 4, 1 if board.rows == board.columns else 2):
        turn = Rigid.exp([0, 0, quarter * np.pi / 2, 0, 0, 0]).rotation
        found.append(Rigid(turn, middle - turn @ middle))
    return found


def gathered(
    names: Sequence[str],
    cameras: Sequence[Camera],
    sightings: Sequence[Sighting],
    board: BoardDesign,
    unique: bool = False,
) -> Together:
    """Where cameras sit on each other, from views of the same instants.

    Parameters
    ----------
    names, cameras : of the rig
    sightings : of all cameras; an instant has one of each at most
    board : with its grid
    unique : the points of the board cannot be taken for each other

    Raises
    ------
    InputError
        Two images of one camera and one instant.
    DegenerateError
        A camera shares no instant with the rest, or they do not tell how its board is numbered.
    """
    turns = symmetries(board, unique)
    own = _by_instant(names, sightings)
    sits, final, apart = {0: Rigid()}, list(own[0].values()), []
    placed = dict(own[0])
    while len(sits) < len(names):
        left = [k for k in range(len(names)) if k not in sits]
        k = max(left, key=lambda k: len(own[k].keys() & placed.keys()))
        shared = sorted(own[k].keys() & placed.keys())
        if not shared:
            raise _alone(names, own, [names[i] for i in sits], k)
        first_from_board = [sits[placed[t].camera].inverse() @ placed[t].camera_from_board for t in shared]
        found = _where(names[k], cameras[k], board, turns, first_from_board, [own[k][t] for t in shared])
        sits[k] = found.camera_from_first
        usual = max(set(found.choice), key=found.choice.count)
        at = {t: i for i, t in enumerate(shared)}
        for t, each in own[k].items():
            turned = _renumbered(each, board, turns[found.choice[at[t]] if t in at else usual])
            if t in at and found.off_px[at[t]] > found.limit_px:
                reason = (
                    f"the board is {found.off_px[at[t]]:.1f} px RMS from where {names[placed[t].camera]} saw it, "
                    f"{found.limit_px:.1f} px allowed"
                )
                apart.append(Apart(names[k], each.view.name, reason))
                turned = replace(turned, instant=f"{t} ({names[k]})")
            final.append(turned)
            placed.setdefault(turned.instant, turned)
    return Together(tuple(sits[k] for k in range(len(names))), tuple(final), tuple(apart))


def _by_instant(names: Sequence[str], sightings: Sequence[Sighting]) -> list[dict[str, Sighting]]:
    """Of each camera."""
    own: list[dict[str, Sighting]] = [{} for _ in names]
    for each in sightings:
        if each.instant in own[each.camera]:
            both = f"{own[each.camera][each.instant].view.name} and {each.view.name}"
            raise InputError(
                "E-RIG-INSTANT",
                f"rig: camera {names[each.camera]}: {both} are both of one instant; one image of each camera and "
                "instant needed",
            )
        own[each.camera][each.instant] = each
    return own


def _alone(names: Sequence[str], own: Sequence[Mapping[str, Sighting]], rest: list[str], k: int) -> DegenerateError:
    return DegenerateError(
        "E-RIG-UNLINKED",
        f"rig: camera {names[k]} shares no instant with {', '.join(rest)}: its images, such as {next(iter(own[k]))}, "
        "show the board when theirs do not, or have other names; add images of one instant, named alike in both "
        "folders, that show the board",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Where:
    """Where a camera sits; for each shared instant ``choice`` of a turn of the board, and by how much the board is off
    then, px; ``limit_px`` ."""

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
    """Of all relations that one instant and one turn of the board give, that of the least median (Rousseeuw 1984)."""
    corners = board.places_mm([board.labels()[i] for i in (0, board.columns - 1, -board.columns, -1)])
    relations = [
        each.camera_from_board @ turn.inverse() @ pose.inverse()
        for each, pose in zip(seen, first_from_board, strict=True)
        for turn in turns
    ]
    observed = np.array([[(s.camera_from_board @ t.inverse()) @ corners for t in turns] for s in seen])
    expected = np.array([pose @ corners for pose in first_from_board])
    off = np.array([_off_px(camera, relation @ expected, observed) for relation in relations])
    least = off.min(axis=2)  # (relation, instant)
    middle = np.median(least, axis=1)
    best = int(middle.argmin())
    limit = max(LEAST_LIMIT_PX, LIMIT_TIMES * float(middle[best]))
    own = relations[best] @ expected
    as_good = [relations[i] for i in np.flatnonzero(middle < limit)]
    if len(turns) > 1 and any(np.median(_off_px(camera, each @ expected, own[:, None])) > limit for each in as_good):
        raise DegenerateError(
            "E-RIG-TURNED",
            f"rig: camera {name}: {len(seen)} shared instants do not tell which way round it saw the board, which "
            "looks the same after a turn; add instants with the board turned and tilted, or use a board with one "
            "larger dot",
        )
    return _Where(relations[best], off[best].argmin(axis=1).tolist(), least[best].tolist(), limit)


def _off_px(camera: Camera, expected: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """RMS distance in the image, (instant, turn), of points (instant, 4, 3) from such (instant, turn, 4, 3)."""
    ideal, seen = expected[:, None, :, :2] / expected[:, None, :, 2:], observed[..., :2] / observed[..., 2:]
    px = np.linalg.norm((ideal - seen) * camera.focal, axis=-1)
    px = np.where((expected[:, None, :, 2] > 0) & (observed[..., 2] > 0), px, np.inf)
    return np.sqrt((px**2).mean(axis=-1))


def _renumbered(each: Sighting, board: BoardDesign, turn: Rigid) -> Sighting:
    """The sighting with its dots counted after a turn of the board."""
    places = turn @ board.places_mm(each.view.labels)
    cells = np.round(places[:, 1::-1] / board.pitch_mm).astype(int)
    view = replace(each.view, labels=tuple(DotLabel(row, column) for row, column in cells.tolist()))
    return replace(each, view=view, camera_from_board=each.camera_from_board @ turn.inverse())
