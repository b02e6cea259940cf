"""All checks of a run. Each tests for an error that small residuals may hide."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.design import (
    POINT_RADIUS_MM,
    BoardDesign,
    ScaleReference,
    TargetDesign,
    faces_of_known_shape,
    known_distances,
)
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import align_similarity
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import DotLabel, Label
from stcal.parallel import Progress, counted
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration, calibrate, image_sigma_factors, with_sigma
from stcal.sfm.adjust.refine import MIN_DOTS, Network, adjust, free_network, known_points, solve_score
from stcal.sfm.adjust.rims import Rim, find_rims
from stcal.sfm.checks import board_checks, face_checks, image_checks
from stcal.sfm.checks.causes import ANOTHER_CAMERA, whole_set_cause
from stcal.sfm.checks.significance import Trial, assess
from stcal.sfm.data.group_model import ImageObservations, Outlier, WorldModel
from stcal.sfm.report.check import CHECKS, Check, TestedValue, impossible

JOINT = ("agreement", "halves", "groups", "loops")
"""Checks that need the joint result and its covariances."""
BESIDE_A_GROUP = 0.9
"""Largest factor on the residuals that a cause of the whole set may leave to be named in place of a group without which
all is well."""
MICRO = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Input of the checks."""

    models: tuple[WorldModel, ...]  # adjusted models of the single groups, without unit
    outliers: tuple[Outlier, ...]
    images: tuple[ImageObservations, ...]
    camera: Camera  # as given
    target: TargetDesign
    board: BoardDesign
    options: AdjustOptions
    calibration: Calibration
    prior: CameraPrior | None  # of the intrinsics if they were refined
    blur_px: dict[str, float]
    rim: bool = False  # whether rims are estimated for the result
    camera_given: bool = True  # False if the camera was found from the photographs
    cause: Check | None = None  # of the whole set if it is known already

    def radius_mm(self) -> dict[Label, float]:
        """Returns the radii of all circles and dots, without the corners of printed faces."""
        radius: dict[Label, float] = {**self.target.radius_of(), **self.board.radius_of()}
        return {label: value for label, value in radius.items() if value > POINT_RADIUS_MM}

    def networks(self) -> list[Network]:
        """Returns the free networks of all groups, mm, at the intrinsics of the result."""
        camera = self.calibration.camera
        models = self.models
        if not camera.same_as(self.camera):
            models = tuple(adjust(model, camera) for model in models)
        factors = image_sigma_factors(models, camera, self.target.printed_ids())
        scales = self.calibration.scales
        return [free_network(with_sigma(m.metric(scales[m.group].group_from_world()), factors), camera) for m in models]


def _rims(evidence: Evidence) -> tuple[dict[str, Rim], float | None, Mapping[str, float | None]]:
    """Returns rims by kind, the largest σ of a face's position, mm, and the heights allowed for by kind."""
    rims = find_rims(evidence.calibration.models, evidence.images, evidence.radius_mm(), evidence.calibration.camera)
    known = [np.sqrt(np.diag(c)[3:].max()) for c in evidence.calibration.target.face_covariance.values()]
    if evidence.rim:
        return rims, float(max(known)) if known else None, dict.fromkeys(rims)
    faces = list(evidence.target.rim_of().values())
    stated = {"circles": float(np.mean(faces)) if faces else 0.0, "dots": evidence.board.rim_mm}
    return rims, float(max(known)) if known else None, stated


def shows_rim(evidence: Evidence) -> bool:
    """Returns whether the radii of the faces' circles show for certain that they lie behind a rim that none stated."""
    if evidence.calibration.joint is None or evidence.target.rim_of():
        return False
    rims, sigma_mm, _ = _rims(evidence)
    return "circles" in rims and rims["circles"].height_mm > board_checks.rim_limit_mm(rims["circles"], sigma_mm)


