"""Centres to the sub-pixel, and their σ from pixel errors: the least-squares fit of blurred ellipses to grey values.

A rim is fitted to a band around it in the image, without pixels of neighbouring circles; many are fitted side by side.
"""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.plane import singular_values
from stcal.geometry.robust import robust_sigmas
from stcal.sfm.data.group_model import Centres
from stcal.sfm.detect.candidates import Ellipses

BAND_PX = 4.0  # half width of the band of pixels around the rim, at first and at least
RIM_CLEARANCE_PX = 1.5


def monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the monomials up to third degree, (10, ...)."""
    xx, yy = x * x, y * y
    return np.stack([np.ones_like(x), x, y, xx, x * y, yy, xx * x, xx * y, x * yy, yy * y])


def local_ideal_maps(camera: Camera, centre_px: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Returns cubic polynomials, (n, 2, 10), that map the box around each candidate (scaled to ±1) to ideal pixels."""
    knots = np.cos(np.pi * (np.arange(6) + 0.5) / 6)
    x, y = (g.ravel() for g in np.meshgrid(knots, knots))
    basis = monomials(x, y)
    points = centre_px[:, None] + half[:, None] * np.column_stack([x, y])
    ideal = camera.normalised_from_pixel(points) * np.sqrt(camera.focal.prod())
    return np.swapaxes(np.linalg.pinv(basis.T) @ ideal, 1, 2)


def intruders(ellipses: Ellipses, neighbours: Ellipses, half: np.ndarray) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Returns by ellipse the (relative centre, inverse shape) of other candidates that reach into its box."""
    reach = np.sqrt((neighbours.shape_px**2).sum(2))
    gap = np.abs(ellipses.centre_px[:, None] - neighbours.centre_px) - half[:, None] - reach
    i, j = np.nonzero((gap < 0).all(2))
    between = neighbours.centre_px[j] - ellipses.centre_px[i]
    square = (between**2).sum(1)
    shapes = np.stack([ellipses.shape_px[i], neighbours.shape_px[j]])
    support = np.linalg.norm(shapes @ between[..., None], axis=2).sum((0, 2))
    # Ellipses that overlap are the same blob, or one holds the other: supports along the line of centres.
    beside = (square > 1) & (square > support - 2 * np.sqrt(square))
    wider = np.linalg.inv(neighbours.shape_px[j] + RIM_CLEARANCE_PX * np.eye(2))
    rows = [np.flatnonzero(beside & (i == own)) for own in range(len(ellipses))]
    return [[(between[k], wider[k]) for k in own] for own in rows]


BAND_BLURS = 4.0  # half width of the band of pixels, in units of the blur
START_BLUR_PX = 0.8
BLUR_LIMITS_PX = (0.25, 12.0)
STEPS = 12
RESELECTIONS = 4  # number of first steps in which the band of pixels may be selected again
RESELECT_PX = 0.3
RESELECT_BAND = 0.15  # change of the centre, and of the width of the band, beyond which the band is selected again
PARAMETERS = 12
MIN_PIXELS = 30
CONVERGED_PX = 2e-3  # size of the last step. The next one is at most a tenth of it, which is far below any σ.
ROBUST_WIDTH = 5.0  # residuals beyond this many standard deviations lose weight (Geman–McClure)
MAX_SHIFT = 0.35  # largest move of the centre from its candidate, in mean radii (plus one pixel)
MIN_SIGMA = 0.4  # smallest σ of a pixel, in grey values: quantisation noise and a little more
WAVES = (1, 2, 3)  # harmonics around the rim of brightness that the planes do not describe
UNEVEN = 0.004  # amplitude of the third harmonic from which it matters, as a share of the contrast
UNEVEN_CHI2 = 23.0
"""χ² of the third harmonic (two freedoms) from which it is significant: a false alarm in one of 100 000 circles."""
WAVE_STEPS = 8
TINY = 1e-9
CUSP = 0.3
"""Share of the radius below which slopes and waves keep their values: the edge's distance has a cusp in the middle."""


