"""Proves targets impossible: divides the box of all hands until every part of it is refuted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels import FunctionKernel
from casadi_ik.problem.arm_span import arm_span
from casadi_ik.problem.contacts.conditions import CONDITIONS, PLACE
from casadi_ik.problem.hand_motors import endless_fingers, joint_limits, motor_box
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.proof import Proof, ProofKind
from casadi_ik.robots.description import RobotDescription
from casadi_ik.solving.diagnosis.box_test import BoxTest
from casadi_ik.solving.diagnosis.hand_space import HandSpace
from casadi_ik.solving.diagnosis.wrist_bound import Wrist

MOST = 6000
"""Boxes of a target after which the search for a proof is given up."""

TOGETHER = 256
"""Targets whose boxes are divided side by side."""


SLIDING = {
    f"{name}s"
    for condition in CONDITIONS.values()
    if condition.aspect == PLACE
    for name in condition.data
    if name != "point"
}
"""Arrays that let a contact be elsewhere than at its point: no proof counts such a finger."""

TINY = 1e-9
"""A box whose contacts move by less than this is not divided any more [0.1 m, rad]."""


@dataclass(frozen=True, eq=False)
class _Found:
    """The results of k searches: whether proved, boxes, and whether the arm was needed."""

    proved: NDArray[np.bool_]
    boxes: NDArray[np.int64]
    reach: NDArray[np.bool_]


class Prover:
    """Looks for proofs of impossibility on one robot."""

    def __init__(self, robot: RobotDescription, compiled: bool = True) -> None:
        """Keep the robot; the test is built when it is first needed."""
        self._robot = robot
        self._compiled = compiled
        self._space = HandSpace(robot)
        self._arm = arm_span(robot)

    def prove(self, problems: Problems) -> list[Proof | None]:
        """Proofs of k targets, None where none was found.

        No proof says nothing: neither that a target can be reached nor that it cannot.
        """
        found: list[Proof | None] = []
        for start in range(0, len(problems), TOGETHER):
            found += self._together(problems.rows(slice(start, start + TOGETHER)))
        return found

    def _together(self, problems: Problems) -> list[Proof | None]:
        proofs: list[Proof | None] = [None] * len(problems)
        known = ~np.isnan(problems.points[:, :, 0])
        for name in SLIDING & problems.more.keys():
            # Anywhere on a line or a plane: the point itself need not be reached.
            known &= np.isnan(problems.more[name][..., 0])
        known &= ~np.array(endless_fingers(self._robot, motor_box(self._robot, problems)))
        for group in self._groups():
            chosen = np.zeros(known.shape[1], dtype=bool)
            chosen[group] = True
            asked = known & chosen
            still = np.array([proof is None for proof in proofs])
            rows = np.flatnonzero(still & asked.any(axis=1))
            if not len(rows):
                continue
            result = self._search(problems.rows(rows), asked[rows])
            for place in np.flatnonzero(result.proved).tolist():
                row = int(rows[place])
                proofs[row] = self._proof(problems, row, asked[row], result, place)
        return proofs

    def _groups(self) -> list[list[int]]:
        """Fingers that may contradict each other; of a fixed hand each by itself."""
        fingers = list(range(len(self._robot.fingers)))
        return [[i] for i in fingers] if self._arm is None else [fingers]

    def _proof(
        self, problems: Problems, row: int, asked: NDArray[np.bool_], found: _Found, place: int
    ) -> Proof:
        kind = ProofKind.REACH if found.reach[place] else ProofKind.HAND
        names: Sequence[str] = self._robot.finger_names
        return Proof(
            kind=ProofKind.FINGER if self._arm is None else kind,
            fingers=tuple(name for name, used in zip(names, asked.tolist(), strict=True) if used),
            quantities=(),
            boxes=int(found.boxes[place]),
            tolerance=problems.tolerances,
            target=problems.rows(slice(row, row + 1)),
        )

    @cached_property
    def _test(self) -> FunctionKernel:
        wrist = None if self._arm is None else Wrist(self._arm.shoulder, self._arm.wrist)
        return FunctionKernel(BoxTest(self._space, wrist).graph(), self._compiled)

    def _search(self, problems: Problems, fingers: NDArray[np.bool_]) -> _Found:
        """Divide the boxes of k targets, all of them a level deeper in each pass.

        Args:
            problems: The targets.
            fingers: (k, f) which contacts count.
        """
        count = len(problems)
        points = np.where(fingers[..., None], problems.points, 0.0)
        faced = fingers & ~np.isnan(problems.normals[:, :, 0])
        normals = np.where(faced[..., None], problems.normals, 0.0)
        asked = np.stack([fingers, faced], axis=2).astype(float)
        tolerance = np.stack([problems.position_tolerance, problems.angle_tolerance], axis=1)
        limits = joint_limits(self._robot, problems)
        span = np.zeros(2) if self._arm is None else np.array(self._arm.span(problems))
        lower, upper = (np.tile(end, (count, 1)) for end in self._space.box(problems))
        target, boxes = np.arange(count), np.zeros(count, dtype=np.int64)
        given_up, reach = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        while len(target):
            boxes += np.bincount(target, minlength=count)
            refuted, scores = self._test(
                *(lower, upper, *limits, points[target], normals[target]),
                *(tolerance, asked[target], span),
            )
            refuted = refuted > 0
            reach[target[refuted[:, 1] & ~refuted[:, 0]]] = True
            widest = scores.argmax(axis=1)
            rows = np.arange(len(target))
            tiny = scores[rows, widest] < TINY
            left = ~refuted.any(axis=1)
            given_up[target[left & tiny]] = True
            given_up |= boxes > MOST
            left = np.flatnonzero(left & ~given_up[target])
            target, lower, upper, widest = target[left], lower[left], upper[left], widest[left]
            rows = np.arange(len(target))
            middle = (lower[rows, widest] + upper[rows, widest]) / 2
            lower, upper = np.concatenate([lower, lower]), np.concatenate([upper, upper])
            upper[rows, widest] = middle
            lower[len(rows) + rows, widest] = middle
            target = np.concatenate([target, target])
        return _Found(~given_up, boxes, reach)
