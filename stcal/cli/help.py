"""Help texts: plain, at once, and whole."""

from typing import Any

from typer.core import TyperGroup

PLAIN: dict[str, Any] = {
    "rich_markup_mode": None,  # rich takes twice as long to load as all the rest of `--help`
    "context_settings": {"max_content_width": 120, "help_option_names": ["-h", "--help"]},
    "pretty_exceptions_enable": False,
    "no_args_is_help": True,
}
"""Settings of every group of commands."""


class Commands(TyperGroup):
    """A group whose help has the whole sentence of each command, and whose commands may have names of two words."""

    def resolve_command(self, ctx, args):
        """``handeye plan`` before ``handeye``, whose first argument is a file."""
        if len(args) > 1 and self.get_command(ctx, two := " ".join(args[:2])) is not None:
            args = [two, *args[2:]]
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx, formatter) -> None:
        """Name and help of each."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, " ".join((each.help or "").split())) for name, each in commands if each and not each.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
