"""Checks of traces against independent computations.

The checks use only the promises of standard fields; differences between methods are in `Promise`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik
from casadi_ik.compile.layout import Layout  # noqa: F401 (for test_trace_contract)
from casadi_ik.solve.recorder import SolveBlock
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import (
    ACCEPTED,
    ACTIVE_MASK,
    ANGLE_ERROR,
    COST,
    DAMPING,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    STATUS,
    STEP_SIZE,
    Q,
)

LENGTH = 0.1
"""Length by which position errors are divided in a cost [m]."""


class TraceRecorder:
    """Recorder that keeps the blocks in memory."""

    def __init__(self) -> None:
        self.blocks: list[SolveBlock] = []

    def record(self, block: SolveBlock) -> None:
        self.blocks.append(block)

    def close(self) -> None:
        """Do nothing."""

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None:
        """Do nothing."""


@dataclass(frozen=True)
class Promise:
    """Promises of a method about the rows of its trace.

    Attributes:
        exact_phases: Phases whose errors are those of the row's q.
        step_phases: Phases whose `STEP_SIZE` is that of the step between two rows in them.
        has_q_before_step: Whether a row's q is the one before its step, not the one after it.
        slack: Distance from a limit that counts as on it [rad or m].
        thumb_weight: Weight of the squared errors of the thumb in the cost.
        normals: Term of the normals in the cost: the "chord" of the angle or the "angle".
    """

    exact_phases: tuple[Phase, ...]
    step_phases: tuple[Phase, ...]
    has_q_before_step: bool = True
    slack: float = 0.0
    thumb_weight: float = 1.0
    normals: str = "chord"


HIERARCHY = Promise((Phase.HIERARCHY,), (Phase.HIERARCHY,))
ENHANCED = Promise((Phase.THUMB_REACHING, Phase.HAND_ALIGNMENT), (Phase.THUMB_REACHING,))
PROMISES = {
    "hand-first": Promise((Phase.REFINEMENT,), (Phase.REFINEMENT, Phase.HAND_FIT)),
    "thumb-first": Promise(
        (Phase.CANDIDATE, Phase.HAND_ALIGNMENT),
        (Phase.HAND_ALIGNMENT,),
        has_q_before_step=False,
        thumb_weight=4.0,
        normals="angle",
    ),
    "enhanced-dls": ENHANCED,
    "enhanced-sdls": ENHANCED,
    "original-dls": HIERARCHY,
    "original-sdls": HIERARCHY,
    "ipopt": Promise((Phase.WHOLE_SYSTEM,), (Phase.WHOLE_SYSTEM,), slack=1e-6),
}


def check_trace(robot: ik.ArmHand, block: SolveBlock) -> None:
    """Check the trace of a block.

    Raises:
        AssertionError: A value of the trace is wrong.
    """
    promise, names = PROMISES[block.method], block.format.layout.names
    _check_errors(robot, block, promise)
    _check_step(block, promise)
    _check_limits(robot, block, promise)
    _check_phases(block)
    _check_status(block)
    if COST.name in names:
        _check_cost(block, promise)
    if RESTART.name in names:
        _check_restarts(block)
    if ACCEPTED.name in names:
        _check_accepted(block, promise)
    if ACTIVE_MASK.name in names:
        _check_active(block)


def _solves(block: SolveBlock) -> Iterator[tuple[int, np.ndarray]]:
    ends = np.cumsum(block.batch.iterations)
    for row, (end, count) in enumerate(zip(ends, block.batch.iterations, strict=True)):
        yield row, block.rows[end - count : end]


def _of_solve(block: SolveBlock) -> NDArray[np.int64]:
    return np.repeat(np.arange(len(block)), block.batch.iterations)


def _in(block: SolveBlock, phases: tuple[Phase, ...]) -> NDArray[np.bool_]:
    return np.isin(block.rows[PHASE.name], [int(phase) for phase in phases])


def _check_errors(robot: ik.ArmHand, block: SolveBlock, promise: Promise) -> None:
    """Check that distances and angles are those of the row's q."""
    in_promise = _in(block, promise.exact_phases)
    assert in_promise.any()
    rows, of_solve = block.rows[in_promise], _of_solve(block)[in_promise]
    points, normals = robot.contacts(rows[Q.name].astype(float))
    goal = block.targets.points[of_solve], block.targets.normals[of_solve]
    distance = np.linalg.norm(points - goal[0], axis=2)
    sine = np.linalg.norm(np.cross(normals, goal[1]), axis=2)
    angle = np.arctan2(sine, np.sum(normals * goal[1], axis=2))
    np.testing.assert_allclose(rows[POSITION_ERROR.name], distance, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(rows[ANGLE_ERROR.name], angle, rtol=1e-4, atol=1e-6)


def _pairs(block: SolveBlock, phases: tuple[Phase, ...]) -> NDArray[np.intp]:
    """Return the rows whose successor has the same solve, phase and start."""
    of_solve, phase = _of_solve(block), block.rows[PHASE.name]
    same_phase = (
        (of_solve[1:] == of_solve[:-1]) & (phase[1:] == phase[:-1]) & _in(block, phases)[1:]
    )
    if RESTART.name in block.format.layout.names:
        restart = block.rows[RESTART.name]
        same_phase &= restart[1:] == restart[:-1]
    return np.flatnonzero(same_phase)


def _check_step(block: SolveBlock, promise: Promise) -> None:
    """Check that the length of an accepted step is the distance between two rows."""
    pairs = _pairs(block, promise.step_phases)
    assert len(pairs)
    step_rows = pairs if promise.has_q_before_step else pairs + 1
    max_steps = np.abs(block.rows[Q.name][pairs + 1] - block.rows[Q.name][pairs]).max(axis=1)
    size = block.rows[STEP_SIZE.name][step_rows]
    is_checked = np.ones(len(pairs), dtype=bool)
    if ACCEPTED.name in block.format.layout.names:
        is_checked = block.rows[ACCEPTED.name][step_rows] > 0
    assert is_checked.any()
    np.testing.assert_allclose(size[is_checked], max_steps[is_checked], rtol=1e-4, atol=1e-9)


def _check_limits(robot: ik.ArmHand, block: SolveBlock, promise: Promise) -> None:
    """Check the bits of the actuators at or beyond a limit."""
    q = block.rows[Q.name]
    at = (q <= robot.lower + promise.slack) | (q >= robot.upper - promise.slack)
    assert at.any()
    np.testing.assert_array_equal(_bits(block.rows[LIMIT_MASK.name], q.shape[1]), at)


def _bits(mask: np.ndarray, count: int) -> NDArray[np.bool_]:
    words = np.atleast_2d(mask.T).T
    bits = [words[:, i // 32] >> np.uint32(i % 32) & 1 for i in range(count)]
    return np.stack(bits, axis=1).astype(bool)


def _check_phases(block: SolveBlock) -> None:
    """Check that each phase has as many rows as the solve counts."""
    codes = {phase.label: int(phase) for phase in Phase}
    for row, rows in _solves(block):
        for label, counts in block.batch.phases.items():
            assert np.sum(rows[PHASE.name] == codes[label]) == counts[row], (row, label)


def _check_status(block: SolveBlock) -> None:
    """Check that the last row has the final status, and that no earlier row is solved."""
    status_rows = 0
    for row, rows in _solves(block):
        ended = Status(int(block.batch.status[row]))
        if ended is Status.SOLVED:
            assert rows[STATUS.name][-1] == Status.SOLVED
            status_rows += 1
        assert not np.any(rows[STATUS.name][:-1] == Status.SOLVED)
    assert status_rows


def _check_cost(block: SolveBlock, promise: Promise) -> None:
    """Check that the cost is the sum of squares, or larger while the hand is fitted."""
    position, angle = block.rows[POSITION_ERROR.name], block.rows[ANGLE_ERROR.name]
    is_known = ~np.isnan(position).any(axis=1)
    assert is_known.any()
    # The cost is recorded exactly where errors are measured.
    np.testing.assert_array_equal(np.isnan(block.rows[COST.name]), ~is_known)
    normal_error = angle if promise.normals == "angle" else 2 * np.sin(angle / 2)
    squares = (position / LENGTH) ** 2 + normal_error**2
    squares[:, block.fingers.index("thumb")] *= promise.thumb_weight
    cost, square_sum = block.rows[COST.name], squares.sum(axis=1)
    in_promise = is_known & _in(block, promise.exact_phases)
    np.testing.assert_allclose(cost[in_promise], square_sum[in_promise], rtol=1e-3, atol=1e-12)
    # The fit of a hand also includes the distance of the palm from the reach of the arm.
    assert (cost[is_known] >= (1 - 1e-3) * square_sum[is_known] - 1e-12).all()


def _check_restarts(block: SolveBlock) -> None:
    """Check that restarts are numbered from 0 by one, up to the number of the solve."""
    assert block.batch.restarts.any()
    for row, rows in _solves(block):
        steps = np.diff(rows[RESTART.name].astype(int), prepend=0)
        assert np.isin(steps, (0, 1)).all(), row
        # A failed solve has a row beyond its last start.
        final_row = int(rows[STATUS.name][-1] == Status.STALLED)
        assert (
            block.batch.restarts[row]
            <= rows[RESTART.name][-1]
            <= block.batch.restarts[row] + final_row
        )


def _check_accepted(block: SolveBlock, promise: Promise) -> None:
    """Check that an accepted step moves the robot, reduces the cost and the damping."""
    pairs = _pairs(block, promise.step_phases)
    step_rows = pairs if promise.has_q_before_step else pairs + 1
    is_accepted = block.rows[ACCEPTED.name][step_rows] > 0
    assert is_accepted.any()
    assert not is_accepted.all()
    has_moved = np.any(block.rows[Q.name][pairs + 1] != block.rows[Q.name][pairs], axis=1)
    np.testing.assert_array_equal(has_moved, is_accepted)
    cost = block.rows[COST.name]
    np.testing.assert_array_equal(cost[pairs + 1] < cost[pairs], is_accepted)
    damping = block.rows[DAMPING.name]
    assert (
        damping[pairs[~is_accepted] + 1] > damping[pairs[~is_accepted]]
    ).all() or not promise.has_q_before_step
    assert (damping[step_rows] > 0).all()


def _check_active(block: SolveBlock) -> None:
    """Check that a joint that reaches its limit is marked as active."""
    n = block.rows[Q.name].shape[1]
    at = _bits(block.rows[LIMIT_MASK.name], n)
    is_active = _bits(block.rows[ACTIVE_MASK.name], n)
    pairs = _pairs(block, PROMISES[block.method].step_phases)
    come = at[pairs + 1] & ~at[pairs]
    assert come.any()
    assert is_active[pairs + 1][come].all()
    # A joint that leaves a limit is not active.
    is_accepted = block.rows[ACCEPTED.name][pairs + 1] > 0
    released = at[pairs] & ~at[pairs + 1]
    assert not is_active[pairs + 1][is_accepted][released[is_accepted]].any()
