"""Report of a study's log as one self-contained HTML page; needs the extra `plots`."""

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
from casadi_ik.logs.explanation import explain, worst_error_ratio
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import one_solve
from casadi_ik.logs.tables import MethodRows


def study_page(log: Log, title: str, max_details: int) -> str:
    """Return a report of a log: totals, failures by reason, and solves to filter and sort.

    Args:
        log: The log.
        title: Title of the page.
        max_details: Maximum number of solves that are listed with details, the hardest first.

    Returns:
        Self-contained HTML.

    Raises:
        LogError: The log is damaged.
    """
    groups = solve_groups(log)
    info, count = log.info(), sum(map(len, groups))
    parts = [
        f"<h1>{_escape(title)}</h1>",
        f'<p class="faint">{_escape(info.robot)}; {count:,} solve{"s" * (count != 1)} in '
        f"{len(info.paths)} file(s), {info.size / 1e6:.1f} MB; written "
        f"{_escape(info.metadata['created'])} by casadi-ik "
        f"{_escape(info.metadata['code_version'])}.</p>",
        "<h2>Results</h2>",
        _totals(groups),
    ]
    if count:
        listed = list(hardest_solves(groups, max_details))
        parts += [
            "<h2>Failures by reason</h2>",
            _clusters(groups),
            f"<h2>{'Solves' if len(listed) == count else f'The {len(listed)} hardest solves'}</h2>",
            "<p>Unsolved targets come first, ordered by error, then solves ordered by iterations. "
            "Click a number for details; the curve shows the worst error over the iterations, "
            "from a thousand times the tolerance (top) to a thousandth; dashed: the "
            "tolerance.</p>",
            _filter(groups, listed),
            _solves(log, listed),
            "<h2>Iterations and time</h2>",
            effort_figure(groups),
            "<h2>Positions of targets</h2>",
            "<p>Mean contact point of each target in the base frame.</p>",
            contact_figure(groups),
        ]
    page = (models_folder() / "viewer" / "report.html").read_text(encoding="utf-8")
    head, foot = page.split("BODY")
    return head.replace("TITLE", _escape(title)) + "\n".join(parts) + foot


def _totals(groups: Sequence[SolveGroup]) -> str:
    titles = (
        *("method", "targets", "solves", "solved %", "not solved"),
        *("iterations, median", "99 %", "restarted %", "time, median [µs]", "99 %", "singular %"),
    )
    rows = [_total(group) for group in groups]
    return _table(titles, [[_escape(cell) for cell in row] for row in rows])


def _total(group: SolveGroup) -> list[str]:
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


def _clusters(groups: Sequence[SolveGroup]) -> str:
    """Return a table of failures by reason, the max_details frequent first."""
    members_by_reason: dict[tuple[str, str], list[tuple[SolveGroup, int]]] = {}
    for group in groups:
        for i in np.flatnonzero(~group.success).tolist():
            members_by_reason.setdefault((str(group.status[i]), group.reason(i)), []).append(
                (group, i)
            )
    failure_count = sum(map(len, members_by_reason.values()))
    if not failure_count:
        return "<p>Every target is solved.</p>"
    rows = []
    for (status, reason), members in sorted(
        members_by_reason.items(), key=lambda item: -len(item[1])
    ):
        error = np.median([group.worst[i] for group, i in members])
        group, i = min(members, key=lambda member: np.nan_to_num(member[0].worst[member[1]]))
        keys = f'data-status="{_escape(status)}" data-reason="{_escape(reason)}"'
        button = f'<button type="button" {keys}>{_escape(status)}: {_escape(reason)}</button>'
        example = f"{group.method}, solve {group.solve_id[i] + 1}"
        numbers = f"{len(members):,}", f"{100 * len(members) / failure_count:.1f}", f"{error:.3g}"
        rows.append([button, *numbers, _escape(example)])
    titles = "reason", "solves", "% of failures", "error / tolerance, median", "smallest error"
    return _table(titles, rows)


