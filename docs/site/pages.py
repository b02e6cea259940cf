"""Pages of the site that are made from the program: commands with their options, keys of result files, errors, and the
public interface."""

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import errors_page
import files_pages
from typer.main import get_command

import stcal
from stcal.cli.help import PLAIN, examples_of
from stcal.cli.main import app

SYSTEMS = {
    "sfm": "Targets",
    "robot": "Robots",
    "register": "Registration",
    "handeye": "Hand-eye",
    "locate": "Targets of tags",
    "synthetic": "Simulation",
}
"""Packages whose ``__all__`` is the public interface."""
BESIDE = {
    "stcal": tuple(
        name
        for name in stcal.__all__
        if not inspect.ismodule(value := getattr(stcal, name)) and value.__module__ != "stcal.errors"
    ),
    "stcal.errors": None,
}
"""Names that results and arguments are made of; all that a module defines where None."""


def made() -> Iterator[tuple[str, str]]:
    """Yields (place in the site, text) of each page made from the program."""
    yield "reference/errors.md", errors_page.page()
    for folder, pages in (("commands", commands()), ("files", files_pages.pages())):
        for name, text in pages:
            yield f"reference/{folder}/{name}.md", text
    for name, text in interface():
        yield f"reference/api/{name}.rst", text


def commands() -> Iterator[tuple[str, str]]:
    """(name of the page, text) of each command, and of their list."""
    root: Any = get_command(app)
    rows = ["# Commands", "", "Made from the program; `--help-all` of each says the same.", ""]
    for name, group in sorted(root.commands.items(), key=lambda item: hasattr(item[1], "commands")):
        words = f"stcal {name}" if name != "sfm" else "stcal-sfm"
        members = getattr(group, "commands", None)
        rows += ["", f"## {words}", "", inspect.cleandoc(group.help or ""), ""] if members else []
        for each, command in {f"{words} {k}": v for k, v in members.items()}.items() if members else [(words, group)]:
            page = each.replace(" ", "-")
            rows.append(f"- [{each}]({page}.md)")
            yield page, "\n".join(command_text(each, command)) + "\n"
    yield "index", "\n".join(rows) + "\n"


def command_text(words: str, command: Any) -> list[str]:
    """Heading, help, and a table of arguments and options."""
    context = command.make_context(words, [], resilient_parsing=True, **PLAIN["context_settings"])
    usage = " ".join(command.collect_usage_pieces(context))
    calls = [f"{words} {usage}", *examples_of(words)]
    text = [f"# {words}", "", inspect.cleandoc(command.help or ""), "", "```", *calls, "```", ""]
    records = [each.get_help_record(context) for each in command.params if each.name != "help"]
    rows = [f"| `{cell(names)}` | {plain(meaning)} |" for names, meaning in filter(None, records)]
    return [*text, "| argument or option | meaning |", "|---|---|", *rows, ""]


def cell(text: str) -> str:
    """In a table."""
    return " ".join(text.split()).replace("|", "\\|")


def plain(text: str) -> str:
    """In a table, with nothing in it that Markdown would obey."""
    return re.sub(r"([*_<>\[\]])", r"\\\1", cell(text))


def interface() -> Iterator[tuple[str, str]]:
    """(name of the page, text) of each package, and of their list."""
    listed = [f"{system}.rst" for system in SYSTEMS] + ["beside.rst"]
    for system, title in SYSTEMS.items():
        module = import_module(f"stcal.{system}")
        yield system, package(f"stcal.{system}", title, list(module.__all__))
    text = ["What they are made of", "=====================", ""]
    for name, own in BESIDE.items():
        module = import_module(name)
        names = own or [each for each, value in vars(module).items() if getattr(value, "__module__", "") == name]
        text += [f"``{name}``", "-" * (len(name) + 4), "", *directives(name, list(names))]
    yield "beside", "\n".join(text) + "\n"
    toc = "".join(f"   {each.removesuffix('.rst')}\n" for each in listed)
    yield "index", f"Python interface\n================\n\nMade from the docstrings.\n\n.. toctree::\n\n{toc}"


def package(name: str, title: str, names: list[str]) -> str:
    """The page of one system."""
    head = f"{title}: ``{name}``"
    return "\n".join([head, "=" * len(head), "", f".. module:: {name}", "", *directives(name, names)]) + "\n"


def directives(module: str, names: list[str]) -> list[str]:
    """Of autodoc, for functions, classes and constants."""
    text = [f".. currentmodule:: {module}", ""]
    for name in names:
        value = getattr(import_module(module), name)
        if inspect.isclass(value):
            text += [f".. autoclass:: {name}", "   :members:", ""]
        elif callable(value):
            text += [f".. autofunction:: {name}", ""]
        else:
            text += [f".. autodata:: {name}", "   :no-value:", ""]
    return text
