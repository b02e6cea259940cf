"""Pages as HTML and PDF."""

import io
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from stcal.errors import InputError
from stcal.report.text import number

MACROS = "report/templates/macros.html.jinja"


@cache
def environment() -> Environment:
    """Return the template environment, which escapes everything but markup, and refuses undefined names."""
    env = Environment(
        loader=PackageLoader("stcal", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters["with_code"] = with_code
    env.filters["number"] = number
    macros = vars(env.get_template(MACROS).module)
    env.globals |= {name: macro for name, macro in macros.items() if not name.startswith("_")}
    return env


def with_code(text: str) -> Markup:
    """Return a sentence with the text between backticks marked as code."""
    parts = [escape(part) for part in text.split("`")]
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else p for i, p in enumerate(parts))


NEEDED = (
    'PDF: needs WeasyPrint, which is not installed; pip install "stereo-target-calibration[pdf]", or in a clone '
    '`source scripts/setup "[pdf]"`'
)
NO_PANGO = (
    "PDF: WeasyPrint does not find a library of the system ({reason}); install Pango, as with `apt-get install "
    "libpango-1.0-0 libpangoft2-1.0-0`"
)


def pdf_of(page: str) -> bytes:
    """Return the PDF of a page as its style sheet prints it, A4 with page numbers; equal pages give equal bytes.

    ``page`` : HTML with all of its content embedded; external resources are not loaded.

    Raises InputError: WeasyPrint, or Pango, which it uses, is not installed.
    """
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
    """Refuse, before the work, if no PDF can be made.

    Raises InputError: the message names the missing library, and how to install it.
    """
    pdf_of("<p></p>")