def _filter(groups: Sequence[SolveGroup], listed: Sequence[tuple[SolveGroup, int]]) -> str:
    """Return the form that filters the list of solves."""
    values = {
        "method": [group.method for group in groups],
        "status": [str(group.status[i]) for group, i in listed],
        "reason": [group.reason(i) for group, i in listed if not group.success[i]],
    }
    fields = [
        f'<label>{name} <select name="{name}"><option value="">all</option>'
        + "".join(f"<option>{_escape(value)}</option>" for value in dict.fromkeys(options))
        + "</select></label>"
        for name, options in values.items()
    ]
    return (
        '<form id="filter"><label>text <input name="words" type="search"></label>'
        + "".join(fields)
        + '<button type="reset">Show all</button><span id="count" role="status"></span></form>'
    )


def _solves(log: Log, listed: Sequence[tuple[SolveGroup, int]]) -> str:
    """Return a table of solves whose details open by a button."""
    titles = ["solve", "method", "targets", "status", "reason"]
    titles += ["iterations", "restarts", "time [µs]", "error / tolerance"]
    header = "".join(
        f'<th scope="col" class="{"left" if 0 < i < 5 else ""}" aria-sort="none">'
        f'<button type="button">{text}</button></th>'
        for i, text in enumerate(titles)
    )
    table_bodies = []
    for group, i in listed:
        number, status = int(group.solve_id[i]) + 1, str(group.status[i])
        reason, kind = ("", "good") if group.success[i] else (group.reason(i), "bad")
        texts = _escape(group.method), _escape(group.name), _escape(status), _escape(reason)
        text_cells = (
            '<td class="left">{}</td><td class="left">{}</td><td class="left {kind}">{}</td>'
        )
        text_cells = f'{text_cells}<td class="left">{{}}</td>'.format(*texts, kind=kind)
        worst_error = float(np.nan_to_num(group.worst[i], nan=0.0))
        numbers = group.iterations[i], group.restarts[i], 1e6 * group.time[i], worst_error
        number_cells = "".join(
            f'<td data-value="{value:.9g}">{_format_number(value)}</td>' for value in numbers
        )
        keys = f'data-method="{_escape(group.method)}" data-status="{_escape(status)}"'
        table_bodies.append(
            f'<tbody class="solve" {keys} data-reason="{_escape(reason)}">'
            f'<tr><td data-value="{number}"><button type="button" aria-expanded="false">{number}'
            f"</button></td>{text_cells}{number_cells}</tr>"
            f'<tr hidden><td class="story" colspan="{len(titles)}"><div>'
            f"{_details_html(log, group, i)}</div></td></tr></tbody>"
        )
    return (
        f'<div class="wide"><table id="solves"><thead><tr>{header}</tr></thead>'
        f"{''.join(table_bodies)}</table></div>"
    )


def _format_number(value: float) -> str:
    """Return a number with at least three digits, without an exponent if it is large."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def _details_html(log: Log, group: SolveGroup, i: int) -> str:
    """Return the explanation of a solve."""
    solve = one_solve(log, int(group.solve_id[i]), group.method)
    explanation = explain(solve)
    parts = [f"<p>{_escape(explanation.headline)}</p>"]
    if len(solve.rows):
        parts.append(error_curve(worst_error_ratio(solve)))
    for title, lines in explanation.parts.items():
        items = "".join(f"<li>{_escape(line)}</li>" for line in lines)
        parts.append(f"<h4>{title}</h4><ul>{items}</ul>")
    return "".join(parts)


def _table(titles: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of HTML cells whose first column is text."""

    def line(cells: Iterable[str], tag: str) -> str:
        label, *values = cells
        return f'<tr><{tag} class="left">{label}</{tag}>' + "".join(
            f"<{tag}>{cell}</{tag}>" for cell in values
        )

    lines = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table>{line(titles, "th")}{lines}</table></div>'


def _escape(text: str) -> str:
    """Return a text from an untrusted file as HTML."""
    return escape(printable(str(text)))


# Groups of solves.

ALL_TARGETS = "all"


