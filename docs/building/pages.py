"""Parts of pages that are generated from the package: `<!-- here: NAME ARGUMENTS -->`.

A line with such a comment is replaced by the Markdown that the function of that name returns for
the arguments.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from building.api import (
    documented,
    label_attributes,
    pages_of,
    readable_types,
    short_signature,
    write_pages,
)
from building.commands import command_line
from building.files import file_reference, quantities

PART_LINE = re.compile(r"^<!-- here: ([a-z-]+) ?(.*?) ?-->$", re.MULTILINE)
ROOT = Path(__file__).parents[2]


PARTS: dict[str, Callable[..., str]] = {
    "api": documented,
    "api-pages": pages_of,
    "command-line": command_line,
    "files": file_reference,
    "quantities": quantities,
}


@cache
def _listed_reports() -> str:
    """Return the page of reports; the reports that it does not list are not in the menu."""
    return (ROOT / "docs" / "results.md").read_text(encoding="utf-8")


def _expand(app: Sphinx, docname: str, source: list[str]) -> None:
    del app

    def part(match: re.Match[str]) -> str:
        name, arguments = match[1], match[2].split()
        if name not in PARTS:
            raise ExtensionError(
                f"{docname}: {name!r} is not a part; expected one of {list(PARTS)}"
            )
        return PARTS[name](*arguments)

    if docname.startswith("docs/"):
        source[0] = PART_LINE.sub(part, source[0])
    elif docname.startswith("studies/results/") and f"\n/{docname}\n" not in _listed_reports():
        source[0] = f"---\norphan: true\n---\n\n{source[0]}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("builder-inited", write_pages)
    app.connect("source-read", _expand)
    app.connect("autodoc-process-docstring", readable_types, priority=900)
    app.connect("autodoc-process-signature", short_signature)
    label_attributes()
    return {"parallel_read_safe": True, "parallel_write_safe": True}
