"""The rigid arrangement of the planes of one group and the poses of its images."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np
from scipy.spatial import KDTree

from stcal.geometry.least_squares import PoseStack
from stcal.geometry.plane_bundle import PlaneBundle
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD
from stcal.lookalikes import alike
from stcal.sfm.data.patterns import Pattern
from stcal.sfm.detect.sightings import PlaneView, Readings, flipped_pose, mirrored_as

MAX_SHIFT_PITCHES = 0.3
"""Largest deviation of a plane from its place in an image's first pose, in steps of the pattern. A wrong numbering of
the board deviates by a whole step."""
MAX_SEEDS = 8
"""Largest number of start images, until one explains everything."""
MIN_MIRRORED = 0.5
"""Least share of a mirrored image's circles that coincide with circles of the group when the image is turned back."""
MAX_OFF_PITCHES = 0.12
"""Largest median deviation of a reading's circles after the adjustment, in steps of the pattern: 3 mm for the reference
target. A design deviates by tenths of a step, a wrong numbering by a whole one."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """Rigid arrangement of the planes of a group, with the poses of its images.

    ``group_from_plane`` : by plane; ``camera_from_group`` : by image. By image, too: ``views`` : accepted readings;
    ``contradicted`` : readings that do not fit; ``open`` : boards with several numberings that fit; ``reflected`` :
    readings of a plane's mirror image; ``foreign`` : readings of a plane that other groups have at another place.
    """

    group_from_plane: dict[str, Rigid]
    camera_from_group: dict[int, Rigid]
    views: dict[int, tuple[PlaneView, ...]]
    contradicted: dict[int, tuple[Readings, ...]] = field(default_factory=dict)
    open: dict[int, tuple[Readings, ...]] = field(default_factory=dict)
    reflected: dict[int, tuple[PlaneView, ...]] = field(default_factory=dict)
    foreign: dict[int, tuple[PlaneView, ...]] = field(default_factory=dict)

    def without(self, planes: set[str]) -> tuple["Arrangement", dict[int, tuple[PlaneView, ...]]]:
        """Returns the arrangement without some planes, and the removed readings by image."""
        gone = {i: tuple(v for v in views if v.plane in planes) for i, views in self.views.items()}
        rest = replace(
            self,
            group_from_plane={p: pose for p, pose in self.group_from_plane.items() if p not in planes},
            views={i: tuple(v for v in views if v.plane not in planes) for i, views in self.views.items()},
        )
        return rest, {i: views for i, views in gone.items() if views}

    def explained(self) -> int:
        """Returns the number of circles of the readings that fit."""
        return sum(len(view.rows) for views in self.views.values() for view in views)


def arrange(
    images: Sequence[list[Readings]], patterns: dict[str, Pattern], step_mm: float, focal_px: float
) -> Arrangement:
    """Returns the arrangement that explains most circles of one group, without reflections in a mirror.

    Parameters
    ----------
    images
        Readings of every image.
    patterns
        Circles of each plane.
    step_mm
        Distance between neighbouring circles, the least error of a wrong reading.
    focal_px
        Focal length of the camera.
    """
    reach_mm = MAX_SHIFT_PITCHES * step_mm
    found, reflected = _best(images, patterns, step_mm, focal_px), {}
    while mirror := _mirror_of_group(found, patterns, reach_mm):
        behind = {i: gone for i in found.camera_from_group if (gone := _behind(images[i], found, i, mirror))}
        if not behind:
            break
        reflected = {i: reflected.get(i, ()) + behind.get(i, ()) for i in {*reflected, *behind}}
        images = [[r for r in own if not any(r[0] is v for v in behind.get(i, ()))] for i, own in enumerate(images)]
        found = _best(images, patterns, step_mm, focal_px)
    whole = {i: reflected.get(i, ()) + found.reflected.get(i, ()) for i in {*reflected, *found.reflected}}
    return replace(found, reflected=whole)


def _best(
    images: Sequence[list[Readings]], patterns: dict[str, Pattern], step_mm: float, focal_px: float
) -> Arrangement:
    total = sum(len(views[0].rows) for readings in images for views in readings if views[0].named)
    best = Arrangement({}, {}, {})
    for i, reading in _seeds(images):
        if any(reading is view for view in best.views.get(i, ())):
            continue  # a start with this image gives the same arrangement
        found = _adjusted(_grown(images, i, reading, MAX_SHIFT_PITCHES * step_mm), focal_px)
        found = _without_reflections(_checked(images, found, step_mm), patterns, MAX_SHIFT_PITCHES * step_mm)
        if found.explained() > best.explained():
            best = found
        if best.explained() >= total:
            break
    return best


Mirror = tuple[np.ndarray, np.ndarray]
"""Normal of a mirror, towards the cameras, and a point of it; group frame."""


def _mirror_of_group(found: Arrangement, patterns: dict[str, Pattern], reach_mm: float) -> Mirror | None:
    """Returns the mirror that most images show, such as a shiny table; None without one.

    If an image shows a plane at two places, each the mirror image of the other, one of them is a reflection. The real
    one is on the same side of the mirror as the cameras; the reflection has its handedness reversed.
    """
    mirrors = []
    for i, contradicted in found.contradicted.items():
        centre, planes = found.camera_from_group[i].inverse(), {view.plane for view in found.views[i]}
        for view in (view for views in contradicted for view in views if view.plane in planes):
            pattern = patterns[view.plane]
            own, other = found.group_from_plane[view.plane], centre @ view.camera_from_plane
            xyz = pattern.xyz_mm()
            mirror = _mirror_between(own @ xyz, other @ xyz, pattern.radius_mm, reach_mm)
            if mirror is not None:
                normal, middle = mirror
                mirrors.append((normal * np.sign((centre.translation - middle) @ normal), middle, i))
    if not mirrors:
        return None
    images = [{j for _, m, j in mirrors if abs((m - middle) @ normal) < reach_mm} for normal, middle, _ in mirrors]
    return mirrors[int(np.argmax([len(own) for own in images]))][:2]


def _mirror_between(own: np.ndarray, other: np.ndarray, radius: np.ndarray, reach_mm: float) -> Mirror | None:
    """Returns normal and a point of the mirror that shows the circles ``own`` as ``other``, (n, 3) each, in any order;
    None if there is none.

    Nothing real lies on both sides of a mirror. This excludes the plane half way between a grid and the same grid with
    another numbering, which intersects both.
    """
    between = own.mean(0) - other.mean(0)
    length = float(np.linalg.norm(between))
    if length < 2 * reach_mm:
        return None
    normal, middle = between / length, (own.mean(0) + other.mean(0)) / 2
    if ((own - middle) @ normal <= 0).any():
        return None
    apart, nearest = KDTree(other).query(own - 2 * ((own - middle) @ normal)[:, None] * normal)
    same = len(np.unique(nearest)) == len(own) and apart.max() < reach_mm and alike(radius, radius[nearest]).all()
    return (normal, middle) if same else None


def _behind(readings: list[Readings], found: Arrangement, image: int, mirror: Mirror) -> tuple[PlaneView, ...]:
    """Returns the first view of the readings of one image that lie behind a mirror."""
    group_from_camera = found.camera_from_group[image].inverse()
    normal, middle = mirror

    def is_behind(view: PlaneView) -> bool:
        xyz = group_from_camera @ (view.camera_from_plane @ view.xyz_mm())
        return bool(np.median((xyz - middle) @ normal) < 0)

    return tuple(views[0] for views in readings if all(is_behind(view) for view in views))


def across_groups(groups: Sequence[Arrangement], patterns: dict[str, Pattern], reach_mm: float) -> list[Arrangement]:
    """Compares the arrangements of all groups, as the faces of a target have the same relative poses in all of them.

    A face is removed from a group in which its place differs from that in most groups. A face is added to a group if
    its place is known from other groups, even if no image of the group has a reading of it: the second look decides.
    The places of all faces then also identify the mirror image of a face that a group does not show. A face that any
    group shows to be real stays in all groups that have it at the same place. A group that contradicts the others, and
    whose faces may all be mirror images of other faces, has mirrored images and loses them.
    """
    faces = [_as_faces(group) for group in groups]
    best: Arrangement = Arrangement({}, {}, {})
    for i, view in _seeds(faces):
        grown = _grown(faces, i, view, reach_mm)
        if grown.explained() > best.explained():
            best = grown
    settled = []
    for i, group in enumerate(groups):
        if i not in best.views:
            settled.append(group)
            continue
        agreed = {view.plane for view in best.views[i]}
        faces = {p for p in group.group_from_plane if p != BOARD}
        if faces - agreed and all(_may_be_mirrored(group, patterns, face) for face in faces):
            reduced, foreign = group.without(faces)
            others = [replace(reduced, foreign=foreign) if each is group else each for each in groups]
            return across_groups(others, patterns, reach_mm)
        reduced, foreign = group.without(faces - agreed)
        pose = best.camera_from_group[i]
        known = {p: pose @ target_from_face for p, target_from_face in best.group_from_plane.items()}
        foreign = {k: group.foreign.get(k, ()) + foreign.get(k, ()) for k in {*group.foreign, *foreign}}
        settled.append(replace(reduced, group_from_plane=known | reduced.group_from_plane, foreign=foreign))
    cleared = [_without_reflections(group, patterns, reach_mm) for group in settled]
    real = {view.plane for i in best.views for own in cleared[i].views.values() for view in own}
    gone = [
        (s.group_from_plane.keys() - c.group_from_plane.keys()) - (real if i in best.views else set())
        for i, (s, c) in enumerate(zip(settled, cleared, strict=True))
    ]
    if not any(gone):
        return [_restored(group, reach_mm) if i in best.views else group for i, group in enumerate(settled)]
    without_reflections = []
    for group, planes in zip(groups, gone, strict=True):
        rest, removed = group.without(planes)
        reflected = {i: group.reflected.get(i, ()) + removed.get(i, ()) for i in {*group.reflected, *removed}}
        without_reflections.append(replace(rest, reflected=reflected))
    return across_groups(without_reflections, patterns, reach_mm)


def _restored(group: Arrangement, reach_mm: float) -> Arrangement:
    """Returns the group with the readings that passed for a mirror image, but lie where other groups see that face."""
    views, reflected = dict(group.views), dict(group.reflected)
    for i in reflected.keys() & views.keys():
        pose, taken = group.camera_from_group[i], {view.plane for view in views[i]}
        back, _ = _agreeing([[view] for view in reflected[i]], pose, group.group_from_plane, reach_mm, taken)
        views[i] = (*views[i], *back)
        reflected[i] = tuple(view for view in reflected[i] if not any(view is each for each in back))
    return replace(group, views=views, reflected=reflected)


def _as_faces(group: Arrangement) -> list[Readings]:
    """Returns the faces of a group in the form of an image's readings, with a row for each observed circle."""
    views_of_plane: dict[str, list[PlaneView]] = {}
    for views in group.views.values():
        for view in views:
            if view.plane != BOARD:
                views_of_plane.setdefault(view.plane, []).append(view)
    faces = []
    for plane, views in views_of_plane.items():
        if plane in group.group_from_plane:
            rows = np.concatenate([view.rows for view in views])
            first = max(views, key=lambda view: len(view.rows))
            area = sum(view.area for view in views)
            pose = group.group_from_plane[plane]
            faces.append([replace(first, rows=rows, area=area, camera_from_plane=pose, named=True)])
    return faces


