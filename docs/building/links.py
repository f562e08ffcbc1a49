"""Check the built site for broken links and for Markdown that was not converted.

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
"""A table or formula in Markdown that was not converted."""


@cache
def _named(page: Path) -> frozenset[str]:
    return frozenset(map(unescape, NAMED.findall(page.read_text(encoding="utf-8"))))


def broken(folder: Path) -> Iterator[str]:
    """Yield a line for each broken link; external addresses are not checked."""
    for page in sorted(folder.rglob("*.html")):
        for link in {
            unescape(address) for address in LINK.findall(page.read_text(encoding="utf-8"))
        }:
            if re.match(r"[a-z]+:", link):
                continue
            path, _, anchor = link.partition("#")
            target = page if not path else (page.parent / unquote(path.partition("?")[0])).resolve()
            if not target.exists():
                yield f"{page.relative_to(folder)}: {link}: no such file"
            elif anchor and target.suffix == ".html" and unquote(anchor) not in _named(target):
                yield f"{page.relative_to(folder)}: {link}: no such anchor"


def unread(folder: Path) -> Iterator[str]:
    """Yield a line for each table and formula that was not converted."""
    for page in sorted(folder.rglob("*.html")):
        for raw in RAW.findall(page.read_text(encoding="utf-8")):
            yield f"{page.relative_to(folder)}: {raw}: is not converted"


if __name__ == "__main__":
    site = Path(sys.argv[1]).resolve()
    sys.exit("\n".join([*broken(site), *unread(site)]) or 0)