def _before_circles_mm(evidence: Evidence, rims: Mapping[str, Rim], check: Check) -> dict[Label, float]:
    """Heights of the rims in front of circles and dots: estimated if allowed for or found, else as stated."""
    stated = {**evidence.target.rim_of(), **dict.fromkeys(evidence.board.labels(), evidence.board.rim_mm)}
    of_label = {label: "dots" if isinstance(label, DotLabel) else "circles" for label in evidence.radius_mm()}
    found = {kind for kind in rims if evidence.rim or board_checks.KINDS[kind][0] in check.names}
    return {k: rims[kind].height_mm if kind in found else stated.get(k, 0.0) for k, kind in of_label.items()}


def run_checks(evidence: Evidence, progress: Progress | None = None) -> tuple[Check, ...]:
    """Returns all checks in the order of the report, the cause of the whole set before them if one failed."""
    networks, calibration = evidence.networks(), evidence.calibration
    camera, board, target = calibration.camera, evidence.board, evidence.target
    rims, sigma_mm, allowed = _rims(evidence)
    of_rims = board_checks.rim_check(rims, sigma_mm, allowed, bool(evidence.radius_mm()))
    before_mm = _before_circles_mm(evidence, rims, of_rims)
    radii = board_checks.measure_radii(networks, evidence.images, evidence.radius_mm(), camera, before_mm)
    joint, known_faces = calibration.joint, {face.id for face in faces_of_known_shape(board)}
    factors = (1.0, 1.0) if joint is None else (joint.print_factor, joint.bend_factor)
    makers: tuple[Callable[[], Check | Iterable[Check]], ...] = (
        lambda: image_checks.camera_check(
            networks, evidence.camera, calibration, evidence.prior, evidence.camera_given
        ),
        lambda: image_checks.field_check(networks, camera),
        lambda: image_checks.sigma_check(networks, calibration.sigma_factors.all),
        *_joint_checks(evidence, networks),
        lambda: image_checks.moved_check(networks),
        lambda: image_checks.image_check(networks),
        lambda: image_checks.sharpness_check(networks, evidence.blur_px),
        lambda: image_checks.evenness_check(networks, evidence.images, camera, bool(evidence.radius_mm())),
        lambda: image_checks.labels_check(networks, evidence.outliers, evidence.images, camera),
        lambda: board_checks.board_checks(networks, board),
        lambda: board_checks.pitch_check(calibration.target, target, radii, bool(board.rows)),
        lambda: board_checks.radius_checks(radii),
        lambda: of_rims,
        lambda: face_checks.flatness_check(networks, evidence.options.flatness_mm, known_faces, factors[1]),
        lambda: control_check(evidence, networks),
    )
    if isinstance(board, ScaleReference):  # the target tells its size itself
        makers += (lambda: scales_check(networks, board, factors[0]),)
    step = counted(progress or (lambda *_: None), "check", len(makers))
    checks: list[Check] = []
    for make in makers:
        result = make()
        checks += [result] if isinstance(result, Check) else result
        step(None)
    failed = {check.key: check for check in checks if check.verdict == "failed"}
    cause = evidence.cause
    # That all intrinsics differ explains a board in nearly any photographs: what all circles tell goes before it.
    if (cause is None or cause.cause == ANOTHER_CAMERA) and any(
        check.verdict in ("failed", "suspicious") for check in checks
    ):
        moved = "moved" in failed and not failed["moved"].names
        # A group without which all is well is the cause, unless another one explains far more of the residuals.
        of_group = "groups" in failed and len(failed["groups"].names) == 1
        most_left = BESIDE_A_GROUP if of_group else 1.0
        if of_set := whole_set_cause(networks, camera, moved, evidence.camera_given, most_left):
            cause = replace(of_set, verdict="failed" if failed else "suspicious")
    return (cause, *checks) if cause else tuple(checks)


def _joint_checks(evidence: Evidence, networks: list[Network]) -> list[Callable[[], Check]]:
    joint = evidence.calibration.joint
    if not evidence.calibration.target.target_from_face:
        return [partial(impossible, key, "the board alone, no face", "") for key in JOINT]
    if joint is None:
        reason = "needs the covariances of the joint adjustment"
        return [partial(impossible, key, reason, "run with --solve joint") for key in JOINT]
    again = face_checks.Again(evidence.calibration, joint, evidence.target, evidence.board, evidence.options)
    linked = {model.group for model in joint.models}
    linked_networks = [n for n in networks if n.model.group in linked]
    return [
        partial(face_checks.agreement_check, joint, linked_networks),
        partial(face_checks.halves_check, again),
        partial(face_checks.groups_check, again, linked_networks),
        partial(face_checks.loops_check, again),
    ]


