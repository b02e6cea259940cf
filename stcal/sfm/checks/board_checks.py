"""Checks of the board, the radii of circles and the scale."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from stcal.design import BoardDesign, ScaleReference, known_distances
from stcal.errors import DegenerateError
from stcal.geometry.normal_equations import free_motions
from stcal.geometry.rigid import align_similarity
from stcal.geometry.robust import robust_sigma
from stcal.labels import DotLabel, Label, dot_cells
from stcal.sfm.adjust.refine import MIN_DOTS, Network, known_points
from stcal.sfm.adjust.rims import Rim, common_dome, lost_radius_mm, radius_views
from stcal.sfm.checks.image_checks import MAD_EFFICIENCY
from stcal.sfm.checks.significance import MICRO, Evidence, Trial, assess, weight_beside
from stcal.sfm.report.check import CHECKS, Check, TestedValue, impossible

EDGE_BIAS_PX = 0.05  # σ of the bias that light, lens and threshold add to all radii alike; it moves no centre
SHARP_PX = 0.8  # blur, σ, of photographs of which EDGE_BIAS_PX holds
RADIUS_TOLERANCE = 2e-3
"""Relative σ of a single radius from manufacturing; it moves the centre by 4·10⁻³ of its eccentricity, about 1 nm."""
MIN_PEERS = 5  # smallest number of circles of one design radius that are compared with each other


def radius_checks(evidence: Evidence) -> list[Check]:
    """Tests every circle against those of its kind and radius, and each such kind against its design. Radii follow from
    the areas of the ellipses and the positions and planes of the circles: medians over all images and groups."""
    design_mm, before_mm = evidence.radius_mm, _before_circles_mm(evidence)
    by_name = {image.name: image for image in evidence.images}
    found: dict[Label, list[np.ndarray]] = defaultdict(list)  # (2, v) of a group: ratio to the design, its radius in px
    for network in evidence.networks:
        views = radius_views(network.model, by_name, design_mm, evidence.calibration.camera)
        for k, label in enumerate(network.model.labels):
            if label in design_mm:  # no corner
                own, radius = views.point_index == k, design_mm[label]
                hidden = lost_radius_mm(before_mm[label], views.tan_tilt[own], radius) / radius
                faded = common_dome(views.domes[own])[0] * views.by_dome_mm[own] / radius
                found[label].append(np.stack([views.ratio[own] + hidden + faded, views.size_px[own]]))
    blur_px = float(np.median([*evidence.blur_px.values()] or [0.0]))
    kinds: dict[str, dict[Label, np.ndarray]] = defaultdict(dict)
    for label, parts in found.items():
        kind = f"{'dots' if isinstance(label, DotLabel) else 'circles'} of radius {design_mm[label]:g} mm"
        kinds[kind][label] = np.median(np.concatenate(parts, axis=1), axis=1)
    single, whole = [], []
    for kind, members in kinds.items():
        ratio, size_px = np.array(list(members.values())).T
        usual, size = float(np.median(ratio)), float(np.median(size_px))
        # A blur of σ moves the steepest place of an edge of radius r by σ²/2r.
        bias_px, by_blur_px = (usual - 1) * size, max(blur_px**2 - SHARP_PX**2, 0.0) / (2 * size)
        allowed_px = np.hypot(EDGE_BIAS_PX, by_blur_px)
        whole.append(Trial(kind, bias_px, "px", (bias_px / allowed_px) ** 2, 1))
        if len(members) >= MIN_PEERS:
            sigma = float(np.hypot(robust_sigma(np.abs(ratio - usual)), RADIUS_TOLERANCE))
            freedom = max(MAD_EFFICIENCY * len(members) - 1, 2.0)
            for label, away in zip(members, (ratio - usual).tolist(), strict=True):
                off_um = MICRO * away * float(design_mm[label])
                single.append(Trial(label, off_um, "µm", (away / sigma) ** 2, 1, freedom))
    remedy = "a damaged or dirty circle, a wrong label or another radius: look at the overlays, correct target.toml"
    of_kind = "images are over-exposed, or target.toml or board.toml is wrong: measure a circle, correct the file"
    return [assess("radius", single, "circles", remedy), assess("radius-design", whole, "kinds of circle", of_kind)]


RIM_SIGMAS = 4.0  # height of a rim, in its σ, that is taken as seen: by chance in one of 16 000 kinds of circle
KINDS = {"circles": ("circles of the faces", "the faces lie"), "dots": ("dots of the board", "the board lies")}
"""Name of each kind of circle, and what lies where its circles do."""


def rim_limit_mm(rim: Rim, sigma_mm: float | None) -> float:
    """Returns the height from which a rim is seen and moves the faces, whose positions are known to ``sigma_mm``."""
    return max(RIM_SIGMAS * rim.sigma_mm, 2 * (sigma_mm or 0.0))


def rim_check(
    rims: Mapping[str, Rim],
    sigma_mm: float | None,  # largest σ of a face's position
    allowed_mm: Mapping[str, float | None],  # the height that the result allows for; None: that estimated here
    has_circles: bool = True,
) -> Check:
    """Tests whether circles lie behind a rim, from the change of their radii with tilt."""
    if not has_circles:
        return impossible("rim", "corners alone, which have no rim", "")
    if not rims:
        return impossible("rim", "too few different tilts of circles", "photograph faces from several angles")
    measured, names, reasons, settled, title = [], [], [], [], CHECKS["rim"][0]
    for kind, rim in rims.items():
        limit = rim_limit_mm(rim, sigma_mm)
        allowed = allowed_mm.get(kind, 0.0)
        beyond = 0.0 if allowed is None else rim.height_mm - allowed
        what, surface = KINDS[kind]
        look = f"{what} look {rim.height_mm:.3f} ± {rim.sigma_mm:.3f} mm deep"
        measured.append(TestedValue(what, 1e3 * rim.height_mm, 1e3 * limit, "µm", None))
        if abs(beyond) > limit:
            names.append(what)
            where = "in front of" if beyond > 0 else "behind"
            reasons.append(f"{look}: {surface} {abs(beyond) / 2:.3f} mm {where} the luminous surface")
        elif allowed != 0:
            source = "estimated" if allowed is None else f"{allowed:g} mm stated"
            settled.append(f"{look}, {source}; {surface} on the surface")
    if not names:
        deepest = max(rims.values(), key=lambda rim: abs(rim.height_mm) / rim.sigma_mm)
        flat = f"radii change with tilt as those of flat circles: {deepest.height_mm:.3f} ± {deepest.sigma_mm:.3f} mm"
        return Check("rim", title, "passed", "; ".join(settled) or flat, tuple(measured), len(rims), (), "")
    remedy = "faces are where circles appear; for the luminous surface, leave --no-rim out, or state rim_mm"
    return Check("rim", title, "suspicious", "; ".join(reasons), tuple(measured), len(rims), tuple(names), remedy)


def rim_of_run(evidence: Evidence) -> Check:
    """Returns :func:`rim_check` of a run."""
    return rim_check(evidence.rims, evidence.face_sigma_mm, evidence.allowed_mm, bool(evidence.radius_mm))


def shows_rim(evidence: Evidence) -> bool:
    """Returns whether the radii of the faces' circles show for certain that they lie behind a rim that none stated."""
    if evidence.joint is None or evidence.target.rim_of() or "circles" not in evidence.rims:
        return False
    rim = evidence.rims["circles"]
    return rim.height_mm > rim_limit_mm(rim, evidence.face_sigma_mm)


