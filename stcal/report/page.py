"""Report pages that open off line: tables, the look of the page, and plots as SVG data URIs.

matplotlib is loaded when the first plot is drawn.
"""

import base64
import io
import math
import warnings
from collections.abc import Sequence
from html import escape

import numpy as np

# The palette of Okabe & Ito (2008), darkened where it would be faint on white; then shades for many groups.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b8559a", "#3d9bd1", "#c98a00", "#5b3f8c", "#555555", "#8c2d04", "#00606b")
INK, FAINT = "#333333", "#d5d9de"
AXIS_COLOURS = ("#c1272d", "#2e8b3d", "#2457a8")
SMALL = 7.5

NONE = "–"
PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header>
{banner}<nav aria-label="Contents"><ol>{links}</ol></nav>
</header>
<main>
{body}</main>
</body>
</html>
"""
STYLE = """
:root { color-scheme: light; --ink: #1c2733; --soft: #556270; --line: #d9dee4; --tint: #f5f7f9; --link: #0b5394; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-padding-top: 1rem; }
body { margin: 0 auto; max-width: 76rem; padding: 2rem 1.5rem 4rem; background: #fff; color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .25rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .75rem; padding-bottom: .3rem; border-bottom: 2px solid var(--ink); }
h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; } h4 { font-size: .95rem; margin: .6rem 0 .3rem; }
p { margin: .4rem 0 .7rem; max-width: 50rem; } a { color: var(--link); }
.counts { font-size: 1.05rem; color: var(--soft); }
.alarm { max-width: none; padding: .9rem 1.1rem; background: #b3261e; color: #fff; border-radius: 4px;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
nav ol { display: flex; flex-wrap: wrap; gap: .15rem 1.2rem; list-style: none; margin: .9rem 0 0; padding: .6rem 0;
  border-top: 1px solid var(--line); border-bottom: 1px solid var(--line); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: .7rem; margin: 0 0 1rem; }
.tiles div { border: 1px solid var(--line); border-radius: 4px; padding: .6rem .8rem; }
.tiles b { font-size: 1.5rem; font-variant-numeric: tabular-nums; }
.tiles span { display: block; color: var(--soft); font-size: .88rem; line-height: 1.35; }
.scroll { overflow-x: auto; margin: .4rem 0 1rem; max-width: 100%; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums lining-nums; }
th, td { padding: .22rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
thead th { vertical-align: bottom; white-space: normal; color: var(--soft); font-weight: 600;
  line-height: 1.25; border-bottom: 1px solid #8b97a3; }
thead th.over { text-align: center; white-space: nowrap; border: 0; }
thead th.over:not(:empty) { border-bottom: 1px solid var(--line); }
tbody th { font-weight: 600; } .l { text-align: left; }
tbody th[scope=row] { position: sticky; left: 0; background: #fff; }
tbody tr:hover > * { background: var(--tint); }
.text .l { white-space: normal; overflow-wrap: break-word; min-width: 7.5rem; }
.facts thead { display: none; } .facts th { color: var(--soft); font-weight: 400; vertical-align: top; }
.facts tr:first-child > * { border-top: 1px solid var(--line); }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: 0 2rem; }
.columns > div { min-width: 0; }
.columns.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 1rem 1.5rem; }
figure { margin: 0; break-inside: avoid; } figure img { display: block; width: 100%; height: auto; }
figcaption { font-size: .88rem; color: var(--soft); }
.plots figcaption { text-align: center; } .plots img { max-width: 32rem; margin: 0 auto; }
.legend { font-size: .9rem; max-width: none; } .legend span { white-space: nowrap; margin-right: .6rem; }
.swatch { display: inline-block; width: .75em; height: .75em; margin: 0 .35em 0 .2em !important; border-radius: 2px;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
details { margin: .5rem 0; } summary { cursor: pointer; font-weight: 600; padding: .25rem 0; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); gap: 1rem; }
.cell { min-height: 8rem; } .photo img { border-radius: 3px; } .open { display: block; cursor: zoom-in; }
.photo figcaption { padding-top: .25rem; overflow-wrap: anywhere; } .photo b { color: var(--ink); }
.steps { display: none; }
.photo:target { position: fixed; inset: 0; z-index: 9; margin: 0; padding: .8rem; background: #fff; display: flex;
  flex-direction: column; align-items: center; justify-content: center; }
.photo:target .open { display: contents; cursor: default; }
.photo:target img { min-height: 0; max-width: 100%; max-height: calc(100% - 2.5rem); object-fit: contain; }
.photo:target .steps { display: inline; margin-left: 1rem; } .steps a { margin-left: .6rem; }
@media (max-width: 40rem) { body { padding: 1rem .8rem 3rem; } th, td { padding: .22rem .45rem; }
  .text td.l { min-width: 9.5rem; } .facts td.l { min-width: 0; }
  .wide { overflow-x: auto; } .wide img { min-width: 44rem; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; } nav { display: none; } h2 { margin-top: 1.4rem; }
  h2, h3, h4, summary { break-after: avoid; } .scroll { overflow: visible; } tr { break-inside: avoid; }
  table { font-size: 6.8pt; } th, td { padding: .1rem .28rem; } .grid, .plots { grid-template-columns: 1fr 1fr; }
  .cell { break-inside: avoid; } @page { margin: 14mm; } }
"""


def page(title: str, banner: str, sections: Sequence[tuple[str, str, str]]) -> str:
    """The page: ``banner`` is markup above the contents; each section is (anchor, title, markup)."""
    links = "".join(f'<li><a href="#{key}">{text}</a></li>' for key, text, _ in sections)
    body = "".join(f'<section id="{key}"><h2>{text}</h2>\n{content}</section>\n' for key, text, content in sections)
    return PAGE.format(title=escape(title), style=STYLE, banner=banner, links=links, body=body)


class Html(str):
    """Text that is markup already; everything else is escaped."""

    __slots__ = ()


def number(value: float | None, digits: int) -> str:
    """Fixed digits; a dash where there is no value, and no minus before zero."""
    if value is None or not math.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


def table(columns: list[str], rows: list[list], over: list[tuple[str, int]] | None = None, css: str = "") -> Html:
    """A table that scrolls by itself. The first cell of a row is its head.

    Parameters
    ----------
    columns : heads; ``<`` in front aligns the column to the left
    rows : cells, text that is escaped or :class:`Html`
    over : a line of heads above, each with the number of columns it spans
    css : class of the table
    """
    left = [column.startswith("<") for column in columns]
    side = [' class="l"' if each else "" for each in left]
    head = "".join(f'<th scope="col"{s}>{escape(c.lstrip("<"))}</th>' for c, s in zip(columns, side, strict=True))
    if over:
        line = "".join(f'<th colspan="{span}" class="over">{escape(text)}</th>' for text, span in over)
        head = f"{line}</tr><tr>{head}"
    lines = []
    for row in rows:
        texts = [cell if isinstance(cell, Html) else escape(str(cell)) for cell in row]
        cells = "".join(f"<td{s}>{text}</td>" for text, s in zip(texts[1:], side[1:], strict=True))
        lines.append(f'<tr><th scope="row"{side[0]}>{texts[0]}</th>{cells}</tr>')
    body = "\n".join(lines)
    return Html(
        f'<div class="scroll"><table class="{css}"><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{body}\n</tbody></table></div>\n"
    )


def cells(row: dict, spec: str) -> list:
    """Values of a row by words of ``key``, or ``key:digits`` for numbers."""
    found = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in found]


def join(values) -> str:
    return ", ".join(str(value) for value in values) or NONE


def fold(summary: str, content: str) -> str:
    return f"<details><summary>{escape(summary)}</summary>\n{content}</details>\n"


def plot(uri: str, alt: str, caption: str = "", css: str = "") -> str:
    return f'<figure class="{css}"><img src="{uri}" alt="{escape(alt)}"><figcaption>{caption}</figcaption></figure>\n'


def swatch(name: str, colour: str) -> str:
    return f'<span class="swatch" style="background:{colour}"></span>{escape(name)}'


def round_below(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above ``value``; 1 where there is no value."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def locator(integer: bool = False):
    """Round ticks, few."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(5, steps=[1, 2, 5, 10], integer=integer)


def new_figure(width: float, height: float):
    """An empty figure, inches."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="none")
    FigureCanvasSVG(figure)
    return figure


def calm(axes) -> None:
    """Axes without a frame."""
    axes.tick_params(labelsize=SMALL, length=2, color="#9aa0a8")
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa0a8")


def plane(axes, x: str, y: str, margin: float) -> None:
    """Axes of a map: one scale for both, a faint grid, ``margin`` around in shares of the extent."""
    axes.set_aspect("equal", "datalim")
    axes.margins(margin)
    axes.set_xlabel(x, fontsize=SMALL + 1, color=INK)
    axes.set_ylabel(y, fontsize=SMALL + 1, color=INK)
    axes.xaxis.set_major_locator(locator())
    axes.yaxis.set_major_locator(locator())
    calm(axes)
    axes.grid(color=FAINT, lw=0.6)
    axes.set_axisbelow(True)


def uri(figure) -> str:
    """The figure as an SVG data URI, the same bytes for the same figure."""
    import matplotlib

    stream = io.BytesIO()
    settings = {"svg.fonttype": "path", "svg.hashsalt": "stcal"}
    with warnings.catch_warnings(), matplotlib.rc_context(settings):
        warnings.filterwarnings("ignore", "Glyph")  # a face may be named in any script
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode()
