"""Checks of images, labels, single observations and camera from the residuals of the free networks."""

import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import bdtrc, chdtri

from stcal.errors import StcalError
from stcal.geometry.arrays import rms
from stcal.geometry.camera import PARAMETER_NAMES, intrinsic_basis
from stcal.geometry.robust import ratio_limit, robust_sigma
from stcal.labels import Label
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.refine import Network, ScoreTest, adjust, solve_score
from stcal.sfm.checks import significance
from stcal.sfm.checks.significance import MICRO, Evidence, Guilt, Trial, assess
from stcal.sfm.report.check import CHECKS, SUSPICIOUS, Check, TestedValue, impossible

MIN_CIRCLES = 3
"""Smallest number of circles of the faces, and of the board, in an image that can show motion between both."""
SIGMA_LIMITS = (2.0, significance.MOST_SIGMAS)
"""Limits of residuals over the centres' own σ: light and lens may add a factor of two."""
DULL = 1.5
"""Ratio of an image's σ of centres to that of its group at which the image has lost more than half of its weight."""
MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation: degrees of freedom, per value, of a spread estimated by it."""
UNEVEN_BY_CHANCE = 0.01  # share of even circles that noise or a compressed file may make look uneven
FIELD_DEGREE = 3
FIELD_FLOOR_PX = 0.002
"""σ of a field that any centring leaves: pixel raster, JPEG blocks and light from one side do not average out."""
NEARLY_ALL = 0.7  # share of the images beyond which a check that names them names none
EXCHANGED = 0.1
"""Largest deviation of exchanged labels: each centre lies at the place of the other to within this share of their
distance."""
MANY = 5  # number of centres left out of one image at which they are no longer single hidden or dirty circles


def camera_check(evidence: Evidence) -> Check:
    """Tests whether the intrinsics are those of the images: in the residuals of all free networks (score test) if they
    are as given, by their distance from the given ones if they were refined."""
    if not evidence.camera_given:
        reason = "no camera file, or a rough one as from EXIF: the intrinsics were found from these photographs"
        return impossible("camera", reason, "")
    anew = "use --refine-camera" if evidence.prior is None else "calibrate the camera anew"
    remedy = f"not the camera of these images (focus, zoom, lens, size), or too coarse: {anew}"
    networks, camera, found = evidence.networks, evidence.camera, evidence.calibration.camera
    if evidence.prior is not None and evidence.joint is not None:  # the options of a run ensure the latter
        model, stated = evidence.prior.colmap_model, evidence.prior.covariance
        estimate = np.linalg.pinv(intrinsic_basis(model)) @ (found.parameters() - camera.parameters())
        gained = stated - evidence.joint.camera_covariance
        test = solve_score(np.linalg.pinv(gained, hermitian=True), np.linalg.pinv(gained) @ estimate)
        sigma, redundancy = np.sqrt(np.diag(stated)), sum(n.redundancy.sum() for n in networks)
    else:
        model = "FULL_OPENCV" if camera.colmap_model == "FULL_OPENCV" else "OPENCV"
        model = "THIN_PRISM_FISHEYE" if camera.fisheye else model
        basis = intrinsic_basis(model)
        test, redundancy = tested(networks, lambda n: n.model.whiten(n.model.by_parameters(found) @ basis))
        estimate, sigma = test.estimate, np.sqrt(np.diag(test.covariance))
    names = [PARAMETER_NAMES[i] for i in intrinsic_basis(model).argmax(0)]
    value = float(np.sqrt(max(test.statistic, 0) / max(test.freedom, 1)))
    check = assess("camera", [Trial("camera", value, "σ", test.statistic, test.freedom, redundancy)], "cameras", remedy)
    single = tuple(
        TestedValue(name, float(value), float(3.29 * s), "px" if name[0] in "fc" else "", None)
        for name, value, s in zip(names, estimate, sigma, strict=True)
    )
    values = ", ".join(f"{m.name} {m.value:+.2g}" for m in single if abs(m.value) > (m.limit or 0))
    reason = f"{check.reason}; the images suggest {values}" if check.names and values else check.reason
    return replace(check, reason=reason, measured=check.measured + single)


def summed(equations: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sums of :meth:`~stcal.sfm.adjust.refine.Network.score` of parameters that groups have in common."""
    normal, right = zip(*equations, strict=True)
    return np.sum(normal, axis=0), np.sum(right, axis=0)


