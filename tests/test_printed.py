"""Figures of the documents are those that their scripts printed, cell by cell, and the scripts print them still."""

import shlex

import pytest

from tests.levels import sampled
from tests.scripts import load_script

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
