"""A body without a trunk: its sides know nothing of each other, and each is solved by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.status import Status
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.trace import packed
from casadi_ik.robots.description import RobotDescription

SideRun = Callable[[TargetBatch, Array], Outcome]
"""Solves the targets of a side from where it is."""


def side_by_side(
    robot: RobotDescription,
    runs: Sequence[SideRun],
    targets: TargetBatch,
    q0: Array,
    phases: Sequence[str],
    record: np.dtype[Any] | None,
) -> Outcome:
    """Solve every side by itself.

    Args:
        robot: The body.
        runs: What solves its sides.
        targets: k targets.
        q0: (k, n) where the robot is, within bounds.
        phases: Names of all phases, in order.
        record: Of the rows of a trace of the body; None: no trace is wanted.
    """
    count, q = len(targets), np.array(q0)
    status = np.full(count, int(Status.SOLVED))
    iterations, restarts = np.zeros((2, count), dtype=np.int64)
    seconds, spent = np.zeros(count), {name: np.zeros(count, dtype=np.int64) for name in phases}
    traces: list[list[NDArray[Any]]] = [[] for _ in range(count)]
    for run, side, (arm, hand) in zip(runs, robot.sides, robot.side_actuators, strict=True):
        motors = sorted((*arm, *hand))
        fingers = [robot.finger_names.index(name) for name in side.fingers]
        known = [targets.points, targets.normals]
        asked = np.any([~np.isnan(one[:, fingers, 0]) for one in known], axis=(0, 2))
        rows = np.flatnonzero(asked)
        if not len(rows):
            continue
        found = run(part_of(targets.rows(rows), fingers, motors), q[rows][:, motors])
        before = q[rows]
        q[rows[:, None], motors] = found.q
        worse = (status[rows] == Status.SOLVED) & (found.status != Status.SOLVED)
        status[rows[worse]] = found.status[worse]
        iterations[rows] += found.iterations
        restarts[rows] += found.restarts
        seconds[rows] += found.time
        for name, numbers in found.phases.items():
            spent[name][rows] += numbers
        if record is not None:
            for row, here, own in zip(rows.tolist(), before, found.trace, strict=True):
                traces[row].append(_of_body(robot, own, here, motors, fingers, record))
    whole = None
    if record is not None:
        every = [part for parts in traces for part in parts]
        whole = np.concatenate([np.empty(0, record), *every])
    return Outcome(q, status, iterations, restarts, seconds, spent, whole)


def part_of(targets: TargetBatch, fingers: Sequence[int], motors: Sequence[int]) -> TargetBatch:
    """The part of targets that is of some fingers, on a robot of some motors."""
    fixed = None if targets.fixed is None else targets.fixed[..., motors]
    return replace(targets.of_fingers(fingers), fixed=fixed)


def _of_body(
    robot: RobotDescription,
    rows: NDArray[Any],
    here: Array,
    motors: Sequence[int],
    fingers: Sequence[int],
    record: np.dtype[Any],
) -> NDArray[Any]:
    """The rows of a side's trace as rows of the body, all other motors at `here` (n,)."""
    found = np.zeros(len(rows), record)
    for name in record.names or ():
        if found[name].dtype.kind == "f":
            found[name] = np.nan
        if name == "q":
            found[name] = here
            found[name][:, motors] = rows[name]
        elif name in ("position_error", "angle_error"):
            found[name][:, fingers] = rows[name]
        elif name != "limit_mask" and name in (rows.dtype.names or ()):
            found[name] = rows[name]
    at_limits = (found["q"] <= robot.lower) | (found["q"] >= robot.upper)
    found["limit_mask"] = packed(at_limits).reshape(found["limit_mask"].shape)
    return found
