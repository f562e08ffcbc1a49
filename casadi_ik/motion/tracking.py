"""Following a path of grasps that is known beforehand: without a jump where that can be."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array, Bools
from casadi_ik.motion.clear_between import between
from casadi_ik.motion.path import Jump, Path
from casadi_ik.motion.walker import Walker
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge
from casadi_ik.solving.engine import Engine

STARTS = 8
"""Solutions of the first grasp that the motion may begin with."""


@dataclass(frozen=True, eq=False)
class Track:
    """A motion along k grasps.

    Attributes:
        q: (k, n) actuator positions [rad or m].
        success: (k,) whether the contacts are met (within limits, unless they are ignored), and
            nothing is too near where the solver has a scene.
        position_error: (k, f) [m], NaN where free.
        angle_error: (k, f) [rad], NaN where free.
        jumps: Where the motion could not be continued.
        clearance: (k,) distance of the pair nearest to being too near [m]; None without a scene.
        free_between: (k - 1,) whether nothing is too near all along the straight way from each
            posture to the next; not where the motion jumps. None without a scene.
        time: Seconds spent on the whole motion.

    Example:
        >>> track = solver.track([grasp, grasp])
        >>> track.q.shape, bool(track.success.all())
        ((2, 14), True)
    """

    q: Array
    success: NDArray[np.bool_]
    position_error: Array
    angle_error: Array
    jumps: tuple[Jump, ...]
    clearance: Array | None
    free_between: Bools | None
    time: float

    def __len__(self) -> int:
        return len(self.q)


def track(
    engine: Engine,
    problems: Problems,
    q0: Array,
    prefer: str,
    walker: Walker,
    travel: Array | None,
    seed: int,
) -> Track:
    """Follow k grasps of the same kinds.

    The motion begins with the best solution of the first grasp from which all others are reached
    without a jump; if there is none, with the one that misses the fewest and then jumps least.

    Args:
        engine: Hand-first on the robot, for the kinds of the grasps.
        problems: The grasps in order.
        q0: (n,) where the robot is.
        prefer: How the solutions of the first grasp are ranked, see `PREFERENCES`.
        walker: Goes along them.
        travel: (n,) how far every motor may move from one grasp to the next; None: any distance.
            Where motors are too slow they run after the motion that they cannot keep up with.
        seed: Of the starts of arms without a closed form.

    Raises:
        UnsupportedError: The method is not hand-first.
    """
    begin = time.perf_counter()
    around = engine.around(problems)
    path = Path(engine, problems, seed, walker, around)
    best: tuple[Array, list[Jump]] | None = None
    least = (np.inf, np.inf)
    for start in _starts(engine, problems, q0, prefer, seed, around):
        q, jumps = path.follow(start)
        missed = int((~_solved(engine.robot, problems, q, around)).sum())
        if around is not None and not missed:
            # A way between two postures that touches something counts as one missed.
            missed += int((~_free_between(around, q, jumps)).sum()) - len(jumps)
        if (missed, len(jumps)) < least:
            best, least = (q, jumps), (missed, len(jumps))
        if least[1] == 0 and (least[0] == 0 or least[0] <= path.unreachable):
            break
    assert best is not None
    q, jumps = best
    if travel is not None:
        q = _run_after(q, travel)
    verdict = judge(engine.robot, problems, q)
    return Track(
        q=q,
        success=_solved(engine.robot, problems, q, around),
        position_error=verdict.position_error,
        angle_error=verdict.angle_error,
        jumps=tuple(jumps),
        clearance=None if around is None else around.check(q).distance,
        free_between=None if around is None else _free_between(around, q, jumps),
        time=time.perf_counter() - begin,
    )


def _free_between(around: Surroundings, q: Array, jumps: Sequence[Jump]) -> Bools:
    """(k - 1,) of postures (k, n) whether the ways between them are free; jumps are no ways."""
    reached = np.array([jump.index for jump in jumps], dtype=np.intp)
    free = np.ones(max(len(q) - 1, 0), dtype=bool)
    free[reached - 1] = False
    ends = np.flatnonzero(np.append(~free, True)) + 1
    first = 0
    for end in ends.tolist():
        rows = np.arange(first, end)
        free[first : end - 1] = between(around.rows(rows), q[rows]).free
        first = end
    return free


def _starts(
    engine: Engine,
    problems: Problems,
    q0: Array,
    prefer: str,
    seed: int,
    around: Surroundings | None,
) -> Iterator[Array]:
    """Postures that the motion may begin with, the one that a solve gives first: it is quick."""
    first = problems.rows(slice(0, 1))
    here = None if around is None else around.rows(np.zeros(1, dtype=np.intp))
    q = engine.method.run(replace(first, prefer=prefer), q0[None], seed, trace=False).q
    solved = bool(_solved(engine.robot, first, q, here)[0])
    if solved:
        yield q[0]
    found = engine.finder.find(first, q0, seed, STARTS, prefer, apart=0, around=here)
    yield from (alternative.q for alternative in found)
    if not (found or solved):
        # Not to be solved: the nearest there is.
        yield q[0]


def _run_after(path: Array, travel: Array) -> Array:
    """Motors (k, n) that go straight to where the path (k, n) is, as far as they come."""
    q = path.copy()
    for i in range(1, len(q)):
        way = path[i] - q[i - 1]
        share = np.max(np.abs(way) / travel)
        if share > 1:
            q[i] = q[i - 1] + way / share
    return q


def _solved(
    robot: ArmHand, problems: Problems, q: Array, around: Surroundings | None
) -> NDArray[np.bool_]:
    solved = judge(robot, problems, q).solved(problems.enforce_limits)
    return solved if around is None else solved & around.free(q)
