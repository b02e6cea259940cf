"""YAML as other programs write it: plain values and OpenCV's matrices.

Aliases are refused: with them, ten lines can expand to more than any memory holds. A repeated key is refused too, since
the last one would silently count.
"""

import re

import numpy as np
import yaml


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


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def load_yaml(text: str):
    """Return the values of a text.

    ``cv2.FileStorage`` begins its files with ``%YAML:1.0``, which is no valid YAML directive; it is removed.

    Raises yaml.YAMLError: the text is not YAML, has aliases, or a key twice.
    """
    return yaml.load(_without_directive(text), _Loader)


def load_documents(text: str) -> list:
    """Return the values of each document of a text, as ``rostopic echo`` ends each with ``---``.

    Raises yaml.YAMLError: the text is not YAML, has aliases, or a key twice.
    """
    return list(yaml.load_all(_without_directive(text), _Loader))


def _without_directive(text: str) -> str:
    return re.sub(r"\A\s*%YAML:?[ \t]*[\d.]+[ \t]*(#[^\r\n]*)?(\r\n|\r|\n|\Z)", "", text)


def opencv_matrix(name: str, values: np.ndarray) -> list[str]:
    """Return the lines of a matrix as ``cv2.FileStorage`` writes it, with numbers of full precision."""
    rows, columns = values.shape
    numbers = ",\n       ".join(", ".join(repr(float(v)) for v in row) for row in values)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {numbers} ]",
    ]
