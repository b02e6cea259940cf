"""All checks of a run, each for an error that small residuals may hide, and the cause of the whole set that is named
before them: of a table of further parameters of the free networks (score tests), the fewest that explain most of the
squared residuals beyond chance."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri, fdtrc

from stcal.design import BoardDesign, TargetDesign
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import rms
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel
from stcal.parallel import Progress, counted
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.adjust.refine import Network, ScoreTest, solve_score
from stcal.sfm.checks import board_checks, face_checks, image_checks, significance
from stcal.sfm.checks.significance import MOVED, MOVED_REMEDY, NO_ELLIPSES, Evidence
from stcal.sfm.data.group_model import FAR_DEG, turned_faces
from stcal.sfm.report.check import CAUSE, FAILED, OF_WHOLE_SET, SUSPICIOUS, Check, TestedValue, impossible

Maker = Callable[[Evidence], Check | Iterable[Check]]
BESIDE_A_GROUP = 0.9
"""Largest factor on the residuals that a cause of the whole set may leave to be named in place of a group without which
all is well."""


def of_joint(key: str, make: Callable[[Evidence, JointResult], Check]) -> Maker:
    """Returns a check that needs the joint result and its covariances."""

    def check(evidence: Evidence) -> Check:
        if not evidence.calibration.target.target_from_face:
            return impossible(key, "the board alone, no face", "")
        if evidence.joint is None:
            return impossible(key, "needs the covariances of the joint adjustment", "run with --solve joint")
        return make(evidence, evidence.joint)

    return check


MAKERS: tuple[Maker, ...] = (
    image_checks.camera_check,
    image_checks.field_check,
    image_checks.sigma_check,
    of_joint("agreement", face_checks.agreement_check),
    of_joint("halves", face_checks.halves_check),
    of_joint("groups", face_checks.groups_check),
    of_joint("loops", face_checks.loops_check),
    image_checks.moved_check,
    image_checks.image_check,
    image_checks.sharpness_check,
    image_checks.evenness_check,
    image_checks.labels_check,
    board_checks.board_checks,
    board_checks.pitch_check,
    board_checks.radius_checks,
    board_checks.rim_of_run,
    face_checks.flatness_check,
    image_checks.control_check,
    board_checks.scales_check,
)
"""Makers of the checks in the order of the report."""


def run_checks(evidence: Evidence, progress: Progress | None = None) -> tuple[Check, ...]:
    """Returns all checks in the order of the report, the cause of the whole set before them if one failed."""
    step = counted(progress or (lambda *_: None), "check", len(MAKERS))
    checks: list[Check] = []
    for make in MAKERS:
        made = make(evidence)
        checks += [made] if isinstance(made, Check) else made
        step(None)
    failed = {check.key: check.names for check in checks if check.verdict == "failed"}
    cause, is_doubtful = evidence.cause, any(check.verdict in ("failed", "suspicious") for check in checks)
    # That all intrinsics differ explains a board in nearly any photographs: what all circles tell goes before it.
    if is_doubtful and (cause is None or cause.cause == ANOTHER_CAMERA):
        moved, camera = failed.get("moved") == (), evidence.calibration.camera
        # A group without which all is well is the cause, unless another one explains far more of the residuals.
        most_left = BESIDE_A_GROUP if len(failed.get("groups", ())) == 1 else 1.0
        if of_set := whole_set_cause(evidence.networks, camera, moved, evidence.camera_given, most_left):
            cause = replace(of_set, verdict="failed" if failed else "suspicious")
    return (cause, *checks) if cause else tuple(checks)


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
FEW = 0.25  # share of the images that may not explain alone what is taken for a cause of the whole set
ALONE = 0.93
"""Share of what all images explain at which a few explain it alone; of random changes in all of them they have 0.5 to
0.87."""
LEAST_SHIFT_PX = 3.0  # smallest change of the principal point that reveals photographs turned by 180°


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A row of the table of causes.

    ``size`` : words from the estimates (q,) and their σ; ``by`` : direction (p, q) of the camera's parameters, or the
    derivatives (n, 2, q) of the projections over σ; ``scope`` : whose parameters they are; ``whole`` : whether the
    first one is 1 where the hypothesis is true (0 or 1 in each image), and so not free.
    """

    name: str
    remedy: str
    size: Callable[[np.ndarray, np.ndarray], str]
    by: np.ndarray | Callable[[Network], np.ndarray]
    scope: Literal["all", "group", "image"] = "all"
    whole: bool = False

    def equations(self, network: Network, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Returns the score equations of the parameters of a group, or of separate ones for each image."""
        by, model = self.by, network.model
        columns = by(network) if callable(by) else model.whiten(model.by_parameters(camera) @ by)
        return network.score(significance.apart(network, columns) if self.scope == "image" else columns)


@dataclass(frozen=True, slots=True, eq=False)
class FittedCause:
    """A hypothesis with its parameters; ``left`` : squared residuals per degree of freedom that it leaves;
    ``probability`` : of what it explains by chance."""

    cause: Hypothesis
    test: ScoreTest
    left: float
    probability: float = 0.0


def _named(
    fitted: Sequence[FittedCause], misfit: Callable[[FittedCause], float], most: float, alike: float = 1.0
) -> tuple[list[FittedCause], Check | None]:
    """Returns the hypotheses with the fewest free parameters that explain the data, motions last; and their check."""
    candidates = (
        Candidate(f.cause.name, lambda f=f: f, (f.cause.by is _by_motion, f.test.freedom - f.cause.whole))
        for f in fitted
    )
    best = [candidate.change() for candidate, _ in explain(candidates, misfit, most, alike)]
    if not best:
        return [], None
    sizes = [f.cause.size(f.test.estimate, np.sqrt(np.maximum(np.diag(f.test.covariance), 0))) for f in best]
    name, remedy = ("; or ".join(dict.fromkeys(getattr(f.cause, key) for f in best)) for key in ("name", "remedy"))
    return best, failed_cause(name, "; or ".join(sizes), remedy, len(fitted))


def failed_cause(name: str, reason: str, remedy: str, tested: int, names: tuple[str, ...] = ()) -> Check:
    """Returns the failed check that names the cause of the whole set."""
    return Check(CAUSE, f"{OF_WHOLE_SET}{name}", "failed", reason, (), tested, names, remedy)


def whole_set_cause(
    networks: Sequence[Network], camera: Camera, moved: bool = False, from_file: bool = True, most_left: float = 1.0
) -> Check | None:
    """Returns a failed check that names the cause of the whole set; None if none explains most of the residuals. What
    is beyond chance is what the most flexible hypothesis explains."""
    possible = [cause for cause in _hypotheses(camera) if from_file or cause.scope != "all" or callable(cause.by)]
    fitted = [f for cause in possible if (f := _fit(cause, networks, camera)) is not None]
    if not fitted:
        return None
    square, redundancy = _square(networks), _redundancy(networks)
    richest = min(fitted, key=lambda f: f.left)
    most = square - redundancy * richest.left
    by_chance = 2 * richest.left * np.sqrt(2 * richest.test.freedom)  # two σ of what its parameters fit by chance
    enough = max(EXPLAINS * most, EXPLAINS_ALL * most - by_chance)

    def misfit(own: FittedCause) -> float:
        is_possible = moved or own.cause.by is not _by_motion
        is_certain = own.probability * len(fitted) < FAILED
        return own.left if is_possible and is_certain and _applies(own, networks, camera) else np.inf

    alike = 1 + float(chdtri(1, SUSPICIOUS)) / redundancy
    best, check = _named(fitted, misfit, (square - enough) / redundancy, alike)
    if check is None:
        return None
    first = best[0]
    if first.cause.scope == "image" and _explained_by_one(networks, first.left) > EXPLAINS * most:
        return None  # its checks name that image
    after, freedom = float(np.sqrt(first.left * redundancy / square)), first.test.freedom
    if after > most_left:
        return None
    measured = tuple(
        TestedValue(f.cause.name, 100 * (square - redundancy * f.left) / most, None, "% explained", f.probability)
        for f in sorted(fitted, key=lambda f: (f is not first, f.test.freedom))
    )
    parameters = "1 parameter explains" if freedom == 1 else f"{freedom} parameters explain"
    explained = f"{parameters} {measured[0].value:.0f} % of what any cause explains"
    reason = f"{check.reason}: {explained}; residuals would be {after:.2f} times as large"
    return replace(check, reason=reason, measured=measured)


def cause_of_file(camera: Camera, found: Camera, covariance: np.ndarray, colmap_model: str) -> Check | None:
    """Returns a failed check that names what of a camera file is wrong against the true camera, or None."""
    to_model = np.linalg.pinv(intrinsic_basis(colmap_model))
    weight = np.linalg.inv(covariance)
    off = to_model @ (found.parameters() - camera.parameters())
    square = float(off @ weight @ off)
    fitted = []
    for cause in _hypotheses(camera):
        if cause.scope == "all" and not callable(cause.by):  # what says that the file is wrong
            along = to_model @ cause.by
            test = solve_score(along.T @ weight @ along, along.T @ weight @ off)
            fitted.append(FittedCause(cause, test, square - test.statistic))

    def misfit(own: FittedCause) -> float:
        within = FILE_WITHIN + 3 * np.sqrt(own.test.covariance[0, 0])
        return np.inf if own.cause.whole and abs(own.test.estimate[0] - 1) > within else own.left

    best, check = _named(fitted, misfit, (1 - EXPLAINS_ALL) * square)
    if check is None:
        return None
    share = TestedValue(best[0].cause.name, 100 * best[0].test.statistic / square, None, "% explained", None)
    return replace(check, measured=(share,))


def cause_of_drawing(target_from_face: Mapping[str, Rigid], design: TargetDesign) -> Check | None:
    """Returns a failed check that names faces on another side of the body than their rough poses, which reflections and
    other patterns look like; None if none is. Notes say what is turned by less."""
    rough = {face: pose for face, pose in design.rough_poses().items() if face in target_from_face}
    turned = turned_faces({face: target_from_face[face] for face in rough}, rough) if len(rough) > 1 else {}
    far = tuple(face for face, angle in turned.items() if angle > FAR_DEG)
    if not far:
        return None
    name = f"face {', '.join(far)} is not where its rough_pose has it"
    why = f"turned by {turned[far[0]]:.0f}°, {FAR_DEG:.0f}° possible: a reflection, another pattern, or another name"
    remedy = "look at the overlays; leave out images that show a reflection, or correct names, ids or rough_pose"
    return failed_cause(name, why, remedy, len(rough), far)


OTHER_SIZE = 0.02
"""Relative difference of the faces' size from their drawing that no print has; less is for the check of the scale."""


def cause_of_size(
    circles: Mapping[CircleLabel, np.ndarray], design: TargetDesign, board: BoardDesign | None
) -> Check | None:
    """Returns a failed check that names another size of the board than the faces' drawing has, if it does not fit."""
    if board is None or not board.rows:
        return None
    ratios = []
    for face in design.faces:
        labels = [label for label in circles if label.face == face.id]
        if len(labels) >= 3:
            found, drawn = np.array([circles[own] for own in labels]), face.places_mm(own.circle for own in labels)
            ratios.append(rms(found - found.mean(0)) / rms(drawn - drawn.mean(0)))
    ratio = float(np.median(ratios)) if ratios else 1.0
    if abs(ratio - 1) < OTHER_SIZE:
        return None
    name = f"the board in board.toml is {ratio:.4g} times as large as the drawing in target.toml has the faces"
    why = f"{len(ratios)} faces agree; they would fit a pitch of {board.pitch_mm / ratio:.4g} mm"
    remedy = "measure the board over its full length with a calliper; correct pitch_mm, or the target's drawing"
    return failed_cause(name, why, remedy, len(ratios))


MOST_SHARE = 1 / 3
"""Largest share of the redundancy that a hypothesis may take as parameters: more would explain errors of any kind."""


def _redundancy(networks: Sequence[Network]) -> float:
    return float(sum(n.redundancy.sum() for n in networks))


def _square(networks: Sequence[Network]) -> float:
    return sum(float((n.residual**2).sum()) for n in networks)


def _fit(cause: Hypothesis, networks: Sequence[Network], camera: Camera) -> FittedCause | None:
    """Returns the hypothesis fitted to all networks; None if it cannot be."""
    if cause.scope == "image" and max(len(n.model.images) for n in networks) > MOST_IMAGES:
        return None
    equations = [cause.equations(network, camera) for network in networks]
    if cause.scope == "all":
        test = solve_score(*image_checks.summed(equations))
    else:
        tests = [solve_score(*own) for own in equations]
        statistic, freedom = sum(t.statistic for t in tests), sum(t.freedom for t in tests)
        covariance = np.asarray(block_diag(*(t.covariance for t in tests)))
        test = ScoreTest(np.concatenate([t.estimate for t in tests]), covariance, statistic, freedom)
    redundancy = _redundancy(networks)
    rest = redundancy - test.freedom
    left = (_square(networks) - test.statistic) / rest if rest > 0 else 0.0
    if not test.freedom or left <= 0 or test.freedom > MOST_SHARE * redundancy:
        return None
    return FittedCause(cause, test, left, float(fdtrc(test.freedom, rest, test.statistic / test.freedom / left)))


def _applies(fitted: FittedCause, networks: Sequence[Network], camera: Camera) -> bool:
    """Whether estimates are of a cause of the whole set: 1 as a whole, 1 or 0 by image, and not of few images alone."""
    cause, estimate, variance = fitted.cause, fitted.test.estimate, np.diag(fitted.test.covariance)
    if cause.whole and cause.scope == "all":
        return bool(abs(estimate[0] - 1) < FIXED_WITHIN)
    if cause.whole and (np.abs(estimate - (estimate > 0.5)) > FIXED_WITHIN + 3 * np.sqrt(fitted.left * variance)).any():
        return False
    if cause.scope == "group":
        away = (estimate - np.median(estimate)) ** 2 / np.maximum(variance, 1e-300)
        return len(networks) > 1 and bool((away > fitted.left * chdtri(1, FAILED)).any())
    if cause.scope == "image" and cause.by is not _by_motion:
        return _explained_by_few(cause, networks, camera) < ALONE * fitted.test.statistic
    return True


def _explained_by_few(cause: Hypothesis, networks: Sequence[Network], camera: Camera) -> float:
    """Returns how much the parameters of a quarter of the images explain, of the images that explain most."""
    equations = [cause.equations(network, camera) for network in networks]
    q = len(equations[0][1]) // len(networks[0].model.images)

    def explained(group: int, images: Sequence[int]) -> float:
        normal, right = equations[group]
        own = (q * np.array(images)[:, None] + np.arange(q)).ravel()
        return solve_score(normal[np.ix_(own, own)], right[own]).statistic

    images = [(i, k) for i, network in enumerate(networks) for k in range(len(network.model.images))]
    images.sort(key=lambda image: -explained(image[0], [image[1]]))
    few = sorted(images[: max(round(FEW * len(images)), 1)])
    return sum(explained(i, [k for _, k in own]) for i, own in groupby(few, lambda image: image[0]))


def _explained_by_one(networks: Sequence[Network], left: float) -> float:
    """Returns how much leaving out one image explains, at most; ``left``: unexplained square per degree of freedom."""
    each = (n.score_of_image(image) for n in networks for image in range(len(n.model.images)))
    tests = [solve_score(*equations) for equations in each]
    return max([0.0, *(test.statistic - test.freedom * left for test in tests)])


Size = Callable[[np.ndarray, np.ndarray], str]  # words on the size of a cause, from its parameters (q,) and their σ


def _percent(what: str) -> Size:
    return lambda value, sigma: f"{what} {100 * value[0]:+.3g} ± {100 * sigma[0]:.2g} % against the file"


def _spread(value: np.ndarray, _: np.ndarray) -> str:
    return f"focal lengths up to {100 * np.ptp(value):.3g} % apart"


def _listed(names: Sequence[str]) -> Size:
    return lambda value, _: ", ".join(f"{name} {v:+.2g}" for name, v in zip(names, value, strict=True))


def _of_distortion(more: Size = lambda *_: "") -> Size:
    return lambda value, sigma: (
        f"{100 * value[0]:.0f} ± {100 * sigma[0]:.2g} % of the file's distortion is not in them{more(value, sigma)}"
    )


ANEW = "calibrate the camera again with this lens, zoom and focus, or run with --refine-camera"
AS_RECORDED = "use them as the sensor recorded them, without the rotation that a viewer or converter applied"
ANOTHER_CAMERA = "the intrinsics are not those of the camera file"
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def _hypotheses(camera: Camera) -> list[Hypothesis]:
    """Returns the causes that a set of photographs may have as a whole."""
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    unit = np.eye(len(camera.parameters()))
    focal = fx * unit[:, [0]] + fy * unit[:, [1]]
    scaled = focal + (cx + 0.5) * unit[:, [2]] + (cy + 0.5) * unit[:, [3]]
    removed = -camera.parameters()[:, None] * (np.arange(len(unit)) > 3)[:, None]
    causes = [
        Hypothesis("the focal length is not that of the camera file", "zoom or focus is not as at the calibration, or "
                   f"the file belongs to another lens: {ANEW}", _percent("focal length"), focal),
        Hypothesis("the photographs are scaled relative to the camera file", "use the photographs at the size of the "
                   "calibration, or scale focal length and principal point in the camera file by the same factor",
                   _percent("size"), scaled),
        Hypothesis("width and height are scaled differently", "the photographs were resized without keeping their "
                   "proportions, or fx and fy of the camera file are wrong: use the original photographs",
                   _percent("fx over fy"), fx * unit[:, [0]]),
        Hypothesis("the principal point is not that of the camera file", "the photographs are cropped, or from another "
                   f"sensor: use them uncropped, or correct cx and cy in the camera file; or {ANEW}",
                   _listed(INTRINSICS[2:4]), unit[:, 2:4]),
        Hypothesis("the distortion is not that of the camera file", "another lens or focus, or its signs or order are "
                   f"wrong in the file: {ANEW}", _listed(INTRINSICS[4:]), unit[:, 4:8]),
        Hypothesis(ANOTHER_CAMERA, f"the camera file belongs to another camera: {ANEW}", _listed(INTRINSICS),
                   unit[:, :8]),
        Hypothesis("zoom or focus changed between the groups", "the focal length differs from group to group: fix zoom "
                   "and focus, and take the photographs again; or run each group with a camera file of its own",
                   _spread, focal, "group"),
        Hypothesis("zoom or focus changed from image to image", "the focal length differs from image to image: turn "
                   "autofocus and stabiliser off, and take the photographs again", _spread, focal, "image"),
        Hypothesis("the camera moved while its rows were read (rolling shutter)", "use a camera with a global shutter, "
                   "or stand still for each photograph", lambda value, _: "in most images", _by_row, "image"),
        Hypothesis("the centres are not those of ellipses (eccentricity)", NO_ELLIPSES, lambda value, sigma:
                   f"{1 + value[0]:.3f} ± {sigma[0]:.2g} of the eccentricity found", significance.by_eccentricity),
        Hypothesis(MOVED, MOVED_REMEDY, lambda value, _: "in more than one image", _by_motion, "image"),
    ]  # fmt: skip
    if np.abs(removed).max() > 0:
        causes += [
            Hypothesis("the photographs are already undistorted", "the camera file has a distortion that they no "
                       "longer have: use the original photographs, or set the distortion in the camera file to 0",
                       _of_distortion(), removed, whole=True),
            Hypothesis("the photographs are already undistorted, with another camera matrix", "give the original "
                       "photographs, or a camera file with the matrix that they were undistorted to, and a distortion "
                       "of 0", _of_distortion(lambda v, s: f", {_listed(INTRINSICS[:4])(v[1:], s[1:])}"),
                       np.hstack([removed, unit[:, :4]]), whole=True),
            Hypothesis("the distortion of the camera file has its sign reversed", "the program that wrote it "
                       "undistorts where this one distorts: change the signs of all coefficients in the camera file",
                       lambda value, sigma: f"{100 * value[0]:.0f} ± {100 * sigma[0]:.2g} % of the way", 2 * removed,
                       whole=True),
        ]  # fmt: skip
    for quarters in (1, 2, 3) if camera.width == camera.height else (2,):
        turned = (_turned(camera, quarters) - camera.parameters())[:, None]
        if np.abs(turned[2:4]).max() > LEAST_SHIFT_PX:
            by = f"turned by {90 * quarters}° relative to the"
            causes += [
                Hypothesis(f"the photographs are {by} camera file", AS_RECORDED,
                           lambda value, _: f"principal point {100 * value[0]:.0f} % of the way", turned, whole=True),
                Hypothesis(f"some photographs are {by} others", AS_RECORDED,
                           lambda value, _: f"{(value > 0.5).sum()} of {len(value)} are turned", turned, "image", True),
            ]  # fmt: skip
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
    """Returns the columns of a motion of all faces against the board, about the middle of all points."""
    return significance.by_motion(network, network.model.xyz_model.mean(0))
