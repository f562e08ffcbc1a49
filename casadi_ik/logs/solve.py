"""Records of single solves, read from a log."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.events import Event
from casadi_ik.logs.reader import Log
from casadi_ik.logs.tables import MethodRows, Table, element_name, events_of, label_of
from casadi_ik.logs.traces import bits_of, measured_jacobians
from casadi_ik.logs.wording import errors_text
from casadi_ik.model.targets import EXTRA_ARRAY_NAMES, NO_PREFERENCE, Tolerance
from casadi_ik.solve.trace import SIGMA, TraceFormat


@dataclass(frozen=True)
class PhaseSpan:
    """Consecutive iterations of one phase.

    Attributes:
        phase: Name of the phase.
        first: First iteration, from 0.
        last: Last iteration.
    """

    phase: str
    first: int
    last: int

    @property
    def rows(self) -> slice:
        """Slice of the iterations in the trace."""
        return slice(self.first, self.last + 1)

    def __len__(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True, eq=False)
class LoggedTarget:
    """Conditions of a logged solve.

    A solve can be repeated from its contacts, these conditions and the parameters of the solver.

    Attributes:
        tolerances: Tolerances of the contacts by finger.
        limits: Treatment of limits, "enforce" or "ignore".
        seed: Seed of the random numbers, which also depend on the number of the solve.
        start: (n,) start configuration [rad or m]; None if unknown.
        fixed: Positions of fixed actuators by name [rad or m].
        prefer: Preference among solutions; None if the method has none.

    Example:
        >>> target = ik.logs.one_solve(ik.logs.open("cup.mcap")).target
        >>> target.limits, target.seed, bool(np.allclose(target.start, robot.home))
        ('enforce', 0, True)
    """

    tolerances: tuple[Tolerance, ...]
    limits: str = "enforce"
    seed: int = 0
    start: Array | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    prefer: str | None = None


@dataclass(frozen=True, eq=False, repr=False)
class SolveRecord(RecordReprMixin):
    """Record of a solve for f fingers.

    Attributes:
        method: Name of the method.
        robot: Name of the robot.
        solve_id: Number of the solve in the log, from 0.
        started: Start time [ns since the Unix epoch].
        time: Duration [s].
        status: Name of the final status.
        success: True if the target is solved.
        restarts: Number of restarts.
        iterations: Number of iterations, logged or not.
        fingers: Names of the fingers in the order of every (f,) array.
        position_error: (f,) final position errors [m]; NaN for free contacts.
        angle_error: (f,) final angle errors [rad]; NaN for free contacts.
        ok: (f,) True for contacts within tolerance.
        target_points: (f, 3) contact points in the base frame [m]; NaN if free.
        target_normals: (f, 3) contact normals in the base frame; NaN if free.
        layout: Fields of a row of the trace.
        labels: Names of codes, bits and elements by field.
        rows: Trace with a row per iteration; empty if the log holds only the totals.
        events: Events in the order of iterations.
        parameters: Parameters of the solver.
        target: Conditions of the solve in addition to its contacts.
        shard: Name of the shard of the solve; "" unless the log has several shards.
        number: Number of the solve in its shard, from which its random numbers follow.
        target_more: (f, 3) further vectors of the contacts ("tangents", "lines", "planes",
            "balls"), NaN if free; arrays that are free everywhere are absent.
        clearance: Clearance of the solution [m]; None without a scene.
        closest: Pair of shapes with the smallest clearance beyond its margin; None without a scene
            or without a pair.

    Example:
        >>> record = ik.logs.one_solve(ik.logs.open("cup.mcap"))
        >>> record.success, record.status, record.fingers
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
    events: tuple[Event, ...]
    parameters: Mapping[str, Any]
    target: LoggedTarget
    shard: str = ""
    number: int = 0
    target_more: Mapping[str, Array] = field(default_factory=dict)
    clearance: float | None = None
    closest: tuple[str, str] | None = None

    @property
    def asked(self) -> LoggedTarget:
        """Deprecated name of `target`."""
        warn_renamed("SolveRecord.asked", "SolveRecord.target")
        return self.target

    @property
    def stretches(self) -> tuple[PhaseSpan, ...]:
        """Deprecated name of `phase_spans`."""
        warn_renamed("SolveRecord.stretches", "SolveRecord.phase_spans")
        return self.phase_spans

    @property
    def tolerances(self) -> tuple[Tolerance, ...]:
        """Tolerances of the contacts by finger."""
        return self.target.tolerances

    @property
    def position_tolerance(self) -> Array:
        """(f,) position tolerances [m]."""
        return np.array([tolerance.position for tolerance in self.tolerances])

    @property
    def angle_tolerance(self) -> Array:
        """(f,) angle tolerances [rad]."""
        return np.array([tolerance.angle for tolerance in self.tolerances])

    def columns(self, name: str) -> Array:
        """Return a field of all rows as a matrix (k, size)."""
        return self.rows[name].reshape(len(self.rows), -1).astype(float)

    def bits(self, name: str) -> NDArray[np.bool_]:
        """Return the bits of a mask in all rows, (k, bits)."""
        return bits_of(self.rows[name].reshape(len(self.rows), -1))

    def errors_of(self, finger: int) -> str:
        """Return the final errors of a finger as text."""
        return errors_text(float(self.position_error[finger]), float(self.angle_error[finger]))

    def name_of(self, field: str, index: int) -> str:
        """Return the name of an element or bit of a field, or the field with the index."""
        names = self.labels.get(field, ())
        return names[index] if index < len(names) else f"{field} {index}"

    @cached_property
    def sigmas(self) -> dict[str, Array]:
        """(k,) smallest singular value of each Jacobian by name; NaN where not measured."""
        form = TraceFormat(self.layout, self.labels)
        return {
            name: self.columns(item.name)[:, i]
            for item in self.layout
            if item.name.startswith(SIGMA)
            for i, name in enumerate(measured_jacobians(form, item))
        }

    @cached_property
    def phase_spans(self) -> tuple[PhaseSpan, ...]:
        """Phases in chronological order; one span if the method has no phases."""
        count = len(self.rows)
        if count == 0 or "phase" not in self.layout.names:
            return (PhaseSpan("", 0, count - 1),) if count else ()
        codes = self.rows["phase"].astype(int)
        starts = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()]
        lasts = [*(start - 1 for start in starts[1:]), count - 1]
        return tuple(
            PhaseSpan(label_of(self.labels.get("phase", ()), int(codes[first])), first, last)
            for first, last in zip(starts, lasts, strict=True)
        )