def control_check(evidence: Evidence, networks: list[Network]) -> Check:
    """Compares the run with a control without eccentricity, chained with three-point frames, and tests the correction:
    a factor on it is 1 up to chance, and 0 if the centres are not those of ellipses."""
    if not evidence.radius_mm():
        return impossible("control", "corners alone, which have no eccentricity", "")
    if not evidence.options.eccentricity:
        return impossible("control", "this run is the control", "run with eccentricity")
    if not any(n.model.shift_px.any() for n in networks):
        return impossible("control", "no circle is in the result", "add views of the faces with circles")
    test = solve_score(*image_checks.summed(networks, image_checks.by_eccentricity))
    if not test.freedom:
        return impossible("control", "poses and circles explain any eccentricity", "add tilted views of the faces")
    redundancy = sum(n.redundancy.sum() for n in networks)
    share = float(test.estimate[0])
    trial = Trial("share of the eccentricity found, minus 1", share, "", test.statistic, test.freedom, redundancy)
    check = assess("control", [trial], "corrections", image_checks.NO_ELLIPSES)
    try:
        whole = evidence.calibration.target.target_from_face
        message, measured = _control(evidence) if whole else ("no face that it could move", ())
    except StcalError as error:
        message, measured = f"no uncorrected result ({error})", ()
    reason = f"{1 + share:.3f} ± {np.sqrt(test.covariance[0, 0]):.3f} of the eccentricity found; {message}"
    return replace(check, reason=reason, measured=check.measured + measured)


def _control(evidence: Evidence) -> tuple[str, tuple[TestedValue, ...]]:
    camera, whole = evidence.calibration.camera, evidence.calibration.target
    models = [adjust(replace(m, shift_px=np.zeros_like(m.shift_px)), camera) for m in evidence.models]
    options = replace(evidence.options, solve="chain", frame="three-point", eccentricity=False)
    control = calibrate(models, camera, evidence.target, evidence.board, options).target
    shifts = {
        face: MICRO * float(np.linalg.norm(control.target_from_face[face].translation - pose.translation))
        for face, pose in whole.target_from_face.items()
        if face != whole.reference_face
    }
    rms = float(np.sqrt(np.concatenate([m.residuals_px(camera).ravel() ** 2 for m in models]).mean()))
    rows = tuple(
        TestedValue(f"face {face}, without eccentricity", value, None, "µm", None) for face, value in shifts.items()
    )
    largest = max(shifts.values(), default=0.0)
    return f"without it faces are off by up to {largest:.0f} µm at residuals of {rms:.4f} px", rows


PPM = 1e6
ALONE, FAR, LEAST_AGREEING = 0.005, 3.0, 2
"""Relative error of size from which one source is named, how many times as far off as the others it must be, and how
many others must agree."""
MOST_PRINT_FACTOR = 10.0
"""Corners about the design over their stated σ from which on the design, or a stated size, is another one."""


