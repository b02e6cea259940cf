"""Options that several commands share, how commands declare their parameters, and the notes on assumed designs.

``count: Annotated[int, "Name this many poses.", Opt(min=1, max=100)] = 3`` is the option ``--count``: with its help
text and range. Its name, and its panel in the help, follow from the parameter's name and type. What a command writes
beside a parameter's type becomes Typer's form of it.
"""

import inspect
import os
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from stcal.cli.help import Command, panel_of
from stcal.cli.terminal import STANDARD_OUTPUT, manner, print_each, said_apart, say, warn_if_quiet
from stcal.errors import ChecksFailed, InputError, InputNote, StcalError, held
from stcal.io.files import keep_apart

if TYPE_CHECKING:
    from stcal.design import BoardDesign
    from stcal.geometry.rigid import Order
    from stcal.io.table import Table
    from stcal.sfm.detect.candidates import EllipseOptions


@dataclass(frozen=True, slots=True)
class Opt:
    """An option: what its help text and its parameter do not state. ``name`` : its names, ``--held-out`` for
    ``held_out`` if not given; ``min``, ``max`` : range of a number; ``writes`` : whether a file of this name is
    written; ``metavar``, ``envvar`` : word for the value, and variable that sets it."""

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


MOST_SEED = 2**63 - 1
"""Largest seed: other programs read seeds in result files as signed 64-bit integers."""
WRITES, JSON, SEED = Opt(writes=True), Opt("--json", writes=True), Opt(min=0, max=MOST_SEED)
WIDTH = Opt(min=320, max=100_000)  # of images, px


class Arg(Opt):
    """An argument, a parameter without the name of an option: ``name`` is the word for its value."""

    def info(self, parameter: str, text: str) -> Any:
        """Returns Typer's form of the argument."""
        return typer.Argument(metavar=self.name or None, help=text, min=self.min, max=self.max, writable=self.writes)


def declared(parameter: inspect.Parameter) -> inspect.Parameter:
    """Returns a parameter with Typer's form of its annotation."""
    kind, text, *rest = get_args(parameter.annotation)
    [given] = rest or [Opt()]
    info = given.info(parameter.name, text)
    info.rich_help_panel = panel_of(parameter.name, "Path" in str(kind), given.writes)
    return parameter.replace(annotation=Annotated[kind, info])


