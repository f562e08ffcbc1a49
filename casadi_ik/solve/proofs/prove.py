"""Search for proofs of impossibility: bisect the box of all hand postures until all is refuted.

Every contact that a hand in a box can make lies in a ball (`proofs.boxes`), and every admissible
contact lies within the tolerances of the target. A box is refuted if no contacts of both kinds
satisfy the necessary conditions in `proofs.contact_tests`. A box that is not refuted may still
contain no solution.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import casadi as ca
import numpy as np

from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.files.arrays import Array, Bools, Counts, Rows
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.boxes import BoxContact, HandSpace, box_contacts
from casadi_ik.solve.proofs.contact_tests import (
    Inequality,
    cone_excess,
    pair_angles,
    pair_rows,
    palm_ball,
    rigid_excess,
    wrist_excess,
)
from casadi_ik.solve.proofs.premises import (
    NO_CONE_LIMIT,
    ArmCones,
    ArmSpan,
    arm_cones,
    arm_span,
    fingers_without_limits,
    joint_limits,
    motor_box,
    required_points,
)
from casadi_ik.solve.proofs.proof import Proof, ProofKind


@dataclass(frozen=True, eq=False)
class BoxTest:
    """Test of boxes of hand postures for one robot.

    Attributes:
        space: Coordinates of the hand.
        arm: Shoulder and wrist of the arm; None if the palm does not move.
        cones: Cones within the limits of shoulder and wrist; None for arms of another family.
    """

    space: HandSpace
    arm: ArmSpan | None
    cones: ArmCones | None

    def graph(self) -> FunctionGraph:
        """Return the graph of the test.

        Returns:
            ``(lower, upper, joint_lower, joint_upper, points, depths, normals, tolerance,
            constrained, span, cosines) -> (refuted, scores)``. Inputs: bounds of the coordinates
            (h,), limits of the finger joints (m,), required points (f, 3) and their depths (f,),
            normals (f, 3), tolerances of position and angle (f, 2), 1 where a point or normal is
            constrained (f, 2), smallest and largest distance of the wrist from the shoulder (2,),
            cosines of the arm's cones (2,). Outputs: values > 0 if the hand alone or the arm
            refutes the box (2,), and the contribution of each coordinate to the remaining
            uncertainty (h,).
        """
        robot = self.space.robot
        h, m, f = len(robot.finger_motors), len(robot.finger_joints), len(robot.fingers)
        shapes = {"lower": (h, 1), "upper": (h, 1), "joint_lower": (m, 1), "joint_upper": (m, 1)}
        shapes |= {"points": (f, 3), "depths": (f, 1), "normals": (f, 3)}
        shapes |= {"tolerance": (f, 2), "constrained": (f, 2)}
        shapes |= {"span": (2, 1), "cosines": (2, 1)}
        name = ca.Function.fix_name(f"{robot.name}_box_test")

        def build() -> ca.Function:
            symbols = {key: ca.SX.sym(key, *shape) for key, shape in shapes.items()}
            outputs = with_cse(*map(ca.densify, self._outputs(symbols)))
            return ca.Function(
                name, list(symbols.values()), outputs, list(shapes), ["refuted", "scores"]
            )

        arm_geometry: tuple[Array, ...] = (
            () if self.arm is None else (self.arm.shoulder, self.arm.wrist)
        )
        arm_geometry += () if self.cones is None else (self.cones.last,)
        graph_recipe = recipe(name, robot, arm_geometry)
        return FunctionGraph(name, build, shapes, ((2, 1), (h, 1)), graph_recipe)

    def _outputs(self, p: dict[str, ca.SX]) -> tuple[Expr, Expr]:
        ranges = self.space.intervals(p["lower"], p["upper"])
        half_widths = (p["upper"] - p["lower"]) / 2
        contacts = box_contacts(self.space, ranges, half_widths, p, self.arm is not None)
        hand_tests, arm_tests = [ca.SX(-1)], [ca.SX(-1)]
        for i, name in enumerate(self.space.robot.finger_joints):
            hand_tests.append(ranges[name].lower - p["joint_upper"][i])
            hand_tests.append(p["joint_lower"][i] - ranges[name].upper)
        rows: list[Inequality] = []
        if self.arm is None:
            hand_tests += [test for contact in contacts for test in contact.fixed_hand_tests()]
        else:
            for a, b in combinations(contacts, 2):
                rows += pair_rows(a, b)
                hand_tests += pair_angles(a, b)
            hand_tests += [ca.fabs(row.value) - row.width for row in rows]
            hand_tests.append(rigid_excess(contacts))
            new_tests, arm_rows = self._arm_tests(contacts, self.arm, p)
            arm_tests, rows = arm_tests + new_tests, rows + arm_rows
        refuted = ca.vertcat(ca.mmax(ca.vertcat(*hand_tests)), ca.mmax(ca.vertcat(*arm_tests)))
        return refuted, self._scores(contacts, rows, p["constrained"])

    def _arm_tests(
        self, contacts: list[BoxContact], arm: ArmSpan, p: dict[str, ca.SX]
    ) -> tuple[list[Expr], list[Inequality]]:
        """Return the tests of the arm, and the inequalities that most of them depend on."""
        wrist_ball = palm_ball(contacts, ca.SX(ca.DM(arm.wrist)), 1)
        tests, rows = wrist_excess(contacts, arm, p["span"], wrist_ball)
        if self.cones is not None:
            axis_ball = palm_ball(contacts, ca.SX(ca.DM(self.cones.last)), 0)
            tests.append(cone_excess(self.cones, wrist_ball, axis_ball, p["span"], p["cosines"]))
        return tests, rows

    def _scores(
        self, contacts: list[BoxContact], rows: list[Inequality], constrained: Expr
    ) -> Expr:
        """Return the contribution of each coordinate to the remaining uncertainty, (h, 1).

        A coordinate scores highest if it widens inequalities that are nearly violated; motion of a
        contact alone has a tenth of that weight. 0.1 m count as one radian.
        """
        scores = []
        for k in range(len(self.space.coordinates)):
            largest = ca.SX(0)
            for i, contact in enumerate(contacts):
                motion = (
                    constrained[i, 0] * contact.radius_shares[k] / 0.1
                    + constrained[i, 1] * contact.chord_shares[k]
                )
                largest = ca.fmax(largest, motion)
            scores.append(0.1 * largest if rows else largest)
        for row in rows:
            square = (row.value / row.width) ** 2
            for k, motion in enumerate(row.shares):
                scores[k] += square * square * motion / row.width
        return ca.vertcat(*scores)


@dataclass(frozen=True)
class ProverEffort:
    """Limits of the search for proofs. Source: ``studies/proofs.py``.

    Attributes:
        first_search_boxes: Maximum number of boxes per target in the first search with all fingers.
        subset_boxes: Maximum number of boxes per target and subset of fingers.
        max_boxes: Maximum number of boxes per target in the last search with all fingers.
        fixed_finger_boxes: Maximum number of boxes of each finger of a fixed hand in the first
            search.
        pair_boxes: Maximum number of boxes of two fingers, searched first because pairs reveal
            gross contradictions.
        single_finger_boxes: Maximum number of boxes of one finger, whose contact may be out of
            the reach of the arm.
        subset_size: Number of fingers in a subset; hands with more fingers are also searched by
            subsets, which have fewer motors to divide.
        boxes_per_call: Boxes evaluated in one call: enough to hide the cost of a call, few enough
            for the cache.
        targets_per_pass: Number of targets searched together.
        min_width_fraction: A coordinate narrower than this fraction of the smallest position
            tolerance is not divided further.
    """

    first_search_boxes: int = 3000
    subset_boxes: int = 3000
    max_boxes: int = 80_000
    fixed_finger_boxes: int = 200
    pair_boxes: int = 100
    single_finger_boxes: int = 400
    subset_size: int = 3
    boxes_per_call: int = 4096
    targets_per_pass: int = 256
    min_width_fraction: float = 0.01


PROVER_EFFORT = ProverEffort()

Boxes = tuple[Rows, Array, Array]
"""Boxes of one chunk: target index (k,), lower and upper bounds (k, h)."""


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """Results of k searches.

    Attributes:
        is_proved: (k,) True if every box was refuted.
        boxes: (k,) number of boxes evaluated.
        needs_arm: (k,) True if some box was refuted by the reach of the arm alone.
    """

    is_proved: Bools
    boxes: Counts
    needs_arm: Bools


class Prover:
    """Search for proofs of impossibility for one robot.

    Attributes:
        space: Coordinates of the hand whose box is divided.
    """

    def __init__(self, robot: RobotDescription, compiled: bool = True) -> None:
        """Store the robot; the test is built at the first use.

        Args:
            robot: Description of the robot.
            compiled: False to run the test in CasADi's virtual machine.
        """
        self._robot = robot
        self._compiled = compiled
        self.space = HandSpace(robot)
        self._arm = arm_span(robot)

    def prove(
        self,
        targets: TargetBatch,
        known_hands: Array | None = None,
        max_boxes: Counts | None = None,
    ) -> list[Proof | None]:
        """Return proofs of k targets, None where the search found no proof.

        The absence of a proof implies nothing about whether a target can be reached.

        Args:
            targets: Targets to prove impossible.
            known_hands: (k, h) coordinates (`HandSpace`) of hands that reach the targets, to test
                the prover: the search is restricted to boxes that contain them, so that every
                proof returned is a false proof, at a fraction of the full cost.
            max_boxes: (k,) maximum number of boxes of each target, if smaller than the default.
        """
        proofs: list[Proof | None] = []
        for start in range(0, len(targets), PROVER_EFFORT.targets_per_pass):
            rows = slice(start, start + PROVER_EFFORT.targets_per_pass)
            known_rows = None if known_hands is None else known_hands[rows]
            box_limits = (
                np.full(len(targets), PROVER_EFFORT.max_boxes)[rows]
                if max_boxes is None
                else max_boxes[rows]
            )
            proofs += self._prove_pass(targets.rows(rows), known_rows, box_limits)
        return proofs

    def _prove_pass(
        self, targets: TargetBatch, known_hands: Array | None, box_limits: Counts
    ) -> list[Proof | None]:
        is_usable = ~np.isnan(required_points(self._robot, targets)[0][:, :, 0])
        is_usable &= ~np.array(fingers_without_limits(self._robot, motor_box(self._robot, targets)))
        proofs: list[Proof | None] = [None] * len(targets)
        for group, max_boxes in self._finger_groups():
            is_in_group = np.zeros(is_usable.shape[1], dtype=bool)
            is_in_group[group] = True
            is_constrained = is_usable & is_in_group
            is_open = np.array([proof is None for proof in proofs])
            rows = np.flatnonzero(is_open & is_constrained.any(axis=1))
            if not len(rows):
                continue
            known_rows = None if known_hands is None else known_hands[rows]
            boxes = np.minimum(max_boxes, box_limits[rows])
            result = self._search(targets.rows(rows), is_constrained[rows], boxes, known_rows)
            for i in np.flatnonzero(result.is_proved).tolist():
                row = int(rows[i])
                kind = ProofKind.REACH if result.needs_arm[i] else ProofKind.HAND
                names = (self._robot.finger_names[i] for i in np.flatnonzero(is_constrained[row]))
                proofs[row] = Proof(
                    kind=ProofKind.FINGER if self._arm is None else kind,
                    fingers=tuple(names),
                    boxes=int(result.boxes[i]),
                    tolerance=targets.tolerances,
                    target=targets.rows(slice(row, row + 1)),
                ).sealed()
        return proofs

    def _finger_groups(self) -> list[tuple[list[int], int]]:
        """Return the groups of fingers to search, with the maximum number of boxes."""
        fingers = list(range(len(self._robot.fingers)))
        if self._arm is None:
            # A short search of every finger first: a finger that reaches its contact is never
            # refuted and would exhaust the effort before the finger that misses.
            return [
                ([i], max_boxes)
                for max_boxes in (PROVER_EFFORT.fixed_finger_boxes, PROVER_EFFORT.max_boxes)
                for i in fingers
            ]
        # A contradiction of few fingers is more informative: search small groups first.
        subgroups = [[[i] for i in fingers], list(map(list, combinations(fingers, 2)))]
        small_groups = [
            (group, max_boxes)
            for groups, max_boxes in zip(
                (*subgroups, subgroups[0]),
                (1, PROVER_EFFORT.pair_boxes, PROVER_EFFORT.single_finger_boxes),
                strict=True,
            )
            for group in groups
            if len(group) < len(fingers)
        ]
        if len(fingers) <= PROVER_EFFORT.subset_size:
            return [*small_groups, (fingers, PROVER_EFFORT.max_boxes)]
        subsets = [
            (list(subset_boxes), PROVER_EFFORT.subset_boxes)
            for subset_boxes in combinations(fingers, PROVER_EFFORT.subset_size)
        ]
        return [
            *small_groups,
            (fingers, PROVER_EFFORT.first_search_boxes),
            *subsets,
            (fingers, PROVER_EFFORT.max_boxes),
        ]

    @cached_property
    def _test(self) -> FunctionKernel:
        return FunctionKernel(BoxTest(self.space, self._arm, self._cones).graph(), self._compiled)

    @cached_property
    def _cones(self) -> ArmCones | None:
        cones = arm_cones(self._robot)
        if cones is None or self._arm is None:
            return None
        same_shoulder = np.allclose(cones.shoulder, self._arm.shoulder, rtol=0, atol=1e-9)
        return (
            cones if same_shoulder and np.allclose(cones.wrist, self._arm.wrist, 0, 1e-9) else None
        )

    def _search(
        self, targets: TargetBatch, fingers: Bools, max_boxes: Counts, known_hands: Array | None
    ) -> _SearchResult:
        """Bisect the boxes of k targets until all are refuted or the effort is exhausted.

        Args:
            targets: Targets to prove impossible.
            fingers: (k, f) mask of the contacts to consider.
            max_boxes: (k,) maximum number of boxes of each target.
            known_hands: (k, h) hands that reach the targets, see `prove`.
        """
        count = len(targets)
        points, depths = required_points(self._robot, targets)
        points = np.where(fingers[..., None], points, 0.0)
        has_normal = fingers & ~np.isnan(targets.normals[:, :, 0])
        normals = np.where(has_normal[..., None], targets.normals, 0.0)
        constrained = np.stack([fingers, has_normal], axis=2).astype(float)
        tolerance = np.stack([targets.position_tolerance, targets.angle_tolerance], axis=1)
        min_width = max(
            1e-9, PROVER_EFFORT.min_width_fraction * float(targets.position_tolerance.min())
        )
        # Kernels drop the second dimension of columns, so that a hand with one motor needs a
        # reshape.
        size, limit_shape, depth_shape = (self._test.input_shapes[i] for i in (0, 2, 5))
        depths = depths.reshape(count, *depth_shape)
        limits = [np.reshape(end, limit_shape) for end in joint_limits(self._robot, targets)]
        arm_inputs = np.zeros(2), np.full(2, NO_CONE_LIMIT)
        if self._arm is not None:
            cosines = arm_inputs[1] if self._cones is None else self._cones.cosines(targets)
            arm_inputs = np.array(self._arm.span(targets)), cosines
        lower, upper = (np.tile(end, (count, 1)) for end in self.space.box(targets))
        queue: list[Boxes] = [(np.arange(count), lower, upper)]
        boxes = np.zeros(count, dtype=np.int64)
        given_up, needs_arm = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        while queue:
            target, lower, upper = queue.pop()
            is_active = ~given_up[target]
            target, lower, upper = target[is_active], lower[is_active], upper[is_active]
            boxes += np.bincount(target, minlength=count)
            refuted, scores = self._test(
                *(end.reshape(len(end), *size) for end in (lower, upper)),
                *(*limits, points[target], depths[target], normals[target]),
                *(tolerance, constrained[target], *arm_inputs),
            )
            refuted, scores = refuted > 0, scores.reshape(lower.shape)
            needs_arm[target[refuted[:, 1] & ~refuted[:, 0]]] = True
            if not lower.shape[1]:  # a rigid tool has no coordinates to divide
                given_up[target[~refuted.any(axis=1)]] = True
                continue
            widest = scores.argmax(axis=1)
            rows = np.arange(len(target))
            is_narrow = (upper - lower)[rows, widest] < min_width
            is_narrow |= scores[rows, widest] <= 0
            is_open = ~refuted.any(axis=1)
            given_up[target[is_open & is_narrow]] = True
            given_up |= boxes > max_boxes
            is_open = np.flatnonzero(is_open & ~given_up[target])
            halves = _halves(target[is_open], lower[is_open], upper[is_open], widest[is_open])
            if known_hands is not None:
                hands = known_hands[halves[0]]
                contains_hand = ((halves[1] <= hands) & (hands <= halves[2])).all(axis=1)
                halves = (
                    halves[0][contains_hand],
                    halves[1][contains_hand],
                    halves[2][contains_hand],
                )
            queue += _chunks(*halves)
        return _SearchResult(~given_up, boxes, needs_arm)


def _halves(target: Rows, lower: Array, upper: Array, widest: Rows) -> Boxes:
    """Return the halves of boxes bisected along one coordinate each (k,)."""
    rows = np.arange(len(target))
    middle = (lower[rows, widest] + upper[rows, widest]) / 2
    lower, upper = np.concatenate([lower, lower]), np.concatenate([upper, upper])
    upper[rows, widest] = middle
    lower[len(rows) + rows, widest] = middle
    return np.concatenate([target, target]), lower, upper


def _chunks(target: Rows, lower: Array, upper: Array) -> Iterator[Boxes]:
    """Yield boxes in chunks that are evaluated in one call."""
    for start in range(0, len(target), PROVER_EFFORT.boxes_per_call):
        rows = slice(start, start + PROVER_EFFORT.boxes_per_call)
        yield target[rows], lower[rows], upper[rows]
