"""Causes of the whole set: further parameters of the free networks (score test). The hypothesis that explains most of
the squared residuals beyond chance with fewest parameters is named first."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtrc

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.arrays import rms
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Rigid, skew
from stcal.labels import CircleLabel
from stcal.sfm.adjust.network import Network, ScoreTest, solve_score
from stcal.sfm.checks.images import summed
from stcal.sfm.checks.verdict import FAILED, MOVED, MOVED_REMEDY, Check, Measured
from stcal.sfm.data.as_drawn import FAR_DEG, turned_faces
from stcal.sfm.report.judgement import CAUSE, OF_WHOLE_SET

EXPLAINS = 0.8
"""Smallest share of what the best hypothesis explains that another one with fewer parameters must explain."""
EXPLAINS_ALL = 0.95
"""That share where chance is small against what is explained: tests of first order leave s² of the square of a change
by a share s, 4 % of one by a fifth."""
MOST_IMAGES = 60
"""Largest number of images of a group in which parameters of single images are fitted; more take minutes."""
FIXED_WITHIN = 0.2
"""Largest deviation from 1 of the share of a change that is as a whole or not at all, such as a distortion removed."""
FILE_WITHIN = 0.02
"""That deviation where the true camera is known: what two good calibrations of a distortion differ by."""
FEW = 0.25
"""Share of the images that may not explain alone what is taken for a cause of the whole set."""
ALONE = 0.93
"""Share of what all images explain at which a few explain it alone; of random changes in all of them they have 0.5 to
0.87."""
LEAST_SHIFT_PX = 3.0
"""Smallest change of the principal point that reveals photographs turned by 180°."""


@dataclass(frozen=True, slots=True)
class _Cause:
    name: str
    remedy: str
    size: Callable[[np.ndarray, np.ndarray], str]  # its size in words, from the estimates (q,) and their σ
    columns: Callable[[Network], np.ndarray]  # (n, 2, q) derivatives of the projections over σ
    scope: str = "all"
    # the first parameter is 1 where the hypothesis is true, or 0 or 1 in each image, and so not free
    whole: bool = False
    # (p, q) derivatives of the camera's parameters; None: no matter of the camera file
    direction: np.ndarray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    cause: _Cause
    test: ScoreTest
    explained: float
    probability: float
    left: float


def whole_set_cause(
    networks: Sequence[Network], camera: Camera, moved: bool = False, from_file: bool = True, most_left: float = 1.0
) -> Check | None:
    """Returns a failed check that names the cause of the whole set; None if none explains most of the residuals. What
    is beyond chance is what the most flexible hypothesis explains."""
    possible = [cause for cause in _hypotheses(camera) if from_file or cause.direction is None]
    fitted = [f for cause in possible if (f := _fit(cause, networks)) is not None]
    if not fitted:
        return None
    richest = max(fitted, key=lambda f: f.explained)
    most = richest.explained
    by_chance = 2 * richest.left * np.sqrt(2 * richest.test.freedom)  # two σ of what its parameters fit by chance
    enough = max(EXPLAINS * most, EXPLAINS_ALL * most - by_chance)
    named = [
        f
        for f in fitted
        if (moved or f.cause.columns is not _by_motion)
        and f.probability * len(fitted) < FAILED
        and f.explained >= enough
        and _applies(f, networks)
    ]
    if not named:
        return None
    best = min(named, key=lambda f: (f.cause.columns is _by_motion, f.test.freedom - f.cause.whole, -f.explained))
    if best.cause.scope == "image" and _explained_by_one(networks, best.left) > EXPLAINS * most:
        return None  # its checks name that image
    size = best.cause.size(best.test.estimate, np.sqrt(np.maximum(np.diag(best.test.covariance), 0)))
    square = sum(float((n.residual**2).sum()) for n in networks)
    after = float(np.sqrt(best.left * _redundancy(networks) / square))
    if after > most_left:
        return None
    reason = (
        f"{size}: {best.test.freedom} parameter{'s' * (best.test.freedom > 1)} explain"
        f"{'s' * (best.test.freedom == 1)} {100 * best.explained / most:.0f} % of what any cause explains; residuals "
        f"would be {after:.2f} times as large"
    )
    measured = tuple(
        Measured(f.cause.name, 100 * f.explained / most, None, "% explained", f.probability)
        for f in sorted(fitted, key=lambda f: (f is not best, f.test.freedom))
    )
    return Check(
        CAUSE, f"{OF_WHOLE_SET}{best.cause.name}", "failed", reason, measured, len(fitted), (), best.cause.remedy
    )


def cause_of_file(camera: Camera, found: Camera, covariance: np.ndarray, colmap_model: str) -> Check | None:
    """Returns a failed check that names what of a camera file is wrong against the true camera, or None."""
    to_model = np.linalg.pinv(intrinsic_basis(colmap_model))
    weight = np.linalg.inv(covariance)
    off = to_model @ (found.parameters() - camera.parameters())
    square = float(off @ weight @ off)
    fitted = []
    for cause in _hypotheses(camera):
        if cause.direction is None:
            continue
        along = to_model @ cause.direction
        test = solve_score(along.T @ weight @ along, along.T @ weight @ off)
        if cause.whole and abs(test.estimate[0] - 1) > FILE_WITHIN + 3 * np.sqrt(test.covariance[0, 0]):
            continue
        if test.statistic > EXPLAINS_ALL * square:
            fitted.append((test.freedom - cause.whole, -test.statistic, cause, test))
    if not fitted:
        return None
    _, explained, cause, test = min(fitted, key=lambda f: f[:2])
    size = cause.size(test.estimate, np.sqrt(np.maximum(np.diag(test.covariance), 0)))
    share = Measured(cause.name, -100 * explained / square, None, "% explained", None)
    return Check(CAUSE, f"{OF_WHOLE_SET}{cause.name}", "failed", size, (share,), len(fitted), (), cause.remedy)


def cause_of_drawing(target_from_face: Mapping[str, Rigid], design: TargetDesign) -> Check | None:
    """Returns a failed check that names faces on another side of the body than their rough poses, which reflections and
    other patterns look like; None if none is. Notes say what is turned by less."""
    rough = {face: pose for face, pose in design.rough_poses().items() if face in target_from_face}
    turned = turned_faces({face: target_from_face[face] for face in rough}, rough) if len(rough) > 1 else {}
    far = tuple(face for face, angle in turned.items() if angle > FAR_DEG)
    if not far:
        return None
    name = f"face {', '.join(far)} is not where its rough_pose has it"
    reason = f"turned by {turned[far[0]]:.0f}°, {FAR_DEG:.0f}° possible: a reflection, another pattern, or another name"
    remedy = "look at the overlays; leave out images that show a reflection, or correct names, ids or rough_pose"
    return Check(CAUSE, f"{OF_WHOLE_SET}{name}", "failed", reason, (), len(rough), far, remedy)


OTHER_SIZE = 0.02
"""Relative difference of the faces' size from their drawing that no print has; less is for the check of the scale."""


