"""Read-only arrays of a checked shape, for the fields of frozen dataclasses; and the only check of covariances from
outside."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache, wraps
from inspect import signature
from numbers import Integral, Real
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from stcal.errors import InputError

Shape = tuple[int | None, ...]
MOST_KEPT = 512  # number of results that a function keeps
LONGEST = 100  # number of characters up to which the repr of a value stands in that of a result

if TYPE_CHECKING:

    class Array:
        """Type of a dataclass field that accepts any array-like and holds the read-only array of :func:`freeze`. To
        checkers of types it is a descriptor: the constructor accepts lists and tuples of numbers, reading returns an
        ``np.ndarray``. At run time it is ``np.ndarray``. Only for fields; an optional one is ``np.ndarray | None``."""

        def __get__(self, instance: object, owner: Any) -> np.ndarray: ...
        def __set__(self, instance: object, value: ArrayLike) -> None: ...

else:
    Array = np.ndarray


class ByValue:
    """Equality of dataclasses whose numbers are the same to the last bit, also after a copy or a pickle."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return _same(self, other) if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        values = [getattr(self, entry.name) for entry in fields(self)]  # type: ignore[arg-type]
        numbers = [float(np.nansum(part)) if isinstance(part, np.ndarray) else part for part in values]
        known = (part for part in numbers if isinstance(part, str | int | float) and part == part)
        return hash((type(self).__name__, *known))


def _same(one: Any, two: Any) -> bool:
    """Return True if two values are equal, arrays by their values; NaN, which stands for what is not known, is NaN."""
    if one is two:
        return True
    if isinstance(one, np.ndarray) or isinstance(two, np.ndarray):
        return np.array_equal(one, two, equal_nan=np.asarray(one).dtype.kind == "f")
    if type(one) is not type(two):
        return one == two
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(_same, one, two))
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(_same(each, two[name]) for name, each in one.items())
    if is_dataclass(one):
        return all(_same(getattr(one, entry.name), getattr(two, entry.name)) for entry in fields(one))
    return bool(one == two or (one != one and two != two))


class Brief(ByValue):
    """Base of results (``@dataclass(eq=False, repr=False)``) that show values, notes, and sizes in one line."""

    __slots__ = ()

    def __repr__(self) -> str:
        values = ((field.name, getattr(self, field.name)) for field in fields(self))  # type: ignore[arg-type]
        shown = (f"{name}={list(value) if name in TOLD and value else _brief(value)}" for name, value in values)
        return f"{type(self).__name__}({', '.join(shown)})"


TOLD = {"notes", "doubts"}  # fields whose sentences a repr has in full


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"<array {'×'.join(map(str, value.shape))}>" if value.size > 1 else str(value)
    if isinstance(value, dict | list | tuple | set | frozenset):
        return f"<{len(value)}>"
    text = repr(value)
    return text if len(text) <= LONGEST else f"<{type(value).__name__}>"


Rule = tuple[Callable[[Any], bool], str]  # whether a value is of a type, and the type in words
P = ParamSpec("P")
R = TypeVar("R")


