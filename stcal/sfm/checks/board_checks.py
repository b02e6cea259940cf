"""Checks of the board and its scale, and of the measured radius of every circle."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import align_similarity, skew
from stcal.geometry.robust import robust_sigma
from stcal.labels import CircleLabel, DotLabel, Label, dot_cells
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.refine import Network
from stcal.sfm.adjust.rims import Rim, common_dome, lost_radius_mm, radius_views
from stcal.sfm.checks.image_checks import MAD_EFFICIENCY
from stcal.sfm.checks.significance import Trial, assess
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.report.check import CHECKS, SUSPICIOUS, Check, TestedValue, impossible

EDGE_BIAS_PX = 0.05
"""σ of the bias that light, lens and threshold add to all radii alike; it moves no centre."""
EDGE_DIFFERENCE_PX = 0.01
"""σ of the difference of this bias between large and small circles."""
RADIUS_TOLERANCE = 2e-3
"""Relative σ of a single radius from manufacturing; it moves the centre by 4·10⁻³ of its eccentricity, about 1 nm."""
MIN_PEERS = 5
"""Smallest number of circles of one design radius that are compared with each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Radii:
    """Radii of the target's circles and the board's dots: medians over all images and groups."""

    labels: tuple[Label, ...]
    design_mm: np.ndarray  # (c,)
    ratio: np.ndarray  # (c,) measured over designed
    size_px: np.ndarray  # (c,) designed radius in the images, geometric mean of the ellipse's axes

    def __post_init__(self):
        for name in ("design_mm", "ratio", "size_px"):
            object.__setattr__(self, name, frozen(getattr(self, name), (len(self.labels),), name))

    def classes(self) -> dict[str, np.ndarray]:
        """Returns the indices of the circles of each kind and radius, by the name of the class."""
        indices: dict[str, list[int]] = {}
        for i, (label, radius) in enumerate(zip(self.labels, self.design_mm, strict=True)):
            kind = "dots" if isinstance(label, DotLabel) else "circles"
            indices.setdefault(f"{kind} of radius {radius:g} mm", []).append(i)
        return {name: np.array(members) for name, members in indices.items()}


@dataclass(frozen=True, slots=True)
class Size:
    """Size of the target over that of its design, minus 1, with its σ and the degrees of freedom of σ."""

    name: str
    size: float
    sigma: float
    freedom: int


def measure_radii(
    networks: Sequence[Network],
    images: Sequence[ImageObservations],
    design_mm: dict[Label, float],
    camera: Camera,
    rim_mm: Mapping[Label, float],  # heights of the rims that the result allows for, which hide a part of the circles
) -> Radii:
    """Computes radii from the areas of the ellipses and the positions and planes of the circles."""
    by_name = {image.name: image for image in images}
    ratio: dict[Label, list[np.ndarray]] = {}
    size: dict[Label, list[np.ndarray]] = {}
    for network in networks:
        views = radius_views(network.model, by_name, design_mm, camera)
        for k, label in enumerate(network.model.labels):
            if label not in design_mm:  # a corner
                continue
            own = views.point_index == k
            hidden = lost_radius_mm(rim_mm.get(label, 0.0), views.tan_tilt[own], design_mm[label]) / design_mm[label]
            faded = common_dome(views.domes[own])[0] * views.by_dome_mm[own] / design_mm[label]
            ratio.setdefault(label, []).append(views.ratio[own] + hidden + faded)
            size.setdefault(label, []).append(views.size_px[own])
    medians = (np.array([np.median(np.concatenate(v)) for v in each.values()]) for each in (ratio, size))
    return Radii(tuple(ratio), np.array([design_mm[label] for label in ratio]), *medians)


