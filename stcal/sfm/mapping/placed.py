"""Models of the groups of a body whose faces of known shape are placed, and the camera if none is given."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import FaceDesign
from stcal.errors import ConvergenceError, DegenerateError, MappingError
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Rigid
from stcal.labels import Label
from stcal.sfm.data.group_model import ImageObservations, Outlier, WorldModel
from stcal.sfm.mapping.body import (
    FOCAL_STEPS,
    MIN_CORNERS,
    Body,
    Corners,
    adjust_body,
    contradictions,
    place_body,
    settled_body,
    wrong_sizes,
)
from stcal.sfm.mapping.incremental import (
    MAX_REPROJECTION_PX,
    MIN_RAY_ANGLE_RAD,
    complete,
    rays_of,
    widest_angle_rad,
)
from stcal.sfm.mapping.models import assemble
from stcal.sfm.mapping.pairs import PairScore

BY_FACES = "faces of known shape, placed together"
LENS = "OPENCV"  # model of an unknown camera
SIGMA_FOCAL, SIGMA_SQUARE = 0.5, 2e-3
"""Relative σ of the focal length of an unknown camera, and of the ratio of its two focal lengths."""
SIGMA_CENTRE = 0.03  # σ of its principal point, in longer image sides
SIGMA_RADIAL, SIGMA_TANGENTIAL = np.array([0.3, 0.1]), 0.003
"""σ of its distortion, as shares of a corner's distance from the middle of the image: lenses of cameras have no more,
and few or small faces would take noise for it."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBody:
    """A body with the faces and images that are placed."""

    body_from_face: dict[str, Rigid]
    camera_from_body: dict[str, Rigid]
    faces: tuple[FaceDesign, ...]
    camera: Camera  # with the covariance of the assumptions about an unknown one
    unlinked: tuple[str, ...]  # faces that are seen, and never with a placed one
    contradictions: tuple[Outlier, ...]  # corners that lie elsewhere than the body has them

    def unlinked_notes(self) -> list[str]:
        """Returns a note for each face of known shape that no image shows together with one that is placed."""
        return [
            f"face {face}: left out, no image shows it with a face that is linked to the others, by {MIN_CORNERS} "
            "corners each; add one that does"
            for face in self.unlinked
        ]


