"""Help texts in plain form, in two levels: what the first week needs, and all options, sorted into panels."""

from copy import copy
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

PLAIN: dict[str, Any] = {
    "rich_markup_mode": None,  # rich takes twice as long to load as all the rest of `--help`
    "context_settings": {"max_content_width": 120, "help_option_names": ["-h", "--help"]},
    "pretty_exceptions_enable": False,
    "no_args_is_help": True,
}
"""Settings of every group of commands."""
PANELS = {
    "Input": "setup dry_run",
    "Method": "",
    "Output": "out strict overwrite quiet verbose",
    "Performance": "workers scheduler send_images",
    "Input in other forms": "rotation length_unit poses_are first second key quaternions undo_flips camera_name",
    "Noise": "sigma_robot_mm sigma_robot_deg sigma_camera_mm sigma_camera_deg sigma_board_mm "
    "sigma_px sigma_mm sigma_rad",
    "Cross-validation": "held_out splits folds motions_held_out",
    "Clocks of robot and camera": "time_offset image_times time_tolerance",
    "Files for other programs": "ros urdf opencv export parent child camera_frame camera_out",
    "Differential evolution": "de_bounds_deg de_bounds_mm",
}
PANELS = {panel: tuple(names.split()) for panel, names in PANELS.items()}
"""Panels of the help text in their order, each with the names of its parameters. All other parameters are in Input if
they are paths to read, in Output if they are paths to write, and else in Method. ``--help`` is shown in Output."""


def panel_of(name: str, reads: bool, writes: bool) -> str:
    """Returns the panel of a parameter. ``reads``, ``writes`` : whether its value is a path that is read or written."""
    for panel, names in PANELS.items():
        if name in names:
            return panel
    return "Output" if writes else "Input" if reads else "Method"


def words_of(path: str) -> str:
    """Returns the words of a command without the program's: ``sfm run`` of ``stcal-sfm run`` and ``stcal sfm run``."""
    return path.replace("stcal-sfm", "stcal sfm", 1).partition(" ")[2]


def examples_of(path: str) -> list[str]:
    """Returns typical calls of a command; ``path`` : its words, with the program's."""
    return [f"{path} {arguments}".rstrip() for arguments in EXAMPLES.get(words_of(path), ())]


SHOW_ALL = "--help-all"


class Command(TyperCommand):
    """A command whose help has what the first week needs, all options in panels on demand, and examples."""

    def get_params(self, ctx) -> list[Any]:
        """Returns the parameters, with that for all options."""
        params, every = super().get_params(ctx), copy(self.get_help_option(ctx))
        assert every is not None, "help is an option of all commands"
        show: Any = every.callback

        def show_all(ctx: Any, param: Any, wanted: bool) -> None:
            ctx.meta[SHOW_ALL] = wanted
            show(ctx, param, wanted)

        every.name, every.opts, every.callback = "help_all", [SHOW_ALL], show_all
        every.help = f"Show all {sum(each.param_type_name == 'option' for each in params) + 1} options and exit."
        return [*params, every]

    def format_epilog(self, ctx, formatter) -> None:
        """Writes the examples, each on one line to copy."""
        path = ctx.command_path
        examples = examples_of(path)
        if examples:
            with formatter.section("Examples" if len(examples) > 1 else "Example"):
                formatter.write("".join(f"  {line}\n" for line in examples))

    def format_options(self, ctx, formatter) -> None:
        """Writes the arguments, then the options: those that must be given come first."""
        listed = FIRST_WEEK.get(words_of(ctx.command_path))
        week = None if ctx.meta.get(SHOW_ALL) else listed
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": [], **{panel: [] for panel in PANELS}}
        params = self.get_params(ctx)
        rank = {name: i for i, name in enumerate(week or ())}
        for param in sorted(params, key=lambda each: (not each.required, rank.get(str(each.name), len(rank)))):
            record = None if param.name == "help_all" and not listed else param.get_help_record(ctx)
            own = getattr(param, "rich_help_panel", None)  # none of the two that show the help
            if record is None or (week and own and param.param_type_name == "option" and param.name not in rank):
                continue
            panel = "Arguments" if param.param_type_name == "argument" else "Options" if week else own or "Output"
            sections[panel].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def group(name: str, text: str) -> typer.Typer:
    """Returns a group of commands; ``text`` : its help."""
    return typer.Typer(name=name, help=text, cls=Commands, **PLAIN)


class Commands(TyperGroup):
    """A group of commands, whose names may have two words; its help has those that belong together."""

    def resolve_command(self, ctx, args):
        """Resolves ``handeye plan`` before ``handeye``, whose first argument is a file."""
        if len(args) > 1 and self.get_command(ctx, two := " ".join(args[:2])) is not None:
            args = [two, *args[2:]]
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx, formatter) -> None:
        commands = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        shown = {name: command for name, command in commands.items() if command and not command.hidden}
        rows = {name: (name, " ".join((command.help or "").split())) for name, command in shown.items()}
        groups = GROUPS.get(words_of(ctx.command_path) or "stcal", {"Commands": tuple(rows)})
        for title, names in groups.items():
            with formatter.section(title):
                formatter.write_dl([rows[name] for name in names])


