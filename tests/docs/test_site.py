"""Checks of the built site: dead links, unrendered markup, and formulas."""

from __future__ import annotations

import sys
from pathlib import Path

from processes import python

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from building.links import broken, unread
from building.mathml import mathml

SCRIPT = Path(__file__).parents[2] / "docs" / "building" / "links.py"


def test_broken_links_are_named(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "b.html").write_text('<h1 id="here"></h1><a href="../a.html">up</a>')
    (tmp_path / "a.html").write_text(
        '<a href="deep/b.html#here">x</a> <a href="https://elsewhere/x">x</a> <a href="#top">x</a>'
        '<p id="top"></p> <img alt="" src="gone.png"> <a href="deep/b.html#nowhere">x</a>'
    )
    assert sorted(broken(tmp_path)) == [
        "a.html: deep/b.html#nowhere: no such anchor",
        "a.html: gone.png: no such file",
    ]


def test_unrendered_markup_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        "<p>| solves | share |\n| --- | --- |\n| 12 | 67 % |</p><p>of $H_p$ alone</p>"
        "<pre>| --- | $H_p$</pre><p>5 $ and no more</p><p><code>$x$</code></p>"
    )
    assert list(unread(tmp_path)) == [
        "a.html: | --- |: is not converted",
        "a.html: $H_p$: is not converted",
    ]


def test_script_exits_with_its_findings(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    page.write_text('<p id="top"></p><a href="#top">x</a>')
    assert python(SCRIPT, tmp_path).returncode == 0
    page.write_text('<a href="gone.html">x</a>')
    done = python(SCRIPT, tmp_path)
    assert done.returncode == 1
    assert "gone.html" in done.stderr


sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))


def flat(tex: str) -> str:
    return "".join(mathml(tex, display=True).split())


def test_index_is_placed_beside_an_accented_letter() -> None:
    rendered = flat(r"\dot q_t")
    assert "<msub><moveraccent" in rendered
    assert "munderover" not in rendered