def _before_circles_mm(evidence: Evidence) -> dict[Label, float]:
    """Heights of the rims in front of circles and dots: estimated if allowed for or found, else as stated."""
    stated = {**evidence.target.rim_of(), **dict.fromkeys(evidence.board.labels(), evidence.board.rim_mm)}
    names = rim_of_run(evidence).names
    found = {k: rim.height_mm for k, rim in evidence.rims.items() if evidence.rim or KINDS[k][0] in names}
    return {
        label: found.get("dots" if isinstance(label, DotLabel) else "circles", stated.get(label, 0.0))
        for label in evidence.radius_mm
    }


DESIGN_SCALE = 1e-4
"""Relative σ of the target's size against its design: the effect of 4 K on aluminium, or of a printer on a film."""


def board_checks(evidence: Evidence) -> list[Check]:
    """Tests the dots of every group against the grid, and the scale of each row and column against the rest."""
    whole, lines = [], []
    for network in evidence.networks:
        dots = np.array([i for i, label in enumerate(network.model.labels) if isinstance(label, DotLabel)])
        if len(dots) < MIN_DOTS:
            continue
        gap, weight, cells = _board_gap(network, dots, evidence.board)
        redundancy, freedom, square = network.redundancy.sum(), 3 * len(dots) - 7, float(gap @ weight @ gap)
        name = f"group {network.model.group}"
        rms_um = MICRO * float(np.sqrt((gap**2).mean()))
        whole.append(Trial(name, rms_um, "µm RMS", square, freedom, redundancy))
        lines += _lines(name, gap, weight, cells, evidence.board, max(1.0, square / freedom), redundancy)
    remedy = "a bent, swollen or badly printed board, or a stated σ too small: measure it, state its σ in board.toml"
    of_line = "check this line of the board for damage, and rows, columns and pitch in board.toml"
    return [assess("board", whole, "groups", remedy), assess("board-lines", lines, "rows and columns", of_line)]


