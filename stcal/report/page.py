"""Report pages: single files that open offline, from jinja2 templates beside the code whose results they show.

A template's name is its path below ``stcal/``. All templates have the macros of ``templates/macros.html.jinja``, and
the filters ``number``, ``cells`` and ``listed`` (``join``) of :mod:`stcal.report.text`.
"""

from collections.abc import Sequence
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from markupsafe import Markup

from stcal.report.text import cells, join, number

Sections = Sequence[tuple[str, str, Markup]]
"""Sections of a page, each (anchor, heading, markup)."""
MACROS = "report/templates/macros.html.jinja"


@cache
def environment() -> Environment:
    """Return the template environment, which escapes everything but markup, and refuses undefined names."""
    env = Environment(
        loader=PackageLoader("stcal", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters |= {"number": number, "listed": join, "cells": lambda rows, spec: [cells(row, spec) for row in rows]}
    macros = vars(env.get_template(MACROS).module)
    env.globals |= {name: macro for name, macro in macros.items() if not name.startswith("_")}
    return env


def render(template: str, **values) -> str:
    """Return the page of a template with these values.

    Raises
    ------
    LookupError
        ``values`` lack a name that the template uses.
    """
    try:
        return environment().get_template(template).render(values)
    except UndefinedError as error:
        raise LookupError(error.message) from error


def swatch(name: str, colour: str) -> Markup:
    """Return a patch of colour and its meaning ``name``, for a cell of a table."""
    return environment().globals["swatch"](name, colour)


def verdict(text: str, colour: str) -> Markup:
    """Return a word in its colour, for a cell of a table."""
    return environment().globals["verdict"](text, colour)
