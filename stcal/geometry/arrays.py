"""Read-only arrays of a checked shape, for the fields of the package's frozen dataclasses."""

from dataclasses import fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from stcal.errors import InputError

Shape = tuple[int | None, ...]

LONGEST = 100
"""Number of characters up to which the ``repr`` of a value stands in that of a result."""
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


class Brief:
    """Base of results with many values, made with ``@dataclass(repr=False)``: their ``repr`` is one short line, with
    plain values as they are and of all else how much there is of it."""

    __slots__ = ()

    def __repr__(self) -> str:
        values = ((field.name, getattr(self, field.name)) for field in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(f'{name}={_brief(value)}' for name, value in values)})"


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"<array {'×'.join(map(str, value.shape))}>" if value.size > 1 else str(value)
    if isinstance(value, dict | list | tuple | set | frozenset):
        return f"<{len(value)}>"
    text = repr(value)
    return text if len(text) <= LONGEST else f"<{type(value).__name__}>"


@lru_cache
def _choices(kind: type) -> dict[str, tuple]:
    """Return the words that a dataclass's fields of a Literal type admit, by field; None among them if optional."""
    found = {}
    for name, hint in get_type_hints(kind).items():
        parts = get_args(hint) if get_origin(hint) in (Union, type(int | str)) else (hint,)
        words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
        if words:
            found[name] = (*words, *([None] if type(None) in parts else []))
    return found


def require_choices(instance: object, what: str) -> None:
    """Refuse words in fields of a dataclass that their Literal types do not list; to be called in ``__post_init__``.

    Raises
    ------
    InputError
        The message begins with ``what`` and names the field and its choices.
    """
    for name, words in _choices(type(instance)).items():
        value = getattr(instance, name)
        if not any(value is word or (isinstance(value, str) and value == word) for word in words):
            listed = " or ".join(str(word) for word in words if word is not None)
            raise InputError("E-OPTION-VALUE", f"{what}: {name} {value!r}: not a choice; use {listed}")


def frozen(values: ArrayLike, shape: Shape | None = None, what: str = "array", dtype: DTypeLike = float) -> np.ndarray:
    """Return a read-only copy.

    Parameters
    ----------
    values : array-like
    shape : tuple of int or None, optional
        Required shape; ``None`` in it admits any length. If it is not given, any shape is accepted.
    what : str
        Name of the values in messages.
    dtype : data type

    Returns
    -------
    array of ``shape``

    Raises
    ------
    InputError
        If the shape differs, or a float array holds a value that is not finite.
    """
    array = np.array(values, dtype=dtype)
    if shape not in (None, array.shape) and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError("E-ARRAY-SHAPE", f"{what}: shape {array.shape}, {shape} needed")
    if array.dtype.kind == "f" and b"\0" in np.isfinite(array).tobytes():  # three times as fast as all() on few numbers
        raise InputError("E-ARRAY-NOT-FINITE", f"{what}: holds values that are not finite")
    array.flags.writeable = False
    return array


def freeze(
    instance: object, field: str, shape: Shape | None = None, what: str = "array", dtype: DTypeLike = float
) -> None:
    """Replace a field of a frozen dataclass by its read-only copy; to be called in ``__post_init__``.

    Parameters
    ----------
    instance : dataclass instance
    field : str
        Name of the field.
    shape, what, dtype :
        See :func:`frozen`.

    Raises
    ------
    InputError
        As :func:`frozen`.
    """
    object.__setattr__(instance, field, frozen(getattr(instance, field), shape, what, dtype))
