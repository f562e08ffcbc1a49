"""Reports of results as tables for terminals (80 columns, colour optional) and notebooks."""

from __future__ import annotations

import html
import math
import re
import textwrap
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.style import Style
from rich.table import Table
from rich.text import Text

from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.diagnosis import Diagnosis
from casadi_ik.solve.solution import BatchSolution, Choice, Ranking, Solution
from casadi_ik.solve.status import Status

Units = Mapping[str, tuple[float, str]]
"""Factor and name of the unit shown, by unit ("rad", "m")."""

HUMAN: Units = {"rad": (math.degrees(1.0), "deg"), "m": (1e3, "mm")}
SI: Units = {"rad": (1.0, "rad"), "m": (1.0, "m")}

LIMIT_TOLERANCE = 1e-6
"""Distance to a limit below which an actuator is at it [rad or m]."""

ROWS_SHOWN = 10
"""Maximum number of unsolved rows of a batch that are listed."""

MAX_LINES = 25
"""Maximum number of lines of a printed report."""

FAILURE_TEXTS = {
    Status.INVALID: "a number became infinite or NaN",
    Status.STALLED: "the method stalled",
    Status.ITERATION_LIMIT: "the iteration limit was reached",
    Status.UNREACHABLE: "{} cannot be reached (proved)",
    Status.COLLISION: "{} and limits are met, but the robot is in collision",
    Status.NOT_FOUND: "neither a solution nor a proof of infeasibility was found",
    Status.NEAREST: "{} were not reached: the nearest configuration found",
}


# Elements of reports.


def headline(success: bool, status: str, text: str) -> Text:
    """Return the first line of a report, which starts with the status."""
    return Text.assemble((status, "bold green" if success else "bold red"), f"  {text}")


