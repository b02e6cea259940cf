"""Centres to the sub-pixel: a blurred ellipse is fitted to the grey values around the rim of each candidate.

The edge is modelled as a step blurred by a Gaussian (its width is estimated), between two brightness planes, along
an ellipse in *ideal* coordinates: every pixel is first moved to where a lens without distortion would have put it,
because a distorted ellipse is none. The fit is a robust Gauss–Newton over the centre (2), the ellipse (3), the blur
and both planes (6). (The field's alternatives are grey-value centroids, edges along the normals with an ellipse fit,
and contours; this model is the one nearest to the Cramér–Rao bound, also under a brightness gradient.)

The σ that a centre carries is that of an M-estimator: what errors in the pixels do to its equation, through the
inverse of how the equation answers to a shifted image. Errors are not independent from pixel to pixel, as JPEG,
demosaicing and denoising spread them, and what the model does not follow, as motion blur, is none: it is even about
the centre and moves nothing. Both are measured where centres live, on the rim: a centre is the residuals' first
harmonic around it, and the next odd ones, which no parameter takes up, show how large it is by chance. All circles
measured in one call share that factor; each has its own noise.

Planes do not follow a circle of which one half is darker, or with an edge beside it: the centre then moves by up to
0.2 px without any residual that a rim's share would show. The third harmonic of the residuals around the rim does show
it (the first is the planes', even ones move no centre), inside and outside apart; where it is significant the fit goes
on with brightness that varies around the rim, at the price of a larger σ.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from stcal.geometry.camera import Camera
from stcal.geometry.robust import robust_sigma
from stcal.sfm.data.centres import Centres
from stcal.sfm.detect.ellipses import Ellipses

BAND_PX = 4.0
"""Half width of the band of pixels around the rim, at first and at least …"""
BAND_BLURS = 4.0
"""… and in units of the blur afterwards."""
START_BLUR_PX = 0.8
BLUR_LIMITS_PX = (0.25, 12.0)
STEPS = 12
RESELECTIONS = 4
"""In so many first steps the band is laid anew …"""
RESELECT_PX = 0.3
RESELECT_BAND = 0.15
"""… when the centre or the width of the band has changed by more than this."""
PARAMETERS = 12
MIN_PIXELS = 30
CONVERGED_PX = 2e-3
"""The step after one of this size is a tenth of it at most: what is left is far below any σ."""
ROBUST_WIDTH = 5.0
"""Residuals beyond this many standard deviations lose weight (Geman–McClure)."""
SECTORS = 16
MIN_RIM = 0.8
"""Share of the rim's sectors that must follow the model; less is a circle partly hidden or cut off."""
MAX_SHIFT = 0.35
"""Largest move of the centre from its candidate, in mean radii (plus one pixel)."""
MAX_RIM_RESIDUAL = 0.15
"""RMS residual of a sector that follows the model, as a fraction of the contrast."""
RIM_CLEARANCE_PX = 1.5
MIN_SIGMA = 0.4
"""Grey values: what quantisation leaves of noise, and a little more."""
MIN_NOISE2 = 1e-12
"""Square of grey values: no noise at all."""
WAVES = (1, 2, 3)
"""Harmonics around the rim of what planes do not follow."""
TOLD_BY = 3
UNEVEN = 0.004
"""Amplitude of that harmonic, as a share of the contrast, that moves a centre by about 2 µm in 100 …"""
UNEVEN_CHI2 = 23.0
"""… and its χ² of two degrees of freedom: by chance one circle in 100 000."""
WAVE_STEPS = 8
CHANCE_WAVES = 3
"""So many odd harmonics around the rim stand for the first: the third, the fifth, the seventh. Higher ones are shorter
than what correlates the pixels: JPEG's blocks are of 8 px, and the seventh wave around a circle of 6 px is of 5. (JPEG
50 to 95 on 240 sheets of 200 circles: errors over σ were within 0.9…1.15 on 227 with 1 wave, 235 with 2, 234 with 3,
219 with 4; the fewer, the more is left to chance.)"""
MAX_CHANCE = 4.2
"""Squares of one circle over their median: by chance one in a thousand (χ² of six degrees of freedom); a dirty circle
does not speak for the others."""
SHARP_PX, SHARP = 1.5, 0.33
"""Where the blur is wider than this, in pixels or in the ellipse's smaller radius, how the fit answers to a shift is
asked of the image; below it that changed σ by 1 %, and it costs a tenth of the fit."""
CUSP = 0.3
"""The edge's distance has a cusp in the middle of the ellipse; slopes and waves are kept to what they are at this share
of the radius."""
UNTRUSTED = 0.2
"""Share of the move that following the waves leaves unexplained at most (circles of 8 to 28 px, halves darker by 5 to
30 %); it goes into σ."""


