"""The tables of docs/reference/files/ for result files, made from their models.

.venv/bin/python scripts/data_layout.py [--check]

A table stands between the comments ``<!-- made by scripts/data_layout.py: Model -->`` and ``<!-- end -->``. Every field
with a description is a row; a field of an object inside the file that has none must be named by the row that holds it.
`--check` writes nothing, names the tables that differ, and exits with 1 where there are any.
"""

import argparse
import re
import sys
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from stcal.io.json import Part, Shape

FILES = Path(__file__).resolve().parents[1] / "docs" / "reference" / "files"
BLOCK = re.compile(r"(<!-- made by scripts/data_layout\.py: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
MODULES = (
    "stcal.sfm.adjust.file",
    "stcal.sfm.runs.marker",
    "stcal.sfm.runs.report",
    "stcal.sfm.measurement.report",
    "stcal.sfm.report.compare",
    "stcal.synthetic.dataset",
    "stcal.sfm.camera.file",
    "stcal.sfm.planning.file",
    "stcal.sfm.budget.file",
    "stcal.handeye.report.file",
    "stcal.handeye.plan",
    "stcal.register.file",
    "stcal.locate.exposures",
    "stcal.locate.page",
    "stcal.robot.axes.report",
    "stcal.robot.identification.report",
    "stcal.robot.use.evaluation",
    "stcal.robot.use.compensation",
    "stcal.robot.use.verification",
    "stcal.robot.use.design",
)
"""Where the models are."""
WORDS = {str: "string", int: "integer", float: "number", bool: "true or false", type(None): "null", Any: "any"}


def models() -> dict[str, type[Part]]:
    """By name."""
    found = {}
    for module in map(import_module, MODULES):
        for name, each in vars(module).items():
            if isinstance(each, type) and issubclass(each, Part) and each.__module__ == module.__name__:
                if name in found:
                    raise ValueError(f"{name}: in {found[name].__module__} and {module.__name__}; rename one")
                found[name] = each
    return found


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
            yield f"{key}{suffix}" if within else key, kind, field.description
        elif said is None or f"`{field.alias or name}`" not in said:
            raise SystemExit(f"{model.__name__}.{name}: neither a description, nor named by the object that holds it")
        holder = field.description or said
        if within and issubclass(within, Part):
            yield from rows_of(within, f"{key}{suffix}.", holder)
        elif within and not all(f"`{each.name}`" in holder for each in fields(within)):
            raise SystemExit(f"{model.__name__}.{name}: does not name every field of {within.__name__}")


def inner(annotation: Any) -> tuple[type | None, str]:
    """Model or dataclass of the objects in a field, if any, and how their place is written: ``[]`` or ``.<face>``."""
    origin, own = get_origin(annotation), get_args(annotation)
    if isinstance(annotation, type) and (issubclass(annotation, Part) or is_dataclass(annotation)):
        return annotation, ""
    if origin is Annotated:
        return inner(own[0])
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


def documents() -> list[Path]:
    """Pages with such tables, and without."""
    return sorted(FILES.glob("*.md"))


def made_anew(text: str) -> tuple[str, list[str]]:
    """The document with its tables as the models have them, and the names of those that were different."""
    known, differing = models(), []

    def made(match: re.Match) -> str:
        begin, name, old, end = match.groups()
        if name not in known:
            raise SystemExit(f"no model {name}; add its module to {Path(__file__).name}")
        new = table(known[name])
        if new != old:
            differing.append(name)
        return begin + new + end

    return BLOCK.sub(made, text), differing


def main() -> None:
    """Write the tables anew, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare only, and name the tables that differ")
    check = parser.parse_args().check
    for document in documents():
        text, differing = made_anew(document.read_text(encoding="utf-8"))
        if not check:
            document.write_text(text, encoding="utf-8")
        elif differing:
            sys.exit(f"{document.name}: not as the models say: {', '.join(differing)}; run scripts/data_layout.py")


if __name__ == "__main__":
    main()