def plain_lens(camera: Camera) -> Camera:
    """Returns a camera of this focal length with a tenth of the σ of :func:`unknown_lens` about no distortion and a
    principal point in the middle: for images that do not tell these."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    lens = unknown_lens(replace(camera, centre=middle, distortion=np.zeros_like(camera.distortion)))
    assert lens.covariance is not None
    share = np.where(np.arange(len(lens.covariance)) < 2, 1.0, 0.1)
    return replace(lens, covariance=lens.covariance * np.outer(share, share))


def unknown_lens(camera: Camera) -> Camera:
    """Returns a camera with the weak prior of an unknown lens, a covariance about its own values."""
    side = max(camera.width, camera.height)
    reach = float(np.hypot(camera.width, camera.height) / 2 / camera.focal.mean())
    radial, tangential = SIGMA_RADIAL / reach ** np.array([2.0, 4.0]), SIGMA_TANGENTIAL / reach
    sigma = np.concatenate([[1.0, 1.0], [SIGMA_CENTRE * side] * 2, radial, [tangential] * 2])
    covariance, focal = np.diag(sigma**2), float(camera.focal.mean())
    covariance[:2, :2] = focal**2 * (SIGMA_FOCAL**2 * np.ones((2, 2)) + SIGMA_SQUARE**2 / 2 * np.eye(2))
    return Camera.of(camera, LENS, covariance)


def place_with_camera(
    observations: Sequence[ImageObservations], faces: Sequence[FaceDesign], camera: Camera
) -> PlacedBody:
    """Returns the body by its faces, with a known camera; for faces of circles the design is a start."""
    corners = Corners.of(observations, faces)
    _require_sizes(corners, camera)
    body = settled_body(place_body(corners, camera), corners, np.zeros((16, 0)), np.zeros((0, 0)), camera)
    return _named(body, corners, camera)


def place_and_find_camera(
    observations: Sequence[ImageObservations], faces: Sequence[FaceDesign], starts: Sequence[Camera]
) -> PlacedBody:
    """Body by faces of known shape and the camera, of least cost from ``starts`` and several focal lengths."""
    corners = Corners.of(observations, faces)
    side, first = max(starts[0].width, starts[0].height), starts[0]
    cameras = [*starts, *(replace(first, focal=np.full(2, step * side)) for step in FOCAL_STEPS)]
    _require_sizes(corners, first)
    bodies = [body for camera in cameras if (body := _with_focal_length(corners, camera)) is not None]
    best = max(bodies, key=lambda body: (int(body.placed_images.sum()), -body.cost), default=None)
    if best is None:
        raise MappingError(
            "E-BODY-NO-CAMERA",
            f"camera: no focal length of {cameras[-1].focal[0]:.0f} px and less explains the views of the faces; check "
            "the sizes in target.toml, or give a camera file with --camera",
        )
    lens = unknown_lens(best.camera)
    assert lens.covariance is not None
    basis, prior = intrinsic_basis(LENS), np.linalg.inv(lens.covariance)
    with suppress(ConvergenceError):  # a lens that folds the image: the adjustment of all begins without distortion
        best = settled_body(best, corners, basis, prior, lens)
    return _named(best, corners, unknown_lens(best.camera))


def _require_sizes(corners: Corners, camera: Camera) -> None:
    """Refuses faces of which some are drawn at another size than the others. A rough camera is enough."""
    wrong, alike = wrong_sizes(corners, camera)
    if not wrong:
        return
    names, factors = [corners.faces[face].id for face in wrong], list(wrong.values())
    if alike < len(names):
        told = (
            f"sizes of faces {' and '.join(names)} contradict one another: by the photographs, face {names[-1]} is "
            f"{factors[-1] / factors[0]:.3g} times as large against face {names[0]} as target.toml states; measure the "
            "side of each print"
        )
    else:
        each = ", ".join(f"face {name} {v:.3g}" for name, v in zip(names, factors, strict=True))
        told = (
            f"the photographs show {each} times as large as target.toml states, and the sizes of {alike} other faces "
            "agree with one another; measure the side of its print"
        )
    raise MappingError("E-BODY-SIZES", f"target: {told}, and correct it")


def _with_focal_length(corners: Corners, camera: Camera) -> Body | None:
    """Returns the body with an adjusted focal length, None if there is none from this start."""
    basis = intrinsic_basis("SIMPLE_PINHOLE")[:, :1]
    try:
        for _ in range(2):  # the reflections are chosen again with the better camera
            prior = np.array([[(2 * camera.focal[0]) ** -2]])
            body = adjust_body(place_body(corners, camera), corners, basis, prior, camera)
            camera = body.camera
        return body
    except (ConvergenceError, DegenerateError, np.linalg.LinAlgError):
        return None


def _named(body: Body, corners: Corners, camera: Camera) -> PlacedBody:
    placed = np.flatnonzero(body.placed_faces).tolist()
    return PlacedBody(
        {corners.faces[f].id: body.body_from_face[f] for f in placed},
        {corners.images[i]: body.camera_from_body[i] for i in np.flatnonzero(body.placed_images).tolist()},
        tuple(corners.faces[f] for f in placed),
        camera,
        tuple(corners.faces[f].id for f in np.flatnonzero(~body.placed_faces) if (corners.face == f).any()),
        tuple(contradictions(body, corners)),
    )


def model_of_body(body: PlacedBody, group: Sequence[ImageObservations], camera: Camera) -> WorldModel:
    """Returns the model of a group: placed images, points that two of them see, and what these determine further."""
    placed = [image for image in group if image.name in body.camera_from_body]
    if len(placed) < 2:
        raise MappingError(
            "E-BODY-FEW-IMAGES",
            f"group {group[0].group}: {len(placed)} of {len(group)} images show faces of known shape well enough, 2 "
            "needed; add images that each show two faces",
        )
    designed: dict[Label, np.ndarray] = {
        label: xyz
        for face in body.faces
        for label, xyz in zip(face.labels(), body.body_from_face[face.id] @ face.places_mm(face.ids), strict=True)
    }
    rays = rays_of(placed, body.camera_from_body, designed)
    xyz = {label: designed[label] for label, (_, ray) in rays.items() if widest_angle_rad(ray) > MIN_RAY_ANGLE_RAD}
    poses = [body.camera_from_body[image.name] for image in placed]
    model = assemble(WorldModel, group[0].group, placed, poses, xyz)
    return complete(model, list(group), camera, MAX_REPROJECTION_PX)


def pair_of_model(model: WorldModel) -> PairScore:
    """Returns the pair of images with most points in common: a report names one for each group."""
    sees = np.zeros((len(model.images), len(model.labels)), bool)
    sees[model.image_index, model.point_index] = True
    shared = np.triu(sees.astype(int) @ sees.T.astype(int), 1)
    i, j = np.unravel_index(int(shared.argmax()), shared.shape)
    pose = model.camera_from_model[j] @ model.camera_from_model[i].inverse()
    both = model.xyz_model[sees[i] & sees[j]]
    towards = [both - model.camera_from_model[k].inverse().translation for k in (i, j)]
    cosine = (towards[0] * towards[1]).sum(1) / np.prod([np.linalg.norm(ray, axis=1) for ray in towards], axis=0)
    angle = float(np.median(np.arccos(np.clip(cosine, -1, 1)))) if len(both) else 0.0
    length = float(np.linalg.norm(pose.translation)) or 1.0
    return PairScore(
        model.images[i],
        model.images[j],
        int(shared[i, j]),
        angle,
        1.0,
        abs(float(pose.translation[2])) / length,
        Rigid(pose.rotation, pose.translation / length),
        "chosen",
    )