def measure_centres(image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses) -> Centres:
    """Measure ``ellipses`` in a grey image of any depth.

    Parameters
    ----------
    image : (height, width) array, uint8 or uint16
    ellipses : what to measure
    neighbours : all candidates of the image; pixels of those that come near are left out
    """
    half = 1.25 * np.sqrt((ellipses.shape_px**2).sum(2)) + 3 * BAND_PX
    to_ideal = _local_ideal_maps(camera, ellipses.centre_px, half)
    masks = _intruders(ellipses, neighbours, half)
    focal = float(np.sqrt(camera.focal.prod()))
    rows = [
        _Fit(image, ellipses.centre_px[i], ellipses.shape_px[i], half[i], to_ideal[i], masks[i]).result()
        for i in range(len(ellipses))
    ]
    centre = np.array([fit.centre for fit in rows]).reshape(-1, 2) / focal
    shape = np.array([fit.shape for fit in rows]).reshape(-1, 2, 2) / focal
    rim = np.array([fit.rim for fit in rows], float)
    uneven = np.array([fit.uneven for fit in rows]).reshape(-1, 2) / focal
    chance = np.array([fit.chance for fit in rows], float)
    covariance = np.array([fit.covariance for fit in rows]).reshape(-1, 2, 2) / focal**2
    covariance = _correlation(chance[rim >= MIN_RIM]) * covariance
    covariance += UNTRUSTED**2 * uneven[:, :, None] * uneven[:, None, :]
    distorted, jacobian = camera.distort_jacobian(centre)
    jacobian = jacobian * camera.focal[:, None]
    return Centres(
        centre_px=distorted * camera.focal + camera.centre,
        centre=centre,
        shape=shape,
        covariance_px2=jacobian @ covariance @ np.swapaxes(jacobian, 1, 2),
        blur_px=np.array([fit.blur for fit in rows], float),
        contrast=np.array([fit.contrast for fit in rows], float),
        noise=np.array([fit.noise for fit in rows], float),
        rim=rim,
        uneven_px=(jacobian @ uneven[..., None])[..., 0],
        ok=rim >= MIN_RIM,
    )


def _correlation(chance: np.ndarray) -> float:
    """Factor of the covariances of independent pixels, from the squares of n circles' harmonics over what independent
    pixels would make them; 1 of no circle. Few squares may be small by chance: their mean times ν/(ν−2), ν degrees of
    freedom, keeps the expectation of squared errors over variances at one (mean of the F distribution)."""
    freedom = 2 * CHANCE_WAVES * len(chance)
    if not freedom:
        return 1.0
    return float(np.minimum(chance, MAX_CHANCE * np.median(chance)).mean()) * freedom / (freedom - 2)


def _monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Cubic monomials, (10, ...)."""
    xx, xy, yy = x * x, x * y, y * y
    return np.stack([np.ones_like(x), x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y])


def _local_ideal_maps(camera: Camera, centre_px: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Cubic polynomials, (n, 2, 10), from the box around each candidate (scaled to ±1) to ideal pixels."""
    knots = np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    x, y = (g.ravel() for g in np.meshgrid(knots, knots))
    basis = _monomials(x, y)
    points = centre_px[:, None] + half[:, None] * np.column_stack([x, y])
    ideal = camera.normalised_from_pixel(points) * np.sqrt(camera.focal.prod())
    return np.swapaxes(np.linalg.pinv(basis.T) @ ideal, 1, 2)


