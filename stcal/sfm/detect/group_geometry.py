"""The rigid arrangement of the planes of one group, the poses of its images, and circles that do not fit them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from stcal.adjust.blocks import Huber
from stcal.adjust.engine import Adjustment
from stcal.geometry.plane import circle_image_offset
from stcal.geometry.rigid import Poses, Rigid, by_pose
from stcal.labels import BOARD, Label
from stcal.sfm.data.group_model import FAR_DEG, ImageObservations
from stcal.sfm.data.patterns import Pattern
from stcal.sfm.detect.sightings import PlaneView, Readings

MAX_SHIFT_PITCHES = 0.3
"""Largest deviation of a plane from its place in an image's first pose, in steps; a wrong numbering deviates by one."""
MAX_SEEDS = 8
"""Largest number of start images, until one explains everything."""
MAX_OFF_PITCHES = 0.12
"""Largest median deviation of a reading's circles after the adjustment, in steps: 3 mm for the reference target."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """Rigid arrangement of the planes of a group, with the poses of its images; readings by image."""

    group_from_plane: dict[str, Rigid]  # by plane
    camera_from_group: dict[int, Rigid]  # by image
    views: dict[int, tuple[PlaneView, ...]]  # accepted readings
    contradicted: dict[int, tuple[Readings, ...]] = field(default_factory=dict)  # readings that do not fit
    open: dict[int, tuple[Readings, ...]] = field(default_factory=dict)  # boards with several numberings that fit
    # readings of a plane that other groups, or its rough pose, have elsewhere
    foreign: dict[int, tuple[PlaneView, ...]] = field(default_factory=dict)

    def without(self, planes: set[str]) -> "Arrangement":
        """Returns the arrangement without some planes, whose readings are then ``foreign``."""
        gone = {i: tuple(v for v in views if v.plane in planes) for i, views in self.views.items()}
        return replace(
            self,
            group_from_plane={p: pose for p, pose in self.group_from_plane.items() if p not in planes},
            views={i: tuple(v for v in views if v.plane not in planes) for i, views in self.views.items()},
            foreign={i: self.foreign.get(i, ()) + views for i, views in gone.items()},
        )

    def stacks(self) -> tuple[Poses, Poses]:
        """Returns the poses of the images, and those of the planes."""
        return Poses.of(self.camera_from_group.values()), Poses.of(self.group_from_plane.values())

    def moved(self, cameras: Poses, planes: Poses) -> "Arrangement":
        """Returns the arrangement with other poses, in the order of :meth:`stacks`."""
        return replace(
            self,
            camera_from_group={i: cameras[a] for a, i in enumerate(self.camera_from_group)},
            group_from_plane={p: planes[b] for b, p in enumerate(self.group_from_plane)},
        )

    def explained(self) -> int:
        """Returns the number of circles of the readings that fit."""
        return sum(len(view.rows) for views in self.views.values() for view in views)


def arrange(images: Sequence[list[Readings]], step_mm: float, focal_px: float) -> Arrangement:
    """Arrangement that explains most circles; ``step_mm`` between circles is the least error of a wrong reading."""
    total = sum(len(views[0].rows) for readings in images for views in readings if views[0].named)
    best = Arrangement({}, {}, {})
    for i, reading in _seeds(images):
        if any(reading is view for view in best.views.get(i, ())):
            continue  # a start with this image gives the same arrangement
        found = _adjusted(_grown(images, i, reading, MAX_SHIFT_PITCHES * step_mm), focal_px)
        best = max(best, _checked(images, found, step_mm), key=Arrangement.explained)
        if best.explained() >= total:
            break
    return best


def as_drawn(found: Arrangement, rough_poses: Mapping[str, Rigid]) -> Arrangement:
    """Arrangement without faces turned by more than ``FAR_DEG`` against most others from their rough poses."""
    circles = Counter(view.plane for views in found.views.values() for view in views for _ in view.rows)
    turn = {
        p: (pose @ rough_poses[p].inverse()).rotation for p, pose in found.group_from_plane.items() if p in rough_poses
    }
    agreed = {p: {q for q in turn if Rigid(turn[p].T @ turn[q]).angle_rad() <= np.radians(FAR_DEG)} for p in turn}
    most = max(agreed.values(), key=lambda planes: sum(circles[p] for p in planes), default=set())
    return found.without(turn.keys() - most)


def across_groups(groups: Sequence[Arrangement], reach_mm: float) -> list[Arrangement]:
    """Compares the arrangements, as faces have the same relative poses in all groups. A face that most groups have
    elsewhere is removed, and the last face with the others: alone it may be mirrored. A face known from other groups is
    added; the second look decides."""
    faces = [_as_faces(group) for group in groups]
    grown = (_grown(faces, i, view, reach_mm) for i, view in _seeds(faces))
    best = max((Arrangement({}, {}, {}), *grown), key=Arrangement.explained)
    settled = []
    for i, group in enumerate(groups):
        if i in best.views:
            agreed = {view.plane for view in best.views[i]}
            others = group.group_from_plane.keys() - agreed - {BOARD}
            if len(agreed) == 1 < len(groups) and (others or any(group.foreign.values())):
                settled.append(group.without(others | agreed))
                continue
            pose = best.camera_from_group[i]
            known = {p: pose @ target_from_face for p, target_from_face in best.group_from_plane.items()}
            group = group.without(others)
            group = replace(group, group_from_plane=known | group.group_from_plane)
        settled.append(group)
    return settled


def _as_faces(group: Arrangement) -> list[Readings]:
    """Returns the faces of a group in the form of an image's readings, with a row for each observed circle."""
    views_of_plane: dict[str, list[PlaneView]] = {}
    for view in chain.from_iterable(group.views.values()):
        if view.plane != BOARD and view.plane in group.group_from_plane:
            views_of_plane.setdefault(view.plane, []).append(view)
    faces = []
    for plane, views in views_of_plane.items():
        first, area = max(views, key=lambda view: len(view.rows)), sum(view.area for view in views)
        rows, pose = np.concatenate([view.rows for view in views]), group.group_from_plane[plane]
        faces.append([replace(first, rows=rows, area=area, camera_from_plane=pose, named=True)])
    return faces