def _rule(hint: Any, may_be_infinite: bool = False) -> Rule | None:
    """Return the rule of a type; None for arrays, which :func:`freeze` judges, and for functions."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return (lambda v: any(v is w or (isinstance(v, str) and v == w) for w in parts)), " or ".join(map(str, parts))
    if origin in (Union, UnionType):
        rules = [_rule(part, may_be_infinite) for part in parts]
        known = [rule for rule in rules if rule]
        words = " or ".join(rule[1] for rule in known)
        return None if len(known) < len(rules) else ((lambda v: any(admits(v) for admits, _ in known)), words)
    if origin in (tuple, list, Sequence) and parts:
        count = None if origin is not tuple or Ellipsis in parts else len(parts)
        each = [_rule(part) or (lambda _: True, "value") for part in parts if part is not Ellipsis]
        words = f"a tuple, each {each[0][1]}," if count is None else f"a tuple of {', '.join(r[1] for r in each)}"

        def admits(value: object) -> bool:
            if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str):
                return False
            return count in (None, len(value)) and all(each[i % len(each)][0](v) for i, v in enumerate(value))

        return admits, words
    if origin in (dict, Mapping):
        (is_key, key), (is_value, value) = (_rule(part) or (lambda _: True, "value") for part in parts)
        words = f"a mapping from {key} to {value}"
        return (lambda v: isinstance(v, Mapping) and all(is_key(k) and is_value(w) for k, w in v.items())), words
    if hint in PLAIN:
        return PLAIN[hint]
    if hint is float:
        is_ok = (lambda v: v == v) if may_be_infinite else math.isfinite
        return (lambda v: isinstance(v, Real) and not isinstance(v, bool) and is_ok(v)), "a finite number"
    if not isinstance(hint, type) or hint is np.ndarray or hint is Any:
        return None
    return (lambda v: isinstance(v, hint)), f"a {hint.__name__}"


PLAIN: dict[Any, Rule] = {
    type(None): (lambda v: v is None, "None"),
    bool: (lambda v: isinstance(v, bool | np.bool_), "True or False"),
    int: (lambda v: isinstance(v, Integral) and not isinstance(v, bool), "a whole number"),
    str: (lambda v: isinstance(v, str), "a text"),
}


def _require(what: str, name: str, value: object, known: tuple[Rule, Any] | None) -> None:
    if known is None or known[0][0](value):
        return
    words, hint = known[0][1], known[1]
    if any(get_origin(part) is Literal for part in (hint, *get_args(hint))):
        words = words.removesuffix(" or None")
        raise InputError("E-OPTION-VALUE", f"{what}: {name} {_brief(value)}: not a choice; use {words}")
    raise InputError("E-FIELD-TYPE", f"{what}: {name} {_brief(value)}: {words} needed")


@lru_cache
def _rules(kind: type) -> dict[str, tuple[Rule, Any]]:
    hints = get_type_hints(kind)
    ends = {e.name: isinstance(e.default, float) and math.isinf(e.default) for e in fields(kind) if e.init}
    return {name: (rule, hints[name]) for name, end in ends.items() if (rule := _rule(hints[name], end))}


def require_fields(instance: object, what: str, **least: float) -> None:
    """Refuse values of a dataclass that are not of their field's type; to be called in ``__post_init__``. Numbers
    must be finite, and at least ``least`` by field. Arrays are left to :func:`freeze`."""
    for name, known in _rules(type(instance)).items():
        value = getattr(instance, name)
        _require(what, name, value, known)
        if name in least and value is not None and value < least[name]:
            raise InputError("E-OPTION-RANGE", f"{what}: {name} {value:g}: {least[name]:g} or more needed")


def require_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, which then refuses arguments that are not of their annotated type, as fields are refused."""
    bind = signature(function).bind

    @lru_cache
    def rules() -> dict[str, tuple[Rule, Any]]:
        return {name: (rule, hint) for name, hint in get_type_hints(function).items() if (rule := _rule(hint))}

    @wraps(function)
    def judged(*args: P.args, **kwargs: P.kwargs) -> R:
        for name, value in bind(*args, **kwargs).arguments.items():
            _require_unmasked(value, f"{function.__name__}: {name}")
            _require(function.__name__, name, value, rules().get(name))
        return function(*args, **kwargs)

    return judged


def _require_unmasked(value: object, what: str) -> None:
    """Refuse masked entries, whose values NumPy's functions would take."""
    if np.ma.isMaskedArray(value) and (masked := int(np.ma.count_masked(value))):
        raise InputError("E-ARRAY-NOT-FINITE", f"{what}: {masked} values are masked; leave out their rows")


def _holds_text(values: object) -> bool:
    return isinstance(values, str) or (isinstance(values, list | tuple) and any(map(_holds_text, values)))


