"""A report as Markdown and as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from markdown_it import MarkdownIt

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; font-size: 0.9rem }
th, td { padding: 0.15rem 0.6rem; border-bottom: 1px solid #ddd }
img { max-width: 100% }
code { font-size: 0.9em }
"""


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; the first column to the left, the others to the right."""
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def write_page(title: str, parts: Sequence[str], folder: Path) -> None:
    """Write `report.md` and `report.html`.

    Args:
        title: Title of the page.
        parts: Markdown, one block after the other; figures by names in the folder.
        folder: Where it goes; made if it is not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join((f"# {title}", *(part.strip() for part in parts))) + "\n"
    (folder / "report.md").write_text(text, encoding="utf-8")
    body = MarkdownIt("commonmark").enable("table").render(text)
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    page = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}</body></html>\n'
    (folder / "report.html").write_text(page, encoding="utf-8")