def _board_gap(network: Network, dots: np.ndarray, board: BoardDesign):
    """Returns dots minus grid after a similarity, (3d,) mm, their weights with the group's noise, and their cells."""
    labels = [network.model.labels[i] for i in dots]
    cells = dot_cells(labels)
    design = board.places_mm(labels)
    xyz = network.model.xyz_model[dots]
    board_from_model = align_similarity(design, xyz)
    turn = np.kron(np.eye(len(dots)), board_from_model.scale * board_from_model.rigid.rotation)
    of_images = network.noise() * network.covariance_of(dots)
    covariance = turn @ of_images @ turn.T + board.sigma_mm**2 * np.eye(3 * len(dots))
    weight = weight_beside(covariance, free_motions(design, scale=True))
    return (board_from_model @ xyz - design).ravel(), weight, cells


def _lines(name, gap, weight, cells, board: BoardDesign, inflation: float, redundancy: float) -> list[Trial]:
    """Tests the stretch of each row along X and of each column along Y, in ppm."""
    trials = []
    for axis, kind in enumerate(("row", "column")):
        for line in np.unique(cells[:, axis]):
            members = np.flatnonzero(cells[:, axis] == line)
            if len(members) < 3:
                continue
            pattern = np.zeros((len(cells), 3))
            place = board.places_mm([DotLabel(*cell) for cell in cells[members].tolist()])[:, axis]
            pattern[members, axis] = place - place.mean()
            weighted = pattern.ravel() @ weight
            information = float(weighted @ pattern.ravel())
            stretch = float(weighted @ gap) / information
            statistic = stretch**2 * information / inflation
            trials.append(Trial(f"{name} {kind} {line}", 1e6 * stretch, "ppm", statistic, 1, redundancy))
    return trials


def pitch_check(evidence: Evidence) -> Check:
    """Tests the size of the targetagainst its design, with σ of 100 ppm: no residual shows a wrong pitch."""
    calibrated, target = evidence.calibration.target, evidence.target
    if target.up_to_scale:
        return impossible("pitch", "the drawing defines the size", "state a known distance with scale")
    weighted, weight, square, freedom = 0.0, 0.0, 0.0, 0
    circled = target.with_faces(printed=False).faces  # the others have told the scale
    for face in circled:
        labels = [label for label in face.labels() if label in calibrated.circles]
        if len(labels) < MIN_DOTS:
            continue
        design = face.places_mm(label.circle for label in labels)
        xyz = np.array([calibrated.circles[label] for label in labels])
        fit = align_similarity(xyz, design)
        spread = float(((design - design.mean(0)) ** 2).sum())
        weighted, weight = weighted + spread * (fit.scale - 1), weight + spread
        residuals = fit.inverse() @ xyz - design
        square, freedom = square + float((residuals[:, :2] ** 2).sum()), freedom + 2 * len(labels) - 4
    if not freedom:
        return impossible("pitch", f"no face with {MIN_DOTS} circles", "add views of the faces" if circled else "")
    size = weighted / weight
    variance = square / freedom / weight + DESIGN_SCALE**2 + (calibrated.scale_sigma or 0.0) ** 2
    what, remedy = "board pitch", "pitch_mm, or the target's size, is wrong, and all lengths with it: measure the board"
    if not evidence.board.rows:
        what, remedy = "size of the circles' faces", "sizes in target.toml do not fit it: measure a side of each print"
    return assess("pitch", [Trial(what, 1e6 * size, "ppm", size**2 / variance, 1, freedom)], "boards", remedy)


PPM = 1e6
ALONE, FAR, LEAST_AGREEING = 0.005, 3.0, 2
"""Relative error of size from which one source is named, how many times as far off as the others it must be, and how
many others must agree."""
MOST_PRINT_FACTOR = 10.0
"""Corners about the design over their stated σ from which on the design, or a stated size, is another one."""


