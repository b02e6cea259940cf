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
of a pattern share that factor; each has its own noise.

Planes do not follow a circle of which one half is darker, or with an edge beside it: the centre then moves by up to
0.2 px without any residual that a rim's share would show. The third harmonic of the residuals around the rim does show
it (the first is the planes', even ones move no centre), inside and outside apart; where it is significant the fit goes
on with brightness that varies around the rim, at the price of a larger σ.
"""

from dataclasses import dataclass, fields

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.robust import robust_sigmas
from stcal.sfm.data.centres import Centres
from stcal.sfm.detect.ellipses import Ellipses

PIXELS_AT_ONCE = 30_000
"""Of the ellipses that are fitted side by side: their derivatives are 1.5 MB, which stay in a core's cache."""
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


def measure_centres(
    image: np.ndarray,
    camera: Camera,
    ellipses: Ellipses,
    neighbours: Ellipses,
    groups: np.ndarray | None = None,
) -> Centres:
    """Measure ``ellipses`` in a grey image of any depth.

    Parameters
    ----------
    image : (height, width) array, uint8 or uint16
    ellipses : what to measure
    neighbours : all candidates of the image; pixels of those that come near are left out
    groups : (n,) numbers of the patterns that they belong to, whose circles share the factor for what correlates the
        pixels; one pattern where None
    """
    focal = float(np.sqrt(camera.focal.prod()))
    found = _fitted(image, camera, ellipses, neighbours)
    centre, uneven = found.centre / focal, found.uneven / focal
    groups, ok = np.zeros(len(ellipses), int) if groups is None else groups, found.rim >= MIN_RIM
    factor = np.array([_correlation(found.chance[ok & (groups == i)]) for i in range(groups.max(initial=0) + 1)])
    covariance = factor[groups, None, None] * found.covariance / focal**2
    covariance += UNTRUSTED**2 * uneven[:, :, None] * uneven[:, None, :]
    distorted, jacobian = camera.distort_jacobian(centre)
    jacobian = jacobian * camera.focal[:, None]
    return Centres(
        centre_px=distorted * camera.focal + camera.centre,
        centre=centre,
        shape=found.shape / focal,
        covariance_px2=jacobian @ covariance @ np.swapaxes(jacobian, 1, 2),
        blur_px=found.blur,
        contrast=found.contrast,
        noise=found.noise,
        rim=found.rim,
        uneven_px=(jacobian @ uneven[..., None])[..., 0],
        ok=ok,
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
    found = np.empty((10, *x.shape), x.dtype)
    found[0], found[1], found[2] = 1, x, y
    found[3], found[4], found[5] = x * x, x * y, y * y
    found[6], found[7], found[8], found[9] = found[3] * x, found[3] * y, x * found[5], found[5] * y
    return found


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
class _Rims:
    """n fitted ellipses, ideal px: ``centre`` (n, 2), ``shape`` and ``covariance`` (n, 2, 2) as if pixels were
    independent, ``chance`` (n,), and what :class:`Centres` says; of no contrast and no rim where the fit failed."""

    centre: np.ndarray
    shape: np.ndarray
    covariance: np.ndarray
    chance: np.ndarray
    blur: np.ndarray
    contrast: np.ndarray
    noise: np.ndarray
    rim: np.ndarray
    uneven: np.ndarray

    @classmethod
    def joined(cls, parts: list["_Rims"], order: np.ndarray) -> "_Rims":
        """Row k of the parts, one behind the other, in place ``order[k]``."""
        place = np.argsort(order)
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts])[place] for f in fields(cls)))


