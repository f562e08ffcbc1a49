"""Proofs that a target is impossible."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.check import Refutation
from casadi_ik.solve.proofs.premises import required_points


class ProofKind(StrEnum):
    """Kind of contradiction that a proof shows."""

    FINGER = "a finger of the fixed hand cannot reach its contact"
    HAND = "no posture of the hand fits the contacts, wherever the palm is"
    REACH = "every posture of the hand that may fit puts the wrist out of the arm's reach"


@dataclass(frozen=True, eq=False)
class Proof:
    """Proof that a target is impossible, by guaranteed bounds.

    Boxes cover the postures of the hand. In each box a bound of quantities that palm motions
    preserve (distances, angles, heights, the best rigid fit) or of the wrist position excludes the
    target, including tolerances and rounding errors.

    Attributes:
        kind: Kind of contradiction.
        fingers: Fingers whose contacts are contradictory; the proof does not use other fingers.
        boxes: Number of boxes that cover the postures of the hand; 1 if they were not divided.
        tolerance: Tolerances by finger within which the target is impossible; at least those of
            the target.
        target: Target that is proved impossible, one row.
        seal: Hash of the other fields, see `sealed`.
    """

    kind: ProofKind
    fingers: tuple[str, ...]
    boxes: int
    tolerance: tuple[Tolerance, ...]
    target: TargetBatch = field(repr=False)
    seal: str = field(default="", repr=False)

    def sealed(self) -> Proof:
        """Return a copy with a seal, by which `check` detects changes of the fields."""
        return replace(self, seal=self._seal())

    def _seal(self) -> str:
        parts = (self.kind.name, self.fingers, self.boxes, self.tolerance)
        digest = hashlib.sha256(repr(parts).encode())
        extra_vectors = (array for _, array in sorted(self.target.extra_vectors.items()))
        for array in (self.target.points, self.target.normals, *extra_vectors):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return digest.hexdigest()[:32]

    @property
    def lines(self) -> tuple[str, ...]:
        """Description of the proof in short lines."""
        fingers = ", ".join(self.fingers)
        scope = "at once" if self.boxes == 1 else f"in each of {self.boxes} parts of its postures"
        return (f"proved for {fingers} {scope}: {self.kind}",)

    @property
    def lines_of_palm(self) -> tuple[str, ...]:
        """Description of the proof for a target with a palm pose and a fixed hand posture."""
        if self.kind is ProofKind.REACH:
            return ("proved: the palm has the wrist where the arm does not reach",)
        return (f"proved: {self.kind}",)

    def check(self, robot: ArmHand, target: TargetBatch | None = None) -> bool:
        """Return True if the proof is unchanged and an independent check confirms it.

        The check compares the seal and bisects the box of hand postures with separate code in
        numpy (`proofs.check`). It takes several seconds, and up to a minute for hard targets.

        Args:
            robot: Robot of the proof.
            target: Single target that the proof must concern (default: the stored target).
        """
        description, side_target = robot.description, target
        for side in description.sides:
            # The proof of a multi-arm robot is a proof for one of its sides.
            if set(self.fingers) <= set(side.fingers):
                fingers = [robot.fingers.index(finger) for finger in side.fingers]
                side_target = None if target is None else target.for_part(fingers)
                description = description.side(side.name, with_trunk=True)
                break
        return self.seal == self._seal() and _is_confirmed(self, description, side_target)


def _is_confirmed(proof: Proof, robot: RobotDescription, target: TargetBatch | None) -> bool:
    """Return True if a proof concerns the target, is consistent and passes the check."""
    proved = proof.target
    if len(proved) != 1 or (target is not None and not _is_same_target(proved, target)):
        return False
    numbers = [
        robot.finger_names.index(name) for name in proof.fingers if name in robot.finger_names
    ]
    has_point = ~np.isnan(required_points(robot, proved)[0][0, :, 0])
    if len(numbers) != len(proof.fingers) or not numbers or not has_point[numbers].all():
        return False
    pairs = zip(proof.tolerance, proved.tolerances, strict=True)
    if any(p.position < a.position or p.angle < a.angle for p, a in pairs):
        return False
    relaxed = replace(proved, tolerance=tuple(proof.tolerance))
    return Refutation(robot, relaxed, numbers, proof.kind is ProofKind.REACH).succeeds()


def _is_same_target(a: TargetBatch, b: TargetBatch) -> bool:
    names = ("points", "normals", *sorted(a.extra_vectors.keys() | b.extra_vectors.keys()))
    arrays = ((a.vectors(name), b.vectors(name)) for name in names)
    fixed = [np.zeros(0) if item.fixed is None else item.fixed for item in (a, b)]
    return (
        all(np.array_equal(array_a, array_b, equal_nan=True) for array_a, array_b in arrays)
        and np.array_equal(fixed[0], fixed[1], equal_nan=True)
        and a.tolerances == b.tolerances
        and a.enforce_limits == b.enforce_limits
    )
