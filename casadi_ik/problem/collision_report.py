"""What can be said about a grasp whose answers all touch something."""

from __future__ import annotations

from dataclasses import dataclass

Pair = tuple[str, str]


@dataclass(frozen=True)
class CollisionReport:
    """Why no answer is free.

    Attributes:
        pair: The pair that is in the way in the best answer: two links, or a link and a solid.
        short: By how much they are nearer than they have to be [m].
        tried: Answers (hands, arms, elbows) that were looked at.
        without_scene: Whether one of them is free of the robot itself, the scene left out.
        without_self: Whether one of them is free of the scene, the robot itself left out.
    """

    pair: Pair
    short: float
    tried: int
    without_scene: bool
    without_self: bool

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
        return tuple(lines)
