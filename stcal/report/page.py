"""Report pages: one file each that opens off line, from jinja2 templates that stand beside what they show.

A template's name is its path below ``stcal/``. All have the macros of ``templates/macros.html.jinja``, and the filters
``number``, ``cells`` and ``listed`` (``join``) of :mod:`stcal.report.text`.
"""

from collections.abc import Sequence
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from markupsafe import Markup

from stcal.report.text import cells, join, number

Sections = Sequence[tuple[str, str, Markup]]
"""(anchor, heading, markup)."""
MACROS = "report/templates/macros.html.jinja"


@cache
def environment() -> Environment:
    """Everything that is not markup is escaped; a name that is not there is an error."""
    own = Environment(
        loader=PackageLoader("stcal", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    own.filters |= {"number": number, "listed": join, "cells": lambda rows, spec: [cells(row, spec) for row in rows]}
    macros = vars(own.get_template(MACROS).module)
    own.globals |= {name: macro for name, macro in macros.items() if not name.startswith("_")}
    return own


def render(template: str, **values) -> str:
    """The page.

    Raises
    ------
    LookupError
        ``values`` have not what the template shows.
    """
    try:
        return environment().get_template(template).render(values)
    except UndefinedError as error:
        raise LookupError(error.message) from error


def swatch(name: str, colour: str) -> Markup:
    """A patch of colour and what it stands for, for a table's cell."""
    return environment().globals["swatch"](name, colour)


def verdict(text: str, colour: str) -> Markup:
    """A word in its colour, for a table's cell."""
    return environment().globals["verdict"](text, colour)
