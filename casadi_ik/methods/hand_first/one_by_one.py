"""Targets that go through their rounds one by one, in compiled code."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.kernels import LoopResult
from casadi_ik.methods.hand_first.one_target import OneTarget
from casadi_ik.methods.hand_first.rounds import RoundsPlan
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.method import Quick
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status

ALONE = 16
"""Targets left to a batch from which on they are solved one by one. What is done once a round in
Python outweighs that four would be solved side by side."""


class OneByOne:
    """Makes rounds of targets one after the other; bit for bit those of a batch."""

    def __init__(self, layouts: HandFirstLayouts, plan: Callable[[bool], RoundsPlan]) -> None:
        """Nothing is compiled before it is asked for.

        Args:
            layouts: Of the step.
            plan: All rounds, with limits enforced or not.
        """
        self._layouts, self._plan = layouts, plan
        self._ready: dict[tuple[bool, bool], list[OneTarget]] = {}

    def first(self, problems: Problems, q0: Array, terms: Array) -> Quick | None:
        """The first round of one target; see `QuickMethod.quick`."""
        with self._one_target(problems, whole=False) as one:
            self._ask(one, problems, 0, q0, terms)
            return one.quick(not one.more) if one() == Status.SOLVED else None

    def rest(
        self,
        problems: Problems,
        q0: Array,
        terms: Array,
        last: LoopResult,
        number: int,
        rounds: int,
    ) -> LoopResult:
        """All rounds from one on; see `LoopedMethod.finish`.

        Args:
            problems: k targets.
            q0: (k, n).
            terms: What `beginning` calls so, (t,) or (k, t).
            last: How the rounds before ended.
            number: The first of the rounds.
            rounds: How many there are with those before.
        """
        states, status = last.states.copy(), last.status.copy()
        iterations, seconds = np.zeros_like(last.iterations), np.zeros_like(last.time)
        every = np.broadcast_to(terms, (len(problems), terms.shape[-1]))
        with self._one_target(problems, whole=True) as one:
            for row in range(len(problems)):
                begun = time.perf_counter()
                self._ask(one, problems, row, q0[row], every[row])
                one.state[...] = states[row]
                ended = one.go_on(number, rounds)
                if ended is not None:
                    states[row], status[row] = one.state, ended
                    iterations[row] = one.iterations
                seconds[row] = time.perf_counter() - begun
        return LoopResult(states, iterations, status, seconds)

    @contextmanager
    def _one_target(self, problems: Problems, whole: bool) -> Iterator[OneTarget]:
        """Memory for one target at a time, of which there is one for every thread at work."""
        ready = self._ready.setdefault((problems.enforce_limits, whole), [])
        try:
            one = ready.pop()
        except IndexError:
            one = OneTarget(self._plan(problems.enforce_limits), whole)
        yield one
        ready.append(one)

    def _ask(self, one: OneTarget, problems: Problems, row: int, here: Array, terms: Array) -> None:
        one.points[...], one.normals[...] = problems.points[row], problems.normals[row]
        one.here[...], one.terms[...] = here, terms
        for vectors, name in zip(one.more, self._layouts.contacts.data[2:], strict=True):
            vectors[...] = problems.vectors(f"{name}s")[row]