def radius_checks(radii: Radii) -> list[Check]:
    """Tests every circle against those of its kind and radius, and each such class against its design."""
    single, whole = [], []
    for name, members in radii.classes().items():
        ratio = radii.ratio[members]
        usual = float(np.median(ratio))
        bias_px = (usual - 1) * float(np.median(radii.size_px[members]))
        whole.append(Trial(name, bias_px, "px", (bias_px / EDGE_BIAS_PX) ** 2, 1))
        if len(members) < MIN_PEERS:
            continue
        sigma = float(np.hypot(robust_sigma(np.abs(ratio - usual)), RADIUS_TOLERANCE))
        freedom = max(MAD_EFFICIENCY * len(members) - 1, 2.0)
        for i in members:
            away = float(radii.ratio[i]) - usual
            single.append(
                Trial(radii.labels[i], 1e3 * away * float(radii.design_mm[i]), "µm", (away / sigma) ** 2, 1, freedom)
            )
    single_remedy = (
        "a damaged or dirty circle, a wrong label, or another radius than the design's: look at it in the overlays, "
        "correct target.toml"
    )
    class_remedy = (
        "all circles of a kind are larger or smaller than target.toml or board.toml says, or over-exposed: check that "
        "both files are of this body, measure a circle, correct the file; a wrong radius makes a wrong eccentricity"
    )
    return [
        assess("radius", single, "circles", single_remedy),
        assess("radius-design", whole, "kinds of circle", class_remedy),
    ]


RIM_SIGMAS = 4.0
"""Height of a rim, in its σ, that is taken as seen: by chance in one of 16 000 kinds of circle."""
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
    remedy = (
        "faces are where their circles appear; for the luminous surface, run without --no-rim, or state rim_mm in "
        "target.toml, of dots in board.toml"
    )
    return Check("rim", title, "suspicious", "; ".join(reasons), tuple(measured), len(rims), tuple(names), remedy)


def size_by_radii(radii: Radii) -> Size | None:
    """Slope of measured over designed radii of the target's circles, minus 1; None if it is not determined."""
    is_circle = np.array([isinstance(label, CircleLabel) for label in radii.labels], bool)
    size = radii.size_px[is_circle]
    design = radii.design_mm[is_circle]
    if len(size) < MIN_PEERS or np.ptp(design) == 0:
        return None
    design_matrix = np.column_stack([np.ones(len(size)), size])
    excess = (radii.ratio[is_circle] - 1) * size
    fit, *_ = np.linalg.lstsq(design_matrix, excess, rcond=None)
    freedom = len(size) - 2
    variance = float(((excess - design_matrix @ fit) ** 2).sum()) / freedom
    slope_variance = variance * np.linalg.inv(design_matrix.T @ design_matrix)[1, 1]
    reach = np.median(size[design == design.max()]) - np.median(size[design == design.min()])
    sigma = np.hypot(np.sqrt(slope_variance), EDGE_DIFFERENCE_PX / reach)
    return Size("by radii of circles", float(fit[1]), float(sigma), freedom)


DESIGN_SCALE = 1e-4
"""Relative σ of the target's size against its design: the effect of 4 K on aluminium, or of a printer on a film."""
MIN_DOTS = 4


def board_checks(networks: Sequence[Network], board: BoardDesign) -> list[Check]:
    """Tests the dots of every group against the grid, and the scale of each row and column against the rest."""
    whole, lines = [], []
    for network in networks:
        dots = np.array([i for i, label in enumerate(network.model.labels) if isinstance(label, DotLabel)])
        if len(dots) < MIN_DOTS:
            continue
        gap, weight, cells = _board_gap(network, dots, board)
        redundancy = network.redundancy.sum()
        freedom = 3 * len(dots) - 7
        square = float(gap @ weight @ gap)
        rms = 1e3 * float(np.sqrt((gap**2).mean()))
        name = f"group {network.model.group}"
        whole.append(Trial(name, rms, "µm RMS", square, freedom, redundancy))
        lines += _lines(name, gap, weight, cells, board, max(1.0, square / freedom), redundancy)
    remedy = "a bent, swollen or badly printed board, or a stated σ too small: measure it, state its σ in board.toml"
    of_line = "check this line of the board for damage, and rows, columns and pitch in board.toml"
    return [
        assess("board", whole, "groups", remedy),
        assess("board-lines", lines, "rows and columns", of_line),
    ]