def frozen(
    values: ArrayLike, shape: Shape | None = None, what: str = "array", dtype: DTypeLike = float, finite: bool = True
) -> np.ndarray:
    """Return a read-only copy of values of a shape, in which ``None`` admits any length; ``what`` : their name in
    messages; ``finite`` : whether NaN is refused, which else stands for what is not known."""
    if type(values) is np.ndarray and values.dtype == dtype:
        array = values if values.base is None and not values.flags.writeable else values.copy()
    else:
        array = _as_array(values, shape, what, dtype)
    if (
        shape is not None
        and shape != array.shape
        and (array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)))
    ):
        raise InputError("E-ARRAY-SHAPE", f"{what}: shape {array.shape}, {shape} needed")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError("E-ARRAY-NOT-FINITE", f"{what}: holds values that are not finite")
    array.flags.writeable = False
    return array


def _as_array(values: ArrayLike, shape: Shape | None, what: str, dtype: DTypeLike) -> np.ndarray:
    _require_unmasked(values, what)
    if dtype is not object and _holds_text(values):  # numpy would make all values as long as the longest text
        raise InputError("E-ARRAY-TYPE", f"{what}: text among the values; real numbers needed")
    try:
        array = np.array(values)
    except ValueError as error:
        raise InputError("E-ARRAY-SHAPE", f"{what}: rows of different lengths; {shape or 'equal'} needed") from error
    if array.dtype.kind not in "biuf" and dtype is not object and array.size:
        raise InputError("E-ARRAY-TYPE", f"{what}: {array.dtype} values; real numbers needed")
    if array.dtype.kind == "f" and np.dtype(dtype).kind in "iu" and (array != np.rint(array)).any():
        raise InputError("E-ARRAY-TYPE", f"{what}: fractions; whole numbers needed")
    return array.astype(dtype, copy=False)


def freeze(
    instance: object, field: str, shape: Shape | None = None, what: str = "array", dtype: DTypeLike = float
) -> None:
    """Replace a field of a frozen dataclass by its read-only copy, in ``__post_init__``; see :func:`frozen`."""
    object.__setattr__(instance, field, frozen(getattr(instance, field), shape, what, dtype))


