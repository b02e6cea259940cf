"""Checks of images, labels, single observations and camera from the residuals of the free networks."""

import shlex
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import bdtrc, chdtri

from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.rigid import skew
from stcal.geometry.robust import ratio_limit, robust_sigma
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import Label
from stcal.sfm.adjust.calibration import Calibration
from stcal.sfm.adjust.refine import Network, ScoreTest, solve_score
from stcal.sfm.checks.significance import (
    FREE,
    MOST_SIGMAS,
    SHOWN,
    Guilt,
    Trial,
    assess,
    culprits,
    culprits_by_score,
    on_face,
)
from stcal.sfm.data.group_model import ImageObservations, Outlier
from stcal.sfm.report.check import CHECKS, SUSPICIOUS, Check, TestedValue, impossible

MIN_CIRCLES = 3
"""Smallest number of circles of the faces, and of the board, in an image that can show motion between both."""
SIGMA_LIMITS = (2.0, MOST_SIGMAS)
"""Limits of residuals over the centres' own σ: light and lens may add a factor of two."""
DULL = 1.5
"""Ratio of an image's σ of centres to that of its group at which the image has lost more than half of its weight."""
MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation: degrees of freedom, per value, of a spread estimated by it."""
UNEVEN_BY_CHANCE = 0.01
"""Share of even circles that noise or a compressed file may make look uneven."""
FIELD_DEGREE = 3
FIELD_FLOOR_PX = 0.002
"""σ of a field that any centring leaves: pixel raster, JPEG blocks and light from one side do not average out."""


def camera_check(
    networks: Sequence[Network],
    camera: Camera,
    calibration: Calibration,
    prior: CameraPrior | None,  # of the intrinsics if they were refined
    given: bool = True,  # False if the camera was found from the photographs
) -> Check:
    """Tests whether the intrinsics are those of the images: in the residuals of all free networks (score test) if they
    are as given, by their distance from the given ones if they were refined."""
    if not given:
        reason = "no camera file, or a rough one as from EXIF: the intrinsics were found from these photographs"
        return impossible("camera", reason, "")
    remedy = (
        "the camera file does not belong to these images (other focus, zoom, lens or size), or is too coarse: run with "
        "--refine-camera, or calibrate the camera again"
    )
    if prior is not None and calibration.joint is not None:  # the options of a run ensure the latter
        change = np.linalg.pinv(intrinsic_basis(prior.colmap_model))
        change = change @ (calibration.camera.parameters() - camera.parameters())
        gained = prior.covariance - calibration.joint.camera_covariance
        model, estimate, sigma = prior.colmap_model, change, np.sqrt(np.diag(prior.covariance))
        test = solve_score(np.linalg.pinv(gained, hermitian=True), np.linalg.pinv(gained) @ change)
        redundancy = sum(n.redundancy.sum() for n in networks)
    else:
        model = "FULL_OPENCV" if camera.colmap_model == "FULL_OPENCV" else "OPENCV"
        model = "THIN_PRISM_FISHEYE" if camera.fisheye else model
        basis, found = intrinsic_basis(model), calibration.camera
        test, redundancy = tested(networks, lambda n: n.model.whiten(n.model.by_parameters(found) @ basis))
        estimate, sigma = test.estimate, np.sqrt(np.diag(test.covariance))
    names = [PARAMETER_NAMES[i] for i in intrinsic_basis(model).argmax(0)]
    rms = float(np.sqrt(max(test.statistic, 0) / max(test.freedom, 1)))
    check = assess("camera", [Trial("camera", rms, "σ", test.statistic, test.freedom, redundancy)], "cameras", remedy)
    single = tuple(
        TestedValue(name, float(value), float(3.29 * s), "px" if name[0] in "fc" else "", None)
        for name, value, s in zip(names, estimate, sigma, strict=True)
    )
    values = ", ".join(f"{m.name} {m.value:+.2g}" for m in single if abs(m.value) > (m.limit or 0))
    reason = f"{check.reason}; the images suggest {values}" if check.names and values else check.reason
    return replace(check, reason=reason, measured=check.measured + single)


def summed(networks: Sequence[Network], columns: Callable[[Network], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns :meth:`~stcal.sfm.adjust.refine.Network.score` of parameters that all groups have in common."""
    normal, right = zip(*(n.score(columns(n)) for n in networks), strict=True)
    return np.sum(normal, axis=0), np.sum(right, axis=0)


