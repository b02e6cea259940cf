"""Checks of the faces: parts of the images against one another, groups against groups, circles against their plane."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, reduce
from itertools import combinations
from operator import matmul

import numpy as np
from scipy.special import fdtrc

from stcal.design import faces_of_known_shape
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid, UncertainRigid
from stcal.sfm.adjust.chain import CalibratedTarget, FaceChain, measure_chains
from stcal.sfm.adjust.joint import SETTLED_PX, JointResult, adjust_part
from stcal.sfm.adjust.refine import Network
from stcal.sfm.adjust.uncertainty import calibrated_target, widened_result
from stcal.sfm.checks.significance import MICRO, Evidence, Guilt, Trial, assess, weight_beside
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.report.check import SUSPICIOUS, Check, TestedValue, impossible

MIN_HALF = 2  # smallest number of images of a group in each half
EXPLAINED = 0.05
"""Smallest share of the variance that a group must add in a tested direction; below it, rounding would be tested."""


def _loop_remedy(evidence: Evidence) -> str:
    """Returns what makes comparisons of groups possible; nothing where all images are one group without a board."""
    return "add a group that closes a loop of faces" if evidence.board.rows or len(evidence.linked) > 1 else ""


def _adjusted(evidence: Evidence, whole: JointResult, models: Iterable[MetricModel]) -> JointResult:
    """Adjusts a part of the models as the run did, from its result and with its intrinsics."""
    models = [model for model in models if model.images]  # a part of a group may hold no two images of a point
    if not models:
        raise _unfixed(models)
    try:
        return widened_result(adjust_part(models, evidence.board, evidence.options.flatness_mm, whole))
    except np.linalg.LinAlgError as error:
        raise _unfixed(models) from error


def _posed(evidence: Evidence, joint: JointResult, faces: Sequence[str]) -> CalibratedTarget:
    """Returns the poses of ``faces``, in the frame of the first one, by the adjustment of a part of the models."""
    whole = evidence.calibration.target
    start = replace(whole, reference_face=faces[0], target_from_face={f: whole.target_from_face[f] for f in faces})
    try:
        posed = calibrated_target(joint, start, evidence.target, evidence.options.frame)
        for face in faces[1:]:
            np.linalg.cholesky(posed.face_covariance[face])  # fails where rounding is all that determines it
        return posed
    except np.linalg.LinAlgError as error:
        raise _unfixed(joint.models) from error


def _unfixed(models: Sequence[MetricModel]) -> DegenerateError:
    return DegenerateError("E-GROUPS-UNFIXED", f"{len(models)} groups do not fix the target; add images")


def _face_trial(name: str, a: Rigid, b: Rigid, covariance: np.ndarray, redundancy: float) -> Trial:
    """Returns the trial of two independent poses of a face; ``covariance`` : (6, 6) of their difference."""
    apart = a.difference(b)
    statistic = float(apart @ np.linalg.solve(covariance, apart))
    return Trial(name, MICRO * float(np.linalg.norm(apart[3:])), "µm", statistic, 6, redundancy)


def halves_check(evidence: Evidence, joint: JointResult) -> Check:
    """Compares two halves of the images, alternate ones of every group; the board's deviations are common to both."""
    models, faces = joint.models, _faces(evidence)
    fewest = min(models, key=lambda model: len(model.images))
    if len(fewest.images) < 2 * MIN_HALF:
        reason = f"group {fewest.group} has {len(fewest.images)} images, {2 * MIN_HALF} needed"
        return impossible("halves", reason, "add images")
    try:
        halves = [_adjusted(evidence, joint, (m.without(m.image_index % 2 != k) for m in models)) for k in (0, 1)]
        first, second = (_posed(evidence, half, faces) for half in halves)
    except StcalError as error:
        return impossible("halves", f"half of the images do not determine the result ({error})", "add images")
    redundancy, trials = sum(half.redundancy for half in halves), []
    for face in faces[1:]:
        covariance = first.face_covariance[face] + second.face_covariance[face]
        poses = first.target_from_face[face], second.target_from_face[face]
        trials.append(_face_trial(f"face {face}", *poses, covariance, redundancy))
    remedy = "images of one group contradict one another: look for one that is blurred, or in which something moved"
    return assess("halves", trials, "faces", remedy, covered=True)


