"""Whether the tests find faults: the package with one fault at a time, and the share of faults that a test finds.

.venv/bin/python scripts/studies/mutants.py draw FILE [--count 150] [--seed 1]
.venv/bin/python -m pytest -n 2 --cov=stcal --cov-context=test --cov-report= --junitxml build/tests.xml
.venv/bin/python scripts/studies/mutants.py run FILE [--seconds 60] [--marked "not full"]

`draw` writes faults that cosmic-ray makes: other operators, comparisons, numbers, loops that do not run. They are
spread over all folders of the package; a fault changes one line of a function's body, no message and no annotation.
`run` applies each to a copy of the repository and runs the tests that reach its line by `.coverage`, and those of its
folder and the folders above that the coverage was not measured with: of both the shortest (by `build/tests.xml`) that
together take `--seconds`, until one fails. Results are added to the file; a second call goes on where the first ended.
Needs `pip install "stereo-target-calibration[mutants]"`.
"""

import ast
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from xml.etree import ElementTree

import numpy as np

from scripts.runner import ROOT, script

PACKAGE = ROOT / "stcal"
OPERATORS = ("ReplaceComparisonOperator_", "ReplaceBinaryOperator_", "ReplaceUnaryOperator_")
ALSO = ("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd")
ALSO += ("NumberReplacer", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ZeroIterationForLoop")
NEVER = ("BitOr", "BitAnd", "BitXor", "Shift", "Is", "Pow", "FloorDiv", "Invert")
"""In names of operators: of annotations and sets, or faults of types rather than of values."""
PYTEST = (sys.executable, "-m", "pytest", "-p", "no:randomly")
START_S = 40.0
"""That a test process may take before its first test."""


def lines_in_bodies(source: str) -> set[int]:
    """Numbers of lines on which a simple statement of a function's body stands, but for errors and texts."""
    found: set[int] = set()
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Assign | ast.AugAssign | ast.Return | ast.If | ast.While | ast.For):
                found.add(node.lineno)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.AnnAssign):
            last = node.body[0].lineno - 1 if isinstance(node, ast.FunctionDef) else node.end_lineno or node.lineno
            found -= set(range(node.lineno, last + 1))
    return found


def fault_of(path: Path, rng: np.random.Generator) -> dict | None:
    """A fault of a module: its path, the line as it is and as it becomes, and the line's number; None on a bad draw."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    source = path.read_text(encoding="utf-8")
    short = [name.split("/")[1] for name in operator_names()]
    kinds = [n for n in short if n in ALSO or (n.startswith(OPERATORS) and not any(word in n for word in NEVER))]
    name = str(rng.choice(kinds))
    changed = mutate_code(source, get_operator(f"core/{name}")(), int(rng.integers(12)))
    lines, after = source.split("\n"), (changed or "").split("\n")
    differing = [i for i, (a, b) in enumerate(zip(lines, after, strict=False)) if a != b]
    if len(after) != len(lines) or len(differing) != 1 or differing[0] + 1 not in lines_in_bodies(source):
        return None
    (i,) = differing
    which = [k for k, line in enumerate(lines) if line == lines[i]].index(i)
    place = {"path": str(path.relative_to(ROOT)), "line": i + 1, "which": which}
    return place | {"before": lines[i], "after": after[i], "operator": name}


def draw(count: int, seed: int) -> list[dict]:
    """Faults of all folders of the package, more where there is more code, but by its square root."""
    rng = np.random.default_rng(seed)
    folders = sorted({path.relative_to(PACKAGE).parts[0] for path in PACKAGE.rglob("*.py")})
    files = {f: sorted((PACKAGE / f).rglob("*.py")) if "." not in f else [PACKAGE / f] for f in folders}
    sizes = {f: math.sqrt(sum(len(p.read_bytes()) for p in own)) for f, own in files.items()}
    found: dict[tuple, dict] = {}
    while len(found) < count:
        share = np.array(list(sizes.values()))
        folder = folders[rng.choice(len(folders), p=share / share.sum())]
        weights = np.array([len(path.read_bytes()) for path in files[folder]], float)
        path = files[folder][rng.choice(len(weights), p=weights / weights.sum())]
        fault = fault_of(path, rng)
        if fault:
            found.setdefault((fault["path"], fault["line"]), fault)
    return list(found.values())


def apply(fault: dict, root: Path) -> bool:
    """Put a fault into a copy of the repository; false where its line is not there any more."""
    path = root / fault["path"]
    lines = path.read_text(encoding="utf-8").split("\n") if path.exists() else []
    places = [i for i, line in enumerate(lines) if line == fault["before"]]
    if len(places) <= fault["which"]:
        return False
    lines[places[fault["which"]]] = fault["after"]
    path.write_text("\n".join(lines), encoding="utf-8")
    return True


class Choice:
    """Which tests may find a fault, and what they take."""

    def __init__(self, marked: str):
        from coverage import CoverageData

        words = [*PYTEST, "--collect-only", "-q", "-m", marked, "-o", "addopts=", "--import-mode=importlib"]
        printed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False).stdout
        self.tests = [line for line in printed.splitlines() if "::" in line]
        self.data = CoverageData(str(ROOT / ".coverage"))
        if (ROOT / ".coverage").exists():
            self.data.read()
        self.measured = {context.rpartition("|")[0] for context in self.data.measured_contexts()}
        self.taken: dict[str, float] = {}
        times = ROOT / "build" / "tests.xml"
        for case in ElementTree.parse(times).iter("testcase") if times.exists() else ():
            place = case.attrib["classname"].replace(".", "/") + ".py"
            self.taken[f"{place}::{case.attrib['name']}"] = float(case.attrib["time"])

    def of(self, fault: dict, seconds: float) -> list[str]:
        """Tests that reach the line, then those of the same folders, the shortest first, for so many seconds."""
        by_line = self.data.contexts_by_lineno(str(ROOT / fault["path"]))
        lines = range(fault["line"] - 3, fault["line"] + 1)  # a statement over several lines is counted at its first
        reach = {c.rpartition("|")[0] for line in lines for c in by_line.get(line, ())} & set(self.tests)
        folders = {str(Path("tests") / f) for f in Path(fault["path"]).relative_to("stcal").parents}
        beside = [t for t in self.tests if str(Path(t.partition("::")[0]).parent) in folders and t not in self.measured]
        return [*self._shortest(reach, seconds), *self._shortest(beside, seconds)]

    def _shortest(self, tests: Iterable[str], seconds: float) -> list[str]:
        chosen = sorted(tests, key=lambda t: self.taken.get(t, 1.0))
        total = np.cumsum([self.taken.get(t, 1.0) for t in chosen])
        return chosen[: max(1, int(np.sum(total <= seconds)))]


def copy_of(place: Path) -> Path:
    """A copy of the repository's files in an empty folder, with the shared data beside it."""
    root = place / "main"
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in names.splitlines():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, root / name)
    if (ROOT.parent / "shared").exists():
        (place / "shared").symlink_to(ROOT.parent / "shared")
    return root


