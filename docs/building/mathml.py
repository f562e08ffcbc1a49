"""Equations as MathML, which browsers draw without scripts and without network access.

The converter is that of docutils, with two corrections: the index of a letter with an accent
follows the letter, and the bars of a norm have the height of letters.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number

TAG = re.compile(r"\\tag\{(.*?)\}")
"""Number of an equation in its paper."""

MATHML = "http://www.w3.org/1998/Math/MathML"
ACCENTS = frozenset("˙¨→ˆ˜¯~^_")
APPLY = "\u2061"
"""Invisible character between a function and its argument."""

THIN = "0.17em"


def mathml(tex: str, display: bool) -> str:
    """Convert a formula in TeX to MathML.

    Raises:
        MathError: The converter does not know a command; the build fails and names the page.
    """
    text = latex2mathml.tex2mathml(tex, as_block=display).replace("&ApplyFunction;", APPLY)
    root = ElementTree.fromstring(text)
    for element in list(root.iter()):
        _space_functions(element)
        if element.tag == _tag("munderover") and element[2].text in ACCENTS:
            letter, index, accent = element
            element[:] = [_accented(letter, accent), index]
            element.tag = _tag("msub")
        elif element.tag == _tag("mo") and element.text == "‖" and "minsize" not in element.attrib:
            element.set("stretchy", "false")
    # Not at import, because other libraries register the empty prefix too.
    ElementTree.register_namespace("", MATHML)
    return ElementTree.tostring(root, encoding="unicode")


def _space_functions(row: ElementTree.Element) -> None:
    """Insert a thin space between a function and its letters, as TeX does."""
    bars = _tag("mo"), _tag("mrow"), _tag("mspace")
    for function, applied in list(pairwise(row)):
        if applied.text != APPLY:
            continue
        place = list(row).index(applied)
        if place + 1 < len(row) and row[place + 1].tag not in bars:
            applied.set("rspace", THIN)
        if place > 1 and row[place - 2].tag not in bars:
            row.insert(list(row).index(function), ElementTree.Element(_tag("mspace"), width=THIN))


def _tag(name: str) -> str:
    return f"{{{MATHML}}}{name}"


def _accented(letter: ElementTree.Element, accent: ElementTree.Element) -> ElementTree.Element:
    both = ElementTree.Element(_tag("mover"), {"accent": "true"})
    both.extend([letter, accent])
    return both


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(mathml(node.astext(), display=False))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.math_block) -> None:
    tex = node.astext()
    tag = TAG.search(tex)
    number = tag[1] if tag else get_node_equation_number(self, node) if node["number"] else ""
    self.body.append(self.starttag(node, "div", CLASS="equation"))
    self.body.append(mathml(TAG.sub("", tex), display=True))
    if number:
        self.body.append(f'<span class="eqno">({number})</span>')
    self.body.append("</div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer of equations."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
