"""Parts of pages that are made from the package: `<!-- here: NAME ARGUMENTS -->` in a page.

On a line of its own such a comment is replaced by the Markdown that the function of that name
makes of the arguments. In the repository the page reads on without it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from building.api import (
    call_them_attributes,
    documented,
    in_words,
    pages_of,
    readable,
    write_pages,
)
from building.commands import command_line
from building.files import file_reference, quantities
from building.results import results_table, retitled

HERE = re.compile(r"^<!-- here: ([a-z-]+) ?(.*?) ?-->$", re.MULTILINE)
ROOT = Path(__file__).parents[2]


def _other_pages(*known: str) -> str:
    """The pages in docs/ that no list of pages names."""
    lists = ("index.md", "extending.md", "community.md")
    text = "\n".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in lists)
    named = set(re.findall(r"^(?:.*<)?(?:/docs/)?([a-z_0-9/]+)>?$", text, re.MULTILINE))
    pages = sorted(path.stem for path in (ROOT / "docs").glob("*.md"))
    others = [name for name in pages if name not in {"index", *named, *known}]
    if not others:
        return ""
    return "\n".join(["```{toctree}", ":hidden:", ":caption: More", "", *others, "```"])


PARTS: dict[str, Callable[..., str]] = {
    "api": documented,
    "api-pages": pages_of,
    "command-line": command_line,
    "files": file_reference,
    "quantities": quantities,
    "other-pages": _other_pages,
    "results": results_table,
}


def _expand(app: Sphinx, docname: str, source: list[str]) -> None:
    del app

    def part(match: re.Match[str]) -> str:
        name, arguments = match[1], match[2].split()
        if name not in PARTS:
            raise ExtensionError(f"{docname}: found <!-- here: {name} -->, known: {list(PARTS)}")
        return PARTS[name](*arguments)

    if docname.startswith("docs/"):
        source[0] = HERE.sub(part, source[0])
    elif docname.startswith("studies/results/"):
        source[0] = retitled(docname, source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of it."""
    app.connect("builder-inited", write_pages)
    app.connect("source-read", _expand)
    app.connect("autodoc-process-docstring", readable, priority=900)
    app.connect("autodoc-process-signature", in_words)
    call_them_attributes()
    return {"parallel_read_safe": True, "parallel_write_safe": True}
