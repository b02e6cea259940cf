"""Covariances of faces and circles, and what each kind of observation contributes to them."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from stcal.design import TargetDesign
from stcal.geometry.arrays import rms
from stcal.geometry.camera import PARAMETER_NAMES
from stcal.geometry.clusters import released
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.adjust import chain, equations
from stcal.sfm.adjust.chain import CalibratedTarget, FrameKind
from stcal.sfm.adjust.equations import BOARD, CIRCLES, DOTS
from stcal.sfm.adjust.joint import Adjusted, JointResult

STEP_MM = 1e-3  # step of the central differences, in mm


@dataclass(frozen=True, slots=True, eq=False)
class Derivatives:
    """The target in its own frame, and its derivatives by the circles in the models' frame, mm."""

    target_from_face: dict[str, Rigid]
    xyz_target: np.ndarray  # (c, 3)
    target_from_model: Rigid
    faces: dict[str, np.ndarray]  # by face, (6, 3c + d) rad and mm, perturbation in the target frame
    circles: np.ndarray  # (c, 3, 3c + d), d in-plane places by the design of frame circles that were not mapped
    design_sigma_mm: float  # of these

    def whole(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns the covariance (3c + d, 3c + d) of circles and places by the design."""
        designed = self.circles.shape[2] - len(covariance_mm2)
        return block_diag(covariance_mm2, self.design_sigma_mm**2 * np.eye(designed)) if designed else covariance_mm2

    def by_circles(self) -> dict[str, np.ndarray]:
        """Returns the derivatives (6, 3c) of the faces by the circles alone."""
        return {face: own[:, : 3 * len(self.circles)] for face, own in self.faces.items()}

    def face_covariance(self, covariance_mm2: np.ndarray) -> dict[str, np.ndarray]:
        """Returns 6×6 by face from the covariance (3c, 3c) of the circles, in any datum."""
        whole = self.whole(covariance_mm2)
        return {face: own @ whole @ own.T for face, own in self.faces.items()}

    def distance_sigma_mm(self, covariance_mm2: np.ndarray) -> dict[tuple[str, str], float]:
        """Returns σ of the distance between the origins of every two faces."""
        sigma, whole = {}, self.whole(covariance_mm2)
        for a, b in combinations(self.target_from_face, 2):
            offset = self.target_from_face[b].translation - self.target_from_face[a].translation
            along = offset / np.linalg.norm(offset)
            apart = along @ (self.faces[b][3:] - self.faces[a][3:])
            sigma[a, b] = float(np.sqrt(max(apart @ whole @ apart, 0.0)))
        return sigma

    def circle_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns (c, 3, 3) mm², target frame, from the covariance (3c, 3c) of the circles."""
        c = np.arange(len(self.circles))
        return self.all_circles_covariance(covariance_mm2).reshape(len(c), 3, len(c), 3)[c, :, c]

    def all_circles_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns (3c, 3c) mm², target frame, of all circles together; singular, since they carry the frame."""
        by_circles = self.circles.reshape(3 * len(self.circles), -1)
        return by_circles @ self.whole(covariance_mm2) @ by_circles.T


def calibrated_target(
    result: JointResult,
    start: CalibratedTarget,  # gives the reference face and the side to which each face looks
    target: TargetDesign,
    kind: FrameKind,
    state: Adjusted | None = None,  # without it the contributions to the σ of positions are not computed
) -> CalibratedTarget:
    """Returns faces and circles of the adjusted target in the target frame, with their marginal covariances."""
    own = derivatives(result, start, target, kind)
    sources: dict[str, dict[str, np.ndarray]] = {}  # by face and kind of observation, part of σ of x, y, z, mm
    if state:
        positions = np.concatenate([jacobian[3:] for jacobian in own.by_circles().values()])
        variances = {
            kind: np.maximum(np.diag(matrix), 0.0) for kind, matrix in _parts_of(state, positions.T)[0].items()
        }
        sigma = {kind: result.sigma_scale * np.sqrt(v).reshape(-1, 3) for kind, v in variances.items() if v.any()}
        sources = {face: {kind: each[i] for kind, each in sigma.items()} for i, face in enumerate(own.faces)}
    return CalibratedTarget(
        reference_face=start.reference_face,
        target_from_face=own.target_from_face,
        circles=dict(zip(result.labels, own.xyz_target, strict=True)),
        target_from_group=dict.fromkeys(start.target_from_group, own.target_from_model),
        face_covariance=own.face_covariance(result.covariance_mm2),
        circle_covariance=dict(zip(result.labels, own.circle_covariance(result.covariance_mm2), strict=True)),
        distance_sigma_mm=own.distance_sigma_mm(result.covariance_mm2),
        scale_sigma=scale_sigma(result.xyz_model, result.covariance_mm2),
        covariance_mm2=own.all_circles_covariance(result.covariance_mm2),
        position_sources_mm=sources,
    )


def scale_sigma(xyz_model: np.ndarray, covariance_mm2: np.ndarray) -> float:
    """Returns the relative σ of the scale of the similarity between the adjusted and the true circles."""
    middle = xyz_model - xyz_model.mean(0)
    gradient = (middle / (middle**2).sum()).ravel()
    return float(np.sqrt(gradient @ covariance_mm2 @ gradient))


def derivatives(result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind) -> Derivatives:
    """Computes the derivatives of poses and circles in the target frame by all circles, by central differences."""
    mapped = width = 3 * len(result.labels)
    poses: dict[str, Rigid] = {}
    parts: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # columns, and derivatives of model_from_face by these
    for face in target.faces:
        if face.id not in start.target_from_face:
            continue
        rows = np.array([i for i, label in enumerate(result.labels) if label.face == face.id], int)
        names, towards = tuple(result.labels[i].circle for i in rows), start.target_from_face[face.id].rotation[:, 2]
        m, p = 3 * len(rows), len(chain.unmapped(face, names))
        moves, shifts = np.eye(m + 2 * p, m).reshape(m + 2 * p, len(rows), 3), np.zeros((m + 2 * p, p, 3))
        shifts[m:, :, :2] = np.eye(2 * p).reshape(2 * p, p, 2)
        place, ahead, behind = (
            chain.face_frames(face, names, result.xyz_model[rows] + h * moves, kind, towards, h * shifts)
            for h in (0, STEP_MM, -STEP_MM)
        )
        columns = np.append(equations.coordinates(rows), width + np.arange(2 * p))
        poses[face.id], parts[face.id] = place[0], (columns, ahead.difference(behind).T / (2 * STEP_MM))
        width += 2 * p
    by_model = {face_id: np.zeros((6, width)) for face_id in poses}
    for face_id, (columns, own) in parts.items():
        by_model[face_id][:, columns] = own
    target_from_model = poses[start.reference_face].inverse()
    frame, origin, turn = by_model[start.reference_face], poses[start.reference_face], target_from_model.rotation

    def in_target(place: np.ndarray, move: np.ndarray) -> np.ndarray:
        """Returns how a place (3,) changes in the target frame, which moves too; ``move`` (3, 3c + d) in the model."""
        return turn @ (move - frame[3:] + skew(place - origin.translation) @ frame[:3])

    by_face = {
        face_id: np.vstack([turn @ (by[:3] - frame[:3]), in_target(poses[face_id].translation, by[3:])])
        for face_id, by in by_model.items()
    }
    moves = np.eye(mapped, width).reshape(-1, 3, width)
    circles = np.array([in_target(*each) for each in zip(result.xyz_model, moves, strict=True)])
    places = {face_id: target_from_model @ pose for face_id, pose in poses.items()}
    sigma = chain.off_design_mm(target, result.labels, result.xyz_model) if width > mapped else 0.0
    return Derivatives(places, target_from_model @ result.xyz_model, target_from_model, by_face, circles, sigma)


FLATNESS, INTRINSICS, PRINT, SIZES, DISTANCES = "flatness", "intrinsics", "print", "sizes", "distances"
OBSERVED = (CIRCLES, DOTS, BOARD, FLATNESS, INTRINSICS, PRINT, SIZES, DISTANCES)
"""Kinds of observations: centres of circles and of dots in the images, positions of the dots on the board, flatness of
the faces, the given intrinsics if they are adjusted; shapes and sizes of faces of known shape, known distances."""


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """Contributions to the covariance of the c circles, in the datum of the adjustment."""

    joint: JointResult
    covariance_mm2: dict[str, np.ndarray]  # (3c, 3c) by kind of observation, adding up to that of ``joint``
    by_scale: np.ndarray  # (3c,) mm per relative error of the board's pitch
    by_intrinsics: np.ndarray  # (3c, 16) per error of the intrinsics if these are fixed, else zero
    centre_sigma_px: dict[str, float]  # of circles and of dots, RMS per axis, scaled by σ₀


def widened_result(state: Adjusted, covariance: dict[str, np.ndarray] | None = None) -> JointResult:
    """Returns the result of an adjustment, with covariances by how much its photographs differ."""
    joint, variance = state.result(), state.differ**2
    if variance <= 1:
        return joint
    of_kind = covariance or _parts_of(state)[0]
    added = (1 - 1 / variance) * joint.sigma_scale**2 * (of_kind[CIRCLES] + of_kind[DOTS])
    wider, of_camera = joint.covariance_mm2 + (added + added.T) / 2, variance * joint.camera_covariance
    return replace(joint, covariance_mm2=wider, camera_covariance=of_camera, differ=state.differ)


def contributions_of(state: Adjusted) -> Contributions:
    """Splits the covariance at the minimum of an adjustment into the contributions of the observations."""
    covariance, by_scale, by_intrinsics = _parts_of(state)
    joint = widened_result(state, covariance)
    variance = joint.sigma_scale**2
    parts = {kind: variance * (matrix + matrix.T) / 2 for kind, matrix in covariance.items()}
    sigma_px = {kind: state.differ * joint.sigma_scale * centre_sigma_px(state, kind) for kind in (CIRCLES, DOTS)}
    return Contributions(joint, parts, by_scale, by_intrinsics, sigma_px)


Parts = tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]
"""Effects of errors of the observations on k quantities, as the three in :class:`Contributions`; σ₀ is 1."""


def _parts_of(state: Adjusted, quantities: np.ndarray | None = None) -> Parts:
    """Returns the parts for quantities with derivatives (3c, k) by the circles, or for the 3c coordinates if None."""
    setting, solution = state.setting, state.solution
    camera, xyz = state.camera, solution.values[CIRCLES].array
    k = xyz.size if quantities is None else quantities.shape[1]

    def along_quantities(inverse: np.ndarray) -> np.ndarray:
        own = inverse[:, : xyz.size]
        return own if quantities is None else own @ quantities

    covariance = {kind: np.zeros((k, k)) for kind in OBSERVED}
    by_scale, by_intrinsics = np.zeros(k), np.zeros((k, len(PARAMETER_NAMES)))
    for group, model, part in zip(setting.groups, state.models, solution.whole, strict=True):
        along = along_quantities(part.inverse)
        pitch = (group.design @ group.board_at(solution.values).rotation.T / setting.own_sigma_mm()).ravel()
        for rows, batch, total in part.effects(along):
            (kind,), flat = rows.factor.kinds, total.reshape(-1, k)
            covariance[kind] += (state.differ**2 if kind in (CIRCLES, DOTS) else 1.0) * flat.T @ flat
            if kind == BOARD and len(rows.factor.on) > 1:
                by_scale += flat.T @ pitch[3 * batch.start : 3 * batch.stop]
            elif kind != BOARD and not setting.basis.shape[1]:
                seen = model.observed(group.observations(kind)[batch])
                lens = seen.whiten(seen.by_parameters(camera)) * np.sqrt(rows.weight[batch])[:, None, None]
                by_intrinsics += flat.T @ lens.reshape(len(flat), -1)
    inverse = along_quantities(solution.inverse)
    intrinsics = inverse[solution.parts[0].places[equations.CAMERA]]
    covariance[INTRINSICS] += intrinsics.T @ setting.prior @ intrinsics
    for kind, known in ((FLATNESS, equations.planes), (DISTANCES, equations.bars)):
        for members, slope, _, sigma in known(xyz, setting):
            rows = slope @ inverse[equations.coordinates(members)] / sigma
            covariance[kind] += rows.T @ rows
    for shape in equations.shapes(xyz, setting):
        rows = inverse[equations.coordinates(shape.members)]
        by_size = rows.T @ shape.by_size()
        covariance[SIZES] += np.outer(by_size, by_size)
        covariance[PRINT] += rows.T @ shape.normal() @ rows - np.outer(by_size, by_size)
    return covariance, by_scale, by_intrinsics


def centre_sigma_px(state: Adjusted, kind: str) -> float:
    """Returns the RMS of the centres' σ per axis, as used for the weights."""
    sigma = np.concatenate([group.model.sigma_px()[group.observations(kind)] for group in state.setting.groups])
    return rms(sigma) if len(sigma) else 0.0


def with_scatter(state: Adjusted, start: CalibratedTarget, target: TargetDesign, kind: FrameKind) -> Adjusted:
    """Returns an adjustment that knows by how much its photographs differ more than their pixels explain; arguments as
    of :func:`calibrated_target`. One factor pools all faces and groups: how far the photographs' pulls on a face
    scatter over what independent errors of pixels would do, as few photographs show a face. A photograph's residuals
    are corrected for its part in the answer (CR2, Bell & McCaffrey 2002)."""
    result = state.result()
    by_circles = [own for own in derivatives(result, start, target, kind).by_circles().values() if own.any()]
    if not by_circles:
        return state
    faces = np.concatenate(by_circles)
    extensible, camera, basis = state.extensible(), state.camera, state.setting.basis
    scatter, told = np.zeros((2, len(faces), len(faces)))
    for model in state.models:
        points, to_faces = extensible.points[model.group], extensible.to_circles[model.group] @ faces.T
        for rows in model.rows_by_image():
            view = model.observed(rows)
            root = np.repeat(np.sqrt(equations.robust_weights(view, camera, state.setting.huber)), 2)
            rows_of = equations.RowsOfView.of(view, camera, basis, root)
            expected = rows_of.along(to_faces).T
            residual = rows_of.free(root * equations.normalised(view, camera).ravel())
            pull = expected @ released(residual, rows_of.square(points))
            scatter += np.outer(pull, pull)
            told += expected @ expected.T
    own_parts = [(slice(i, i + 6), slice(i, i + 6)) for i in range(0, len(faces), 6)]
    ratios = [np.trace(np.linalg.lstsq(told[own], scatter[own], rcond=None)[0]) / 6 for own in own_parts]
    return replace(state, differ=max(1.0, float(np.sqrt(np.mean(ratios))) / max(1.0, result.sigma0)))
