"""Build the documents as a site: build/site/index.html, which opens from disk and can be searched without a server.

.venv/bin/python scripts/build_site.py [--out FOLDER]

The pages are those of docs/ and data_layout.md, and those made from the program (docs/site/pages.py). Any warning of
Sphinx ends it, and so does a link of the pages built that leads nowhere; nothing is asked of the network.
"""

import posixpath
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

from scripts.runner import ROOT, script

try:
    from sphinx.cmd.build import build_main
except ImportError:  # told where the site is built, so that its tests run without it
    build_main = None

DOCS = ROOT / "docs"
SITE = DOCS / "site"
LINK = re.compile(r"(\]\()([^)\s]+)(\))")
ITEM = re.compile(r"\]\(([^)#\s]+\.(?:md|rst))(?:#[^)]*)?\)")
NOT_PAGES = {"printed", "site"}
THEME = ("furo", "myst_parser")
sys.path.insert(0, str(SITE))
pages = __import__("pages")

LISTED = """## Reference

- [Commands](reference/commands/index.md), with all options
- [Keys of result files](reference/files/index.md)
- [Errors and their codes](reference/errors.md)
- [Python interface](reference/api/index.rst)
"""
"""What docs/index.md has more as a page of the site."""


def place_of(path: Path) -> str:
    """Where a file of the repository stands in the site: pages of docs/ at its top, all else by its folders."""
    inside = path.relative_to(DOCS) if path.is_relative_to(DOCS) else path.relative_to(ROOT)
    return inside.as_posix()


def documents() -> list[Path]:
    """All pages that are written by hand."""
    own = [path for path in sorted(DOCS.rglob("*.md")) if path.relative_to(DOCS).parts[0] not in NOT_PAGES]
    at_top = ("README.md", "data_layout.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
    return [*own, *(ROOT / name for name in at_top)]


def collect(source: Path) -> None:
    """Pages, pictures and files that they link to, into an empty folder, with links that hold there."""
    linked: set[Path] = set()
    for page in documents():
        text = with_links(page.read_text(encoding="utf-8"), page, linked)
        write(source / place_of(page), with_contents(page, text))
    for path in linked - set(documents()):
        (source / place_of(path)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, source / place_of(path))
    for place, text in pages.made():
        is_list = place.endswith("index.md")
        write(source / place, text + contents("", items(text)) if is_list else text)
    for path in (SITE / "conf.py", SITE / "docstrings.py"):
        shutil.copyfile(path, source / path.name)
    shutil.copytree(SITE / "static", source / "static")


def write(path: Path, text: str) -> None:
    """A page, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def with_links(text: str, page: Path, linked: set[Path]) -> str:
    """The text of a page with its links as they lead from its place in the site; ``linked`` grows by the files."""
    own = posixpath.dirname(place_of(page)) or "."

    def made(match: re.Match) -> str:
        link, _, anchor = match[2].partition("#")
        if not link or urlsplit(link).scheme:
            return match[0]
        path = (page.parent / link).resolve()
        if path.is_file():
            linked.add(path)
            return f"{match[1]}{posixpath.relpath(place_of(path), own)}{'#' * bool(anchor)}{anchor}{match[3]}"
        return match[0]  # of the site alone, or nowhere: Sphinx knows

    return LINK.sub(made, text)


def with_contents(page: Path, text: str) -> str:
    """The page; docs/index.md with the pages that its sections list, below it in the site's tree."""
    if page == DOCS / "index.md":
        text = text.replace("## Reference\n\n", LISTED)
        parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
        seen: set[str] = set()
        listed = ""
        for title, body in zip(parts[1::2], parts[2::2], strict=True):
            if title == "Three questions":  # their pages are listed below
                continue
            own = [name for name in dict.fromkeys(items(body)) if name not in seen]
            seen.update(own)
            listed += contents(title, own) if own else ""
        return text + listed
    return text


def items(text: str) -> list[str]:
    """Pages that a text links to, in its order."""
    return [link for link in ITEM.findall(text) if not urlsplit(link).scheme]


def contents(caption: str, names: list[str]) -> str:
    """A list of pages that Sphinx puts into its tree, and does not show."""
    head = "\n```{toctree}\n:hidden:\n" + (f":caption: {caption}\n" if caption else "")
    return head + "\n" + "\n".join(names) + "\n```\n"


class Links(HTMLParser):
    """``links`` that a page has, and the ``ids`` that it can be linked at."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Called for each."""
        values = dict(attrs)
        self.links += [link for key in ("href", "src") if (link := values.get(key))]
        self.ids |= {name for key in ("id", "name") if (name := values.get(key))}


def dead_links(site: Path) -> Iterator[str]:
    """What leads nowhere: "page: link". Links to other hosts are not followed."""
    known = {path: Links(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    for page, own in known.items():
        for link in own.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            anchor = unquote(parts.fragment)
            lost = anchor and path in known and anchor not in known[path].ids
            if parts.path.startswith("/") or not path.exists() or lost:
                yield f"{page.relative_to(site)}: {link}"


def build(out: Path, say: Callable[[str], None] = print) -> None:
    """Build it, in place of an earlier one.

    Raises
    ------
    SystemExit
        The extra ``docs`` is not installed, Sphinx warns of something, or a link leads nowhere.
    """
    if build_main is None or not all(map(find_spec, THEME)):
        raise SystemExit('error: the site needs Sphinx, its theme and MyST; run scripts/setup "[docs]", and this again')
    source = out.parent / "site-source"
    for folder in (source, out):
        shutil.rmtree(folder, ignore_errors=True)
    collect(source)
    if build_main(["-b", "html", "-W", "--keep-going", "-n", "-d", str(source / ".doctrees"), str(source), str(out)]):
        raise SystemExit("the site has not been built: see the warnings above")
    dead = list(dead_links(out))
    if dead:
        raise SystemExit("\n".join(["links that lead nowhere:", *dead]))
    shutil.rmtree(source)
    say(f"{len(list(out.rglob('*.html')))} pages: {out / 'index.html'}")


@script(out=ROOT / "build" / "site")
def main(given) -> None:
    build(given.out.resolve())
