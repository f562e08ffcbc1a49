"""A part of a batch, solved: what the method came to, judged, and as it is recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.answers.recorder import Recorder, SolveBlock
from casadi_ik.answers.solution import BatchSolution
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status
from casadi_ik.problem.trace import TraceFormat
from casadi_ik.problem.verdict import judge


@dataclass(frozen=True, eq=False)
class SolvedPart:
    """A part of a batch, solved.

    Attributes:
        problems: Its targets.
        starts: (k, n) where they were begun.
        started: When it was begun, since the Unix epoch [ns].
        outcome: What the method came to.
        batch: The same, judged.
        around: What the answers were checked against; None: nothing.
    """

    problems: Problems
    starts: Array
    started: int
    outcome: Outcome
    batch: BatchSolution
    around: Surroundings | None = None

    def record(self, recorder: Recorder, form: TraceFormat, seed: int) -> None:
        """Hand it on with its iterations, if they were kept."""
        if self.outcome.rows is None:
            return
        batch = self.batch
        before = np.concatenate([[0.0], np.cumsum(batch.time)[:-1]])[: len(batch)]
        block = SolveBlock(
            format=form,
            first=self.problems.first_row,
            problems=self.problems,
            starts=self.starts,
            seed=seed,
            batch=batch,
            rows=self.outcome.rows,
            started=self.started + (before * 1e9).astype(np.int64),
            around=self.around,
        )
        recorder.record(block)


def judged(
    robot: ArmHand,
    method: str,
    problems: Problems,
    outcome: Outcome,
    around: Surroundings | None = None,
) -> BatchSolution:
    """An outcome with the verdict on it, which has the last word on what is solved.

    Args:
        robot: The robot.
        method: Name of the method.
        problems: The targets.
        outcome: What the method came to.
        around: What the answers must not touch; None: nothing is checked.
    """
    verdict = judge(robot, problems, outcome.q)
    success, palm = verdict.solved(problems.enforce_limits), verdict.palm
    clear = None if around is None else around.check(outcome.q)
    touching = None if clear is None else success & ~clear.free
    if clear is not None:
        success = success & clear.free
    status, content = outcome.status, outcome.status == Status.SOLVED
    if (content != success).any():
        # A method that is content with what the verdict refuses has come to a standstill.
        status = np.where(content, int(Status.STALLED), status)
        status[success] = Status.SOLVED
        if touching is not None:
            status[touching] = Status.COLLISION
    return BatchSolution(
        success=success,
        status=status,
        q=outcome.q,
        iterations=outcome.iterations,
        restarts=outcome.restarts,
        time=outcome.time,
        position_error=verdict.position_error,
        angle_error=verdict.angle_error,
        ok=verdict.ok,
        limits_ok=verdict.limits_ok,
        phases=outcome.phases,
        tolerances=problems.tolerances,
        fingers=robot.fingers,
        method=method,
        robot=robot.name,
        actuators=robot.actuators,
        clearance=None if clear is None else clear.distance,
        closest=() if clear is None else tuple(map(clear.pair, range(len(outcome.q)))),
        collisions=() if clear is None else (None,) * len(outcome.q),
        palm_position_error=None if palm is None else palm.position_error,
        palm_angle_error=None if palm is None else palm.angle_error,
        palm_ok=None if palm is None else palm.ok,
    )