def _fitted(image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses) -> _Rims:
    """Fit circles of like size side by side, as many as a processor's cache holds the pixels of."""
    half = 1.25 * np.sqrt((ellipses.shape_px**2).sum(2)) + 3 * BAND_PX
    to_ideal = _local_ideal_maps(camera, ellipses.centre_px, half)
    masks = _intruders(ellipses, neighbours, half)
    size = ellipses.radius_px()
    order = np.argsort(size, kind="stable")
    pixels = np.cumsum(2 * np.pi * size[order] * 2 * BAND_PX)
    ends = np.flatnonzero(np.diff(pixels // PIXELS_AT_ONCE)) + 1
    parts = [
        _Fits(image, ellipses.select(own), half[own], to_ideal[own], [masks[i] for i in own]).result()
        for own in np.split(order, ends)
    ]
    return _Rims.joined(parts, order)


class _Fits:
    """The fits of n blurred ellipses side by side, ideal px.

    Pixels are rows of (n, …, m) arrays of single precision, which is enough as coordinates are taken from the start of
    each centre; ``real`` is 1 where a pixel is, 0 behind the last one of an ellipse.
    """

    def __init__(self, image, ellipses: Ellipses, half, to_ideal, intruders):
        n, lay = len(ellipses), ellipses.centre_px
        self.image, self.place, self.half, self.to_ideal, self.intruders = image, lay, half, to_ideal, intruders
        self.low = np.maximum(np.floor(lay - half).astype(int), 0)
        self.high = np.minimum(np.ceil(lay + half).astype(int) + 1, image.shape[::-1])
        self.from_place = [_offsets(*each) for each in zip(self.low, self.high, lay, strict=True)]
        self.jacobian = to_ideal[:, :, 1:3] / half[:, None]
        m = self.jacobian @ ellipses.shape_px
        value, vector = np.linalg.eigh(m @ np.swapaxes(m, 1, 2))
        self.inverse_shape = (vector / np.sqrt(value)[:, None]) @ np.swapaxes(vector, 1, 2)
        self.start = self.centre = self.selected = to_ideal[:, :, 0]
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
        """Mask of those whose step was one and stayed near the start; the others have failed."""
        away = np.linalg.norm(self.centre[active] - self.start[active], axis=1)
        holds = np.isfinite(move) & (away <= MAX_SHIFT * self.radius[active] + 1)
        self.failed[active[~holds]] = True
        return holds

    def _follow_waves(self):
        """Go on with brightness that varies around the rim on the sides, inside or outside, where it does."""
        inside, outside = (self._is_uneven(side) & ~self.failed for side in (True, False))
        if not (inside | outside).any():
            return
        more = (0, 4 * len(WAVES))
        self.scores = np.pad(self.scores, ((0, 0), more, (0, 0)))
        self.inverse = np.pad(self.inverse, ((0, 0), more, more))
        before = self.centre
        self.unlevelled |= inside | outside
        for waves, own in (
            ((True, False), inside & outside),
            ((True,), inside & ~outside),
            ((False,), outside & ~inside),
        ):
            active = np.flatnonzero(own)
            for _ in range(WAVE_STEPS):
                move = self._step(active, robust=True, waves=waves)
                active = active[self._holds(active, move) & (move >= CONVERGED_PX)]
        self.uneven = np.where((inside | outside)[:, None], before - self.centre, 0.0)

    def _is_uneven(self, inside: bool) -> np.ndarray:
        """Whether the residuals' third harmonic around the rim, on one side of it, is significant and matters; (n,)."""
        own = ((-self.reduced if inside else self.reduced) > 1.0) & (self.weight > 0.5)
        many = own.sum(1) >= MIN_PIXELS
        c, s = np.moveaxis(self._direction(), 1, 0)
        basis = np.stack([c * (4 * c * c - 3), s * (3 - 4 * s * s)], 1) * own[:, None]
        gram = (basis @ np.swapaxes(basis, 1, 2)).astype(float)
        gram[~many] = np.eye(2)
        found = (basis @ self.residual[..., None]).astype(float)
        amplitude = np.linalg.solve(gram, found)
        sigma = np.maximum(robust_sigmas(np.abs(self.residual), own), MIN_SIGMA)
        chi2 = (amplitude * found).sum((1, 2)) / sigma**2
        matters = np.hypot(*amplitude[..., 0].T) > UNEVEN * np.abs(self.levels[:, 3])
        return many & (chi2 > UNEVEN_CHI2) & matters

    def _direction(self) -> np.ndarray:
        """Cosine and sine of each pixel's angle on the unit circle, (n, 2, m)."""
        square = (self.on_unit**2).sum(1, keepdims=True)
        return self.on_unit / np.maximum(np.sqrt(square), np.float32(CUSP))

    def _lay_bands(self, active) -> np.ndarray:
        """Choose the pixels anew where centre or blur have changed; those of ``active`` that have enough."""
        wanted = np.maximum(BAND_PX, BAND_BLURS * self.blur[active])
        moved = np.abs(self.centre[active] - self.selected[active]).max(1)
        anew = (moved > RESELECT_PX) | (np.abs(wanted / self.band[active] - 1) > RESELECT_BAND)
        if not anew.any():
            return active
        chosen = active[anew]
        self.band[chosen] = wanted[anew]
        self.selected = np.where(np.isin(np.arange(len(self.blur)), chosen)[:, None], self.centre, self.selected)
        for i in chosen.tolist():
            self.rows[i], self.columns[i] = self._near_rim(i)
        self._widen(max(map(len, self.rows)))
        for i in chosen.tolist():
            self._take(i)
        self.unlevelled[chosen] = True
        few = np.array([len(self.rows[i]) < MIN_PIXELS for i in active])
        self.failed[active[few]] = True
        return active[~few]

    def _near_rim(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns, in its box, of the pixels within the band around one rim, less those of intruders."""
        dx, dy = self.from_place[i]
        (ia, ib), (ic, id_) = (self.inverse_shape[i] @ self.jacobian[i]).astype(np.float32)
        shift = np.linalg.solve(self.jacobian[i], self.centre[i] - self.start[i]).astype(np.float32)
        x, y = dx - shift[0], dy - shift[1]
        vx, vy = ia * x + ib * y, ic * x + id_ * y
        square = vx * vx + vy * vy
        gx, gy = ia * vx + ic * vy, ib * vx + id_ * vy
        gx *= gx
        gy *= gy
        gx += gy
        gx *= np.float32(self.band[i] ** 2)
        square -= np.sqrt(square)
        square *= square
        chosen = square < gx
        for place, shape in self.intruders[i]:
            ex = dx + np.float32(self.place[i, 0] - place[0])
            ey = dy + np.float32(self.place[i, 1] - place[1])
            chosen &= (shape[0, 0] * ex + shape[0, 1] * ey) ** 2 + (shape[1, 0] * ex + shape[1, 1] * ey) ** 2 > 1
        rows, columns = np.divmod(np.flatnonzero(chosen), chosen.shape[1])
        return rows, columns

    def _widen(self, m: int):
        """Make room for ``m`` pixels of each ellipse."""
        more = m - self.grey.shape[1]
        if more > 0:
            for name in ("grey", "real", "weight", "residual", "reduced", "ideal", "on_unit", "scores"):
                array = getattr(self, name)
                setattr(self, name, np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, more)]))
            self.ideal[:, 0, -more:] = self.radius[:, None]  # not in the middle, where nothing has a direction

    def _take(self, i: int):
        """Grey values and ideal coordinates of one ellipse's pixels."""
        rows, columns = self.rows[i], self.columns[i]
        n = len(rows)
        dx, dy = self.from_place[i]
        x, y = dx[columns] / np.float32(self.half[i, 0]), dy[rows, 0] / np.float32(self.half[i, 1])
        (left, top), (right, bottom) = self.low[i], self.high[i]
        self.grey[i, :n] = self.image[top:bottom, left:right][rows, columns]
        self.ideal[i, :, :n] = self.to_ideal[i, :, 1:].astype(np.float32) @ _monomials(x, y)[1:]
        self.ideal[i, :, n:] = [[self.radius[i]], [0]]
        self.real[i], self.weight[i] = np.arange(self.real.shape[1]) < n, self.real[i]

    def _step(self, active, robust: bool, waves: tuple[bool, ...] = ()) -> np.ndarray:
        """One Gauss–Newton step over all parameters of ``active``; the moves of the centres, NaN where one breaks.

        ``waves`` : sides, inside the rim and outside, on which brightness varies around it.
        """
        if not len(active):
            return np.zeros(0)
        own = slice(None) if len(active) == len(self.blur) else active
        grey, real, start = self.grey[own], self.real[own], self.start[own]
        inverse_shape = self.inverse_shape[own].astype(np.float32)
        blur = self.blur[own].astype(np.float32)[:, None]
        offset = self.ideal[own] - (self.centre[own] - start).astype(np.float32)[..., None]
        on_unit = inverse_shape @ offset
        (p, q), (a, b) = np.moveaxis(offset, 1, 0), np.moveaxis(on_unit, 1, 0)
        rho = np.sqrt(a * a + b * b)
        gradient = inverse_shape @ on_unit
        slope_rho = np.sqrt(gradient[:, 0] ** 2 + gradient[:, 1] ** 2)
        reduced = (rho - 1) * rho / (slope_rho * blur)
        bell = np.exp(np.maximum(-0.5 * reduced * reduced, np.float32(-18)))  # products of smaller ones are denormal
        inside = _normal_above(reduced, bell)
        x, y = np.moveaxis(offset / self.radius[own].astype(np.float32)[:, None, None], 1, 0)
        count, each = PARAMETERS + 2 * len(WAVES) * len(waves), 2 * len(WAVES)
        jacobian = np.empty((len(active), count, rho.shape[1]), np.float32)
        planes = jacobian[:, 6:]
        planes[:, 0], planes[:, 1], planes[:, 2] = 1, x, y
        planes[:, 3], planes[:, 4], planes[:, 5] = inside, inside * x, inside * y
        around = _around(a, b) if waves else np.zeros((len(active), 0, rho.shape[1]), np.float32)
        for k, within in enumerate(waves):
            planes[:, 6 + k * each : 6 + (k + 1) * each] = around * (inside if within else 1 - inside)[:, None]
        levels = self.levels[own, : count - 6]
        if (unlevelled := self.unlevelled[own]).any():
            these, levels = slice(None) if unlevelled.all() else unlevelled, levels.copy()
            levels[these] = _levels(planes[these], self.weight[own][these], grey[these])
            self.unlevelled[own] = False
        amplitude = levels[:, 3:4] + levels[:, 4:5] * x + levels[:, 5:6] * y
        for k, within in enumerate(waves):
            varies = (levels[:, None, 6 + k * each : 6 + (k + 1) * each] @ around)[:, 0]
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
        if len(active) == len(self.blur) and count == self.scores.shape[1]:
            self.scores, self.inverse = weighted, inverse
        else:
            self.scores[own, :count], self.inverse[own, :count, :count] = weighted, inverse
        self.residual[own], self.weight[own] = residual, weight
        self.reduced[own], self.on_unit[own] = reduced, on_unit
        return self._apply(active, step, levels)

    def _apply(self, active, step, levels) -> np.ndarray:
        turn = np.stack([step[:, 2:4], step[:, 3:5]], 1)
        matrix = self.inverse_shape[active] + turn
        (xx, xy), (_, yy) = np.moveaxis(matrix, 0, 2)
        good = np.isfinite(step).all(1) & (xx * yy > xy * xy) & (xx + yy > 0)
        own, step = active[good], step[good]
        self.inverse_shape[own] = matrix[good]
        self.centre = self.centre.copy()
        self.centre[own] += step[:, :2]
        blur = self.blur[own]
        blur = blur + np.minimum(np.maximum(step[:, 5], -0.4 * blur), 0.6 * blur)
        self.blur[own] = np.minimum(np.maximum(blur, BLUR_LIMITS_PX[0]), BLUR_LIMITS_PX[1])
        self.levels[own, : levels.shape[1]] = levels[good] + step[:, 6:]
        move = np.full(len(active), np.nan)
        move[good] = np.abs(step[:, :2]).max(1)
        return move

    def _covariances(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the centres, (n, 2, 2), as if pixels were independent, and :meth:`_chance` over that noise.

        The noise is that of the pixels where the centre's weight is: errors sit on the edge more than beside it. The
        covariance is S·H·Sᵀ, H the inverse of the normal equations, S⁻¹ the share of a shift of the image that one step
        answers with (Huber 1981, sec. 6.3). The step's own derivatives would make that share 1; it is less by what the
        weights give away, and another where the edge is too wide for them, or not as the model has it.
        """
        pull = self.scores[:, 0] ** 2 + self.scores[:, 1] ** 2
        weight = np.where(self.real > 0, self.weight, 1)
        share = pull / weight
        total = share.sum(1, dtype=float)
        noise2 = np.maximum((pull * self.residual**2).sum(1, dtype=float) / total, MIN_NOISE2)
        # ψ' over the weight of Geman–McClure, not below zero, where it would reward outliers.
        influence = np.maximum(4 * np.sqrt(weight) - 3, 0)
        chance = self._chance(np.sqrt(share / weight), total) / noise2
        spread = (pull.sum(1, dtype=float) / (pull * influence).sum(1, dtype=float))[:, None, None] * np.eye(2)
        wide = (self.blur >= np.minimum(SHARP_PX, SHARP * self._narrowest())) & ~self.failed
        for i in np.flatnonzero(wide).tolist():
            n = len(self.rows[i])
            slope = self._exact_slope(i, self.scores[i, :2, :n] / weight[i, :n]) - self._residual_slope(i)
            answer = (self.inverse[i, :2] @ self.scores[i, :, :n]) * influence[i, :n]
            spread[i] = np.linalg.inv(answer @ slope.T)
        covariance = spread @ self.inverse[:, :2, :2] @ np.swapaxes(spread, 1, 2)
        return noise2[:, None, None] * covariance, np.where(noise2 > MIN_NOISE2, chance, 1.0)

    def _narrowest(self) -> np.ndarray:
        """The ellipses' smaller radii, px."""
        xx, xy, yy = self.inverse_shape[:, 0, 0], self.inverse_shape[:, 0, 1], self.inverse_shape[:, 1, 1]
        return 2 / (xx + yy + np.hypot(xx - yy, 2 * xy))

    def _exact_slope(self, i: int, slope: np.ndarray) -> np.ndarray:
        """Derivatives of one model by the centre, (2, pixels): the step's, ``slope``, and the change of the distance's
        own slope."""
        on_unit, reduced = self.on_unit[i, :, : slope.shape[1]], self.reduced[i, : slope.shape[1]]
        inverse_shape = self.inverse_shape[i].astype(np.float32)
        rho = np.maximum(np.hypot(*on_unit), np.float32(CUSP))
        steepness = np.maximum(np.hypot(*(inverse_shape @ on_unit)), np.float32(CUSP / self.radius[i]))
        turn = np.float32(self.blur[i]) * inverse_shape @ inverse_shape
        return (2 - 1 / rho) * slope - reduced / steepness * (turn @ slope)

    def _residual_slope(self, i: int) -> np.ndarray:
        """Derivatives of one residual by the place, (2, pixels); none where a neighbour is not in the band."""
        rows, columns = self.rows[i], self.columns[i]
        patch = np.full((self.high[i] - self.low[i])[::-1], np.nan, np.float32)
        patch[rows, columns] = self.residual[i, : len(rows)]
        slope = np.zeros((2, *patch.shape), np.float32)
        slope[0, :, 1:-1] = patch[:, 2:] - patch[:, :-2]
        slope[1, 1:-1] = patch[2:] - patch[:-2]
        by_pixel = np.nan_to_num(slope[:, rows, columns]) / 2
        return np.linalg.inv(self.jacobian[i]).T.astype(np.float32) @ by_pixel

    def _chance(self, edge: np.ndarray, total: np.ndarray) -> np.ndarray:
        """Variance of a pixel from the residuals' :data:`CHANCE_WAVES` on the rim, of amplitudes ``edge`` and weighted
        squares ``total``: an estimate from orthonormal series (Phillips 2005), less what the parameters took of these.
        """
        wave = np.empty(edge.shape, np.complex64)
        wave.real, wave.imag = np.moveaxis(self._direction(), 1, 0)
        double, wave = wave * wave, wave * edge
        waves = np.empty((len(edge), 2 * CHANCE_WAVES, edge.shape[1]), np.float32)
        for k in range(CHANCE_WAVES):
            wave *= double
            waves[:, 2 * k], waves[:, 2 * k + 1] = wave.real, wave.imag
        taken = (waves @ np.swapaxes(self.scores, 1, 2)).astype(float)
        left = CHANCE_WAVES * total - (taken @ self.inverse * taken).sum((1, 2))
        found = waves @ (self.weight * self.residual)[..., None]
        return (found**2).sum((1, 2)) / left

    def result(self) -> _Rims:
        """The fits."""
        n = len(self.blur)
        near = (np.abs(self.reduced) * self.blur[:, None] < np.maximum(1.5, self.blur)[:, None]) & (self.real > 0)
        angle = np.arctan2(self.on_unit[:, 1][near], self.on_unit[:, 0][near])
        sector = (angle * (SECTORS / (2 * np.pi))).astype(int) % SECTORS + SECTORS * np.nonzero(near)[0]
        total = np.bincount(sector, minlength=n * SECTORS).reshape(n, SECTORS)
        square = np.bincount(sector, self.residual[near] ** 2, minlength=n * SECTORS).reshape(n, SECTORS)
        contrast = self.levels[:, 3].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):  # of those that failed
            noise = robust_sigmas(np.abs(self.residual), self.real > 0)
            rim = (square <= ((MAX_RIM_RESIDUAL * contrast) ** 2 + (2 * noise) ** 2)[:, None] * total).mean(1)
            covariance, chance = self._covariances()
        ok = ~self.failed
        return _Rims(
            np.where(ok[:, None], self.centre, self.start),
            np.where(ok[:, None, None], np.linalg.inv(self.inverse_shape), self.radius[:, None, None] * np.eye(2)),
            np.where(ok[:, None, None], covariance, np.eye(2)),
            np.where(ok, chance, 0.0),
            np.where(ok, self.blur, 0.0),
            np.where(ok, contrast, 0.0),
            np.where(ok, noise, 0.0),
            np.where(ok, rim, 0.0),
            np.where(ok[:, None], self.uneven, 0.0),
        )


def _offsets(low: np.ndarray, high: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (w,) and rows (h, 1) of a box, px from ``place``."""
    x, y = ((np.arange(a, b) - c).astype(np.float32) for a, b, c in zip(low, high, place, strict=True))
    return x, y[:, None]


def _normal_above(x: np.ndarray, bell: np.ndarray) -> np.ndarray:
    """Share of a normal distribution above ``x``, to 3e-7, from ``bell``, exp(−x²/2) (Abramowitz and Stegun 1964,
    7.1.26): in single precision as good as SciPy's, in a sixth of its time."""
    t = 1 / (1 + np.float32(0.3275911 / np.sqrt(2)) * np.abs(x))
    tail = np.float32(1.061405429 / 2) * t
    for c in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail += np.float32(c / 2)
        tail *= t
    tail *= bell
    return np.where(x < 0, 1 - tail, tail)


def _around(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosines and sines around the rim, (n, 2 k, m)."""
    angle = np.arctan2(b, a)[:, None] * np.array(WAVES, np.float32)[:, None]
    return np.concatenate([np.cos(angle), np.sin(angle)], 1)


def _levels(planes: np.ndarray, weight: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Brightness of the planes, (n, k), by linear least squares; NaN where they cannot be told apart."""
    weighted = planes * weight[:, None]
    normal = (weighted @ np.swapaxes(planes, 1, 2)).astype(float)
    normal[:, *np.diag_indices(normal.shape[1])] *= 1 + 1e-9
    return (_inverses(normal) @ (weighted @ grey[..., None]))[..., 0]


def _inverses(normal: np.ndarray) -> np.ndarray:
    """Of normal equations (n, k, k), each scaled to a unit diagonal meanwhile; NaN where one has none."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    scale = scale[:, :, None] * scale[:, None]
    try:
        return np.linalg.inv(normal * scale) * scale
    except np.linalg.LinAlgError:
        if len(normal) == 1:
            return np.full_like(normal, np.nan)
        return np.concatenate([_inverses(each[None]) for each in normal])


def _weights(residual: np.ndarray, inside: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Weights of the pixels: equal but for outliers, which are judged by the spread on the edge itself.

    Weighting the darker side up by its lower noise was tried: the edge's own errors decide, and it gained nothing.
    """
    edge = (inside > 0.08) & (inside < 0.92) & (real > 0)
    edge |= ~edge.any(1, keepdims=True) & (real > 0)
    sigma = np.maximum(robust_sigmas(np.abs(residual), edge), MIN_SIGMA)
    return real / (1 + (residual / (ROBUST_WIDTH * sigma).astype(np.float32)[:, None]) ** 2) ** 2
