"""PDF of a report page, for print and for files: by WeasyPrint, from the page only and without network."""

import io

from stcal.errors import InputError

NEEDED = 'PDF: needs WeasyPrint, which is not installed; pip install "stcal[pdf]"'
NO_PANGO = (
    "PDF: WeasyPrint does not find a library of the system ({reason}); install Pango, as with `apt-get install "
    "libpango-1.0-0 libpangoft2-1.0-0`"
)


def pdf_of(page: str) -> bytes:
    """Return the PDF of a page as its style sheet prints it, A4 with page numbers; equal pages give equal bytes.

    Parameters
    ----------
    page : HTML with all of its content embedded; external resources are not loaded

    Raises
    ------
    InputError
        WeasyPrint, or Pango, which it uses, is not installed.
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

    Raises
    ------
    InputError
        The message names the missing library, and how to install it.
    """
    pdf_of("<p></p>")
