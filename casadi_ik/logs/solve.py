"""One solve out of a log, with all that is known of it."""

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
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import EXTRA_ARRAY_NAMES
from casadi_ik.logs.events import Happening, bits_of, errors_text, measured_jacobians
from casadi_ik.logs.reader import Log
from casadi_ik.logs.tables import MethodRows, Table, element_name, happenings, label_of
from casadi_ik.model.targets import Tolerance
from casadi_ik.solve.request import NO_PREFERENCE
from casadi_ik.solve.trace import SIGMA, TraceFormat


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
class Asked:
    """The conditions of a solve; with its targets and the solver's options they repeat it.

    Attributes:
        tolerances: What counted as reached, by finger.
        limits: "enforce" or "ignore".
        seed: Of its random numbers, which follow from the number of the solve as well.
        start: (n,) where it began [rad or m]; None if that is not known.
        fixed: Actuators that were held, and where [rad or m].
        prefer: Which of several solutions was wanted; None: the method cannot choose.

    Example:
        >>> asked = ik.logs.one_solve(ik.logs.open("cup.mcap")).asked
        >>> asked.limits, asked.seed, bool(np.allclose(asked.start, robot.home))
        ('enforce', 0, True)
    """

    tolerances: tuple[Tolerance, ...]
    limits: str = "enforce"
    seed: int = 0
    start: Array | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    prefer: str | None = None


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
        layout: Fields of a row of the trace.
        labels: Names of codes, bits and elements by field.
        rows: The trace, a row per iteration; none if the log has kept the totals only.
        events: What happened, by iteration.
        parameters: What the solver was set to.
        asked: The question apart from its targets.
        shard: Name of the shard it comes from, if the log has several.
        number: Its number there; random numbers follow from it and the seed.
        target_more: (f, 3) what contacts have beside ("tangents", "lines", "planes", "balls"),
            NaN if free; nothing that is free everywhere.
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

    def errors_of(self, finger: int) -> str:
        """How far a finger ended from its contact, in words."""
        return errors_text(float(self.position_error[finger]), float(self.angle_error[finger]))

    def name_of(self, field: str, index: int) -> str:
        """The name of an element or bit of a field, or its number."""
        names = self.labels.get(field, ())
        return names[index] if index < len(names) else f"{field} {index}"

    @cached_property
    def sigmas(self) -> dict[str, Array]:
        """(k,) smallest singular value in all rows, by Jacobian; NaN where not measured."""
        form = TraceFormat(self.layout, self.labels)
        return {
            name: self.columns(item.name)[:, i]
            for item in self.layout
            if item.name.startswith(SIGMA)
            for i, name in enumerate(measured_jacobians(form, item))
        }

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


def one_solve(
    log: Log, solve: int | None = None, method: str | None = None, counted_from: int = 0
) -> OneSolve:
    """Read one solve from a log.

    Args:
        log: The log.
        solve: Its number; may be left out if the log holds one solve only.
        method: Its method; may be left out if only one has a solve of that number.
        counted_from: Number that the first solve has for who asks.

    Raises:
        UnknownNameError: There is no such solve, or it is not said which of several.
        LogError: The log is damaged.

    Example:
        >>> ik.logs.one_solve(ik.logs.open("cup.mcap"), 0).method
        'hand-first'
    """
    table = log.solves(solve=None if solve is None else solve - counted_from, method=method)
    found = [part for part in table.parts if len(part)]
    if len(table) != 1:
        held = ", ".join(
            f"{part.method} {_range(part.solve_id + counted_from)}"
            for part in found or log.solves().parts
        )
        problem = f"no solve {solve}" if solve is not None else "no solve"
        if found:
            problem = "which solve?" if solve is None else f"solve {solve} of which method?"
        raise UnknownNameError(f"{problem}; the log holds: {held or 'nothing'}")
    (part,) = found
    row, number = part.rows[0], int(part.solve_id[0])
    if not np.isfinite([row["started"], row["time"], row["seed"]]).all():
        raise LogError(f"solve {number} of {part.method}: its times or its seed are no numbers")
    record = next(Table("solve", (part,)).records())
    iterations = log.iterations(method=part.method, solve=number).part
    events = log.events(method=part.method, solve=number).part
    sources = log.sources.sources
    source = sources[0 if part.shard is None else int(part.shard[0])]
    more = targets_beside(row)
    checked = "clearance" in part.names
    closest = (record["closest_first"], record["closest_second"]) if checked else ("none", "none")
    return OneSolve(
        **{name: row[name] for name in _AS_LOGGED},
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
        events=tuple(happenings(events)),
        parameters=source.metadata["parameters"],
        asked=_asked(part),
        shard=source.file if len(sources) > 1 else "",
        number=number - source.first,
        target_more={name: array for name, array in more.items() if not np.isnan(array).all()},
        clearance=float(row["clearance"]) if checked else None,
        closest=None if "none" in closest else closest,
    )


def targets_beside(row: np.void) -> dict[str, Array]:
    """(f, 3) what the contacts of a solve's row have beside points and normals, by name."""
    names = row.dtype.names or ()
    return {name: row[f"target_{name}"] for name in EXTRA_ARRAY_NAMES if f"target_{name}" in names}


NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number in a URDF."""

_AS_LOGGED = ("position_error", "angle_error", "target_points", "target_normals")


def check_robot(robot: ArmHand, urdf: str, where: str) -> None:
    """Check that a robot is the one that a log was written for.

    Args:
        robot: The robot.
        urdf: The robot description attached to the log.
        where: The log, for the message.

    Raises:
        LogError: They differ by more than rounding.
    """
    texts = robot.urdf(), urdf
    frame, expected_frame = (NUMBER.sub("#", text) for text in texts)
    values, expected = (np.array(NUMBER.findall(text), float) for text in texts)
    if frame != expected_frame or not np.allclose(values, expected, rtol=1e-9, atol=1e-9):
        raise LogError(
            f"{where}: the robot {robot.name!r} is not the one in the log (its URDF differs);"
            " give the description that was solved for (--robot)"
        )


def _asked(part: MethodRows) -> Asked:
    """The question of the only solve of a part."""
    row, names = part.rows[0], part.labels.get("q", ())
    prefer = label_of(part.labels.get("prefer", ()), int(row["prefer"]))
    (held,) = bits_of(np.atleast_1d(row["fixed_mask"])[None])
    held = np.flatnonzero(held[: len(row["start"])]).tolist()
    pairs = zip(row["position_tolerance"].tolist(), row["angle_tolerance"].tolist(), strict=True)
    return Asked(
        tolerances=tuple(Tolerance(*pair) for pair in pairs),
        limits="enforce" if row["limits_enforced"] else "ignore",
        seed=int(row["seed"]),
        start=row["start"],
        fixed={element_name(names, i): float(row["start"][i]) for i in held},
        prefer=None if prefer == NO_PREFERENCE else prefer,
    )


def _range(numbers: NDArray[np.int64]) -> str:
    first, last = int(numbers.min()), int(numbers.max())
    return f"solve {first}" if first == last else f"solves {first} to {last}"


def _layout(part: MethodRows) -> Layout:
    """The layout of the rows."""
    kind = part.rows.dtype
    return Layout(
        tuple(
            Field(name, kind[name].shape, kind[name].base.str[1:], part.units.get(name, ""))
            for name in part.names
        )
    )
