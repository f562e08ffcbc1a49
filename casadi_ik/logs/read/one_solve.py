"""One solve out of a log, with all that is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs.events.kinds import SINGULAR
from casadi_ik.logs.events.traces import bits_of
from casadi_ik.logs.read.asked import Asked, asked_of
from casadi_ik.logs.read.log import Log
from casadi_ik.logs.read.table import MethodRows, Table, label_of
from casadi_ik.problem.contacts.arrays import NAMES
from casadi_ik.problem.problems import Tolerance

SINGULAR_KINDS = tuple(kind.name for kind in SINGULAR)


@dataclass(frozen=True)
class Happening:
    """An event of a solve.

    Attributes:
        iteration: In which iteration, from 0.
        kind: What happened, e.g. "NEAR_SINGULAR".
        jacobian: The Jacobian concerned; "" if none.
        joints: The actuators concerned.
        phase: The phase it happened in; "" without phases.
        value: The number that made it an event.
        threshold: The number it was compared with, or the value before.
    """

    iteration: int
    kind: str
    jacobian: str
    joints: tuple[str, ...]
    phase: str
    value: float
    threshold: float


@dataclass(frozen=True)
class Stretch:
    """Iterations in a row that are in one phase.

    Attributes:
        phase: Its name.
        first: First iteration.
        last: Last iteration.
    """

    phase: str
    first: int
    last: int

    @property
    def rows(self) -> slice:
        """The iterations as rows of the trace."""
        return slice(self.first, self.last + 1)

    def __len__(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True, eq=False)
class OneSolve:
    """A solve; f fingers.

    Attributes:
        method: Name of the method.
        robot: Name of the robot.
        solve_id: Number of the solve.
        started: When it began [ns since the Unix epoch].
        time: How long it took [s].
        status: Name of the status it ended with.
        success: Whether the grasp is solved.
        restarts: How often it began anew.
        iterations: How many iterations it took, kept or not.
        fingers: Finger names, the order of every (f,) array.
        position_error: (f,) [m] at the end; NaN if free.
        angle_error: (f,) [rad] at the end; NaN if free.
        ok: (f,) which contacts are within tolerance.
        target_points: (f, 3) [m] in the base frame; NaN if free.
        target_normals: (f, 3); NaN if free.
        target_more: (f, 3) what contacts have beside ("tangents", "lines", "planes"), NaN if free;
            nothing that is free everywhere.
        layout: Fields of a row of the trace.
        labels: Names of codes, bits and elements by field.
        rows: The trace, a row per iteration; none if the log has kept the totals only.
        events: What happened, by iteration.
        parameters: What the solver was set to.
        asked: The question apart from its targets.
        shard: Name of the shard it comes from, if the log has several.
        number: Its number there; random numbers follow from it and the seed.
        clearance: Of the answer [m]; None if the solver had no scene.
        closest: The pair that is nearest to being too near; None as well if there is nothing.

    Example:
        >>> one = ik.logs.one_solve(ik.logs.open("cup.mcap"))
        >>> one.success, one.status, one.fingers
        (True, 'SOLVED', ('thumb', 'finger_2', 'finger_3'))
    """

    method: str
    robot: str
    solve_id: int
    started: int
    time: float
    status: str
    success: bool
    restarts: int
    iterations: int
    fingers: tuple[str, ...]
    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    target_points: Array
    target_normals: Array
    layout: Layout
    labels: Mapping[str, tuple[str, ...]]
    rows: np.ndarray[Any, np.dtype[Any]]
    events: tuple[Happening, ...]
    parameters: Mapping[str, Any]
    asked: Asked
    shard: str = ""
    number: int = 0
    target_more: Mapping[str, Array] = field(default_factory=dict)
    clearance: float | None = None
    closest: tuple[str, str] | None = None

    @property
    def tolerances(self) -> tuple[Tolerance, ...]:
        """What counted as reached, by finger."""
        return self.asked.tolerances

    @property
    def position_tolerance(self) -> Array:
        """(f,) [m]."""
        return np.array([each.position for each in self.tolerances])

    @property
    def angle_tolerance(self) -> Array:
        """(f,) [rad]."""
        return np.array([each.angle for each in self.tolerances])

    def columns(self, name: str) -> Array:
        """A field of all rows as a matrix, (k, size)."""
        return self.rows[name].reshape(len(self.rows), -1).astype(float)

    def bits(self, name: str) -> NDArray[np.bool_]:
        """The bits of a mask in all rows, (k, bits)."""
        return bits_of(self.rows[name].reshape(len(self.rows), -1))

    def name_of(self, field: str, index: int) -> str:
        """The name of an element or bit of a field, or its number."""
        names = self.labels.get(field, ())
        return names[index] if index < len(names) else f"{field} {index}"

    @cached_property
    def stretches(self) -> tuple[Stretch, ...]:
        """The phases in the order in which they were gone through; one without phases."""
        count = len(self.rows)
        if count == 0 or "phase" not in self.layout.names:
            return (Stretch("", 0, count - 1),) if count else ()
        codes = self.rows["phase"].astype(int)
        starts = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()]
        ends = [*(start - 1 for start in starts[1:]), count - 1]
        return tuple(
            Stretch(label_of(self.labels.get("phase", ()), int(codes[first])), first, last)
            for first, last in zip(starts, ends, strict=True)
        )


def one_solve(log: Log, solve: int | None = None, method: str | None = None) -> OneSolve:
    """Take one solve out of a log.

    Args:
        log: The log.
        solve: Its number; may be left out if the log holds one solve only.
        method: Its method; may be left out if only one has a solve of that number.

    Raises:
        UnknownNameError: There is no such solve, or it is not said which of several.
        LogError: The log is damaged.

    Example:
        >>> ik.logs.one_solve(ik.logs.open("cup.mcap"), 0).method
        'hand-first'
    """
    table = log.solves(solve=solve, method=method)
    found = [part for part in table.parts if len(part)]
    if len(table) != 1:
        held = ", ".join(
            f"{part.method} {_range(part.solve_id)}" for part in found or log.solves().parts
        )
        problem = f"no solve {solve}" if solve is not None else "no solve"
        if found:
            problem = "which solve?" if solve is None else f"solve {solve} of which method?"
        raise UnknownNameError(f"{problem}; the log holds: {held or 'nothing'}")
    (part,) = found
    row, number = part.rows[0], int(part.solve_id[0])
    if not np.isfinite([row["started"], row["time"]]).all():
        raise LogError(f"solve {number} of {part.method}: its times are no numbers")
    record = next(Table("solve", (part,)).records())
    iterations = log.iterations(method=part.method, solve=number).part
    events = log.events(method=part.method, solve=number)
    sources = log.sources.sources
    checked = "clearance" in (part.rows.dtype.names or ())
    source = sources[0 if part.shard is None else int(part.shard[0])]
    return OneSolve(
        method=part.method,
        robot=log.metadata["robot"],
        solve_id=number,
        started=round(float(row["started"]) * 1e9),
        time=float(row["time"]),
        status=record["status"],
        success=bool(row["success"]),
        restarts=int(row["restarts"]),
        iterations=int(row["iterations"]),
        fingers=tuple(part.labels["position_error"]),
        position_error=row["position_error"],
        angle_error=row["angle_error"],
        ok=row["ok"].astype(bool),
        target_points=row["target_points"],
        target_normals=row["target_normals"],
        layout=_layout(iterations),
        labels=iterations.labels,
        rows=iterations.rows,
        events=tuple(map(happening, events.records())) if len(events) else (),
        parameters=source.metadata["parameters"],
        asked=asked_of(part, source.metadata),
        shard=source.name if len(sources) > 1 else "",
        number=number - source.first,
        target_more=_more(row),
        clearance=float(row["clearance"]) if checked else None,
        closest=_pair(record) if checked else None,
    )


def _more(row: np.void) -> dict[str, Array]:
    """What the contacts have beside points and normals; logs of earlier versions have none."""
    known = row.dtype.names or ()
    more = {name: row[f"target_{name}"] for name in NAMES if f"target_{name}" in known}
    return {name: array for name, array in more.items() if not np.isnan(array).all()}


def _pair(record: Mapping[str, Any]) -> tuple[str, str] | None:
    pair = str(record["closest_first"]), str(record["closest_second"])
    return None if "none" in pair else pair


def _range(numbers: NDArray[np.int64]) -> str:
    first, last = int(numbers.min()), int(numbers.max())
    return f"solve {first}" if first == last else f"solves {first} to {last}"


def _layout(part: MethodRows) -> Layout:
    """The layout of the rows, which must be numbers only."""
    described = part.rows.dtype
    return Layout(
        tuple(
            Field(
                name,
                described[name].shape,
                described[name].base.str[1:],
                part.units.get(name, ""),
            )
            for name in described.names or ()
        )
    )


def happening(record: Mapping[str, Any]) -> Happening:
    """An event as `Table.records` gives it."""
    return Happening(
        iteration=record["iteration"],
        kind=record["kind"],
        jacobian=record["subject"] if record["kind"] in SINGULAR_KINDS else "",
        joints=tuple(record["joint_mask"]),
        phase=record["phase"],
        value=record["value"],
        threshold=record["threshold"],
    )
