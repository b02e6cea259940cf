"""A report that a system writes once: lines for the terminal, and a page.

A block is a sentence, a :class:`Table`, :class:`Notes`, or :class:`Html`, which a page alone has. A block without
content, such as None or a table without rows, is left out, and so is a section without blocks.
"""

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from stcal.errors import InputError
from stcal.parallel import one_thread
from stcal.report.svg import Drawing
from stcal.report.text import NONE, join, number, text_table


@cache
def environment() -> Environment:
    """Return the template environment, which escapes everything but markup, and refuses undefined names."""
    loader = PackageLoader("stcal", ".")
    env = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    env.filters["with_code"] = with_code
    env.filters["number"] = number
    macros = vars(env.get_template("report/templates/macros.html.jinja").module)
    env.globals |= {name: macro for name, macro in macros.items() if not name.startswith("_")}
    return env


def with_code(text: str) -> Markup:
    """Return a sentence in which what stands between backticks is code."""
    parts = [escape(part) for part in text.split("`")]
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else p for i, p in enumerate(parts))


NEEDED = (
    'PDF: needs WeasyPrint, which is not installed; pip install "stereo-target-calibration[pdf]", or in a clone '
    '`scripts/setup "[pdf]"`'
)
NO_PANGO = (
    "PDF: WeasyPrint does not find a library of the system ({reason}); install Pango, as with `apt-get install "
    "libpango-1.0-0 libpangoft2-1.0-0`"
)


def pdf_of(page: str) -> bytes:
    """Return the PDF of a page whose content is all embedded, A4 with page numbers; equal pages give equal bytes.
    Raises InputError: WeasyPrint, or Pango, which it uses, is not installed."""
    try:
        from weasyprint import HTML
        from weasyprint.urls import URLFetcher
    except ImportError as error:
        raise InputError("E-EXTRA-MISSING", NEEDED) from error
    except OSError as error:
        raise InputError("E-EXTRA-MISSING", NO_PANGO.format(reason=str(error).splitlines()[0])) from error
    stream = io.BytesIO()
    HTML(string=page, url_fetcher=URLFetcher(allowed_protocols=["data"])).write_pdf(stream)
    return stream.getvalue()


def require_pdf() -> None:
    """Refuse, before the work, if no PDF can be made."""
    pdf_of("<p></p>")


MOST_ROWS, MOST_PRINTED = 500, 60  # largest number of rows of a table on a page, and on the terminal


