"""The documents know every option of every command."""

import re
from pathlib import Path

from typer.main import get_command

import stcal
import stcal.errors
from stcal.cli.main import app
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = (ROOT / "README.md", ROOT / "data_layout.md", *sorted((ROOT / "docs").rglob("*.md")))
LINK = re.compile(r"\]\(([^)\s]+)\)")


def commands(command, path=()):
    """(name, command) of all that have no commands of their own."""
    own = getattr(command, "commands", {})
    if not own:
        yield " ".join(path), command
    for name, each in own.items():
        yield from commands(each, (*path, name))


def test_every_option_is_documented():
    text = "".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    for name, command in commands(get_command(app)):
        options = [option for each in command.params for option in each.opts if option.startswith("--")]
        assert [option for option in options if option != "--help" and option not in text] == [], name


VERBS = """
Accept Add Adjust Advise Allow Also Answer Assume Begin Blur Calibrate Call Choose Compare Compute Convert Copy Correct
Count Cross-validate Decide Detect Divide Draw End Explain Find Fit Follow Forecast Give Hand Hold Identify Ignore Keep
Lay Listen Look Make Map Match Measure Multiply Name Photograph Place Plan Print Rank Read Reject Render Replace Run Say
Send Set Show Solve Spread Start Stop Take Tell Treat Use Write
"""
"""With which a help text may begin; *Also* goes before one of the others."""


def test_every_help_is_a_sentence_with_a_verb():
    for name, command in commands(get_command(app)):
        texts = {f"{name} {each.name}": each.help for each in command.params if each.name != "help"}
        for what, text in (texts | {name: command.help}).items():
            first = (text or "").split("\n\n")[0].strip()
            words = first.split()
            assert words, f"{what}: no help"
            assert words[0] in VERBS.split(), f"{what}: {first}"
            assert words[0] != "Also" or words[1] == "write", f"{what}: {first}"
            assert first.endswith((".", "….")), f"{what}: {first}"


layout = load_script("data_layout")


def test_the_tables_of_result_files_are_those_of_the_models():
    texts = {document.name: document.read_text(encoding="utf-8") for document in layout.documents()}
    assert {name: wrong for name, text in texts.items() if (wrong := layout.made_anew(text)[1])} == {}


def test_every_model_has_its_table():
    text = "".join(document.read_text(encoding="utf-8") for document in layout.documents())
    assert {"FacesFile", "IdentifiedFile", "RegistrationFile"} <= {name for _, name, _, _ in layout.BLOCK.findall(text)}


def test_a_table_that_differs_is_named():
    text = (layout.FILES / "run.md").read_text(encoding="utf-8")
    changed = text.replace("| `eccentricity` | true or false |", "| `eccentricity` | number |")
    assert changed != text
    again, differing = layout.made_anew(changed)
    assert (again, differing) == (text, ["FacesFile"])


def test_links_of_documents_lead_to_files():
    for document in DOCUMENTS:
        links = [link.partition("#")[0] for link in LINK.findall(document.read_text(encoding="utf-8"))]
        paths = [link for link in links if link and not link.startswith("http")]
        assert [link for link in paths if not (document.parent / link).exists()] == [], document.name


def test_first_page_is_short_and_the_version_is_one():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 180
    assert f"\nversion: {stcal.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_page_of_checks_has_each_check_by_its_key():
    page = (ROOT / "docs" / "howto" / "checks.md").read_text(encoding="utf-8")
    told = set(re.findall(r"^\| [^|]+\(`([\w-]+)`\)", page, re.MULTILINE))
    sources = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "stcal" / "sfm" / "checks").glob("*.py"))
    made = set(re.findall(r'(?:judge|key = |key, title = |impossible)\(?"([a-z-]+)"', sources))
    assert told == made


errors = load_script("errors")


def test_the_page_of_errors_is_that_of_the_source():
    """`scripts/errors.py` makes it anew; a changed sentence is read in its diff."""
    assert errors.PAGE.read_text(encoding="utf-8") == errors.page()


def test_each_error_has_a_code_and_each_code_one_exit_code():
    exits: dict[str, set[int]] = {}
    for kind, code, _ in errors.all_errors():
        if hasattr(stcal.errors, kind):
            exits.setdefault(code, set()).add(getattr(stcal.errors, kind).exit_code)
    assert len(exits) > 300
    assert {code: found for code, found in exits.items() if len(found) > 1} == {}