def _faces(evidence: Evidence) -> list[str]:
    """Returns the faces of the result, the reference face first."""
    whole = evidence.calibration.target
    return list(dict.fromkeys([whole.reference_face, *whole.target_from_face]))


def groups_check(evidence: Evidence, joint: JointResult) -> Check:
    """Compares the result without one group with the whole, with the covariance of a nested adjustment. A group is
    named only if the others agree without it, and do not if another one is left out instead."""
    whole, faces = evidence.calibration.target, _faces(evidence)
    members = {m.group: {f.face for f in evidence.calibration.faces if f.group == m.group} for m in joint.models}
    trials: list[Trial] = []
    curing = []
    for group in members:
        others = [shown for other, shown in members.items() if other != group]
        if not others or set(faces) - _linked(others, faces[0]):
            continue
        try:
            part = _adjusted(evidence, joint, (m for m in joint.models if m.group != group))
        except StcalError:
            continue
        extra, freedom, free = _added(part, [n for n in evidence.linked if n.model.group != group])
        if freedom < 1 or float(fdtrc(freedom, free, extra / freedom)) >= SUSPICIOUS:  # the others agree
            curing.append(group)
        try:
            without = _posed(evidence, part, faces)
        except StcalError:
            continue
        scale = (joint.sigma_scale / part.sigma_scale) ** 2
        for face in faces[1:]:
            change = without.target_from_face[face].difference(whole.target_from_face[face])
            covariances = scale * without.face_covariance[face], whole.face_covariance[face]
            trials += _nested_trial(f"face {face} without group {group}", change, *covariances, part.redundancy)
    if not trials:
        return impossible("groups", "every group holds a face that no other links", _loop_remedy(evidence))
    check = assess("groups", trials, "faces", "", covered=True)
    if not check.names:
        return check
    if len(curing) == 1:
        remedy = f"group {curing[0]} contradicts the others: was target or board moved in it, or the focus changed?"
        return replace(check, names=(f"group {curing[0]}",), remedy=f"{remedy} Take it again, or leave it out")
    remedy = "something moved in one of the groups, or the focus changed: further groups will show which one is wrong"
    words = Guilt("groups", rivals=tuple(curing)).words()
    return replace(check, reason=f"{check.reason}; {words}", names=(), remedy=remedy)


def _added(joint: JointResult, networks: Sequence[Network]) -> tuple[float, int, float]:
    """Returns squared residuals that a joint adjustment adds to its groups' own, and both degrees of freedom."""
    free = float(sum(n.redundancy.sum() for n in networks))
    square = float(sum((n.residual**2).sum() for n in networks))
    return max(joint.sigma0**2 * joint.redundancy - square, 0.0), round(joint.redundancy - free), free


def _nested_trial(name: str, change, larger: np.ndarray, smaller: np.ndarray, redundancy: float) -> list[Trial]:
    """Returns the trial of the change of a face; none if what was left out tells nothing of that face."""
    root = np.linalg.cholesky(larger)
    half = np.linalg.solve(root, np.linalg.solve(root, larger - smaller).T)
    value, vector = np.linalg.eigh((half + half.T) / 2)
    held = value > EXPLAINED
    along = vector[:, held].T @ np.linalg.solve(root, change)
    statistic, value_um = float((along**2 / value[held]).sum()), MICRO * float(np.linalg.norm(change[3:]))
    return [Trial(name, value_um, "µm", statistic, int(held.sum()), redundancy)] if held.any() else []


def _linked(members: list[set[str]], start: str) -> set[str]:
    """Returns the faces that the groups link to ``start``."""
    reached = {start}
    while linked := set().union(*(faces for faces in members if faces & reached)) - reached:
        reached |= linked
    return reached


