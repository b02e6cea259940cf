"""Figures as files, the same numbers as the same bytes."""

from pathlib import Path

import matplotlib as mpl

TEXT = {"svg.hashsalt": "stcal", "svg.fonttype": "none"}
"""The same numbers give the same SVG, byte for byte, and its text stays text: small, and a change can be read."""


def save(figure, path: Path) -> None:
    """As PNG or SVG, by the file's ending; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(TEXT):
        figure.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
