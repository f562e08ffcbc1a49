"""The first round of hand-first for one target: the same kernels, on memory that is kept."""

from __future__ import annotations

from collections.abc import Callable

from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel, LoopKernel
from casadi_ik.methods.common.posture_table import PostureTable
from casadi_ik.methods.hand_first.state import STAGE_LABELS, HandFirstLayouts
from casadi_ik.problem.method import Quick
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status


class FirstRound:
    """Lookup, beginning and loop, chained by the arrays they share; not to be shared by threads.

    A call of a kernel costs microseconds for its arrays alone, which a batch pays once and a
    single solve every time.
    """

    def __init__(
        self,
        table: PostureTable,
        beginning: FunctionKernel,
        loop: LoopKernel,
        layouts: HandFirstLayouts,
        order: Callable[[Problems, Array, Array, bool], Array],
    ) -> None:
        """Lay the arrays out; all kernels must be compiled.

        Args:
            table: The hand postures.
            beginning: See `steps.hand_first_beginning`.
            loop: The loop.
            layouts: Of its step.
            order: See `HandFirstMethod.order`.
        """
        self._order = order
        self._postures = table.postures
        self._solve = loop.single()
        self._state = self._solve.result.states[0]
        self._more = [f"{name}s" for name in layouts.contacts.data[2:]]
        self._begin = beginning.single(outputs=[self._state, self._solve.parameters])
        self._lookup = table.lookup.single(layouts.candidates, self._begin.inputs[:2])
        fields = ("q", "candidate", "counts")
        self._q, self._candidate, self._counts = (
            self._state[layouts.state.slice(name)] for name in fields
        )

    def __call__(
        self, problems: Problems, q0: Array, terms: Array, max_iterations: int
    ) -> Quick | None:
        """Solve.

        Args:
            problems: One target.
            q0: (n,).
            terms: Of the beginning.
            max_iterations: Of the loop.
        """
        points, normals, *more, here, common, postures = self._begin.inputs
        postures = postures.reshape(-1, self._postures.shape[1])  # a view
        points[...], normals[...], here[...], common[...] = (
            problems.points[0],
            problems.normals[0],
            q0,
            terms,
        )
        for vectors, name in zip(more, self._more, strict=True):
            vectors[...] = problems.vectors(name)[0]
        self._lookup()
        postures[...] = self._postures[self._lookup.found[0]]
        if problems.prefer == "q0":
            postures[...] = self._order(problems, q0[None], postures[None], True)[0]
        self._begin()
        self._solve(max_iterations)
        if self._solve.result.status[0] != Status.SOLVED:
            return None
        counts = [int(count) for count in self._counts.tolist()]
        return Quick(
            self._q.copy(),
            sum(counts),
            int(self._candidate[0]),
            dict(zip(STAGE_LABELS, counts, strict=True)),
        )