def scales_check(evidence: Evidence) -> Check | tuple[()]:
    """Tests the sources of the scale against their mean in a group's free network, if the target tells its size too."""
    networks, board, joint = evidence.networks, evidence.board, evidence.joint
    if not isinstance(board, ScaleReference):
        return ()
    print_factor, title = 1.0 if joint is None else joint.print_factor, CHECKS["scales"][0]
    remedy = "another size than stated: measure a side of each print, and correct target.toml or state size_sigma_mm"
    name, times = _alone(networks, board) or ("", 1.0)
    of_name = f"correct the size of {name}, or state size_sigma_mm of the prints larger"
    fits = f"{name} would fit with {times:.4g} times its stated size, and the others agree with one another"
    if print_factor > MOST_PRINT_FACTOR:
        # σ that have grown so much would hide the contradiction that made them grow.
        grown = TestedValue("corners about the design", print_factor, MOST_PRINT_FACTOR, "× their stated σ", None)
        if name:
            size = TestedValue(name, 100 * (times - 1), 100 * ALONE, "% larger than stated", None)
            return Check("scales", title, "failed", fits, (size, grown), 1, (name,), of_name)
        why = "the size or drawing of the print is another one, or its σ too small"
        reason = f"{grown.name} at {grown.words()}: {why}"
        return Check("scales", title, "suspicious", reason, (grown,), 1, (grown.name,), remedy)
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
        for source, off, own in zip(names, away.tolist(), spread.tolist(), strict=True):
            trials += [Trial(source, PPM * off, "ppm", off**2 / own, 1, freedom)] if own > 0 else []
    if not trials:
        return impossible("scales", "only one source of the scale", "state a known distance with scale")
    check = assess("scales", trials, "sources of the scale", remedy)
    if check.names and name:
        return replace(check, reason=f"{fits}; {check.reason}", names=(name,), remedy=of_name)
    return check


def _alone(networks: Sequence[Network], board: BoardDesign) -> tuple[str, float] | None:
    """Returns the one source that contradicts all others, which agree, and its size over the stated one."""
    off: dict[str, list[float]] = defaultdict(list)
    for network in networks:
        names, log_scale, *_ = _sources(network, board, 1.0)
        for name, value in zip(names, log_scale.tolist(), strict=True):
            off[name].append(value - float(np.median(log_scale)))
    ratio = {name: float(np.median(values)) for name, values in off.items()}
    if len(ratio) < LEAST_AGREEING + 1:
        return None
    name = max(ratio, key=lambda each: abs(ratio[each]))
    others = max(abs(value) for each, value in ratio.items() if each != name)
    return (name, float(np.exp(ratio[name]))) if abs(ratio[name]) > max(ALONE, FAR * others) else None


def _sources(
    network: Network, board: BoardDesign, print_factor: float
) -> tuple[Sequence[str], np.ndarray, np.ndarray, np.ndarray]:
    """Returns names, log of model over known size (s,), gradient (s, 3p) and variance of the sources of the scale."""
    model = network.model
    parts = [
        (f"face {face.id}", members, face.places_mm(model.labels[i].circle for i in members),
         print_factor * (face.sigma_mm or 1.0), face.size_sigma)
        for face, members in known_points(model.labels, board)
    ]  # fmt: skip
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)], int)
    if len(dots) >= MIN_DOTS:
        parts.append(("board", dots, board.places_mm(model.labels[i] for i in dots), board.sigma_mm, 0.0))
    sources: list[tuple[str, float, np.ndarray, float]] = []
    for name, members, design, sigma_mm, size_sigma in parts:
        with suppress(DegenerateError):
            found = align_similarity(model.xyz_model[members], design)
            middle = design - design.mean(0)
            square = float((middle**2).sum())
            gradient = np.zeros((len(model.labels), 3))
            gradient[members] = middle @ found.rigid.rotation.T / (square * found.scale)
            variance = sigma_mm**2 / square + size_sigma**2
            sources.append((name, np.log(found.scale), gradient.ravel(), variance))
    place = {label: i for i, label in enumerate(model.labels)}
    for known in known_distances(board):
        if known.first in place and known.second in place:
            i, j = place[known.first], place[known.second]
            apart = model.xyz_model[i] - model.xyz_model[j]
            gradient = np.zeros((len(model.labels), 3))
            gradient[i] = apart / float(apart @ apart)
            gradient[j] = -gradient[i]
            name, log_scale = f"distance {known.first} to {known.second}", np.log(np.linalg.norm(apart) / known.mm)
            sources.append((name, log_scale, gradient.ravel(), (known.sigma_mm / known.mm) ** 2))
    names, *numbers = zip(*sources, strict=True) if sources else [()] * 4
    log_scales, gradients, variances = (np.array(each) for each in numbers)
    return names, log_scales, gradients, variances
