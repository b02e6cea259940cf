"""Parameters of commands: what a command writes beside a parameter's type, and Typer's form of it.

``count: Annotated[int, "Name this many poses.", Opt(min=1, max=100)] = 3`` is the option ``--count``: with its help
text and range. Its name, and its panel in the help, follow from the parameter's name and type.
"""

from dataclasses import dataclass
from typing import Annotated, Any, get_args

import typer

from stcal.cli.help import panel_of


@dataclass(frozen=True, slots=True)
class Opt:
    """An option: what its help text and its parameter do not state.

    ``name`` : its names, such as ``--a``, or ``--robust/--least-squares``; ``--held-out`` for ``held_out`` if not
    given; ``min``, ``max`` : range of a number; ``writes`` : whether a file of this name is written; ``metavar``,
    ``envvar`` : word for the value in the help text, and variable of the environment that sets it.
    """

    name: str = ""
    min: float | None = None
    max: float | None = None
    writes: bool = False
    metavar: str | None = None
    envvar: str | None = None

    def info(self, parameter: str, text: str) -> Any:
        """Returns Typer's form of the option."""
        names = self.name.split() or [f"--{parameter.replace('_', '-')}"]
        more = {"metavar": self.metavar, "envvar": self.envvar, "writable": self.writes}
        return typer.Option(*names, help=text, min=self.min, max=self.max, **more)


WRITES = Opt(writes=True)
"""An option with the name of a file that is written."""


@dataclass(frozen=True, slots=True)
class Arg:
    """An argument: a parameter without the name of an option; fields as of :class:`Opt`."""

    metavar: str | None = None
    min: float | None = None
    max: float | None = None
    writes: bool = False

    def info(self, _: str, text: str) -> Any:
        """Returns Typer's form of the argument."""
        return typer.Argument(metavar=self.metavar, help=text, min=self.min, max=self.max, writable=self.writes)


@dataclass(frozen=True, slots=True)
class Declared:
    """``annotation`` : of a parameter, for Typer; ``word`` : its name in messages; ``reads``, ``writes`` : whether its
    value is a path that is read, or written; ``reads_images`` : whether images are read there."""

    annotation: Any
    word: str
    reads: bool
    writes: bool
    reads_images: bool


def declared(parameter: str, annotation: Any) -> Declared:
    """Returns Typer's form of a parameter."""
    kind, text, *rest = get_args(annotation)
    [given] = rest or [Opt()]
    info = given.info(parameter, text)
    is_path = "Path" in str(kind)
    info.rich_help_panel = panel_of(parameter, is_path, given.writes)
    # With Annotated, Typer takes an option's first name for its default.
    word = info.default if isinstance(given, Opt) else parameter
    of_images = is_path and (parameter in ("images", "exposures", "rig_file") or "IMAGES" in (given.metavar or ""))
    return Declared(Annotated[kind, info], word, is_path and not given.writes, given.writes, of_images)
