"""Checks of the faces: parts of the images against one another, groups against groups, circles against their plane."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid, skew
from stcal.parallel import run_in_order
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration
from stcal.sfm.adjust.chain import CalibratedTarget, FaceChain, measure_chains
from stcal.sfm.adjust.joint import SETTLED_PX, JointResult, adjust_part
from stcal.sfm.adjust.refine import Network
from stcal.sfm.adjust.uncertainty import calibrated_target, result_of
from stcal.sfm.checks.significance import Guilt, Trial, assess
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.report.check import SUSPICIOUS, Check, TestedValue, impossible

MIN_HALF = 2
"""Smallest number of images of a group in each half."""
EXPLAINED = 0.05
"""Smallest share of the variance that a group must add in a tested direction; below it, rounding would be tested."""
MICRO = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Again:
    """Input of further adjustments of parts of a run, which begin at its ``joint`` result and keep its intrinsics."""

    calibration: Calibration
    joint: JointResult
    target: TargetDesign
    board: BoardDesign
    options: AdjustOptions

    def loop_remedy(self) -> str:
        """Returns what makes comparisons of groups possible; nothing where all images are one group without a board."""
        needed = self.board.rows or len(self.joint.models) > 1
        return "add a group that closes a loop of faces" if needed else ""

    def adjust(self, parts: Sequence[Sequence[MetricModel]]) -> list[JointResult | StcalError]:
        """Adjusts parts of the models as the run did; returns the error of a part that has no result."""
        jobs = [(models, self.board, self.options.flatness_mm, self.joint) for models in parts]
        return run_in_order(_adjusted, jobs, 1)

    def posed(self, joint: JointResult | StcalError, faces: Sequence[str]) -> tuple[CalibratedTarget, JointResult]:
        """Returns the poses of ``faces``, in the frame of the first one, by the adjustment of a part of the models."""
        if isinstance(joint, StcalError):
            raise joint
        whole = self.calibration.target
        start = replace(whole, reference_face=faces[0], target_from_face={f: whole.target_from_face[f] for f in faces})
        try:
            posed = calibrated_target(joint, start, self.target, self.options.frame)
            for face in faces[1:]:
                np.linalg.cholesky(posed.face_covariance[face])  # fails where rounding is all that determines it
            return posed, joint
        except np.linalg.LinAlgError as error:
            raise _unfixed(joint.models) from error


def _adjusted(models: Sequence[MetricModel], board, flatness_mm, whole: JointResult) -> JointResult | StcalError:
    models = [model for model in models if model.images]  # a part of a group may hold no two images of a point
    if not models:
        return _unfixed(models)
    try:
        return result_of(adjust_part(models, board, flatness_mm, whole))
    except StcalError as error:
        return error
    except np.linalg.LinAlgError:
        return _unfixed(models)


def _unfixed(models: Sequence[MetricModel]) -> DegenerateError:
    return DegenerateError("E-GROUPS-UNFIXED", f"{len(models)} groups do not fix the target; add images")


def _difference(a: Rigid, b: Rigid) -> np.ndarray:
    """Returns rotation (rad) and translation (mm) of a against b, in the frame of both, as covariances of faces do."""
    return np.concatenate([Rotation.from_matrix(a.rotation @ b.rotation.T).as_rotvec(), a.translation - b.translation])


def _face_trial(name: str, a: Rigid, b: Rigid, covariance: np.ndarray, redundancy: float) -> Trial:
    """Returns the trial of two independent poses of a face; ``covariance`` : (6, 6) of their difference."""
    apart = _difference(a, b)
    statistic = float(apart @ np.linalg.solve(covariance, apart))
    return Trial(name, MICRO * float(np.linalg.norm(apart[3:])), "µm", statistic, 6, redundancy)


def halves_check(again: Again) -> Check:
    """Compares two halves of the images, alternate ones of every group; the board's deviations are common to both."""
    models, reference = again.joint.models, again.calibration.target.reference_face
    fewest = min(models, key=lambda model: len(model.images))
    if len(fewest.images) < 2 * MIN_HALF:
        reason = f"group {fewest.group} has {len(fewest.images)} images, {2 * MIN_HALF} needed"
        return impossible("halves", reason, "add images")
    faces = [reference, *(f for f in again.calibration.target.target_from_face if f != reference)]
    joints = again.adjust([[m.without(m.image_index % 2 != k) for m in models] for k in (0, 1)])
    try:
        (first, joint), (second, second_joint) = (again.posed(joint, faces) for joint in joints)
    except StcalError as error:
        return impossible("halves", f"half of the images do not determine the result ({error})", "add images")
    redundancy = joint.redundancy + second_joint.redundancy
    trials = [
        _face_trial(
            f"face {face}",
            first.target_from_face[face],
            second.target_from_face[face],
            first.face_covariance[face] + second.face_covariance[face],
            redundancy,
        )
        for face in faces[1:]
    ]
    remedy = (
        "images of one group contradict one another more than their residuals show: look for images in which something "
        "moved, or that are blurred; trust no σ below this difference"
    )
    return assess("halves", trials, "faces", remedy, covered=True)