def kept(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, which then keeps results by the content of its arguments, arrays among them."""
    known: dict[tuple, R] = {}

    @wraps(function)
    def with_arrays(*given: P.args, **more: P.kwargs) -> R:
        content = tuple(
            (each.tobytes(), each.dtype.str, each.shape) if isinstance(each, np.ndarray) else each
            for each in (*given, *more, *more.values())
        )
        with suppress(KeyError):
            return known[content]
        if len(known) >= MOST_KEPT:
            known.clear()
        result = known[content] = function(*given, **more)
        return result

    return with_arrays


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt((values**2).mean()))


ROUNDING = 1e-5
"""Tolerance of a correlation per row of its matrix: files state six digits, so that 1.00000 may be off by 5e-6."""
LARGEST = 1e24
"""Largest variance in any unit: a σ of 1e12 exceeds anything that is measured."""
TINY = 1e-300  # value that replaces a variance of zero, to avoid division by zero


@dataclass(frozen=True, slots=True)
class CovarianceRows:
    """The rows of a covariance: ``names``; ``nothing`` : variance of each row that counts as zero (rounding)."""

    names: tuple[str, ...]
    nothing: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, names: Iterable[str], axes: str) -> "CovarianceRows":
        """Return the rows for the coordinates, in mm, of several named points."""
        return cls(tuple(f"{axis} of {name}" for name in names for axis in axes), NANOMETRE)


TWIST = ("rx", "ry", "rz", "x", "y", "z")
"""Rows of the covariance of a pose: rotation vector (rad) and translation (mm), left perturbation."""
NANOMETRE = 1e-12  # square of a nanometre in mm²
NANORADIAN = 1e-18
"""Square of a nanoradian in rad²: a point at a distance of a metre moves by a nanometre."""
OF_POSE = CovarianceRows(TWIST, (*[NANORADIAN] * 3, *[NANOMETRE] * 3))
OF_POINT = CovarianceRows(("x", "y", "z"), NANOMETRE)
OF_PIXEL = CovarianceRows(("x", "y"))


@dataclass(frozen=True, slots=True)
class Fault:
    """An invalid covariance. ``row`` : index of the matrix, from 0; ``reason`` : measured and needed values."""

    row: int
    reason: str


def first_fault(matrices: np.ndarray, rows: CovarianceRows, definite: bool = False) -> Fault | None:
    """Return the fault of the first of m matrices (m, n, n) that is no covariance, None if all are. A covariance is
    finite, symmetric and without negative eigenvalues of its correlations, up to rounding; without any that are not
    positive if it will be inverted, ``definite``."""
    size = matrices.shape[-1]
    nothing = np.zeros(size) if definite else np.resize(rows.nothing, size)
    variance = np.diagonal(matrices, axis1=1, axis2=2) + nothing
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.maximum(variance, TINY))
        scales = scale[:, :, None] * scale[:, None, :]
        correlation = (matrices + np.diag(nothing)) / scales
        odd = np.abs(matrices - np.swapaxes(matrices, 1, 2)) - np.sqrt(np.outer(nothing, nothing))
        odd /= scales
        usable = (variance >= 0) & (variance <= LARGEST) & (odd <= ROUNDING * size).all(axis=2)
    usable = usable.all(axis=1) & np.isfinite(matrices).all(axis=(1, 2)) & np.isfinite(correlation).all(axis=(1, 2))
    lowest = np.full(len(matrices), -np.inf)
    lowest[usable] = np.linalg.eigvalsh(correlation[usable])[:, 0]
    bad = np.flatnonzero(~(lowest > 0 if definite else lowest >= -ROUNDING * size))
    if not len(bad):
        return None
    row = int(bad[0])
    suffix = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    reason = _reason(matrices[row], variance[row], odd[row], correlation[row], float(lowest[row]), rows, definite)
    return Fault(row, reason + suffix)


def require_covariance(matrix: np.ndarray, size: int, rows: CovarianceRows, definite: bool = False) -> None:
    """Refuse a matrix that is not a covariance of ``size`` rows; see :func:`first_fault`."""
    if matrix.shape != (size, size):
        shape = "×".join(map(str, matrix.shape)) or "one number"
        raise InputError("E-COVARIANCE-SHAPE", f"{shape}, {size}×{size} needed")
    if fault := first_fault(matrix[None], rows, definite):
        raise InputError("E-COVARIANCE-VALUE", fault.reason)


def _reason(matrix, variance, odd, correlation, lowest: float, rows: CovarianceRows, definite: bool) -> str:
    """Return why one matrix is not a covariance; ``odd`` : asymmetry of its correlations."""
    needed, below = "a positive number" if definite else "0 or more", variance <= 0 if definite else variance < 0
    if not np.isfinite(matrix).all():
        return "a value is not finite, finite numbers needed"
    if below.any() or variance.max() > LARGEST:
        k = int(np.argmax(below if below.any() else variance))
        needed = needed if below.any() else f"up to {LARGEST:g}"
        return f"variance {matrix[k, k]:.3g} of {rows.names[k]}, {needed} needed"
    if odd.max() > ROUNDING * len(matrix):
        i, j = np.unravel_index(int(np.argmax(odd)), odd.shape)
        share = abs(matrix[i, j] - matrix[j, i]) / max(abs(matrix[i, j]), abs(matrix[j, i]))
        return f"not symmetric by {round(100 * share, 1):g} % at {rows.names[i]}, {rows.names[j]}"
    off = np.abs(correlation - np.diag(np.diagonal(correlation)))
    i, j = np.unravel_index(int(np.argmax(off)), off.shape)
    if off[i, j] > 1 + ROUNDING * len(matrix):
        return f"correlation {correlation[i, j]:.6g} of {rows.names[i]} and {rows.names[j]}, −1 to 1 needed"
    return f"its correlations have the eigenvalue {lowest:.3g}, {needed} needed"
