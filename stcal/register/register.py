"""Registration of two instruments from corresponding points: the calls in order; read this first."""

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.register.covariance import Noise, covariance_of, noise_of, sigma_within
from stcal.register.models import MODELS, Model, Transform, fit, squares
from stcal.register.result import Alternative, Registration
from stcal.register.robust import AS_GOOD, Fitted, alternative_fit, chance, robust_fit, turn_between
from stcal.register.search import FALSE_ALARMS

METHODS = ("robust", "least-squares")


def register(
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    *,
    model: str = "rigid",
    method: str = "robust",
    threshold_mm: float | None = None,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    seed: int = 0,
    folds: int = 6,
    allow_ambiguous: bool = False,
) -> Registration:
    """b_from_a from corresponding points of two frames, some of which may be wrong.

    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> xyz_a = rng.uniform(-100, 100, (40, 3))
    >>> xyz_b = xyz_a[:, [1, 2, 0]] + [1000, 0, 50] + rng.normal(0, 0.1, (40, 3))
    >>> xyz_b[7] += [3, 0, 0]
    >>> found = register(xyz_a, xyz_b)
    >>> found.outliers
    array([7])
    >>> found.b_from_a.translation.round(0)
    array([1000.,    0.,   50.])

    Parameters
    ----------
    xyz_a, xyz_b : (n, 3) arrays
        mm; row i of both is the same point.
    model : str
        ``rigid``, ``similarity`` or ``affine``.
    method : str
        ``robust`` or ``least-squares``.
    threshold_mm : float, optional
        Inliers are nearer than this; estimated from the data where not given.
    weights : (n,) array, optional
        ~ 1/σ², positive.
    covariances : (n, 3, 3) or (n,) array, optional
        Covariance, or variance per axis, of b − b_from_a a in frame b, mm².
    seed : int
        Of the random samples; the same seed gives the same answer.
    folds : int
        Of the cross-validation; 0 for none.
    allow_ambiguous : bool
        Give the transform of the more points where another one is about as good, instead of an error.

    Raises
    ------
    InputError
        Shapes, values or options that cannot be used; units or axes of the two frames that do not fit together.
    DegenerateError
        The points do not determine the model; none agree beyond chance; two transforms are about as good.
    """
    a, b, chosen, noise = _checked(xyz_a, xyz_b, model, method, threshold_mm, weights, covariances)
    if method == "least-squares":
        fitted = _least_squares(chosen, a, b, noise)
    else:
        fitted = robust_fit(chosen, a, b, noise, threshold_mm, seed)
        if chance(chosen, fitted, a, b) > np.log(FALSE_ALARMS) and len(a) > chosen.sample:
            raise DegenerateError(
                f"registration: {fitted.inliers.sum()} of {len(a)} point pairs agree to {fitted.sigma:.4g} mm, no better "
                "than chance; check that row i of both is the same point"
            )
    other = alternative_fit(chosen, fitted, a, b, noise, seed)
    alternative = None if other is None else _alternative(fitted.transform, other, a)
    ambiguous = alternative is not None and len(alternative.rows) >= AS_GOOD * fitted.inliers.sum()
    if ambiguous and not allow_ambiguous:
        raise DegenerateError(
            f"registration: {fitted.inliers.sum()} point pairs agree on one transform and {len(alternative.rows)} others "
            f"on another, {alternative.apart_mm:.4g} mm from it; register one group of rows alone, or allow ambiguous "
            "answers"
        )
    residuals = b - fitted.transform @ a
    length = np.linalg.norm(residuals[fitted.inliers], axis=1)
    covariance, scaled, dof = covariance_of(
        chosen, fitted.transform, a[fitted.inliers], noise[fitted.inliers], fitted.sigma, fitted.threshold
    )
    return Registration(
        model=model,
        method=method,
        b_from_a=fitted.transform,
        covariance=covariance,
        inliers=fitted.inliers,
        residuals=residuals,
        sigma_mm=fitted.sigma,
        dof=dof,
        threshold_mm=fitted.threshold,
        mean_mm=float(length.mean()),
        rms_mm=float(np.sqrt((length**2).mean())),
        max_mm=float(length.max()),
        sigma_factor=None if noise.sigma_mm is None else fitted.sigma / noise.sigma_mm,
        scaled=scaled,
        ambiguous=ambiguous,
        alternative=alternative,
        seed=seed,
        samples=fitted.samples,
    )


def _checked(
    xyz_a, xyz_b, model: str, method: str, threshold_mm, weights, covariances
) -> tuple[np.ndarray, np.ndarray, Model, Noise]:
    a, b = np.asarray(xyz_a, float), np.asarray(xyz_b, float)
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        raise InputError(f"registration: points of shapes {a.shape} and {b.shape}; (n, 3) twice needed")
    for name, xyz in (("a", a), ("b", b)):
        bad = np.flatnonzero(~np.isfinite(xyz).all(1))
        if len(bad):
            raise InputError(f"registration: row {bad[0] + 1} of {name} is not finite; remove it")
    if model not in MODELS:
        raise InputError(f"registration: model {model!r}; one of {', '.join(MODELS)} needed")
    if method not in METHODS:
        raise InputError(f"registration: method {method!r}; one of {', '.join(METHODS)} needed")
    if threshold_mm is not None and not (np.isfinite(threshold_mm) and threshold_mm > 0):
        raise InputError(f"registration: threshold {threshold_mm} mm; a positive number needed")
    chosen = MODELS[model]
    if len(a) < chosen.sample or chosen.freedom(len(a)) <= 0:
        needed = max(chosen.sample, chosen.parameters // 3 + 1)
        raise DegenerateError(f"registration: {len(a)} point pairs, {needed} needed for the {model} model")
    return a, b, chosen, noise_of(len(a), weights, covariances)


def _least_squares(model: Model, a: np.ndarray, b: np.ndarray, noise: Noise) -> Fitted:
    transform = fit(model, a, b, noise.precision)
    total = squares(b - transform @ a, noise.precision).sum()
    sigma = sigma_within(float(total), model, len(a), None)
    return Fitted(transform, np.ones(len(a), bool), sigma, None)


def _alternative(transform: Transform, other: Fitted, a: np.ndarray) -> Alternative:
    apart = np.sqrt(np.mean(((transform @ a - other.transform @ a) ** 2).sum(1)))
    return Alternative(
        other.transform, np.flatnonzero(other.inliers), float(apart), turn_between(transform, other.transform)
    )