def tested(networks: Sequence[Network], columns: Callable[[Network], np.ndarray]) -> tuple[ScoreTest, float]:
    """Returns the score test of parameters that all groups have in common, and its degrees of freedom of noise. Where
    images scatter about the common estimate by more than their pixels do (Cochran's Q), its squares count by as many
    times less, as those of σ from how photographs differ."""
    test = solve_score(*summed(networks, columns))
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


def field_check(networks: Sequence[Network], camera: Camera) -> Check:
    """Tests for a residual field that is the same in all images, cubics in x and y that no intrinsics explain."""

    def columns(network: Network) -> np.ndarray:
        size = np.array([camera.width, camera.height])
        # Not at the measured places: a field that poses and points absorb would leave the residuals themselves.
        x, y = (2 * camera.project(network.model.xyz_camera()) / size - 1).T
        terms = np.stack([x**i * y**j for i in range(FIELD_DEGREE + 1) for j in range(FIELD_DEGREE + 1 - i)], axis=1)
        zeros = np.zeros_like(terms)
        field = np.stack([np.hstack([terms, zeros]), np.hstack([zeros, terms])], axis=1)
        return network.model.whiten(field)

    test, redundancy = tested(networks, columns)
    count = sum(n.residual.size for n in networks)
    sigma = np.sqrt(np.mean(np.concatenate([n.model.sigma_px() ** 2 for n in networks])))
    value = float(sigma * np.sqrt(max(test.statistic, 0) / count))
    allowed = 1 + count * (FIELD_FLOOR_PX / sigma) ** 2 / max(test.freedom, 1)
    trial = Trial("camera", value, "px RMS", test.statistic / allowed, test.freedom, redundancy)
    remedy = (
        "a distortion that the camera model cannot follow, or wrong intrinsics: calibrate with a richer model "
        "(FULL_OPENCV), and keep focus and aperture as they were then"
    )
    return assess("residual-field", [trial], "residual fields", remedy)


def sigma_check(networks: Sequence[Network], factor: float) -> Check:
    """Tests σ₀ of the images alone; the σ of the result include it, so that only a large factor is a fault."""
    low, high = SIGMA_LIMITS
    verdict = "passed" if factor < low else "suspicious" if factor < high else "failed"
    redundancy = sum(n.redundancy.sum() for n in networks)
    if redundancy < 1:
        return impossible("centres", FREE, "add images")
    reason = f"residuals are {factor:.2f} times the centres' own σ, limit {low:g}; {redundancy:.0f} degrees of freedom"
    remedy = "look at the other checks first: camera, moved target, images; then at exposure and sharpness"
    measured = (TestedValue("all images", factor, low, "×", None),)
    names = () if verdict == "passed" else ("all images",)
    return Check("centres", CHECKS["centres"][0], verdict, reason, measured, 1, names, remedy if names else "")


def image_check(networks: Sequence[Network]) -> Check:
    """Tests the squared residuals of every image against those of its group's other images (F test). Residuals of one
    image are not independent: where images scatter more than they would be, each counts as so many fewer."""
    found: list[tuple[str, float, float, float]] = []  # name, ratio of squares, redundancy of the image and the others
    for network in networks:
        square, redundancy = network.square_by_image()
        others = redundancy.sum() - redundancy
        for i, name in enumerate(network.model.images):
            if redundancy[i] >= 1 and others[i] >= 1:
                ratio = square[i] / redundancy[i] / max((square.sum() - square[i]) / others[i], 1e-12)
                found.append((name, float(ratio), float(redundancy[i]), float(others[i])))
    logs = np.log([max(ratio, 1e-12) for _, ratio, _, _ in found])
    by_chance = float(np.mean([2 / own + 2 / others for _, _, own, others in found])) if found else 1.0
    scattered = robust_sigma(np.abs(logs - np.median(logs))) ** 2 if len(found) > 1 else 0.0
    fewer = max(1.0, scattered / by_chance)
    trials = []
    for name, ratio, own, others in found:
        freedom = max(round(own / fewer), 1)
        trials.append(Trial(name, float(np.sqrt(ratio)), "×", ratio * freedom, freedom, others / fewer))
    check = assess("image-residuals", trials, "images", "")
    remedy = "a blurred image, or one in which something had moved: look at its overlay, leave it out, and run again"
    return _take_out(check, remedy)


