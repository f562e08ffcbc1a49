"""Targets that parts of a robot solve: independent sides, and an arm with a palm pose.

The sides of a multi-arm robot without a trunk are solved independently. Without compiled code, so
are those of a robot with a trunk, at one position of the trunk after the other.

A palm pose with a hand posture determines all contacts, but a palm pose within tolerance may move
them beyond theirs: a rotation by 10 deg moves a fingertip at a distance of 150 mm by 26 mm. The
search for a palm pose within its tolerance therefore fits the palm frame itself, as the only
fingertip of the arm without its hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import Kinds, kind_from_vectors
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.link_shapes import NO_SHAPES
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import pack_mask

SideSolver = Callable[[TargetBatch], Outcome]
"""Function that solves the targets of a side."""


def solve_sides_independently(
    robot: RobotDescription,
    solvers: Sequence[SideSolver],
    targets: TargetBatch,
    phases: Sequence[str],
    record: np.dtype[Any] | None,
) -> Outcome:
    """Solve each side of a multi-arm robot independently.

    Args:
        robot: Description of the robot.
        solvers: Solvers of its sides.
        targets: k targets.
        phases: Names of all phases, in order.
        record: Record type of the rows of a trace of the robot; None: no trace.
    """
    count, starts = len(targets), targets.starts(robot)
    q = np.where(robot.continuous, starts, np.clip(starts, *targets.bounds(robot)))
    targets = targets.starting_at(q)
    status = np.full(count, int(Status.SOLVED))
    iterations, restarts = np.zeros((2, count), dtype=np.int64)
    seconds = np.zeros(count)
    phase_counts = {name: np.zeros(count, dtype=np.int64) for name in phases}
    traces: list[list[NDArray[Any]]] = [[] for _ in range(count)]
    for solve, side, (arm, hand) in zip(solvers, robot.sides, robot.side_actuators, strict=True):
        motors = sorted((*arm, *hand))
        fingers = [robot.finger_names.index(name) for name in side.fingers]
        vectors = [targets.points, targets.normals]
        has_contact = np.any([~np.isnan(array[:, fingers, 0]) for array in vectors], axis=(0, 2))
        rows = np.flatnonzero(has_contact)
        if not len(rows):
            continue
        outcome = solve(targets.rows(rows).for_part(fingers, motors))
        q_before = q[rows]
        q[rows[:, None], motors] = outcome.q
        is_worse = (status[rows] == Status.SOLVED) & (outcome.status != Status.SOLVED)
        status[rows[is_worse]] = outcome.status[is_worse]
        iterations[rows] += outcome.iterations
        restarts[rows] += outcome.restarts
        seconds[rows] += outcome.time
        for name, counts in outcome.phases.items():
            phase_counts[name][rows] += counts
        if record is not None:
            for row, other_q, trace in zip(rows.tolist(), q_before, outcome.trace, strict=True):
                traces[row].append(robot_trace(robot, trace, other_q, motors, fingers, record))
    all_rows = None
    if record is not None:
        parts = [trace for target_traces in traces for trace in target_traces]
        all_rows = np.concatenate([np.empty(0, record), *parts])
    return Outcome(q, status, iterations, restarts, seconds, phase_counts, all_rows)


TRUNK_POSITIONS = 192
"""Number of trunk positions besides the start at which sides are solved independently.

