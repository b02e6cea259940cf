"""Sets of circles of a face that also fit another face, or the same face turned, and so cannot identify it."""

from functools import lru_cache

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.lookalikes import common_circles, whole_likeness


def confusable(target: TargetDesign) -> dict[str, tuple[frozenset[int], ...]]:
    """Returns by face the sets of its circles (indices in the design) that another reading explains as well.

    Circles name a face only if no such set contains all of them.
    """
    key = tuple((f.id, f.xy_mm.tobytes(), f.radius_mm.tobytes()) for f in target.faces)
    return _confusable(key)


@lru_cache(maxsize=8)
def _confusable(key) -> dict[str, tuple[frozenset[int], ...]]:
    faces = [(face_id, np.frombuffer(xy).reshape(-1, 2), np.frombuffer(radius)) for face_id, xy, radius in key]
    found = {}
    for face_id, xy, radius in faces:
        sets: set[frozenset[int]] = set()
        for other_id, other_xy, other_radius in faces:
            for common in common_circles(xy, radius, other_xy, other_radius, same=face_id == other_id):
                sets.add(common)
        found[face_id] = tuple(s for s in sets if not any(s < t for t in sets))
    return found


def in_common(face: FaceDesign, other: FaceDesign, mirrored: bool = False) -> int:
    """Returns the largest number of circles of a face that coincide with circles of another, or with its own after a
    turn.

    The face is moved rigidly or, if ``mirrored``, turned over. 0 if fewer than ``MIN_COMMON`` coincide.
    """
    xy = np.asarray(face.xy_mm) * [-1 if mirrored else 1, 1]
    same = face.id == other.id and not mirrored
    found = common_circles(xy, face.radius_mm, other.xy_mm, other.radius_mm, same)
    return max(map(len, found), default=0)


def is_named(face: FaceDesign, found: np.ndarray, target: TargetDesign) -> bool:
    """Returns whether the circles found (mask) name the face, as no other reading explains them all."""
    circles = frozenset(np.flatnonzero(found).tolist())
    return not any(circles <= rival for rival in confusable(target)[face.id])


def likeness_notes(target: TargetDesign) -> list[str]:
    """Returns notes about faces that only one circle distinguishes, and about mirror images among the faces."""
    near = [telling for face in target.faces for other in target.faces for telling in _telling(face, other)]
    notes = []
    if near:
        gap, face, other, circle = min(near)
        faces = [each.id for each in target.faces if any(each.id in telling[1:3] for telling in near)]
        rival = "the same face turned" if face == other else f"face {other}"
        notes.append(
            f"target {target.name}: face{'s' * (len(faces) > 1)} {', '.join(faces)}: one circle tells each from "
            f"another, or from itself turned (the least is {face}:{circle} against {rival}, {gap:.1f} mm); where it is "
            "hidden, the face has no name"
        )
    if pairs := {tuple(sorted(pair)) for pair in mirror_images(target).items()}:
        listed = ", ".join(f"{a} of itself" if a == b else f"{a} and {b}" for a, b in sorted(pairs))
        notes.append(f"target {target.name}: faces are mirror images: {listed}; a reflection passes for a face")
    return notes


def _telling(face: FaceDesign, other: FaceDesign) -> list[tuple[float, str, str, str]]:
    """Returns single circles that distinguish a face from another one: distance in mm, both faces, and the circle."""
    rival = other.xy_mm, other.radius_mm
    found = []
    for common in common_circles(face.xy_mm, face.radius_mm, *rival, same=face is other):
        if len(common) != len(face.ids) - 1:
            continue
        own = np.array(sorted(common))
        like = whole_likeness(face.xy_mm[own], face.radius_mm[own], *rival, own if face is other else None)
        if like is not None:
            (alone,) = set(range(len(face.ids))) - common
            gap = np.linalg.norm(like.moved(face.xy_mm[alone]) - other.xy_mm, axis=1).min()
            found.append((float(gap), face.id, other.id, face.ids[alone]))
    return found


def mirror_images(target: TargetDesign) -> dict[str, str]:
    """Returns the faces whose mirror image looks like a face, and that face."""
    key = tuple((f.id, f.xy_mm.tobytes(), f.radius_mm.tobytes()) for f in target.faces)
    return _mirror_images(key)


@lru_cache(maxsize=8)
def _mirror_images(key) -> dict[str, str]:
    faces = [(face_id, np.frombuffer(xy).reshape(-1, 2), np.frombuffer(radius)) for face_id, xy, radius in key]
    found = {}
    for face_id, xy, radius in faces:
        for other_id, other_xy, other_radius in faces:
            most = max(map(len, common_circles(xy * [1, -1], radius, other_xy, other_radius, same=False)), default=0)
            if most == len(xy) == len(other_xy):
                found[face_id] = other_id
    return found
