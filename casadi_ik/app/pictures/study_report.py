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

from casadi_ik.app.drawing import palette
from casadi_ik.app.pictures.charts import new_figure
from casadi_ik.errors import printable
from casadi_ik.files.arrays import Array, Bools, Counts
from casadi_ik.files.shipped import models_folder
from casadi_ik.logs.events import SINGULAR, EventKind
from casadi_ik.logs.explanation import explain, worst
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import one_solve
from casadi_ik.logs.tables import MethodRows


def study_page(log: Log, title: str, most: int) -> str:
    """A study's log as a page of its own: totals, failures by reason, solves to filter and sort.

    Args:
        log: The log.
        title: What it is called.
        most: How many of the worst solves are listed with their stories.

    Returns:
        HTML that refers to nothing outside itself.

    Raises:
        LogError: The log is damaged.
    """
    groups = groups_of(log)
    about, count = log.info(), sum(map(len, groups))
    parts = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="faint">{_text(about.robot)}; {count:,} solve{"s" * (count != 1)} in '
        f"{len(about.paths)} file(s), {about.size / 1e6:.1f} MB; written "
        f"{_text(about.metadata['created'])} by casadi-ik "
        f"{_text(about.metadata['code_version'])}.</p>",
        "<h2>Results</h2>",
        _totals(groups),
    ]
    if count:
        chosen = list(hardest(groups, most))
        parts += [
            "<h2>Failures by reason</h2>",
            _clusters(groups),
            f"<h2>{'Solves' if len(chosen) == count else f'The {len(chosen)} hardest solves'}</h2>",
            "<p>What is not solved comes first, by its error, then what took the most iterations. "
            "A number opens the story of a solve: its curve is the worst error over the "
            "iterations, from a thousand times its tolerance (top) to a thousandth; dashed: the "
            "tolerance.</p>",
            _filter(groups, chosen),
            _solves(log, chosen),
            "<h2>Iterations and time</h2>",
            effort(groups),
            "<h2>Where</h2>",
            "<p>The mean of a target's contact points, in the robot's base frame.</p>",
            places(groups),
        ]
    page = (models_folder() / "viewer" / "report.html").read_text(encoding="utf-8")
    before, after = page.split("BODY")
    return before.replace("TITLE", _text(title)) + "\n".join(parts) + after


def _totals(groups: Sequence[Group]) -> str:
    heads = (
        *("method", "targets", "solves", "solved %", "not solved"),
        *("iterations, median", "99 %", "restarted %", "time, median [µs]", "99 %", "singular %"),
    )
    rows = [_total(group) for group in groups]
    return _table(heads, [[_text(cell) for cell in row] for row in rows])


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


def _clusters(groups: Sequence[Group]) -> str:
    """The failures of all groups by reason, the most frequent first."""
    found: dict[tuple[str, str], list[tuple[Group, int]]] = {}
    for group in groups:
        for i in np.flatnonzero(~group.success).tolist():
            found.setdefault((str(group.status[i]), group.reason(i)), []).append((group, i))
    failed = sum(map(len, found.values()))
    if not failed:
        return "<p>Every target is solved.</p>"
    rows = []
    for (status, reason), members in sorted(found.items(), key=lambda item: -len(item[1])):
        error = np.median([group.worst[i] for group, i in members])
        group, i = min(members, key=lambda member: np.nan_to_num(member[0].worst[member[1]]))
        keys = f'data-status="{_text(status)}" data-reason="{_text(reason)}"'
        shown = f'<button type="button" {keys}>{_text(status)}: {_text(reason)}</button>'
        example = f"{group.method}, solve {group.solve_id[i] + 1}"
        numbers = f"{len(members):,}", f"{100 * len(members) / failed:.1f}", f"{error:.3g}"
        rows.append([shown, *numbers, _text(example)])
    heads = "reason", "solves", "% of failures", "error / tolerance, median", "nearest solve"
    return _table(heads, rows)


def _filter(groups: Sequence[Group], chosen: Sequence[tuple[Group, int]]) -> str:
    """What narrows down the list of solves."""
    values = {
        "method": [group.method for group in groups],
        "status": [str(group.status[i]) for group, i in chosen],
        "reason": [group.reason(i) for group, i in chosen if not group.success[i]],
    }
    fields = [
        f'<label>{name} <select name="{name}"><option value="">all</option>'
        + "".join(f"<option>{_text(value)}</option>" for value in dict.fromkeys(known))
        + "</select></label>"
        for name, known in values.items()
    ]
    return (
        '<form id="filter"><label>text <input name="words" type="search"></label>'
        + "".join(fields)
        + '<button type="reset">Show all</button><span id="count" role="status"></span></form>'
    )


