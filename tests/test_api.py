"""Public names are documented, their constructors are as strict as readers of files, and values show themselves."""

import copy
import dataclasses
import importlib
import inspect
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest

import stcal
from stcal import errors, handeye, locate, register, robot, sfm, synthetic
from stcal.design import TargetDesign, reference_board, reference_target
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid, Similarity
from stcal.handeye import HandEyePoses
from stcal.locate import SeenTags
from stcal.robot import DesignOptions, DHRow, IdentifyOptions, Joint, Robot
from stcal.sfm import RunOptions, Trial
from tests.outcome import refuses

SYSTEMS = ("sfm", "robot", "register", "handeye", "locate", "adjust", "synthetic", "workflows")


def public() -> dict[str, object]:
    """Functions and classes of every ``__all__``, by dotted name; constants carry no docstring."""
    modules = [stcal, *(importlib.import_module(f"stcal.{system}") for system in SYSTEMS)]
    found = {f"{m.__name__}.{name}": getattr(m, name) for m in modules for name in getattr(m, "__all__", ())}
    return {name: value for name, value in found.items() if inspect.isclass(value) or inspect.isroutine(value)}


def arguments(value: object) -> set[str]:
    if dataclasses.is_dataclass(value):
        return {field.name for field in dataclasses.fields(value) if field.init and not field.name.startswith("_")}
    if inspect.isclass(value) and issubclass(value, tuple | BaseException):
        return set(getattr(value, "_fields", ()))
    try:
        return {name for name in inspect.signature(value).parameters if name not in ("self", "cls")}
    except ValueError:  # of a class without a signature
        return set()


PUBLIC = public()


def test_every_system_shows_its_names():
    """Sixty at this writing; an empty ``__all__`` would let everything below pass."""
    assert len(PUBLIC) > 40
    assert {"stcal.sfm.run", "stcal.robot.identify", "stcal.register.register", "stcal.handeye.handeye"} <= set(PUBLIC)


def test_names_that_are_not_loaded_yet_are_listed():
    """In a process of its own: here all have been used."""
    code = "from importlib import import_module\n"
    for module in ("stcal", *(f"stcal.{system}" for system in SYSTEMS)):
        code += f"m = import_module('{module}'); print(sorted(set(m.__all__) - set(dir(m))), len(m.__all__) >= 4)\n"
    printed = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == ["[] True"] * (1 + len(SYSTEMS))


def test_public_names_are_documented():
    """Every argument or field stands in the docstring."""
    named = {name: set(re.findall(r"\w+", value.__doc__ or "")) for name, value in PUBLIC.items()}
    assert {name: missing for name, value in PUBLIC.items() if (missing := arguments(value) - named[name])} == {}


