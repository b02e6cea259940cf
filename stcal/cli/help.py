"""Help texts in plain form and full length. Options are sorted into panels, those that most calls need first."""

from typing import Any

from typer.core import TyperCommand, TyperGroup

PLAIN: dict[str, Any] = {
    "rich_markup_mode": None,  # rich takes twice as long to load as all the rest of `--help`
    "context_settings": {"max_content_width": 120, "help_option_names": ["-h", "--help"]},
    "pretty_exceptions_enable": False,
    "no_args_is_help": True,
}
"""Settings of every group of commands."""


PANELS = {
    "Input": ("setup", "dry_run"),
    "Method": (),
    "Output": ("out", "strict", "overwrite", "quiet", "verbose"),
    "Performance": ("workers", "scheduler", "send_images"),
    "Input in other forms": (
        *(
            "rotation",
            "length_unit",
            "poses_are",
            "first",
            "second",
            "key",
            "quaternions",
            "undo_flips",
            "camera_name",
        ),
    ),
    "Noise": (
        *("sigma_robot_mm", "sigma_robot_deg", "sigma_camera_mm", "sigma_camera_deg", "sigma_board_mm"),
        *("sigma_px", "sigma_mm", "sigma_rad"),
    ),
    "Cross-validation": ("held_out", "splits", "folds", "motions_held_out"),
    "Clocks of robot and camera": ("time_offset", "image_times", "time_tolerance"),
    "Errors of the arm itself": ("with_kinematics", "robot_out"),
    "Files for other programs": (
        *("ros", "urdf", "opencv", "export", "parent", "child", "camera_frame", "camera_out"),
    ),
    "Differential evolution": ("de_bounds_deg", "de_bounds_mm"),
}
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


class Command(TyperCommand):
    """A command whose help has its options in panels, and examples."""

    def format_epilog(self, ctx, formatter) -> None:
        """Writes the examples, each on one line to copy."""
        path = ctx.command_path
        examples = examples_of(path)
        if examples:
            with formatter.section("Examples" if len(examples) > 1 else "Example"):
                formatter.write("".join(f"  {line}\n" for line in examples))

    def format_options(self, ctx, formatter) -> None:
        """Writes the arguments, and then the options panel by panel."""
        arguments: list[tuple[str, str]] = []
        panels: dict[str, list[tuple[str, str]]] = {panel: [] for panel in PANELS}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is None:
                continue
            is_argument = param.param_type_name == "argument"
            (arguments if is_argument else panels[getattr(param, "rich_help_panel", None) or "Output"]).append(record)
        for title, records in {"Arguments": arguments, **panels}.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


class Commands(TyperGroup):
    """A group of commands, whose names may have two words. Its help has those that belong together, each with its
    sentence."""

    def resolve_command(self, ctx, args):
        """Resolves ``handeye plan`` before ``handeye``, whose first argument is a file."""
        if len(args) > 1 and self.get_command(ctx, two := " ".join(args[:2])) is not None:
            args = [two, *args[2:]]
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx, formatter) -> None:
        """Writes the name and help of each command."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = {
            name: (name, " ".join((command.help or "").split()))
            for name, command in commands
            if command and not command.hidden
        }
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