def one_solve(
    log: Log, solve: int | None = None, method: str | None = None, counted_from: int = 0
) -> SolveRecord:
    """Read one solve from a log.

    Args:
        log: The log.
        solve: Number of the solve; optional if the log holds a single solve.
        method: Method of the solve; optional if only one method has a solve of this number.
        counted_from: Number of the first solve in `solve` and in messages.

    Raises:
        UnknownNameError: The log has no such solve, or the arguments select several.
        LogError: The log is damaged.

    Example:
        >>> ik.logs.one_solve(ik.logs.open("cup.mcap"), 0).method
        'hand-first'
    """
    table = log.solves(solve=None if solve is None else solve - counted_from, method=method)
    parts = [part for part in table.parts if len(part)]
    if len(table) != 1:
        available = ", ".join(
            f"{part.method} {_number_range(part.solve_id + counted_from)}"
            for part in parts or log.solves().parts
        )
        name = "solve" if solve is None else f"solve {solve}"
        problem = f"{name} is not in the log"
        if parts:
            problem = "solve: number is missing" if solve is None else f"{name}: method is missing"
        raise UnknownNameError(f"{problem}; the log holds: {available or 'no solve'}")
    (part,) = parts
    row, number = part.rows[0], int(part.solve_id[0])
    if not np.isfinite([row["started"], row["time"], row["seed"]]).all():
        raise LogError(f"solve {number} of {part.method}: times or seed are not numeric")
    record = next(Table("solve", (part,)).records())
    iterations = log.iterations(method=part.method, solve=number).part
    events = log.events(method=part.method, solve=number).part
    sources = log.sources.sources
    source = sources[0 if part.shard is None else int(part.shard[0])]
    optional = optional_targets(row)
    checked = "clearance" in part.names
    closest = (record["closest_first"], record["closest_second"]) if checked else ("none", "none")
    return SolveRecord(
        **{name: row[name] for name in _COPIED_FIELDS},
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
        ok=row["ok"].astype(bool),
        layout=_layout(iterations),
        labels=iterations.labels,
        rows=iterations.rows,
        events=tuple(events_of(events)),
        parameters=source.metadata["parameters"],
        target=_target_of(part),
        shard=source.file if len(sources) > 1 else "",
        number=number - source.first,
        target_more={name: array for name, array in optional.items() if not np.isnan(array).all()},
        clearance=float(row["clearance"]) if checked else None,
        closest=None if "none" in closest else closest,
    )