def cause_of_size(
    circles: Mapping[CircleLabel, np.ndarray], design: TargetDesign, board: BoardDesign | None
) -> Check | None:
    """Returns a failed check that names another size of the board than the drawing of the faces has; None if it fits.
    ``circles`` : (3,) places found, mm."""
    ratios = []
    for face in design.faces if board is not None and board.rows else ():
        labels = [label for label in circles if label.face == face.id]
        if len(labels) < 3:
            continue
        found, drawn = np.array([circles[label] for label in labels]), face.places_mm(each.circle for each in labels)
        ratios.append(rms(found - found.mean(0)) / rms(drawn - drawn.mean(0)))
    ratio = float(np.median(ratios)) if ratios else 1.0
    if board is None or abs(ratio - 1) < OTHER_SIZE:
        return None
    name = f"the board in board.toml is {ratio:.4g} times as large as the drawing in target.toml has the faces"
    reason = f"{len(ratios)} faces agree; they would fit a pitch of {board.pitch_mm / ratio:.4g} mm"
    remedy = "measure the board over its full length with a calliper; correct pitch_mm, or the target's drawing"
    return Check(CAUSE, f"{OF_WHOLE_SET}{name}", "failed", reason, (), len(ratios), (), remedy)


MOST_SHARE = 1 / 3
"""Largest share of the redundancy that a hypothesis may take as parameters: more would explain errors of any kind."""


