"""From a file of a target or a board to a drawing of it."""

from dataclasses import dataclass
from pathlib import Path

from stcal.boards.design import BoardSet, FlatBoard
from stcal.boards.file import board_content
from stcal.boards.several import load_boards
from stcal.design import BoardDesign, TargetDesign
from stcal.drawing.dxf import dxf
from stcal.drawing.net import net_parts
from stcal.drawing.parts import Part, board_parts, target_parts
from stcal.drawing.pdf import pdf
from stcal.drawing.sheets import MOST_MM, PAPERS, Sheet, one_sheet, paper_sheets
from stcal.drawing.svg import svg
from stcal.errors import InputError
from stcal.io.design import load_target
from stcal.io.saving import save

SUFFIXES = (".pdf", ".svg", ".dxf")
OWN = "own"
"""In place of a paper: pages as large as what they show."""
MARGIN_MM = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What was written: ``parts`` and ``sheets``; ``paper`` : its name, or ``own``."""

    path: Path
    parts: list[Part]
    sheets: list[Sheet]
    paper: str


def draw(
    design: str | Path, path: str | Path, paper: str = "", margin_mm: float = MARGIN_MM, net: bool = False
) -> Drawn:
    """Draw a target or a board 1:1 to a file, whose suffix tells the form.

    Parameters
    ----------
    design : path
        A ``target.toml`` or a board file of any kind.
    paper : str
        Of :data:`~stcal.drawing.sheets.PAPERS`, or ``own``; if not given A4 for PDF, ``own`` for SVG and DXF.
    margin_mm : float
        From the outermost circles to the edge of a plate, where the design has no outline.
    net : bool
        The plates of a target unfolded into one plane, by their outlines and rough poses.

    Raises
    ------
    InputError
        The design cannot be read or drawn, the file has another suffix, or the paper does not go with it.
    """
    path = Path(path)
    paper = _paper(path, paper)
    what = load_design(design)
    if net and not isinstance(what, TargetDesign):
        raise InputError("E-DRAW-DESIGN", f"--net: {design} is a board; nets are of targets")
    parts = net_parts(what) if net and isinstance(what, TargetDesign) else _parts(what, margin_mm)
    title = what.name if isinstance(what, TargetDesign) else parts[0].name if len(parts) == 1 else "boards"
    sheets = sheets_of(parts, paper, title, apart=path.suffix.lower() == ".pdf")
    save(path, content_of(sheets, path))
    return Drawn(path, parts, sheets, paper)


def _parts(what: TargetDesign | BoardDesign | FlatBoard | BoardSet, margin_mm: float) -> list[Part]:
    return target_parts(what, margin_mm) if isinstance(what, TargetDesign) else board_parts(what, margin_mm)


def load_design(path: str | Path) -> TargetDesign | BoardDesign | FlatBoard | BoardSet:
    """A target, or a board or boards of any kind."""
    if not Path(path).exists():
        raise InputError(
            "E-DRAW-DESIGN", f"{path}: no such file; give a target.toml or a board file (`stcal-sfm init` writes both)"
        )
    content = board_content(path)
    return load_target(path) if content is not None and "face" in content else load_boards(path)


def sheets_of(parts: list[Part], paper: str, title: str, apart: bool) -> list[Sheet]:
    """On that paper, or pages of their own size: one for each part where they stand ``apart``."""
    if paper != OWN:
        return paper_sheets(parts, paper, title)
    if not apart:
        return [one_sheet(parts, title)]
    return [one_sheet([part], f"{title}, {part.name}" if len(parts) > 1 else title) for part in parts]


def content_of(sheets: list[Sheet], path: Path) -> str | bytes:
    """Of a file with that suffix.

    Raises
    ------
    InputError
        More sheets than it holds, or larger ones.
    """
    suffix = path.suffix.lower()
    if suffix == ".pdf":
        largest = max(max(sheet.width, sheet.height) for sheet in sheets)
        if largest > MOST_MM:
            raise InputError(
                "E-DRAW-SHEETS",
                f"{path}: page of {largest:.0f} mm, at most {MOST_MM:.0f} mm in a PDF; take --paper or .svg",
            )
        return pdf(sheets)
    if len(sheets) > 1:
        raise InputError(
            "E-DRAW-SHEETS", f"{path}: {len(sheets)} sheets, an SVG holds one; take .pdf, a larger --paper, or none"
        )
    return svg(sheets[0]) if suffix == ".svg" else dxf(sheets[0])


def _paper(path: Path, paper: str) -> str:
    """The paper's name as it is listed."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            "E-OUTPUT-SUFFIX", f"{path}: suffix {path.suffix or 'missing'}; one of {', '.join(SUFFIXES)} needed"
        )
    names = {name.lower(): name for name in (*PAPERS, OWN)}
    if paper and paper.lower() not in names:
        raise InputError("E-OPTION-VALUE", f"--paper {paper}: unknown; one of {', '.join(names.values())} needed")
    name = names.get(paper.lower(), "A4" if suffix == ".pdf" else OWN)
    if suffix == ".dxf" and name != OWN:
        raise InputError(
            "E-OPTION-CONFLICT", f"--paper {paper}: a DXF is no page; take .pdf or .svg, or leave --paper out"
        )
    return name