def scales_check(networks: Sequence[Network], board: BoardDesign, print_factor: float) -> Check:
    """Tests each source of the scale against the mean of all in the free network of a group, which has one scale."""
    key, (title, _) = "scales", CHECKS["scales"]
    remedy = (
        "one print, distance or board has another size than stated: measure a side of each print and correct "
        "target.toml, or state size_sigma_mm"
    )
    name, times = _alone(networks, board) or ("", 1.0)
    fits = f"{name} would fit with {times:.4g} times its stated size, and the others agree with one another"
    if print_factor > MOST_PRINT_FACTOR:
        # σ that have grown so much would hide the contradiction that made them grow.
        grown = TestedValue("corners about the design", print_factor, MOST_PRINT_FACTOR, "× their stated σ", None)
        if name:
            size = TestedValue(name, 100 * (times - 1), 100 * ALONE, "% larger than stated", None)
            return Check(key, title, "failed", fits, (size, grown), 1, (name,), f"correct the size of {name}")
        why = "the size or drawing of the print is another one, or its σ too small"
        reason = f"{grown.name} at {grown.words()}: {why}"
        return Check(key, title, "suspicious", reason, (grown,), 1, (grown.name,), remedy)
    trials: list[Trial] = []
    for network in networks:
        names, log_scale, gradient, variance = _sources(network, board, print_factor)
        if len(names) < 2:
            continue
        covariance = gradient @ network.covariance_mm2 @ gradient.T + np.diag(variance)
        weight = np.linalg.inv(covariance)
        away = log_scale - float(weight.sum(0) @ log_scale / weight.sum())
        spread = np.diag(covariance) - 1 / weight.sum()
        freedom = float(network.redundancy.sum())
        trials += [
            Trial(source, PPM * off, "ppm", off**2 / own, 1, freedom)
            for source, off, own in zip(names, away.tolist(), spread.tolist(), strict=True)
            if own > 0
        ]
    if not trials:
        return impossible(key, "only one source of the scale", "state a known distance with scale")
    check = assess(key, trials, "sources of the scale", remedy)
    if check.names and name:
        reason = f"{fits}; {check.reason}"
        return replace(check, reason=reason, names=(name,), remedy=f"correct the size of {name}")
    return check


def _alone(networks: Sequence[Network], board: BoardDesign) -> tuple[str, float] | None:
    """Returns the one source that contradicts all others, which agree, and its size over the stated one."""
    off: dict[str, list[float]] = {}
    for network in networks:
        names, log_scale, *_ = _sources(network, board, 1.0)
        for name, value in zip(names, (log_scale - np.median(log_scale)).tolist() if names else (), strict=True):
            off.setdefault(name, []).append(value)
    ratio = {name: float(np.median(values)) for name, values in off.items()}
    if len(ratio) < LEAST_AGREEING + 1:
        return None
    name = max(ratio, key=lambda each: abs(ratio[each]))
    others = max(abs(value) for each, value in ratio.items() if each != name)
    return (name, float(np.exp(ratio[name]))) if abs(ratio[name]) > max(ALONE, FAR * others) else None


def _sources(
    network: Network, board: BoardDesign, print_factor: float
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """Returns the s sources of the scale: their names, the logarithm of the model's scale over the known size (s,), its
    gradient by the points (s, 3p), and the variance of the known size (s,)."""
    model = network.model
    parts = [
        (f"face {face.id}", members, face.places_mm(model.labels[i].circle for i in members),
         print_factor * (face.sigma_mm or 1.0), face.size_sigma)
        for face, members in known_points(model.labels, board)
    ]  # fmt: skip
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)], int)
    if len(dots) >= MIN_DOTS:
        parts.append(("board", dots, board.places_mm(model.labels[i] for i in dots), board.sigma_mm, 0.0))
    names, values, gradients = [], [], []
    for name, members, design, sigma_mm, size_sigma in parts:
        with suppress(DegenerateError):
            found = align_similarity(model.xyz_model[members], design)
            middle = design - design.mean(0)
            square = float((middle**2).sum())
            gradient = np.zeros((len(model.labels), 3))
            gradient[members] = middle @ found.rigid.rotation.T / (square * found.scale)
            names.append(name)
            values.append((np.log(found.scale), sigma_mm**2 / square + size_sigma**2))
            gradients.append(gradient.ravel())
    place = {label: i for i, label in enumerate(model.labels)}
    for known in known_distances(board):
        if known.first in place and known.second in place:
            i, j = place[known.first], place[known.second]
            apart = model.xyz_model[i] - model.xyz_model[j]
            gradient = np.zeros((len(model.labels), 3))
            gradient[i] = apart / float(apart @ apart)
            gradient[j] = -gradient[i]
            names.append(f"distance {known.first} to {known.second}")
            values.append((np.log(np.linalg.norm(apart) / known.mm), (known.sigma_mm / known.mm) ** 2))
            gradients.append(gradient.ravel())
    log_scale, variance = np.array(values).reshape(-1, 2).T
    return names, log_scale, np.array(gradients), variance