def tested(networks: Sequence[Network], columns: Callable[[Network], np.ndarray]) -> tuple[ScoreTest, float]:
    """Returns the score test of parameters that all groups have in common, and its degrees of freedom of noise. Where
    images scatter about the common estimate by more than their pixels do (Cochran's Q), its squares count by as many
    times less, as those of σ from how photographs differ."""
    test = solve_score(*summed(n.score(columns(n)) for n in networks))
    scatter, freedom = 0.0, -test.freedom
    for network in networks:
        for normal, right in zip(*network.score_by_image(columns(network)), strict=True):
            own = solve_score(normal, right - normal @ test.estimate)
            scatter, freedom = scatter + own.statistic, freedom + own.freedom
    redundancy = float(sum(n.redundancy.sum() for n in networks))
    if freedom <= 0 or scatter <= freedom:
        return test, redundancy
    times = scatter / freedom
    fewer = replace(test, covariance=times * test.covariance, statistic=test.statistic / times)
    return fewer, min(redundancy, float(freedom))


def field_check(evidence: Evidence) -> Check:
    """Tests for a residual field that is the same in all images, cubics in x and y that no intrinsics explain."""
    networks, camera = evidence.networks, evidence.calibration.camera

    def columns(network: Network) -> np.ndarray:
        # Not at the measured places: a field that poses and points absorb would leave the residuals themselves.
        x, y = (2 * camera.project(network.model.xyz_camera()) / np.array([camera.width, camera.height]) - 1).T
        terms = np.stack([x**i * y**j for i in range(FIELD_DEGREE + 1) for j in range(FIELD_DEGREE + 1 - i)], axis=1)
        zeros = np.zeros_like(terms)
        return network.model.whiten(np.stack([np.hstack([terms, zeros]), np.hstack([zeros, terms])], axis=1))

    test, redundancy = tested(networks, columns)
    count = sum(n.residual.size for n in networks)
    sigma = np.sqrt(np.mean(np.concatenate([n.model.sigma_px() ** 2 for n in networks])))
    value = float(sigma * np.sqrt(max(test.statistic, 0) / count))
    allowed = 1 + count * (FIELD_FLOOR_PX / sigma) ** 2 / max(test.freedom, 1)
    trial = Trial("camera", value, "px RMS", test.statistic / allowed, test.freedom, redundancy)
    remedy = "the camera model cannot follow the distortion: calibrate with FULL_OPENCV, at this focus and aperture"
    return assess("residual-field", [trial], "residual fields", remedy)


def sigma_check(evidence: Evidence) -> Check:
    """Tests σ₀ of the images alone; the σ of the result include it, so that only a large factor is a fault."""
    (low, high), factor = SIGMA_LIMITS, evidence.calibration.sigma_factors.all
    redundancy = sum(n.redundancy.sum() for n in evidence.networks)
    if redundancy < 1:
        return impossible("centres", significance.FREE, "add images")
    verdict = "passed" if factor < low else "suspicious" if factor < high else "failed"
    reason = f"residuals are {factor:.2f} times the centres' own σ, limit {low:g}; {redundancy:.0f} degrees of freedom"
    remedy = "look at the other checks first: camera, moved target, images; then at exposure and sharpness"
    measured = (TestedValue("all images", factor, low, "×", None),)
    names = () if verdict == "passed" else ("all images",)
    return Check("centres", CHECKS["centres"][0], verdict, reason, measured, 1, names, remedy if names else "")


