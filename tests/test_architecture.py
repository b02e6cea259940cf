"""Who may import whom, folder by folder, and where heavy libraries belong: read from the source with ``ast``."""

import ast
import functools
import importlib
from collections import Counter
from collections.abc import Collection, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import stcal

ROOT = Path(stcal.__file__).parent
MOST_FILES = 14
"""In one folder: what can be seen at a glance."""
MOST_ENTRIES = 16
"""Of ``sfm/``, folders and files."""

LAYERS = (
    ("alone", "errors", "parallel", "cross_validation", "row_order"),
    ("geometry",),
    ("design", "labels", "lookalikes", "lengths"),
    ("io",),
    ("boards", "report"),
    ("synthetic", "drawing"),
    ("sfm", "robot", "register", "handeye", "locate"),
    ("workflows",),
    ("cli", "__main__"),
)
"""From below; a folder imports its own layer and those below it. ``design`` lies below ``io``, whose readers make
designs. ``synthetic`` knows no system, which must not be tested on its own view of the world. What only tests and
studies use is in ``tests/support``."""
INSIDE = {
    "sfm": (
        ("data",),
        ("detect", "mapping"),
        ("report",),
        ("adjust",),
        ("checks", "camera", "measurement"),
        ("runs",),
        ("interop", "diagnose", "planning", "budget"),
        ("make",),
        (".",),
    ),
    "robot": (("kinematics",), ("identification",), ("axes",), ("use",), (".",)),
    "register": ((".",),),
    "locate": ((".",),),
    "handeye": (("data",), ("methods",), ("judge",), (".",), ("report",)),
}
"""Folders of each system, from below; ``.`` stands for the files beside them. Folders of one layer know nothing of each
other; a folder uses those inside it, not they it."""
FRONTS = {f"{system}/__init__.py" for system in INSIDE}
"""May hand on everything of their system."""
LIBRARIES = {
    "pycolmap": ("sfm/mapping", "sfm/interop"),
    "sqlite3": ("sfm/mapping", "sfm/interop", "io/cameras/foreign.py"),
    "cv2": (
        *("io/images.py", "io/photographs", "boards", "sfm/detect", "sfm/diagnose", "synthetic"),
        *(
            "io/device.py",
            "io/cameras/foreign.py",
            "handeye/methods/closed_form.py",
            "sfm/measurement/live.py",
            "sfm/mapping/pairs.py",
        ),
    ),
}
"""Library: folders or files that may use it. ``cv2`` where pixels are, and in two places for a method of its own."""
GEOMETRY_USES = {"numpy", "scipy", "dataclasses", "typing", "types", "collections"}
GEOMETRY_USES |= {"math", "numbers", "inspect", "functools", "itertools"}


@functools.cache
def imports_in(source: str, module: str) -> frozenset[str]:
    """Absolute dotted names that a module imports, wherever in it; ``from a import b`` gives ``a`` and ``a.b``."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module":
            found |= {argument.value for argument in node.args[:1] if isinstance(argument, ast.Constant)}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: -node.level]
                base = ".".join([*package, *([base] if base else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names} | ({base} if base.count(".") != 0 else set())
    return frozenset(found)


def module_of(path: str) -> str:
    """``stcal.sfm.detect.faces`` of ``sfm/detect/faces.py``."""
    return "stcal." + path.removesuffix(".py").replace("/", ".")


def place_of(path: str) -> str:
    """``sfm/detect`` of ``sfm/detect/faces.py``; ``errors`` of ``errors.py``; ``sfm`` of ``sfm/pipeline.py``."""
    parts = path.split("/")
    return "/".join(parts[:-1]) or parts[0].removesuffix(".py")


def target_of(name: str) -> str | None:
    """The place that an imported dotted name lies in; None outside the package, and for the package itself."""
    parts = name.split(".")
    if parts[0] != "stcal" or len(parts) < 2:
        return None
    for end in range(len(parts), 1, -1):
        path = "/".join(parts[1:end])
        if (ROOT / f"{path}.py").is_file():
            return place_of(f"{path}.py")
        if (ROOT / path).is_dir():
            return path
    return place_of("/".join(parts[1:]) + ".py")


def layer_of(place: str) -> int:
    """Rank in ``LAYERS``; the longest name that fits counts."""
    ranks = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
    return ranks.get("/".join(place.split("/")[:2]), ranks.get(place.split("/")[0], len(LAYERS)))


def inner_layer(place: str) -> int:
    """Rank of a system's folder in ``INSIDE``."""
    system, _, folder = place.partition("/")
    return next(rank for rank, layer in enumerate(INSIDE[system]) if (folder.split("/")[0] or ".") in layer)