def sharpness_check(networks: Sequence[Network], blur_px: dict[str, float]) -> Check:
    """Compares the σ of centres, circle by circle, and the blur of every image with its group's other images."""
    sigma: dict[str, float] = {}
    blur: dict[str, float] = {}
    for network in networks:
        model, log_sigma = network.model, np.log(network.model.sigma_px())
        usual = np.array([np.median(log_sigma[model.point_index == p]) for p in range(len(model.labels))])
        away = log_sigma - usual[model.point_index]
        sigma |= {name: float(np.median(away[r])) for name, r in zip(model.images, model.rows_by_image(), strict=True)}
        log_blur = {name: np.log(blur_px[name]) for name in model.images if blur_px.get(name, 0) > 0}
        blur |= {name: float(value - np.median(list(log_blur.values()))) for name, value in log_blur.items()}
    remedy = "blurred, out of focus or dark: take the image again; its centres have little weight and do no harm"
    trials = [*_dull(sigma, "× σ"), *_dull(blur, "× blur")]
    return assess("sharpness", trials, "values", remedy, "suspicious")


def evenness_check(
    networks: Sequence[Network], images: Sequence[ImageObservations], camera: Camera, round_: bool = True
) -> Check:
    """Finds circles whose brightness varies around the rim, in many images, by more than two planes describe. Their
    centres would be off alike in all views; a value is the error that the wider model avoids, µm at the circle."""
    if not round_:
        return impossible("evenness", "corners alone, which have no rim", "")
    uneven = {image.name: image.uneven_px for image in images}
    shifts_of_label: dict[str, list[float]] = {}
    for network in networks:
        model = network.model
        depth = model.xyz_camera()[:, 2] / float(np.sqrt(camera.focal.prod()))
        for k, (i, p) in enumerate(zip(model.image_index, model.point_index, strict=True)):
            shift_px = float(np.linalg.norm(uneven[model.images[i]][model.keypoint[k]]))
            shifts_of_label.setdefault(model.labels[p], []).append(1e3 * depth[k] * shift_px)
    trials = []
    for label, shifts in shifts_of_label.items():
        count = sum(shift > 0 for shift in shifts)
        chance = float(bdtrc(count - 1, len(shifts), UNEVEN_BY_CHANCE)) if count else 1.0
        trials.append(Trial(label, float(np.mean(shifts)), "µm", float(chdtri(1, chance)), 1))
    remedy = (
        "one side of these circles is darker or brighter, in most views: clean them, shade them from glare, check "
        "their light; their centres are measured by a wider model, with a larger σ"
    )
    return assess("evenness", trials, "circles", remedy, "suspicious")


def _dull(values: dict[str, float], unit: str) -> list[Trial]:
    if not values:
        return []
    log_ratios = np.array(list(values.values()))
    freedom = max(MAD_EFFICIENCY * len(log_ratios) - 1, 2.0)
    least = np.log(DULL) / np.sqrt(ratio_limit(SUSPICIOUS / len(log_ratios), 1, freedom))
    sigma = max(robust_sigma(np.abs(log_ratios - np.median(log_ratios))), least)
    return [
        Trial(name, float(np.exp(value)), unit, max(value / sigma, 0.0) ** 2, 1, freedom, True)
        for name, value in values.items()
    ]


