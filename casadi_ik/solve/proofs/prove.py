"""The search for proofs: divides the box of all hands until every part of it is refuted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from casadi_ik.compile import FunctionKernel
from casadi_ik.files.arrays import Array, Bools, Counts, Rows
from casadi_ik.kinematics.contacts import CONDITIONS, PLACE
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.box_tests import BoxTest
from casadi_ik.solve.proofs.boxes import HandSpace
from casadi_ik.solve.proofs.premises import (
    NO_CONE,
    ArmCones,
    arm_cones,
    arm_span,
    endless_fingers,
    joint_limits,
    motor_box,
)
from casadi_ik.solve.proofs.proof import Proof, ProofKind


@dataclass(frozen=True)
class ProverEffort:
    """How long the search for a proof goes on; chosen with ``studies/proofs.py``.

    Attributes:
        first: Boxes of a target after which its first search, with all fingers, is given up.
        some: The same of searches with some of the fingers.
        most: The same of the last search, again with all fingers.
        alone: Boxes of each finger of a fixed hand, before any has more.
        pair: Boxes of two fingers, looked at first: what contradicts each other by much.
        one: Boxes of one finger, whose contact may be too far for the arm.
        subset: Fingers of more are looked at by so many, too: fewer motors to divide.
        chunk: Boxes that are looked at in one go: so many that calls cost little, few enough for
            a cache.
        together: Targets whose boxes are divided side by side.
        part: A coordinate is not divided any more where less is left of it than this part of the
            smallest tolerance [m].
    """

    first: int = 3000
    some: int = 3000
    most: int = 80_000
    alone: int = 200
    pair: int = 100
    one: int = 400
    subset: int = 3
    chunk: int = 4096
    together: int = 256
    part: float = 0.01


EFFORT = ProverEffort()

SLIDING = {
    f"{name}s"
    for condition in CONDITIONS.values()
    if condition.aspect == PLACE
    for name in condition.data
    if name != "point"
}
"""Arrays that let a contact be elsewhere than at its point: no proof counts such a finger."""

Boxes = tuple[Rows, Array, Array]
"""Numbers of targets, lower and upper ends (h,) of a box each."""


@dataclass(frozen=True, eq=False)
class _Found:
    """The results of k searches: whether proved, boxes, and whether the arm was needed."""

    proved: Bools
    boxes: Counts
    reach: Bools


class Prover:
    """Looks for proofs of impossibility on one robot.

    Attributes:
        space: The coordinates whose box is divided.
    """

    def __init__(self, robot: RobotDescription, compiled: bool = True) -> None:
        """Keep the robot; the test is built when it is first needed."""
        self._robot = robot
        self._compiled = compiled
        self.space = HandSpace(robot)
        self._arm = arm_span(robot)

    def prove(
        self, targets: TargetBatch, holding: Array | None = None, most: Counts | None = None
    ) -> list[Proof | None]:
        """Proofs of k targets, None where none was found.

        No proof says nothing: neither that a target can be reached nor that it cannot.

        Args:
            targets: The targets.
            holding: (k, h) coordinates of hands (`HandSpace`) that reach them. Only boxes that
                hold these are looked at: what comes out as proved would be proved wrongly, and
                whatever would be proved wrongly comes out, in a fraction of the time.
            most: (k,) boxes of a target after which it is given up, if not before.
        """
        found: list[Proof | None] = []
        for start in range(0, len(targets), EFFORT.together):
            some = slice(start, start + EFFORT.together)
            known = None if holding is None else holding[some]
            bound = np.full(len(targets), EFFORT.most)[some] if most is None else most[some]
            found += self._together(targets.rows(some), known, bound)
        return found

    def _together(
        self, targets: TargetBatch, holding: Array | None, bound: Counts
    ) -> list[Proof | None]:
        known = ~np.isnan(targets.points[:, :, 0])
        for name in SLIDING & targets.more.keys():
            # Anywhere on a line or a plane: the point itself need not be reached.
            known &= np.isnan(targets.more[name][..., 0])
        known &= ~np.array(endless_fingers(self._robot, motor_box(self._robot, targets)))
        proofs: list[Proof | None] = [None] * len(targets)
        for group, most in self._groups():
            chosen = np.zeros(known.shape[1], dtype=bool)
            chosen[group] = True
            asked = known & chosen
            still = np.array([proof is None for proof in proofs])
            rows = np.flatnonzero(still & asked.any(axis=1))
            if not len(rows):
                continue
            kept = None if holding is None else holding[rows]
            boxes = np.minimum(most, bound[rows])
            result = self._search(targets.rows(rows), asked[rows], boxes, kept)
            for place in np.flatnonzero(result.proved).tolist():
                row = int(rows[place])
                kind = ProofKind.REACH if result.reach[place] else ProofKind.HAND
                names = (self._robot.finger_names[i] for i in np.flatnonzero(asked[row]))
                proofs[row] = Proof(
                    kind=ProofKind.FINGER if self._arm is None else kind,
                    fingers=tuple(names),
                    boxes=int(result.boxes[place]),
                    tolerance=targets.tolerances,
                    target=targets.rows(slice(row, row + 1)),
                ).sealed()
        return proofs

    def _groups(self) -> list[tuple[list[int], int]]:
        """Fingers that may contradict each other, and boxes; of a fixed hand each by itself."""
        fingers = list(range(len(self._robot.fingers)))
        if self._arm is None:
            # One that reaches its contact must not take all the time before the one that does not.
            return [([i], most) for most in (EFFORT.alone, EFFORT.most) for i in fingers]
        # Few fingers that contradict each other say more than all of them.
        alone = [[[i] for i in fingers], list(map(list, combinations(fingers, 2)))]
        few = [
            (group, most)
            for groups, most in zip((*alone, alone[0]), (1, EFFORT.pair, EFFORT.one), strict=True)
            for group in groups
            if len(group) < len(fingers)
        ]
        if len(fingers) <= EFFORT.subset:
            return [*few, (fingers, EFFORT.most)]
        subsets = [(list(some), EFFORT.some) for some in combinations(fingers, EFFORT.subset)]
        return [*few, (fingers, EFFORT.first), *subsets, (fingers, EFFORT.most)]

    @cached_property
    def _test(self) -> FunctionKernel:
        return FunctionKernel(BoxTest(self.space, self._arm, self._cones).graph(), self._compiled)

    @cached_property
    def _cones(self) -> ArmCones | None:
        cones = arm_cones(self._robot)
        if cones is None or self._arm is None:
            return None
        same = np.allclose(cones.shoulder, self._arm.shoulder, rtol=0, atol=1e-9)
        return cones if same and np.allclose(cones.wrist, self._arm.wrist, 0, 1e-9) else None

    def _search(
        self, targets: TargetBatch, fingers: Bools, most: Counts, holding: Array | None
    ) -> _Found:
        """Divide the boxes of k targets, some of them a level deeper in each pass.

        Args:
            targets: The targets.
            fingers: (k, f) which contacts count.
            most: (k,) boxes of a target after which it is given up.
            holding: (k, h) see `prove`.
        """
        count = len(targets)
        points = np.where(fingers[..., None], targets.points, 0.0)
        faced = fingers & ~np.isnan(targets.normals[:, :, 0])
        normals = np.where(faced[..., None], targets.normals, 0.0)
        asked = np.stack([fingers, faced], axis=2).astype(float)
        tolerance = np.stack([targets.position_tolerance, targets.angle_tolerance], axis=1)
        finest = max(1e-9, EFFORT.part * float(targets.position_tolerance.min()))
        # A kernel's column is a vector: of a hand with one motor there is no second dimension.
        size, ends = self._test.input_shapes[0], self._test.input_shapes[2]
        limits = [np.reshape(end, ends) for end in joint_limits(self._robot, targets)]
        arm = np.zeros(2), np.full(2, NO_CONE)
        if self._arm is not None:
            cosines = arm[1] if self._cones is None else self._cones.cosines(targets)
            arm = np.array(self._arm.span(targets)), cosines
        lower, upper = (np.tile(end, (count, 1)) for end in self.space.box(targets))
        waiting: list[Boxes] = [(np.arange(count), lower, upper)]
        boxes = np.zeros(count, dtype=np.int64)
        given_up, reach = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        while waiting:
            target, lower, upper = waiting.pop()
            wanted = ~given_up[target]
            target, lower, upper = target[wanted], lower[wanted], upper[wanted]
            boxes += np.bincount(target, minlength=count)
            refuted, scores = self._test(
                *(end.reshape(len(end), *size) for end in (lower, upper)),
                *(*limits, points[target], normals[target]),
                *(tolerance, asked[target], *arm),
            )
            refuted, scores = refuted > 0, scores.reshape(lower.shape)
            reach[target[refuted[:, 1] & ~refuted[:, 0]]] = True
            if not lower.shape[1]:  # a tool has no postures to divide
                given_up[target[~refuted.any(axis=1)]] = True
                continue
            widest = scores.argmax(axis=1)
            rows = np.arange(len(target))
            tiny = (upper - lower)[rows, widest] < finest
            tiny |= scores[rows, widest] <= 0
            left = ~refuted.any(axis=1)
            given_up[target[left & tiny]] = True
            given_up |= boxes > most
            left = np.flatnonzero(left & ~given_up[target])
            halves = _halves(target[left], lower[left], upper[left], widest[left])
            if holding is not None:
                known = holding[halves[0]]
                inside = ((halves[1] <= known) & (known <= halves[2])).all(axis=1)
                halves = halves[0][inside], halves[1][inside], halves[2][inside]
            waiting += _parts(*halves)
        return _Found(~given_up, boxes, reach)


def _halves(target: Rows, lower: Array, upper: Array, widest: Rows) -> Boxes:
    """Boxes divided amid their widest coordinates."""
    rows = np.arange(len(target))
    middle = (lower[rows, widest] + upper[rows, widest]) / 2
    lower, upper = np.concatenate([lower, lower]), np.concatenate([upper, upper])
    upper[rows, widest] = middle
    lower[len(rows) + rows, widest] = middle
    return np.concatenate([target, target]), lower, upper


def _parts(target: Rows, lower: Array, upper: Array) -> Iterator[Boxes]:
    """Boxes in parts that are looked at together."""
    for start in range(0, len(target), EFFORT.chunk):
        some = slice(start, start + EFFORT.chunk)
        yield target[some], lower[some], upper[some]
