"""Folders that can be seen at a glance, and names that stand for one thing. pyproject.toml says who imports whom."""

import importlib
from collections import Counter
from pathlib import Path

import stcal

ROOT = Path(stcal.__file__).parent
FILES = sorted(path.relative_to(ROOT) for path in ROOT.rglob("*.py"))
MOST_FILES = 14
"""Most files of a folder: what can be seen at a glance."""
MOST_ENTRIES = 16  # most folders and files of `sfm/`
SYSTEMS = ("sfm", "robot", "register", "handeye", "locate")


def test_folders_can_be_seen_at_a_glance_and_names_stand_for_one_thing():
    counts = Counter(path.parent for path in FILES)
    assert {folder: n for folder, n in counts.items() if n > MOST_FILES} == {}
    entries = [p for p in (ROOT / "sfm").iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()]
    assert len(entries) <= MOST_ENTRIES
    assert [path for path in FILES if path.stem == path.parent.name] == []
    stems = Counter(path.stem for path in FILES if not path.stem.startswith("__"))
    assert {stem: n for stem, n in stems.items() if n > 1} == {}
    for system in SYSTEMS:
        names = importlib.import_module(f"stcal.{system}").__all__
        assert {each.stem for each in (ROOT / system).iterdir()} & set(names) == set()