Images = Annotated[Path, "Read the images of this folder: IMAGES/<group>/*.jpg, png, tif, bmp.", Arg()]
Run = Annotated[Path, "Read the finished run in this folder.", Arg("RUN")]
CameraFile = Annotated[Path, "Read the intrinsics from this file of COLMAP, OpenCV, ROS, Kalibr, mrcal and others."]
OptionalCamera = Annotated[
    Path | None,
    "Read the intrinsics from this file: COLMAP, OpenCV, ROS, Kalibr, mrcal, Metashape or MATLAB. If not given, they "
    "are found from the board's dots or the target's printed faces.",
]
CAMERA = "--camera"
CameraName = Annotated[str, "Take this camera, by name or number, of a --camera file of several.", Opt("--camera-name")]
"""Option that every command with ``--camera`` has."""
TargetFile = Annotated[Path | None, "Read the target's design from this target.toml, in place of the reference design."]
BoardFile = Annotated[Path | None, "Read the board from this file (TOML, or Kalibr's YAML), in place of the reference."]
PlateMargin = Annotated[
    float, "Assume that plates without outline_mm end this far beyond circles.", Opt(min=0, max=1e4)
]
Distance = Annotated[float, "Place the camera at this distance, mm.", Opt("--distance --distance-mm", min=50, max=1e5)]
"""Distance of the camera in `design`, `plan` and `simulate`: photographs that are forecast can be simulated."""
FlatBoardFile = Annotated[Path, "Read the board from this file: dots, chessboard, ChArUco or tags (TOML)."]
RobotFile = Annotated[Path, "Read the robot from this file (TOML); `stcal robot init` writes one.", Opt("--robot")]
LayoutFile = Annotated[Path, "Read the target's tags from this file (TOML)."]
JsonFile = Annotated[Path | None, "Also write all results to this file (JSON; `-`: standard output).", JSON]
ReportFile = Annotated[Path | None, "Also write a page to this file (HTML).", Opt("--report", writes=True)]
Device = Annotated[str, "Use this camera: a number, or a device such as /dev/video0 (V4L2, UVC)."]
Gain = Annotated[float | None, "Set this gain, in the driver's unit; unchanged if not given.", Opt(min=0, max=1e6)]
Exclude = Annotated[list[str] | None, "Ignore this image, such as 12/a.jpg; repeat it for more.", Opt(metavar="IMAGE")]
Strict = Annotated[bool, "End with exit code 4 if a check has failed; results are written in any case."]
StrictByDefault = Annotated[bool, "End with exit code 4 if the answer is no, else with 0.", Opt("--strict/--no-strict")]
"""Option of the commands that say whether a run may be used."""
Overwrite = Annotated[bool, "Replace existing output files.", Opt("--overwrite")]
"""Option of every command that writes a file."""
Quiet = Annotated[bool, "Print only warnings and errors, and a verdict that is not good.", Opt("--quiet -q")]
Verbose = Annotated[bool, "Print more: steps, times, and what is found in images.", Opt("--verbose -v")]
ALWAYS_NEW = ("export_database", "export_run")
"""Commands that never replace a file, as other programs work on their outputs."""
WRITE_NOTHING = ("serve", "live", "dry_run")  # options with which no output is written
_replacing: ContextVar[bool] = ContextVar("_replacing", default=True)
"""Whether a command may replace existing outputs."""
Workers = Annotated[int | None, "Use this many processes; one per core if not given.", Opt(min=1, max=1024)]
Scheduler = Annotated[str | None, "Send the images to the Dask scheduler at this address, tcp://host:8786."]
SendImages = Annotated[bool, "Send the content of the images to the cluster, whose machines cannot read their folder."]
Quaternions = Annotated[
    Literal["wxyz", "xyzw"], "Read quaternions by the names of their columns, or in their order as x, y, z, w (xyzw)."
]
Rotation = Annotated[
    str | None,
    "Read angles in this convention, if the file does not name it: kuka-abc, fanuc-wpr, ur-rotvec, yaskawa …, "
    "rotvec, xyz (fixed axes), ZYX (moving axes).",
]
PayloadKg = Annotated[
    float | None, "Take this mass at the flange for rows without payload_kg, or the robot file's.", Opt(min=0, max=1e4)
]
MinDiameter = Annotated[
    float | None, "Ignore circles smaller than this, px; 4.5, 9 over 8 megapixels, if not given.", Opt(min=4, max=1e6)
]
MaxDiameter = Annotated[float, "Ignore circles larger than this, px.", Opt(min=8, max=1e6)]
FirstTable = Annotated[Path | None, "Read rows from this file (CSV), and join those of --b.", Opt("--a")]
SecondTable = Annotated[Path | None, "Read the values that belong to the rows of --a from this file (CSV).", Opt("--b")]
Key = Annotated[str, "Match rows of --a and --b by this column, or by A=B: column A of --a and column B of --b."]


@dataclass(frozen=True, slots=True)
class JoinOptions:
    """Options of a table in place of a command's file: two tables joined."""

    first: FirstTable = None
    second: SecondTable = None
    key: Key = "image"

    def table(
        self, given: Path | None, what: str, prefixes: tuple[str, str] = ("", ""), quaternions: "Order" = "wxyz"
    ) -> "Path | Table":
        """Returns the file given, or the table of --a and --b joined, printing notes on rows left out."""
        seconds = [self.second] if self.second else []
        tables = several_tables(given, self.first, seconds, self.key, what, prefixes, quaternions)
        return tables[0] if isinstance(tables, list) else tables


