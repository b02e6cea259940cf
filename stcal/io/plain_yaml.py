"""YAML as other programs write it: plain values and OpenCV's matrices. No aliases: with them ten lines can stand for
more than any memory holds."""

import re

import numpy as np
import yaml


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            said = f"alias *{event.anchor}: write the values out"
            raise yaml.MarkedYAMLError(problem=said, problem_mark=event.start_mark)
        return super().compose_node(parent, index)


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def load_yaml(text: str):
    """The values of a text; ``cv2.FileStorage`` heads its files with ``%YAML:1.0``, which is not a YAML directive.

    Raises
    ------
    yaml.YAMLError
        Not YAML, or with aliases.
    """
    return yaml.load(re.sub(r"\A\s*%YAML:?\s*[\d.]+\s*\n", "", text), _Loader)


def opencv_matrix(name: str, values: np.ndarray) -> list[str]:
    """Lines of a matrix as ``cv2.FileStorage`` writes it, with numbers that read back as they are."""
    rows, columns = values.shape
    numbers = ",\n       ".join(", ".join(repr(float(v)) for v in row) for row in values)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {numbers} ]",
    ]
