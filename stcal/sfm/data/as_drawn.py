"""Whether a result has the faces where the design draws them, and groups show the faces that their names state."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.distance import pdist

from stcal.design import TargetDesign
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.group_model import ImageObservations, by_group
from stcal.sfm.data.note import ELSEWHERE, NOT_AS_DRAWN, Note

MOST_TURNED_DEG = 25.0
"""Largest angle of a face to its rough pose. A rough pose is good to a few degrees; a face on the wrong side of the
body, or drawn turned, is off by far more."""
FAR_DEG = 45.0
"""Angle from which a face is not the one that was drawn: half of that between two sides of a box."""
LIKE_DRAWN = 1.3
"""Largest factor between distances of faces and those of their rough poses."""
SHOWN, RARELY = 2, 3
"""Number of images that must show a face before its group counts as one of it, and how many times as many must show it
as a face that the group is named after."""


def not_as_drawn(target_from_face: Mapping[str, Rigid], design: TargetDesign, one_folder: bool = False) -> list[Note]:
    """Returns notes on faces that are not where the rough poses of the design have them; ``one_folder``: whether
    photographs in one folder were taken to be of one setting of target and board."""
    rough = {face: pose for face, pose in design.rough_poses().items() if face in target_from_face}
    if len(rough) < 2:
        return []
    notes, found = [], {face: target_from_face[face] for face in rough}
    drawn, seen = (pdist([pose.translation for pose in of.values()]) for of in (rough, found))
    ratio = float(np.median(seen[drawn > 0] / drawn[drawn > 0])) if drawn.any() else 1.0
    if not 1 / LIKE_DRAWN < ratio < LIKE_DRAWN:
        what = f"faces are {ratio:.2g} times as far from one another as their rough_pose in target.toml has them"
        sizes = "check the sizes that it states (size_mm, radius_mm, pitch_mm), and that of the board"
        notes.append(Note(what, NOT_AS_DRAWN, remedy=sizes, then=": "))
    turned = turned_faces(found, rough)
    if not turned:
        return notes
    what = ", ".join(f"face {face} is turned by {angle:.0f}°" for face, angle in turned.items())
    what += " against rough_pose in target.toml"
    for a, b in combinations(turned, 2):
        exchanged = rough | {a: rough[b], b: rough[a]}
        if not {a, b} & turned_faces(found, exchanged).keys():
            what += f", as if the names of faces {a} and {b} were exchanged"
            break
    folders = "put the photographs of each setting of target and board into a folder of its own; or " * one_folder
    return [*notes, Note(what, NOT_AS_DRAWN, remedy=f"{folders}correct names, ids or rough_pose", then=": ")]


def turned_faces(found: Mapping[str, Rigid], rough: Mapping[str, Rigid]) -> dict[str, float]:
    """Returns the faces that are turned against most others, with their angles, degrees."""
    off = {face: found[face].rotation @ rough[face].rotation.T for face in rough}
    angles = {
        anchor: {face: float(np.degrees(Rigid(own.T @ other).angle_rad())) for face, other in off.items()}
        for anchor, own in off.items()
    }
    anchor = max(angles, key=lambda face: sum(angle <= MOST_TURNED_DEG for angle in angles[face].values()))
    return {face: angle for face, angle in angles[anchor].items() if angle > MOST_TURNED_DEG}


def misnamed_groups(observations: Sequence[ImageObservations], design: TargetDesign) -> list[Note]:
    """Returns notes on groups that are named after faces, and show others in place of them."""
    ids, notes = [face.id for face in design.faces], []
    for group, images in by_group(observations).items():
        named = faces_in_name(group, ids)
        seen = Counter(face for image in images for face in image.face_ids())
        others = [face for face, count in seen.items() if count >= SHOWN and face not in named]
        most = max((seen[face] for face in others), default=0)
        if named and most and any(RARELY * seen[face] < most for face in named):
            shown = [face for face, _ in seen.most_common(len(named))]
            what = f"group {group} is named after {_faces(sorted(named))} and shows {_faces(shown)}"
            remedy = "correct the names of faces in target.toml, or of folders"
            notes.append(Note(what, NOT_AS_DRAWN, group, remedy, then=": "))
    return notes


def misplaced_images(
    observations: Sequence[ImageObservations], notes: Mapping[str, Sequence[str]], design: TargetDesign
) -> list[str]:
    """Returns notes on images that show the faces after which another group is named, also by ``notes``."""
    ids = [face.id for face in design.faces]
    named = {image.group: faces_in_name(image.group, ids) for image in observations}
    found = []
    for image in observations:
        read = {n.place for n in notes.get(image.name, ()) if isinstance(n, Note) and n.code == ELSEWHERE}
        seen = (set(image.face_ids()) | read) & set(ids)
        if not named[image.group] or named[image.group] <= seen:
            continue
        others = [group for group, faces in named.items() if faces and faces <= seen]
        if len(others) == 1:
            found.append(
                f"{image.name} shows {_faces(sorted(seen))}, as group {others[0]} does: move it there if it was taken "
                "with these"
            )
    return found


def faces_in_name(group: str, ids: Sequence[str]) -> set[str]:
    """Returns the faces, at least two, of which a group's name consists; empty if it consists of anything else."""
    for parts in (re.split("[-_+ ]", group), list(group)):
        if len(parts) > 1 and len(set(parts)) == len(parts) and set(parts) <= set(ids):
            return set(parts)
    return set()


def _faces(names: Iterable[str]) -> str:
    return f"faces {' and '.join(names)}"