def forbidden(path: str, target: str) -> str:
    """Why the file at ``path`` may not import from the place ``target``; empty where it may."""
    own = place_of(path)
    if own == target or (path in FRONTS and target.split("/")[0] == own.split("/")[0]):
        return ""
    system, other = own.split("/")[0], target.split("/")[0]
    if layer_of(target) > layer_of(own):
        return f"{target} lies above {own}"
    if system == other and system in INSIDE and not target.startswith(f"{own}/"):
        if inner_layer(target) > inner_layer(own):
            return f"{target} lies above {own}"
        if inner_layer(target) == inner_layer(own):
            return f"{target} stands beside {own}"
    if system != other and system in INSIDE and other in INSIDE:
        return f"{target} is another system"
    return ""


def violations(path: str, imports: Collection[str]) -> list[str]:
    """What in ``imports`` the file at ``path`` (below ``stcal/``) may not import, with the reason."""
    targets = {target_of(name) for name in imports} - {None}
    bad = [why for target in sorted(targets) if (why := forbidden(path, target))]
    used = {name.split(".")[0] for name in imports}
    for library, places in LIBRARIES.items():
        if library in used and not any(path == place or path.startswith(f"{place}/") for place in places):
            bad.append(f"{library} is for {', '.join(places)} alone")
    bad += [f"{folder} is not part of the package" for folder in sorted(used & {"tests", "scripts"})]
    if path.startswith("geometry/") and (others := used - {"stcal", *GEOMETRY_USES}):
        bad.append(f"geometry is numpy and scipy only, not {', '.join(sorted(others))}")
    return bad


FILES = sorted(str(path.relative_to(ROOT).as_posix()) for path in ROOT.rglob("*.py"))


def test_the_source_is_found():
    assert {"errors.py", "geometry/rigid.py", "design.py", "io/cameras/model.py", "sfm/pipeline.py"} <= set(FILES)


def violations_of(path: str, source: str) -> list[str]:
    """:func:`violations` of a file with this content."""
    return violations(path, imports_in(source, module_of(path)))


def test_imports_go_one_way():
    found = {path: violations_of(path, (ROOT / path).read_text(encoding="utf-8")) for path in FILES}
    assert {path: wrong for path, wrong in found.items() if wrong} == {}


def test_every_folder_has_its_place():
    for path in FILES:
        place = place_of(path)
        assert layer_of(place) < len(LAYERS) or path == "__init__.py", place
        if place.split("/")[0] in INSIDE:
            inner_layer(place)


def test_no_folder_holds_more_than_one_can_see():
    counts = Counter(path.rpartition("/")[0] for path in FILES)
    assert {folder: n for folder, n in counts.items() if n > MOST_FILES} == {}
    entries = [p for p in (ROOT / "sfm").iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()]
    assert len(entries) <= MOST_ENTRIES


def test_no_file_repeats_its_folder():
    repeated = [p for p in FILES if "/" in p and p.split("/")[-1].removesuffix(".py") == p.split("/")[-2]]
    assert repeated == []


def circle(sources: Mapping[str, str]) -> list[str]:
    """Modules that import each other in a circle, in functions too; empty where there is none.

    Parameters
    ----------
    sources : contents of files by their paths below ``stcal/``
    """
    files = {path: module_of(path) for path in sources}
    modules = {path: name.removesuffix(".__init__") for path, name in files.items()}
    graph = {modules[path]: imports_in(sources[path], name) & set(modules.values()) for path, name in files.items()}
    try:
        TopologicalSorter({module: others - {module} for module, others in graph.items()}).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_no_modules_import_each_other():
    assert circle({path: (ROOT / path).read_text(encoding="utf-8") for path in FILES}) == []


def test_circles_are_found():
    hidden = {"a.py": "from stcal.b import c", "b/c.py": "def f():\n    import stcal.d", "d.py": "from . import a"}
    assert set(circle(hidden)) == {"stcal.a", "stcal.b.c", "stcal.d"}
    named = {"a.py": "import stcal.b", "b.py": "import importlib\nimportlib.import_module('stcal.a')"}
    assert set(circle(named)) == {"stcal.a", "stcal.b"}
    assert circle({"a.py": "import stcal.b", "b.py": "import stcal.c", "c.py": ""}) == []


