"""Which of many grasps to take, and how: answers in order, and why others have none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, overload

from casadi_ik.arrays import Array
from casadi_ik.grasps import Grasp
from casadi_ik.problem.solution import Solution


class Chosen(Protocol):
    """A posture that takes a grasp."""

    @property
    def grasp(self) -> Grasp:
        """In the base frame."""
        ...

    @property
    def q(self) -> Array:
        """(n,) the posture [rad or m]."""
        ...


@dataclass(frozen=True, eq=False)
class Choice:
    """One of the answers of a `Ranking`.

    Attributes:
        candidate: Number of the grasp among those that were given, from 0.
        solution: How to take it.
        score: What it was ranked by, higher is better: smallest distance of an actuator that is
            not given from its limits as a part of half its range ("limits"); minus the distance
            from q0, every actuator as a part of its range ("q0"); of the arm [m^3]
            ("manipulability"); room beyond the margins of the scene [m] ("clearance"); or what the
            given function says.
        grasp: The grasp, where the object is (base frame).

    Example:
        >>> best = solver.choose([grasp], prefer="limits")[0]
        >>> best.candidate, best.solution.success
        (0, True)
    """

    candidate: int
    solution: Solution
    score: float
    grasp: Grasp

    @property
    def q(self) -> Array:
        """(n,) the posture: what `Solver.reach` goes to."""
        return self.solution.q


@dataclass(frozen=True, eq=False)
class Ranking(Sequence[Choice]):
    """Answers to the question which of many grasps to take, best first.

    Attributes:
        entries: The answers; itself a sequence of them.
        candidates: How many grasps there were.
        answered: How many of them have an answer, in `entries` or not.
        failures: How many have none, by reason: the name of a `Status`, and of a COLLISION the pair
            that is in the way. Most frequent first.
        prefer: What they were ranked by.

    Example:
        >>> ranked = solver.choose([grasp, ik.load_grasp("apple")], limit=2, prefer="limits")
        >>> len(ranked), ranked.candidates, dict(ranked.failures)
        (2, 2, {})
        >>> print(ranked.lines[0])
        2 of 2 candidates have an answer
    """

    entries: tuple[Choice, ...]
    candidates: int
    answered: int
    failures: Mapping[str, int]
    prefer: str

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Choice]:
        return iter(self.entries)

    @overload
    def __getitem__(self, place: int) -> Choice: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Choice, ...]: ...

    def __getitem__(self, place: int | slice) -> Choice | tuple[Choice, ...]:
        return self.entries[place]

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        lines = [f"{self.answered} of {self.candidates} candidates have an answer"]
        lines += [f"  {count} have none: {reason}" for reason, count in self.failures.items()]
        if self.entries:
            lines.append(f"best {len(self)} by {self.prefer}:")
        for place, one in enumerate(self.entries, 1):
            clear = one.solution.clearance
            room = "" if clear is None else f", clearance {1e3 * clear:.1f} mm"
            lines.append(f"  {place}. candidate {one.candidate}: {one.score:.4g}{room}")
        return tuple(lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)