def fields(pairs: Mapping[str, str]) -> Table:
    """Return a table of names and texts; empty texts are omitted."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    for name, value in pairs.items():
        if value:
            grid.add_row(f"  {name}", value)
    return grid


def table(*columns: str, right: Sequence[str] = ()) -> Table:
    """Return an empty table whose cells wrap and are never cut off."""
    empty = Table(box=SIMPLE_HEAD, pad_edge=True, header_style="bold")
    for i, name in enumerate(columns):
        justify = "right" if name in right else "left"
        empty.add_column(name, justify=justify, overflow="fold", no_wrap=i == 0)
    return empty


def indented(text: str, style: str = "", width: int = 2) -> Padding:
    """Return an indented text that wraps."""
    return Padding(Text(text, style), (0, 0, 0, width))


def files(written: Mapping[str, Path | None]) -> list[RenderableType]:
    """Return a line per written file, which never wraps, so that it can be copied."""
    return [
        Text(f"  {option.lstrip('-'):<8} {path}", no_wrap=True, overflow="ignore")
        for option, path in written.items()
        if path is not None
    ]


def count_text(count: int, noun: str) -> str:
    """Return a number with its noun: "no solves", "1 solve", "12 solves"."""
    return f"{count or 'no'} {noun}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """Return a time in a suitable unit."""
    if seconds >= 1:
        return f"{seconds:.2f} s"
    if seconds >= 1e-3:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds * 1e6:.3g} us"


def as_text(part: RenderableType) -> str:
    """Return a report as plain text of at most `MAX_LINES` lines."""
    console = Console(width=80, color_system=None, file=StringIO(), force_jupyter=False)
    with console.capture() as captured:
        console.print(part)
    text = re.sub(r"\n(?: *\n)+", "\n\n", captured.get().strip("\n"))
    lines = [line.rstrip() for line in text.split("\n")]
    hidden_count = len(lines) - MAX_LINES + 1
    return "\n".join(
        lines if hidden_count < 2 else [*lines[: MAX_LINES - 1], f"  ... {hidden_count} more lines"]
    )


def as_html(part: RenderableType) -> str:
    """Return a report as HTML without scripts or style sheets."""
    if isinstance(part, Group):
        return "".join(map(as_html, part.renderables))
    if isinstance(part, Padding):
        return as_html(part.renderable)
    if not isinstance(part, Table):
        return f"<div>{_inline(part)}</div>"
    rows = list(zip(*(column.cells for column in part.columns), strict=True))
    styles = [f"text-align: {column.justify}" for column in part.columns]
    headers = [column.header for column in part.columns]
    lines = [("th", headers)] if part.show_header else []
    text = "".join(
        f"<tr>{''.join(_cell(kind, *pair) for pair in zip(styles, cells, strict=True))}</tr>"
        for kind, cells in [*lines, *(("td", row) for row in rows)]
    )
    return f"<table>{text}</table>"


def _cell(kind: str, style: str, content: RenderableType) -> str:
    return f'<{kind} style="{style}">{_inline(content)}</{kind}>'


def _inline(text: RenderableType) -> str:
    if not isinstance(text, Text):
        return html.escape(str(text).strip()).replace("\n", "<br>")
    console, parts = Console(), []
    base_style = console.get_style(text.style)
    for segment in text.render(console, end=""):
        style = (base_style + (segment.style or Style())).get_html_style()
        content = html.escape(segment.text)
        parts.append(f'<span style="{style}">{content}</span>' if style else content)
    return "".join(parts)


# Reports.


def clearance(solution: Solution, units: Units = HUMAN) -> str:
    """Return the clearance of a solution in words."""
    if solution.clearance is None:
        return "collision not checked"
    if solution.closest is None:
        return "no pair of shapes to check"
    distance = _number(solution.clearance, "m", units, 2)
    return f"clearance {distance}: {' and '.join(solution.closest)}"


def page_of(result: object) -> str:
    """Return the report as HTML, for a robot with a thumbnail if pictures can be drawn."""
    robot, q = None, None
    match result:
        case Choice():
            robot, q = result.solution.arm_hand, result.q
        case Solution():
            robot, q = result.arm_hand, result.q
        case ArmHand():
            robot, q = result, result.home
    text = as_html(report_of(result, robot))
    if robot is None or q is None or not np.isfinite(q).all():
        return text
    try:
        image = import_module("casadi_ik.app.pictures.thumbnail").thumbnail(robot, q)
    except ImportError:  # the extra is not installed
        return text
    source = f"data:image/png;base64,{b64encode(image).decode()}"
    picture = f'<img src="{source}" alt="{html.escape(robot.name)}" style="max-width: 100%">'
    style = "display: flex; flex-wrap: wrap; gap: 1em; align-items: flex-start"
    return f'<div style="{style}"><div>{text}</div>{picture}</div>'


def report_of(result: object, robot: ArmHand | None = None) -> Group:
    """Return the report of a result or a robot."""
    match result:
        case Solution():
            return solution_report(result, robot)
        case BatchSolution():
            scene = None if result.clearance is None else "given"
            return Totals.of_batch(result).report(result.method, result.robot, scene)
        case Choice():
            score = f"candidate {result.candidate}, score {result.score:.4g}"
            return solution_report(result.solution, robot, score)
        case Ranking():
            return ranking_report(result)
        case Diagnosis():
            return Group(*map(Text, result.lines))
        case ArmHand():
            return robot_report(result.description)
    raise TypeError(f"result: found {type(result).__name__}; expected a solution or a robot")


def solution_report(
    solution: Solution,
    robot: ArmHand | None = None,
    name: str = "",
    units: Units = HUMAN,
    enforced: bool = True,
    notes: Iterable[str] = (),
) -> Group:
    """Return the report of a solution: verdict, effort, reasons, contacts, actuators.

    Args:
        solution: The solution.
        robot: Robot of the solution; None: limits and units of actuators are unknown.
        name: Name of the grasp.
        units: Units of the numbers.
        enforced: Limits were enforced.
        notes: Additional lines.
    """
    effort = [count_text(solution.iterations, "iteration")]
    phases = [f"{phase} {count}" for phase, count in solution.phases.items() if count]
    if solution.restarts:
        effort.append(count_text(solution.restarts, "restart"))
    effort.append(duration(solution.time))
    description = f"{solution.method} on {solution.robot}"
    parts: list[RenderableType] = [
        headline(
            solution.success,
            solution.status.name,
            f"{name}: {description}" if name else description,
        ),
        Text(f"  {', '.join(effort)}"),
        *(Text(f"    {line}", "dim") for line in _wrapped_pairs(phases)),
        Text(f"  {clearance(solution, units)}"),
        *(indented(note, "yellow") for note in notes),
    ]
    if not solution.success:
        parts += [indented(line, "yellow") for line in reasons(solution)]
    exceeds_limits = robot is not None and not solution.limits_ok and np.isfinite(solution.q).all()
    excesses = _limit_excesses(robot, solution, units) if robot and exceeds_limits else {}
    followers = [" ".join(pair) for pair in excesses.items() if pair[0] not in solution.actuators]
    if followers:
        parts.append(indented(f"joints beyond a limit: {', '.join(followers)}", "yellow"))
    if not enforced and excesses:
        parts.append(
            indented(f"limits are ignored; positions beyond them: {len(excesses)}", "yellow")
        )
    return Group(
        *parts, _target_table(solution, units), _actuator_table(solution, robot, excesses, units)
    )


def reasons(solution: Solution) -> list[str]:
    """Return the reasons why a grasp is not solved, without the content of the tables."""
    target = "the contacts" if solution.palm is None else "the palm"
    lines: list[str] = []
    if solution.collision is not None:
        touches, _, *remedies = solution.collision.lines
        lines += [touches, *remedies]
    if solution.diagnosis is not None:
        lines += solution.diagnosis.lines
    if not lines:
        lines.append(FAILURE_TEXTS.get(solution.status, "not met").format(target))
    if solution.status is Status.NEAREST and solution.palm is None:
        lines.append(f"the largest error is {solution.error_ratio:.3g} times its tolerance")
    return lines


def _wrapped_pairs(pairs: Iterable[str]) -> list[str]:
    """Return lines of pairs of words, separated by commas; no line breaks within a pair."""
    text = ", ".join(pair.replace(" ", "\N{NO-BREAK SPACE}") for pair in pairs)
    lines = textwrap.wrap(text, 76, break_on_hyphens=False)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


def _number(value: float, unit: str, units: Units, digits: int = 3) -> str:
    """Return a number with its unit; SI units have three more digits."""
    scale, name = units[unit]
    return f"{value * scale:.{digits if scale > 1 else digits + 3}f} {name}"


def _target_table(solution: Solution, units: Units) -> Table:
    """Return the errors of the palm or of the contacts."""
    tolerances = [verdict.tolerance for verdict in solution.contacts.values()]
    rows: list[Any] = list(zip(solution.contacts.items(), tolerances, strict=True))
    first_column, right = "contact", ("point off by", "tolerance", "normal off by", "tolerance")
    if solution.palm is not None:
        rows = [(("palm", solution.palm), max(tolerances, key=lambda verdict: verdict.position))]
        first_column, right = "", ("position off by", "tolerance", "angle off by", "tolerance")
    result = table(first_column, *right, "", right=right)
    for (name, verdict), tolerance in rows:
        cells: list[str] = []
        for error, bound, unit in (
            (verdict.position_error, tolerance.position, "m"),
            (verdict.angle_error, tolerance.angle, "rad"),
        ):
            scale, unit_name = units[unit]
            bound_text = f"{bound * scale:.4g} {unit_name}"
            is_free = math.isnan(error)
            cells += ["free", ""] if is_free else [_number(error, unit, units), bound_text]
        result.add_row(name, *cells, Text(*(("ok", "green") if verdict.ok else ("missed", "red"))))
    return result


def _actuator_table(
    solution: Solution, robot: ArmHand | None, excesses: Mapping[str, str], units: Units
) -> Table:
    """Return the positions, and the limits if the robot is known."""
    if robot is None:
        names, values = solution.actuators, [f"{value:.6f}" for value in solution.q]
        row_count = (len(names) + 1) // 2
        rows = table(*("actuator", "rad or m") * 2, right=("rad or m",))
        for i in range(row_count):
            pairs = zip(names[i::row_count], values[i::row_count], strict=True)
            rows.add_row(*(cell for pair in pairs for cell in pair))
        return rows
    right = ("position", "lower", "upper")
    rows = table("actuator", *right, "limit", right=right)
    for actuator, value in zip(robot.description.actuators, solution.q.tolist(), strict=True):
        scale, _ = units[actuator.unit]
        flag = "at lower" if value - actuator.lower <= LIMIT_TOLERANCE else ""
        flag = "at upper" if actuator.upper - value <= LIMIT_TOLERANCE else flag
        bounds = [f"{bound * scale:.4g}" for bound in (actuator.lower, actuator.upper)]
        if actuator.continuous:
            flag, bounds = "", ["none", "none"]
        flag_text = Text(excesses.get(actuator.name, flag), "yellow")
        rows.add_row(actuator.name, _number(value, actuator.unit, units), *bounds, flag_text)
    return rows


def _limit_excesses(robot: ArmHand, solution: Solution, units: Units) -> dict[str, str]:
    """Return the excesses of actuators and coupled joints over their limits."""
    description, theta = robot.description, robot.joints(solution.q)
    ranges: dict[str, tuple[float, Any, str]] = {
        joint.name: (theta[joint.name], joint, "m" if joint.type == "prismatic" else "rad")
        for joint in description.movable
    }
    for actuator, value in zip(description.actuators, solution.q.tolist(), strict=True):
        ranges[actuator.name] = (value, actuator, actuator.unit)
    excesses = {}
    for actuator in description.actuators:
        if actuator.continuous:
            del ranges[actuator.name]
    for name, (value, limits, unit) in ranges.items():
        scale, unit_name = units[unit]
        for side, excess in (("below", limits.lower - value), ("above", value - limits.upper)):
            if excess > LIMIT_TOLERANCE:
                excesses[name] = f"{excess * scale:.3g} {unit_name} {side}"
    return excesses


class Totals:
    """Totals of a batch, accumulated block by block.

    Attributes:
        count: Number of targets.
        solved: Number of solved targets.
    """

    def __init__(self) -> None:
        self.count = self.solved = 0
        self._statuses: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._efforts = {"iterations": (0, 0), "restarts": (0, 0)}
        self._unsolved_rows: list[int] = []
        self._times: list[np.ndarray] = []  # memory grows by four bytes per target only

    def add(self, arrays: Mapping[str, np.ndarray], first_row: int = 0) -> None:
        """Add the results of a block.

        Args:
            arrays: Arrays as written by `casadi_ik.integrations`: success, status (names),
                iterations, restarts, time, and reason if failures were diagnosed.
            first_row: Number of the first target.
        """
        success = arrays["success"]
        self.count += len(success)
        self.solved += int(success.sum())
        self._statuses.update(arrays["status"].tolist())
        self._reasons.update(filter(None, arrays.get("reason", np.zeros(0)).tolist()))
        for name, (total, maximum) in self._efforts.items():
            values = arrays[name]
            self._efforts[name] = total + int(values.sum()), max(maximum, int(values.max()))
        rows = first_row + np.flatnonzero(~success)
        self._unsolved_rows += rows[: ROWS_SHOWN - len(self._unsolved_rows)].tolist()
        self._times.append(arrays["time"].astype(np.float32))

    @classmethod
    def of_batch(cls, batch: BatchSolution) -> Totals:
        """Return the totals of a complete batch."""
        reasons = [diagnosis.reason.name if diagnosis else "" for diagnosis in batch.diagnoses]
        totals = cls()
        if len(batch):
            arrays = {name: getattr(batch, name) for name in ("success", *totals._efforts, "time")}
            totals.add(arrays | {"status": batch.status_names, "reason": np.array(reasons)})
        return totals

    def report(self, method: str, robot: str, scene: str | None, name: str = "") -> Group:
        """Return the report of a batch; scene None: collisions were not checked."""
        all_solved, share = self.solved == self.count, 100 * self.solved / max(self.count, 1)
        (iterations, max_iterations), (restarts, max_restarts) = self._efforts.values()
        times = np.concatenate([*self._times, np.zeros(0 if self._times else 1)])
        unnamed_count = self.count - self.solved - len(self._unsolved_rows)
        missed = f"rows {', '.join(map(str, self._unsolved_rows))}" + (
            f" and {unnamed_count} more" if unnamed_count else ""
        )
        pairs = {
            "status": ", ".join(f"{n} {status}" for status, n in sorted(self._statuses.items())),
            "iterations": f"mean {iterations / max(self.count, 1):.1f}, most {max_iterations}",
            "time": f"mean {duration(float(times.mean()))}, 99th percentile "
            + duration(float(np.percentile(times, 99))),
            "collision": "not checked" if scene is None else f"scene {scene}",
            "restarts": f"mean {restarts / self.count:.2f}, most {max_restarts}"
            if restarts
            else "",
            "not solved": "" if all_solved else f"{missed} (from 0)",
            "reasons": ", ".join(f"{n} {reason}" for reason, n in sorted(self._reasons.items())),
        }
        suffix = f" of {name}" if name else ""
        summary = f"{self.solved} of {count_text(self.count, 'target')} ({share:.1f} %){suffix}"
        status = "SOLVED" if all_solved else "NOT ALL SOLVED"
        return Group(headline(all_solved, status, f"{summary}: {method} on {robot}"), fields(pairs))


def ranking_report(
    ranking: Ranking, names: Sequence[str] = (), source: str = "", units: Units = HUMAN
) -> Group:
    """Return the report of a ranking of grasps.

    Args:
        ranking: The ranking.
        names: Names of the candidates.
        source: Origin of the candidates.
        units: Units of clearances.
    """
    candidates_text = f"{ranking.candidates} candidates" + (f" of {source}" if source else "")
    summary = f"{ranking.answered} of {candidates_text} have an answer"
    nearest = "NEAREST" if ranking.entries else "NONE FOUND"
    status = "FOUND" if ranking.answered else nearest
    parts: list[RenderableType] = [headline(ranking.answered > 0, status, summary)]
    if ranking.entries:
        seconds = ranking.entries[0].solution.time * ranking.candidates
        best = table("candidate", "name", "score", "clearance", right=("score",))
        for choice in ranking:
            clear = clearance(choice.solution, units).removeprefix("clearance ")
            name = names[choice.candidate] if names else choice.grasp.name
            best.add_row(str(choice.candidate), name, f"{choice.score:.4g}", clear)
        parts += [Text(f"  by {ranking.prefer}, in {duration(seconds)}"), best]
    failures = (
        Text(f"  {count} have none: {reason}") for reason, count in ranking.failures.items()
    )
    return Group(*parts, *failures)


def robot_report(robot: RobotDescription, description: str = "") -> Group:
    """Return the report of a robot: fingers, actuators, closed form of the arm."""
    thumb = robot.named_thumb
    fingers = (
        f"{finger} (placed first)" if finger == thumb else finger for finger in robot.finger_names
    )
    pairs = {
        "fingers": f"{len(robot.fingers)}: {', '.join(fingers)}",
        "actuators": f"{len(robot.actuators)}: {', '.join(robot.actuator_names)}",
        "arm": f"closed form: {describe_arm(robot)}" if robot.arm_actuators else "",
    }
    lines = [Text(f"  {description}")] if description else []
    return Group(Text(robot.name, "bold"), *lines, fields(pairs))
