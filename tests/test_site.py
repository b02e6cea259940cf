"""The site of the documents: what is made for it, and its links. `.ci/run` builds all of it."""

import re

import pytest

from tests.scripts import load_script

site = load_script("build_site")
docstrings = __import__("docstrings")
QUESTIONS = {
    "How do I make a target?": ("init", "target.toml"),
    "May I trust this result?": ("suspicious", "failed"),
    "How do I use my Kalibr camera?": ("camchain.yaml", "--camera"),
}
"""Of three engineers, and words of the answer."""


@pytest.mark.parametrize("question", QUESTIONS)
def test_questions_are_answered_one_click_from_the_first_page(question):
    (link,) = re.findall(
        re.escape(question) + r"\*\* \[[^\]]+\]\(([^)#]+)", (site.DOCS / "index.md").read_text("utf-8")
    )
    answer = (site.DOCS / link).read_text("utf-8")
    assert [word for word in QUESTIONS[question] if word not in answer] == []


def test_every_page_is_listed():
    """In docs/index.md, or in a page of pages that is: Sphinx would end the build."""
    lists = [site.DOCS / "index.md", site.DOCS / "accuracy" / "index.md", site.ROOT / "data_layout.md"]
    listed = {(page.parent / link).resolve() for page in lists for link in site.items(page.read_text("utf-8"))}
    assert sorted(set(site.documents()) - listed - {lists[0]}) == []


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


def test_pages_of_commands_have_every_command():
    made = dict(site.pages.commands())
    assert {"index", "sfm", "robot", "handeye", "register", "locate", "camera"} == set(made)
    assert "## stcal-sfm run\n" in made["sfm"]
    assert "| `--refine-camera` |" in made["sfm"]
    assert "## stcal handeye plan\n" in made["handeye"]


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


def test_pictures_are_cut_to_the_circles(tmp_path):
    pictures = load_script("pictures")
    (tmp_path / "d.csv").write_text("image,label,x_px,y_px\na,1:1,100,60\na,1:2,300,200\nb,1:1,900,900\na,,5,5\n")
    assert pictures.box_of_circles(tmp_path / "d.csv", "a", (320, 600)) == (55, 15, 320, 245)
