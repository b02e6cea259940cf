"""Pages of the keys of all result files, made from their pydantic models: one page for each system.

Every field with a description is a row; a field of an object inside the file that has none must be named by the row
that holds it.
"""

import re
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from stcal.io.json import Named, Part, ResultFile, Shape

PACKAGE = Path(__file__).resolve().parents[2] / "stcal"
WORDS = {str: "string", int: "integer", float: "number", bool: "true or false", type(None): "null", Any: "any"}
LINK = re.compile(r"\[([^\]]+)\]\([^)]+\)")


def models() -> dict[str, list[type[ResultFile]]]:
    """Returns the models of result files by the package of their system, in the order of modules and lines."""
    found: dict[str, list[type[ResultFile]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        if "ResultFile):" in path.read_text(encoding="utf-8"):
            module = import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
            own = [each for each in vars(module).values() if getattr(each, "__module__", "") == module.__name__]
            system = path.relative_to(PACKAGE).parts[0]
            found.setdefault(system, []).extend(e for e in own if isinstance(e, type) and issubclass(e, ResultFile))
    return found


def pages() -> Iterator[tuple[str, str]]:
    """Yields (name, text) of the page of each system, and of their list."""
    rows = ["# Keys of result files", "", "Made from the program. Units are mm, px and rad.", ""]
    for system, own in models().items():
        text = [f"# Result files of `stcal.{system}`", ""]
        for model in own:
            title = model.__name__.removesuffix("File")
            text += [f"## {title}", "", " ".join((model.__doc__ or "").replace("``", "`").split()), "", table(model)]
        yield system, "\n".join(text)
        rows += [f"- [{system}]({system}.md): {', '.join(each.__name__.removesuffix('File') for each in own)}"]
    yield "index", "\n".join(rows) + "\n"


def table(model: type[Part]) -> str:
    """All rows with a heading."""
    rows = [f"| `{key}` | {kind} | {meaning} |" for key, kind, meaning in rows_of(model)]
    return "\n".join(["| key | type | meaning |", "|---|---|---|", *rows, ""])


def rows_of(model: type[Part], above: str = "", said: str | None = None) -> Iterator[tuple[str, str, str]]:
    """(key, type, meaning) of each field; ``said`` : what the row of the object that holds them says."""
    for name, field in model.model_fields.items():
        key = f"{above}{field.alias or name}"
        annotation = Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
        within, suffix = inner(annotation)
        if field.description:
            kind = words(annotation)
            if not field.is_required():  # absent, not null
                kind = kind.removesuffix(" or null")
            yield f"{key}{suffix}" if within else key, kind, LINK.sub(r"\1", field.description)
        elif said is None or f"`{field.alias or name}`" not in said:
            raise ValueError(f"{model.__name__}.{name}: neither a description, nor named by the object that holds it")
        holder = field.description or said or ""
        if within and issubclass(within, Part):
            yield from rows_of(within, f"{key}{suffix}.", holder)
        elif within and not all(f"`{each}`" in holder for each in names_of(annotation, within)):
            raise ValueError(f"{model.__name__}.{name}: does not name every field of {within.__name__}")


def names_of(annotation: Any, within: type) -> list[str]:
    """The keys of an object: those that its annotation names, or all fields of its dataclass."""
    own = get_args(annotation)
    if get_origin(annotation) is Annotated:
        named = " ".join(each.names for each in own[1:] if isinstance(each, Named))
        return [part for name in named.split() for part in name.split(".")] or names_of(own[0], within)
    of_parts = [names_of(each, within) for each in own if inner(each)[0] is within]
    return of_parts[0] if of_parts else [each.name for each in fields(within)]


def inner(annotation: Any) -> tuple[type | None, str]:
    """Model or dataclass of the objects in a field, if any, and how their place is written: ``[]`` or ``.<face>``."""
    origin, own = get_origin(annotation), get_args(annotation)
    if isinstance(annotation, type) and (issubclass(annotation, Part) or is_dataclass(annotation)):
        return annotation, ""
    if origin is Annotated:
        return (object, "") if own[0] is Any and any(isinstance(each, Named) for each in own) else inner(own[0])
    if origin in (Union, types.UnionType):
        return next((found for each in own if (found := inner(each))[0]), (None, ""))
    if origin in (list, tuple):
        found, suffix = inner(own[0])
        return found, f"[]{suffix}"
    if origin is dict:
        found, suffix = inner(own[1])
        return found, f".<{words(own[0])}>{suffix}"
    return None, ""


def words(annotation: Any) -> str:
    """A type as the documents call it."""
    origin, own = get_origin(annotation), get_args(annotation)
    if origin is Annotated and any(isinstance(each, Named) for each in own):
        return "object"
    if origin is Annotated:
        shape = next((each for each in own[1:] if isinstance(each, Shape)), None)
        name = next((each for each in own[1:] if isinstance(each, str)), None)
        return shape.words() if shape else name or words(own[0])
    if origin is Literal:
        return " or ".join(f'`"{each}"`' if isinstance(each, str) else f"`{each}`" for each in own)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(words(each) for each in own if not (each is int and float in own)))
    if origin in (list, tuple):
        return "objects" if inner(own[0])[0] else f"list of {words(own[0])}"
    if origin is dict:
        return "object" if inner(own[1])[0] or own[1] is Any else f"{words(own[0])} → {words(own[1])}"
    if inner(annotation)[0]:
        return "object"
    return WORDS[annotation]
