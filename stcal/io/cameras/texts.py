"""Keys and values of camera files: JSON, XML, TOML, INI, YAML, NumPy's archives, and a matrix alone."""

import json
import re
import tomllib
import warnings
import xml.etree.ElementTree as ElementTree
import zipfile
from io import BytesIO

import numpy as np

from stcal.errors import InputNote
from stcal.io.toml import load_documents

TAB = 4
"""Spaces in place of a tab, which YAML does not allow."""


def values_of(text: str) -> dict:
    """Return the keys and values of a text in JSON, XML, TOML, INI, or YAML, or of a matrix alone.

    Raises ValueError, yaml.YAMLError, ElementTree.ParseError: the text is none of these, or holds several documents
    that differ.
    """
    if text.lstrip().startswith("<"):
        return _xml_values(ElementTree.fromstring(text))
    if re.match(r"\s*(\[\s*)?\{", text):
        try:
            values = json.loads(text, strict=False, object_pairs_hook=_once)
        except json.JSONDecodeError:  # YAML has braces, too
            values = load_documents(text)[0]
    elif (matrix := _matrix_alone(text)) is not None:
        return {"K": matrix}
    elif sections := _toml_values(text) or _ini_values(text):
        return sections
    else:
        documents = [each for each in load_documents(text.replace("\t", " " * TAB)) if each is not None]
        if not documents:
            raise ValueError("no keys")
        values, *more = documents
        if any(_without_header(each) != _without_header(values) for each in more):
            raise ValueError(f"{len(documents)} documents that differ; leave one in")
    if isinstance(values, list) and values and all(isinstance(each, dict) for each in values):
        values = values[0] if len(values) == 1 else {"cameras": values}
    made = _with_data(values) if isinstance(values, dict) else None
    if not isinstance(made, dict):
        raise ValueError("no keys")
    return made


def values_of_archive(content: bytes) -> dict:
    """Return the arrays of a file of ``numpy.savez`` as lists; pickled objects are not opened, as they may be programs.

    Raises ValueError: the content is no such archive.
    """
    values = {}
    try:
        with np.load(BytesIO(content), allow_pickle=False) as archive:
            for name in archive.files:
                try:
                    values[name] = archive[name].tolist()
                except ValueError:
                    values[name] = "a pickled object"
    except (zipfile.BadZipFile, OSError, AttributeError, EOFError) as error:
        raise ValueError("no archive of NumPy") from error
    return values


def _matrix_alone(text: str) -> list[float] | None:
    """Return the matrix of a text of 3×3 numbers, or of 4×4 with 0 0 0 1 around it; None for any other text."""
    rows = [line.replace(",", " ").split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if {len(row) for row in rows} != {len(rows)} or len(rows) not in (3, 4) or not all(map(_are_numbers, rows)):
        return None
    matrix = np.array(rows, float)
    if len(rows) == 4 and ((matrix[3] != [0, 0, 0, 1]).any() or matrix[:3, 3].any()):
        return None
    warnings.warn("a matrix alone: the lens is taken to have no distortion", InputNote, stacklevel=2)
    return matrix[:3, :3].ravel().tolist()


def _toml_values(text: str) -> dict:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _once(pairs: list) -> dict:
    """Return an object of JSON; refuse a repeated key, as readers silently take the last one."""
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)[:40]} twice")
    return made


def _without_header(document: object) -> object:
    return {k: v for k, v in document.items() if k != "header"} if isinstance(document, dict) else document


def _with_data(values):
    """Return values with the content of matrices in place of their rows, columns and type, and with keys as texts."""
    if isinstance(values, dict):
        if "data" in values and values.keys() & {"rows", "cols"}:
            return values["data"]
        return {str(key): _with_data(value) for key, value in values.items()}
    if isinstance(values, list) and any(isinstance(value, dict) for value in values):
        return [_with_data(value) for value in values]
    return values


def _xml_values(root: ElementTree.Element) -> dict:
    values: dict = {}
    for node in root:
        data = node.find("data")
        if data is not None:
            value = [float(word) for word in (data.text or "").split()]
        elif len(node):
            value = _xml_values(node)
        else:
            value = (node.text or "").strip().strip('"')
        if node.tag not in values:
            values[node.tag] = value
        elif isinstance(value, dict):
            earlier = values[node.tag]
            values[node.tag] = [*(earlier if isinstance(earlier, list) else [earlier]), value]
        else:
            raise ValueError(f"the key {node.tag[:40]} twice")
    return values


def _ini_values(text: str) -> dict:
    """Return sections, keys and numbers of ROS's ``.ini``: each key in a line of its own, then lines of numbers."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith(";")]
    if not lines or not re.fullmatch(r"\[[A-Za-z_][\w /.-]*\]", lines[0]):
        return {}
    values: dict = {}
    section = numbers = None
    for line in lines:
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = values.setdefault(match[1], {})
        elif section is not None:
            key, equals, rest = (word.strip() for word in line.partition("="))
            words = rest.split() if equals else line.split()
            if key in ("projection", "rectification"):  # the words elsewhere name a lens
                key = f"{key}_matrix"
            if equals or not _are_numbers(words):
                numbers = section.setdefault(key, [])
            if equals and not _are_numbers(words):
                section[key] = rest
            elif numbers is not None and _are_numbers(words):
                numbers += [float(word) for word in words]
    for section in values.values():
        for key, value in section.items():
            if isinstance(value, list) and len(value) == 1:
                section[key] = value[0]
    return values


def _are_numbers(words: list[str]) -> bool:
    try:
        return [float(word) for word in words] != []
    except ValueError:
        return False
