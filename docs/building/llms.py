"""`llms.txt`: a list of the pages of the site for language models (https://llmstxt.org)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

SUMMARY = (
    "Inverse kinematics for robot arms with multi-fingered hands: joint positions from fingertip "
    "contacts. Python package `casadi_ik`, command line `casadi-ik`, export to C and WebAssembly."
)


def llms_text(app: Sphinx) -> str:
    """Return the pages of the menu in its order, with their first sentences."""
    lines = ["# casadi_ik", "", f"> {SUMMARY}"]
    root = app.env.get_doctree(app.config.root_doc)
    for menu in root.findall(addnodes.toctree):
        lines += ["", f"## {menu['caption']}", ""]
        for _, page in menu["entries"]:
            lines += [_entry(app, page), *(_entry(app, child) for child in _children(app, page))]
    return "\n".join(lines) + "\n"


def _children(app: Sphinx, page: str) -> Iterator[str]:
    """Yield the pages below a page of the menu; names of the reference have no entry."""
    for child in app.env.toctree_includes.get(page, []):
        if "/names/" not in child:
            yield child


def _entry(app: Sphinx, page: str) -> str:
    """Return a Markdown list item: title, address, first sentence."""
    title = app.env.titles[page].astext()
    address = f"{app.config.html_baseurl.rstrip('/')}/{page}.html"
    paragraphs = app.env.get_doctree(page).findall(nodes.paragraph)
    texts = (
        " ".join(paragraph.astext().split())
        for paragraph in paragraphs
        if isinstance(paragraph.parent, nodes.section) and not paragraph.next_node(nodes.image)
    )
    text = next(texts, "")
    sentence = re.split(r"(?<=[a-z0-9)])\. ", text)[0].rstrip(".:")
    return f"- [{title}]({address}): {sentence}" if sentence else f"- [{title}]({address})"


def write_llms(app: Sphinx, failure: Exception | None) -> None:
    """Write `llms.txt` to the root of the built site."""
    if failure is None and app.builder.format == "html":
        Path(app.outdir, "llms.txt").write_text(llms_text(app), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("build-finished", write_llms)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
