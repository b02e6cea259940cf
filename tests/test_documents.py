"""The documents: their links lead somewhere, their commands can be typed, what ``docs/sources.md`` names is there, the
pages made from the program have all of its options, keys and errors, and the tutorials run, block after block, and
print what they say; figures are those that scripts printed, cell by cell, and the scripts print them still. `.ci/run`
builds the whole site."""

import os
import re
import shlex
import subprocess
import sys
from importlib import import_module
from itertools import takewhile
from pathlib import Path

import pytest
from typer.main import get_command

import stcal
import stcal.errors
from stcal import load_flat_board, load_target
from stcal.cli.help import EXAMPLES, GROUPS
from stcal.cli.main import app
from stcal.locate.layout import load_layout
from stcal.sfm.report.check import CAUSE, CHECKS
from tests.commands import CALLS
from tests.levels import FULL, SLOW, sampled
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
site = load_script("build_site")  # makes the modules of docs/site importable
pages, errors_page, files_pages = (__import__(name) for name in ("pages", "errors_page", "files_pages"))
DOCUMENTS = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")))
}
LINK = re.compile(r"\]\(([^)\s]+)\)")
TYPED = re.compile(r"^(?:\$ )?(stcal(?:-sfm)? [^\n]+)", re.MULTILINE)
BLOCK = re.compile(r"^(<!-- printed by[^\n]*\n)?```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAM = get_command(app)


def blocks(text: str, *languages: str) -> list[str]:
    """Blocks of a document in one of these languages that no script printed."""
    return [code for printed, language, code in BLOCK.findall(text) if not printed and language in languages]


def commands(command, path=()):
    """(name, command) of all that have no commands of their own."""
    own = getattr(command, "commands", {})
    if not own:
        yield " ".join(path), command
    for name, each in own.items():
        yield from commands(each, (*path, name))


def parse(line: str) -> None:
    """Parses a call as the program would."""
    words = shlex.split(line, comments=True)
    words = ["sfm", *words[1:]] if words[0] == "stcal-sfm" else words[1:]
    command, context = PROGRAM, PROGRAM.make_context("stcal", [], resilient_parsing=True)
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name, command, words = command.resolve_command(context, words)
        context = command.make_context(name, [], parent=context, resilient_parsing=True)
    if not hasattr(command, "commands"):
        command.make_context(command.name, words, parent=context)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_commands_in_documents_can_be_typed_and_links_lead_to_files(name):
    for block in blocks(DOCUMENTS[name], "", "bash"):
        for line in TYPED.findall(block.replace("\\\n", " ")):
            if "…" not in line:
                parse(line)
    links = [link.partition("#")[0] for link in LINK.findall(DOCUMENTS[name])]
    paths = [link for link in links if link and not link.startswith("http")]
    assert [link for link in paths if not (ROOT / name).parent.joinpath(link).exists()] == []


def test_examples_of_files_can_be_read_the_first_page_is_short_and_the_version_is_one(tmp_path):
    found = blocks(DOCUMENTS["docs/reference/files-in.md"], "toml")
    for k, (read, text) in enumerate(zip((load_target, load_target, load_flat_board, load_layout), found, strict=True)):
        (tmp_path / f"{k}.toml").write_text(text, encoding="utf-8")
        read(tmp_path / f"{k}.toml")
    assert len(DOCUMENTS["README.md"].splitlines()) < 180
    assert f"\nversion: {stcal.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    told = set(re.findall(r"^\| [^|]+\(`([\w-]+)`\)", DOCUMENTS["docs/howto/checks.md"], re.MULTILINE))
    assert told == CHECKS.keys() - {CAUSE}


@pytest.mark.slow
def test_the_pages_made_have_every_option_key_and_error():
    made = dict(pages.made())
    listed = "".join(text for place, text in made.items() if place.startswith("reference/commands/"))
    for name, command in commands(PROGRAM):
        options = [option for each in command.params for option in each.opts if option.startswith("--")]
        assert [option for option in options if option != "--help" and option not in listed] == [], name
    for system, models in files_pages.models().items():
        page = made[f"reference/files/{system}.md"]
        keys = [field.alias or key for model in models for key, field in model.model_fields.items()]
        assert [key for key in keys if f"`{key}" not in page] == []
    assert len(errors_page.all_errors()) > 300
    assert {f"\n## {code}\n" in made["reference/errors.md"] for _, code, _ in errors_page.all_errors()} == {True}


def test_each_code_of_an_error_has_one_exit_code():
    exits: dict[str, set[int]] = {}
    for kind, code, _ in errors_page.all_errors():
        if hasattr(stcal.errors, kind):
            exits.setdefault(code, set()).add(getattr(stcal.errors, kind).exit_code)
    assert {code: found for code, found in exits.items() if len(found) > 1} == {}


def test_every_help_is_a_sentence_with_an_example_that_can_be_parsed_and_its_groups_hold_every_command():
    for name, command in commands(PROGRAM):
        helps = {each.name: each.help for each in command.params if each.name != "help"} | {"": command.help}
        first = {what: (text or "").split("\n\n")[0].strip() for what, text in helps.items()}
        assert [what for what, text in first.items() if not re.match(r"[A-Z].*(\.|….)$", text, re.DOTALL)] == [], name
    assert set(EXAMPLES) == {name for name, _ in commands(PROGRAM)}
    for words, calls in EXAMPLES.items():
        for call in calls:
            parse(f"stcal {words} {call}")
    for words, groups in GROUPS.items():
        names = [name for group in groups.values() for name in group]
        group = PROGRAM if words == "stcal" else PROGRAM.commands[words]
        assert sorted(names) == sorted(group.commands)


def test_every_page_is_listed_links_hold_where_pages_stand_in_the_site_and_dead_ones_are_found(tmp_path):
    """Sphinx would end the build."""
    index = site.DOCS / "index.md"
    listed = {(index.parent / link).resolve() for link in site.items(index.read_text("utf-8"))}
    assert sorted(set(site.documents()) - listed - {index}) == []
    page, linked = site.DOCS / "howto" / "checks.md", set()
    text = "[a](../cameras.md#x) [b](../../data_layout.md) [c](https://x.org) [e](../../README.md) [f](../none.md)"
    made = site.with_links(text, page, linked)
    assert made == "[a](../cameras.md#x) [b](../data_layout.md) [c](https://x.org) [e](../README.md) [f](../none.md)"
    assert {path.name for path in linked} == {"cameras.md", "data_layout.md", "README.md"}
    (tmp_path / "a.html").write_text('<a href="b.html#one">1</a><a href="b.html#two">2</a><img src="none.png">')
    (tmp_path / "b.html").write_text('<h1 id="one">x</h1><a href="/rooted">3</a><a href="https://x.org/y">4</a>')
    assert list(site.dead_links(tmp_path)) == ["a.html: b.html#two", "a.html: none.png", "b.html: /rooted"]


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(site, "build_main", None)
    with pytest.raises(SystemExit) as caught:
        site.build(tmp_path / "site")
    assert 'scripts/setup "[docs]"' in str(caught.value)
    assert "\n" not in str(caught.value)


QUOTED = re.findall(r"`([^`]+)`", (ROOT / "docs" / "sources.md").read_text(encoding="utf-8"))
NAMED = sorted({each for each in QUOTED if re.match(r"stcal(-sfm)? ", each)})
FUNCTIONS = sorted({each for each in QUOTED if re.fullmatch(r"stcal(\.\w+)+", each)})
SCRIPTS = sorted({each for each in QUOTED if each.startswith("scripts/")})


def test_each_function_script_and_command_is_there():
    """With all its options; calls are made by `tests/sfm/test_fuzz.py`."""
    for name in FUNCTIONS:
        module, _, function = name.rpartition(".")
        assert hasattr(import_module(module), function), name
    assert [name for name in SCRIPTS if not (ROOT / name).is_file()] == []
    for call in CALLS:
        parse(shlex.join(["stcal", *call.command.split(), *call.split()]))
    for text in NAMED:
        program, *words = shlex.split(text)
        words = ["sfm", *words] if program == "stcal-sfm" else words
        calls = [[*call.command.split(), *call.split()] for call in CALLS if call.code == 0]
        own = [call for call in calls if call[: len(call_words(words))] == call_words(words)]
        assert any(choices(words) <= choices(call) for call in own), text


def choices(words: list[str]) -> set[str]:
    """Options and words chosen with them; other numbers and files serve as well."""
    return {word for word in words if re.fullmatch(r"--[\w-]+|[a-z][a-z-]+\d*", word)}


def call_words(words: list[str]) -> list[str]:
    """The words before the first option: those of the command."""
    return list(takewhile(lambda word: not word.startswith("--"), words))


TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
TAUGHT = re.compile(r"^```(bash|python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LONG = ("cube-of-tags", "hand-eye", "own-target", "robot", "tags")
"""Tutorials of more than twenty seconds whose chains other slow tests make too; `test_documents` parses their calls."""
SMALLER = {
    "(2016, 1512)": "(1008, 756)",
    "2016 1512 1530 1531 1012.3 748.6": "1008 756 765 765.5 506.15 374.3",
    "--images 6": "--images 4",
    " --pdf\n": "\n",
}
"""Of the tutorial of a target of one's own: smaller cameras, fewer photographs and no PDF; it says the same of them."""
NUMBER = re.compile(r"\d+(?:\.\d+)?")  # of what a page shows; another processor rounds otherwise


def run(kind: str, code: str, folder: Path) -> str:
    """What a block prints, run in a folder by the program that is tested."""
    programs = str(Path(sys.executable).parent)
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    words = ["bash", "-euo", "pipefail", "-c", code] if kind == "bash" else [sys.executable, "-c", code]
    ended = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{code}\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout


@pytest.mark.parametrize(
    ("page", "smaller"),
    [
        *(pytest.param(page, {}, marks=FULL if page.stem in LONG else SLOW, id=page.stem) for page in TUTORIALS),
        pytest.param(ROOT / "docs/tutorials/own-target.md", SMALLER, marks=SLOW, id="own-target, smaller"),
    ],
)
def test_a_tutorial_runs_and_prints_what_it_says(page, smaller, tmp_path):
    text = page.read_text("utf-8")
    for large, small in smaller.items():
        assert large in text
        text = text.replace(large, small)
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    printed = ""
    for kind, code in TAUGHT.findall(text):
        if kind != "text":
            printed = run(kind, code, tmp_path)
            continue
        lines = {NUMBER.sub("#", line).strip() for line in printed.splitlines()}
        assert [line for line in code.splitlines() if NUMBER.sub("#", line).strip() not in lines] == [], printed


def test_every_tutorial_has_blocks_that_run():
    assert len(TUTORIALS) >= 4
    for page in TUTORIALS:
        assert {kind for kind, _ in TAUGHT.findall(page.read_text("utf-8"))} & {"bash", "python"}, page.name


printed = load_script("printed")
BLOCKS = printed.of_documents()
MARKED = [block for block in BLOCKS if block.command]
NOT_YET = {"docs/accuracy.md: face as published + centres of blurred edges + eccentricity +"}
"""Of reproduce_paper.py, which takes long and whose output is not stored yet."""
QUICK = {"register_shared": "hilti_stationing", "reproduce_registration": None, "camera_formats": None}
"""Commands of about half a minute, and the data set that they are run on, which is not part of the repository."""


def test_every_block_of_figures_has_what_a_script_printed_and_stored():
    assert {block.name for block in BLOCKS if not block.command} == NOT_YET
    found = {block.name: printed.first_missing(block, printed.stored(block.command)[1]) for block in MARKED}
    assert {name: missing for name, missing in found.items() if missing is not None} == {}
    commands = {printed.name_of(block.command): block.command for block in MARKED}
    assert sorted(path.stem for path in printed.PRINTED.iterdir()) == sorted(commands)
    assert [c for c in commands.values() if not (printed.ROOT / shlex.split(c)[0]).is_file()] == []


@pytest.mark.parametrize("name", sampled(QUICK, kept=(2,)))
def test_quick_scripts_print_the_same_again(name, shared_data):
    """To one unit of the last digit shown: another processor rounds otherwise."""
    (command,) = {block.command for block in MARKED if printed.name_of(block.command) == name}
    data = QUICK[name] and shlex.quote(str(shared_data(QUICK[name])))
    now = printed.run(f"{command} {data or ''}")
    assert printed.differing_figures(printed.stored(command)[1], now) == []


TABLE = """Text.

<!-- printed by: scripts/some.py --only one -->
| case | a | b |
|---|---|---|
| first | 1.25 | 3 ± 1 |
| second | 2.5 | – |

| word | other |
|---|---|
| 1 | none |

```
head   x     y
one    1.25  2.50
two    -1.00 3.75  4.5
```
"""
OUTPUT = ["Title", "", "| case | a | b |", "|---|---|---|", "| first | 1.25 | 3 ± 1 |", "| second  | 2.5 | – |", "end"]


def test_a_cell_that_differs_is_named_by_the_digits_shown():
    """A table of words is none; a comment stands for one of few figures too. Rows may be left out, but not
    exchanged."""
    one, two = printed.blocks("x.md", TABLE)
    assert (one.line, one.command, len(one.rows)) == (4, "scripts/some.py --only one", 3)
    assert (two.line, two.command, two.rows[1]) == (13, None, ("one", "1.25", "2.50"))
    assert printed.name_of(one.command) == "some_only_one"
    block = printed.blocks("x.md", TABLE)[0]
    assert printed.first_missing(block, OUTPUT) is None
    assert printed.first_missing(block, [*OUTPUT[:5], "| between | 1 | 2 |", *OUTPUT[5:]]) is None
    assert printed.first_missing(block, [line.replace("2.5", "2.6") for line in OUTPUT]) == "second | 2.5 | –"
    assert printed.first_missing(block, [*OUTPUT[:4], OUTPUT[5], OUTPUT[4]]) == "second | 2.5 | –"
    differing = printed.differing_figures
    assert differing(["a 1.25 of 30"], ["a  1.26 of 30"]) == []
    assert differing(["a 1.25 of 30"], ["a 1.27 of 30"]) != []
    assert differing(["a 1.25"], ["b 1.25"]) != []
    assert differing(["a"], ["a", "b"]) != []
