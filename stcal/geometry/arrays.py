"""Read-only arrays of a checked shape, for the fields of the package's frozen dataclasses."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache, wraps
from inspect import signature
from numbers import Integral, Real
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from stcal.errors import InputError

Shape = tuple[int | None, ...]

LONGEST = 100  # number of characters up to which the repr of a value stands in that of a result
MYPY = False
"""True to mypy, by its name: it knows no descriptors in frozen dataclasses, so that fields are arrays to it."""

if TYPE_CHECKING and not MYPY:

    class Array:
        """Type of a dataclass field that accepts any array-like and holds the read-only array of :func:`freeze`.

        To pyright it is a descriptor: the constructor accepts lists and tuples of numbers, reading returns an
        ``np.ndarray``. At run time, and to mypy, it is ``np.ndarray``. Only for fields; an optional one is
        ``np.ndarray | None``.
        """

        def __get__(self, instance: object, owner: Any) -> np.ndarray: ...
        def __set__(self, instance: object, value: ArrayLike) -> None: ...

else:
    Array = np.ndarray  # pyright: ignore[reportAssignmentType]  # to mypy, and at run time


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
    """Base of results, made with ``@dataclass(eq=False, repr=False)``, that show plain values, notes, and the size of
    everything else in one line."""

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
    """Refuse a value that is not of its type, by the rule and the hint of it."""
    if known is None or known[0][0](value):
        return
    words, hint = known[0][1], known[1]
    if any(get_origin(part) is Literal for part in (hint, *get_args(hint))):
        words = words.removesuffix(" or None")
        raise InputError("E-OPTION-VALUE", f"{what}: {name} {_brief(value)}: not a choice; use {words}")
    raise InputError("E-FIELD-TYPE", f"{what}: {name} {_brief(value)}: {words} needed")


@lru_cache
def _rules(kind: type) -> dict[str, tuple[Rule, Any]]:
    """Return the rules and hints of a dataclass's fields."""
    hints = get_type_hints(kind)
    ends = {
        each.name: isinstance(each.default, float) and math.isinf(each.default) for each in fields(kind) if each.init
    }
    return {name: (rule, hints[name]) for name, end in ends.items() if (rule := _rule(hints[name], end))}


def require_fields(instance: object, what: str, **least: float) -> None:
    """Refuse values of a dataclass that are not of their field's type; to be called in ``__post_init__``.

    Numbers must be finite, and at least ``least`` by field. Arrays are left to :func:`freeze`.
    """
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
    values: ArrayLike,
    shape: Shape | None = None,
    what: str = "array",
    dtype: DTypeLike = float,
    finite: bool = True,
) -> np.ndarray:
    """Return a read-only copy of values of a shape, in which ``None`` admits any length; ``what`` : their name in
    messages; ``finite`` : whether NaN is refused, which else stands for what is not known."""
    if type(values) is np.ndarray and values.dtype == dtype:
        array = values if values.base is None and not values.flags.writeable else values.copy()
    else:
        array = _as_array(values, shape, what, dtype)
    if shape not in (None, array.shape) and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError("E-ARRAY-SHAPE", f"{what}: shape {array.shape}, {shape} needed")
    # three times as fast as all() on few numbers
    if finite and array.dtype.kind == "f" and b"\0" in np.isfinite(array).tobytes():
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
        raise InputError(
            "E-ARRAY-SHAPE", f"{what}: rows of different lengths; {shape or 'equal ones'} needed"
        ) from error
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


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt((values**2).mean()))