@dataclass(frozen=True, eq=False)
class SolveGroup:
    """Solves of one method and one set of targets.

    Attributes:
        method: The method.
        name: Name of the targets: the folder of their shards; "all" if there is only one.
        solve_id: (k,) Numbers of the solves.
        success: (k,) The target is solved.
        singular: (k,) A Jacobian was near singular or ill-conditioned during the solve.
        iterations: (k,) Iterations.
        restarts: (k,) Restarts.
        time: (k,) Time [s].
        worst: (k,) Largest error relative to its tolerance.
        centre: (k, 3) Mean contact point in the base frame [m]; NaN if all points are free.
        status: (k,) Names of the status.
        fingers: Names of the f fingers.
        ok: (k, f) The contact is within tolerance.
        limited: (k,) A limit was violated, or an actuator stayed at one.
        touching: (k,) The solution is in collision.
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
        """Return the missed contacts and the difficulties of a solve, from its totals."""
        missed = [finger for finger, ok in zip(self.fingers, self.ok[i], strict=True) if not ok]
        contacts = "every contact" if len(missed) == len(self.fingers) else ", ".join(missed)
        conditions = {
            f"{contacts} missed": bool(missed),
            "at a limit": self.limited[i],
            "near singular": self.singular[i],
            "in collision": self.touching[i],
        }
        return (
            ", ".join(text for text, is_met in conditions.items() if is_met) or "no contact missed"
        )


def solve_groups(log: Log) -> tuple[SolveGroup, ...]:
    """Return the solves of a log in groups.

    Raises:
        LogError: The log is damaged.
    """
    groups = []
    for part in log.solves().parts:
        folders = [str(PurePath(name).parent) for name in part.origins or ()]
        names = list(dict.fromkeys(folders))
        if len(names) <= 1:
            groups.append(_solve_group(part, ALL_TARGETS))
            continue
        folder_of_solve = np.array(folders)
        groups += [
            _solve_group(part.where(folder_of_solve == name), ALL_TARGETS if name == "." else name)
            for name in names
        ]
    return tuple(groups)


def hardest_solves(groups: tuple[SolveGroup, ...], count: int) -> Iterator[tuple[SolveGroup, int]]:
    """Yield the hardest solves: failures by descending error, then solves by iterations.

    Args:
        groups: Groups of a log.
        count: Maximum number of solves.

    Yields:
        Group, and index of the solve in it.
    """
    keys = [
        (bool(group.success[i]), -error, -int(group.iterations[i]), g, i)
        for g, group in enumerate(groups)
        for i, error in enumerate(_sort_error(group).tolist())
    ]
    for _, _, _, g, i in sorted(keys)[:count]:
        yield groups[g], i


def _sort_error(group: SolveGroup) -> Array:
    """Return the (k,) worst errors of failures; 0 for solved targets."""
    return np.where(group.success, 0.0, np.nan_to_num(group.worst, nan=0.0))


def _solve_group(part: MethodRows, name: str) -> SolveGroup:
    rows = part.rows
    events = list(part.labels["events"])
    limit_hits, limit_exits = (
        rows["events"][:, events.index(kind.name)]
        if kind.name in events
        else np.zeros(len(rows), np.int64)
        for kind in (EventKind.LIMIT_HIT, EventKind.LIMIT_LEFT)
    )
    singular = [events.index(kind.name) for kind in SINGULAR if kind.name in events]
    # Unconstrained errors are NaN and ignored.
    relative_errors = [
        rows[f"{kind}_error"] / rows[f"{kind}_tolerance"] for kind in ("position", "angle")
    ]
    points = rows["target_points"]
    is_finite: Bools = np.all(np.isfinite(points), axis=2)
    total = np.where(is_finite[:, :, None], points, 0.0).sum(axis=1)
    counts = is_finite.sum(axis=1)[:, None]
    return SolveGroup(
        method=part.method,
        name=name,
        solve_id=part.solve_id,
        success=rows["success"] > 0,
        singular=np.any(rows["events"][:, singular], axis=1),
        iterations=rows["iterations"].astype(np.int64),
        restarts=rows["restarts"].astype(np.int64),
        time=rows["time"].astype(float),
        worst=np.fmax.reduce(np.concatenate(relative_errors, axis=1), axis=1),
        centre=np.where(counts > 0, total / np.maximum(counts, 1), np.nan),
        status=np.array(part.labels["status"])[rows["status"]],
        fingers=tuple(part.labels["position_error"]),
        ok=rows["ok"] > 0,
        limited=(rows["limits_ok"] == 0) | (limit_hits > limit_exits),
        touching=rows["clearance"] < 0 if "clearance" in part.names else rows["success"] > 1,
    )


# Figures.

TEXT_COLOR = "#7c8792"
"""Colour of text in figures, readable on light and dark pages."""


def effort_figure(groups: Sequence[SolveGroup]) -> str:
    """Return a figure of the distributions of iterations and time by method."""
    figure = new_figure(9.0, 3.2, 110)
    methods = list(dict.fromkeys(group.method for group in groups))
    panels = (("iterations", "iterations"), ("time", "time of a solve [µs]"))
    for position, (name, label) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 2, position)
        for method, color in palette.method_colors(methods).items():
            values = np.concatenate([getattr(g, name) for g in groups if g.method == method])
            values = np.sort(values * (1e6 if name == "time" else 1.0))
            percentage = 100 * np.arange(1, len(values) + 1) / len(values)
            axes.plot(np.maximum(values, 1e-3), percentage, color=color, lw=1.8, label=method)
        axes.set_xscale("log")
        axes.set_ylim(0, 101)
        axes.set_xlabel(label)
        axes.set_ylabel("cumulative share of solves [%]")
        _style_axes(axes)
        if position == 1:
            axes.legend(frameon=False, fontsize=8, loc="upper left", labelcolor=TEXT_COLOR)
    figure.tight_layout()
    return _embedded_image(figure, "cumulative share of solves over iterations and time")


def contact_figure(groups: Sequence[SolveGroup]) -> str:
    """Return a figure of the mean contact points of solved, near-singular and failed targets."""
    figure = new_figure(9.0, 4.2, 110)
    centre = np.concatenate([group.centre for group in groups])
    success = np.concatenate([group.success for group in groups])
    singular = np.concatenate([group.singular for group in groups])
    kinds = (
        ("solved", "#9fb0bf", success & ~singular, 4),
        ("solved, passed a singularity", palette.LINE_COLORS[0], success & singular, 7),
        ("not solved", palette.LINE_COLORS[4], ~success, 12),
    )
    panels = figure.subplots(1, 2)
    for axes, title, axis, axis_name in zip(
        panels, ("from above", "from the side"), (1, 2), "yz", strict=True
    ):
        for label, color, rows, size in kinds:
            points = centre[rows]
            points = points[:: 1 + len(points) // 20_000]
            axes.scatter(
                points[:, 0],
                points[:, axis],
                s=size,
                color=color,
                lw=0,
                label=f"{label} ({int(rows.sum()):,})",
            )
        axes.plot([0], [0], marker="+", color=TEXT_COLOR, ms=9, ls="none", label="base")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x [m]")
        axes.set_ylabel(f"{axis_name} [m]")
        axes.set_title(title, fontsize=9)
        _style_axes(axes)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        lines, labels, frameon=False, fontsize=8, loc="lower center", ncols=4, labelcolor=TEXT_COLOR
    )
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return _embedded_image(figure, "positions of solved, near-singular and failed targets")


def error_curve(errors: Array) -> str:
    """Return a small chart of the worst error of a solve over its iterations.

    Args:
        errors: (m,) Errors relative to the tolerance; inf where they were not measured.
    """
    width, height, low, high = 320, 70, 1e-3, 1e3
    clipped = np.clip(np.nan_to_num(errors, nan=high, posinf=high), low, high)
    y = height * np.log10(high / clipped) / np.log10(high / low)
    x = np.linspace(0, width, len(y)) if len(y) > 1 else np.array([0.0])
    if len(y) > width:  # the maximum of the iterations that share a pixel
        cuts = np.linspace(0, len(y), width, endpoint=False).astype(int)
        x, y = np.arange(width), np.minimum.reduceat(y, cuts)
    points = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True))
    centre_y = height / 2
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
        f"<title>worst error in multiples of its tolerance, {low:g} to {high:g}</title>"
        f'<line x1="0" x2="{width}" y1="{centre_y}" y2="{centre_y}" class="bound"/>'
        f'<polyline points="{points}"/></svg>'
    )


def _style_axes(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(TEXT_COLOR)
    axes.tick_params(which="both", labelsize=8, colors=TEXT_COLOR)
    for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
        text.set_color(TEXT_COLOR)
    axes.grid(color=TEXT_COLOR, alpha=0.25, lw=0.6)
    axes.set_axisbelow(True)


def _embedded_image(figure: Figure, text: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=figure.dpi, transparent=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'