def groups_check(again: Again, networks: Sequence[Network]) -> Check:
    """Compares the result without one group with the whole, with the covariance of a nested adjustment. A group is
    named only if the others agree without it, and do not if another one is left out instead."""
    calibration = again.calibration
    models, whole = again.joint.models, calibration.target
    reference = whole.reference_face
    faces = [reference, *(f for f in whole.target_from_face if f != reference)]
    members = {m.group: {f.face for f in calibration.faces if f.group == m.group} for m in models}
    removable = [
        g
        for g in members
        if len(members) > 1 and _linked([s for other, s in members.items() if other != g], reference) >= set(faces)
    ]
    trials: list[Trial] = []
    joints = again.adjust([[m for m in models if m.group != group] for group in removable])
    cures = [
        not isinstance(joint, StcalError) and _agree(joint, [n for n in networks if n.model.group != group])
        for group, joint in zip(removable, joints, strict=True)
    ]
    for group, adjustment in zip(removable, joints, strict=True):
        try:
            without, joint = again.posed(adjustment, faces)
        except StcalError:
            continue
        scale = (again.joint.sigma_scale / joint.sigma_scale) ** 2
        for face in faces[1:]:
            change = _difference(without.target_from_face[face], whole.target_from_face[face])
            larger = scale * without.face_covariance[face]
            name = f"face {face} without group {group}"
            trial = _nested_trial(name, change, larger, whole.face_covariance[face], joint.redundancy)
            trials += [trial] if trial else []
    if not trials:
        reason = "every group holds a face that no other links"
        return impossible("groups", reason, again.loop_remedy())
    check = assess("groups", trials, "faces", "", covered=True)
    if not check.names:
        return check
    curing = [group for group, cured in zip(removable, cures, strict=True) if cured]
    if len(curing) == 1:
        remedy = f"group {curing[0]} contradicts the others: was target or board moved in it, or the focus changed?"
        return replace(check, names=(f"group {curing[0]}",), remedy=f"{remedy} Take it again, or leave it out")
    remedy = (
        "groups contradict one another: target, board or a face moved in one of them, or the focus changed; photograph "
        "the faces in further groups, which show which one is wrong"
    )
    words = Guilt("groups", rivals=tuple(curing)).words()
    return replace(check, reason=f"{check.reason}; {words}", names=(), remedy=remedy)


def _agree(joint: JointResult, networks: Sequence[Network]) -> bool:
    """Whether a joint adjustment adds no more to the squared residuals of its groups than chance does."""
    extra, freedom, free = _added(joint, networks)
    return freedom < 1 or float(fdtrc(freedom, free, extra / freedom)) >= SUSPICIOUS


