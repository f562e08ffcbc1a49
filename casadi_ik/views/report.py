"""A study's log as one page that needs nothing but a browser; needs the extra `plots`."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import PurePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from casadi_ik import palette
from casadi_ik.arrays import Array, Bools, Counts
from casadi_ik.errors import printable
from casadi_ik.logs.events import SINGULAR
from casadi_ik.logs.explanation import explain, worst
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import one_solve
from casadi_ik.logs.tables import MethodRows
from casadi_ik.views.charts import new_figure

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
        "<h2>Results</h2>",
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


# Solves that belong together.

ALL = "all"


@dataclass(frozen=True, eq=False)
class Group:
    """Solves of one method that belong together.

    Attributes:
        method: The method.
        name: Of the targets: the folder of their shards, as studies lay them down; "all" if there
            is but one.
        solve_id: (k,) their numbers.
        success: (k,) whether solved.
        singular: (k,) whether a Jacobian was near singular or ill-conditioned on the way.
        iterations: (k,).
        restarts: (k,).
        time: (k,) [s].
        worst: (k,) largest error in multiples of its tolerance.
        centre: (k, 3) mean of the contact points [m], base frame; NaN if all are free.
        status: (k,) names.
    """

    method: str
    name: str
    solve_id: Counts
    success: Bools
    singular: Bools
    iterations: Counts
    restarts: Counts
    time: Array
    worst: Array
    centre: Array
    status: np.ndarray

    def __len__(self) -> int:
        return len(self.solve_id)


def groups_of(log: Log) -> tuple[Group, ...]:
    """The solves of a log in groups.

    Raises:
        LogError: The log is damaged.
    """
    found = []
    for part in log.solves().parts:
        whole = _group(part)
        origins = part.origins
        folders = [ALL] if origins is None else [str(PurePath(name).parent) for name in origins]
        names = [ALL if folder == "." else folder for folder in folders]
        known = list(dict.fromkeys(names))
        if len(known) <= 1:
            found.append(whole)
            continue
        kept = np.array(names)
        found += [_rows(whole, name, kept == name) for name in known]
    return tuple(found)


def hardest(groups: tuple[Group, ...], count: int) -> Iterator[tuple[Group, int]]:
    """The solves worth a look: what is not solved, the largest error first, then the longest.

    Args:
        groups: Of a log.
        count: How many at most.

    Yields:
        Group and number of the solve.
    """
    keys = [
        (bool(group.success[i]), -error, -int(group.iterations[i]), g, i)
        for g, group in enumerate(groups)
        for i, error in enumerate(_error(group).tolist())
    ]
    for _, _, _, g, i in sorted(keys)[:count]:
        yield groups[g], int(groups[g].solve_id[i])


def _error(group: Group) -> Array:
    """(k,) the worst error of what is not solved; of the others nothing counts but iterations."""
    return np.where(group.success, 0.0, np.nan_to_num(group.worst, nan=0.0))


def _group(part: MethodRows) -> Group:
    rows = part.rows
    known = list(part.labels["events"])
    singular = [known.index(kind.name) for kind in SINGULAR if kind.name in known]
    share = np.fmax(
        _largest(rows["position_error"] / rows["position_tolerance"]),
        _largest(rows["angle_error"] / rows["angle_tolerance"]),
    )
    points = rows["target_points"]
    there: Bools = np.all(np.isfinite(points), axis=2)
    total = np.where(there[:, :, None], points, 0.0).sum(axis=1)
    counted = there.sum(axis=1)[:, None]
    return Group(
        method=part.method,
        name=ALL,
        solve_id=part.solve_id,
        success=rows["success"] > 0,
        singular=np.any(rows["events"][:, singular], axis=1),
        iterations=rows["iterations"].astype(np.int64),
        restarts=rows["restarts"].astype(np.int64),
        time=rows["time"].astype(float),
        worst=share,
        centre=np.where(counted > 0, total / np.maximum(counted, 1), np.nan),
        status=np.array(part.labels["status"])[rows["status"]],
    )


def _largest(values: Array) -> Array:
    """(k,) of (k, f), free ones aside; NaN where all are."""
    return np.fmax.reduce(values, axis=1)


def _rows(group: Group, name: str, chosen: Bools) -> Group:
    arrays = {
        key: value[chosen] for key, value in vars(group).items() if isinstance(value, np.ndarray)
    }
    return Group(method=group.method, name=name, **arrays)


# Figures.


def effort(groups: Sequence[Group]) -> str:
    """How many iterations and how much time, as shares of the solves of each method."""
    figure = new_figure(9.0, 3.2, 110)
    methods = list(dict.fromkeys(group.method for group in groups))
    panels = (("iterations", "iterations"), ("time", "time of a solve [µs]"))
    for place, (name, label) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 2, place)
        for method, color in palette.method_colors(methods).items():
            values = np.concatenate([getattr(g, name) for g in groups if g.method == method])
            values = np.sort(values * (1e6 if name == "time" else 1.0))
            share = 100 * np.arange(1, len(values) + 1) / len(values)
            axes.plot(np.maximum(values, 1e-3), share, color=color, lw=1.8, label=method)
        axes.set_xscale("log")
        axes.set_ylim(0, 101)
        axes.set_xlabel(label)
        axes.set_ylabel("solves with no more [%]")
        _plain(axes)
        if place == 1:
            axes.legend(frameon=False, fontsize=8, loc="lower right")
    figure.tight_layout()
    return _embedded(figure, "shares of the solves by iterations and by time")


def places(groups: Sequence[Group]) -> str:
    """Where the middle of the contacts is, of solved, near-singular and failed solves."""
    figure = new_figure(9.0, 4.2, 110)
    centre = np.concatenate([group.centre for group in groups])
    success = np.concatenate([group.success for group in groups])
    singular = np.concatenate([group.singular for group in groups])
    kinds = (
        ("solved", "#c9d3dc", success & ~singular, 4),
        ("solved, singular on the way", palette.LINES[0], success & singular, 7),
        ("not solved", palette.LINES[4], ~success, 12),
    )
    panels = figure.subplots(1, 2)
    for axes, title, second, up in zip(
        panels, ("from above", "from the side"), (1, 2), "yz", strict=True
    ):
        for label, color, rows, size in kinds:
            chosen = centre[rows]
            chosen = chosen[:: 1 + len(chosen) // 20_000]
            axes.scatter(
                chosen[:, 0],
                chosen[:, second],
                s=size,
                color=color,
                lw=0,
                label=f"{label} ({int(rows.sum()):,})",
            )
        axes.plot([0], [0], marker="+", color=palette.INK, ms=9, ls="none", label="base")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x [m]")
        axes.set_ylabel(f"{up} [m]")
        axes.set_title(title, fontsize=9, color=palette.INK)
        _plain(axes)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, fontsize=8, loc="lower center", ncols=4)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return _embedded(figure, "where solves fail and where they meet singularities")


def curve(errors: Array) -> str:
    """The worst error of a solve over its iterations as a small drawing.

    Args:
        errors: (m,) in multiples of the tolerance; inf where not measured.
    """
    width, height, low, high = 320, 70, 1e-3, 1e3
    level = np.clip(np.nan_to_num(errors, nan=high, posinf=high), low, high)
    y = height * np.log10(high / level) / np.log10(high / low)
    x = np.linspace(0, width, len(y)) if len(y) > 1 else np.array([0.0])
    if len(y) > width:  # the worst of the iterations that share a dot
        cuts = np.linspace(0, len(y), width, endpoint=False).astype(int)
        x, y = np.arange(width), np.minimum.reduceat(y, cuts)
    dots = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True))
    middle = height / 2
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
        f"<title>worst error in multiples of its tolerance, {low:g} to {high:g}</title>"
        f'<line x1="0" x2="{width}" y1="{middle}" y2="{middle}" class="bound"/>'
        f'<polyline points="{dots}"/></svg>'
    )


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, colors=palette.FAINT)
    axes.grid(color="#eceff2", lw=0.6)
    axes.set_axisbelow(True)


def _embedded(figure: Figure, text: str) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=figure.dpi)
    data = base64.b64encode(drawn.getvalue()).decode("ascii")
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'
