"""Equations as MathML: every browser draws it, no script and no network is needed.

The converter is docutils' own. What it makes of accents with an index and of the bars of a norm is
put right here: the index goes beside the letter with its accent, the bars stay as high as letters.
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
"""The number that a formula has in the paper it is from."""

MATHML = "http://www.w3.org/1998/Math/MathML"
ACCENTS = frozenset("˙¨→ˆ˜¯~^_")
APPLY = "\u2061"
"""What stands between a function and its argument: nothing is seen of it."""

THIN = "0.17em"


def mathml(tex: str, display: bool) -> str:
    """A formula in TeX as MathML.

    Raises:
        MathError: TeX that the converter does not know; the build then fails and names the page.
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
    # Here, as others take the empty prefix for theirs.
    ElementTree.register_namespace("", MATHML)
    return ElementTree.tostring(root, encoding="unicode")


def _space_functions(row: ElementTree.Element) -> None:
    """A thin space between a function and its letters, as TeX has it."""
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
    """Tell Sphinx of it."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
