"""What commands print is text: a terminal obeys nothing of it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import stcal
from stcal.cli import terminal
from stcal.cli.entry import lacks_memory

CLI = Path(stcal.__file__).parent / "cli"


@pytest.mark.parametrize("name", ["\x1b[31mred", "a\rb", "bell\x07", "\u202egpj.exe", "\x9b2J", "\udc80"])
def test_what_a_terminal_would_obey_is_a_question_mark(capsys, name):
    terminal.say(f"12/{name}.jpg: 0.2 µm ± 3 mdeg – σ\n\u2009fine")
    terminal.print_each("left out", [name])
    text = capsys.readouterr().out
    assert all(c.isprintable() or c in "\n\u2009" for c in text)
    assert "\x1b" not in text
    assert text.splitlines()[-1] in (
        "left out: ?[31mred",
        "left out: a b",
        "left out: bell?",
        "left out: ?gpj.exe",
        "left out: ?2J",
        "left out: ?",
    )
    assert "0.2 µm ± 3 mdeg – σ\n\u2009fine\n" in text


def test_every_command_prints_through_it():
    for path in CLI.glob("*.py"):
        found = re.findall(r"(?<![\w.])print\((?!stcal|said|f\"error)", path.read_text(encoding="utf-8"))
        allowed = {"terminal.py": 2, "main.py": 2}.get(path.name, 0)
        assert len(found) <= allowed, path.name


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


def test_the_version_loads_nothing():
    code = "import sys; from stcal.cli.entry import main; main(); print('typer' in sys.modules)"
    words = [sys.executable, "-P", "-c", code, "--version"]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert printed == f"{stcal.__version__}\nFalse\n"


def test_help_loads_no_numerics():
    """They take longer than all the rest; Typer itself loads pydantic."""
    code = "import sys, stcal.cli.main; print([m for m in ('numpy', 'yaml', 'rich.progress') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device there")
@pytest.mark.parametrize("words", ["--version", "--help"])
def test_text_that_nothing_takes_is_one_line(words):
    begin = "from stcal.cli.entry import main; main()"
    with open("/dev/full", "w") as full:
        found = subprocess.run([sys.executable, "-c", begin, words], stdout=full, stderr=-1, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.startswith("error: No space left on device; ")
    assert found.stderr.count("\n") == 1