def moved_check(networks: Sequence[Network]) -> Check:
    """Tests whether the target moved relative to the board, one image against all others. The yardstick is the residual
    that the motion leaves in the image and its group: a noisy image seems to move too."""
    trials: list[Trial] = []
    tested_by_group: dict[str, tuple[Network, np.ndarray, list[int]]] = {}
    for network in networks:
        model = network.model
        of_faces = on_face(model)
        if of_faces.all() or not of_faces.any():
            continue
        columns = by_motion(network, model.xyz_model[of_faces].mean(0))
        normal, right = network.score_by_image(columns)
        redundancy = float(network.redundancy.sum())
        square = float((network.residual**2).sum())
        tested = []
        for i, (name, rows) in enumerate(zip(model.images, model.rows_by_image(), strict=True)):
            faces = of_faces[model.point_index[rows]].sum()
            if min(faces, len(rows) - faces) < MIN_CIRCLES:
                continue
            test = solve_score(normal[i], right[i])
            if test.freedom:
                shift_um = 1e3 * float(np.linalg.norm(test.estimate[3:]))
                own = float((network.residual[rows] ** 2).sum()), float(network.redundancy[rows].sum())
                noise = max(
                    (total - test.statistic) / max(freedom - test.freedom, 1.0)
                    for total, freedom in (own, (square, redundancy))
                )
                statistic = test.statistic / max(noise, 1.0)
                trials.append(Trial(name, shift_um, "µm", statistic, test.freedom, redundancy - test.freedom))
                tested.append(i)
        tested_by_group[model.group] = network, columns, tested
    check = assess("moved", trials, "images", "")
    if not check.names or _nearly_all(check):
        return _take_out(check, "")
    guilt = [
        culprits_by_score(network, columns, tested, check.tested, f"group {group}")
        for group, (network, columns, tested) in tested_by_group.items()
        if any(network.model.images[i] in check.names for i in tested)
    ]
    remedy = (
        "in these images the target stood at another place relative to the board than in the others of the group: sort "
        "the images into groups in which nothing moved, or take the group again; leave out a single image"
    )
    causes = "target or board moved between these images, or zoom or focus changed: take the group again"
    return with_culprits(check, guilt, remedy, causes)


def by_motion(network: Network, centre: np.ndarray) -> np.ndarray:
    """Returns the derivatives (n, 2, 6) over σ by a motion of all faces together about a ``centre`` (3,)."""
    model = network.model
    arm = model.xyz_model[model.point_index] - centre
    motion = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
    return network.by_point @ (motion * on_face(model)[model.point_index][:, None, None])


NO_ELLIPSES = (
    "the measured centres do not move as those of ellipses: check radii, polarity and exposure; centroids of grey "
    "values or of contours need another correction"
)


def by_eccentricity(network: Network) -> np.ndarray:
    """Returns the derivatives (n, 2, 1) over σ by a factor on the eccentricity."""
    return network.model.whiten(network.model.shift_px[:, :, None])


def without_image(name: str) -> str:
    """Returns the option that excludes an image from a run."""
    return f"--exclude {shlex.quote(name)}"


def with_culprits(check: Check, guilt: Sequence[Guilt], remedy: str, causes: str) -> Check:
    """Returns the check with the names of the culprits alone, and the ``remedy`` for the first of them; if no culprit
    is known, ``causes`` says what makes such a fault and what to do."""
    names = tuple(name for own in guilt for name in own.culprits)
    names = tuple(sorted(names, key=check.names.index)) if set(names) <= set(check.names) else names
    open_ones = [words for own in guilt if (words := own.words())]
    reason = "; ".join([check.reason, *open_ones])
    advice = [f"{remedy}: {without_image(names[0])}"] if names else []
    return replace(check, reason=reason, names=names, remedy="; ".join(advice + [causes] * bool(open_ones)))


NEARLY_ALL = 0.7
"""Share of the images beyond which a check that names them names none."""


def _nearly_all(check: Check) -> bool:
    return len(check.names) > max(NEARLY_ALL * check.tested, 1)


def _take_out(check: Check, remedy: str) -> Check:
    """Returns the check with the remedy and the option that excludes the worst image, if it names one."""
    if _nearly_all(check):
        common = "nearly all images, so do not leave any out: look for what they have in common, first the camera"
        return replace(check, names=(), remedy=common)
    return replace(check, remedy=f"{remedy}: {without_image(check.names[0])}") if check.names else check


EXCHANGED = 0.1
"""Largest deviation of exchanged labels: each centre lies at the place of the other to within this share of their
distance."""
MANY = 5
"""Number of centres left out of one image at which they are no longer single hidden or dirty circles."""