def _intruders(ellipses: Ellipses, neighbours: Ellipses, half: np.ndarray) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """For every ellipse the (centre, inverse shape) of other candidates that reach into its box."""
    reach = np.sqrt((neighbours.shape_px**2).sum(2))
    gap = np.abs(ellipses.centre_px[:, None] - neighbours.centre_px) - half[:, None] - reach
    near = (gap < 0).all(2)
    lists = []
    for i in range(len(ellipses)):
        found = []
        for j in np.flatnonzero(near[i]):
            between = neighbours.centre_px[j] - ellipses.centre_px[i]
            square = between @ between
            support = np.linalg.norm(ellipses.shape_px[i] @ between) + np.linalg.norm(neighbours.shape_px[j] @ between)
            # Ellipses that overlap are the same blob, or one holds the other: supports along the line of centres.
            if square > 1 and square > support - 2 * np.sqrt(square):
                wider = neighbours.shape_px[j] + RIM_CLEARANCE_PX * np.eye(2)
                found.append((neighbours.centre_px[j], np.linalg.inv(wider)))
        lists.append(found)
    return lists


@dataclass(frozen=True, slots=True, eq=False)
class _Ellipse:
    """One ellipse, ideal px: ``centre`` (2,), ``shape`` and ``covariance`` (2, 2) as if pixels were independent,
    ``chance``, and what :class:`Centres` says."""

    centre: np.ndarray
    shape: np.ndarray
    covariance: np.ndarray
    chance: float
    blur: float
    contrast: float
    noise: float
    rim: float
    uneven: np.ndarray