FACE, TWO = reference_target().faces[:2]
ROW = DHRow(100.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: Joint("Prismatic"), "E-OPTION-VALUE … 'Prismatic' … revolute or prismatic"),
        (lambda: Joint(lower=1.0, upper=-1.0), "E-ROBOT-LIMITS … 1 … -1"),
        (lambda: Joint(fixed={"alpha_deg": "why"}), "E-ROBOT-FIXED … alpha_deg … alpha"),
        (lambda: DHRow(float("nan"), 0, 0, 0), "E-ROBOT-ROW … a … nan"),
        (lambda: DHRow(0, "0", 0, 0), "E-ROBOT-ROW … alpha … '0'"),
        (lambda: Robot("a", "Modified", (ROW,), (Joint(),)), "E-OPTION-VALUE … robot a … 'Modified'"),
        (lambda: Robot("a", "modified", ((1, 2, 3, 4),), (Joint(),)), "E-ROBOT-ENTRIES … DHRow"),
        (lambda: Robot("a", "modified", (DHRow(0.4, 0, 0.1, 0),), (Joint(),)), "E-LENGTH-UNIT … 0.4 mm … metres"),
        (lambda: TargetDesign("t", "black", (FACE,)), "E-OPTION-VALUE … 'black' … bright or dark"),
        (
            lambda: TargetDesign("t", "dark", (replace(FACE, xy_mm=FACE.xy_mm / 1e3, radius_mm=FACE.radius_mm / 1e3),)),
            "E-LENGTH-UNIT … metres",
        ),
        (lambda: replace(FACE, ids=FACE.ids[:-1]), "E-ARRAY-SHAPE … face 1"),
        (lambda: replace(FACE, radius_mm=0 * FACE.radius_mm), "E-TARGET-RADIUS … 0 mm"),
        (lambda: replace(FACE, radius_mm=-FACE.radius_mm), "E-TARGET-RADIUS … -"),
        (lambda: replace(reference_board(), polarity="black"), "E-OPTION-VALUE … 'black'"),
        (lambda: replace(reference_board(), pitch_mm=0.03, radius_mm=0.01), "E-LENGTH-UNIT … 0.03 mm"),
        (lambda: replace(reference_board(), rows=0), "E-BOARD-SIZE … 0 rows"),
        (lambda: replace(reference_board(), corner=(0, 0)), "E-BOARD-CORNER … None"),
        (lambda: replace(reference_board(), sigma_mm=-1.0), "E-SIGMA-VALUE … -1"),
        (lambda: RunOptions(solve="Joint"), "E-OPTION-VALUE … solve 'Joint' … joint"),
        (lambda: IdentifyOptions(model="stiff"), "E-OPTION-VALUE … model 'stiff'"),
        (lambda: DesignOptions(observe="poses"), "E-OPTION-VALUE … observe 'poses'"),
        (lambda: RunOptions(workers=0), "E-OPTION-RANGE … workers 0 … 1"),
        (lambda: RunOptions(exclude="12/a.jpg"), "E-FIELD-TYPE … exclude '12/a.jpg' … tuple"),
        (lambda: replace(FACE, xy_mm=[["0", "1"]] * len(FACE.ids)), "E-ARRAY-TYPE … face 1"),
        (lambda: Rigid.exp([0] * 6) and Rigid(translation=[0, "1", 2]), "E-ARRAY-TYPE … translation"),
        (lambda: SeenTags([0.5], np.zeros((1, 4, 2)), np.eye(8)[None]), "E-ARRAY-TYPE … rows … whole"),
        (lambda: Camera(2.5, 3, [1, 1], [1, 1], [0] * 8), "E-FIELD-TYPE … width 2.5 … whole"),
        (lambda: HandEyePoses(Poses.of([Rigid()]).matrix(), Poses.of([Rigid()])), "E-FIELD-TYPE … Poses"),
    ],
)
def test_constructors_are_as_strict_as_readers_of_files(make, error):
    refuses(error, make)


def wrong_values(value: object, hint: object) -> list[object]:
    """Values that no field of this type can have, beside one that it has."""
    if isinstance(value, np.ndarray):
        return ["word", [[1, 2], [3]], value + 1j, value[None], None if "None" not in str(hint) else object()]
    if "str" in str(hint) and "tuple" not in str(hint):
        return [object(), 7]
    return [object(), "word", *([] if value is None or not isinstance(value, int | float) else [float("nan")])]


INPUTS = [
    Camera.from_opencv([[900, 0, 500], [0, 900, 400], [0, 0, 1]], [], (1000, 800)),
    Rigid(),
    Poses.of([Rigid()]),
    FACE,
    reference_target(),
    reference_board(),
    reference_board().stated,
    RunOptions(),
    RunOptions().pairs,
    RunOptions().ellipses,
    sfm.MeasureOptions(),
    sfm.MeasureOptions().pose,
    sfm.Tolerances(),
    sfm.PlanOptions(),
    sfm.PlanOptions().noise,
    sfm.DesignOptions((130.0, 120.0, 110.0)),
    Trial("a", 1.0, "mm", 1.0, 1),
    sfm.judge("key", "Title", [Trial("a", 1.0, "mm", 1.0, 1)], "faces", "nothing"),
    ROW,
    Joint(),
    Robot("a", "standard", (ROW,), (Joint(),)),
    robot.Measurements.from_arrays(np.zeros((3, 1)), np.zeros((3, 3))),
    robot.Targets.from_poses(Poses.of([Rigid()])),
    DesignOptions(),
    IdentifyOptions(),
    register.Pairs("pairs", range(3), np.eye(3), np.eye(3)),
    register.Liu2017Options(),
    HandEyePoses(Poses.of([Rigid()]), Poses.of([Rigid()])),
    handeye.HandEyeOptions(),
    handeye.EvolutionOptions(),
    handeye.Noise(),
    handeye.View(np.eye(4, 3), np.eye(4, 2)),
    locate.TagLayout.from_tags("4X4_50", [3, 7], [[0, 0], [50, 0]], 30),
    locate.LocateOptions(),
    locate.VerdictOptions(),
    locate.PatentOptions(),
    SeenTags([0], np.zeros((1, 4, 2)), np.eye(8)[None]),
    synthetic.SceneOptions(),
    synthetic.RenderOptions(),
    synthetic.BodyOptions(),
    synthetic.ThinLens(8.0, 24.0, 1000.0),
]