@dataclass(frozen=True, slots=True)
class Table:
    """A table, on the terminal and on a page. Of many rows only the first ones are shown; result files have all.

    ``heads`` : ``<`` before one aligns its column to the left; ``rows`` : each begins with its head; ``over`` : heads
    above, each with the number of columns that it spans; ``css`` : ``text`` for sentences, ``text facts`` for names and
    values without heads.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]
    over: Sequence[tuple[str, int]] = ()
    css: str = ""

    def __bool__(self) -> bool:
        return len(self.rows) > 0

    def lines(self) -> list[str]:
        """Return the lines of the table; a heading that spans several columns is put before each of their headings."""
        if "facts" in self.css:
            return [f"{name}: {value}" for name, value in self.rows if value != NONE]
        above = [text for text, span in self.over for _ in range(span)] or [""] * len(self.heads)
        heads = [
            "<" * head.startswith("<") + f"{text} {head.removeprefix('<')}".strip()
            for text, head in zip(above, self.heads, strict=True)
        ]
        lines = text_table([heads, *([str(cell) for cell in row] for row in self.rows[:MOST_PRINTED])])
        more = len(self.rows) - MOST_PRINTED
        return [*lines, f"… and {more} more rows; result files have all"] if more > 0 else lines

    def __html__(self) -> str:
        table = _macro("table", self.heads, self.rows[:MOST_ROWS], self.over, self.css)
        count = len(self.rows)
        told = f"The first {MOST_ROWS} of {count} rows; result files have all" if count > MOST_ROWS else ""
        return html(told) + table


@dataclass(frozen=True, slots=True)
class Printed:
    """Lines for the terminal alone."""

    content: Sequence[str]

    def __bool__(self) -> bool:
        return len(self.content) > 0

    def lines(self) -> list[str]:
        return list(self.content)

    def __html__(self) -> str:
        return ""


@dataclass(frozen=True, slots=True)
class Notes(Printed):
    """Remarks: a list on the page, lines that begin with ``note:`` on the terminal."""

    def lines(self) -> list[str]:
        return [f"note: {text}" for text in self.content]

    def __html__(self) -> str:
        return _macro("bullets", [sentence(text) for text in self.content])


@dataclass(frozen=True, slots=True)
class Html:
    """Markup for the page alone. ``make`` : writes it, and draws its figures, when the page is written."""

    make: Callable[[], str]

    def __html__(self) -> str:
        return self.make()


TONES = {
    "passed": ("passed", "good", "accept", "yes"),
    "care": ("suspicious", "use with care", "ambiguous", "with care", "part"),
    "failed": ("failed", "do not use", "reject", "no"),
    "open": ("not possible", "not applicable"),
}
"""Words of verdicts that look alike on a page."""


def tone_of(word: str) -> str:
    return next(tone for tone, words in TONES.items() if word in words)


@dataclass(frozen=True, slots=True)
class Cell:
    """A word for a cell that a page shows in a way of its own. ``look`` : the macro that writes it, and its values."""

    word: str
    look: tuple[str, ...]

    def __str__(self) -> str:
        return self.word

    def __html__(self) -> str:
        return _macro(self.look[0], self.word, *self.look[1:])


def verdict_word(word: str) -> Cell:
    return Cell(word, ("verdict", tone_of(word)))


def swatch(text: str, colour: str) -> Cell:
    """Return a word with a patch of its colour before it."""
    return Cell(text, ("swatch", colour))


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer at the head of a report. ``word`` : yes, with care, part or no; ``why`` : in one sentence; ``said`` :
    both, if not as ``Word: why``."""

    word: str
    why: str = ""
    question: str = "May I use it?"
    said: str = ""

    def lines(self) -> list[str]:
        return [f"{self.question} {self._said()}"]

    def __html__(self) -> str:
        return _macro("answers", [(self.question, self._said())], tone_of(self.word))

    def _said(self) -> str:
        return self.said or sentence(f"{self.word.capitalize()}: {self.why}")


Block = str | Table | Answer | Printed | Html | None


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a page; ``terminal`` : whether its sentences and tables are printed too; ``name`` : by which links
    lead to it, made from its heading if not given."""

    heading: str
    blocks: Sequence[Block]
    terminal: bool = False
    name: str = ""

    def anchor(self) -> str:
        """Return the name by which a link leads to the section."""
        return self.name or re.sub(r"[^\w]+", "-", self.heading.lower()).strip("-")


@dataclass(frozen=True, slots=True)
class Document:
    """A report: its title, what it is about, and its sections, the answer first; ``banner`` : blocks before the
    contents; ``window`` : title of the browser's window if it is another one."""

    title: str
    about: str
    sections: Sequence[Section]
    banner: Sequence[Block] = ()
    window: str = ""

    def page(self) -> str:
        """Return the page, which opens offline."""
        with one_thread():  # small matrices of figures, on which threads wait for each other
            written = [(each.anchor(), each.heading, html(*each.blocks)) for each in self.sections]
            parts = {"banner": html(*self.banner), "sections": [section for section in written if section[2].strip()]}
            names = {"title": self.title, "about": self.about, "window": self.window or self.title}
            return environment().get_template("report/templates/base.html.jinja").render(names | parts)

    def text(self) -> str:
        """Return the sections for the terminal; headings tell them apart where there are several."""
        shown = {each.heading: list(_lines(each.blocks)) for each in self.sections if each.terminal}
        shown = {heading: lines for heading, lines in shown.items() if lines}
        lines = [self.about, *_lines(self.banner)]
        for heading, content in shown.items():
            lines += ["", *([heading] if heading and len(shown) > 1 else []), *content]
        return "\n".join(lines)