def _seeds(images: Sequence[list[Readings]]) -> list[tuple[int, PlaneView]]:
    """Returns readings to start from, with all alternatives: the board of an image, or its largest face.

    The readings of the most reliable image come first.
    """
    candidates = []
    for i, readings in enumerate(images):
        boards = [views for views in readings if views[0].plane == BOARD]
        faces = [views for views in readings if views[0].plane != BOARD and views[0].named]
        if boards or faces:
            first = max(boards or faces, key=lambda views: len(views[0].rows))
            circles = sum(len(views[0].rows) for views in boards + faces)
            candidates.append(((not boards, not faces, len(first), -len(faces), -circles), i, first))
    candidates.sort(key=lambda each: each[:2])
    return [(i, view) for _, i, views in candidates[:MAX_SEEDS] for view in views]


def _grown(images: Sequence[list[Readings]], seed: int, view: PlaneView, reach_mm: float) -> Arrangement:
    """Grows the arrangement from one image to all images that share planes with placed ones."""
    known = {view.plane: Rigid()}
    # If the numbering of the first image is a convention, the board alone cannot place another image.
    by_convention = view.plane == BOARD and len(_same_circles(images[seed], view)) > 1
    while True:
        placed = {i: found for i, r in enumerate(images) if (found := _placed(r, known, reach_mm, by_convention))}
        placed[seed] = _with_seed(images[seed], view, known, reach_mm)
        new = _new_planes(images, placed, known, reach_mm) or _agreed_plane(images, placed, known, reach_mm)
        if not new:
            break
        known |= new
    poses = {i: pose for i, (pose, _) in placed.items()}
    return Arrangement(known, poses, {i: tuple(views) for i, (_, views) in placed.items()})