def image_check(evidence: Evidence) -> Check:
    """Tests the squared residuals of every image against those of its group's other images (F test). Residuals of one
    image are not independent: where images scatter more than they would be, each counts as so many fewer."""
    found: list[tuple[str, float, float, float]] = []  # name, ratio of squares, redundancy of the image and the others
    for network in evidence.networks:
        square, redundancy = network.square_by_image()
        others = redundancy.sum() - redundancy
        for name, own, free, rest in zip(network.model.images, square, redundancy, others, strict=True):
            if free >= 1 and rest >= 1:
                ratio = own / free / max((square.sum() - own) / rest, 1e-12)
                found.append((name, float(ratio), float(free), float(rest)))
    logs = np.log([max(ratio, 1e-12) for _, ratio, _, _ in found])
    by_chance = float(np.mean([2 / own + 2 / others for _, _, own, others in found])) if found else 1.0
    scattered = robust_sigma(np.abs(logs - np.median(logs))) ** 2 if len(found) > 1 else 0.0
    fewer = max(1.0, scattered / by_chance)
    trials = []
    for name, ratio, own, others in found:
        freedom = max(round(own / fewer), 1)
        trials.append(Trial(name, float(np.sqrt(ratio)), "×", ratio * freedom, freedom, others / fewer))
    remedy = "a blurred image, or one in which something had moved: look at its overlay, leave it out, and run again"
    return _take_out(assess("image-residuals", trials, "images", ""), remedy)


def sharpness_check(evidence: Evidence) -> Check:
    """Compares the σ of centres, circle by circle, and the blur of every image with its group's other images."""
    sigma: dict[str, float] = {}
    blur: dict[str, float] = {}
    for network in evidence.networks:
        model, log_sigma = network.model, np.log(network.model.sigma_px())
        usual = np.array([np.median(log_sigma[model.point_index == p]) for p in range(len(model.labels))])
        away = log_sigma - usual[model.point_index]
        sigma |= {name: float(np.median(away[r])) for name, r in zip(model.images, model.rows_by_image(), strict=True)}
        log_blur = {n: float(np.log(evidence.blur_px[n])) for n in model.images if evidence.blur_px.get(n, 0) > 0}
        blur |= {name: value - np.median(list(log_blur.values())) for name, value in log_blur.items()}
    trials = []
    for log_ratios, unit in ((sigma, "× σ"), (blur, "× blur")):
        if log_ratios:
            values, freedom = np.array(list(log_ratios.values())), max(MAD_EFFICIENCY * len(log_ratios) - 1, 2.0)
            least = np.log(DULL) / np.sqrt(ratio_limit(SUSPICIOUS / len(values), 1, freedom))
            spread = max(robust_sigma(np.abs(values - np.median(values))), least)
            for name, value in log_ratios.items():
                statistic = float(max(value / spread, 0.0)) ** 2
                trials.append(Trial(name, float(np.exp(value)), unit, statistic, 1, freedom, ratio=True))
    remedy = "blurred, out of focus or dark: take the image again; its centres have little weight and do no harm"
    return assess("sharpness", trials, "values", remedy, "suspicious")


def evenness_check(evidence: Evidence) -> Check:
    """Finds circles whose brightness varies around the rim, in many images, by more than two planes describe. Their
    centres would be off alike in all views; a value is the error that the wider model avoids, µm at the circle."""
    if not evidence.radius_mm:
        return impossible("evenness", "corners alone, which have no rim", "")
    uneven = {image.name: image.uneven_px for image in evidence.images}
    focal_px = float(np.sqrt(evidence.calibration.camera.focal.prod()))
    shifts_of_label: dict[str, list[float]] = defaultdict(list)
    for network in evidence.networks:
        model = network.model
        depth = model.xyz_camera()[:, 2] / focal_px
        for k, (i, p) in enumerate(zip(model.image_index, model.point_index, strict=True)):
            shift_px = float(np.linalg.norm(uneven[model.images[i]][model.keypoint[k]]))
            shifts_of_label[model.labels[p]].append(MICRO * depth[k] * shift_px)
    trials = []
    for label, shifts in shifts_of_label.items():
        count = sum(shift > 0 for shift in shifts)
        chance = float(bdtrc(count - 1, len(shifts), UNEVEN_BY_CHANCE)) if count else 1.0
        trials.append(Trial(label, float(np.mean(shifts)), "µm", float(chdtri(1, chance)), 1))
    remedy = "one side of them is darker in most views: clean them, shade them from glare, check their light"
    return assess("evenness", trials, "circles", remedy, "suspicious")


