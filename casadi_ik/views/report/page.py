"""The page: totals, figures, and the worst solves with their stories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from html import escape

import numpy as np

from casadi_ik.errors import printable
from casadi_ik.logs.explanation import explain, worst
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import one_solve
from casadi_ik.views.report.figures import curve, effort, places
from casadi_ik.views.report.groups import Group, groups_of, hardest

STYLE = """
:root { color-scheme: light dark; --ink: #2b333b; --faint: #66717c; --line: #dfe4e8;
  --paper: #fff; --bad: #c2334d; --good: #1f7d48 }
@media (prefers-color-scheme: dark) { :root { --ink: #e3e8ec; --faint: #9aa5af; --line: #39424a;
  --paper: #171b1f; --bad: #f07f92; --good: #67c48d } img { background: #fff } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 64rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; font-size: .9rem; display: block; overflow-x: auto }
th, td { padding: .15rem .7rem; border-bottom: 1px solid var(--line); text-align: right }
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2) { text-align: left }
img { max-width: 100%; border-radius: 4px }
details { border-bottom: 1px solid var(--line); padding: .25rem 0 }
summary { cursor: pointer } .bad { color: var(--bad) } .good { color: var(--good) }
.faint { color: var(--faint) } h4 { margin: .5rem 0 0 }
svg polyline { fill: none; stroke: currentColor; stroke-width: 1.4 }
svg .bound { stroke: var(--bad); stroke-dasharray: 4 3 }
"""


def study_page(log: Log, title: str, most: int) -> str:
    """A study's log as a page of its own.

    Args:
        log: The log.
        title: What it is called.
        most: How many of the worst solves can be opened.

    Returns:
        HTML that refers to nothing outside itself.

    Raises:
        LogError: The log is damaged.
    """
    groups = groups_of(log)
    about = log.info()
    parts = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="faint">{_text(about.robot)}; {sum(map(len, groups)):,} solves in '
        f"{len(about.paths)} file(s), {about.size / 1e6:.1f} MB; written "
        f"{_text(about.metadata['created'])} by casadi-ik "
        f"{_text(about.metadata['code_version'])}.</p>",
        "<h2>What came of it</h2>",
        _totals(groups),
    ]
    if any(map(len, groups)):
        parts += [
            "<h2>How long it took</h2>",
            effort(groups),
            "<h2>Where</h2>",
            "<p>The middle of a target's contact points, in the robot's base frame.</p>",
            places(groups),
            f"<h2>The {min(most, sum(map(len, groups)))} hardest</h2>",
            "<p>What is not solved comes first, by its error, then what took the most iterations. "
            "The curve is the worst error over the iterations, from a thousand times its tolerance "
            "(top) to a thousandth; dashed: the tolerance.</p>",
            *_hardest(log, groups, most),
        ]
    body = "\n".join(parts)
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<title>{_text(title)}</title>'
        f"<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _totals(groups: Sequence[Group]) -> str:
    heads = (
        *("method", "targets", "solves", "solved %", "not solved"),
        *("iterations, median", "99 %", "restarted %", "time, median [µs]", "99 %", "singular %"),
    )
    rows = [_total(group) for group in groups]
    return _table(heads, rows)


def _total(group: Group) -> list[str]:
    count = len(group)
    if not count:
        return [group.method, group.name, "0", *[""] * 8]
    failed = Counter(group.status[~group.success].tolist())
    micro = 1e6 * group.time
    return [
        group.method,
        group.name,
        f"{count:,}",
        f"{100 * group.success.mean():.2f}",
        ", ".join(f"{number} {status}" for status, number in failed.most_common()),
        f"{np.median(group.iterations):.0f}",
        f"{np.percentile(group.iterations, 99):.0f}",
        f"{100 * np.mean(group.restarts > 0):.1f}",
        f"{np.median(micro):.0f}",
        f"{np.percentile(micro, 99):.0f}",
        f"{100 * group.singular.mean():.1f}",
    ]


def _hardest(log: Log, groups: tuple[Group, ...], most: int) -> Iterator[str]:
    for group, number in hardest(groups, most):
        solve = one_solve(log, number, group.method)
        found = explain(solve)
        kind = "good" if solve.success else "bad"
        where = "" if group.name == "all" else f" {_text(group.name)}"
        parts = [
            f'<details><summary><span class="{kind}">{_text(solve.status)}</span> '
            f'{_text(found.headline)}<span class="faint">{where}</span></summary>'
        ]
        if len(solve.rows):
            parts.append(curve(worst(solve)))
        for title, lines in (
            ("phases", found.phases),
            ("fingers", found.fingers),
            ("met on its way", found.met),
            ("verdict", found.verdict),
        ):
            if lines:
                items = "".join(f"<li>{_text(line)}</li>" for line in lines)
                parts.append(f"<h4>{title}</h4><ul>{items}</ul>")
        yield "".join(parts) + "</details>"


def _table(heads: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Iterable[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{_text(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(heads, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def _text(text: str) -> str:
    """A text that may come from any file, as a page shows it."""
    return escape(printable(str(text)))
