"""Answers as tables: in a terminal (readable without colour at 80 columns) and in notebooks."""

from __future__ import annotations

import html
import math
import re
import textwrap
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
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

from casadi_ik.files.lazy_import import import_lazily
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.diagnosis import Diagnosis
from casadi_ik.solve.solution import BatchSolution, Choice, Ranking, Solution
from casadi_ik.solve.status import Status

Units = Mapping[str, tuple[float, str]]
"""By unit ("rad", "m") what numbers are multiplied by, and the unit they are then in."""

HUMAN: Units = {"rad": (math.degrees(1.0), "deg"), "m": (1e3, "mm")}
SI: Units = {"rad": (1.0, "rad"), "m": (1.0, "m")}

AT_LIMIT = 1e-6
"""How near to a limit counts as at it [rad or m]."""

ROWS_SHOWN = 10
"""How many unsolved rows of a batch are named."""

LINES = 25
"""Of a report that is printed."""

MEANING = {
    Status.INVALID: "a number was no longer finite",
    Status.STALLED: "the method came to a standstill",
    Status.ITERATION_LIMIT: "the budget of iterations is used up",
    Status.UNREACHABLE: "{} cannot be reached: there is a proof",
    Status.COLLISION: "{} and limits are met, but something touches",
    Status.NOT_FOUND: "neither a solution nor a proof that there is none",
}


# What reports are made of.


def headline(success: bool, status: str, rest: str) -> Text:
    """The verdict first."""
    return Text.assemble((status, "bold green" if success else "bold red"), f"  {rest}")