def moved_check(evidence: Evidence) -> Check:
    """Tests whether the target moved relative to the board, one image against all others. The yardstick is the residual
    that the motion leaves in the image and its group: a noisy image seems to move too."""
    trials: list[Trial] = []
    tested_by_group: dict[str, tuple[Network, np.ndarray, list[int]]] = {}
    for network in evidence.networks:
        model, of_faces = network.model, significance.on_face(network.model)
        if of_faces.all() or not of_faces.any():
            continue
        columns = significance.by_motion(network, model.xyz_model[of_faces].mean(0))
        normal, right = network.score_by_image(columns)
        redundancy, square = float(network.redundancy.sum()), float((network.residual**2).sum())
        suspects = []
        squares, redundancies = network.square_by_image()
        for i, (name, rows) in enumerate(zip(model.images, model.rows_by_image(), strict=True)):
            faces, test = of_faces[model.point_index[rows]].sum(), solve_score(normal[i], right[i])
            if test.freedom and min(faces, len(rows) - faces) >= MIN_CIRCLES:
                of_both = (squares[i], redundancies[i]), (square, redundancy)
                noise = max((own - test.statistic) / max(free - test.freedom, 1.0) for own, free in of_both)
                statistic, shift_um = test.statistic / max(noise, 1.0), MICRO * float(np.linalg.norm(test.estimate[3:]))
                trials.append(Trial(name, shift_um, "µm", statistic, test.freedom, redundancy - test.freedom))
                suspects.append(i)
        tested_by_group[model.group] = network, columns, suspects
    check = assess("moved", trials, "images", "")
    if not check.names or _nearly_all(check):
        return _take_out(check, "")
    guilt = [
        significance.culprits_by_score(network, columns, suspects, check.tested, f"group {group}")
        for group, (network, columns, suspects) in tested_by_group.items()
        if any(network.model.images[i] in check.names for i in suspects)
    ]
    names, open_ones = [name for own in guilt for name in own.culprits], [w for own in guilt if (w := own.words())]
    names = sorted(names, key=check.names.index) if set(names) <= set(check.names) else names
    where = "the target stood elsewhere relative to the board: sort images into groups, or leave a single one out"
    remedies = [f"{where}: {without_image(name)}" for name in names[:1]] + [
        "target or board moved between these images, or zoom or focus changed: take the group again"
    ] * bool(open_ones)
    reason = "; ".join([check.reason, *open_ones])
    return replace(check, reason=reason, names=tuple(names), remedy="; ".join(remedies))


def without_image(name: str) -> str:
    """Returns the option that excludes an image from a run."""
    return f"--exclude {shlex.quote(name)}"


def _nearly_all(check: Check) -> bool:
    return len(check.names) > max(NEARLY_ALL * check.tested, 1)


def _take_out(check: Check, remedy: str) -> Check:
    """Returns the check with the remedy and the option that excludes the worst image, if it names one."""
    if _nearly_all(check):
        common = "nearly all images, so do not leave any out: look for what they have in common, first the camera"
        return replace(check, names=(), remedy=common)
    return replace(check, remedy=f"{remedy}: {without_image(check.names[0])}") if check.names else check


def labels_check(evidence: Evidence) -> Check:
    """Tests every observation against all others by its own covariance (Baarda's data snooping), and names those left
    out. Labels at each other's places are a fault: others may be exchanged without being noticed."""
    remedy = "look at them in the overlays: hidden in part, dirty, a reflection, at an edge, or a wrong label"
    trials = []
    for network in evidence.networks:
        model, total = network.model, float(network.redundancy.sum())
        square, freedom = network.squares_of_observations()
        for k in np.flatnonzero(freedom):
            name = f"{model.images[model.image_index[k]]} {model.labels[model.point_index[k]]}"
            length = float(np.linalg.norm(network.residual[k]))
            trials.append(Trial(name, length, "σ", float(square[k]), int(freedom[k]), total))
    check, outliers = assess("labels", trials, "centres", remedy, "suspicious"), evidence.outliers
    if not outliers:
        return check
    swapped, guilt = _exchanged(evidence), _images_of_outliers(evidence)
    lost = [name for own in guilt for name in own.culprits]
    measured = [TestedValue(f"{o.image} {o.label}", o.residual_px, o.limit_px, "px", None) for o in outliers]
    named = [own.name for own in measured]
    verdict, reason = "suspicious", f"{len(outliers)} left out, first {named[0]}: {measured[0].words()}"
    if guilt:
        verdict = "failed"
        words = [f"{MANY} or more of image {', '.join(lost)}"] * bool(lost) + [w for own in guilt if (w := own.words())]
        reason = f"{len(outliers)} left out, {'; '.join(words)}"
        remedy = "target or board moved between the images of a group, or zoom or focus changed: take it again"
        if lost:
            remedy = "the target stood elsewhere, or they are of another group: leave them out"
            remedy = f"{remedy}: {without_image(lost[0])}"
    if swapped:
        verdict, reason = "failed", f"labels exchanged: {swapped[0]}"
        remedy = "these labels are wrong: check the circles' positions and radii in target.toml, look at the overlay"
    shown, names = (*measured, *check.measured)[: significance.SHOWN], (*swapped, *lost, *named, *check.names)
    return replace(check, verdict=verdict, reason=reason, measured=shown, names=names, remedy=remedy)