def loops_check(evidence: Evidence, joint: JointResult) -> Check:
    """Compares two ways to one face through different groups, with each group adjusted alone with its board."""
    calibration, models = evidence.calibration, joint.models
    pairs = [
        (face, first, second)
        for face, chains in measure_chains(calibration.faces, calibration.target).items()
        for first, second in combinations(chains, 2)
        if not set(first.groups) & set(second.groups)
    ]

    @cache  # several ways share a group, also one that fails by itself, and a step
    def alone(group: str) -> JointResult | StcalError:
        try:
            return _adjusted(evidence, joint, (model for model in models if model.group == group))
        except StcalError as error:
            return error

    @cache
    def step_of(group: str, a: str, b: str) -> UncertainRigid:
        if isinstance(part := alone(group), StcalError):
            raise part
        target = _posed(evidence, part, (a, b))
        return UncertainRigid(target.target_from_face[b], target.face_covariance[b])

    def along(way: FaceChain) -> UncertainRigid:
        """Returns reference_from_face along a way, with each group adjusted alone."""
        steps = zip(way.groups, way.faces[:-1], way.faces[1:], strict=True)
        return reduce(matmul, (step_of(*step) for step in steps))

    trials = []
    redundancy = sum(2 * len(m.image_index) for m in models)
    for face, first, second in pairs:
        with suppress(StcalError):
            one, other = along(first), along(second)
            name = f"face {face} by groups {' '.join(first.groups)} and {' '.join(second.groups)}"
            trials.append(_face_trial(name, one.rigid, other.rigid, one.covariance + other.covariance, redundancy))
    if not trials:
        return impossible("loops", "no face is reached in two ways that share no group", _loop_remedy(evidence))
    remedy = "a group of these ways is wrong: compare with the result without each group, and look for what moved in it"
    return assess("loops", trials, "loops", remedy, covered=True)


def agreement_check(evidence: Evidence, joint: JointResult) -> Check:
    """Tests what one target, the board's σ and flat faces add to the residuals (F test of nested models). An adjustment
    that has not settled is suspicious: contradictory observations make its last steps slow."""
    extra, freedom, free = _added(joint, evidence.linked)
    if freedom < 1:
        return impossible("agreement", "one target and board add no condition to the groups", "add images")
    value = float(np.sqrt(extra / freedom))
    remedy = "look at the checks of board, groups and flatness: one of their σ is too small, or something moved"
    trial = Trial("all groups", value, "σ", extra, freedom, free)
    check = assess("agreement", [trial], "adjustments", remedy, covered=True)
    if joint.settled:
        return check
    last = TestedValue("last step", joint.last_move_px, SETTLED_PX, "px", None)
    verdict = "suspicious" if check.verdict == "passed" else check.verdict
    reason, names = f"{check.reason}; not settled, {last.name} at {last.words()}", (*check.names, last.name)
    measured = (*check.measured, last)
    return replace(check, verdict=verdict, reason=reason, measured=measured, names=names, remedy=remedy)


def flatness_check(evidence: Evidence) -> Check:
    """Tests the distance of each circle from the plane of the other circles of its face in all free networks. Faces of
    known shape are as flat as the joint adjustment found them."""
    networks, flatness_mm = evidence.networks, evidence.options.flatness_mm
    if flatness_mm is None:
        return impossible("flatness", "the run was asked not to use flatness", "state it with --flatness")
    printed = {face.id for face in faces_of_known_shape(evidence.board)}
    factor = evidence.joint.bend_factor if evidence.joint else 1.0
    heights: dict[str, list[tuple[tuple[str, ...], np.ndarray, np.ndarray]]] = defaultdict(list)
    for network in networks:
        for face, members in network.model.points_by_face().items():
            if face != "board" and len(members) > 3:
                heights[face].append(_heights(network, members))
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
    worst = "suspicious" if heights.keys() <= printed else "failed"
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
    labels = tuple(model.labels[i] for i in members)
    return labels, xyz @ plane.normal - plane.offset, weight_beside(covariance, free)
