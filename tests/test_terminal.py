"""What commands print is text, of which a terminal obeys nothing; and no command writes over what it was given to read:
walked over all commands and all their options."""

import inspect
import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args

import pytest
from typer.models import OptionInfo, ParameterInfo
from typer.testing import CliRunner

import stcal
from stcal.cli import options, terminal
from stcal.cli.help import FIRST_WEEK, PANELS
from stcal.cli.main import app, main
from stcal.cli.options import ALWAYS_NEW
from stcal.errors import lacks_memory
from stcal.io.files import RUN_ENTRIES, RUN_MARKER, keep_apart
from tests.commands import CALLS, COMMANDS, paths_of
from tests.outcome import INPUT, assert_error, ended, fails_with, refuses

CLI = Path(stcal.__file__).parent / "cli"


def printed(code: str, *words: str) -> str:
    """What a program of its own prints."""
    program = [sys.executable, "-P", "-c", code, *words]
    return subprocess.run(program, capture_output=True, text=True, check=True).stdout


OBEYED = {"\x1b[31mred": "?[31mred", "a\rb": "a b", "bell\x07": "bell?", "\u202egpj.exe": "?gpj.exe"}
OBEYED |= {"\x9b2J": "?2J", "\udc80": "?"}


@pytest.mark.parametrize("name", OBEYED)
def test_what_a_terminal_would_obey_is_a_question_mark(capsys, name):
    terminal.say(f"12/{name}.jpg: 0.2 µm ± 3 mdeg – σ\n\u2009fine")
    terminal.print_each("left out", [name])
    text = capsys.readouterr().out
    assert all(c.isprintable() or c in "\n\u2009" for c in text)
    assert text.splitlines()[-1] == f"left out: {OBEYED[name]}"
    assert "0.2 µm ± 3 mdeg – σ\n\u2009fine\n" in text


def test_every_command_prints_through_it_and_can_be_quiet_or_say_more():
    for path in CLI.glob("*.py"):
        found = re.findall(r"(?<![\w.])print\((?!stcal|said|f\"error)", path.read_text(encoding="utf-8"))
        allowed = {"terminal.py": 3, "main.py": 3}.get(path.name, 0)
        assert len(found) <= allowed, path.name
    for command in COMMANDS.values():
        assert {"quiet", "verbose"} <= set(inspect.signature(command).parameters)


@pytest.mark.parametrize(
    ("error", "used_up"),
    [
        (MemoryError(), True),
        (RuntimeError("can't start new thread"), True),
        (ImportError("libx.so: failed to map segment from shared object"), True),
        (ImportError("No module named 'x'"), False),
        (RuntimeError("a fault of ours"), False),
    ],
)
def test_how_libraries_say_that_memory_is_used_up(error, used_up):
    assert lacks_memory(error) == used_up
    outer = ImportError("install it")
    outer.__cause__ = error
    assert lacks_memory(outer) == used_up


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit there")
@pytest.mark.parametrize(("words", "code"), [("run x --camera y --out z", 3), ("--version", 0)])
def test_too_little_address_space_is_said_before_libraries_load(words, code):
    """Loaded with 350 to 600 MB, they crashed, hung or sent SIGINT."""
    import resource

    program = "from stcal.cli.entry import main_sfm; main_sfm()"
    ended = subprocess.run(
        [sys.executable, "-P", "-c", program, *words.split()],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (500 << 20, 500 << 20)),
        check=False,
    )
    assert ended.returncode == code
    said = "error: not enough memory: 500 MB of address space allowed, 800 MB needed; raise the limit (`ulimit -v`)\n"
    assert ended.stderr == (said if code else "")


def test_the_package_is_the_program_and_version_and_help_load_little():
    """Numerics take longer than all the rest; Typer itself loads pydantic."""
    code = "import sys; from stcal.cli.entry import main; main(); print('typer' in sys.modules)"
    assert printed(code, "--version") == f"{stcal.__version__}\nFalse\n"
    code = "import sys, stcal.cli.main; print([m for m in ('numpy', 'yaml', 'rich.progress') if m in sys.modules])"
    assert printed(code) == "[]\n"
    words = [sys.executable, "-P", "-m", "stcal", "--version"]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip() == stcal.__version__


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device there")
@pytest.mark.parametrize("words", ["--version", "--help"])
def test_text_that_nothing_takes_is_one_line(words):
    begin = "from stcal.cli.entry import main; main()"
    with open("/dev/full", "w") as full:
        found = subprocess.run([sys.executable, "-c", begin, words], stdout=full, stderr=-1, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.startswith("error: No space left on device; ")
    assert found.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no such shell there")
def test_closed_streams_end_no_command(tmp_path):
    """The first files that are opened would take their numbers."""
    call = f"{sys.executable} -P -c 'from stcal.cli.entry import main; main()' robot init a.toml <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", call], cwd=tmp_path, check=False).returncode == 0
    assert (tmp_path / "a.toml").read_text().startswith("#")


