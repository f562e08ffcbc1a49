"""A proof that a target is impossible: what was proved, of what, and a way to check it again."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.proof_check import holds


class ProofKind(StrEnum):
    """What contradicts what."""

    FINGER = "a finger of the fixed hand comes nowhere near its contact"
    HAND = "no posture of the hand fits the contacts, wherever the palm is"
    REACH = "every posture of the hand that may fit puts the wrist out of the arm's reach"


@dataclass(frozen=True)
class Quantity:
    """What contacts keep however the palm is moved, or where the arm reaches.

    Attributes:
        name: What it is, with the fingers.
        unit: "m", "rad" or "".
        asked: Its value in the target.
        give: By how much the tolerances let it differ.
        lower: The smallest value that the robot can make; a guaranteed bound.
        upper: The largest.
    """

    name: str
    unit: str
    asked: float
    give: float
    lower: float
    upper: float

    @property
    def excess(self) -> float:
        """By how much it is out of what is possible, whatever the tolerances give; <= 0 within."""
        return max(self.lower - self.asked, self.asked - self.upper) - self.give


@dataclass(frozen=True, eq=False)
class Proof:
    """A proof of impossibility by guaranteed bounds.

    The hand's postures are covered by boxes, and in each of them a bound on what the contacts keep
    (distances, angles, heights, their best rigid fit) or on where the wrist comes to lie excludes
    the target, tolerances and rounding included.

    Attributes:
        kind: What contradicts what.
        fingers: The fingers whose contacts contradict each other; the others play no part.
        quantities: What these contacts keep, as asked and as possible at all; one whose `excess` is
            > 0 decides by itself.
        boxes: How many boxes cover the hand's postures, 1 if none had to be divided.
        tolerance: Within which the target is impossible, by finger; at least those asked for.
        target: The target that was proved impossible, one row.
    """

    kind: ProofKind
    fingers: tuple[str, ...]
    quantities: tuple[Quantity, ...]
    boxes: int
    tolerance: tuple[Tolerance, ...]
    target: Problems = field(repr=False)

    @property
    def deciding(self) -> tuple[Quantity, ...]:
        """Quantities that exclude the target by themselves, the clearest first."""
        found = [item for item in self.quantities if item.excess > 0]
        return tuple(sorted(found, key=lambda item: -item.excess / item.give))

    @property
    def lines(self) -> tuple[str, ...]:
        """What is proved, in short lines."""
        who = ", ".join(self.fingers)
        parts = "at once" if self.boxes == 1 else f"in each of {self.boxes} parts of its postures"
        return (f"proved for {who} {parts}: {self.kind}",)

    def check(self, robot: ArmHand, target: Problems | None = None) -> bool:
        """Prove it again by other means: whether the proof holds.

        Another arithmetic in numpy, not compiled, that shares nothing with the search but the
        robot's description; boxes as fine as it takes. Takes up to some seconds.

        Args:
            robot: The robot.
            target: One target that the proof has to be about; None: the one it names.
        """
        return holds(self, robot.description, target)
