"""Detection of the boards and tags on the faces of a body, all of one image together."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stcal.boards.board_designs import AprilGridDesign, BoardView, CharucoDesign, ChessboardDesign, FlatBoard, TagLayout
from stcal.boards.chessboard import find_charuco, find_chessboard, why_no_chessboard
from stcal.boards.edges import ALONG, POINTS
from stcal.boards.tags import APART_PX, Unseen, find_aprilgrid, find_tags, seen_otherwise, view_of_tags
from stcal.boards.target_file import tags_on
from stcal.design import FaceDesign
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.io.images import ImageFile, decode, grey_of
from stcal.labels import BOARD

MOST_READ, LOOKED_AT = 12, 5
"""Largest numbers of images in which tags of no face, and tags of other kinds, are looked for."""
MOST_TILT_DEG = 70.0
LEAST_COSINE = float(np.cos(np.radians(MOST_TILT_DEG)))
"""Largest tilt of tags, and its cosine: beyond, corners had errors of 0.27 to 0.45 px RMS in place of 0.06."""


def find_on_faces(
    image: np.ndarray, name: str, boards: Mapping[str, FlatBoard], camera: Camera
) -> tuple[dict[str, BoardView], list[str]]:
    """Return the views of boards and tags in a grey image by face, and notes on what was left out."""
    of_layouts = [d for board in boards.values() if isinstance(board, TagLayout) for d, _ in board.tags]
    of_charuco = [board.dictionary for board in boards.values() if isinstance(board, CharucoDesign)]
    tags = find_tags(image, (*of_layouts, *of_charuco), windows_px=APART_PX)
    read = {*tags.tags, *tags.repeated}

    def charuco(board: CharucoDesign) -> tuple[BoardView | None, str]:
        if not any((board.dictionary, tag) in read for tag in board.tag_ids()):
            return None, f"no tag of {board.dictionary}"
        return find_charuco(image, name, board), ""

    def chessboard(board: ChessboardDesign) -> tuple[BoardView | None, str]:
        view = find_chessboard(image, name, board, with_sigma=True)
        return view, "" if view else why_no_chessboard(image, board)

    finders = {
        TagLayout: lambda board: (view_of_tags(name, tags, board), ""),
        CharucoDesign: charuco,
        ChessboardDesign: chessboard,
        AprilGridDesign: lambda board: find_aprilgrid(image, name, board, camera),
    }
    views: dict[str, BoardView] = {}
    notes: list[str] = []
    for face, board in boards.items():
        view, why, oblique = None, "", ""
        try:
            view, why = finders[type(board)](board)
            if isinstance(board, TagLayout | AprilGridDesign):
                view, oblique = _not_oblique(view)
                view = straightened(view, camera)
        except StcalError as error:  # corners on a line, say
            view, why = None, f"left out, {error}"
        where = BOARD if face == BOARD else f"face {face}"
        notes += [f"{where}: {oblique}"] if oblique else []
        if view is not None:
            views[face] = view
            notes += [f"{where}: {reason}" for reason in view.unused]
        elif why and (face == BOARD or not isinstance(why, Unseen)):
            notes.append(f"{where}: {why}")
    return views, notes


def _not_oblique(view: BoardView | None) -> tuple[BoardView | None, str]:
    """Returns the view of tags without those that are tilted too far, None if none is left, and why."""
    if view is None:
        return None, ""
    corners = view.xy_px.reshape(-1, 4, 2)
    across = corners[:, 1] + corners[:, 2] - corners[:, 0] - corners[:, 3]
    down = corners[:, 2] + corners[:, 3] - corners[:, 0] - corners[:, 1]
    shape = np.linalg.svd(np.stack([across, down], axis=2), compute_uv=False)
    cosine = shape[:, 1] / shape[:, 0]
    keep = np.repeat(cosine >= LEAST_COSINE, 4)
    if keep.all():
        return view, ""
    count, tilt_deg = int((~keep).sum()) // 4, float(np.degrees(np.arccos(cosine.min())))
    tags = "a tag is" if count == 1 else f"{count} tags are"
    why = f"{tags} tilted by {tilt_deg:.0f}°, up to {MOST_TILT_DEG:g}° is measured; turn the face towards the camera"
    return view.rows(keep) if keep.any() else None, why


def straightened(view: BoardView | None, camera: Camera) -> BoardView | None:
    """Returns the view of tags with the corners at which their curved edges meet."""
    if view is None:
        return None
    return replace(view, xy_px=view.xy_px - shift_by_curves(view.xy_px.reshape(-1, 4, 2), camera).reshape(-1, 2))


def shift_by_curves(corners_px: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns how far the lens moves the measured corners (n, 4, 2) of tags, as lines are laid along its curves."""
    ideal = camera.normalised_from_pixel(corners_px)
    step = (np.roll(ideal, -1, axis=1) - ideal)[:, :, None]
    edge = camera.pixel_from_normalised(ideal[:, :, None] + np.linspace(*ALONG, POINTS)[:, None] * step)
    middle = edge.mean(2)
    away = edge - middle[:, :, None]
    normal = np.linalg.eigh(np.swapaxes(away, 2, 3) @ away)[1][..., 0]
    lines, offsets = (np.stack([np.roll(each, 1, axis=1), each], axis=2) for each in (normal, (normal * middle).sum(2)))
    return np.linalg.solve(lines, offsets[..., None])[..., 0] - corners_px


def tags_of_no_face(files: Sequence[ImageFile], faces: Sequence[FaceDesign], unseen: Sequence[FaceDesign]) -> list[str]:
    """Return notes on tags that images show and no face has, where tags of ``unseen`` faces are in none of them."""
    missing = sorted({tag for face in unseen for tag in tags_on(face.printed)})
    own = {tag for face in faces for tag in tags_on(face.printed)}
    known = sorted({dictionary for dictionary, _ in own})
    if not missing:
        return []
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, min(len(files), MOST_READ)).astype(int))]
    seen = Counter(
        tag for file in chosen for tag in set(find_tags(grey_of(decode(file.read(), file.name), file.name), known).tags)
    )
    strange = [(tag, count) for tag, count in seen.most_common() if tag not in own and count > 1]
    if not strange:
        return []
    shown = ", ".join(f"tag {number} of {name} in {count} of {len(chosen)}" for (name, number), count in strange[:3])
    names = ", ".join(f"{number} of {name}" for name, number in missing[:3])
    return [f"images show tags that no face has ({shown}), and not {names}"]


def why_unseen(files: Sequence[ImageFile], faces: Sequence[FaceDesign]) -> str:
    """Return why none of the images shows one of the printed faces, by the tags in the first images."""
    own = {tag for face in faces for tag in tags_on(face.printed)}
    known = sorted({dictionary for dictionary, _ in own})
    reason = f"no printed face of the target is seen in {len(files)} images"
    for file in files[:LOOKED_AT] if known else ():
        grey = grey_of(decode(file.read(), file.name), file.name)
        read = find_tags(grey, known).tags
        names = ", ".join(str(tag) for _, tag in read[:5])
        if own.intersection(read):
            return f"{reason}: {file.name} shows tags {names}, too small or too steep; go nearer, or turn the target"
        if read:
            return f"{reason}, and {file.name} shows tags {names} of its dictionaries; correct the ids in target.toml"
        if shown := seen_otherwise(grey, own, "target.toml"):
            return f"{reason}, and {file.name} shows {shown}"
    return f"{reason}; look at overlays (`stcal-sfm detect`), and check dictionary, ids and the exposure"