@pytest.mark.parametrize("made", INPUTS, ids=lambda made: type(made).__name__)
def test_no_field_takes_a_value_of_another_type(made):
    hints, taken = get_type_hints(type(made)), []
    for entry in (each for each in dataclasses.fields(made) if each.init):
        for value in wrong_values(getattr(made, entry.name), hints[entry.name]):
            if value is None and entry.default is None:
                continue
            try:
                replace(made, **{entry.name: value})
            except InputError:
                continue
            taken.append((entry.name, value))
    assert taken == []


@pytest.mark.parametrize("made", INPUTS, ids=lambda made: type(made).__name__)
def test_a_copy_of_a_value_is_equal_and_a_value_shows_itself_in_a_line(made):
    """Results with many values: in `tests/sfm/test_pipeline.py`, and by what they are made of."""
    for again in (copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert (again, hash(again)) == (made, hash(made))
    assert len(repr(made)) < 600
    assert len(repr(made)) < 200 or "array([[" not in repr(made) or isinstance(made, Rigid)


def test_results_and_designs_are_equal_by_value():
    """Those of the engine of least squares hold functions."""
    kinds = [kind for name, kind in PUBLIC.items() if dataclasses.is_dataclass(kind) and "adjust" not in name]
    assert [kind for kind in kinds if kind.__eq__ is object.__eq__] == []
    xyz = np.vstack([np.eye(3), np.ones((1, 3)), -np.eye(3)])
    found = register.register(xyz, xyz + 1.0)
    assert pickle.loads(pickle.dumps(found)) == found != replace(found, notes=("another",))
    assert reference_target() != replace(reference_target(), name="another")


def test_transforms_are_equal_by_value():
    turned = Rigid.exp([0.1, 0, 0, 1, 2, 3])
    again = Rigid(turned.rotation, turned.translation)
    assert turned == again != Rigid()
    assert len({turned, again, Rigid(), Rigid([[1, 0, 0], [0, 1, -0.0], [0, 0, 1]])}) == 2
    assert Poses.of([turned, Rigid()]) == Poses.of([turned, Rigid()]) != Poses.of([Rigid(), turned])
    assert Similarity(2.0, turned) == Similarity(2.0, turned) != Similarity(2.0, Rigid())
    assert Rigid() != "identity"


def test_errors_speak_of_arguments(monkeypatch):
    monkeypatch.delenv(errors.COMMAND_LINE, raising=False)
    said = InputError("E-TEST", "--to-link a, --no-strict: give '--flatness 0.1', as `stcal robot --dh` has it; a--b")
    assert str(said) == "to_link a, strict=False: give 'flatness_mm 0.1', as `stcal robot --dh` has it; a--b"
    said.append(", or --out")
    with errors.at_command_line():
        assert str(said).startswith("--to-link a, --no-strict")
        assert str(said).endswith(", or --out")
    assert errors.COMMAND_LINE not in os.environ
    assert str(pickle.loads(pickle.dumps(said))) == str(said)


def test_options_that_errors_name_are_arguments_in_python(monkeypatch):
    """Those of errors that a call from Python can raise: where the command's name differs, `PYTHON_NAMES` has it."""
    monkeypatch.delenv(errors.COMMAND_LINE)
    refuses("E-OPTION-RANGE … flatness_mm 1e+09", RunOptions(flatness_mm=1e9).settled, reference_target())
    assert all(name.split(".")[0] in RunOptions.__dataclass_fields__ for name in errors.PYTHON_NAMES.values())