def _board_gap(network: Network, dots: np.ndarray, board: BoardDesign):
    """Returns dots minus grid after a similarity, (3d,) mm, their weight matrix with the group's noise, and their
    cells."""
    labels = [network.model.labels[i] for i in dots]
    cells = dot_cells(labels)
    design = board.places_mm(labels)
    xyz = network.model.xyz_model[dots]
    board_from_model = align_similarity(design, xyz)
    turn = np.kron(np.eye(len(dots)), board_from_model.scale * board_from_model.rigid.rotation)
    of_images = network.noise() * network.covariance_of(dots)
    covariance = turn @ of_images @ turn.T + board.sigma_mm**2 * np.eye(3 * len(dots))
    middle = design - design.mean(0)
    free = np.concatenate(
        [-skew(middle), np.broadcast_to(np.eye(3), (len(dots), 3, 3)), middle[:, :, None]], axis=2
    ).reshape(-1, 7)
    # The similarity is eliminated as an unknown, so that the weights annihilate it.
    inverse = np.linalg.inv(covariance)
    along = inverse @ free
    weight = inverse - along @ np.linalg.solve(free.T @ along, along.T)
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


def pitch_check(calibrated: CalibratedTarget, target: TargetDesign, radii: Radii, has_board: bool = True) -> Check:
    """Tests the measured size of the target, by positions and by radii of circles, against its design, with its own σ
    of 100 ppm: no residual shows a wrong pitch. Radii that contradict the positions are left out."""
    if target.up_to_scale:
        return impossible("pitch", "the drawing defines the size", "state a known distance with scale")
    positions, of_radii = _size_by_positions(calibrated, target), size_by_radii(radii)
    measures = [m for m in (positions, of_radii) if m is not None]
    if not measures:
        reason = f"no face with {MIN_DOTS} circles, and no circles of two sizes"
        has_circles = any(face.printed is None for face in target.faces)
        return impossible("pitch", reason, "add views of the faces" if has_circles else "")
    shown = measures
    if positions and of_radii:
        square = (positions.size - of_radii.size) ** 2 / (positions.sigma**2 + of_radii.sigma**2)
        if fdtrc(1, min(positions.freedom, of_radii.freedom), square) < SUSPICIOUS:  # they contradict each other
            measures = [positions]
    weight = np.array([1 / m.sigma**2 for m in measures])
    size = float(weight @ [m.size for m in measures] / weight.sum())
    variance = 1 / weight.sum() + DESIGN_SCALE**2 + (calibrated.scale_sigma or 0.0) ** 2
    freedom = sum(m.freedom for m in measures)
    remedy = (
        "the pitch in board.toml, or the size of the target in target.toml, is wrong as a whole, and so are all "
        "distances of the result: measure the board over its full length with a calliper"
        if has_board
        else "printed sizes or known distances in target.toml do not fit the circles there, and all distances of the "
        "result may be wrong with them: measure a side of each print with a calliper"
    )
    trial = Trial(
        "board pitch" if has_board else "size of the circles' faces", 1e6 * size, "ppm", size**2 / variance, 1, freedom
    )
    check = assess("pitch", [trial], "boards", remedy)
    single = tuple(TestedValue(m.name, 1e6 * m.size, None, "ppm", None) for m in shown)
    reason = check.reason if measures == shown else f"{check.reason}; by positions alone, which radii contradict"
    return replace(check, reason=reason, measured=check.measured + single)


def _size_by_positions(calibrated: CalibratedTarget, target: TargetDesign) -> Size | None:
    weighted, weight, square, freedom = 0.0, 0.0, 0.0, 0
    for face in target.with_faces(printed=False).faces:  # the others have told the scale
        indices = [i for i, label in enumerate(face.labels()) if label in calibrated.circles]
        if len(indices) < MIN_DOTS:
            continue
        design = np.column_stack([face.xy_mm[indices], np.zeros(len(indices))])
        xyz = np.array([calibrated.circles[face.labels()[i]] for i in indices])
        fit = align_similarity(xyz, design)
        spread = float(((design - design.mean(0)) ** 2).sum())
        weighted, weight = weighted + spread * (fit.scale - 1), weight + spread
        residuals = fit.inverse() @ xyz - design
        square, freedom = square + float((residuals[:, :2] ** 2).sum()), freedom + 2 * len(indices) - 4
    if not freedom:
        return None
    return Size("by positions of circles", weighted / weight, float(np.sqrt(square / freedom / weight)), freedom)
