"""The site of the documents: what is made for it, and its links. `.ci/run` builds all of it."""

import pytest

from tests.scripts import load_script

site = load_script("build_site")


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


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(site, "build_main", None)
    with pytest.raises(SystemExit) as caught:
        site.build(tmp_path / "site")
    assert 'scripts/setup "[docs]"' in str(caught.value)
    assert "\n" not in str(caught.value)