def _redundancy(networks: Sequence[Network]) -> float:
    return float(sum(n.redundancy.sum() for n in networks))


def _fit(cause: _Cause, networks: Sequence[Network]) -> _Fitted | None:
    """Returns the hypothesis fitted to all networks; None if it cannot be."""
    if cause.scope == "all":
        test = solve_score(*summed(networks, cause.columns))
    else:
        if cause.scope == "image" and max(len(n.model.images) for n in networks) > MOST_IMAGES:
            return None
        tests = [solve_score(*n.score(_apart(cause, n))) for n in networks]
        test = _together(tests)
    redundancy = _redundancy(networks)
    square = sum(float((n.residual**2).sum()) for n in networks)
    rest = redundancy - test.freedom
    left = (square - test.statistic) / rest if rest > 0 else 0.0
    if not test.freedom or left <= 0 or test.freedom > MOST_SHARE * redundancy:
        return None
    probability = float(fdtrc(test.freedom, rest, test.statistic / test.freedom / left))
    return _Fitted(cause, test, test.statistic - test.freedom * left, probability, left)


def _apart(cause: _Cause, network: Network) -> np.ndarray:
    """Returns the columns with separate parameters for each image, or for the group."""
    columns = cause.columns(network)
    if cause.scope == "group":
        return columns
    n, _, q = columns.shape
    images = len(network.model.images)
    apart = np.zeros((n, 2, images, q))
    apart[np.arange(n), :, network.model.image_index] = columns
    return apart.reshape(n, 2, images * q)


def _together(tests: Sequence[ScoreTest]) -> ScoreTest:
    sizes = [len(t.estimate) for t in tests]
    covariance = np.zeros((sum(sizes), sum(sizes)))
    for end, size, test in zip(np.cumsum(sizes), sizes, tests, strict=True):
        covariance[end - size : end, end - size : end] = test.covariance
    return ScoreTest(
        np.concatenate([t.estimate for t in tests]),
        covariance,
        sum(t.statistic for t in tests),
        sum(t.freedom for t in tests),
    )


def _applies(fitted: _Fitted, networks: Sequence[Network]) -> bool:
    """Whether the estimates are those of a cause of the whole set: a change as a whole is 1, or in each image 1 or 0,
    groups differ, and a few images do not explain it alone."""
    estimate = fitted.test.estimate
    if fitted.cause.whole and fitted.cause.scope == "all":
        return bool(abs(estimate[0] - 1) < FIXED_WITHIN)
    if fitted.cause.whole:
        sigma = np.sqrt(fitted.left * np.diag(fitted.test.covariance))
        if (np.abs(estimate - (estimate > 0.5)) > FIXED_WITHIN + 3 * sigma).any():
            return False
    if fitted.cause.scope == "group":
        away = (estimate - np.median(estimate)) ** 2 / np.maximum(np.diag(fitted.test.covariance), 1e-300)
        return len(networks) > 1 and bool((away > fitted.left * chdtri(1, FAILED)).any())
    if fitted.cause.scope == "image" and fitted.cause.columns is not _by_motion:
        few = _explained_by_few(fitted, networks)
        return few < ALONE * fitted.test.statistic
    return True


def _explained_by_few(fitted: _Fitted, networks: Sequence[Network]) -> float:
    """Returns how much the parameters of a quarter of the images explain, of the images that explain most."""
    equations = [network.score(_apart(fitted.cause, network)) for network in networks]
    gains = []
    for i, (network, (normal, right)) in enumerate(zip(networks, equations, strict=True)):
        q = len(right) // len(network.model.images)
        for k in range(len(network.model.images)):
            own = slice(q * k, q * k + q)
            gains.append((solve_score(normal[own, own], right[own]).statistic, i, np.arange(q * k, q * k + q)))
    gains.sort(key=lambda gain: -gain[0])
    few = gains[: max(round(FEW * len(gains)), 1)]
    explained = 0.0
    for i, (normal, right) in enumerate(equations):
        if columns := [own for _, j, own in few if j == i]:
            own = np.concatenate(columns)
            explained += solve_score(normal[np.ix_(own, own)], right[own]).statistic
    return explained