def labels_check(
    networks: Sequence[Network], outliers: Sequence[Outlier], images: Sequence[ImageObservations], camera: Camera
) -> Check:
    """Tests every observation against all others by its own covariance (Baarda's data snooping), and names those left
    out. Labels at each other's places are a fault: others may be exchanged without being noticed."""
    remedy = (
        "look at them in the overlays: hidden in part, dirty, a reflection, at an edge, or a wrong label; a centre "
        "that was left out does no harm where other images show it"
    )
    trials = []
    for network in networks:
        model, total = network.model, float(network.redundancy.sum())
        square, freedom = network.squares_of_observations()
        for k in np.flatnonzero(freedom):
            name = f"{model.images[model.image_index[k]]} {model.labels[model.point_index[k]]}"
            length = float(np.linalg.norm(network.residual[k]))
            trials.append(Trial(name, length, "σ", float(square[k]), int(freedom[k]), total))
    check = assess("labels", trials, "centres", remedy, "suspicious")
    if not outliers:
        return check
    swapped = _exchanged(networks, outliers, images, camera)
    guilt = _images_of_outliers(networks, outliers)
    lost = tuple(name for own in guilt for name in own.culprits)
    named = tuple(f"{o.image} {o.label}" for o in outliers)
    measured = tuple(
        TestedValue(name, o.residual_px, o.limit_px, "px", None) for name, o in zip(named, outliers, strict=True)
    )
    verdict, reason = "suspicious", f"{len(outliers)} left out, first {named[0]}: {measured[0].words()}"
    if guilt:
        verdict = "failed"
        words = [f"{MANY} or more of image {', '.join(lost)}"] * bool(lost) + [w for own in guilt if (w := own.words())]
        reason = f"{len(outliers)} left out, {'; '.join(words)}"
        remedy = (
            "in these images the target stood at another place relative to the board, or they belong to another group: "
            f"leave them out, the first with {without_image(lost[0])}"
            if lost
            else "target or board moved between the images of a group, or zoom or focus changed: take it again"
        )
    if swapped:
        verdict = "failed"
        reason = f"labels exchanged: {swapped[0]}"
        remedy = "these labels are wrong: check the circles' positions and radii in target.toml, look at the overlay"
    shown, names = (*measured, *check.measured)[:SHOWN], (*swapped, *lost, *named, *check.names)
    return replace(check, verdict=verdict, reason=reason, measured=shown, names=names, remedy=remedy)


def _images_of_outliers(networks: Sequence[Network], outliers: Sequence[Outlier]) -> list[Guilt]:
    """Returns the culprits of each group in which an image lost :data:`MANY` centres or more."""
    count = Counter(o.image for o in outliers)
    found = []
    for network in networks:
        of_group = [name for name in count if name.rpartition("/")[0] == network.model.group]
        names = list(dict.fromkeys([*network.model.images, *of_group]))

        def worst(out: Collection[int], names: list[str] = names) -> int | None:
            many = [i for i, name in enumerate(names) if i not in out and count[name] >= MANY]
            return max(many, key=lambda i: count[names[i]], default=None)

        if worst(()) is not None:
            found.append(culprits(names, worst, f"group {network.model.group}"))
    return found


def _exchanged(
    networks: Sequence[Network], outliers: Sequence[Outlier], images: Sequence[ImageObservations], camera: Camera
) -> tuple[str, ...]:
    """Returns ``image: label and label`` of every pair of outliers that are at each other's places."""
    by_image: dict[str, list[Label]] = {}
    for outlier in outliers:
        by_image.setdefault(outlier.image, []).append(outlier.label)
    observed = {image.name: image for image in images}
    pairs = []
    for network in networks:
        model = network.model
        for name in [name for name in model.images if name in by_image]:
            pose = model.camera_from_model[model.images.index(name)]
            labels = [label for label in by_image[name] if label in model.labels]
            place = {x: camera.project((pose @ model.xyz_model[model.labels.index(x)])[None])[0] for x in labels}
            measured = dict(zip(observed[name].labels, observed[name].centre_px, strict=True))
            for a, b in combinations(labels, 2):
                apart = np.linalg.norm(place[a] - place[b])
                off = max(np.linalg.norm(measured[a] - place[b]), np.linalg.norm(measured[b] - place[a]))
                if off < EXCHANGED * apart:
                    pairs.append(f"{name}: {a} and {b}")
    return tuple(pairs)
