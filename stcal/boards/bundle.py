"""Tags as apriltag_ros lists them: bundles with a place for each tag, and standalone tags with their sizes alone."""

from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import ConfigDict, Field

from stcal.errors import InputError
from stcal.io.plain_yaml import load_yaml
from stcal.io.poses.rotations import of_quaternions
from stcal.io.toml import Finite, Positive, Strict, validated

KEYS = ("tag_bundles", "standalone_tags")
FAMILY = "tag36h11"
"""The family where the file names none: settings.yaml of apriltag_ros does."""
METRE_MM = 1000.0
FLAT_MM, FLAT_RAD = 0.01, 1e-3
"""Largest deviation of tags from one plane: what a file rounds off."""
CORNERS = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2
"""Corners of a tag of side 1 in its frame (X right, Y up), in the order of OpenCV, which draws tags of this family half
a turn from AprilTag's own pictures."""
UPRIGHT = np.roll(CORNERS, 2, axis=0)
"""The same of a tag that stands as OpenCV draws it."""


class _Tag(Strict):
    id: Annotated[int, Field(ge=0, strict=True)]
    size: Positive
    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    qw: Finite = 1.0
    qx: Finite = 0.0
    qy: Finite = 0.0
    qz: Finite = 0.0
    name: str = ""


class _Bundle(Strict):
    name: str
    layout: list[_Tag] = Field(min_length=1)


class _BundlesFile(Strict):
    # settings.yaml may be in the same file: its other keys say how to detect tags.
    model_config = ConfigDict(extra="ignore", frozen=True)
    tag_family: str = FAMILY
    upright: bool = False
    tag_bundles: list[_Bundle] = Field(default_factory=list)
    standalone_tags: list[_Tag] = Field(default_factory=list)


def bundle_content(text: str) -> dict[str, Any] | None:
    """Return the keys and values of a file of apriltag_ros; None for any other text."""
    if not any(key in text for key in KEYS):
        return None
    try:
        content = load_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and any(key in content for key in KEYS) else None


def tags_of_bundle(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the keys and values of a layout of tags, from those of a file of apriltag_ros, in mm and with Y down.

    Without bundles, standalone tags have their sizes and no places.

    Raises
    ------
    InputError
        Keys are missing or unknown, there are several bundles, or tags do not lie in one plane.
    """
    data = validated(content, _BundlesFile, where)
    if len(data.tag_bundles) > 1:
        names = ", ".join(bundle.name for bundle in data.tag_bundles)
        raise InputError("E-LAYOUT-BUNDLES", f"{where}: bundles {names}: one needed; leave it alone in the file")
    if not data.tag_bundles:
        sizes = [
            {"dictionary": data.tag_family, "id": t.id, "size_mm": METRE_MM * t.size} for t in data.standalone_tags
        ]
        return {"type": "tags", "tag": sizes}
    [bundle] = data.tag_bundles
    places = tuple(f"tag {tag.id}" for tag in bundle.layout)
    wxyz = np.array([[tag.qw, tag.qx, tag.qy, tag.qz] for tag in bundle.layout])
    turn, at = (
        of_quaternions(wxyz, places, where),
        np.array([[tag.x, tag.y, tag.z] for tag in bundle.layout]) * METRE_MM,
    )
    tilt = np.arccos(np.clip(turn[:, 2, 2], -1, 1))
    off = np.abs(at[:, 2] - at[0, 2])
    for place, angle, height in zip(places, tilt, off, strict=True):
        if angle > FLAT_RAD or height > FLAT_MM:
            raise InputError(
                "E-LAYOUT-FLAT",
                f"{where}: {place}: {np.degrees(angle):.3g}° and {height:.3g} mm from the plane of the bundle, none "
                "allowed: targets are flat here; give the tags of one plane",
            )
    tags = []
    for tag, rotation, middle in zip(bundle.layout, turn, at, strict=True):
        corners = METRE_MM * tag.size * (UPRIGHT if data.upright else CORNERS) @ rotation[:2, :2].T + middle[:2]
        tags.append({"dictionary": data.tag_family, "id": tag.id, "corners_mm": (corners * [1, -1]).tolist()})
    return {"type": "tags", "name": bundle.name, "tag": tags}