def _explained_by_one(networks: Sequence[Network], left: float) -> float:
    """Returns how much leaving out one image explains, at most; ``left``: unexplained square per degree of freedom."""
    most = 0.0
    for network in networks:
        for image in range(len(network.model.images)):
            test = solve_score(*network.score_of_image(image))
            most = max(most, test.statistic - test.freedom * left)
    return most


Size = Callable[[np.ndarray, np.ndarray], str]
"""Words on the size of a cause, from its parameters (q,) and their σ."""


def _percent(what: str) -> Size:
    return lambda value, sigma: f"{what} {100 * value[0]:+.3g} ± {100 * sigma[0]:.2g} % against the file"


def _spread(what: str) -> Size:
    return lambda value, _: f"{what} up to {100 * np.ptp(value):.3g} % apart"


def _listed(names: Sequence[str]) -> Size:
    return lambda value, _: ", ".join(f"{name} {v:+.2g}" for name, v in zip(names, value, strict=True))


ANEW = "calibrate the camera again with this lens, zoom and focus, or run with --refine-camera"


def _hypotheses(camera: Camera) -> list[_Cause]:
    """Returns the causes that a set of photographs may have as a whole."""
    fx, fy = camera.focal
    cx, cy = camera.centre
    unit = np.eye(len(camera.parameters()))
    focal = fx * unit[:, [0]] + fy * unit[:, [1]]
    scaled = focal + (cx + 0.5) * unit[:, [2]] + (cy + 0.5) * unit[:, [3]]
    removed = -camera.parameters()[:, None] * (np.arange(len(unit)) > 3)[:, None]

    def by(direction: np.ndarray) -> Callable[[Network], np.ndarray]:
        return lambda network: network.model.whiten(network.model.by_parameters(camera) @ direction)

    def of_file(name: str, remedy: str, size: Size, direction: np.ndarray, whole: bool = False) -> _Cause:
        return _Cause(name, remedy, size, by(direction), whole=whole, direction=direction)

    causes = [
        of_file("the focal length is not that of the camera file", "zoom or focus is not as at the calibration, or the "
               f"file belongs to another lens: {ANEW}", _percent("focal length"), focal),
        of_file("the photographs are scaled relative to the camera file", "use the photographs at the size of the "
               "calibration, or scale focal length and principal point in the camera file by the same factor",
               _percent("size"), scaled),
        of_file("width and height are scaled differently", "the photographs were resized without keeping their "
               "proportions, or fx and fy of the camera file are wrong: use the original photographs",
               _percent("fx over fy"), fx * unit[:, [0]]),
        of_file("the principal point is not that of the camera file", "the photographs are cropped, or from another "
               f"sensor: use them uncropped, or correct cx and cy in the camera file; or {ANEW}",
               _listed(("cx", "cy")), unit[:, 2:4]),
        of_file("the distortion is not that of the camera file", f"another lens or focus, or its signs or order are "
               f"wrong in the file: {ANEW}", _listed(("k1", "k2", "p1", "p2")), unit[:, 4:8]),
        of_file("the intrinsics are not those of the camera file", f"the camera file belongs to another camera: {ANEW}",
               _listed(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")), unit[:, :8]),
        _Cause("zoom or focus changed between the groups", "the focal length differs from group to group: fix zoom and "
               "focus, and take the photographs again; or run each group with a camera file of its own",
               _spread("focal lengths"), by(focal), "group"),
        _Cause("zoom or focus changed from image to image", "the focal length differs from image to image: turn "
               "autofocus and stabiliser off, and take the photographs again", _spread("focal lengths"), by(focal),
               "image"),
        _Cause("the camera moved while its rows were read (rolling shutter)", "use a camera with a global shutter, or "
               "stand still for each photograph", lambda value, _: "in most images", _by_row, "image"),
        _Cause("the centres are not those of ellipses (eccentricity)", "the measured centres do not move as those of "
               "ellipses: check radii, polarity and exposure; centroids of grey values or of contours need another "
               "correction", lambda value, sigma: f"{1 + value[0]:.3f} ± {sigma[0]:.2g} of the eccentricity found",
               lambda network: network.model.whiten(network.model.shift_px[:, :, None])),
        _Cause(MOVED, MOVED_REMEDY, lambda value, _: "in more than one image", _by_motion, "image"),
    ]  # fmt: skip
    if np.abs(removed).max() > 0:
        causes.append(
            of_file("the photographs are already undistorted", "the camera file has a distortion that they no longer "
                   "have: use the original photographs, or set the distortion in the camera file to 0",
                   lambda value, sigma: f"{100 * value[0]:.0f} ± {100 * sigma[0]:.2g} % of the file's distortion is "
                   "not in them", removed, whole=True)
        )  # fmt: skip
        causes.append(
            of_file("the photographs are already undistorted, with another camera matrix", "give the original "
                   "photographs, or a camera file with the matrix that they were undistorted to, and a distortion of 0",
                   lambda value, sigma: f"{100 * value[0]:.0f} ± {100 * sigma[0]:.2g} % of the file's distortion is "
                   f"not in them, {_listed(('fx', 'fy', 'cx', 'cy'))(value[1:], sigma[1:])}",
                   np.hstack([removed, unit[:, :4]]), whole=True)
        )  # fmt: skip
        causes.append(
            of_file("the distortion of the camera file has its sign reversed", "the program that wrote it undistorts "
                   "where this one distorts: change the signs of all coefficients in the camera file",
                   lambda value, sigma: f"{100 * value[0]:.0f} ± {100 * sigma[0]:.2g} % of the way",
                   2 * removed, whole=True)
        )  # fmt: skip
    for quarters in (1, 2, 3) if camera.width == camera.height else (2,):
        turned = _turned(camera, quarters)[:, None] - camera.parameters()[:, None]
        if np.abs(turned[2:4]).max() > LEAST_SHIFT_PX:
            causes.append(
                of_file(f"the photographs are turned by {90 * quarters}° relative to the camera file", "use "
                       "them as the sensor recorded them, without the rotation that a viewer or converter applied",
                       lambda value, _: f"principal point {100 * value[0]:.0f} % of the way", turned, whole=True)
            )  # fmt: skip
            causes.append(
                _Cause(f"some photographs are turned by {90 * quarters}° relative to the others", "use them as the "
                       "sensor recorded them, without the rotation that a viewer or converter applied",
                       lambda value, _: f"{(value > 0.5).sum()} of {len(value)} are turned", by(turned), "image",
                       whole=True)
            )  # fmt: skip
    return causes


def _turned(camera: Camera, quarters: int) -> np.ndarray:
    """Returns the parameters of a camera whose photographs are turned counterclockwise by quarter turns."""
    parameters, size = camera.parameters().copy(), (camera.width, camera.height)
    for _ in range(quarters):
        (fx, fy, cx, cy), (p1, p2), (s1, s2, s3, s4) = parameters[:4], parameters[6:8], parameters[12:16]
        parameters[:4], parameters[6:8] = (fy, fx, cy, size[0] - 1 - cx), (-p2, p1)
        parameters[12:16] = s3, s4, -s1, -s2
        size = size[::-1]
    return parameters


def _by_row(network: Network) -> np.ndarray:
    """Returns the columns of a motion that grows from the first to the last row of an image."""
    row = network.model.measured_px[:, 1]
    return network.by_pose * ((row - row.mean()) / max(float(np.ptp(row)), 1.0))[:, None, None]


def _by_motion(network: Network) -> np.ndarray:
    """Returns the columns of a motion of all faces against the board."""
    model = network.model
    on_face = np.array([isinstance(label, CircleLabel) for label in model.labels])
    arm = model.xyz_model[model.point_index] - model.xyz_model.mean(0)
    motion = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
    return network.by_point @ (motion * on_face[model.point_index][:, None, None])
