"""Equations as MathML: every browser draws it, no script and no network is needed."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number

TAG = re.compile(r"\\tag\{(.*?)\}")
"""The number that a formula has in the paper it is from."""


def _mathml(tex: str, display: bool) -> str:
    """A formula in TeX as MathML.

    Raises:
        MathError: TeX that the converter does not know; the build then fails and names the page.
    """
    return latex2mathml.tex2mathml(tex, as_block=display)


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node.astext(), display=False))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.math_block) -> None:
    tex = node.astext()
    tag = TAG.search(tex)
    number = tag[1] if tag else get_node_equation_number(self, node) if node["number"] else ""
    self.body.append(self.starttag(node, "div", CLASS="equation"))
    self.body.append(_mathml(TAG.sub("", tex), display=True))
    if number:
        self.body.append(f'<span class="eqno">({number})</span>')
    self.body.append("</div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of it."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