def _lines(blocks: Iterable[Block]) -> Iterator[str]:
    """Yield the lines of sentences and tables, with an empty line before and after each table."""
    before: Block = None
    for block in blocks:
        if not block or isinstance(block, Html):
            continue
        if before and (isinstance(block, Table) or isinstance(before, Table)):
            yield ""
        yield from [block] if isinstance(block, str) else block.lines()
        before = block


def _macro(name: str, *values) -> str:
    return cast(Callable[..., str], environment().globals[name])(*values)


def html(*blocks: Block):
    """Return blocks as markup: sentences as paragraphs, with a capital at their start and a full stop."""
    paragraph = Markup("<p>{}</p>")
    return Markup("\n").join(
        paragraph.format(with_code(sentence(block))) if isinstance(block, str) else escape(block)
        for block in blocks
        if block
    )


def sentence(text: str) -> str:
    """Return a message as a sentence; symbols, file names and what ends in a colon keep their small letters."""
    first = re.split(r"[\s,;]", text, maxsplit=1)[0]
    start = text[0].upper() if first.isascii() and first.isalpha() else text[0]
    return start + text[1:] + ("" if text[-1] in ".!?:)" else ".")


def macro(name: str, *values) -> Html:
    """Return what a macro of ``macros.html.jinja`` writes; functions among ``values`` are called when it does."""
    return Html(lambda: _macro(name, *(value() if callable(value) else value for value in values)))


def page_only(*blocks: Block) -> Html | None:
    """Return blocks that the terminal does not show."""
    return Html(lambda: html(*blocks)) if any(blocks) else None


def subheading(text: str) -> Html:
    return macro("subheading", text)


def fold(summary: str, *blocks: Block) -> Html | None:
    """Return blocks behind a summary to click on."""
    return Html(lambda: _macro("fold", summary, html(*blocks))) if any(blocks) else None


def plot(draw: Callable[[], Drawing], alt: str, caption: str = "", css: str = "wide") -> Html:
    """Return a figure with its caption, drawn when the page is written."""
    return Html(lambda: _macro("plot", draw().uri(), alt, caption or alt, css))


def plots(*figures: Html | None) -> Html | None:
    """Return figures side by side where the page is wide enough."""
    return Html(lambda: _macro("group", "plots", [html(*filter(None, figures))])) if any(figures) else None


def columns(*parts: Sequence[Block], css: str = "columns") -> Html | None:
    """Return parts, each of several blocks, side by side where the page is wide enough."""
    return Html(lambda: _macro("group", css, [html(*part) for part in parts])) if parts else None


def bullets(texts: Sequence[str]) -> Html | None:
    return macro("bullets", [sentence(text) for text in texts]) if texts else None


def alarms(texts: Sequence[str]) -> Html | None:
    return macro("alarms", [sentence(text) for text in texts]) if texts else None


def tiles(values: Sequence[tuple[str, str, str]]) -> Html:
    """Return figures of the headline, each (value, unit, what it is)."""
    return macro("tiles", values)


def legend(colours: dict[str, str], title: str = "") -> Html | None:
    """Return patches of colour with their meanings."""
    return macro("legend", colours, title) if colours else None


def links(pages: Iterable[tuple[str, str]]) -> Html:
    """Return a list of links, each (address, words)."""
    return macro("links", list(pages))


def listed(what: str, values: Iterable) -> str:
    """Return ``what: a, b, c``; nothing if there are no values."""
    values = list(values)
    return f"{what}: {join(values)}" if values else ""