def _solves(log: Log, chosen: Sequence[tuple[Group, int]]) -> str:
    """Solves as a table, each with its story behind a button."""
    heads = ["solve", "method", "targets", "status", "reason"]
    heads += ["iterations", "restarts", "time [µs]", "error / tolerance"]
    head = "".join(
        f'<th scope="col" class="{"left" if 0 < i < 5 else ""}" aria-sort="none">'
        f'<button type="button">{text}</button></th>'
        for i, text in enumerate(heads)
    )
    bodies = []
    for group, i in chosen:
        number, status = int(group.solve_id[i]) + 1, str(group.status[i])
        reason, kind = ("", "good") if group.success[i] else (group.reason(i), "bad")
        texts = _text(group.method), _text(group.name), _text(status), _text(reason)
        left = '<td class="left">{}</td><td class="left">{}</td><td class="left {kind}">{}</td>'
        left = f'{left}<td class="left">{{}}</td>'.format(*texts, kind=kind)
        worst_error = float(np.nan_to_num(group.worst[i], nan=0.0))
        numbers = group.iterations[i], group.restarts[i], 1e6 * group.time[i], worst_error
        right = "".join(f'<td data-value="{value:.9g}">{_digits(value)}</td>' for value in numbers)
        keys = f'data-method="{_text(group.method)}" data-status="{_text(status)}"'
        bodies.append(
            f'<tbody class="solve" {keys} data-reason="{_text(reason)}">'
            f'<tr><td data-value="{number}"><button type="button" aria-expanded="false">{number}'
            f"</button></td>{left}{right}</tr>"
            f'<tr hidden><td class="story" colspan="{len(heads)}"><div>'
            f"{_story(log, group, i)}</div></td></tr></tbody>"
        )
    return (
        f'<div class="wide"><table id="solves"><thead><tr>{head}</tr></thead>'
        f"{''.join(bodies)}</table></div>"
    )


def _digits(value: float) -> str:
    """A number with three digits at least, and never with an exponent of ten if it is large."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def _story(log: Log, group: Group, i: int) -> str:
    """What `explain` tells of a solve."""
    solve = one_solve(log, int(group.solve_id[i]), group.method)
    found = explain(solve)
    parts = [f"<p>{_text(found.headline)}</p>"]
    if len(solve.rows):
        parts.append(curve(worst(solve)))
    for title, lines in found.parts.items():
        items = "".join(f"<li>{_text(line)}</li>" for line in lines)
        parts.append(f"<h4>{title}</h4><ul>{items}</ul>")
    return "".join(parts)


def _table(heads: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of HTML cells; the first column is text."""

    def line(cells: Iterable[str], tag: str) -> str:
        first, *rest = cells
        return f'<tr><{tag} class="left">{first}</{tag}>' + "".join(
            f"<{tag}>{cell}</{tag}>" for cell in rest
        )

    lines = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table>{line(heads, "th")}{lines}</table></div>'


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
        fingers: Names of the f fingers.
        ok: (k, f) whether each contact is within tolerance.
        limited: (k,) whether a limit was violated or an actuator came to one and stayed.
        touching: (k,) whether shapes touch in the answer.
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
    fingers: tuple[str, ...]
    ok: Bools
    limited: Bools
    touching: Bools

    def __len__(self) -> int:
        return len(self.solve_id)

    def reason(self, i: int) -> str:
        """Why a solve is none, as far as its totals tell: what is missed, and what was met."""
        missed = [finger for finger, ok in zip(self.fingers, self.ok[i], strict=True) if not ok]
        every = "every contact" if len(missed) == len(self.fingers) else ", ".join(missed)
        met = {
            f"{every} missed": bool(missed),
            "at a limit": self.limited[i],
            "near singular": self.singular[i],
            "in collision": self.touching[i],
        }
        return ", ".join(text for text, holds in met.items() if holds) or "nothing was missed"