def test_a_file_for_standard_output_needs_one_that_is_open(monkeypatch):
    with open(os.devnull, "w") as closed, fails_with("E-OUTPUT-UNWRITABLE … --json"):
        monkeypatch.setattr(sys, "stdout", closed)
        with terminal.said_apart():
            terminal.write(terminal.STANDARD_OUTPUT, {})


def test_help_shows_a_dozen_options_all_on_demand_each_once_and_h_is_help():
    """Of the program, of each group and of each command; the same text as with the whole word."""
    for words in ("", *COMMANDS):
        short, long = (CliRunner().invoke(app, [*words.split(), option]) for option in ("-h", "--help"))
        assert (short.exit_code, short.output) == (0, long.output), words
        assert short.output.startswith("Usage: "), words
        assert re.search(r"-h, --help +Show this message and exit\.", short.output), words
    used = set()
    for words, callback in COMMANDS.items():
        each = [CliRunner().invoke(app, [*words.split(), option]).output for option in ("--help", "--help-all")]
        week, every = (re.findall(r"^  (?:-\w, )?(--[\w-]+)", shown, flags=re.MULTILINE) for shown in each)
        assert len(week) <= 12, words
        options = [name for name in inspect.signature(callback).parameters if _is_option(callback, name)]
        if "--help-all" not in week:  # nothing is left out
            assert len(week) == len(set(week)) == len(options) + 1, words  # and --help
            continue
        assert len(every) == len(set(every)) == len(options) + 2, words
        assert set(FIRST_WEEK[words]) <= {*options, *inspect.signature(callback).parameters}, words
        needed = ["[required]" in entry for entry in each[0].partition("Options:")[2].split("\n  -")[1:]]
        assert needed == sorted(needed, reverse=True), words
        used |= set(options)
        titles = re.findall(r"^([A-Z].*):$", each[1], flags=re.MULTILINE)
        assert titles == [t for t in ("Arguments", *PANELS, "Example", "Examples") if t in titles], words
    assert {name for names in PANELS.values() for name in names} <= used


def _is_option(command, name: str) -> bool:
    kind = inspect.signature(command, eval_str=True).parameters[name].annotation
    return any(isinstance(each, OptionInfo) for each in get_args(kind)[1:])


@pytest.fixture
def program(monkeypatch, capsys):
    """What a command came to: (exit code, standard output, standard error)."""

    def call(*words):
        monkeypatch.setattr("sys.argv", ["stcal", *map(str, words)])
        return ended(main, capsys)

    return call


def test_json_goes_to_standard_output_alone(program, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    nominal = tmp_path / "robot.toml"
    assert program("robot", "init", nominal)[0] == 0
    words = ["robot", "design", "--robot", nominal, "--count", "16", "--candidates", "40", "--out", "q.csv"]
    _, said, _ = program(*words, "--json", "design.json")
    code, out, err = program(*words, "--json", "-", "--overwrite")
    assert code == 0
    assert json.loads(out) == json.loads((tmp_path / "design.json").read_text(encoding="utf-8"))
    assert err.splitlines() == said.replace("written: design.json\n", "").splitlines()
    assert not (tmp_path / "-").exists()
    assert_error(program(*words[:-1], "-"), INPUT, "E-OPTION-STDOUT", "--out", "--json")
    assert not (tmp_path / "-").exists()
    last = [line.split()[-1] for line in said.splitlines() if line.startswith(("O1 ", "O2 "))]
    assert last == ["(D-optimality)", "number"]


@pytest.mark.parametrize(
    ("encoding", "shown"), [("utf-8", "12 µm \\u202e\\u009b"), ("ascii", "12 \\u00b5m \\u202e\\u009b")]
)
def test_json_on_a_terminal_is_printable_and_the_same(monkeypatch, encoding, shown):
    raw = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(raw, encoding=encoding))
    with terminal.said_apart():
        terminal.write(terminal.STANDARD_OUTPUT, {"note": "12 µm \u202e\x9b"})
    text = raw.getvalue().decode(encoding)
    assert json.loads(text) == {"note": "12 µm \u202e\x9b"}
    assert shown in text


