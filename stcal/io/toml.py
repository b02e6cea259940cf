"""TOML files, validated by a pydantic model, and YAML as other programs write it.

Messages name file and place of a mistake, and lengths that are not mm. In YAML, aliases are refused: with them, ten
lines can expand to more than any memory holds. A repeated key is refused too, since the last one would silently count.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from stcal.errors import InputError
from stcal.geometry.rigid import UNIT_WITHIN, Poses, Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, text_of
from stcal.io.json import first_mistake

M = TypeVar("M", bound=BaseModel)
YAML_LINE = re.compile(r"^\s*(?:%YAML|[\w-]+\s*:(?:\s|$))", re.MULTILINE)  # a line as YAML has it
DEEPEST = 60
DEEP = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){{{DEEPEST}}}""")
"""A dotted name of more parts than any table needs."""


class Strict(BaseModel):
    """A model that refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


LEAST = 1e-9
"""Smallest positive length or σ, mm: far below the size of an atom; the square of a smaller value may underflow."""


def _least(value: float) -> float:
    if value < LEAST:
        raise ValueError(f"at least {LEAST:g} needed")
    return value


# strict: a quoted number or a true is a typing mistake; more than 1e6 mm is a wrong unit.
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False, strict=True), AfterValidator(_least)]
Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False, strict=True)]


class PoseEntry(Strict):
    """A position and a unit quaternion; the default is the identity."""

    x_mm: Finite = 0.0
    y_mm: Finite = 0.0
    z_mm: Finite = 0.0
    qw: Finite = 1.0
    qx: Finite = 0.0
    qy: Finite = 0.0
    qz: Finite = 0.0

    def rigid(self, where: str) -> Rigid:
        """Return the transform; the message of an InputError begins with ``where``."""
        wxyz = np.array([self.qw, self.qx, self.qy, self.qz])
        length = float(np.linalg.norm(wxyz))
        if abs(length - 1) > UNIT_WITHIN:
            raise InputError("E-QUATERNION-LENGTH", f"{where}: quaternion of length {length:.4g}, 1 needed; correct it")
        return Poses.from_quaternions([wxyz], [[self.x_mm, self.y_mm, self.z_mm]])[0]


def validated(content: Any, model: type[M], where: str) -> M:
    """Return the content of a file as a ``model``."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise first_mistake(error, where, top=model.model_fields) from error


def toml_of(text: str) -> dict[str, Any]:
    """Return the content of a TOML text; raises ValueError where it is none, or nested so deep that it fills memory."""
    if DEEP.search(text):
        raise ValueError(f"a name of more than {DEEPEST} parts")
    return tomllib.loads(text)


def load_toml(path: str | Path, model: type[M], what: str, remedy: str) -> M:
    """Read and validate a TOML file; messages name the kind of file, ``what``, and the ``remedy`` for a missing one."""
    text = ""
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
        content = toml_of(text)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{what} {path}: {error.strerror or error}; {remedy}") from error
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, UnicodeDecodeError, numbers of 5000 digits
        looks = "JSON" if text.lstrip().startswith("{") else "YAML" if YAML_LINE.search(text) else ""
        said = f"it looks like {looks}; lines of TOML such as `name = 12` needed" if looks else "correct it"
        raise InputError("E-TOML-INVALID", f"{what} {path}: not valid TOML: {error}; {said}") from error
    return validated(content, model, f"{what} {path}")


def toml_string(value: str) -> str:
    """Return a text as a quoted TOML string."""
    # JSON's escapes are TOML's, but JSON leaves DEL as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


class Sized(Strict):
    """A file of hardware, which may state that unusual lengths in it are meant."""

    unusual_size: bool = False


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            problem = f"alias *{event.anchor}: write the values out"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise yaml.MarkedYAMLError(problem=f"the key {twice[:40]} twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda own, node: own.construct_mapping(node, deep=True))


def load_yaml(text: str):
    """Return the values of a text; YAMLError for aliases and repeated keys; ``%YAML:1.0`` of OpenCV is removed."""
    return yaml.load(_without_directive(text), _Loader)


def load_documents(text: str) -> list:
    """Return the values of each document of a text, as ``rostopic echo`` ends each with ``---``."""
    return list(yaml.load_all(_without_directive(text), _Loader))


def _without_directive(text: str) -> str:
    return re.sub(r"\A\s*%YAML:?[ \t]*[\d.]+[ \t]*(#[^\r\n]*)?(\r\n|\r|\n|\Z)", "", text)


def opencv_matrix(name: str, values: np.ndarray) -> list[str]:
    """Return the lines of a matrix as ``cv2.FileStorage`` writes it, with numbers of full precision."""
    rows, columns = values.shape
    numbers = ",\n       ".join(", ".join(repr(float(v)) for v in row) for row in values)
    head = f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"
    return [*head, f"   data: [ {numbers} ]"]