def groups_of(log: Log) -> tuple[Group, ...]:
    """The solves of a log in groups.

    Raises:
        LogError: The log is damaged.
    """
    found = []
    for part in log.solves().parts:
        folders = [str(PurePath(name).parent) for name in part.origins or ()]
        known = list(dict.fromkeys(folders))
        if len(known) <= 1:
            found.append(_group(part, ALL))
            continue
        of = np.array(folders)
        found += [_group(part.where(of == name), ALL if name == "." else name) for name in known]
    return tuple(found)


def hardest(groups: tuple[Group, ...], count: int) -> Iterator[tuple[Group, int]]:
    """The solves worth a look: what is not solved, the largest error first, then the longest.

    Args:
        groups: Of a log.
        count: How many at most.

    Yields:
        Group and place of the solve in it.
    """
    keys = [
        (bool(group.success[i]), -error, -int(group.iterations[i]), g, i)
        for g, group in enumerate(groups)
        for i, error in enumerate(_error(group).tolist())
    ]
    for _, _, _, g, i in sorted(keys)[:count]:
        yield groups[g], i


def _error(group: Group) -> Array:
    """(k,) the worst error of what is not solved; of the others nothing counts but iterations."""
    return np.where(group.success, 0.0, np.nan_to_num(group.worst, nan=0.0))


def _group(part: MethodRows, name: str) -> Group:
    rows = part.rows
    known = list(part.labels["events"])
    hits, leavings = (
        rows["events"][:, known.index(kind.name)]
        if kind.name in known
        else np.zeros(len(rows), np.int64)
        for kind in (EventKind.LIMIT_HIT, EventKind.LIMIT_LEFT)
    )
    singular = [known.index(kind.name) for kind in SINGULAR if kind.name in known]
    # What is free is NaN and counts for nothing.
    shares = [rows[f"{kind}_error"] / rows[f"{kind}_tolerance"] for kind in ("position", "angle")]
    points = rows["target_points"]
    there: Bools = np.all(np.isfinite(points), axis=2)
    total = np.where(there[:, :, None], points, 0.0).sum(axis=1)
    counted = there.sum(axis=1)[:, None]
    return Group(
        method=part.method,
        name=name,
        solve_id=part.solve_id,
        success=rows["success"] > 0,
        singular=np.any(rows["events"][:, singular], axis=1),
        iterations=rows["iterations"].astype(np.int64),
        restarts=rows["restarts"].astype(np.int64),
        time=rows["time"].astype(float),
        worst=np.fmax.reduce(np.concatenate(shares, axis=1), axis=1),
        centre=np.where(counted > 0, total / np.maximum(counted, 1), np.nan),
        status=np.array(part.labels["status"])[rows["status"]],
        fingers=tuple(part.labels["position_error"]),
        ok=rows["ok"] > 0,
        limited=(rows["limits_ok"] == 0) | (hits > leavings),
        touching=rows["clearance"] < 0 if "clearance" in part.names else rows["success"] > 1,
    )


# Figures.

READABLE = "#7c8792"
"""Colour of what is written in figures, which stand on a light or a dark page."""


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
            axes.legend(frameon=False, fontsize=8, loc="upper left", labelcolor=READABLE)
    figure.tight_layout()
    return _embedded(figure, "shares of the solves by iterations and by time")


def places(groups: Sequence[Group]) -> str:
    """Where the middle of the contacts is, of solved, near-singular and failed solves."""
    figure = new_figure(9.0, 4.2, 110)
    centre = np.concatenate([group.centre for group in groups])
    success = np.concatenate([group.success for group in groups])
    singular = np.concatenate([group.singular for group in groups])
    kinds = (
        ("solved", "#9fb0bf", success & ~singular, 4),
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
        axes.plot([0], [0], marker="+", color=READABLE, ms=9, ls="none", label="base")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x [m]")
        axes.set_ylabel(f"{up} [m]")
        axes.set_title(title, fontsize=9)
        _plain(axes)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        lines, labels, frameon=False, fontsize=8, loc="lower center", ncols=4, labelcolor=READABLE
    )
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
    axes.spines[["left", "bottom"]].set_color(READABLE)
    axes.tick_params(which="both", labelsize=8, colors=READABLE)
    for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
        text.set_color(READABLE)
    axes.grid(color=READABLE, alpha=0.25, lw=0.6)
    axes.set_axisbelow(True)


def _embedded(figure: Figure, text: str) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=figure.dpi, transparent=True)
    data = base64.b64encode(drawn.getvalue()).decode("ascii")
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'
