"""Reports in mm and degrees, readable without colour at 80 columns, and solutions as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from casadi_ik.answers.diagnosis import Diagnosis
from casadi_ik.answers.solution import Solution
from casadi_ik.api import Solver
from casadi_ik.cli.outputs import write_output
from casadi_ik.problem.status import Status

UNITS = {"rad": (math.degrees(1.0), "deg"), "m": (1e3, "mm")}
"""What numbers in a unit are multiplied by, and the unit they are shown in."""

AT_LIMIT = 1e-6
"""How near to a limit counts as at it [rad or m]."""

MEANING = {
    Status.INVALID: "a number was no longer finite",
    Status.STALLED: "the method came to a standstill",
    Status.ITERATION_LIMIT: "the budget of iterations is used up",
    Status.UNREACHABLE: "{} cannot be reached: there is a proof",
    Status.COLLISION: "{} and limits are met, but something touches",
    Status.NOT_FOUND: "neither a solution nor a proof that there is none",
}


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
    """So many of something: "1 solve", "2 solves", "no solves"."""
    return f"{count or 'no'} {thing}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds >= 1:
        return f"{seconds:.2f} s"
    if seconds >= 1e-3:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds * 1e6:.3g} us"


def clearance(solution: Solution) -> str:
    """How far the answer is from touching something, in words."""
    if solution.clearance is None:
        return "collision not checked"
    if solution.closest is None:
        return "nothing there to touch"
    return f"clearance {1e3 * solution.clearance:.2f} mm: {' and '.join(solution.closest)}"


def solution_report(
    name: str,
    solver: Solver,
    solution: Solution,
    written: Mapping[str, Path | None],
    warning: str = "",
) -> Group:
    """The report of `solve`.

    Args:
        name: What the grasp is called.
        solver: Who solved.
        solution: The solution.
        written: Files that were written, by option.
        warning: What else should be known, "": nothing.
    """
    phases = ", ".join(f"{phase} {count}" for phase, count in solution.phases.items() if count)
    effort = counted(solution.iterations, "iteration") + (f" ({phases})" if phases else "")
    if solution.restarts:
        effort += f", {counted(solution.restarts, 'restart')}"
    what = f"{name}: {solution.method} on {solution.robot}"
    parts: list[RenderableType] = [
        headline(solution.success, solution.status.name, what),
        indented(f"{effort}, {duration(solution.time)}"),
        Text(f"  {clearance(solution)}"),
    ]
    if warning:
        parts.append(indented(warning, "yellow"))
    if not solution.success:
        parts += [indented(line, "yellow") for line in reasons(solver, solution)]
    parts += [_asked(solution), _actuators(solver, solution)]
    if solver.limits == "ignore" and not solution.limits_ok:
        count = len(_beyond(solver, solution))
        parts.append(indented(f"limits are ignored; positions beyond them: {count}", "yellow"))
    return Group(*parts, *files(written))


def reasons(solver: Solver, solution: Solution) -> list[str]:
    """Why a grasp is not solved: what is beyond or at a limit, and the diagnosis."""
    asked = "the contacts" if solution.palm is None else "the palm"
    lines = [MEANING.get(solution.status, "not met").format(asked)]
    beyond = _beyond(solver, solution) if solver.limits == "enforce" else {}
    if beyond:
        lines.append(f"beyond a limit: {', '.join(map(' '.join, beyond.items()))}")
    flags = zip(solution.actuators, _flags(solver, solution), strict=True)
    held = [f"{actuator} ({flag})" for actuator, flag in flags if flag in ("lower", "upper")]
    if held:
        lines.append(f"at a limit: {', '.join(held)}")
    if solution.diagnosis is not None:
        lines += solution.diagnosis.lines
    if solution.collision is not None:
        lines += solution.collision.lines[1:]
    return lines


def _asked(solution: Solution) -> Table:
    """The palm against what was asked for, or the contacts."""
    rows: dict[str, Any] = dict(solution.contacts)
    tolerances = [one.tolerance for one in solution.contacts.values()]
    if solution.palm is not None:
        rows = {"palm": solution.palm}
        tolerances = [max(tolerances, key=lambda one: one.position)]
    right = ("point off by", "tolerance", "normal off by", "tolerance")
    if solution.palm is not None:
        right = ("place off by", "tolerance", "direction off by", "tolerance")
    shown = table("contact" if solution.palm is None else "", *right, "", right=right)
    for (name, found), tolerance in zip(rows.items(), tolerances, strict=True):
        shown.add_row(
            name,
            *_compared(found.position_error, tolerance.position, "m"),
            *_compared(found.angle_error, tolerance.angle, "rad"),
            Text("ok", "green") if found.ok else Text("missed", "red"),
        )
    return shown


def _compared(error: float, tolerance: float, unit: str) -> tuple[str, str]:
    scale, name = UNITS[unit]
    if math.isnan(error):
        return "free", ""
    return f"{error * scale:.3f} {name}", f"{tolerance * scale:.4g} {name}"


def _actuators(solver: Solver, solution: Solution) -> Table:
    right = ("position", "lower", "upper")
    rows = table("actuator", *right, "limit", right=right)
    flags = _flags(solver, solution)
    for actuator, value, flag in zip(
        solver.robot.description.actuators, solution.q, flags, strict=True
    ):
        scale, unit = UNITS[actuator.unit]
        rows.add_row(
            actuator.name,
            f"{value * scale:.3f} {unit}",
            f"{actuator.lower * scale:.4g}",
            f"{actuator.upper * scale:.4g}",
            Text(f"at {flag}" if flag in ("lower", "upper") else flag, "yellow"),
        )
    return rows


def _flags(solver: Solver, solution: Solution) -> list[str]:
    """Per actuator "" or "lower" or "upper" (at that limit) or by how much it is beyond."""
    found = []
    for one, value in zip(solver.robot.description.actuators, solution.q, strict=True):
        at = "lower" if value - one.lower <= AT_LIMIT else ""
        at = "upper" if one.upper - value <= AT_LIMIT else at
        found.append(_excess(float(value), one.lower, one.upper, one.unit) or at)
    return found


def _excess(value: float, lower: float, upper: float, unit: str) -> str:
    """By how much a value is beyond its limits, in words; "" if it is not."""
    scale, name = UNITS[unit]
    for side, far in (("below", lower - value), ("above", value - upper)):
        if far > AT_LIMIT:
            return f"{far * scale:.3g} {name} {side}"
    return ""


def _beyond(solver: Solver, solution: Solution) -> dict[str, str]:
    """Actuators, and joints that follow one by a coupling, that are beyond their limits."""
    description = solver.robot.description
    theta = solver.robot.joints(solution.q)
    found = {
        joint.name: _excess(
            theta[joint.name], joint.lower, joint.upper, "m" if joint.type == "prismatic" else "rad"
        )
        for joint in description.movable
    }
    for actuator, value in zip(description.actuators, solution.q, strict=True):
        excess = _excess(float(value), actuator.lower, actuator.upper, actuator.unit)
        found[actuator.name] = excess or found.get(actuator.name, "")
    return {name: excess for name, excess in found.items() if excess}


def as_json(solution: Solution) -> dict[str, Any]:
    """A solution as JSON holds it; null stands for what is not a finite number (a free finger)."""
    names = ["success", "status", "method", "robot", "actuators", "q", "iterations", "restarts"]
    names += ["time", "contacts", "diagnosis"]
    names += ["palm"] if solution.palm is not None else []
    names += ["clearance", "closest", "collision"] if solution.clearance is not None else []
    found = plain({name: getattr(solution, name) for name in names})
    for contact in found["contacts"].values():
        del contact["tolerance"]
    return found


def plain(value: Any) -> Any:
    """What JSON can hold: arrays as lists, enums by name, null for what is not finite."""
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value):
        found = {one.name: getattr(value, one.name) for one in fields_of(value) if one.repr}
        if isinstance(value, Diagnosis):
            names = ("established", "reliefs", "freed", "lines")
            found |= {name: getattr(value, name) for name in names}
        return plain(found)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, data: Any) -> None:
    """Write what ``--out`` asks for as JSON.

    Raises:
        OutputError: It cannot be written.
    """
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    write_output(path, "--out", lambda part: part.write_text(text, encoding="utf-8"))