def _same_circles(readings: list[Readings], view: PlaneView) -> Readings:
    return next(views for views in readings if any(each is view for each in views))


def _with_seed(readings: list[Readings], view: PlaneView, known: dict[str, Rigid], reach_mm: float):
    """Returns pose and readings of the first image, with the reading that the arrangement was started from."""
    pose = view.camera_from_plane @ known[view.plane].inverse()
    alternatives = _same_circles(readings, view)
    others, _ = _agreeing(
        [views for views in readings if views is not alternatives], pose, known, reach_mm, {view.plane}
    )
    return pose, [view, *others]


def _placed(readings: list[Readings], known: dict[str, Rigid], reach_mm: float, by_convention: bool):
    """Returns the pose of an image and the readings that agree with it, or None.

    The pose with the most planes is taken, and of these the one with the most faces. The result is None if the image
    has no known plane, or several poses fit equally well.
    """
    best, best_score, rivals = None, (0, 0, 0), 0
    for views in readings:
        for view in views:
            if view.plane not in known:
                continue
            pose = view.camera_from_plane @ known[view.plane].inverse()
            others, _ = _agreeing([v for v in readings if v is not views], pose, known, reach_mm, {view.plane})
            agreed = [view, *others]
            faces = sum(v.plane != BOARD and v.named for v in agreed)
            score = (len(agreed), faces, sum(len(v.rows) for v in agreed))
            if score > best_score:
                best, best_score, rivals = (pose, agreed), score, 0
            elif score == best_score:
                rivals += best is None or not _alike(best[0], pose, agreed[0], reach_mm)
    if best is None or (rivals and (len(best[1]) == 1 or not all(v.named for v in best[1]))):
        return None
    if not any(v.named for v in best[1]) and len(best[1]) == 1:
        return None
    if by_convention and len(best[1]) == 1 and best[1][0].plane == BOARD and len(readings) > 1:
        return None
    return best