JOINED, JOINED_BY_POSE, JOINED_BY_NAME = JoinOptions(), JoinOptions(key="pose"), JoinOptions(key="name")


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Options of commands that detect circles in images: their sizes, and where the images are processed."""

    min_diameter: MinDiameter = None
    max_diameter: MaxDiameter = 450.0
    workers: Workers = None
    scheduler: Scheduler = None
    send_images: SendImages = False

    def ellipses(self) -> "EllipseOptions":
        """Returns the detection options for circles of these sizes."""
        from stcal.sfm.detect.candidates import EllipseOptions

        if self.min_diameter is not None and self.max_diameter <= self.min_diameter:
            fault = f"--max-diameter {self.max_diameter:g}: over --min-diameter {self.min_diameter:g} needed"
            raise InputError("E-OPTION-RANGE", fault)
        return EllipseOptions(min_diameter_px=self.min_diameter, max_diameter_px=self.max_diameter)

    def handed_over(self) -> AbstractContextManager[None]:
        """Returns the context in which images are processed: on a Dask cluster, or by processes of this machine."""
        if self.scheduler is None:
            if self.send_images:
                fault = "--send-images: only with --scheduler"
                raise InputError("E-OPTION-NEEDS", f"{fault}, to whose machines they are sent")
            return nullcontext()
        from stcal.workflows.cluster import dask_cluster

        return dask_cluster(self.scheduler, self.send_images)


DETECTION = DetectionOptions()


def several_tables(
    given: Path | None,
    first: Path | None,
    seconds: Sequence[Path],
    key: str,
    what: str,
    prefixes: tuple[str, str] = ("", ""),
    quaternions: "Order" = "wxyz",
) -> "Path | Table | list[Table]":
    """Returns the file given, or a table for each --b joined with --a, printing notes on rows left out."""
    if (given is None) == (first is None) or (first is None) != (not seconds):
        raise InputError("E-OPTION-FILES", f"{what}: one file, or --a and --b with --key, needed")
    if given is not None:
        return given
    from stcal.io.join import join_tables

    joined = [join_tables(str(first), str(second), key, prefixes, quaternions) for second in seconds]
    print_each("note", (note for each in joined for note in each.notes))
    return [each.table for each in joined]


def exports_of(words: Sequence[str], forms: Collection[str]) -> list[tuple[str, Path]]:
    """Returns form and file of each FORM=FILE of --export; ``forms`` : the known ones."""
    from stcal.io.static_transforms import require_form

    exports = []
    for word in words:
        form, _, path = word.partition("=")
        require_form(form, forms)
        if not path:
            raise InputError("E-OPTION-VALUE", f"--export {word}: no file; give {form}=FILE")
        exports.append((form, Path(path)))
    return exports


def name_of(source: "Path | Table") -> str:
    """Returns the name, without folder, of a file or table from :meth:`Joined.table`."""
    return source.name if isinstance(source, Path) else source.where


def require_passed(strict: bool, failed: Sequence[str], report: Path | None = None, verdict: str = "") -> None:
    """Raises :class:`ChecksFailed` with the names of the failed checks if ``--strict`` was given; otherwise a quiet
    command writes ``verdict``, the sentence of a verdict that is not good, or what failed."""
    others = f" and {len(failed) - 2} more" if len(failed) > 2 else ""
    said = [f"--strict: failed: {', '.join(failed[:2])}{others}"] * bool(failed)
    require_usable(strict, said, report, verdict or f"failed: {', '.join(failed)}" * bool(failed), remedy="")


def require_usable(
    strict: bool,
    reasons: Sequence[str],
    page: Path | None = None,
    verdict: str = "",
    but: str = "do not use them",
    remedy: str = "; --no-strict ends with 0",
) -> None:
    """Raises :class:`ChecksFailed` with the reasons why a result must not be used, unless ``--no-strict`` was given;
    otherwise a quiet command writes ``verdict``, or the reasons. ``but``, ``remedy`` : end the message, after that the
    results are written."""
    said = "; ".join(reasons)
    if strict and reasons:
        see = f"; see {page}" if page else ""
        raise ChecksFailed("E-CHECKS-FAILED", f"{said}; results are written, {but}{remedy}{see}")
    if verdict or said:
        warn_if_quiet(verdict or said)


def load_ahead(workers: int | None) -> None:
    """Begins to load the modules of the worker processes, while the command loads the same modules."""
    from stcal.parallel import load_ahead

    load_ahead(workers)


def require_new(outputs: Sequence[tuple[str, Path]]) -> None:
    """Refuses, before the work, existing outputs (option, path), unless ``--overwrite`` was given."""
    for option, path in outputs:
        if not _replacing.get() and os.path.lexists(path) and not path.is_dir():
            where = f"{option} {path}" if option.startswith("-") else path
            raise InputError("E-OUTPUT-EXISTS", f"{where}: exists; give another name, or --overwrite to replace it")


def protect_outputs(application: typer.Typer) -> None:
    """Prevents the commands of an application from overwriting their inputs, or other files without a request. Every
    path among the parameters is an input unless its option ``writes``. Commands that write get ``--overwrite``, all
    of them ``--quiet`` and ``--verbose``; only ``--json -`` may use standard output."""
    for command in application.registered_commands:
        if command.callback is not None:
            command.callback, command.cls = _protected(command.callback), Command
    for group in application.registered_groups:
        if group.typer_instance is not None:
            protect_outputs(group.typer_instance)


def _grouped(command: Callable) -> Callable:
    """Returns the command with the options of each group, a dataclass, as parameters, and an instance's defaults."""
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, type] = {
        name: each.annotation
        for name, each in signature.parameters.items()
        if isinstance(each.annotation, type) and is_dataclass(each.annotation)
    }
    every: list[inspect.Parameter] = []
    for name, each in signature.parameters.items():
        if name in groups:
            options = inspect.signature(groups[name], eval_str=True).parameters.values()
            every += [option.replace(default=getattr(each.default, option.name, option.default)) for option in options]
        else:
            every.append(each)

    @wraps(command)
    def together(**given):
        made = {
            name: kind(**{each.name: given.pop(each.name) for each in fields(kind)}) for name, kind in groups.items()
        }
        return command(**given, **made)

    together.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in every]
    )
    return together