def _seeds(images: Sequence[list[Readings]]) -> list[tuple[int, PlaneView]]:
    """Returns readings to start from, the most reliable image first: the board of an image, or its largest face."""
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
    others = [views for views in images[seed] if not any(each is view for each in views)]
    alternatives = sum(map(len, images[seed])) - sum(map(len, others))
    # If the numbering of the first image is a convention, the board alone cannot place another image.
    by_convention = view.plane == BOARD and alternatives > 1
    while True:
        placed = {i: found for i, r in enumerate(images) if (found := _placed(r, known, reach_mm, by_convention))}
        pose = view.camera_from_plane @ known[view.plane].inverse()
        placed[seed] = pose, [view, *_agreeing(others, pose, known, reach_mm, {view.plane})[0]]
        new = _new_planes(images, placed, known, reach_mm)
        if not new:
            break
        known |= new
    poses = {i: pose for i, (pose, _) in placed.items()}
    return Arrangement(known, poses, {i: tuple(views) for i, (_, views) in placed.items()})


def _placed(readings: list[Readings], known: dict[str, Rigid], reach_mm: float, by_convention: bool):
    """Pose of an image with the most planes, then faces, and the readings that agree; None if several fit."""
    best, best_score, rivals = None, (0, 0, 0), 0
    for views in readings:
        others = [v for v in readings if v is not views]
        for view in (each for each in views if each.plane in known):
            pose = view.camera_from_plane @ known[view.plane].inverse()
            agreed = [view, *_agreeing(others, pose, known, reach_mm, {view.plane})[0]]
            faces = sum(v.plane != BOARD and v.named for v in agreed)
            score = (len(agreed), faces, sum(len(v.rows) for v in agreed))
            if score > best_score:
                best, best_score, rivals = (pose, agreed), score, 0
            elif best is not None and score == best_score:  # a rival, unless both put the plane at one place
                span = best[1][0].span_mm()
                rivals += np.abs(best[0].inverse() @ pose @ span - span).max() >= reach_mm
    if best is None:
        return None
    agreed = best[1]
    of_board = by_convention and agreed[0].plane == BOARD and len(readings) > 1
    if len(agreed) == 1 and (rivals or of_board or not agreed[0].named):
        return None
    return None if rivals and not all(v.named for v in agreed) else best


