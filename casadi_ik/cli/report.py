"""Reports on solves: short, in mm and degrees, readable without colour and at 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from casadi_ik.answers.solution import Solution
from casadi_ik.api import Solver
from casadi_ik.cli.batch_totals import BatchTotals
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.status import Status
from casadi_ik.problem.verdict import PalmVerdict

AT_LIMIT = 1e-6
"""How near to a limit counts as at it [rad or m]."""

_SCALE = {"rad": (math.degrees(1.0), "deg"), "m": (1e3, "mm")}

_MEANING = {
    Status.INVALID: "a number was no longer finite",
    Status.STALLED: "the method came to a standstill",
    Status.ITERATION_LIMIT: "the budget of iterations is used up",
    Status.UNREACHABLE: "{} cannot be reached: there is a proof",
    Status.COLLISION: "{} and limits are met, but something touches",
    Status.NOT_FOUND: "neither a solution nor a proof that there is none",
}


def fields(pairs: Mapping[str, str] | Iterable[tuple[str, str]]) -> Table:
    """Names and what they are, one below the other."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    for name, value in dict(pairs).items():
        grid.add_row(f"  {name}", value)
    return grid


def table(*columns: str, right: Sequence[str] = ()) -> Table:
    """An empty table; what does not fit is wrapped, never cut."""
    empty = Table(box=SIMPLE_HEAD, pad_edge=True, header_style="bold")
    for i, name in enumerate(columns):
        justify = "right" if name in right else "left"
        empty.add_column(name, justify=justify, overflow="fold", no_wrap=i == 0)
    return empty


def files(written: Iterable[tuple[str, object]]) -> list[RenderableType]:
    """Where files went, a line each that is never wrapped, so that it can be copied."""
    return [Text(f"  {kind:<8} {path}", no_wrap=True, overflow="ignore") for kind, path in written]


def headline(success: bool, status: str, rest: str) -> Text:
    """The verdict first."""
    return Text.assemble((status, "bold green" if success else "bold red"), f"  {rest}")


def solution_report(
    name: str,
    solver: Solver,
    solution: Solution,
    written: Iterable[tuple[str, object]],
    warning: str = "",
) -> Group:
    """The report of `solve`.

    Args:
        name: What the grasp is called.
        solver: Who solved.
        solution: The solution.
        written: Kind and path of every file that was written.
        warning: What else should be known, "": nothing.
    """
    phases = ", ".join(f"{phase} {count}" for phase, count in solution.phases.items())
    effort = f"  {solution.iterations} iterations" + (f" ({phases})" if phases else "")
    if solution.restarts:
        effort += f", {solution.restarts} restarts"
    parts: list[RenderableType] = [
        headline(
            solution.success,
            solution.status.name,
            f"{name}: {solution.method} on {solution.robot}",
        ),
        Text(f"{effort}, {duration(solution.time)}"),
        Text(f"  {clearance(solution)}"),
    ]
    if warning:
        parts.append(_indented(warning, "yellow"))
    if not solution.success:
        parts += [_indented(line, "yellow") for line in reasons(solver, solution)]
    parts += [_asked(solution), _actuators(solver, solution)]
    if solver.limits == "ignore" and not solution.limits_ok:
        count = len(_beyond(solver, solution))
        parts.append(_indented(f"limits are ignored; positions beyond them: {count}", "yellow"))
    return Group(*parts, *files(written))


def clearance(solution: Solution) -> str:
    """How far the answer is from touching something, in words."""
    if solution.clearance is None:
        return "collision not checked"
    if solution.closest is None:
        return "nothing there to touch"
    return f"clearance {1e3 * solution.clearance:.2f} mm: {' and '.join(solution.closest)}"


def reasons(solver: Solver, solution: Solution) -> list[str]:
    """Why a grasp is not solved: what it missed, what is at a limit, and the diagnosis."""
    asked = "the contacts" if solution.palm is None else "the palm"
    lines = [_MEANING.get(solution.status, "not met").format(asked)]
    for finger, contact in solution.contacts.items():
        if contact.ok or solution.palm is not None:
            continue
        missed = []
        if contact.position_error > contact.tolerance.position:
            missed.append(f"its point by {contact.position_error * 1e3:.2f} mm")
        if contact.angle_error > contact.tolerance.angle:
            missed.append(f"its normal by {math.degrees(contact.angle_error):.2f} deg")
        lines.append(f"{finger} misses {' and '.join(missed)}")
    if solution.palm is not None and not solution.palm.ok:
        off = f"{solution.palm.position_error * 1e3:.2f} mm"
        lines.append(
            f"the palm misses its place by {off} and its direction by "
            f"{math.degrees(solution.palm.angle_error):.2f} deg"
        )
    if solver.limits == "enforce":
        beyond = _beyond(solver, solution)
        if beyond:
            lines.append(f"beyond a limit: {', '.join(beyond)}")
    held = [
        f"{actuator} ({flag})"
        for actuator, flag in zip(solution.actuators, _flags(solver, solution), strict=True)
        if flag in ("lower", "upper")
    ]
    if held:
        lines.append(f"at a limit: {', '.join(held)}")
    if solution.diagnosis is not None:
        lines += solution.diagnosis.lines
    if solution.collision is not None:
        lines += solution.collision.lines[1:]
    return lines