def progress_of(capsys, monkeypatch, quiet: bool, verbose: bool) -> list[str]:
    """Three steps, a second and a half each."""
    clock = iter(100.0 + 1.5 * i for i in range(10))
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(clock))
    with terminal.manner(quiet, verbose), terminal.StageProgress() as progress:
        for done in range(4):
            progress("check", done, 3)
    return capsys.readouterr().err.splitlines()


def test_progress_as_lines(capsys, monkeypatch):
    each = ["check: 1 of 3, about 3 s left", "check: 2 of 3"]
    assert progress_of(capsys, monkeypatch, False, False) == [each[0], "check: 3 of 3"]
    assert progress_of(capsys, monkeypatch, False, True) == [*each, "check: 3 of 3 in 4.5 s"]
    assert progress_of(capsys, monkeypatch, True, False) == []


@pytest.mark.parametrize(("quiet", "waits"), [(False, False), (True, False), (False, True)])
def test_a_command_that_works_in_silence_says_what_it_is_at(capsys, monkeypatch, quiet, waits):
    monkeypatch.setattr(terminal, "LINE_EVERY_S", 0.2)
    with terminal.manner(quiet, False), terminal.StageProgress() as progress:
        progress("check", 0, 3)
        if waits:
            terminal.wait_for_others()
        time.sleep(0.6)
    said = capsys.readouterr().err.splitlines()
    assert all(line.startswith("check: ") for line in said)
    assert len(said) in ((0,) if quiet or waits else (1, 2, 3))


def test_a_quiet_command_says_errors_warnings_and_a_verdict_that_is_not_good_alone(program, tmp_path, capsys):
    """Once: as an error where it ends the command, else as a warning; not beside what a loud command printed."""
    for word in ("--quiet", "-q"):
        path = tmp_path / f"{word}.toml"
        assert program("robot", "init", path, word) == (0, "", "")
        assert path.exists()
        assert_error(program("robot", "init", path, word), INPUT, "E-OUTPUT-EXISTS")
    with terminal.manner(True, False):
        terminal.print_each("note", ["a"])
        terminal.print_each("warning", ["b\x1b"])
    assert capsys.readouterr() == ("", "warning: b?\n")
    for rule in RULES:
        for failed, verdict in ((["a", "b"], "do not use: a"), ([], "with care: c")):
            with terminal.manner(True, False):
                rule(False, failed, None, verdict)
                assert capsys.readouterr() == ("", f"warning: {verdict}\n")
                rule(False, [], None)
                if failed:
                    refuses("E-CHECKS-FAILED … a", rule, True, failed, None, verdict)
            with terminal.manner(False, False):
                rule(False, failed, None, verdict)
            assert capsys.readouterr() == ("", "")


RULES = (options.require_passed, options.require_usable)


def test_files_are_written_before_a_reader_such_as_head_ends_the_command(tmp_path, monkeypatch):
    class Ended(io.StringIO):
        def write(self, _):
            raise BrokenPipeError

    def command():
        with terminal.printed_last():
            terminal.say("the answer")
            terminal.write(tmp_path / "page.html", "the page", "report")

    monkeypatch.setattr(sys, "stdout", Ended())
    with pytest.raises(BrokenPipeError):
        command()
    assert (tmp_path / "page.html").read_text() == "the page"


FOLDERS = {(name, "out") for name in ("run", "detect", "demo", "from_photos", "export_model", "capture")}
FOLDERS |= {(name, "folder") for name in ("init", "design", "simulate")}
"""New ones, which replace nothing, or those of `tests/sfm/runs/test_transaction.py`."""
WRITES = ("Write ", "Also write ", "Draw ", "Keep ")
EVERY = list(COMMANDS.values())
PAIRS = [
    (command, output, read)
    for command in EVERY
    for output in sorted(command.outputs)
    for read in paths_of(command)
    if read not in command.outputs and (command.__name__, read) not in FOLDERS
]


def test_every_command_has_a_call_that_goes_through_and_every_option_that_writes_is_known():
    assert {call.command for call in CALLS} == set(COMMANDS)
    for command in EVERY:
        for name, says in paths_of(command).items():
            writes = name in command.outputs or (command.__name__, name) in FOLDERS
            assert writes == says.startswith(WRITES), (command.__name__, name, says)
    assert len(PAIRS) > 60


