"""The site of the documents: what is made for it, and its links. `.ci/run` builds all of it."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.report.browser import opened, show, sideways_px
from tests.scripts import load_script

site = load_script("build_site")
docstrings = __import__("docstrings")


def test_every_page_is_listed():
    """Sphinx would end the build."""
    index = site.DOCS / "index.md"
    listed = {(index.parent / link).resolve() for link in site.items(index.read_text("utf-8"))}
    assert sorted(set(site.documents()) - listed - {index}) == []


def test_links_hold_where_pages_stand_in_the_site():
    page, linked = site.DOCS / "howto" / "checks.md", set()
    text = "[a](../cameras.md#x) [b](../../data_layout.md) [c](https://x.org) [e](../../README.md) [f](../none.md)"
    made = site.with_links(text, page, linked)
    assert made == "[a](../cameras.md#x) [b](../data_layout.md) [c](https://x.org) [e](../README.md) [f](../none.md)"
    assert {path.name for path in linked} == {"cameras.md", "data_layout.md", "README.md"}


def test_dead_links_are_found(tmp_path):
    (tmp_path / "a.html").write_text('<a href="b.html#one">1</a><a href="b.html#two">2</a><img src="none.png">')
    (tmp_path / "b.html").write_text('<h1 id="one">x</h1><a href="/rooted">3</a><a href="https://x.org/y">4</a>')
    assert list(site.dead_links(tmp_path)) == ["a.html: b.html#two", "a.html: none.png", "b.html: /rooted"]


DOC = """Find it.

Parameters
----------
a, b : (n, 3) array
    Points, |a| < 1.
*rest
    See :func:`stcal.sfm.run`.

References
----------
J. Denavit, R. Hartenberg.
"""
LISTS = """Find it.


.. rubric:: Parameters


- **a, b** : (n, 3) array

  Points, \\|a\\| < 1.

- **\\*rest**

  See ``stcal.sfm.run``.


.. rubric:: References

\\J. Denavit, R. Hartenberg.
"""


def test_docstrings_become_lists():
    lines = "\n".join(docstrings.as_lists(DOC.splitlines()))
    assert re.sub(r"\n{3,}", "\n\n", lines).strip() == re.sub(r"\n{3,}", "\n\n", LISTS).strip()


WIDE = ("README.md", "docs/howto/calibrate.md", "docs/tutorials/tags.md", "docs/sources.md", "docs/accuracy.md")
"""Pages with long lines of output, long commands and wide tables."""


@pytest.fixture(scope="module")
def wide_pages(tmp_path_factory):
    """Some pages as the site has them; links to others lead nowhere."""
    pytest.importorskip("furo")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in WIDE:
        site.write(source / Path(name).name, (site.ROOT / name).read_text(encoding="utf-8"))
    site.write(source / "index.md", "# Pages\n" + site.contents("", [Path(name).name for name in WIDE]))
    for path in (site.SITE / "conf.py", site.SITE / "docstrings.py"):
        site.write(source / path.name, path.read_text(encoding="utf-8"))
    shutil.copytree(site.SITE / "static", source / "static")
    made = subprocess.run(
        [sys.executable, "-m", "sphinx", "-b", "html", "-q", source, out], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    return sorted(out / Path(name).with_suffix(".html").name for name in WIDE)


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 800, 400])
def test_no_page_is_wider_than_its_window(wide_pages, width):
    with opened() as chrome:
        for page in wide_pages:
            show(chrome, page, width)
            assert sideways_px(chrome) == 0, page.name


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(site, "build_main", None)
    with pytest.raises(SystemExit) as caught:
        site.build(tmp_path / "site")
    assert 'pip install ".[docs]"' in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_picture_is_drawn_from_the_sample(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pictures.py", "found", "--out", str(tmp_path)])
    load_script("pictures").main()
    assert [path.name for path in tmp_path.iterdir()] == ["found.jpg"]