def _agreeing(readings: list[Readings], camera_from_group: Rigid, known, reach_mm: float, taken: set[str]):
    """Returns the readings that agree with the arrangement, each plane once, and circles with several such readings."""
    agreed, ambiguous, ranked = [], [], []
    for views in readings:
        inside = [(k, view) for k, view in enumerate(views) if view.plane in known]
        shifts = sorted((_shift_mm(view, camera_from_group, known), k) for k, view in inside)
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
    """Poses of unknown planes that images name, each at the place with the largest area: a target in the background is
    smaller. Else that of the plane without a name that most images, two at least, have at one place."""
    unknown: dict[bool, dict[str, list[tuple[int, PlaneView, Rigid]]]] = {True: {}, False: {}}
    for i, (pose, agreed) in placed.items():
        for views in images[i]:
            for view in () if any(view is each for view in views for each in agreed) else views:
                if view.plane not in known:
                    group_from_plane = pose.inverse() @ view.camera_from_plane
                    unknown[view.named].setdefault(view.plane, []).append((i, view, group_from_plane))
    new = {}
    for plane, found in unknown[True].items():
        support = _together(found, reach_mm) @ np.array([view.area for _, view, _ in found])
        new[plane] = found[int(np.argmax(support))][2]
    ranked = []
    for plane, found in unknown[False].items() if not new else ():
        by_image = np.array([i for i, _, _ in found])
        support = [len(np.unique(by_image[row])) for row in _together(found, reach_mm)]
        k = int(np.argmax(support))
        ranked.append((support[k], plane, found[k][2]))
    ranked.sort(key=lambda each: -each[0])
    if ranked and ranked[0][0] >= 2 and (len(ranked) == 1 or ranked[1][0] < ranked[0][0]):
        new[ranked[0][1]] = ranked[0][2]
    return new


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
    return arrangement.moved(*bundle.adjusted(*arrangement.stacks()))


def _checked(images: Sequence[list[Readings]], found: Arrangement, step_mm: float) -> Arrangement:
    """Returns the arrangement with all readings compared with it, after its adjustment."""
    views, contradicted, unsettled = {}, {}, {}
    for i, pose in found.camera_from_group.items():
        agreed, ambiguous = _agreeing(images[i], pose, found.group_from_plane, MAX_SHIFT_PITCHES * step_mm, set())
        accepted = []
        for view in agreed:
            xyz = pose @ (found.group_from_plane[view.plane] @ view.xyz_mm())
            off_mm = np.linalg.norm(view.xy * xyz[:, 2:] - xyz[:, :2], axis=1)
            accepted += [view] * bool(np.median(off_mm) < MAX_OFF_PITCHES * step_mm)
        left = [r for r in images[i] if not any(v is each for v in r for each in accepted)]
        views[i], unsettled[i] = tuple(accepted), tuple(ambiguous)
        contradicted[i] = tuple(r for r in left if not any(r is each for each in ambiguous))
    return replace(found, views=views, contradicted=contradicted, open=unsettled)


