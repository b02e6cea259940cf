"""The tutorials run, block after block, and print what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.levels import FULL, SLOW

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
BLOCK = re.compile(r"^```(bash|python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
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
    for kind, code in BLOCK.findall(text):
        if kind != "text":
            printed = run(kind, code, tmp_path)
            continue
        lines = {NUMBER.sub("#", line).strip() for line in printed.splitlines()}
        assert [line for line in code.splitlines() if NUMBER.sub("#", line).strip() not in lines] == [], printed


def test_every_tutorial_has_blocks_that_run():
    assert len(TUTORIALS) >= 4
    for page in TUTORIALS:
        assert {kind for kind, _ in BLOCK.findall(page.read_text("utf-8"))} & {"bash", "python"}, page.name
