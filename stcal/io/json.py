"""Result files: pydantic models that define every key, its type and its meaning, written and read as JSON.

A file holds the keys that the model was given, in the order of the fields. A key that was not given is left out; a key
that was given as None is null. Arrays and poses are lists of numbers in the file.
"""

import json
from collections.abc import Collection
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import PydanticCustomError, core_schema

from stcal.errors import InputError
from stcal.geometry.arrays import OF_POINT, OF_POSE, CovarianceRows, frozen, require_covariance
from stcal.geometry.rigid import Rigid
from stcal.io.files import TABLE_BYTES, json_text, read_bytes, require_same, require_unchanged, text_of

LONGEST = 80  # largest number of characters of a value that a message shows
WITHOUT_VALUE = "without value"
"""Type of a mistake whose message omits the value: the first numbers of a matrix, for example, are no help."""


def mistake(reason: object) -> PydanticCustomError:
    """Return an error for a validator to raise; its message is ``reason``, without the value."""
    return PydanticCustomError(WITHOUT_VALUE, "{reason}", {"reason": str(reason)})


def first_mistake(
    error: ValidationError, where: str = "", missing: str = "key missing; add it", top: Collection[str] = ()
) -> InputError:
    """Return the error that names the first mistake, ``where: place: reason``, and the number of further mistakes;
    ``missing`` : reason for a missing key; ``top`` : keys before the first table, which belong to it after its head."""
    first = error.errors()[0]
    keys = [part for part in first["loc"] if not str(part).startswith("<")]  # not which kind of entry it was taken for
    place = ".".join(str(part + 1 if isinstance(part, int) else part) for part in keys)
    place = " ".join(place.split())  # a quoted TOML key may hold a line break
    if first["type"] == "extra_forbidden":
        code, reason = "E-KEY-UNKNOWN", "unknown key; remove it or correct its spelling"
        if len(keys) > 1 and keys[-1] in top:
            reason = "unknown key in this table; move it to the top of the file, before the first [table]"
    elif first["type"] == "missing":
        code, reason = "E-KEY-MISSING", missing
    elif first["type"] == WITHOUT_VALUE:
        code, reason = "E-KEY-VALUE", first["msg"]
    elif first["type"] == "string_pattern_mismatch":
        name = first["input"][:LONGEST]
        code, reason = "E-KEY-NAME", f"{name!r}: spaces, colons, commas, slashes and line breaks are not allowed"
    else:
        shown = " ".join(repr(first["input"]).split())
        shown = shown if len(shown) <= LONGEST else shown[: LONGEST - 1] + "…"
        said = first["msg"].removeprefix("Value error, ")
        code, reason = "E-KEY-VALUE", f"{shown}: {said[0].lower()}{said[1:]}"
    unknown = [
        " ".join(str(other["loc"][-1]).split())[:LONGEST]
        for other in (error.errors()[1:] if code == "E-KEY-MISSING" else ())
        if other["type"] == "extra_forbidden" and other["loc"][:-1] == first["loc"][:-1]
    ]
    if unknown:
        reason += f"; unknown key {', '.join(unknown)} in its place, perhaps misspelt"
    more = error.error_count() - 1 - len(unknown)
    suffix = f" (and {more} more)" if more else ""
    return InputError(code, ": ".join(part for part in (where, place, reason + suffix) if part))