def fields(pairs: Mapping[str, str]) -> Table:
    """Names and what they are, one below the other; a name without a text is left out."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    for name, value in pairs.items():
        if value:
            grid.add_row(f"  {name}", value)
    return grid


def table(*columns: str, right: Sequence[str] = ()) -> Table:
    """An empty table; what does not fit is wrapped, never cut."""
    empty = Table(box=SIMPLE_HEAD, pad_edge=True, header_style="bold")
    for i, name in enumerate(columns):
        justify = "right" if name in right else "left"
        empty.add_column(name, justify=justify, overflow="fold", no_wrap=i == 0)
    return empty


def indented(text: str, style: str = "", by: int = 2) -> Padding:
    """A text that is wrapped behind a margin."""
    return Padding(Text(text, style), (0, 0, 0, by))


def files(written: Mapping[str, Path | None]) -> list[RenderableType]:
    """Where files went, by option, a line each that is never wrapped, so that it can be copied."""
    return [
        Text(f"  {option.lstrip('-'):<8} {path}", no_wrap=True, overflow="ignore")
        for option, path in written.items()
        if path is not None
    ]


def counted(count: int, thing: str) -> str:
    """How many there are, in words: "no solves", "1 solve", "12 solves"."""
    return f"{count or 'no'} {thing}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds >= 1:
        return f"{seconds:.2f} s"
    if seconds >= 1e-3:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds * 1e6:.3g} us"


def as_text(part: RenderableType) -> str:
    """A report as plain text, `LINES` at most."""
    console = Console(width=80, color_system=None, file=StringIO(), force_jupyter=False)
    with console.capture() as captured:
        console.print(part)
    text = re.sub(r"\n(?: *\n)+", "\n\n", captured.get().strip("\n"))
    lines = [line.rstrip() for line in text.split("\n")]
    rest = len(lines) - LINES + 1
    return "\n".join(lines if rest < 2 else [*lines[: LINES - 1], f"  ... {rest} more lines"])


def as_html(part: RenderableType) -> str:
    """A report, made of the above, as HTML without scripts or style sheets."""
    if isinstance(part, Group):
        return "".join(map(as_html, part.renderables))
    if isinstance(part, Padding):
        return as_html(part.renderable)
    if not isinstance(part, Table):
        return f"<div>{_inline(part)}</div>"
    rows = list(zip(*(column.cells for column in part.columns), strict=True))
    sides = [f"text-align: {column.justify}" for column in part.columns]
    heads = [column.header for column in part.columns]
    lines = [("th", heads)] if part.show_header else []
    text = "".join(
        f"<tr>{''.join(_cell(kind, *pair) for pair in zip(sides, cells, strict=True))}</tr>"
        for kind, cells in [*lines, *(("td", row) for row in rows)]
    )
    return f"<table>{text}</table>"


def _cell(kind: str, side: str, content: RenderableType) -> str:
    return f'<{kind} style="{side}">{_inline(content)}</{kind}>'


def _inline(text: RenderableType) -> str:
    if not isinstance(text, Text):
        return html.escape(str(text).strip()).replace("\n", "<br>")
    console, parts = Console(), []
    whole = console.get_style(text.style)
    for segment in text.render(console, end=""):
        style = (whole + (segment.style or Style())).get_html_style()
        content = html.escape(segment.text)
        parts.append(f'<span style="{style}">{content}</span>' if style else content)
    return "".join(parts)


# Reports.


def clearance(solution: Solution, units: Units = HUMAN) -> str:
    """How far the answer is from touching something, in words."""
    if solution.clearance is None:
        return "collision not checked"
    if solution.closest is None:
        return "nothing there to touch"
    distance = _number(solution.clearance, "m", units, 2)
    return f"clearance {distance}: {' and '.join(solution.closest)}"


def page_of(answer: object) -> str:
    """The report as HTML, a robot with a small picture where pictures can be drawn."""
    robot, q = None, None
    match answer:
        case Choice():
            robot, q = answer.solution.arm_hand, answer.q
        case Solution():
            robot, q = answer.arm_hand, answer.q
        case ArmHand():
            robot, q = answer, answer.home
    text = as_html(report_of(answer, robot))
    if robot is None or q is None or not np.isfinite(q).all():
        return text
    try:
        image = import_lazily("casadi_ik.app.pictures.thumbnail").thumbnail(robot, q)
    except ImportError:  # the extra is not installed
        return text
    source = f"data:image/png;base64,{b64encode(image).decode()}"
    picture = f'<img src="{source}" alt="{html.escape(robot.name)}" style="max-width: 100%">'
    beside = "display: flex; flex-wrap: wrap; gap: 1em; align-items: flex-start"
    return f'<div style="{beside}"><div>{text}</div>{picture}</div>'


def report_of(answer: object, robot: ArmHand | None = None) -> Group:
    """What there is to say about an answer, or about a robot."""
    match answer:
        case Solution():
            return solution_report(answer, robot)
        case BatchSolution():
            scene = None if answer.clearance is None else "given"
            return Totals.of(answer).report(answer.method, answer.robot, scene)
        case Choice():
            score = f"candidate {answer.candidate}, score {answer.score:.4g}"
            return solution_report(answer.solution, robot, score)
        case Ranking():
            return ranking_report(answer)
        case Diagnosis():
            return Group(*map(Text, answer.lines))
        case ArmHand():
            return robot_report(answer.description)
    raise TypeError(f"no report of {type(answer).__name__}")


def solution_report(
    solution: Solution,
    robot: ArmHand | None = None,
    name: str = "",
    units: Units = HUMAN,
    enforced: bool = True,
    notes: Iterable[str] = (),
) -> Group:
    """A solution: verdict, effort, why not, contacts, actuators.

    Args:
        solution: The solution.
        robot: Whose it is; None: limits and units of actuators are not known.
        name: What the grasp is called.
        units: What numbers are shown in.
        enforced: Whether limits count.
        notes: What else should be known.
    """
    effort = [counted(solution.iterations, "iteration")]
    phases = [f"{phase} {count}" for phase, count in solution.phases.items() if count]
    if solution.restarts:
        effort.append(counted(solution.restarts, "restart"))
    effort.append(duration(solution.time))
    what = f"{solution.method} on {solution.robot}"
    parts: list[RenderableType] = [
        headline(solution.success, solution.status.name, f"{name}: {what}" if name else what),
        Text(f"  {', '.join(effort)}"),
        *(Text(f"    {line}", "dim") for line in _filled(phases)),
        Text(f"  {clearance(solution, units)}"),
        *(indented(note, "yellow") for note in notes),
    ]
    if not solution.success:
        parts += [indented(line, "yellow") for line in reasons(solution)]
    out = robot is not None and not solution.limits_ok and np.isfinite(solution.q).all()
    beyond = _beyond(robot, solution, units) if robot and out else {}
    followers = [" ".join(one) for one in beyond.items() if one[0] not in solution.actuators]
    if followers:
        parts.append(indented(f"joints beyond a limit: {', '.join(followers)}", "yellow"))
    if not enforced and beyond:
        parts.append(
            indented(f"limits are ignored; positions beyond them: {len(beyond)}", "yellow")
        )
    return Group(*parts, _asked(solution, units), _actuators(solution, robot, beyond, units))


def reasons(solution: Solution) -> list[str]:
    """Why a grasp is not solved; what the tables tell is not said again."""
    asked = "the contacts" if solution.palm is None else "the palm"
    lines: list[str] = []
    if solution.collision is not None:
        touches, _, *others = solution.collision.lines
        lines += [touches, *others]
    if solution.diagnosis is not None:
        lines += solution.diagnosis.lines
    return lines or [MEANING.get(solution.status, "not met").format(asked)]


def _filled(pairs: Iterable[str]) -> list[str]:
    """Pairs of words, parted by commas, on lines of which none breaks within a pair."""
    joined = ", ".join(pair.replace(" ", "\N{NO-BREAK SPACE}") for pair in pairs)
    lines = textwrap.wrap(joined, 76, break_on_hyphens=False)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


def _number(value: float, unit: str, units: Units, digits: int = 3) -> str:
    """A number with its unit; in SI units it has three digits more."""
    scale, name = units[unit]
    return f"{value * scale:.{digits if scale > 1 else digits + 3}f} {name}"


def _asked(solution: Solution, units: Units) -> Table:
    """The palm against what was asked for, or the contacts."""
    tolerances = [one.tolerance for one in solution.contacts.values()]
    rows: list[Any] = list(zip(solution.contacts.items(), tolerances, strict=True))
    first, right = "contact", ("point off by", "tolerance", "normal off by", "tolerance")
    if solution.palm is not None:
        rows = [(("palm", solution.palm), max(tolerances, key=lambda one: one.position))]
        first, right = "", ("place off by", "tolerance", "direction off by", "tolerance")
    shown = table(first, *right, "", right=right)
    for (name, found), tolerance in rows:
        cells: list[str] = []
        for error, most, unit in (
            (found.position_error, tolerance.position, "m"),
            (found.angle_error, tolerance.angle, "rad"),
        ):
            scale, of = units[unit]
            most_said = f"{most * scale:.4g} {of}"
            free = math.isnan(error)
            cells += ["free", ""] if free else [_number(error, unit, units), most_said]
        shown.add_row(name, *cells, Text(*(("ok", "green") if found.ok else ("missed", "red"))))
    return shown


def _actuators(
    solution: Solution, robot: ArmHand | None, beyond: Mapping[str, str], units: Units
) -> Table:
    """Positions; with limits where the robot is known."""
    if robot is None:
        names, values = solution.actuators, [f"{value:.6f}" for value in solution.q]
        half = (len(names) + 1) // 2
        rows = table(*("actuator", "rad or m") * 2, right=("rad or m",))
        for i in range(half):
            pairs = zip(names[i::half], values[i::half], strict=True)
            rows.add_row(*(cell for pair in pairs for cell in pair))
        return rows
    right = ("position", "lower", "upper")
    rows = table("actuator", *right, "limit", right=right)
    for one, value in zip(robot.description.actuators, solution.q.tolist(), strict=True):
        scale, _ = units[one.unit]
        flag = "at lower" if value - one.lower <= AT_LIMIT else ""
        flag = "at upper" if one.upper - value <= AT_LIMIT else flag
        ends = [f"{end * scale:.4g}" for end in (one.lower, one.upper)]
        if one.continuous:
            flag, ends = "", ["none", "none"]
        shown = Text(beyond.get(one.name, flag), "yellow")
        rows.add_row(one.name, _number(value, one.unit, units), *ends, shown)
    return rows


def _beyond(robot: ArmHand, solution: Solution, units: Units) -> dict[str, str]:
    """By how much actuators, and joints that follow them by couplings, are beyond limits."""
    description, theta = robot.description, robot.joints(solution.q)
    ranges: dict[str, tuple[float, Any, str]] = {
        joint.name: (theta[joint.name], joint, "m" if joint.type == "prismatic" else "rad")
        for joint in description.movable
    }
    for one, value in zip(description.actuators, solution.q.tolist(), strict=True):
        ranges[one.name] = (value, one, one.unit)
    found = {}
    for one in description.actuators:
        if one.continuous:
            del ranges[one.name]
    for name, (value, of, unit) in ranges.items():
        scale, called = units[unit]
        for side, far in (("below", of.lower - value), ("above", value - of.upper)):
            if far > AT_LIMIT:
                found[name] = f"{far * scale:.3g} {called} {side}"
    return found


class Totals:
    """What a report on a batch needs to know, gathered block by block.

    Attributes:
        count: Targets so far.
        solved: Of those, solved.
    """

    def __init__(self) -> None:
        self.count = self.solved = 0
        self._statuses: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._efforts = {"iterations": (0, 0), "restarts": (0, 0)}
        self._missed: list[int] = []
        self._times: list[np.ndarray] = []  # four bytes a target are all that grows

    def add(self, arrays: Mapping[str, np.ndarray], first_row: int = 0) -> None:
        """Count answers in.

        Args:
            arrays: As `casadi_ik.integrations` writes them: success, status (names), iterations,
                restarts, time, and reason if failures were explained.
            first_row: Number of their first target.
        """
        success = arrays["success"]
        self.count += len(success)
        self.solved += int(success.sum())
        self._statuses.update(arrays["status"].tolist())
        self._reasons.update(filter(None, arrays.get("reason", np.zeros(0)).tolist()))
        for name, (total, most) in self._efforts.items():
            found = arrays[name]
            self._efforts[name] = total + int(found.sum()), max(most, int(found.max()))
        rows = first_row + np.flatnonzero(~success)
        self._missed += rows[: ROWS_SHOWN - len(self._missed)].tolist()
        self._times.append(arrays["time"].astype(np.float32))

    @classmethod
    def of(cls, batch: BatchSolution) -> Totals:
        """Those of a batch that is there."""
        reasons = [one.reason.name if one else "" for one in batch.diagnoses]
        found = cls()
        if len(batch):
            arrays = {name: getattr(batch, name) for name in ("success", *found._efforts, "time")}
            found.add(arrays | {"status": batch.status_names, "reason": np.array(reasons)})
        return found

    def report(self, method: str, robot: str, scene: str | None, name: str = "") -> Group:
        """How a batch ended; scene: what was checked against, None: collisions were not."""
        all_solved, share = self.solved == self.count, 100 * self.solved / max(self.count, 1)
        (iterations, most), (restarts, most_restarts) = self._efforts.values()
        times = np.concatenate([*self._times, np.zeros(0 if self._times else 1)])
        rest = self.count - self.solved - len(self._missed)
        missed = f"rows {', '.join(map(str, self._missed))}" + (f" and {rest} more" if rest else "")
        pairs = {
            "status": ", ".join(f"{n} {status}" for status, n in sorted(self._statuses.items())),
            "iterations": f"mean {iterations / max(self.count, 1):.1f}, most {most}",
            "time": f"mean {duration(float(times.mean()))}, 99th percentile "
            + duration(float(np.percentile(times, 99))),
            "collision": "not checked" if scene is None else f"scene {scene}",
            "restarts": f"mean {restarts / self.count:.2f}, most {most_restarts}"
            if restarts
            else "",
            "not solved": "" if all_solved else f"{missed} (from 0)",
            "reasons": ", ".join(f"{n} {reason}" for reason, n in sorted(self._reasons.items())),
        }
        of = f" of {name}" if name else ""
        what = f"{self.solved} of {counted(self.count, 'target')} ({share:.1f} %){of}"
        status = "SOLVED" if all_solved else "NOT ALL SOLVED"
        return Group(headline(all_solved, status, f"{what}: {method} on {robot}"), fields(pairs))


def ranking_report(
    ranking: Ranking, names: Sequence[str] = (), of: str = "", units: Units = HUMAN
) -> Group:
    """Which of many grasps to take.

    Args:
        ranking: The answers.
        names: Of the candidates.
        of: What they are from.
        units: What clearances are shown in.
    """
    among = f"{ranking.candidates} candidates" + (f" of {of}" if of else "")
    found = f"{ranking.answered} of {among} have an answer"
    head = "FOUND" if ranking.entries else "NONE FOUND"
    parts: list[RenderableType] = [headline(bool(ranking.entries), head, found)]
    if ranking.entries:
        seconds = ranking.entries[0].solution.time * ranking.candidates
        best = table("candidate", "name", "score", "clearance", right=("score",))
        for one in ranking:
            clear = clearance(one.solution, units).removeprefix("clearance ")
            name = names[one.candidate] if names else one.grasp.name
            best.add_row(str(one.candidate), name, f"{one.score:.4g}", clear)
        parts += [Text(f"  by {ranking.prefer}, in {duration(seconds)}"), best]
    failures = (Text(f"  {count} have none: {why}") for why, count in ranking.failures.items())
    return Group(*parts, *failures)


def robot_report(robot: RobotDescription, description: str = "") -> Group:
    """A robot: its fingers, its actuators, how its arm is solved."""
    thumb = robot.named_thumb
    fingers = (f"{one} (placed first)" if one == thumb else one for one in robot.finger_names)
    pairs = {
        "fingers": f"{len(robot.fingers)}: {', '.join(fingers)}",
        "actuators": f"{len(robot.actuators)}: {', '.join(robot.actuator_names)}",
        "arm": f"closed form: {describe_arm(robot)}" if robot.arm_actuators else "",
    }
    about = [Text(f"  {description}")] if description else []
    return Group(Text(robot.name, "bold"), *about, fields(pairs))
