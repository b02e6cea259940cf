"""The documents know every option of every command."""

import ast
import re
import shlex
from pathlib import Path

from typer.main import get_command

import stcal
import stcal.errors
from stcal.cli.help import EXAMPLES, GROUPS
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
Count Cross-validate Decide Define Detect Divide Draw End Explain Find Fit Follow Forecast Give Hand Hold Identify
Ignore Keep Lay Listen Look Make Map Match Measure Multiply Name Number Photograph Place Plan Print Rank Read Reject
Render Replace Run Say Send Set Show Solve Spread Start Stop Take Tell Treat Use Write
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


PREPOSITIONS = """
about above across after against along among amid around as at before behind below beneath beside between beyond by
despite during except for from in inside into like near of off on onto out outside over past per since than through
till to toward towards under until up upon via with within without
"""
IRREGULAR = """
begun bent born borne bound broken brought built bought caught chosen dealt done drawn driven fallen fed felt forgotten
fought found frozen given gone grown heard held hidden kept known laid led lent lost made meant met paid said seen sent
shown slid spent spoken stood struck stuck swept taken taught thought thrown told torn understood won worn woven written
"""
"""Past participles without -ed, except those that are nouns, adjectives or verbs as often (cut, left, set, run)."""
NOUNS = """
bearing bed beginning being building casting coating coupling drawing ending feed fitting heading king lighting mapping
meaning morning mounting need opening padding painting reading rendering ring seed setting spacing speed spring string
thing timing warning wing wiring
"""
FIRST_WORD = re.compile(r"[^\w`]*([A-Za-z]+)(?![\w`-])\W*(\w*)")
"""A first word of letters only, and the next word. Names in ``code`` and compounds such as closed-form do not match."""


def docstrings_of(source: str):
    """(line, text) of the strings that document a module, class or function, and of those under an assignment."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for k, statement in enumerate(body if isinstance(body, list) else ()):
            value = statement.value if isinstance(statement, ast.Expr) else None
            documents = k == 0 or isinstance(body[k - 1], ast.Assign | ast.AnnAssign)
            if documents and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value


def fragment(text: str) -> str:
    """The preposition or bare participle that a text begins with; a word in -ing before *of* is a noun."""
    match = FIRST_WORD.match(text)
    word, following = (match[1].lower(), match[2].lower()) if match else ("", "")
    if word in NOUNS.split():
        return ""
    past = word in IRREGULAR.split() or word.endswith("ed")
    present = word.endswith("ing") and following not in ("of", "and", "or", "")
    return word if past or present or word in PREPOSITIONS.split() else ""


def fragments(source: str) -> list[str]:
    return [f"line {line}: {text.strip()[:60]}" for line, text in docstrings_of(source) if fragment(text)]


def test_docstrings_begin_with_a_sentence_or_a_noun():
    files = sorted(ROOT.joinpath("stcal").rglob("*.py"))
    assert len(files) > 100
    found = {str(file.relative_to(ROOT)): fragments(file.read_text(encoding="utf-8")) for file in files}
    assert {file: lines for file, lines in found.items() if lines} == {}


FRAGMENTS = '''"""By medians."""
A = 1
"""Of a rim, px."""


class B:
    """Made anew."""

    c: int
    """… to here."""

    def d(self):
        """Measured once."""
        return """of no matter"""

    def e(self):
        """Taking the last."""


def f():
    """Returns what is left."""
'''


def test_fragments_of_docstrings_are_found():
    assert sorted(int(line.split(":")[0].removeprefix("line ")) for line in fragments(FRAGMENTS)) == [
        1,
        3,
        7,
        10,
        13,
        17,
    ]


def test_nouns_and_sentences_are_no_fragments():
    for text in (
        "Returns the poses.",
        "Mapping of a group, and its notes.",
        "Spacing between two lines of text.",
        "Drawing as PDF.",
        "Closed-form solutions.",
        "``by`` : the unit.",
        "Speed of a joint, rad/s.",
        "Need of memory, bytes.",
        "Left perturbation.",
        "Set of rows that agree.",
        "",
    ):
        assert fragment(text) == "", text
    for text in (
        "For messages.",
        "without noise",
        "Found by no one.",
        "Solved again.",
        "… as it is",
        "Giving the pose.",
    ):
        assert fragment(text), text


def test_every_command_has_an_example_that_can_be_parsed():
    root = get_command(app)
    found, parent = dict(commands(root)), root.make_context("stcal", [], resilient_parsing=True)
    assert set(EXAMPLES) == set(found)
    for words, calls in EXAMPLES.items():
        for call in calls:
            found[words].make_context(words, shlex.split(call), parent=parent)


def test_the_groups_of_the_help_hold_every_command():
    for words, groups in GROUPS.items():
        names = [name for group in groups.values() for name in group]
        group = get_command(app) if words == "stcal" else get_command(app).commands[words]
        assert sorted(names) == sorted(group.commands)