Source: of 84 reachable targets of two Pandas with Allegro hands on a mobile base, 64 positions
leave 3 unsolved, and 192 none. The two of 84 targets of a G1 that 64 positions leave, 256 leave as
well.
"""


def solve_sides_at_trunk_positions(
    robot: RobotDescription,
    arm_hand: ArmHand,
    solvers: Sequence[SideSolver],
    targets: TargetBatch,
    phases: Sequence[str],
    record: np.dtype[Any] | None,
    restarts: int,
) -> Outcome:
    """Solve each side of a multi-arm robot independently, at several positions of its trunk.

    Args:
        robot: Description of the robot.
        arm_hand: Kinematics of the robot.
        solvers: See `solve_sides_independently`.
        targets: k targets; the trunk starts at their start configurations.
        phases: See `solve_sides_independently`.
        record: See `solve_sides_independently`.
        restarts: Maximum number of trunk positions.
    """
    trunk = list(robot.trunk_actuators)
    lower, upper = (np.broadcast_to(b, targets.starts(robot).shape) for b in targets.bounds(robot))
    starts = np.clip(targets.starts(robot), lower, upper)
    fractions = spread_points(TRUNK_POSITIONS, len(trunk)) if trunk else np.empty((0, 0))
    outcome: Outcome | None = None
    for number in range(min(1 + len(fractions), restarts)):
        rows = np.arange(len(targets))
        if outcome is not None:
            rows = np.flatnonzero(outcome.status != Status.SOLVED)
        if not len(rows):
            break
        q0 = starts[rows]
        if number:
            ranges = (upper - lower)[rows][:, trunk]
            q0[:, trunk] = lower[rows][:, trunk] + fractions[number - 1] * ranges
        trunk_poses = np.broadcast_to(arm_hand.links(q0)[robot.trunk_link], (len(rows), 4, 4))
        result = solve_sides_independently(
            robot,
            solvers,
            in_frames(targets.rows(rows).starting_at(q0), trunk_poses),
            phases,
            record,
        )
        if outcome is None:
            outcome = result
            continue
        trace = result.trace if record is not None else None
        is_solved = result.status == Status.SOLVED
        status = outcome.status.copy()
        status[rows[is_solved]] = Status.SOLVED
        outcome = outcome.continued(rows, result.q, is_solved, result, trace)
        outcome = replace(outcome, status=status)
    assert outcome is not None
    return outcome


def in_frames(targets: TargetBatch, frames: Array) -> TargetBatch:
    """Return the contacts of k targets in frames whose poses (k, 4, 4) in the base are given."""

    def rotated(vectors: Array) -> Array:
        return np.einsum("kji,kfj->kfi", frames[:, :3, :3], vectors)

    return replace(
        targets,
        points=rotated(targets.points - frames[:, None, :3, 3]),
        normals=rotated(targets.normals),
        extra_vectors={name: rotated(array) for name, array in targets.extra_vectors.items()},
    )


def robot_trace(
    robot: RobotDescription,
    trace: NDArray[Any],
    q: Array,
    motors: Sequence[int],
    fingers: Sequence[int],
    record: np.dtype[Any],
) -> NDArray[Any]:
    """Return the trace of a part of a robot as a trace of the robot.

    Args:
        robot: Description of the robot.
        trace: Rows of the part.
        q: (n,) positions of the other motors [rad or m].
        motors: Indices in q of the motors of the part.
        fingers: Indices of the fingers of the part.
        record: Record type of the rows of the robot.
    """
    rows = np.zeros(len(trace), record)
    for name in record.names or ():
        if rows[name].dtype.kind == "f":
            rows[name] = np.nan
        if name == "q":
            rows[name] = q
            rows[name][:, motors] = trace[name]
        elif name in ("position_error", "angle_error"):
            rows[name][:, fingers] = trace[name]
        elif name != "limit_mask" and name in (trace.dtype.names or ()):
            rows[name] = trace[name]
    at_limits = (rows["q"] <= robot.lower) | (rows["q"] >= robot.upper)
    rows["limit_mask"] = pack_mask(at_limits).reshape(rows["limit_mask"].shape)
    return rows


PALM_KINDS: Kinds = (kind_from_vectors(("tangent",)),)
"""The contact that determines a palm pose: a point with a whole frame."""


def palm_robot(robot: RobotDescription) -> RobotDescription:
    """Return the arm without its hand, with the palm frame as its only fingertip.

    Args:
        robot: An arm-hand.
    """
    joints = robot.chain(robot.palm_link)
    arm = list(robot.arm_actuators)
    palm = Finger(
        name="palm",
        link=robot.palm_link,
        placement=robot.palm_placement,
        normal=np.array([1.0, 0.0, 0.0]),
        joints=(),
        tangent=np.array([0.0, 1.0, 0.0]),
    )
    return replace(
        robot,
        name=f"{robot.name}.palm",
        joints=joints,
        actuators=tuple(robot.actuators[i] for i in arm),
        fingers=(palm,),
        named_thumb=None,
        home=robot.home[arm],
        shapes=NO_SHAPES,
    )


def palm_contacts(robot: RobotDescription, targets: TargetBatch) -> TargetBatch:
    """Return palm poses as contacts of `palm_robot`.

    Args:
        robot: The arm-hand.
        targets: k targets with palm poses.
    """
    palms, arm = targets.palms, list(robot.arm_actuators)
    assert palms is not None
    return replace(
        targets,
        points=palms[:, None, :3, 3],
        normals=palms[:, None, :3, 0],
        extra_vectors={"tangents": palms[:, None, :3, 1]},
        tolerance=targets.largest_tolerance,
        fixed=None if targets.fixed is None else targets.fixed[..., arm],
        q0=None if targets.q0 is None else targets.q0[..., arm],
        palms=None,
    )