def _alike(pose: Rigid, other: Rigid, view: PlaneView, reach_mm: float) -> bool:
    """Returns whether two poses put a plane at the same place, to less than a step at its rim."""
    difference = pose.inverse() @ other
    return bool(np.abs(difference @ view.span_mm() - view.span_mm()).max() < reach_mm)


def _agreeing(readings: list[Readings], camera_from_group: Rigid, known, reach_mm: float, taken: set[str]):
    """Returns the readings that agree with the arrangement, each plane once, and circles with several such readings."""
    agreed, ambiguous = [], []
    ranked = []
    for views in readings:
        shifts = sorted(
            ((_shift_mm(view, camera_from_group, known), k) for k, view in enumerate(views) if view.plane in known)
        )
        if not shifts or shifts[0][0] > reach_mm:
            continue
        if len(shifts) > 1 and shifts[1][0] < 2 * reach_mm:
            ambiguous.append(views)
        else:
            ranked.append((shifts[0][0], views[shifts[0][1]]))
    for _, view in sorted(ranked, key=lambda each: each[0]):
        if view.plane not in taken:
            taken = taken | {view.plane}
            agreed.append(view)
    return agreed, ambiguous


def _shift_mm(view: PlaneView, camera_from_group: Rigid, known: dict[str, Rigid]) -> float:
    """Returns the median distance of circles from their places in the arrangement."""
    own, plane, camera = view.camera_from_plane, known[view.plane], camera_from_group
    turned = own.rotation - camera.rotation @ plane.rotation
    moved = own.translation - camera.rotation @ plane.translation - camera.translation
    square = ((view.xy_mm @ turned[:, :2].T + moved) ** 2).sum(1)
    square.sort()  # NumPy's median takes longer than all of the above, and this is asked thousands of times
    n = len(square)
    return float(np.sqrt(square[(n - 1) // 2]) + np.sqrt(square[n // 2])) / 2


def _new_planes(images: Sequence[list[Readings]], placed, known: dict[str, Rigid], reach_mm: float) -> dict[str, Rigid]:
    """Returns poses of unknown planes, each at the place with the largest area in the placed images.

    A second target in the background may be seen as often, but is smaller.
    """
    new = {}
    for plane, found in _unknown_planes(images, placed, known, named=True).items():
        support = _together(found, reach_mm) @ np.array([view.area for _, view, _ in found])
        new[plane] = found[int(np.argmax(support))][2]
    return new


def _agreed_plane(images: Sequence[list[Readings]], placed, known: dict[str, Rigid], reach_mm: float):
    """Returns a plane that no image alone can name, and its pose, or an empty dict.

    At least two images must agree on its place, and more than for any other plane that the same circles may be.
    """
    ranked = []
    for plane, found in _unknown_planes(images, placed, known, named=False).items():
        together = _together(found, reach_mm)
        by_image = np.array([i for i, _, _ in found])
        support = [len(np.unique(by_image[row])) for row in together]
        k = int(np.argmax(support))
        ranked.append((support[k], plane, found[k][2]))
    ranked.sort(key=lambda each: -each[0])
    if not ranked or ranked[0][0] < 2 or (len(ranked) > 1 and ranked[1][0] == ranked[0][0]):
        return {}
    return {ranked[0][1]: ranked[0][2]}


def _unknown_planes(images: Sequence[list[Readings]], placed, known: dict[str, Rigid], named: bool):
    """Returns (image, view, group_from_plane) by unknown plane, of the placed images' readings that are named, or of
    those that are not named and agree with no known plane."""
    unknown: dict[str, list[tuple[int, PlaneView, Rigid]]] = {}
    for i, (pose, agreed) in placed.items():
        for views in images[i]:
            if any(view is each for view in views for each in agreed):
                continue
            for view in views:
                if view.plane not in known and view.named == named:
                    group_from_plane = pose.inverse() @ view.camera_from_plane
                    unknown.setdefault(view.plane, []).append((i, view, group_from_plane))
    return unknown


def _together(found: list[tuple[int, PlaneView, Rigid]], reach_mm: float) -> np.ndarray:
    """Returns the mask (n, n) of pairs of views that put their plane at the same place."""
    span = found[0][1].span_mm()
    corners = np.array([pose @ span for _, _, pose in found])
    return np.linalg.norm(corners[:, None] - corners, axis=3).max(2) < reach_mm


def _adjusted(arrangement: Arrangement, focal_px: float) -> Arrangement:
    """Adjusts the poses of images and planes to least reprojection error over the accepted views."""
    images, planes = list(arrangement.camera_from_group), list(arrangement.group_from_plane)
    rows = [(a, planes.index(v.plane), v) for a, i in enumerate(images) for v in arrangement.views[i]]
    if not rows:
        return arrangement
    bundle = PlaneBundle(
        np.concatenate([np.full(len(v.rows), a) for a, _, v in rows]),
        np.concatenate([np.full(len(v.rows), b) for _, b, v in rows]),
        np.concatenate([v.xyz_mm() for _, _, v in rows]),
        focal_px * np.concatenate([v.xy for _, _, v in rows]),
        focal_px,
    )
    poses, placed = bundle.adjusted(
        PoseStack.of(*(arrangement.camera_from_group[i] for i in images)),
        PoseStack.of(*(arrangement.group_from_plane[p] for p in planes)),
    )
    return replace(
        arrangement,
        camera_from_group={i: poses.rigid(a) for a, i in enumerate(images)},
        group_from_plane={p: placed.rigid(b) for b, p in enumerate(planes)},
    )


def _checked(images: Sequence[list[Readings]], found: Arrangement, step_mm: float) -> Arrangement:
    """Returns the arrangement with all readings compared with it, after its adjustment."""
    views, contradicted, unsettled = {}, {}, {}
    for i, pose in found.camera_from_group.items():
        agreed, ambiguous = _agreeing(images[i], pose, found.group_from_plane, MAX_SHIFT_PITCHES * step_mm, set())
        views[i] = tuple(v for v in agreed if _off_mm(v, pose, found.group_from_plane) < MAX_OFF_PITCHES * step_mm)
        accepted_ids = [id(v) for v in views[i]]
        others = [r for r in images[i] if not any(id(v) in accepted_ids for v in r)]
        contradicted[i] = tuple(r for r in others if not any(r is each for each in ambiguous))
        unsettled[i] = tuple(ambiguous)
    return replace(found, views=views, contradicted=contradicted, open=unsettled)


def _off_mm(view: PlaneView, camera_from_group: Rigid, known: dict[str, Rigid]) -> float:
    """Returns the median distance of circles from their places in the arrangement, at the depth of these places."""
    xyz = camera_from_group @ (known[view.plane] @ view.xyz_mm())
    return float(np.median(np.linalg.norm(view.xy * xyz[:, 2:] - xyz[:, :2], axis=1)))


def _without_reflections(found: Arrangement, patterns: dict[str, Pattern], reach_mm: float) -> Arrangement:
    """Removes planes that are the mirror image of another one.

    The mirror lies half way between the two, and cameras that see the image stand on the side of the real plane. (Two
    faces of a box may be each other's mirror images, too, but a camera that sees a face stands on its side.)
    """
    for real, image in permutations([p for p in found.group_from_plane if p != BOARD], 2):
        if not _reflected(found, patterns, real, image, reach_mm):
            continue
        found, removed = found.without({image})
        found = replace(found, reflected={i: found.reflected.get(i, ()) + views for i, views in removed.items()})
    return found


def _reflected(found: Arrangement, patterns: dict[str, Pattern], real: str, image: str, reach_mm: float) -> bool:
    """True if a plane is the mirror image of another one.

    In most images its circles are those of the mirrored design, radii included. They are where the mirror would show
    them, and no image that shows them is taken from behind the mirror."""
    if not {real, image} <= found.group_from_plane.keys():
        return False
    seen = _circles_seen(found, patterns, image)
    own, other = (found.group_from_plane[p] @ patterns[p].xyz_mm() for p in (real, image))
    for pairs in mirrored_as(patterns[real], patterns[image]):
        if not _in_most(seen, pairs):
            continue  # most images show circles, or radii, that the mirror image does not have
        mirror = _mirror(own[pairs[:, 0]], other[pairs[:, 1]], reach_mm)
        if mirror is None:
            continue
        normal, middle = mirror
        if all((found.camera_from_group[i].inverse().translation - middle) @ normal > 0 for i in seen):
            return True
    return False


def _circles_seen(found: Arrangement, patterns: dict[str, Pattern], face: str) -> dict[int, set[int]]:
    """Returns the circles of a face, as places in its pattern, by image."""
    labels = list(patterns[face].labels)
    views = {i: view for i, own in found.views.items() for view in own if view.plane == face}
    return {i: {labels.index(label) for label in view.labels} for i, view in views.items()}


def _in_most(seen: dict[int, set[int]], pairs: np.ndarray) -> bool:
    """True if most images show only circles of ``pairs``, second column."""
    return 2 * sum(circles <= set(pairs[:, 1].tolist()) for circles in seen.values()) > len(seen)


def _may_be_mirrored(found: Arrangement, patterns: dict[str, Pattern], face: str) -> bool:
    """True if the circles of a face in a group may be the mirror image of any face, itself included."""
    seen = _circles_seen(found, patterns, face)
    reals = [pattern for plane, pattern in patterns.items() if plane != BOARD]
    return any(_in_most(seen, pairs) for real in reals for pairs in mirrored_as(real, patterns[face]))


def _mirror(own: np.ndarray, other: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns normal, towards ``own``, and a point of the mirror plane half way in which circles (n, 3) appear as the
    others; None if they do not."""
    between = own.mean(0) - other.mean(0)
    if np.linalg.norm(between) < reach_mm:
        return None
    normal, middle = between / np.linalg.norm(between), (own.mean(0) + other.mean(0)) / 2
    turned = own - 2 * ((own - middle) @ normal)[:, None] * normal
    return (normal, middle) if np.linalg.norm(turned - other, axis=1).max() < reach_mm else None


def mirrored_images(
    found: Arrangement, images: Sequence[list[Readings]], patterns: dict[str, Pattern], reach_mm: float
) -> list[int]:
    """Returns the mirrored images of a group whose faces all pass for other faces.

    The reading of the board in such an image contradicts the group. Turned back, the image has its circles where the
    group has the circles of its faces.
    """
    return [
        i
        for i, contradicted in found.contradicted.items()
        if any(
            _is_mirrored(found, images[i], view, patterns, reach_mm)
            for views in contradicted
            for view in views
            if view.plane == BOARD
        )
    ]


def _is_mirrored(found: Arrangement, readings: list[Readings], board: PlaneView, patterns, reach_mm: float) -> bool:
    measured = [views[0].xy for views in readings if views[0].plane != BOARD]
    pose = flipped_pose(board, patterns[BOARD].xy_mm)
    if BOARD not in found.group_from_plane or not measured or pose is None:
        return False
    camera_from_group = pose @ found.group_from_plane[BOARD].inverse()
    planes = [camera_from_group @ (p @ patterns[k].xyz_mm()) for k, p in found.group_from_plane.items() if k != BOARD]
    xyz = np.concatenate(planes or [np.zeros((0, 3))])
    xyz = xyz[xyz[:, 2] > 0]
    if not len(xyz):
        return False
    apart, at = KDTree(xyz[:, :2] / xyz[:, 2:]).query(np.concatenate(measured) * [-1, 1])
    return bool(np.mean(apart * xyz[at, 2] < reach_mm) > MIN_MIRRORED)