class _Fit:
    """The fit of one blurred ellipse. Coordinates are rows of (2, pixels) arrays, ideal px."""

    def __init__(self, image, centre_px, shape_px, half, to_ideal, intruders):
        low = np.maximum(np.floor(centre_px - half).astype(int), 0)
        high = np.minimum(np.ceil(centre_px + half).astype(int) + 1, image.shape[::-1])
        self.patch = image[low[1] : high[1], low[0] : high[0]]
        self.dx = (np.arange(low[0], high[0]) - centre_px[0]).astype(np.float32)
        self.dy = (np.arange(low[1], high[1]) - centre_px[1]).astype(np.float32)[:, None]
        self.place, self.half, self.to_ideal, self.intruders = centre_px, half, to_ideal, intruders
        jacobian = to_ideal[:, 1:3] / half
        value, vector = np.linalg.eigh((m := jacobian @ shape_px) @ m.T)
        self.inverse_shape = (vector / np.sqrt(value)) @ vector.T
        self.jacobian = jacobian
        self.centre = to_ideal[:, 0] + (to_ideal[:, 3:] @ _monomials(np.zeros(1), np.zeros(1))[3:])[:, 0]
        self.start = self.centre
        self.radius = float(np.prod(value) ** 0.25)
        self.blur = START_BLUR_PX
        self.waves: tuple[bool, ...] = ()
        self.uneven = np.zeros(2)
        self.failed = not (self._run() and self._follow_waves())

    def _run(self) -> bool:
        band, selected = 0.0, self.centre
        for step in range(STEPS):
            wanted = max(BAND_PX, BAND_BLURS * self.blur)
            moved = np.abs(self.centre - selected).max()
            if step == 0 or (step < RESELECTIONS and (moved > RESELECT_PX or abs(wanted / band - 1) > RESELECT_BAND)):
                band, selected = wanted, self.centre
                self._select(band)
                if len(self.grey) < MIN_PIXELS:
                    return False
            move = self._step(robust=step >= 1)
            if not np.isfinite(move) or np.linalg.norm(self.centre - self.start) > MAX_SHIFT * self.radius + 1:
                return False
            if step >= 2 and move < CONVERGED_PX:
                break
        return True

    def _follow_waves(self) -> bool:
        """Go on with brightness that varies around the rim on the sides, inside or outside, where it does."""
        self.waves = tuple(inside for inside in (True, False) if self._is_uneven(inside))
        if not self.waves:
            return True
        before = self.centre
        self.levels = None
        for _ in range(WAVE_STEPS):
            move = self._step(robust=True)
            if not np.isfinite(move) or np.linalg.norm(self.centre - self.start) > MAX_SHIFT * self.radius + 1:
                return False
            if move < CONVERGED_PX:
                break
        self.uneven = before - self.centre
        return True

    def _is_uneven(self, inside: bool) -> bool:
        """Whether the residuals' third harmonic around the rim, on one side of it, is significant and matters."""
        away = self.reduced if not inside else -self.reduced
        own = (away > 1.0) & (self.weight > 0.5)
        count = int(own.sum())
        if count < MIN_PIXELS:
            return False
        angle = TOLD_BY * np.arctan2(self.rim_angle[1][own], self.rim_angle[0][own])
        basis = np.stack([np.cos(angle), np.sin(angle)]).astype(float)
        residual = self.residual[own].astype(float)
        amplitude = np.linalg.solve(basis @ basis.T, basis @ residual)
        sigma = max(robust_sigma(np.abs(residual)), MIN_SIGMA)
        chi2 = float(amplitude @ (basis @ basis.T) @ amplitude) / sigma**2
        return chi2 > UNEVEN_CHI2 and float(np.hypot(*amplitude)) > UNEVEN * abs(self.contrast)

    def _select(self, band: float):
        """The pixels within ``band`` of the rim, less those of intruders."""
        inverse = (self.inverse_shape @ self.jacobian).astype(np.float32)
        shift = np.linalg.solve(self.jacobian, self.centre - self.start).astype(np.float32)
        dx, dy = self.dx - shift[0], self.dy - shift[1]
        vx = inverse[0, 0] * dx + inverse[0, 1] * dy
        vy = inverse[1, 0] * dx + inverse[1, 1] * dy
        square = vx * vx + vy * vy
        gx = inverse[0, 0] * vx + inverse[1, 0] * vy
        gy = inverse[0, 1] * vx + inverse[1, 1] * vy
        chosen = (square - np.sqrt(square)) ** 2 < band**2 * (gx * gx + gy * gy)
        for place, shape in self.intruders:
            ex = self.dx + np.float32(self.place[0] - place[0])
            ey = self.dy + np.float32(self.place[1] - place[1])
            chosen &= (shape[0, 0] * ex + shape[0, 1] * ey) ** 2 + (shape[1, 0] * ex + shape[1, 1] * ey) ** 2 > 1
        self.in_patch = rows, columns = np.nonzero(chosen)
        # Single precision is enough here: coordinates are taken from the start of the centre.
        self.grey = self.patch[rows, columns].astype(np.float32)
        at = _monomials(self.dx[columns].astype(float) / self.half[0], self.dy[rows, 0].astype(float) / self.half[1])
        self.ideal = (self.to_ideal @ at - self.start[:, None]).astype(np.float32)
        self.weight = np.ones(len(self.grey), np.float32)
        self.levels = None

    def _step(self, robust: bool) -> float:
        """One Gauss–Newton step over all twelve parameters; returns the move of the centre, NaN where it breaks."""
        inverse_shape = self.inverse_shape.astype(np.float32)
        p, q = offset = self.ideal - (self.centre - self.start).astype(np.float32)[:, None]
        a, b = v = inverse_shape @ offset
        rho = np.sqrt(a * a + b * b)
        gradient = inverse_shape @ v
        slope_rho = np.sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1])
        reduced = (rho - 1) * rho / (slope_rho * np.float32(self.blur))
        inside = ndtr(-reduced)
        x, y = offset * np.float32(1 / self.radius)
        jacobian = np.empty((PARAMETERS + 2 * len(WAVES) * len(self.waves), len(rho)), np.float32)
        planes = jacobian[6:]
        planes[0], planes[1], planes[2], planes[3], planes[4], planes[5] = 1, x, y, inside, inside * x, inside * y
        waves = self._waves(a, b) if self.waves else np.zeros((0, len(a)), np.float32)
        for k, within in enumerate(self.waves):
            planes[6 + k * len(waves) : 6 + (k + 1) * len(waves)] = waves * (inside if within else 1 - inside)
        levels = self._levels(planes) if self.levels is None else self.levels
        amplitude = levels[3] + levels[4] * x + levels[5] * y
        for k, within in enumerate(self.waves):
            own = levels[6 + k * len(waves) : 6 + (k + 1) * len(waves)] @ waves
            amplitude = amplitude + own if within else amplitude - own
        # d(distance)/d(rho) = rho/slope_rho; the change of the slope itself is of second order on the rim.
        density = amplitude * np.exp(-0.5 * reduced * reduced) * np.float32(1 / (np.sqrt(2 * np.pi) * self.blur))
        push = density / slope_rho
        jacobian[0], jacobian[1] = push * gradient[0], push * gradient[1]
        jacobian[2], jacobian[3], jacobian[4] = -push * a * p, -push * (a * q + b * p), -push * b * q
        jacobian[5] = density * reduced
        self.residual, self.rim_angle, self.reduced = self.grey - levels @ planes, (a, b), reduced
        self._weigh(inside, robust)
        weighted = jacobian * self.weight
        normal = (weighted @ jacobian.T).astype(float)
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        try:
            inverse = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
        except np.linalg.LinAlgError:
            return float("nan")
        step = inverse @ (weighted @ self.residual)
        self.scores, self.inverse = weighted, inverse
        return self._apply(step, levels)

    @staticmethod
    def _waves(a, b) -> np.ndarray:
        """Cosines and sines around the rim, (2 k, n)."""
        angle = np.arctan2(b, a) * np.array(WAVES, np.float32)[:, None]
        return np.concatenate([np.cos(angle), np.sin(angle)])

    def _apply(self, step, levels) -> float:
        matrix = self.inverse_shape + np.array([[step[2], step[3]], [step[3], step[4]]])
        if not np.isfinite(step).all() or np.linalg.det(matrix) <= 0 or np.trace(matrix) <= 0:
            return float("nan")
        self.inverse_shape = matrix
        self.centre = self.centre + step[:2]
        self.blur = float(np.clip(self.blur + np.clip(step[5], -0.4 * self.blur, 0.6 * self.blur), *BLUR_LIMITS_PX))
        self.levels = (levels + step[6:]).astype(np.float32)
        self.contrast = float(self.levels[3])
        return float(np.abs(step[:2]).max())

    def _levels(self, planes) -> np.ndarray:
        weighted = planes * self.weight
        normal = (weighted @ planes.T).astype(float)
        normal[np.diag_indices(len(planes))] *= 1 + 1e-9
        try:
            return np.linalg.solve(normal, weighted @ self.grey).astype(np.float32)
        except np.linalg.LinAlgError:
            return np.full(len(planes), np.nan, np.float32)

    def _weigh(self, inside, robust: bool):
        """Weights of the pixels: equal but for outliers, which are judged by the spread on the edge itself.

        Weighting the darker side up by its lower noise was tried: the edge's own errors decide, and it gained nothing.
        """
        edge = (inside > 0.08) & (inside < 0.92)
        size = np.abs(self.residual[edge]) if edge.any() else np.abs(self.residual)
        sigma = max(robust_sigma(size), MIN_SIGMA)
        self.weight = np.ones(len(self.residual), np.float32)
        if robust:
            self.weight = 1 / (1 + (self.residual * np.float32(1 / (ROBUST_WIDTH * sigma))) ** 2) ** 2

    def _covariance(self) -> tuple[np.ndarray, float]:
        """Of the centre, (2, 2), as if pixels were independent, and :meth:`_chance` over that noise.

        The noise is that of the pixels where the centre's weight is: errors sit on the edge more than beside it. The
        covariance is S·H·Sᵀ, H the inverse of the normal equations, S⁻¹ the share of a shift of the image that one step
        answers with (Huber 1981, sec. 6.3). The step's own derivatives would make that share 1; it is less by what the
        weights give away, and another where the edge is too wide for them, or not as the model has it.
        """
        pull = self.scores[0] ** 2 + self.scores[1] ** 2
        share = pull / self.weight
        total = float(share.sum())
        noise2 = max(float(pull @ self.residual**2) / total, MIN_NOISE2)
        # ψ' over the weight of Geman–McClure, not below zero, where it would reward outliers.
        influence = np.maximum(4 * np.sqrt(self.weight) - 3, 0)
        chance = self._chance(np.sqrt(share / self.weight), total) / noise2 if noise2 > MIN_NOISE2 else 1.0
        if self.blur < min(SHARP_PX, SHARP * self._narrowest()):
            return noise2 * (float(pull.sum()) / float(pull @ influence)) ** 2 * self.inverse[:2, :2], chance
        slope = self._exact_slope(self.scores[:2] / self.weight) - self._residual_slope()
        answer = (self.inverse[:2] @ self.scores) * influence
        spread = np.linalg.inv(answer @ slope.T)
        return noise2 * spread @ self.inverse[:2, :2] @ spread.T, chance

    def _narrowest(self) -> float:
        """The ellipse's smaller radius, px."""
        (xx, xy), (_, yy) = self.inverse_shape.tolist()
        return 2 / (xx + yy + math.hypot(xx - yy, 2 * xy))

    def _exact_slope(self, slope: np.ndarray) -> np.ndarray:
        """Derivatives of the model by the centre, (2, pixels): the step's, ``slope``, and the change of the distance's
        own slope."""
        inverse_shape = self.inverse_shape.astype(np.float32)
        rho = np.maximum(np.hypot(*self.rim_angle), np.float32(CUSP))
        steepness = np.maximum(np.hypot(*(inverse_shape @ np.stack(self.rim_angle))), np.float32(CUSP / self.radius))
        turn = np.float32(self.blur) * inverse_shape @ inverse_shape
        return (2 - 1 / rho) * slope - self.reduced / steepness * (turn @ slope)

    def _residual_slope(self) -> np.ndarray:
        """Derivatives of the residual by the place, (2, pixels); none where a neighbour is not in the band."""
        patch = np.full(self.patch.shape, np.nan, np.float32)
        patch[self.in_patch] = self.residual
        slope = np.zeros((2, *patch.shape), np.float32)
        slope[0, :, 1:-1] = patch[:, 2:] - patch[:, :-2]
        slope[1, 1:-1] = patch[2:] - patch[:-2]
        by_pixel = np.nan_to_num(slope[:, *self.in_patch]) / 2
        return np.linalg.inv(self.jacobian).T.astype(np.float32) @ by_pixel

    def _chance(self, edge: np.ndarray, total: float) -> float:
        """Variance of a pixel from the residuals' :data:`CHANCE_WAVES` on the rim, of amplitude ``edge`` and weighted
        square ``total``: an estimate from orthonormal series (Phillips 2005), less what the parameters took of these.
        """
        a, b = self.rim_angle
        wave = np.empty(len(edge), np.complex64)
        wave.real, wave.imag = np.stack([a, b]) / np.maximum(np.sqrt(a * a + b * b), np.float32(CUSP))
        double, wave = wave * wave, wave * edge
        waves = np.empty((2 * CHANCE_WAVES, len(edge)), np.float32)
        for k in range(CHANCE_WAVES):
            wave *= double
            waves[2 * k], waves[2 * k + 1] = wave.real, wave.imag
        taken = (waves @ self.scores.T).astype(float)
        left = CHANCE_WAVES * total - float((taken @ self.inverse * taken).sum())
        found = waves @ (self.weight * self.residual)
        return float(found @ found) / left

    def result(self) -> _Ellipse:
        """The fit; of no contrast and no rim where it failed."""
        if self.failed:
            return _Ellipse(self.start, np.eye(2) * self.radius, np.eye(2), 0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(2))
        near = np.abs(self.reduced) * self.blur < max(1.5, self.blur)
        angle = np.arctan2(self.rim_angle[1][near], self.rim_angle[0][near])
        sector = (angle * (SECTORS / (2 * np.pi))).astype(int) % SECTORS
        total = np.bincount(sector, minlength=SECTORS)
        square = np.bincount(sector, self.residual[near] ** 2, minlength=SECTORS)
        noise = robust_sigma(np.abs(self.residual))
        allowed = (MAX_RIM_RESIDUAL * self.contrast) ** 2 + (2 * noise) ** 2
        rim = float((square <= allowed * total).mean())
        shape = np.linalg.inv(self.inverse_shape)
        covariance, chance = self._covariance()
        return _Ellipse(self.centre, shape, covariance, chance, self.blur, self.contrast, noise, rim, self.uneven)