def judge(fault: dict, choice: Choice, root: Path, seconds: float) -> dict:
    """``outcome`` of a fault: killed, survived, or no test; ``by`` : the test that failed."""
    tests, original = choice.of(fault, seconds), (ROOT / fault["path"]).read_bytes()
    if not tests:
        return fault | {"outcome": "no test", "by": ""}
    apply(fault, root)
    words = [*PYTEST, "-x", "-q", "-m", "", "-p", "no:cacheprovider", "--tb=line"]
    limit = START_S + 5 * seconds
    environment = os.environ | {"PYTHONPATH": str(root)}  # for programs that tests start, too
    try:
        with tempfile.TemporaryDirectory() as scratch:
            words += [f"--basetemp={scratch}/tests", *tests]
            ended = subprocess.run(
                words, cwd=root, env=environment, capture_output=True, text=True, timeout=limit, check=False
            )
        outcome = "survived" if ended.returncode == 0 else "killed"
        by = next((line for line in ended.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), "")
    except subprocess.TimeoutExpired:
        outcome, by = "killed", "time"
    (root / fault["path"]).write_bytes(original)
    return fault | {"outcome": outcome, "by": by[:200], "tests": len(tests)}


def run(file: Path, seconds: float, marked: str, workers: int) -> list[dict]:
    """Judge the faults of a file that have no outcome yet."""
    faults, choice = json.loads(file.read_text(encoding="utf-8")), Choice(marked)
    with tempfile.TemporaryDirectory() as folder:
        roots: Queue[Path] = Queue()
        for i in range(workers):
            roots.put(copy_of(Path(folder) / str(i)))

        def one(number: int) -> None:
            root = roots.get()
            faults[number] = judge(faults[number], choice, root, seconds)
            roots.put(root)
            print(f"{faults[number]['outcome']:9} {faults[number]['path']}:{faults[number]['line']}", flush=True)
            file.write_text(json.dumps(faults, indent=1, ensure_ascii=False), encoding="utf-8")

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(one, [i for i, fault in enumerate(faults) if "outcome" not in fault]))
    return faults


NUMBERS = {"count": 150, "seed": 1, "seconds": 60.0, "workers": os.cpu_count() or 1}


@script({"what": str, "file": Path}, marked="not full", **NUMBERS)
def main(given) -> None:
    if given.what == "draw":
        faults = draw(given.count, given.seed)
        given.file.write_text(json.dumps(faults, indent=1, ensure_ascii=False), encoding="utf-8")
        print(Counter(fault["path"].split("/")[1] for fault in faults).most_common())
        return
    faults = run(given.file, given.seconds, given.marked, given.workers)
    outcomes = Counter(fault["outcome"] for fault in faults)
    print(f"{len(faults)} faults: " + ", ".join(f"{n} {word}" for word, n in outcomes.most_common()))
    for fault in faults:
        if fault["outcome"] != "killed":
            print(f"{fault['path']}:{fault['line']}\n    {fault['before'].strip()}\n    {fault['after'].strip()}")