def test_no_public_name_is_a_module_too():
    for system in INSIDE:
        names = importlib.import_module(f"stcal.{system}").__all__
        assert {each.stem for each in (ROOT / system).iterdir()} & set(names) == set()


CAUGHT = [
    ("errors.py", "import stcal.geometry"),
    ("geometry/plane.py", "from stcal.labels import BOARD"),
    ("geometry/plane.py", "from stcal import design"),
    ("geometry/plane.py", "from .. import sfm"),
    ("geometry/plane.py", "from ..io.design import load_target"),
    ("geometry/plane.py", "import cv2"),
    ("geometry/plane.py", "import yaml"),
    ("design.py", "from stcal.io.design import load_target"),
    ("io/design.py", "import stcal.sfm.adjust.faces"),
    ("sfm/adjust/faces.py", "from stcal.sfm import pipeline"),
    ("sfm/adjust/faces.py", "from stcal.sfm.pipeline import run"),
    ("sfm/adjust/faces.py", "from stcal.sfm.runs.options import RunOptions"),
    ("sfm/detect/faces.py", "from stcal.sfm.mapping import pairs"),
    ("sfm/detect/circles/fits.py", "from stcal.sfm.detect.faces import x"),
    ("sfm/data/model.py", "from stcal.sfm.detect.faces import x"),
    ("sfm/pipeline.py", "from stcal.cli.main import main"),
    ("sfm/pipeline.py", "def f():\n    from stcal.cli import main"),  # hiding it in a function does not help
    ("sfm/__init__.py", "from stcal.cli import main"),
    ("sfm/adjust/faces.py", "from stcal.robot.kinematics import dh"),
    ("robot/kinematics/dh.py", "from stcal.sfm.adjust.faces import x"),
    ("robot/kinematics/dh.py", "from stcal.robot.use import design"),
    ("locate/estimate.py", "from stcal import handeye"),
    ("synthetic/scene.py", "from stcal.sfm.data.model import x"),
    ("synthetic/scene.py", "import stcal.robot"),
    ("synthetic/scene.py", "import pycolmap"),
    ("sfm/adjust/scale.py", "import pycolmap"),
    ("sfm/adjust/scale.py", "if True:\n    from sqlite3 import connect"),
    ("sfm/detect/database.py", "import sqlite3"),
    ("cli/sfm/run.py", "import pycolmap"),
    ("sfm/adjust/refine.py", "import cv2"),
    ("sfm/pipeline.py", "from cv2 import imread"),
    ("io/design.py", "import cv2"),
    ("handeye/data/pairs.py", "import cv2"),
    ("handeye/report/page.py", "from stcal.sfm.detect.image import detect_image"),
    ("handeye/report/export.py", "from stcal.workflows.board_views import detect_boards"),
    ("workflows/board_views.py", "import cv2"),
    ("workflows/board_views.py", "from stcal.cli.main import main"),
    ("boards/tags.py", "from stcal.locate import estimate"),
    ("synthetic/scene.py", "from tests.support import tags"),
]


def test_the_rules_catch_it():
    assert [case for case in CAUGHT if not violations_of(*case)] == []


PASSED = [
    ("geometry/plane.py", "from dataclasses import dataclass\nfrom .rigid import Rigid\nimport scipy.spatial"),
    ("sfm/pipeline.py", "from stcal.sfm.adjust import faces\nfrom stcal.io.cameras.read import read_camera"),
    ("sfm/__init__.py", "from stcal.sfm.pipeline import run"),
    ("sfm/mapping/database.py", "import sqlite3, pycolmap"),
    ("sfm/detect/circles/centres.py", "import cv2"),
    ("sfm/detect/faces.py", "from stcal.sfm.detect.circles.centres import measure_centres"),
    ("sfm/runs/saved.py", "from stcal.sfm.checks.verdict import Check"),
    ("handeye/methods/closed_form.py", "import cv2"),
    ("boards/tags.py", "import cv2\nfrom stcal.io.images import grey_8bit"),
    ("synthetic/render.py", "import cv2\nfrom stcal.io.design import target_toml"),
    ("workflows/board_views.py", "from stcal.sfm.detect import image\nfrom stcal.boards.tags import find_tags"),
    ("cli/main.py", "from stcal.sfm import pipeline\nfrom stcal.robot.kinematics import dh"),
]


def test_the_rules_let_it_pass():
    assert [case for case in PASSED if violations_of(*case)] == []