class Part(BaseModel):
    """An object inside a result file; ``from_attributes`` : a dataclass with the same fields is accepted, too."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        from_attributes=True,
        validate_by_name=True,
        serialize_by_alias=True,
        arbitrary_types_allowed=True,
    )


class ResultFile(Part):
    """A whole result file; the field ``format`` of a model holds name and version of its format."""

    def content(self) -> dict[str, Any]:
        """Return the content as plain values: the keys that were given, in the order of the fields."""
        return self.model_dump(exclude_unset=True, warnings=False)


class NamedReason(Part):
    """The name of something that was left out, and the reason."""

    name: str
    reason: str


F = TypeVar("F", bound=Part)


@dataclass(frozen=True, slots=True)
class Shape:
    """An array with sides of these lengths, None for any length: nested lists in the file, float64 in Python."""

    sides: tuple[int | None, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        plain = core_schema.plain_serializer_function_ser_schema(np.ndarray.tolist)
        return core_schema.no_info_plain_validator_function(self.checked, serialization=plain)

    def checked(self, value: Any) -> np.ndarray:
        try:
            return frozen(value, self.sides, "array")
        except (InputError, ValueError, TypeError) as error:
            reason = str(error).removeprefix("array: ")
            raise PydanticCustomError("array", "{reason}", {"reason": reason}) from error

    def words(self) -> str:
        """Return the shape in words, for the tables of the documentation."""
        if len(self.sides) == 1:
            return "list of numbers" if self.sides[0] is None else f"{self.sides[0]} numbers"
        return "×".join("n" if n is None else str(n) for n in self.sides)


@dataclass(frozen=True, slots=True)
class PoseShape(Shape):
    """A rigid transform: 4×4 in the file; a :class:`Rigid` is accepted, too."""

    def checked(self, value: Any) -> np.ndarray:
        if isinstance(value, Rigid):
            return value.matrix()
        try:
            Rigid.from_matrix(value)
        except (InputError, ValueError, TypeError) as error:
            raise PydanticCustomError("pose", "{reason}", {"reason": str(error)}) from error
        return Shape.checked(self, value)


@dataclass(frozen=True, slots=True)
class CovarianceShape(Shape):
    """A covariance: positive semi-definite up to rounding; ``rows`` : names and variances of its rows."""

    rows: CovarianceRows

    def checked(self, value: Any) -> np.ndarray:
        try:
            matrix = frozen(value)
            require_covariance(matrix, self.sides[0] or len(matrix), self.rows)
        except (InputError, ValueError, TypeError) as error:
            raise mistake(str(error).removeprefix("array: ")) from error
        return matrix


@dataclass(frozen=True, slots=True)
class Named:
    """An object of a file that holds attributes of a result: those named, in words, or all fields of a dataclass.
    ``a.b`` is the attribute b of a, in an object of its own; methods are called. ``model: Annotated[Result,
    Named()]``."""

    names: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(Named(self.names or _names(source)).checked)

    def checked(self, value: Any) -> dict[str, Any]:
        """Return the object as plain values; a dict is one already."""
        if isinstance(value, dict):
            if value.keys() != {name.partition(".")[0] for name in self.names.split()}:
                raise mistake(f"an object with {self.names} needed")
            return value
        found: dict[str, Any] = {}
        for name in self.names.split():
            place, held, (*above, last) = found, value, name.split(".")
            for part in above:
                place, held = place.setdefault(part, {}), getattr(held, part)
            place[last] = _plain(getattr(held, last))
        return found


def _names(kind: Any) -> str:
    return getattr(kind, "KEYS", "") or " ".join(each.name for each in fields(kind))


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: transforms and arrays as lists, null for numbers that are not finite."""
    if callable(value):
        return _plain(value())
    if hasattr(value, "matrix"):
        return value.matrix().tolist()
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if is_dataclass(value):
        return Named(_names(type(value))).checked(value)
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple | range):
        return [_plain(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


Finite = Annotated[
    float | None, BeforeValidator(lambda value: None if value is None or not np.isfinite(value) else value)
]
"""A number, or null in place of infinity and NaN, which JSON lacks."""
Pose = Annotated[np.ndarray, PoseShape((4, 4))]
Matrix3 = Annotated[np.ndarray, Shape((3, 3))]
Matrix4 = Annotated[np.ndarray, Shape((4, 4))]
Matrix6 = Annotated[np.ndarray, Shape((6, 6))]
TransformMatrix = Annotated[Matrix4, BeforeValidator(lambda made: made.matrix() if hasattr(made, "matrix") else made)]
Rows = Annotated[list[int], BeforeValidator(lambda rows: np.asarray(rows, int).tolist())]
"""Numbers of rows, from 0."""
PointCovariance = Annotated[np.ndarray, CovarianceShape((3, 3), OF_POINT)]
PoseCovariance = Annotated[np.ndarray, CovarianceShape((6, 6), OF_POSE)]
Matrix = Annotated[np.ndarray, Shape((None, None))]
Points = Annotated[np.ndarray, Shape((None, 3))]
Vector = Annotated[np.ndarray, Shape((None,))]
Vector3 = Annotated[np.ndarray, Shape((3,))]
Pair = Annotated[np.ndarray, Shape((2,))]
ByFace = Annotated[str, "face"]
ByLabel = Annotated[str, "label"]
ByGroup = Annotated[str, "group"]
ByImage = Annotated[str, "image"]
ByName = Annotated[str, "name"]
"""Types of the keys of objects; the documentation shows the word, as in ``faces.<face>``."""


def read_json(path: str | Path, what: str, remedy: str) -> dict[str, Any]:
    """Return the object in a JSON file; messages name the kind of file, ``what``, and the ``remedy``."""
    where = f"{what} {path}".lstrip()
    try:
        content = json.loads(text_of(read_bytes(path, TABLE_BYTES)))
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; {remedy}") from error
    except (ValueError, RecursionError) as error:  # not UTF-8, a NUL in the name, a number of 5000 digits, deep nesting
        reason = " ".join(str(error).split())[:100]
        raise InputError("E-JSON-INVALID", f"{where}: not JSON ({reason}); {remedy}") from error
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise InputError("E-JSON-CONTENT", f"{where}: a {kind}, an object with named keys needed; {remedy}")
    return content


def checked(content: dict[str, Any], model: type[F]) -> F:
    """Return the content of a file as a ``model``; keys that the model does not know are ignored."""
    try:
        return model.model_validate(content, extra="ignore")
    except ValidationError as error:
        key = error.errors()[0]["loc"][-1:]
        raise first_mistake(error, missing=f"no {str(*key)!r}") from error


def read_result(path: str | Path, model: type[F], what: str, remedy: str) -> F:
    """Read a result file; errors are those of :func:`read_json`, :func:`checked` and :func:`require_unchanged`."""
    content = read_json(path, what, remedy)
    try:
        result = checked(content, model)
    except InputError as error:
        raise InputError(error.code, f"{what} {path}: {error}; {remedy}") from error
    require_unchanged(path)
    return result


def require_result_written(path: str | Path, content: ResultFile) -> None:
    """Read a written result file again, and require the same content."""
    again = partial(read_result, path, type(content), "result file", "report this with its data")
    require_same(path, lambda: json.loads(json_text(again())), json.loads(json_text(content)))