def _added(joint: JointResult, networks: Sequence[Network]) -> tuple[float, int, float]:
    """Returns what a joint adjustment adds to the squared residuals of its groups, the degrees of freedom of that, and
    those of the groups."""
    free = float(sum(n.redundancy.sum() for n in networks))
    square = float(sum((n.residual**2).sum() for n in networks))
    return max(joint.sigma0**2 * joint.redundancy - square, 0.0), round(joint.redundancy - free), free


def _nested_trial(name: str, change, larger: np.ndarray, smaller: np.ndarray, redundancy: float) -> Trial | None:
    """Returns the trial of the change of a face; None if what was left out tells nothing of that face."""
    root = np.linalg.cholesky(larger)
    half = np.linalg.solve(root, np.linalg.solve(root, larger - smaller).T)
    value, vector = np.linalg.eigh((half + half.T) / 2)
    held = value > EXPLAINED
    if not held.any():
        return None
    along = vector[:, held].T @ np.linalg.solve(root, change)
    statistic = float((along**2 / value[held]).sum())
    return Trial(name, MICRO * float(np.linalg.norm(change[3:])), "µm", statistic, int(held.sum()), redundancy)


def _linked(members: list[set[str]], start: str) -> set[str]:
    """Returns the faces that the groups link to ``start``."""
    reached = {start}
    while linked := set().union(*(faces for faces in members if faces & reached)) - reached:
        reached |= linked
    return reached


def loops_check(again: Again) -> Check:
    """Compares two ways to one face through different groups, with each group adjusted alone with its board."""
    calibration = again.calibration
    pairs = [
        (face, first, second)
        for face, chains in measure_chains(calibration.faces, calibration.target).items()
        for first, second in combinations(chains, 2)
        if not set(first.groups) & set(second.groups)
    ]
    groups = sorted({group for _, *ways in pairs for way in ways for group in way.groups})
    alone = again.adjust([[m for m in again.joint.models if m.group == group] for group in groups])
    single = dict(zip(groups, alone, strict=True))

    @cache  # several ways share a step
    def step_of(group: str, a: str, b: str) -> tuple[Rigid, np.ndarray]:
        target, _ = again.posed(single[group], (a, b))
        return target.target_from_face[b], target.face_covariance[b]

    trials = []
    redundancy = sum(2 * len(m.image_index) for m in again.joint.models)
    for face, first, second in pairs:
        try:
            (one, of_one), (other, of_other) = (_along(step_of, way) for way in (first, second))
        except StcalError:
            continue
        name = f"face {face} by groups {' '.join(first.groups)} and {' '.join(second.groups)}"
        trials.append(_face_trial(name, one, other, of_one + of_other, redundancy))
    if not trials:
        reason = "no face is reached in two ways that share no group"
        return impossible("loops", reason, again.loop_remedy())
    remedy = "a group of these ways is wrong: compare with the result without each group, and look for what moved in it"
    return assess("loops", trials, "loops", remedy, covered=True)


def _along(step_of: Callable[[str, str, str], tuple[Rigid, np.ndarray]], way: FaceChain) -> tuple[Rigid, np.ndarray]:
    """Returns reference_from_face along a way, with each group adjusted alone, and its covariance (6, 6)."""
    pose, covariance = Rigid(), np.zeros((6, 6))
    for group, a, b in zip(way.groups, way.faces[:-1], way.faces[1:], strict=True):
        step, step_covariance = step_of(group, a, b)
        # The pose of face a turns the step to face b; an error of its rotation moves b by the lever arm from a to b.
        arm = np.block([[np.eye(3), np.zeros((3, 3))], [-skew(pose.rotation @ step.translation), np.eye(3)]])
        turn = block_diag(pose.rotation, pose.rotation)
        covariance = arm @ covariance @ arm.T + turn @ step_covariance @ turn.T
        pose = pose @ step
    return pose, covariance