HUBER_PX = 1.5
"""Residual beyond which an observation loses weight: such residuals are of printed planes, not of centres."""
BUNDLE_SETTLED = 1e-4
"""Relative decrease of χ² at convergence. A prediction to a fraction of a pixel is sufficient."""
BUNDLE_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class PlaneBundle:
    """Points of planes: ``image``, ``plane`` (n,); ``xyz`` (n, 3) in the plane; ``seen`` (n, 2) measured, ideal px."""

    image: np.ndarray
    plane: np.ndarray
    xyz: np.ndarray
    seen: np.ndarray
    focal_px: float

    def select(self, keep: np.ndarray) -> "PlaneBundle":
        """Returns the points of the mask ``keep``."""
        return PlaneBundle(self.image[keep], self.plane[keep], self.xyz[keep], self.seen[keep], self.focal_px)

    def adjusted(self, poses: Poses, planes: Poses) -> tuple[Poses, Poses]:
        """Returns the poses camera_from_world of the m images and world_from_plane of the planes; the first plane is
        fixed. Without convergence the last state is returned, and the start where a point lies behind its camera:
        predictions are verified anyway."""
        if not np.isfinite(self._off(planes, poses)).all():
            return poses, planes
        a = Adjustment()
        placed, cameras = a.block("planes", planes, fixed=[0]), a.block("cameras", poses, eliminate=True)
        on = [(placed, self.plane), (cameras, self.image)]
        a.factor(self._off, on, derivatives=self._slopes, loss=Huber(HUBER_PX))
        found = a.minimum(settled=BUNDLE_SETTLED, max_steps=BUNDLE_STEPS, damping=1e-3).state
        return found["cameras"], found["planes"]

    def _off(self, planes: Poses, poses: Poses) -> np.ndarray:
        xyz = self.placed(planes, poses)[2]
        if (xyz[:, 2] <= 0).any():
            return np.full(self.seen.shape, np.inf)
        return self.focal_px * xyz[:, :2] / xyz[:, 2:] - self.seen

    def _slopes(self, planes: Poses, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        turned, placed, xyz = self.placed(planes, poses)
        by_point = self.by_point(xyz)
        by_world = by_point @ poses.rotation[self.image]
        return by_pose(by_world, turned), by_pose(by_point, placed)

    def by_point(self, xyz_camera: np.ndarray) -> np.ndarray:
        """Returns the derivatives of images by points in the camera frame, (n, 2, 3), px/mm."""
        by_point = np.zeros((len(xyz_camera), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1
        by_point[:, :, 2] = -xyz_camera[:, :2] / xyz_camera[:, 2:]
        by_point *= (self.focal_px / xyz_camera[:, 2])[:, None, None]
        return by_point

    def placed(self, planes: Poses, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the points turned into the world, turned into the cameras, and in the cameras' frames, (n, 3)."""
        turned = np.einsum("nij,nj->ni", planes.rotation[self.plane], self.xyz)
        placed = np.einsum("nij,nj->ni", poses.rotation[self.image], turned + planes.translation[self.plane])
        return turned, placed, placed + poses.translation[self.image]

    def in_cameras(self, planes: Poses, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Returns rotations camera_from_plane (n, 3, 3), and the points in the cameras' frames (n, 3)."""
        return poses[self.image].rotation @ planes[self.plane].rotation, self.placed(planes, poses)[2]


MIN_LIMIT_PX = 0.5
"""Largest deviation that never counts as outlying. Centres are good to hundredths, designs to tenths."""
BEYOND = 4.0
"""Factor on the median deviation of the plane's circles: 4.7 σ of normal errors, exceeded by one in 60 000."""
BEYOND_SIGMA = 5.0
"""Smallest outlying distance in σ of the centre; one normal error in 270 000 is larger (two coordinates)."""
MIN_USUAL = 6
"""Least number of circles for a plane's own pose and median; those of other planes are judged by the median of all."""
ALIKE = 0.5
"""Relative difference up to which a circle's deviation in another image counts as the same."""
MAX_ROUNDS = 10


def outlying_circles(
    arrangement: Arrangement, images: Sequence[ImageObservations], patterns: dict[str, Pattern], focal_px: float
) -> tuple[Arrangement, dict[int, dict[Label, str]]]:
    """Finds circles that contradict the others of their group; returns the arrangement adjusted without them, the same
    object if there are none, and reasons by image and label."""
    names = list(arrangement.group_from_plane)
    design = {
        label: (k, *xyz, radius)
        for k, pattern in enumerate(patterns[plane] for plane in names)
        for label, xyz, radius in zip(pattern.labels, pattern.xyz_mm(), pattern.radius_mm, strict=True)
    }
    rows, table = [], []
    for a, i in enumerate(arrangement.camera_from_group):
        for label, centre, sigma in zip(images[i].labels, images[i].centre, images[i].sigma_px(), strict=True):
            if label in design:
                rows.append((i, label))
                table.append((a, *design[label], *centre, sigma))
    if not rows:
        return arrangement, {}
    numbers = np.array(table, float)
    image, plane = numbers[:, :2].astype(int).T
    cameras, planes = arrangement.stacks()
    bundle = PlaneBundle(image, plane, numbers[:, 2:5], focal_px * numbers[:, 6:8], focal_px)
    rotation, xyz = bundle.in_cameras(planes, cameras)
    centre = circle_image_offset(xyz, rotation[:, :, 2], numbers[:, 5])
    eccentricity_px = focal_px * (centre[:, :2] / centre[:, 2:] - xyz[:, :2] / xyz[:, 2:])
    bundle = replace(bundle, seen=bundle.seen - eccentricity_px)
    shown = np.array([len(np.unique(image[plane == p])) for p in range(len(names))])
    alone = (shown[plane] == 1) & [label.plane != BOARD for _, label in rows]
    circles = _Circles(rows, bundle, numbers[:, 8], alone, np.bincount(plane)[plane] >= MIN_USUAL)
    keep, reasons = np.ones(len(rows), bool), {}
    for _ in range(MAX_ROUNDS):
        if (use := keep & circles.enough).any():
            cameras, planes = bundle.select(use).adjusted(cameras, planes)
        new = circles.worst(keep, planes, cameras)
        if not new:
            break
        reasons |= new
        keep[list(new)] = False
    found: dict[int, dict[Label, str]] = {}
    for (i, label), reason in ((rows[k], reason) for k, reason in reasons.items()):
        found.setdefault(i, {})[label] = reason
    return arrangement.moved(cameras, planes) if found else arrangement, found


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """n circles of a group."""

    rows: list[tuple[int, Label]]  # image and label of each
    bundle: PlaneBundle  # by places in the arrangement; the images of the circles' centres, without eccentricity
    sigma_px: np.ndarray
    alone: np.ndarray  # (n,) those of faces that only one image shows
    enough: np.ndarray  # (n,) those on planes with enough circles

    def worst(self, keep: np.ndarray, planes: Poses, cameras: Poses) -> dict[int, str]:
        """Returns the worst outlying circle to ``keep`` of each plane and image, as it biases the others."""
        image, plane = self.bundle.image, self.bundle.plane
        rotation, xyz = self.bundle.in_cameras(planes, cameras)
        shift = self.bundle.seen - self.bundle.focal_px * (xyz[:, :2] / xyz[:, 2:])
        by_place = self.bundle.by_point(xyz) @ rotation[:, :, :2]
        off_px, limit = np.linalg.norm(shift, axis=1), np.maximum(MIN_LIMIT_PX, BEYOND_SIGMA * self.sigma_px)
        usual = np.full(len(off_px), np.median(off_px[keep]))
        for p in np.unique(plane[keep & self.enough]):
            usual[plane == p] = np.median(off_px[keep & (plane == p)])
        limit = np.where(self.alone & self.enough, limit, np.maximum(limit, BEYOND * usual))
        outlying = keep & (off_px > limit)
        moved_mm = np.linalg.solve(by_place, shift[..., None])[..., 0]
        for k in np.flatnonzero(outlying):
            same = keep & (image != image[k]) & [label == self.rows[k][1] for _, label in self.rows]
            apart_px = np.linalg.norm((moved_mm[same] - moved_mm[k]) @ by_place[k].T, axis=1)
            outlying[k] = not (apart_px < ALIKE * off_px[k]).any()
        reasons: dict[int, str] = {}
        for i, p in {(image[k], plane[k]) for k in np.flatnonzero(outlying)}:
            of_plane = np.flatnonzero(keep & (image == i) & (plane == p))
            worst = int(of_plane[np.argmax(np.where(outlying, off_px / limit, 0)[of_plane])])
            error = f"{off_px[worst]:.3g} px from its place, {limit[worst]:.3g} allowed"
            if self.alone[worst] and self.enough[worst]:
                why = f"{self.rows[worst][1]} is {error}, and no other image of the group tells which circles are right"
                reasons |= dict.fromkeys(of_plane.tolist(), why)
            else:
                reasons[worst] = error
        return reasons
