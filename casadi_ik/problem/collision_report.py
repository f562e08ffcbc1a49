"""What can be said about a grasp whose answers all touch something."""

from __future__ import annotations

import math
from dataclasses import dataclass

Pair = tuple[str, str]


@dataclass(frozen=True)
class WayOut:
    """What else would do, as far as it was tried.

    Attributes:
        moved: Translation of what is grasped, with its contacts, for which there is a free answer,
            base frame [m]: the shortest of those tried, at which the object itself stands free;
            None: none of them has one.
        farthest: How far it was moved at the most [m].
        fewer: Fingers without whose contact there is a free answer.
    """

    moved: tuple[float, float, float] | None
    farthest: float
    fewer: tuple[str, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        lines = [f"solvable without the contact of {name}" for name in self.fewer]
        if self.moved is None:
            far = f"{1e3 * self.farthest:.0f} mm"
            return (*lines, f"the object moved by up to {far} in 26 directions does not help")
        way = ", ".join(f"{1e3 * value + 0.0:.0f}" for value in self.moved)
        length = 1e3 * math.hypot(*self.moved)
        return (*lines, f"solvable with the object moved by {length:.0f} mm: ({way}) mm")


@dataclass(frozen=True)
class CollisionReport:
    """Why no answer is free.

    Attributes:
        pair: The pair that is in the way in the best answer: two links, or a link and a solid.
        short: By how much they are nearer than they have to be [m].
        tried: Answers (hands, arms, elbows) that were looked at.
        without_scene: Whether one of them is free of the robot itself, the scene left out; None if
            that was not looked at: it is where a diagnosis is asked for.
        without_self: Whether one of them is free of the scene, the robot itself left out, or None.
        way_out: What else would do; None if that was not looked for: it is where one grasp is
            solved and a diagnosis asked for.

    Example:
        >>> wall = {"kind": "box", "size": [3, 3, 3], "xyz": [-1.8, 0, 1.0]}  # the cup is inside
        >>> blocked = ik.Solver(robot, scene=ik.Scene({"wall": wall})).solve(grasp)
        >>> blocked.status.name, "wall" in blocked.collision.pair
        ('COLLISION', True)
    """

    pair: Pair
    short: float
    tried: int
    without_scene: bool | None
    without_self: bool | None
    way_out: WayOut | None = None

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        answers = "the answer touches" if self.tried == 1 else f"all {self.tried} answers touch"
        lines = [
            f"contacts and limits are met, but {answers} something",
            f"best answer: {self.pair[0]} and {self.pair[1]}, {1e3 * self.short:.3g} mm too near",
        ]
        if self.without_scene:
            lines.append("solvable without the scene")
        if self.without_self:
            lines.append("solvable if the robot could pass through itself")
        return tuple(lines) if self.way_out is None else (*lines, *self.way_out.lines)