def _images_of_outliers(evidence: Evidence) -> list[Guilt]:
    """Returns the images of each group that lost :data:`MANY` centres or more; none of a group that lost half of it."""
    count = Counter(o.image for o in evidence.outliers)
    found = []
    for network in evidence.networks:
        group = network.model.group
        names = dict.fromkeys([*network.model.images, *(n for n in count if n.rpartition("/")[0] == group)])
        many = sorted((name for name in names if count[name] >= MANY), key=lambda name: -count[name])
        if many:
            found.append(Guilt(f"group {group}", tuple(many) if len(many) < significance.MOST * len(names) else ()))
    return found


def _exchanged(evidence: Evidence) -> list[str]:
    """Returns ``image: label and label`` of every pair of outliers that are at each other's places."""
    by_image: dict[str, list[Label]] = defaultdict(list)
    for outlier in evidence.outliers:
        by_image[outlier.image].append(outlier.label)
    observed, camera = {image.name: image for image in evidence.images}, evidence.calibration.camera
    pairs = []
    for network in evidence.networks:
        model = network.model
        for name, pose in zip(model.images, model.camera_from_model, strict=True):
            labels = [label for label in by_image[name] if label in model.labels]
            place = {x: camera.project((pose @ model.xyz_model[model.labels.index(x)])[None])[0] for x in labels}
            measured = dict(zip(observed[name].labels, observed[name].centre_px, strict=True))
            for a, b in combinations(labels, 2):
                apart = np.linalg.norm(place[a] - place[b])
                off = max(np.linalg.norm(measured[a] - place[b]), np.linalg.norm(measured[b] - place[a]))
                if off < EXCHANGED * apart:
                    pairs.append(f"{name}: {a} and {b}")
    return pairs


def control_check(evidence: Evidence) -> Check:
    """Compares the run with a control without eccentricity, chained with three-point frames, and tests the correction:
    a factor on it is 1 up to chance, and 0 if the centres are not those of ellipses."""
    networks = evidence.networks
    if not evidence.radius_mm:
        return impossible("control", "corners alone, which have no eccentricity", "")
    if not evidence.options.eccentricity:
        return impossible("control", "this run is the control", "run with eccentricity")
    if not any(n.model.shift_px.any() for n in networks):
        return impossible("control", "no circle is in the result", "add views of the faces with circles")
    test = solve_score(*summed(n.score(significance.by_eccentricity(n)) for n in networks))
    if not test.freedom:
        return impossible("control", "poses and circles explain any eccentricity", "add tilted views of the faces")
    redundancy, share = sum(n.redundancy.sum() for n in networks), float(test.estimate[0])
    trial = Trial("share of the eccentricity found, minus 1", share, "", test.statistic, test.freedom, redundancy)
    check = assess("control", [trial], "corrections", significance.NO_ELLIPSES)
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
    plain = replace(evidence.options, refine_camera=False, eccentricity=False)
    options = replace(plain, solve="chain", frame="three-point")
    control = calibrate(models, camera, evidence.target, evidence.board, options).target
    shifts = {
        face: MICRO * float(np.linalg.norm(control.target_from_face[face].translation - pose.translation))
        for face, pose in whole.target_from_face.items()
        if face != whole.reference_face
    }
    residual = rms(np.concatenate([m.residuals_px(camera) for m in models]))
    rows = [TestedValue(f"face {f}, without eccentricity", value, None, "µm", None) for f, value in shifts.items()]
    largest = max(shifts.values(), default=0.0)
    return f"without it faces are off by up to {largest:.0f} µm at residuals of {residual:.4f} px", tuple(rows)