def batch_report(
    name: str, solver: Solver, batch: BatchTotals, written: Iterable[tuple[str, object]]
) -> Group:
    """The summary of `batch`; arguments as in `solution_report`."""
    count, solved, times = batch.count, batch.solved, batch.times
    share = f"{solved} of {count} targets ({100 * solved / count:.1f} %)"
    pairs = {
        "status": ", ".join(f"{n} {status}" for status, n in sorted(batch.statuses.items())),
        "iterations": f"mean {batch.iterations / count:.1f}, most {batch.most_iterations}",
        "time": f"mean {duration(float(times.mean()))}, 99th percentile "
        + duration(float(np.percentile(times, 99))),
    }
    pairs["collision"] = f"scene {solver.scene.name}" if solver.scene else "not checked"
    if batch.restarts:
        pairs["restarts"] = f"mean {batch.restarts / count:.2f}, most {batch.most_restarts}"
    if solved < count:
        more = count - solved - len(batch.missed)
        rest = f" and {more} more" if more else ""
        pairs["not solved"] = f"rows {', '.join(map(str, batch.missed))}{rest} (from 0)"
    if batch.reasons:
        found = sorted(batch.reasons.items())
        pairs["reasons"] = ", ".join(f"{n} {reason}" for reason, n in found)
    return Group(
        headline(
            solved == count,
            "SOLVED" if solved == count else "NOT ALL SOLVED",
            f"{share} of {name}: {solver.method} on {solver.robot.name}",
        ),
        fields(pairs),
        *files(written),
    )


def _indented(text: str, style: str = "") -> Padding:
    return Padding(Text(text, style), (0, 0, 0, 2))


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds >= 1:
        return f"{seconds:.2f} s"
    if seconds >= 1e-3:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds * 1e6:.3g} us"


def _asked(solution: Solution) -> Table:
    """The palm against what was asked for, or the contacts."""
    if solution.palm is not None:
        return _palm(solution.palm, [one.tolerance for one in solution.contacts.values()])
    right = ("point off by", "tolerance", "normal off by", "tolerance")
    rows = table("contact", *right, "", right=right)
    for finger, contact in solution.contacts.items():
        rows.add_row(
            finger,
            *_compared(contact.position_error, contact.tolerance.position, 1e3, "mm"),
            *_compared(contact.angle_error, contact.tolerance.angle, math.degrees(1), "deg"),
            Text("ok", "green") if contact.ok else Text("missed", "red"),
        )
    return rows


def _palm(palm: PalmVerdict, tolerances: Sequence[Tolerance]) -> Table:
    right = ("place off by", "tolerance", "direction off by", "tolerance")
    rows = table("", *right, "", right=right)
    rows.add_row(
        "palm",
        *_compared(palm.position_error, max(one.position for one in tolerances), 1e3, "mm"),
        *_compared(palm.angle_error, max(one.angle for one in tolerances), math.degrees(1), "deg"),
        Text("ok", "green") if palm.ok else Text("missed", "red"),
    )
    return rows


def _compared(error: float, tolerance: float, scale: float, unit: str) -> tuple[str, str]:
    if math.isnan(error):
        return "free", ""
    return f"{error * scale:.3f} {unit}", f"{tolerance * scale:.4g} {unit}"


def _actuators(solver: Solver, solution: Solution) -> Table:
    right = ("position", "lower", "upper")
    rows = table("actuator", *right, "limit", right=right)
    robot = solver.robot
    flags = _flags(solver, solution)
    for i, actuator in enumerate(robot.description.actuators):
        scale, unit = _SCALE[actuator.unit]
        flag = Text(f"at {flags[i]}" if flags[i] in ("lower", "upper") else flags[i], "yellow")
        rows.add_row(
            actuator.name,
            f"{solution.q[i] * scale:.3f} {unit}",
            f"{robot.lower[i] * scale:.4g}",
            f"{robot.upper[i] * scale:.4g}",
            flag,
        )
    return rows


def _flags(solver: Solver, solution: Solution) -> list[str]:
    """Per actuator "" or "lower" or "upper" (at that limit) or by how much it is beyond."""
    robot = solver.robot
    found = []
    rows = zip(robot.description.actuators, robot.lower, robot.upper, solution.q, strict=True)
    for actuator, lower, upper, value in rows:
        excess = _excess(float(value), lower, upper, actuator.unit)
        if excess:
            found.append(excess)
        elif value - lower <= AT_LIMIT:
            found.append("lower")
        elif upper - value <= AT_LIMIT:
            found.append("upper")
        else:
            found.append("")
    return found


def _excess(value: float, lower: float, upper: float, unit: str) -> str:
    """By how much a value is beyond its limits, in words; "" if it is not."""
    scale, name = _SCALE[unit]
    for side, far in (("below", lower - value), ("above", value - upper)):
        if far > AT_LIMIT:
            return f"{far * scale:.3g} {name} {side}"
    return ""


def _beyond(solver: Solver, solution: Solution) -> list[str]:
    """Actuators, and joints that follow one by a coupling, that are beyond their limits."""
    description = solver.robot.description
    found = {
        actuator.name: _excess(float(value), actuator.lower, actuator.upper, actuator.unit)
        for actuator, value in zip(description.actuators, solution.q, strict=True)
    }
    theta = solver.robot.joints(solution.q)
    for joint in description.movable:
        unit = "m" if joint.type == "prismatic" else "rad"
        excess = _excess(theta[joint.name], joint.lower, joint.upper, unit)
        if not found.get(joint.name):
            found[joint.name] = excess
    return [f"{name} {excess}" for name, excess in found.items() if excess]