class Fits:
    """The fits of n blurred ellipses side by side, ideal px. Pixels are rows of (n, …, m) arrays of single precision:
    coordinates are from each start; ``real`` is 0 behind the last pixel."""

    def __init__(self, image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses):
        n, place = len(ellipses), ellipses.centre_px
        half = 1.25 * np.sqrt((ellipses.shape_px**2).sum(2)) + 3 * BAND_PX  # of the boxes that the rims may move in
        to_ideal = local_ideal_maps(camera, place, half)
        self.image, self.half, self.to_ideal = image, half, to_ideal
        self.intruders = intruders(ellipses, neighbours, half)
        self.low = np.maximum(np.floor(place - half).astype(int), 0)
        self.high = np.minimum(np.ceil(place + half).astype(int) + 1, image.shape[::-1])
        # columns and rows of each box, px from its ellipse
        across, down = (
            [(np.arange(*ends) - at).astype(np.float32) for *ends, at in zip(low, high, middle, strict=True)]
            for low, high, middle in zip(self.low.T, self.high.T, place.T, strict=True)
        )
        self.offset = list(zip(across, down, strict=True))
        self.jacobian = to_ideal[:, :, 1:3] / half[:, None]
        m = self.jacobian @ ellipses.shape_px
        value, vector = np.linalg.eigh(m @ np.swapaxes(m, 1, 2))
        self.inverse_shape = (vector / np.sqrt(value)[:, None]) @ np.swapaxes(vector, 1, 2)
        self.start, self.centre, self.selected = (to_ideal[:, :, 0].copy() for _ in range(3))
        self.radius = np.prod(value, axis=1) ** 0.25
        self.blur, self.band = np.full(n, START_BLUR_PX), np.full(n, np.inf)
        self.levels = np.zeros((n, PARAMETERS - 6 + 4 * len(WAVES)), np.float32)
        self.uneven, self.failed, self.unlevelled = np.zeros((n, 2)), np.zeros(n, bool), np.ones(n, bool)
        self.inverse = np.zeros((n, PARAMETERS, PARAMETERS))
        self.rows, self.columns = [np.zeros(0, int)] * n, [np.zeros(0, int)] * n
        self.grey, self.real, self.weight, self.residual, self.reduced = np.zeros((5, n, 0), np.float32)
        self.ideal, self.on_unit = np.zeros((2, n, 2, 0), np.float32)
        self.scores = np.zeros((n, PARAMETERS, 0), np.float32)
        self._run()
        self._follow_waves()

    def _run(self):
        active = np.arange(len(self.blur))
        for step in range(STEPS):
            if step < RESELECTIONS:
                active = self._lay_bands(active)
            move = self._step(active, robust=step >= 1)
            active = active[self._holds(active, move) & ((step < 2) | (move >= CONVERGED_PX))]
            if not len(active):
                return

    def _holds(self, active, move) -> np.ndarray:
        """Returns the mask of fits with a finite step that stayed near the start; the others are marked as failed."""
        away = np.linalg.norm(self.centre[active] - self.start[active], axis=1)
        holds = np.isfinite(move) & (away <= MAX_SHIFT * self.radius[active] + 1)
        self.failed[active[~holds]] = True
        return holds

    def _follow_waves(self):
        """Continues the fits with brightness that varies around the rim, on the side where this is seen."""
        inside, outside = (self._is_uneven(side) & ~self.failed for side in (True, False))
        if not (inside | outside).any():
            return
        more = (0, 4 * len(WAVES))
        self.scores = np.pad(self.scores, ((0, 0), more, (0, 0)))
        self.inverse = np.pad(self.inverse, ((0, 0), more, more))
        before = self.centre.copy()
        self.unlevelled |= inside | outside
        sides = ((True, False), inside & outside), ((True,), inside & ~outside), ((False,), outside & ~inside)
        for waves, own in sides:
            active = np.flatnonzero(own)
            for _ in range(WAVE_STEPS):
                move = self._step(active, robust=True, waves=waves)
                active = active[self._holds(active, move) & (move >= CONVERGED_PX)]
        self.uneven = np.where((inside | outside)[:, None], before - self.centre, 0.0)

    def _is_uneven(self, inside: bool) -> np.ndarray:
        """Returns (n,) which residuals have a significant and relevant third harmonic on one side of the rim."""
        own = ((-self.reduced if inside else self.reduced) > 1.0) & (self.weight > 0.5)
        many = own.sum(1) >= MIN_PIXELS
        c, s = np.moveaxis(self.direction(), 1, 0)
        basis = np.stack([c * (4 * c * c - 3), s * (3 - 4 * s * s)], 1) * own[:, None]
        gram = (basis @ np.swapaxes(basis, 1, 2)).astype(float)
        gram[~many] = np.eye(2)
        found = (basis @ self.residual[..., None]).astype(float)
        amplitude = np.linalg.solve(gram, found)
        sigma = np.maximum(robust_sigmas(np.abs(self.residual), own), MIN_SIGMA)
        chi2 = (amplitude * found).sum((1, 2)) / sigma**2
        matters = np.hypot(*amplitude[..., 0].T) > UNEVEN * np.abs(self.levels[:, 3])
        return many & (chi2 > UNEVEN_CHI2) & matters

    def domes(self) -> np.ndarray:
        """Returns (n, 3): by which share of the contrast a disc is brighter in its middle than at its rim, σ of that,
        and which share of its radius a dome of all its light hides. Of one more step; a dome moves no centre."""
        bell = np.exp(np.maximum(-0.5 * self.reduced * self.reduced, np.float32(-18)))
        gradient = self.inverse_shape.astype(np.float32) @ self.on_unit
        # (1 − ρ²) D, blurred with its disc as a slope is.
        edge = 2 * self.blur[:, None].astype(np.float32) * np.sqrt((gradient**2).sum(1)) * bell / np.sqrt(2 * np.pi)
        dome = (_normal_above(self.reduced, bell) * (1 - (self.on_unit**2).sum(1)) + edge) * self.real
        own, left = ((self.scores @ each[..., None])[..., 0].astype(float) for each in (dome, self.residual))
        by = (self.inverse @ own[..., None])[..., 0]
        information = np.maximum((self.weight * dome * dome).sum(1, dtype=float) - (own * by).sum(1), TINY)
        height = ((self.weight * dome * self.residual).sum(1, dtype=float) - (by * left).sum(1)) / information
        sigma = np.maximum(robust_sigmas(np.abs(self.residual), self.real > 0), MIN_SIGMA) / np.sqrt(information)
        contrast = np.where(self.levels[:, 3] == 0, 1, self.levels[:, 3]).astype(float)
        turn = np.stack([by[:, 2:4], by[:, 3:5]], 1)
        smaller = contrast * np.trace(np.linalg.solve(self.inverse_shape, turn), axis1=1, axis2=2) / 2
        return np.column_stack([height / contrast, sigma / np.abs(contrast), smaller])

    def direction(self) -> np.ndarray:
        """Returns cosine and sine of each pixel's angle on the unit circle, (n, 2, m)."""
        square = (self.on_unit**2).sum(1, keepdims=True)
        return self.on_unit / np.maximum(np.sqrt(square), np.float32(CUSP))

    def _lay_bands(self, active) -> np.ndarray:
        """Selects the pixels again if centre or blur changed; returns the ``active`` fits with enough pixels."""
        wanted = np.maximum(BAND_PX, BAND_BLURS * self.blur[active])
        moved = np.abs(self.centre[active] - self.selected[active]).max(1)
        anew = (moved > RESELECT_PX) | (np.abs(wanted / self.band[active] - 1) > RESELECT_BAND)
        chosen = active[anew]
        self.band[chosen], self.selected[chosen] = wanted[anew], self.centre[chosen]
        for i in chosen.tolist():
            self.rows[i], self.columns[i] = self._near_rim(i)
        self._widen(max(map(len, self.rows), default=0))
        for i in chosen.tolist():
            self._take(i)
        self.unlevelled[chosen] = True
        few = np.array([len(self.rows[i]) < MIN_PIXELS for i in active], bool)
        self.failed[active[few]] = True
        return active[~few]

    def _near_rim(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns rows and columns, in its box, of the pixels within the band around a rim, without intruders."""
        (dx, dy), inverse = self.offset[i], (self.inverse_shape[i] @ self.jacobian[i]).astype(np.float32)
        centre = np.linalg.solve(self.jacobian[i], self.centre[i] - self.start[i])
        x, y = dx - np.float32(centre[0]), dy[:, None] - np.float32(centre[1])
        a, b = inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y
        square = a * a + b * b
        slope_x, slope_y = inverse[0, 0] * a + inverse[1, 0] * b, inverse[0, 1] * a + inverse[1, 1] * b
        near = (square - np.sqrt(square)) ** 2 < (slope_x**2 + slope_y**2) * np.float32(self.band[i] ** 2)
        for place, shape in self.intruders[i]:
            x, y = dx - np.float32(place[0]), dy[:, None] - np.float32(place[1])
            near &= (shape[0, 0] * x + shape[0, 1] * y) ** 2 + (shape[1, 0] * x + shape[1, 1] * y) ** 2 > 1
        rows, columns = np.divmod(np.flatnonzero(near), near.shape[1])
        return rows, columns

    def _widen(self, m: int):
        """Makes room for ``m`` pixels of each ellipse."""
        more = m - self.grey.shape[1]
        if more > 0:
            for name in ("grey", "real", "weight", "residual", "reduced", "ideal", "on_unit", "scores"):
                array = getattr(self, name)
                setattr(self, name, np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, more)]))
            self.ideal[:, 0, -more:] = self.radius[:, None]  # not in the middle, where nothing has a direction

    def _take(self, i: int):
        """Stores grey values and ideal coordinates of one ellipse's pixels."""
        rows, columns = self.rows[i], self.columns[i]
        n = len(rows)
        dx, dy = self.offset[i]
        x, y = dx[columns] / np.float32(self.half[i, 0]), dy[rows] / np.float32(self.half[i, 1])
        self.grey[i, :n] = self.image[rows + self.low[i, 1], columns + self.low[i, 0]]
        self.ideal[i, :, :n] = self.to_ideal[i, :, 1:].astype(np.float32) @ monomials(x, y)[1:]
        self.ideal[i, :, n:] = [[self.radius[i]], [0]]
        self.real[i], self.weight[i] = np.arange(self.real.shape[1]) < n, self.real[i]

    def _step(self, active, robust: bool, waves: tuple[bool, ...] = ()) -> np.ndarray:
        """Makes one Gauss–Newton step; returns moves of the centres, NaN if failed; ``waves``: True for inside."""
        if not len(active):
            return np.zeros(0)
        selection = slice(None) if len(active) == len(self.blur) else active
        grey, real, start = self.grey[selection], self.real[selection], self.start[selection]
        inverse_shape = self.inverse_shape[selection].astype(np.float32)
        blur = self.blur[selection].astype(np.float32)[:, None]
        offset = self.ideal[selection] - (self.centre[selection] - start).astype(np.float32)[..., None]
        on_unit = inverse_shape @ offset
        (p, q), (a, b) = np.moveaxis(offset, 1, 0), np.moveaxis(on_unit, 1, 0)
        rho = np.sqrt(a * a + b * b)
        gradient = inverse_shape @ on_unit
        slope_rho = np.sqrt(gradient[:, 0] ** 2 + gradient[:, 1] ** 2)
        reduced = (rho - 1) * rho / (slope_rho * blur)
        bell = np.exp(np.maximum(-0.5 * reduced * reduced, np.float32(-18)))  # products of smaller ones are denormal
        inside = _normal_above(reduced, bell)
        x, y = np.moveaxis(offset / self.radius[selection].astype(np.float32)[:, None, None], 1, 0)
        count, per_side = PARAMETERS + 2 * len(WAVES) * len(waves), 2 * len(WAVES)
        jacobian = np.empty((len(active), count, rho.shape[1]), np.float32)
        planes = jacobian[:, 6:]
        planes[:, 0], planes[:, 1], planes[:, 2] = 1, x, y
        planes[:, 3], planes[:, 4], planes[:, 5] = inside, inside * x, inside * y
        # A slope that is blurred with its disc: of x D, blurred by G of variance s², there is x (D∗G) + s² ∂(D∗G)/∂x.
        radius = self.radius[selection].astype(np.float32)[:, None]
        edge = bell * blur / (slope_rho * np.float32(np.sqrt(2 * np.pi)) * radius)
        planes[:, 4:6] -= edge[:, None] * gradient
        angle = np.arctan2(b, a)[:, None] * np.array(WAVES if waves else (), np.float32)[:, None]
        around = np.concatenate([np.cos(angle), np.sin(angle)], 1)  # harmonics around the rim
        for k, within in enumerate(waves):
            planes[:, 6 + k * per_side : 6 + (k + 1) * per_side] = around * (inside if within else 1 - inside)[:, None]
        levels = self.levels[selection, : count - 6]
        if (unlevelled := self.unlevelled[selection]).any():
            these, levels = slice(None) if unlevelled.all() else unlevelled, levels.copy()
            levels[these] = _levels(planes[these], self.weight[selection][these], grey[these])
            self.unlevelled[selection] = False
        amplitude = levels[:, 3:4] + levels[:, 4:5] * x + levels[:, 5:6] * y
        for k, within in enumerate(waves):
            varies = (levels[:, None, 6 + k * per_side : 6 + (k + 1) * per_side] @ around)[:, 0]
            amplitude = amplitude + varies if within else amplitude - varies
        # d(distance)/d(rho) = rho/slope_rho; the change of the slope itself is of second order on the rim.
        density = amplitude * bell / (np.float32(np.sqrt(2 * np.pi)) * blur)
        push = density / slope_rho
        jacobian[:, :2] = push[:, None] * gradient
        push_a, push_b = -push * a, -push * b
        jacobian[:, 2], jacobian[:, 3], jacobian[:, 4] = push_a * p, push_a * q + push_b * p, push_b * q
        jacobian[:, 5] = density * reduced
        residual = (grey - (levels[:, None] @ planes)[:, 0]) * real
        weight = _weights(residual, inside, real) if robust else real
        weighted = jacobian * weight[:, None]
        inverse = _inverses((weighted @ np.swapaxes(jacobian, 1, 2)).astype(float))
        step = (inverse @ (weighted @ residual[..., None]))[..., 0]
        self.scores[selection, :count], self.inverse[selection, :count, :count] = weighted, inverse
        self.residual[selection], self.weight[selection] = residual, weight
        self.reduced[selection], self.on_unit[selection] = reduced, on_unit
        return self._apply(active, step, levels)

    def _apply(self, active, step, levels) -> np.ndarray:
        turn = np.stack([step[:, 2:4], step[:, 3:5]], 1)
        matrix = self.inverse_shape[active] + turn
        (xx, xy), (_, yy) = np.moveaxis(matrix, 0, 2)
        good = np.isfinite(step).all(1) & (xx * yy > xy * xy) & (xx + yy > 0)
        own, step = active[good], step[good]
        self.inverse_shape[own] = matrix[good]
        self.centre[own] += step[:, :2]
        blur = self.blur[own]
        self.blur[own] = np.clip(blur + np.clip(step[:, 5], -0.4 * blur, 0.6 * blur), *BLUR_LIMITS_PX)
        self.levels[own, : levels.shape[1]] = levels[good] + step[:, 6:]
        move = np.full(len(active), np.nan)
        move[good] = np.abs(step[:, :2]).max(1)
        return move


def _normal_above(x: np.ndarray, bell: np.ndarray) -> np.ndarray:
    """Normal distribution above ``x``, to 3e-7 (Abramowitz and Stegun 1964, 7.1.26), six times faster than SciPy."""
    t = 1 / (1 + np.float32(0.3275911 / np.sqrt(2)) * np.abs(x))
    tail = np.float32(1.061405429 / 2) * t
    for c in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail += np.float32(c / 2)
        tail *= t
    tail *= bell
    return np.where(x < 0, 1 - tail, tail)


def _levels(planes: np.ndarray, weight: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Returns the brightness of the planes, (n, k), by linear least squares; NaN if they are not determined."""
    weighted = planes * weight[:, None]
    normal = (weighted @ np.swapaxes(planes, 1, 2)).astype(float)
    normal[:, *np.diag_indices(normal.shape[1])] *= 1 + 1e-9
    return (_inverses(normal) @ (weighted @ grey[..., None]))[..., 0]


def _inverses(normal: np.ndarray) -> np.ndarray:
    """Returns the inverses of normal matrices (n, k, k), computed with unit diagonals; NaN for singular ones."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    scale = scale[:, :, None] * scale[:, None]
    try:
        return np.linalg.inv(normal * scale) * scale
    except np.linalg.LinAlgError:
        if len(normal) == 1:
            return np.full_like(normal, np.nan)
        return np.concatenate([_inverses(each[None]) for each in normal])


def _weights(residual: np.ndarray, inside: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Returns the weights of the pixels: equal except for outliers, judged by the residuals' spread on the edge."""
    edge = (inside > 0.08) & (inside < 0.92) & (real > 0)
    edge |= ~edge.any(1, keepdims=True) & (real > 0)
    sigma = np.maximum(robust_sigmas(np.abs(residual), edge), MIN_SIGMA)
    return real / (1 + (residual / (ROBUST_WIDTH * sigma).astype(np.float32)[:, None]) ** 2) ** 2


MIN_NOISE2 = 1e-12
"""Noise variance, in squared grey values, that counts as no noise."""
CHANCE_WAVES = 3
"""Number of odd harmonics around the rim, from the third on, that stand for the first; higher ones are too short."""
MAX_CHANCE = 4.2
"""Largest ratio of one circle's squares to the median, exceeded by chance by one in a thousand (χ² of six freedoms)."""
SHARP_PX, SHARP = 1.5, 0.33
"""Blur, in pixels and in smaller radii, from which on the response of the fit to a shift is computed from the image."""


def correlation(chance: np.ndarray) -> float:
    """Returns the factor by which correlation between pixels enlarges covariances; 1 without circles. ``chance``: (n,)
    as :func:`_chance` gives it; ν/(ν−2) keeps expected squares over variances at one (F distribution)."""
    freedom = 2 * CHANCE_WAVES * len(chance)
    if not freedom:
        return 1.0
    return float(np.minimum(chance, MAX_CHANCE * np.median(chance)).mean()) * freedom / (freedom - 2)


def covariances(fits: Fits) -> tuple[np.ndarray, np.ndarray]:
    """Returns covariances of the centres, (n, 2, 2), for independent pixels, and :func:`_chance` over their noise. It
    is S·H·Sᵀ, with H the inverse of the normal equations, and S⁻¹ the share of a shift of the image that one step
    responds with (Huber 1981, sec. 6.3)."""
    pull = fits.scores[:, 0] ** 2 + fits.scores[:, 1] ** 2
    weight = np.where(fits.real > 0, fits.weight, 1)
    share = pull / weight
    total = share.sum(1, dtype=float)
    noise2 = np.maximum((pull * fits.residual**2).sum(1, dtype=float) / total, MIN_NOISE2)
    # ψ' over the weight of Geman–McClure, not below zero, where it would reward outliers.
    influence = np.maximum(4 * np.sqrt(weight) - 3, 0)
    chance = _chance(fits, np.sqrt(share / weight), total) / noise2
    spread = (pull.sum(1, dtype=float) / (pull * influence).sum(1, dtype=float))[:, None, None] * np.eye(2)
    narrowest = 1 / singular_values(fits.inverse_shape)[0]
    wide = (fits.blur >= np.minimum(SHARP_PX, SHARP * narrowest)) & ~fits.failed
    for i in np.flatnonzero(wide).tolist():
        n = len(fits.rows[i])
        slope = _exact_slope(fits, i, fits.scores[i, :2, :n] / weight[i, :n]) - _residual_slope(fits, i)
        answer = (fits.inverse[i, :2] @ fits.scores[i, :, :n]) * influence[i, :n]
        spread[i] = np.linalg.inv(answer @ slope.T)
    covariance = spread @ fits.inverse[:, :2, :2] @ np.swapaxes(spread, 1, 2)
    return noise2[:, None, None] * covariance, np.where(noise2 > MIN_NOISE2, chance, 1.0)


def _chance(fits: Fits, edge: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Returns a pixel's variance from :data:`CHANCE_WAVES` harmonics (orthonormal series, Phillips 2005) along the rim.
    ``edge``: amplitudes of the harmonics at the pixels; ``total``: their weighted squares."""
    wave = np.empty(edge.shape, np.complex64)
    wave.real, wave.imag = np.moveaxis(fits.direction(), 1, 0)
    double, wave = wave * wave, wave * edge
    waves = np.empty((len(edge), 2 * CHANCE_WAVES, edge.shape[1]), np.float32)
    for k in range(CHANCE_WAVES):
        wave *= double
        waves[:, 2 * k], waves[:, 2 * k + 1] = wave.real, wave.imag
    taken = (waves @ np.swapaxes(fits.scores, 1, 2)).astype(float)
    left = CHANCE_WAVES * total - (taken @ fits.inverse * taken).sum((1, 2))
    found = waves @ (fits.weight * fits.residual)[..., None]
    return (found**2).sum((1, 2)) / left


def _exact_slope(fits: Fits, i: int, slope: np.ndarray) -> np.ndarray:
    """Returns derivatives by the centre, (2, pixels): ``slope`` of the step, and the change of the distance's slope."""
    on_unit, reduced = fits.on_unit[i, :, : slope.shape[1]], fits.reduced[i, : slope.shape[1]]
    inverse_shape = fits.inverse_shape[i].astype(np.float32)
    rho = np.maximum(np.hypot(*on_unit), np.float32(CUSP))
    steepness = np.maximum(np.hypot(*(inverse_shape @ on_unit)), np.float32(CUSP / fits.radius[i]))
    turn = np.float32(fits.blur[i]) * inverse_shape @ inverse_shape
    return (2 - 1 / rho) * slope - reduced / steepness * (turn @ slope)


def _residual_slope(fits: Fits, i: int) -> np.ndarray:
    """Returns the gradient of one circle's residuals, (2, pixels); zero if a neighbour is not in the band."""
    rows, columns = fits.rows[i], fits.columns[i]
    patch = np.full((fits.high[i] - fits.low[i])[::-1], np.nan, np.float32)
    patch[rows, columns] = fits.residual[i, : len(rows)]
    slope = np.zeros((2, *patch.shape), np.float32)
    slope[0, :, 1:-1] = patch[:, 2:] - patch[:, :-2]
    slope[1, 1:-1] = patch[2:] - patch[:-2]
    by_pixel = np.nan_to_num(slope[:, rows, columns]) / 2
    return np.linalg.inv(fits.jacobian[i]).T.astype(np.float32) @ by_pixel


PIXELS_AT_ONCE = 30_000
"""Number of pixels of ellipses that are fitted side by side: their derivatives, 1.5 MB, stay in a core's cache."""
SECTORS = 16
MIN_RIM = 0.8
"""Smallest share of the rim's sectors that follow the model. With less, the circle is partly hidden or cut off."""
MAX_RIM_RESIDUAL = 0.15  # largest RMS residual of a sector that follows the model, as a fraction of the contrast
UNTRUSTED = 0.2  # largest share of the shift by uneven brightness that the correction leaves, which is added to σ


def measure_centres(
    image: np.ndarray,
    camera: Camera,
    ellipses: Ellipses,
    neighbours: Ellipses,
    groups: np.ndarray | None = None,
) -> Centres:
    """Measures ``ellipses`` in a grey image of 8 or 16 bits. ``neighbours``: all candidates; pixels of near ones are
    excluded. ``groups``: (n,) patterns, whose circles share the factor for correlation; None: one pattern."""
    focal = float(np.sqrt(camera.focal.prod()))
    rims = _fitted(image, camera, ellipses, neighbours)
    centre, uneven, chance = rims.pop("centre") / focal, rims.pop("uneven") / focal, rims.pop("chance")
    groups, ok = np.zeros(len(ellipses), int) if groups is None else groups, rims["rim"] >= MIN_RIM
    factor = np.array([correlation(chance[ok & (groups == i)]) for i in range(groups.max(initial=0) + 1)])
    covariance = factor[groups, None, None] * rims.pop("covariance") / focal**2
    covariance += UNTRUSTED**2 * uneven[:, :, None] * uneven[:, None, :]
    distorted, jacobian = camera.distort_jacobian(centre)
    jacobian = jacobian * camera.focal[:, None]
    covariance_px2 = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    # Far beyond any lens, as with k1 = 1e9, rounding leaves negative variances.
    ok &= (np.diagonal(covariance_px2, axis1=1, axis2=2) > 0).all(1)
    rims |= {"shape": rims["shape"] / focal, "uneven_px": (jacobian @ uneven[..., None])[..., 0]}
    centre_px = distorted * camera.focal + camera.centre
    return Centres(centre_px=centre_px, centre=centre, covariance_px2=covariance_px2, ok=ok, **rims)


def _fitted(image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses) -> dict[str, np.ndarray]:
    """Fits circles of similar size side by side, as many as a processor's cache holds pixels; as :func:`_rims`."""
    size = ellipses.radius_px()
    order = np.argsort(size, kind="stable")
    pixels = np.cumsum(2 * np.pi * size[order] * 2 * BAND_PX)
    parts = [
        _rims(Fits(image, camera, ellipses.select(own), neighbours))
        for own in np.split(order, np.flatnonzero(np.diff(pixels // PIXELS_AT_ONCE)) + 1)
    ]
    return {name: np.concatenate([part[name] for part in parts])[np.argsort(order)] for name in parts[0]}


def _rims(fits: Fits) -> dict[str, np.ndarray]:
    """Returns n ellipses by the names of :class:`Centres`, ideal px; 0 as contrast and rim where a fit failed."""
    n = len(fits.blur)
    near = (np.abs(fits.reduced) * fits.blur[:, None] < np.maximum(1.5, fits.blur)[:, None]) & (fits.real > 0)
    angle = np.arctan2(fits.on_unit[:, 1][near], fits.on_unit[:, 0][near])
    sector = (angle * (SECTORS / (2 * np.pi))).astype(int) % SECTORS + SECTORS * np.nonzero(near)[0]
    total = np.bincount(sector, minlength=n * SECTORS).reshape(n, SECTORS)
    square = np.bincount(sector, fits.residual[near] ** 2, minlength=n * SECTORS).reshape(n, SECTORS)
    contrast = fits.levels[:, 3].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):  # for failed fits
        noise = robust_sigmas(np.abs(fits.residual), fits.real > 0)
        rim = (square <= ((MAX_RIM_RESIDUAL * contrast) ** 2 + (2 * noise) ** 2)[:, None] * total).mean(1)
        covariance, chance = covariances(fits)
        domes = fits.domes()
    ok = ~fits.failed
    one, all_of = ok[:, None], ok[:, None, None]
    numbers = {"chance": chance, "blur_px": fits.blur, "contrast": contrast, "noise": noise, "rim": rim}
    return {name: np.where(ok, value, 0.0) for name, value in numbers.items()} | {
        "centre": np.where(one, fits.centre, fits.start),
        "shape": np.where(all_of, np.linalg.inv(fits.inverse_shape), fits.radius[:, None, None] * np.eye(2)),
        "covariance": np.where(all_of, covariance, np.eye(2)),
        "uneven": np.where(one, fits.uneven, 0.0),
        "domes": np.where(one & np.isfinite(domes), domes, 0.0),
    }