def agreement_check(joint: JointResult, networks: Sequence[Network]) -> Check:
    """Tests what one target, the board's σ and flat faces add to the residuals (F test of nested models). An adjustment
    that has not settled is suspicious: contradictory observations make its last steps slow."""
    extra, freedom, free = _added(joint, networks)
    if freedom < 1:
        return impossible("agreement", "one target and board add no condition to the groups", "add images")
    value = float(np.sqrt(extra / freedom))
    remedy = "look at the checks of board, groups and flatness: one of their σ is too small, or something moved"
    trial = Trial("all groups", value, "σ", extra, freedom, free)
    check = assess("agreement", [trial], "adjustments", remedy, covered=True)
    if joint.settled:
        return check
    last = TestedValue("last step", joint.last_move_px, SETTLED_PX, "px", None)
    return replace(
        check,
        verdict="suspicious" if check.verdict == "passed" else check.verdict,
        reason=f"{check.reason}; not settled, {last.name} at {last.words()}",
        measured=(*check.measured, last),
        names=(*check.names, last.name),
        remedy=remedy,
    )


def flatness_check(
    networks: Sequence[Network], flatness_mm: float | None, printed: Collection[str] = (), factor: float = 1.0
) -> Check:
    """Tests the distance of each circle from the plane of the other circles of its face in all free networks.
    ``printed``: ids of faces of known shape, whose flatness is ``factor`` times the stated one."""
    if flatness_mm is None:
        return impossible("flatness", "the run was asked not to use flatness", "state it with --flatness")
    heights: dict[str, list[tuple[tuple[str, ...], np.ndarray, np.ndarray]]] = {}
    for network in networks:
        for face, members in network.model.points_by_face().items():
            if face != "board" and len(members) > 3:
                heights.setdefault(face, []).append(_heights(network, members))
    redundancy = float(sum(n.redundancy.sum() for n in networks))
    trials = []
    for face, parts in heights.items():
        sigma_mm = flatness_mm * factor if face in printed else flatness_mm
        labels = sorted({label for names, _, _ in parts for label in names})
        normal, right = np.zeros((len(labels), len(labels))), np.zeros(len(labels))
        for names, height, weight in parts:
            place = [labels.index(name) for name in names]
            normal[np.ix_(place, place)] += weight
            right[place] += weight @ height
        covariance = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
        adjusted_heights = covariance @ right
        held = covariance @ normal
        weight = np.linalg.pinv(covariance + sigma_mm**2 * held @ held.T, rcond=1e-9, hermitian=True)
        for i, label in enumerate(labels):
            if weight[i, i] > 0:
                height = float(weight[i] @ adjusted_heights / weight[i, i])
                trials.append(Trial(label, MICRO * height, "µm", height**2 * weight[i, i], 1, redundancy))
    remedy = "a point out of its plane, or a face less flat than stated: press or glue it flat, or state --flatness"
    # Bent paper does no harm: its corners are where they are, and the frame is laid over all of them.
    worst = "suspicious" if heights.keys() <= set(printed) else "failed"
    return assess("flatness", trials, "points", remedy, worst)


def _heights(network: Network, members: np.ndarray) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Returns labels, heights (k,), mm, over any plane, positive outwards, and their weight matrix."""
    model = network.model
    xyz = model.xyz_model[members]
    towards = np.mean([pose.inverse().translation for pose in model.camera_from_model], axis=0) - xyz.mean(0)
    plane = fit_plane(xyz, towards)
    across = np.kron(np.eye(len(members)), plane.normal)
    covariance = network.noise() * across @ network.covariance_of(members) @ across.T
    basis = np.linalg.svd(np.eye(3) - np.outer(plane.normal, plane.normal))[0][:, :2]
    free = np.column_stack([np.ones(len(members)), (xyz - xyz.mean(0)) @ basis])
    inverse = np.linalg.inv(covariance)
    along = inverse @ free
    weight = inverse - along @ np.linalg.solve(free.T @ along, along.T)
    return tuple(model.labels[i] for i in members), plane.distance(xyz), weight
