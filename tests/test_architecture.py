"""Imports go one way, and heavy libraries stay where they belong: read from the source with ``ast``."""

import ast
from pathlib import Path

import pytest

import stcal

ROOT = Path(stcal.__file__).parent
SYSTEMS = ("sfm", "robot", "register", "handeye", "locate")
COLMAP_FILES = {"database.py", "mapping.py", "colmap_model.py", "resect.py", "export.py", "crosscheck.py"}
COLMAP_FILES |= {"export_model.py", "gates.py"}
CV2_FILES = {"overlay.py", "pairs.py"}
HANDEYE_CV2_FILES = {"closed_form.py"}


def imports_in(source: str, module: str) -> set[str]:
    """Absolute dotted names that a module imports, wherever in it; ``from a import b`` gives ``a`` and ``a.b``."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: -node.level]
                base = ".".join([*package, *([base] if base else [])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return found


def module_of(path: str) -> str:
    """``stcal.geometry.rigid`` of ``geometry/rigid.py``; a package is ``stcal.geometry.__init__``."""
    return "stcal." + path.removesuffix(".py").replace("/", ".")


def tops(imports: set[str]) -> set[str]:
    return {name.split(".")[0] for name in imports}


def layer(module: str) -> int:
    """Rank in errors ← geometry ← design ← stages ← pipeline ← cli; a module imports its own rank and below."""
    parts = module.split(".")[1:]
    match parts:
        case [] | ["errors" | "parallel" | "page" | "saving", *_]:  # helpers below everything
            return 0
        case ["geometry", *_]:
            return 1
        case ["design" | "design_file" | "camera_file" | "toml_file" | "table_file" | "images" | "boards", *_]:
            return 2
        case ["sfm", "pipeline", *_]:
            return 4
        case ["sfm" | "synthetic" | "robot" | "register" | "handeye" | "locate", *_]:
            return 3
        case _:
            return 5


def violations(path: str, imports: set[str]) -> list[str]:
    """What in ``imports`` the file at ``path`` (below ``stcal/``) may not import, with the reason."""
    module = module_of(path)
    parts = path.split("/")
    package, name = parts[0].removesuffix(".py"), parts[-1]
    is_front = path == "sfm/__init__.py"  # a package's front may re-export its pipeline
    bad = []
    for target in sorted(imports):
        if target.startswith("stcal.") and layer(target) > layer(module) and not (is_front and layer(target) == 4):
            bad.append(f"{target}: above {module}")
        other = target.split(".")[1] if target.startswith("stcal.") else ""
        if package in SYSTEMS and other in SYSTEMS and other != package:
            bad.append(f"{target}: another system")
        if package == "synthetic" and other in SYSTEMS:
            bad.append(f"{target}: a system, which must not be tested on its own view of the world")
    if package == "geometry":
        known = ("numpy", "scipy", "dataclasses", "typing", "collections", "math", "functools", "itertools")
        allowed = ("stcal.errors", "stcal.geometry")
        for target in sorted(imports):
            if not target.startswith(allowed) and target.split(".")[0] not in known:
                bad.append(f"{target}: geometry is numpy and scipy only")
    used = tops(imports)
    for library in sorted(used & {"pycolmap", "sqlite3"}):
        if not (parts[0] == "sfm" and len(parts) == 2 and name in COLMAP_FILES):
            bad.append(f"{library}: only in sfm/ {', '.join(sorted(COLMAP_FILES))}")
    if "cv2" in used:
        in_sfm = parts[0] == "sfm" and (parts[1] == "detect" or (len(parts) == 2 and name in CV2_FILES))
        in_handeye = parts[0] == "handeye" and name in HANDEYE_CV2_FILES
        if not (in_sfm or in_handeye or parts[0] in ("synthetic", "boards", "images.py")):
            bad.append("cv2: only where pixels are")
    return bad


FILES = sorted(str(path.relative_to(ROOT).as_posix()) for path in ROOT.rglob("*.py"))


def test_the_source_is_found():
    assert {"errors.py", "geometry/rigid.py", "design.py", "camera_file.py"} <= set(FILES)


@pytest.mark.parametrize("path", FILES)
def test_imports_go_one_way(path):
    source = (ROOT / path).read_text(encoding="utf-8")
    assert violations(path, imports_in(source, module_of(path))) == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("errors.py", "import stcal.geometry"),
        ("geometry/plane.py", "from stcal.design import BOARD"),
        ("geometry/plane.py", "from stcal import design"),
        ("geometry/plane.py", "from .. import sfm"),
        ("geometry/plane.py", "from ..design_file import load_target"),
        ("geometry/plane.py", "import cv2"),
        ("geometry/plane.py", "import yaml"),
        ("geometry/__init__.py", "from ..design import BOARD"),
        ("design.py", "import stcal.sfm.faces"),
        ("sfm/faces.py", "from stcal.sfm import pipeline"),
        ("sfm/faces.py", "from stcal.sfm.pipeline import run"),
        ("sfm/pipeline.py", "from stcal.cli.main import main"),
        ("sfm/pipeline.py", "def f():\n    from stcal.cli import main"),  # hiding it in a function does not help
        ("sfm/__init__.py", "from stcal.cli import main"),
        ("sfm/faces.py", "from stcal.robot import dh"),
        ("robot/dh.py", "from stcal.sfm.faces import x"),
        ("locate/pose.py", "from stcal import handeye"),
        ("synthetic/scene.py", "from stcal.sfm.observations import x"),
        ("synthetic/scene.py", "import stcal.robot"),
        ("synthetic/scene.py", "import pycolmap"),
        ("sfm/metric.py", "import pycolmap"),
        ("sfm/metric.py", "if True:\n    from sqlite3 import connect"),
        ("sfm/detect/database.py", "import sqlite3"),
        ("cli/sfm.py", "import pycolmap"),
        ("sfm/refine.py", "import cv2"),
        ("sfm/pipeline.py", "from cv2 import imread"),
        ("design_file.py", "import cv2"),
        ("handeye/pairs.py", "import cv2"),
        ("handeye/report.py", "from stcal.sfm.detect.image import detect_image"),
        ("handeye/export.py", "from stcal.cli.saving import save"),
        ("cli/board_views.py", "import cv2"),
        ("boards/tags.py", "from stcal.locate import pose"),
    ],
)
def test_the_rules_catch_it(path, source):
    assert violations(path, imports_in(source, module_of(path))) != []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/plane.py", "from dataclasses import dataclass\nfrom .rigid import Rigid\nimport scipy.spatial"),
        ("sfm/pipeline.py", "from stcal.sfm import mapping, faces\nfrom stcal.camera_file import read_camera"),
        ("sfm/__init__.py", "from stcal.sfm.pipeline import run"),
        ("sfm/database.py", "import sqlite3, pycolmap"),
        ("sfm/detect/centres.py", "import cv2"),
        ("handeye/closed_form.py", "import cv2"),
        ("boards/tags.py", "import cv2\nfrom stcal.images import grey_8bit"),
        ("synthetic/render.py", "import cv2\nfrom stcal.design_file import target_toml"),
        ("cli/main.py", "from stcal.sfm import pipeline\nfrom stcal.robot import dh"),
        ("cli/board_views.py", "from stcal.sfm.detect import image\nfrom stcal.boards.tags import find_tags"),
    ],
)
def test_the_rules_let_it_pass(path, source):
    assert violations(path, imports_in(source, module_of(path))) == []
