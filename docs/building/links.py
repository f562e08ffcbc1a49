"""Whether all links of the built site lead somewhere, and all text was read as what it is.

`python docs/building/links.py DIR`
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from functools import cache
from html import unescape
from pathlib import Path
from urllib.parse import unquote

LINK = re.compile(r"""<(?:a|img|link|script|source)\b[^>]*?\b(?:href|src)="([^"]+)\"""")
NAMED = re.compile(r"""\b(?:id|name)="([^"]+)\"""")

RAW = re.compile(r"(?:<p>[^<]*?|<m\w+>)(\|\s*---\s*\||\$[^$<]+\$|\[\d+pt\])")
"""A table or a formula in Markdown that stands in a paragraph as it was written."""


@cache
def _named(page: Path) -> frozenset[str]:
    return frozenset(map(unescape, NAMED.findall(page.read_text(encoding="utf-8"))))


def broken(folder: Path) -> Iterator[str]:
    """What leads nowhere, one line each; addresses elsewhere are not looked at."""
    for page in sorted(folder.rglob("*.html")):
        for link in {unescape(one) for one in LINK.findall(page.read_text(encoding="utf-8"))}:
            if re.match(r"[a-z]+:", link):
                continue
            path, _, place = link.partition("#")
            target = page if not path else (page.parent / unquote(path.partition("?")[0])).resolve()
            if not target.exists():
                yield f"{page.relative_to(folder)}: {link}: no such file"
            elif place and target.suffix == ".html" and unquote(place) not in _named(target):
                yield f"{page.relative_to(folder)}: {link}: no such place"


def unread(folder: Path) -> Iterator[str]:
    """Tables and formulas that stand on a page as they were written, one line each."""
    for page in sorted(folder.rglob("*.html")):
        for found in RAW.findall(page.read_text(encoding="utf-8")):
            yield f"{page.relative_to(folder)}: {found}: is not drawn"


if __name__ == "__main__":
    site = Path(sys.argv[1]).resolve()
    sys.exit("\n".join([*broken(site), *unread(site)]) or 0)