def optional_targets(row: np.void) -> dict[str, Array]:
    """Return the contact vectors (f, 3) of a row besides points and normals by name."""
    names = row.dtype.names or ()
    return {name: row[f"target_{name}"] for name in EXTRA_ARRAY_NAMES if f"target_{name}" in names}


URDF_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""Pattern of numbers in a URDF."""

_COPIED_FIELDS = ("position_error", "angle_error", "target_points", "target_normals")


def check_robot(robot: ArmHand, urdf: str, context: str) -> None:
    """Check that a robot is the robot of a log.

    Args:
        robot: The robot.
        urdf: Robot description attached to the log.
        context: Name of the log in the error message.

    Raises:
        LogError: The descriptions differ by more than rounding.
    """
    texts = robot.urdf(), urdf
    frame, expected_frame = (URDF_NUMBER.sub("#", text) for text in texts)
    values, expected = (np.array(URDF_NUMBER.findall(text), float) for text in texts)
    if frame != expected_frame or not np.allclose(values, expected, rtol=1e-9, atol=1e-9):
        raise LogError(
            f"{context}: robot {robot.name!r} is not the robot of the log (the URDFs differ);"
            " expected the description that was used for the solve (--robot)"
        )


def _target_of(part: MethodRows) -> LoggedTarget:
    """Return the conditions of the only solve of a part."""
    row, names = part.rows[0], part.labels.get("q", ())
    prefer = label_of(part.labels.get("prefer", ()), int(row["prefer"]))
    (is_fixed,) = bits_of(np.atleast_1d(row["fixed_mask"])[None])
    fixed = np.flatnonzero(is_fixed[: len(row["start"])]).tolist()
    pairs = zip(row["position_tolerance"].tolist(), row["angle_tolerance"].tolist(), strict=True)
    return LoggedTarget(
        tolerances=tuple(Tolerance(*pair) for pair in pairs),
        limits="enforce" if row["limits_enforced"] else "ignore",
        seed=int(row["seed"]),
        start=row["start"],
        fixed={element_name(names, i): float(row["start"][i]) for i in fixed},
        prefer=None if prefer == NO_PREFERENCE else prefer,
    )


def _number_range(numbers: NDArray[np.int64]) -> str:
    """Return the first and last of some solve numbers as text."""
    first, last = int(numbers.min()), int(numbers.max())
    return f"solve {first}" if first == last else f"solves {first} to {last}"


def _layout(part: MethodRows) -> Layout:
    """Return the layout of the rows of a part."""
    kind = part.rows.dtype
    return Layout(
        tuple(
            Field(name, kind[name].shape, kind[name].base.str[1:], part.units.get(name, ""))
            for name in part.names
        )
    )
