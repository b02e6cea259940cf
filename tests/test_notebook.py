"""The notebook of the tutorials runs as a whole, and shows what its text says."""

import json
import re
from pathlib import Path

import pytest

from tests.levels import SLOW

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "docs" / "tutorials" / "notebook.ipynb"


def shown(cell: dict) -> str:
    """Text and HTML that a cell has printed or shown."""
    outputs = cell.get("outputs", [])
    return "".join(
        str(part)
        for output in outputs
        for part in (output.get("text", ""), *(value for key, value in output.get("data", {}).items() if "text" in key))
    )


def test_the_notebook_is_kept_without_outputs():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert sum(cell["cell_type"] == "code" for cell in cells) >= 8
    assert [cell["id"] for cell in cells if cell.get("outputs") or cell.get("execution_count")] == []


@SLOW
@pytest.mark.filterwarnings("default")  # those of Jupyter's packages are not ours
def test_the_notebook_runs(tmp_path, monkeypatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=":")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    cells = {cell["id"]: cell for cell in notebook.cells}
    texts = {name: shown(cell) for name, cell in cells.items()}
    pictures = [
        name for name, cell in cells.items() for o in cell.get("outputs", []) if "image/png" in o.get("data", {})
    ]
    assert len(pictures) == 2
    whole = "\n".join(texts.values())
    assert re.search(r"<p>may I use it\? Yes, for faces? 1.*face 3 .* seen in no image", whole)
    off_um = [float(value) for value in re.findall(r"(\d+) µm, \d+ mdeg off the truth", whole)]
    assert len(off_um) >= 3
    assert max(off_um) < 100  # circles are placed to 20 µm per axis; a frame at 138 mm follows by some of it
    assert whole.count("certain") >= 3
    turns = [float(value) for value in re.findall(r"(\d+\.\d)°", whole)]
    assert max(turns) > 10
    assert list(tmp_path.glob("*.*")) == []