def _protected(command: Callable) -> Callable:
    if hasattr(command, "outputs"):  # reached through two applications
        return command
    command = _grouped(command)
    signature = inspect.signature(command, eval_str=True)
    every = [*map(declared, signature.parameters.values())]
    infos = {each.name: get_args(each.annotation)[1] for each in every}
    # With Annotated, Typer takes an option's first name for its default.
    words = {name: info.default if isinstance(info.default, str) else name for name, info in infos.items()}
    outputs = {name for name, info in infos.items() if info.writable}

    @wraps(command)
    def checked(overwrite: bool = False, quiet: bool = False, verbose: bool = False, camera_name: str = "", **given):
        values = {name: value if isinstance(value, list | tuple) else [value] for name, value in given.items()}
        paths = [(name, path) for name, several in values.items() for path in several if isinstance(path, Path)]
        written, read = ([(words[n], p) for n, p in paths if (n in outputs) is out] for out in (True, False))
        exports = (word.partition("=")[2] for word in given.get("export") or ())
        written += [("--export", Path(path)) for path in exports if path]
        to_stdout = [option for option, path in written if path == STANDARD_OUTPUT]
        for option in [each for each in to_stdout if each != "--json"]:
            raise InputError("E-OPTION-STDOUT", f"{option} -: only --json writes to standard output; give a file")
        written = [each for each in written if each[1] != STANDARD_OUTPUT]
        for option, path in written:
            if option == "--report" and path.suffix.lower() == ".pdf":
                also = ", and --pdf for the PDF" if "pdf" in given else "; a browser prints it as PDF"
                fault = f"--report {path}: a page of HTML"
                raise InputError("E-OUTPUT-SUFFIX", f"{fault}; give {path.with_suffix('.html')}{also}")
        keep_apart(written, read)
        choice: AbstractContextManager[None] = nullcontext()
        if camera_name:
            from stcal.io.cameras.read import camera_chosen

            choice = camera_chosen(camera_name)
        with held(_replacing, overwrite):
            if command.__name__ not in ALWAYS_NEW and not any(given.get(name) for name in WRITE_NOTHING):
                require_new(written)
            with manner(quiet, verbose), said_apart() if to_stdout else nullcontext(), input_notes(), choice:
                return command(**given)

    checked.outputs = frozenset(outputs)  # type: ignore[attr-defined]
    further: dict[str, tuple[Any, Any]] = {"camera_name": (CameraName, "")} if CAMERA in words.values() else {}
    further |= {"overwrite": (Overwrite, False)} if outputs and command.__name__ not in ALWAYS_NEW else {}
    further |= {"quiet": (Quiet, False), "verbose": (Verbose, False)}
    keyword = inspect.Parameter.KEYWORD_ONLY
    every += [
        declared(inspect.Parameter(name, keyword, default=default, annotation=annotation))
        for name, (annotation, default) in further.items()
    ]
    # Typer reads both.
    checked.__signature__ = signature.replace(parameters=every)  # type: ignore[attr-defined]
    checked.__annotations__ = {each.name: each.annotation for each in every} | {"return": None}
    return checked


@contextmanager
def input_notes() -> Iterator[None]:
    """Print the parts of files that their readers ignore, once each."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", InputNote)
        before, told = warnings.showwarning, set()

        def show(message, category, *rest, **more) -> None:
            if not issubclass(category, InputNote):
                before(message, category, *rest, **more)
            elif str(message) not in told:
                told.add(str(message))
                print_each("note", [str(message)])

        warnings.showwarning = show
        yield


@contextmanager
def designs_told(
    target: Path | None, board: Path | None, with_target: bool = True, with_board: bool = True
) -> Iterator[None]:
    """Prints which reference designs are assumed (unless switched off); errors within the context name them."""
    from stcal.boards.target_file import target_of
    from stcal.design import reference_board, reference_target

    assumed = []
    if target is not None:
        with_board = with_board and not target_of(target).has_scale
    elif with_target:
        faces = reference_target().faces
        assumed.append(f"the reference target, {len(faces)} faces of {len(faces[0].ids)} circles (no --target)")
    if board is None and with_board:
        assumed.append(f"the reference board, {board_in_words(reference_board())} (no --board)")
    for design in assumed:
        say(f"assumed: {design}")
    try:
        yield
    except StcalError as error:
        if assumed and not isinstance(error, InputError):
            error.append(f"; assumed: {' and '.join(assumed)}; if yours is another, give its file")
        raise


def board_in_words(board: "BoardDesign") -> str:
    """Returns the dots of a board in words."""
    dots = f"{board.rows}×{board.columns} dots of radius {board.radius_mm:g} mm"
    return f"{dots}, pitch {board.pitch_mm:g} mm"
