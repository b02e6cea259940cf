"""Remarks on a run: sentences that carry what programs decide by, so that nothing reads them but people; and those on
faces that are not where the design draws them, or not in the groups named after them."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.distance import pdist

from stcal.design import TargetDesign
from stcal.errors import StcalError
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.group_model import ImageObservations, by_group

NOT_AS_DRAWN = "not-as-drawn"
"""Faces are not where the design, or the names of groups, have them."""
GROUP_LEFT_OUT = "group-left-out"
BOARD_LEFT_OUT = "board-left-out"
"""A whole board in an image, not single dots."""
ELSEWHERE, SINGLE = "face-elsewhere", "face-single"
"""Faces that were read in an image and left out: not where others see them, or in no other image."""
BEGINNINGS = {NOT_AS_DRAWN: "not as drawn: ", GROUP_LEFT_OUT: "left out whole: "}


class Note(str):
    """The sentence of a remark.

    ``code`` : kind of remark; ``place`` : name of the face or group that it is about; ``words`` and ``remedy`` : the
    sentence in two parts, what was found and what to do
    """

    code: str
    place: str
    words: str
    remedy: str

    def __new__(cls, words: str, code: str = "", place: str = "", remedy: str = "", then: str = "; ") -> "Note":
        """Returns the note; ``then`` stands between words and remedy."""
        note = super().__new__(cls, f"{BEGINNINGS.get(code, '')}{words}{then if remedy else ''}{remedy}")
        note.code, note.place, note.words, note.remedy = code, place, words, remedy
        return note

    @property
    def note(self) -> str:
        """The whole sentence."""
        return str(self)

    @classmethod
    def of_group(cls, group: str, error: StcalError) -> "Note":
        """Returns the note on a group that an error leaves out."""
        return cls(error.fault, GROUP_LEFT_OUT, group, error.remedy)


def lost_groups(notes) -> list[str]:
    """Returns the names of the groups that were left out, of all notes of a run."""
    return [note.place for note in notes if isinstance(note, Note) and note.code == GROUP_LEFT_OUT]


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
            shown = " and ".join(face for face, _ in seen.most_common(len(named)))
            what = f"group {group} is named after faces {' and '.join(sorted(named))}, and shows {shown}"
            remedy = "correct the names of faces in target.toml, or of folders"
            notes.append(Note(what, NOT_AS_DRAWN, group, remedy, then=": "))
    return notes


def faces_in_name(group: str, ids: Sequence[str]) -> set[str]:
    """Returns the faces, at least two, of which a group's name consists; empty if it consists of anything else."""
    for parts in (re.split("[-_+ ]", group), list(group)):
        if len(parts) > 1 and len(set(parts)) == len(parts) and set(parts) <= set(ids):
            return set(parts)
    return set()
