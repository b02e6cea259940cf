"""Keys and values of camera files: JSON, XML, YAML, and ROS's INI."""

import json
import re
import xml.etree.ElementTree as ElementTree

from stcal.io.toml import load_documents

TAB = 4
"""Spaces in place of a tab, which YAML does not allow."""


def values_of(text: str) -> dict:
    """Return the keys and values of a text in JSON, XML or YAML.

    Raises ValueError, yaml.YAMLError, ElementTree.ParseError: the text is none of these, or holds several documents
    that differ.
    """
    if text.lstrip().startswith("<"):
        return _xml_values(ElementTree.fromstring(text))
    try:
        documents = [json.loads(text, strict=False, object_pairs_hook=_once)]
    except json.JSONDecodeError:
        documents = [each for each in load_documents(text.replace("\t", " " * TAB)) if each is not None]
    if not documents or not isinstance(values := _with_data(documents[0]), dict):
        raise ValueError("no keys")
    if any(_without_header(each) != _without_header(documents[0]) for each in documents[1:]):
        raise ValueError(f"{len(documents)} documents that differ; leave one in")
    return values


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
    if not isinstance(values, dict):
        return values
    if "data" in values and values.keys() & {"rows", "cols"}:
        return values["data"]
    return {str(key): _with_data(value) for key, value in values.items()}


def _xml_values(root: ElementTree.Element) -> dict:
    values: dict = {}
    for node in root:
        if node.tag in values:
            raise ValueError(f"the key {node.tag[:40]} twice")
        data = node.find("data")
        if data is not None:
            values[node.tag] = [float(word) for word in (data.text or "").split()]
        else:
            values[node.tag] = _xml_values(node) if len(node) else (node.text or "").strip().strip('"')
    return values


def is_ini(text: str) -> bool:
    """Return True if a text begins with a section, below comments, and has a camera matrix."""
    return bool(re.match(r"(?:[ \t]*(?:[#;][^\r\n]*)?[\r\n])*[ \t]*\[[^\d\]]", text)) and "camera matrix" in text


def ini_cameras(text: str) -> dict[str, dict]:
    """Return the cameras of ROS's INI by name: every section with a matrix, each with the keys of ``[image]``.

    A key has a line of its own; the lines of its numbers follow. Raises ValueError: a line is neither.
    """
    sections: dict[str, dict] = {}
    section, numbers = {}, []
    for line in (line.split("#")[0].strip() for line in text.splitlines()):
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = sections.setdefault(match[1], {})
        elif re.match(r"[^\W\d]", line):
            numbers = section.setdefault(f"{line}_matrix" if line in ("projection", "rectification") else line, [])
        elif line and line[0] != ";":
            numbers += [float(word) for word in line.split()]
    shared = {key: value for key, (value, *_) in sections.pop("image", {}).items()}
    return {name: shared | section for name, section in sections.items() if "camera matrix" in section}
