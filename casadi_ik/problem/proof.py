"""A proof that a target is impossible: what was proved, of what, and a way to check it again."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.contact_quantities import Quantity
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.proof_check import holds


class ProofKind(StrEnum):
    """What contradicts what."""

    FINGER = "a finger of the fixed hand comes nowhere near its contact"
    HAND = "no posture of the hand fits the contacts, wherever the palm is"
    REACH = "every posture of the hand that may fit puts the wrist out of the arm's reach"


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
        seal: Of all the others, see `sealed`.
    """

    kind: ProofKind
    fingers: tuple[str, ...]
    quantities: tuple[Quantity, ...]
    boxes: int
    tolerance: tuple[Tolerance, ...]
    target: Problems = field(repr=False)
    seal: str = field(default="", repr=False)

    def sealed(self) -> Proof:
        """The same with a seal by which `check` sees whether something was changed since."""
        return replace(self, seal=self._seal())

    def _seal(self) -> str:
        parts = (self.kind.name, self.fingers, self.quantities, self.boxes, self.tolerance)
        digest = hashlib.sha256(repr(parts).encode())
        for array in (self.target.points, self.target.normals):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return digest.hexdigest()[:32]

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

    @property
    def lines_of_palm(self) -> tuple[str, ...]:
        """The same where a palm was asked for, with the hand as it is."""
        if self.kind is ProofKind.REACH:
            return ("proved: the palm has the wrist where the arm does not reach",)
        return (f"proved: {self.kind}",)

    def check(self, robot: ArmHand, target: Problems | None = None) -> bool:
        """Prove it again by other means: whether the proof holds and says what it said.

        The seal is compared, every quantity computed anew from the robot's description, and the
        hand's postures are divided anew with another arithmetic, in numpy and not compiled, in
        boxes as fine as it takes. Takes up to some seconds, of hard targets up to a minute.

        Args:
            robot: The robot.
            target: One target that the proof has to be about; None: the one it names.
        """
        return self.seal == self._seal() and holds(self, robot.description, target)