EXAMPLES = {
    "sfm run": ("photos --camera cameras.txt --target target.toml --board board.toml --out result",),
    "sfm detect": ("photos --camera cameras.txt --out look",),
    "sfm report": ("result --pdf",),
    "sfm init": ("design",),
    "sfm simulate": ("set --images 5 --width 1728",),
    "sfm compare": ("result set/truth.json",),
    "sfm demo": ("--out demo",),
    "sfm draw": ("design/target.toml --out target.pdf",),
    "sfm design": ("box --size 160,140,120 --faces front,right,top",),
    "sfm export-database": ("result old.db --schema 3.8",),
    "sfm export-model": ("result model --format colmap-txt",),
    "sfm export": ("result target.urdf", "result target.csv"),
    "sfm crosscheck": ("result",),
    "sfm faces": ("model --run result --out faces.json",),
    "sfm plan": ("--camera cameras.txt --target target.toml --board board.toml --images 6",),
    "sfm advise": ("result --count 3",),
    "sfm calibrate-camera": ("photos --board board.toml --out cameras.txt",),
    "sfm measure": ("photos --camera cameras.txt --faces result/faces.json --out poses.csv",),
    "sfm budget": ("result --report budget.html --pdf",),
    "register": ("pairs.csv --out b_from_a.json --report pairs.html",),
    "handeye": ("photos --poses flange.csv --camera cameras.txt --board board.toml --report handeye.html",),
    "handeye plan": ("photos --poses flange.csv --camera cameras.txt --board board.toml --robot robot.toml",),
    "locate run": ("scenes --layout tags.toml --camera cameras.txt --out poses.csv",),
    "locate calibrate": ("photos --camera cameras.txt --board board.toml --layout tags.toml --out measured.toml",),
    "locate schedule": ("1 64 7",),
    "locate capture": ("scene",),
    "camera show": ("cameras.txt --plot distortion.svg",),
    "camera convert": ("cameras.txt camera.yaml --form ros",),
    "camera compare": ("cameras.txt camera.yaml",),
    "robot init": ("robot.toml",),
    "robot axes": ("sweeps.csv --robot robot.toml --out axes.toml",),
    "robot identify": ("poses.csv --robot robot.toml --out identified.toml --report identified.html",),
    "robot evaluate": ("new.csv --robot robot.toml --robot identified.toml",),
    "robot compensate": ("targets.csv --robot identified.toml --nominal robot.toml --out joints.csv",),
    "robot verify": ("measured.csv --plot errors.svg",),
    "robot design": ("--robot robot.toml --count 40 --out poses.csv",),
    "robot convert": ("robot.toml robot.urdf",),
    "robot from-photos": (
        "photos --camera cameras.txt --faces faces.json --joints joints.csv --robot robot.toml --out arm",
    ),
}
"""Arguments of typical calls of each command, by its words."""
FIRST_WEEK = {
    "sfm run": "out camera target board refine_camera board_only exclude every expect_faces verbose",
    "sfm detect": "camera out target board exclude min_diameter max_diameter workers verbose",
    "sfm simulate": "target board camera images width distance groups one_board png seed",
    "sfm design": "size faces tags circles radius_mm distance camera images bright",
    "sfm plan": "camera target board images distance groups faces run out one_board",
    "sfm measure": "camera faces out report board sequence joints live serve verbose",
    "sfm budget": "page pdf statement check_lengths lengths lengths_statement field out strict verbose",
    "register": "out report model method threshold first second robot_file overwrite verbose",
    "robot axes": "robot_file out report rotation still_deg orientations overwrite verbose",
    "robot identify": "robot_file out report model offsets observe adjust partial folds verbose",
    "robot evaluate": "robot_files refit out report json_file payload_kg overwrite verbose",
    "robot compensate": "robot_file nominal out report rotation payload_kg overwrite verbose",
    "robot design": "robot_file count out report observe candidates sigma_mm box target seed",
    "robot from-photos": "camera faces joints robot_file out targets target board model verbose",
    "locate run": "layout camera out report hand_eye robot_poses registration offset method verbose",
    "handeye": "poses camera board setup rotation length_unit method with_scale out report",
    "handeye plan": "poses camera board setup robot_file count out rotation length_unit verbose",
}
FIRST_WEEK = {words: tuple(names.split()) for words, names in FIRST_WEEK.items()}
"""Parameters that `--help` shows of commands with more than a dozen options, in their order."""
GROUPS = {
    "stcal": {
        "Stereo targets": ("sfm",),
        "Robots": ("robot", "handeye", "handeye plan"),
        "Other instruments and targets": ("register", "locate"),
        "Camera files": ("camera",),
    },
    "sfm": {
        "Make and photograph a target": ("init", "design", "draw", "plan"),
        "Calibrate it": ("detect", "run", "report", "budget", "advise", "calibrate-camera"),
        "Use it": ("measure", "export"),
        "COLMAP": ("crosscheck", "faces", "export-model", "export-database"),
        "Simulate": ("demo", "simulate", "compare"),
    },
}
"""Commands that belong together, in the order of the help text."""
