"""Layout of the target: its tags, their corners in {obj}, and the covariance of the corners."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.boards.board_designs import UNIT_SQUARE, require_tags
from stcal.boards.board_designs import TagLayout as TagLayout
from stcal.boards.board_file import TagsFile, load_tags, placed_corners
from stcal.boards.dictionaries import known_tags
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, frozen, require_fields
from stcal.io.files import require_written
from stcal.io.toml import toml_string
from stcal.lengths import side, stated_unusual

WHAT = "layout file"
WRITTEN_MM = 1e-6  # largest difference of a written corner, mm: its last decimal


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutPlan(Brief):
    """Nominal target, for its calibration.

    ``name`` : name of the target; ``tags`` : dictionary and id of the n tags; ``origin`` : row of the tag whose centre
    is the origin of {obj}; ``corners_mm`` : (n, 4, 2) nominal corners in the plane of the target, NaN if a place is not
    given; ``unusual_size`` : true if unusually long or short sides are not a mistake of units.
    """

    name: str
    tags: tuple[tuple[str, int], ...]
    origin: int
    corners_mm: np.ndarray
    unusual_size: bool = False

    def __post_init__(self):
        require_fields(self, "target layout", origin=0)
        object.__setattr__(self, "tags", known_tags(self.tags, "target layout"))
        corners = frozen(self.corners_mm, (len(self.tags), 4, 2), "target layout: corners_mm", finite=False)
        object.__setattr__(self, "corners_mm", corners)
        require_tags(self.tags, self.corners_mm, self.unusual_size, "target layout")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TargetLayout(Brief):
    """Target with known corners.

    {obj} : origin in the middle of the tag in row ``origin``, X along its upper edge, Y down, Z into the target.

    Parameters
    ----------
    name : name of the target.
    tags : dictionary and id of the n tags; the ids differ.
    corners_mm : (n, 4, 2) top left, top right, bottom right, bottom left corner as printed, in {obj}.
    covariance_mm2 : (8n, 8n) covariance of all coordinates, mm², tag by tag, corner by corner, x before y.
    origin : row of the tag that holds the origin.
    sigma_px, tag_sigma_px : σ due to print, lens and flatness, in addition to the measured σ of a corner: of each
        corner by itself, and of the four corners of a tag together. Estimated from the residuals of the calibration.
    unusual_size : true if unusually long or short sides are not a mistake of units.
    """

    name: str
    tags: tuple[tuple[str, int], ...]
    corners_mm: np.ndarray
    covariance_mm2: np.ndarray
    origin: int
    sigma_px: float = 0.0
    tag_sigma_px: float = 0.0
    unusual_size: bool = False

    def __post_init__(self):
        require_fields(self, "target layout", origin=0, sigma_px=0, tag_sigma_px=0)
        n = len(self.tags)
        object.__setattr__(self, "tags", known_tags(self.tags, "target layout"))
        freeze(self, "corners_mm", (n, 4, 2), "tags' corners")
        freeze(self, "covariance_mm2", (8 * n, 8 * n), "corners' covariance")
        require_tags(self.tags, self.corners_mm, self.unusual_size, "target layout")

    @classmethod
    def of(cls, layout: TagLayout, name: str = "") -> "TargetLayout":
        """Returns tags with known places as a target. The middle of the first tag is the origin of {obj}."""
        corners = in_obj(layout.corners_mm, 0)
        covariance = layout.sigma_mm**2 * np.eye(corners.size)
        return cls(name, layout.tags, corners, covariance, 0, unusual_size=layout.unusual_size)

    def dictionaries(self) -> tuple[str, ...]:
        """Returns each dictionary of the tags once."""
        return tuple(dict.fromkeys(dictionary for dictionary, _ in self.tags))

    def rows(self) -> dict[tuple[str, int], int]:
        """Returns the row of each tag."""
        return {tag: row for row, tag in enumerate(self.tags)}

    def sigma_mm(self) -> np.ndarray:
        """Returns σ of each coordinate, (n, 4, 2) mm."""
        return np.sqrt(np.maximum(np.diag(self.covariance_mm2), 0)).reshape(-1, 4, 2)


def load_plan(path: str | Path) -> LayoutPlan:
    """Reads a layout file (``path`` : TOML, or YAML of apriltag_ros) whose tags may lack a place.

    Raises InputError: the file is unreadable, does not follow ``data_layout.md``, or repeats an id.
    """
    return _plan(load_tags(path, WHAT), f"{WHAT} {path}")


def load_layout(path: str | Path) -> TargetLayout:
    """Reads a layout file (``path`` : TOML, or YAML of apriltag_ros) with calibrated or nominal places of all tags.

    The corners are in {obj}, mm, with their covariance. Raises InputError: as :func:`load_plan`; or a tag has no place.
    """
    where = f"{WHAT} {path}"
    data = load_tags(path, WHAT)
    plan = _plan(data, where, every=True)
    corners, stated = plan.corners_mm, data.covariance()
    if stated is None:
        corners = in_obj(corners, plan.origin)
        covariance = data.sigma_mm**2 * np.eye(corners.size)
    else:  # without the negative eigenvalues that rounding makes of zeros
        value, vector = np.linalg.eigh(stated)
        covariance = (vector * np.maximum(value, 0)) @ vector.T
    sigmas_px = data.sigma_px, data.tag_sigma_px
    return TargetLayout(plan.name, plan.tags, corners, covariance, plan.origin, *sigmas_px, data.unusual_size)


def layout_toml(layout: TargetLayout, comments: Sequence[str] = ()) -> str:
    """Returns the text of a layout file for :func:`load_layout`."""
    lines = [f"# {comment}" for comment in comments]
    lines += ['type = "tags"', f"name = {toml_string(layout.name)}", f"origin = {layout.tags[layout.origin][1]}"]
    lines += [f"sigma_px = {layout.sigma_px:.6g}", f"tag_sigma_px = {layout.tag_sigma_px:.6g}"]
    lines += stated_unusual(side("", float(np.linalg.norm(c[1] - c[0]))) for c in layout.corners_mm)
    lines.append("# Lower triangle; coordinates tag by tag, corner by corner, x before y.")
    rows = (", ".join(f"{v:.6g}" for v in row[: k + 1]) for k, row in enumerate(layout.covariance_mm2 + 0.0))  # no -0.0
    lines += ["covariance_mm2 = [", *(f"  [{row}]," for row in rows), "]"]
    for (dictionary, tag), corners, sigma in zip(layout.tags, layout.corners_mm, layout.sigma_mm(), strict=True):
        places = ", ".join(f"[{x:.6f}, {y:.6f}]" for x, y in corners.tolist())
        errors = ", ".join(f"{1000 * np.hypot(*s):.1f}" for s in sigma)
        lines += ["", "[[tag]]", f'dictionary = "{dictionary}"', f"id = {tag}", f"corners_mm = [{places}]"]
        lines.append(f"# sigma of the corners in the plane: {errors} um")
    return "\n".join(lines) + "\n"


def require_layout_written(path: str | Path, layout: TargetLayout) -> None:
    """Read a written layout again, and require the corners that were reported."""
    require_written(path, lambda: load_layout(path).corners_mm, layout.corners_mm, WRITTEN_MM, "mm")


def obj_from_plane(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotation (2, 2) and translation (2,) into the middle of a tag, by fitting a square to its corners."""
    middle = corners.mean(0)
    along = np.sum((corners - middle) * UNIT_SQUARE)
    across = np.sum((corners - middle) @ np.array([[0, -1], [1, 0]]) * UNIT_SQUARE)
    cosine, sine = np.array([along, across]) / np.hypot(along, across)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return turn, -turn @ middle


def _plan(data: TagsFile, where: str, every: bool = False) -> LayoutPlan:
    ids = [tag.id for tag in data.tag]
    repeated = [i for i in ids if ids.count(i) > 1]
    if repeated:
        fault = f"{where}: id {repeated[0]} occurs {ids.count(repeated[0])} times"
        raise InputError("E-TAG-REPEATED", f"{fault}; ids must differ, in all families")
    origin = ids[0] if data.origin is None else data.origin
    if origin not in ids:
        fault = f"{where}: origin {origin}: no tag has this id"
        raise InputError("E-LAYOUT-ORIGIN", f"{fault}; one of {', '.join(map(str, ids))} needed")
    corners = placed_corners(data, where, every)
    tags = tuple((tag.dictionary, tag.id) for tag in data.tag)
    return LayoutPlan(data.name, tags, ids.index(origin), corners, data.unusual_size)


def in_obj(corners: np.ndarray, origin: int) -> np.ndarray:
    """Returns corners (n, 4, 2) in the plane in the frame of the tag in row ``origin``."""
    turn, shift = obj_from_plane(corners[origin])
    return corners @ turn.T + shift