def test_no_output_replaces_an_input_or_a_file_in_silence(tmp_path):
    """The file itself, by another way to it, and a file in a folder that is read. One rule for every file that any
    command writes, before its work; links, to nothing too, are files."""
    own = tmp_path / "given"
    own.write_text("mine")
    another_way = tmp_path / "." / "x" / ".." / "given"
    for command, output, read in PAIRS:
        given = dict.fromkeys(paths_of(command))
        for paths in ({read: own, output: own}, {read: own, output: another_way}, {read: tmp_path, output: own}):
            refuses("E-OUTPUT-IS-INPUT … given", command, **given | paths)
    assert own.read_text() == "mine"
    place, link = tmp_path / "earlier", tmp_path / "link"
    place.write_text("a better one")
    link.symlink_to(tmp_path / "nothing")
    for command in EVERY:
        for output in command.outputs if command.__name__ not in ALWAYS_NEW else ():
            for path in (place, link):
                with fails_with(f"E-OUTPUT-EXISTS … {path} … --overwrite"):
                    command(**dict.fromkeys(paths_of(command)) | {output: path})
            assert "overwrite" in inspect.signature(command).parameters
    assert place.read_text() == "a better one"


def test_overwrite_replaces_what_is_there_and_calls_that_write_nothing_ask_for_nothing(tmp_path, monkeypatch, capsys):
    """The table of an earlier call, and only with the option. `measure --serve` beside an earlier poses.csv: the file
    of the camera is what is refused."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b.toml").write_text("mine")

    def init(*more):
        monkeypatch.setattr("sys.argv", ["stcal", "robot", "init", "b.toml", *more])
        return ended(main, capsys)

    assert_error(init(), 2, "E-OUTPUT-EXISTS", "error: b.toml: exists; give another name, or --overwrite to replace it")
    assert (tmp_path / "b.toml").read_text() == "mine"
    assert init("--overwrite")[::2] == (0, "")
    assert "[[joint]]" in (tmp_path / "b.toml").read_text()
    monkeypatch.chdir(tmp_path)
    Path("poses.csv").write_text("an earlier table")
    given = {"camera": tmp_path / "none.txt", "faces": tmp_path / "none.json", "out": Path("poses.csv")}
    refuses("E-OUTPUT-EXISTS … --out poses.csv", COMMANDS["sfm measure"], **given, images=tmp_path / "images")
    with fails_with("E-FILE-UNREADABLE … none.json"):
        COMMANDS["sfm measure"](
            **given, target=None, board=None, sigma_factor=None, json_file=None, report=None, joints=None,
            previous=False, sequence=False, scheduler=None, send_images=False, strict=False, serve=True,
            min_diameter=None, max_diameter=450.0, host="127.0.0.1", port=0, max_megabytes=1.0, workers=None,
        )  # fmt: skip


def test_outputs_are_kept_apart_from_one_another_and_from_what_is_read(tmp_path, monkeypatch):
    """A file beside a run's own is written again, and one in a folder of images, from where no command reads it."""
    run = tmp_path / "run"
    for name in (RUN_MARKER, "advice.json", "faces.json"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("{}")
    keep_apart([("--json", run / "advice.json")], [("run", run)])
    for name in RUN_ENTRIES:
        (run / name).touch()
        refuses("E-OUTPUT-IS-INPUT … run", keep_apart, [("--json", run / name)], [("run", run)])
    monkeypatch.chdir(tmp_path)
    refuses("E-OUTPUT-TWICE … --out", keep_apart, [("--out", tmp_path / "a"), ("--json", tmp_path / "a")], [])
    refuses("E-OUTPUT-FOLDER … --out", keep_apart, [("--out", tmp_path)], [])
    for out in (tmp_path / "a", Path("a")):
        with fails_with(f"E-OUTPUT-IS-INPUT … --out {out}"):
            keep_apart([("--out", out)], [("sources", tmp_path / "a"), ("sources", tmp_path / "b")])
    for name in ("poses.csv", "a.json", "b.HTML", "figure.svg"):
        (tmp_path / name).write_text("an earlier table")
        for out in (name, "new.json"):
            keep_apart([("--out", tmp_path / out)], [("images", tmp_path)])
        for read in ("a.jpg", "cameras.txt", "points3D.bin", "database.db", "drawing.png"):
            (tmp_path / read).write_text("mine")
            refuses("E-OUTPUT-IS-INPUT … images", keep_apart, [("--out", tmp_path / read)], [("images", tmp_path)])


def test_numbers_have_both_ends():
    """A width of 1e20 px, or a distance of 1e308 mm, ends in the numerics; options without a range, and σ of
    hand-eye, are judged by the stage that they go to."""
    for command, function in COMMANDS.items():
        for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
            info = next(each for each in get_args(parameter.annotation) if isinstance(each, ParameterInfo))
            if command == "handeye" and name.startswith("sigma"):
                continue
            assert (info.min is None) == (info.max is None), f"{command}: {name}"
