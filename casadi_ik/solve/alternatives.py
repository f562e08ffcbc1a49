"""Search for alternative solutions of a grasp: hand postures, arm branches and their ranking."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.compile import FunctionKernel
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.linear_algebra import manipulability
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import CLEARANCE, TargetBatch
from casadi_ik.solve.arm_branches import ArmBranches
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.free_rotations import FreeRotations, RotationSearch
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.row_selection import distinct_rows
from casadi_ik.solve.solution import Alternative, ArmBranch
from casadi_ik.solve.subproblems import (
    LocalRefinement,
    MotorBounds,
    SubproblemSolver,
    palm_coordinates,
    sample_trunks,
    side_palms,
)
from casadi_ik.solve.target_builder import resolve_preference
from casadi_ik.solve.turns import nearest_turns, with_search_starts
from casadi_ik.solve.verdict import judge

DEFAULT_SEPARATION = 0.25
"""Default minimum difference of alternatives, see `AlternativeFinder.find`."""

FULL_TURN = 2 * np.pi
"""Full revolution [rad]."""


@dataclass(frozen=True)
class AlternativeParameters:
    """Effort of the search for alternatives.

    Attributes:
        min_difference: Hands and arms are distinct if a motor differs by more than this [fraction
            of its range].
        tight_tolerance: Tolerance [m, rad] of the first fit of hand postures, small enough to
            recognise duplicates.
        trunks: Number of trunk postures of a multi-arm robot that are tried with each hand.
        rotated_hands: Maximum number of rotations of a free palm that are refined, each with all
            arms.
        random_arms: Number of random starts of an arm without a closed form.
        collision_penalty: Reduction of the score of colliding solutions; larger than any score.
    """

    min_difference: float = 0.05
    tight_tolerance: float = 1e-7
    trunks: int = 64
    rotated_hands: int = 6
    random_arms: int = 64
    collision_penalty: float = 1e6


ALTERNATIVES = AlternativeParameters()


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A solution before it is checked and ranked."""

    q: Array
    posture: int
    branch: ArmBranch | None = None
    swivel: float | None = None


class AlternativeFinder:
    """Search for all solutions of a grasp on one robot.

    Attributes:
        robot: The robot.
        subproblems: Solver of subproblems.
        hand: Positions in q of the hand motors.
    """

    def __init__(self, robot: ArmHand, method: HandSearch, compiled: bool = True) -> None:
        """Store the robot and its hand-first method."""
        self.robot = robot
        self.subproblems = SubproblemSolver(robot, method)
        self._compiled = compiled
        self._arm_motors = list(robot.description.arm_actuators)
        self.hand = list(robot.description.hand_actuators)

    @cached_property
    def _arm_branches(self) -> ArmBranches | None:
        """Branches of the arm; None if locked joints leave more than one redundancy parameter."""
        arm = self.subproblems.method.step.arm
        return None if arm is None or arm.locked else ArmBranches(arm, self._compiled)

    @cached_property
    def arm_search(self) -> ArmSearch | None:
        """Search for all arms of a hand; None without a closed form of the arm."""
        family = self.subproblems.method.step.arm
        return None if family is None else self._arm_search(family, self._arm_motors)

    @cached_property
    def side_searches(self) -> list[ArmSearch]:
        """Arm search of every side of a multi-arm robot; empty unless all have a closed form."""
        step, arms = self.subproblems.method.step, self.robot.description.side_actuators
        families = [side.family for side in step.sides] if isinstance(step, MultiArmStep) else []
        return [
            self._arm_search(family, list(arms[side][0]), side)
            for side, family in enumerate(families)
            if family is not None and None not in families
        ]

    def _arm_search(self, family: ArmFamily, arm: list[int], side: int | None = None) -> ArmSearch:
        def scores(q: Array, starts: Array, prefer: Preference) -> Array:
            return self.score(q, starts, prefer, arm)

        def measure() -> FunctionKernel:
            return self.manipulability

        return ArmSearch(self.robot, family, scores, measure, self._compiled, side)

    @cached_property
    def manipulability(self) -> FunctionKernel:
        """Manipulability of the arm as a function of q; the minimum over several arms."""
        robot, q = self.robot.description, ca.SX.sym("q", len(self.robot.actuators))
        body, values = actuated(robot, q), list[ca.SX]()
        arms = [arm for arm, _ in robot.side_actuators] or [self._arm_motors]
        for carrier, arm in zip(robot.sides or [robot], arms, strict=True):
            palm = body.kinematics.links[carrier.palm_link].compose(carrier.palm_placement)
            jacobian = ca.vertcat(*body.twist(carrier.palm_link, palm.origin, arm))
            values.append(manipulability(jacobian))
        measure = ca.mmin(ca.vertcat(*values))
        return FunctionKernel(ca.Function("arm_manipulability", [q], [measure]), self._compiled)

    def find(
        self,
        targets: TargetBatch,
        limit: int,
        prefer: str,
        separation: float = DEFAULT_SEPARATION,
        query: CollisionQuery | None = None,
    ) -> tuple[Alternative, ...]:
        """Return different solutions of one target, best first.

        All solutions are ranked; a solution that is too similar to a better one is omitted.

        Args:
            targets: One target.
            limit: Maximum number of solutions.
            prefer: One of `PREFERENCES`.
            separation: Minimum difference of two solutions: at least one motor differs by this
                fraction of its range. Without it, hands with free closure and elbows with a free
                swivel would fill the list with nearly equal solutions.
            query: Pairs that must not collide; None: no check.

        Raises:
            InputError: The limit, the preference or the difference is invalid.
        """
        if not isinstance(limit, (int, np.integer)) or limit < 1:
            raise InputError(f"limit: found {limit!r}, expected an integer >= 1")
        resolve_preference(prefer, has_start=True)
        separation = check_separation(separation)
        limits = self.subproblems.limits(targets).first
        robot, bounds = self.robot.description, (limits.lower, limits.upper)
        (start,) = targets.starts(robot)
        targets = with_search_starts(robot, targets)
        (q0,) = targets.starts(robot)
        candidates: list[_Candidate] = []
        postures = self._postures(targets, limits)
        for number, q in enumerate(postures):
            candidates += self._arm_candidates(targets, q, number, limits, prefer, query)
        candidates += self._rotated_candidates(targets, postures, limits, prefer, query)
        if not candidates:
            return ()
        q = np.stack([candidate.q for candidate in candidates])
        q = nearest_turns(robot, q, q0, bounds, prefer == "q0")
        solved = self.subproblems.solved(targets, q, targets.enforce_limits)
        if query is not None:
            solved &= query.free(q)
        ranking_keys = np.stack(
            [
                self._collision_aware_score(q, q0, prefer, query),
                self._limit_margins(q, self._arm_motors),
            ]
        )
        order = [int(i) for i in np.lexsort(-ranking_keys[::-1]) if solved[i]]
        fractions = self._range_fractions(q[order], list(range(q.shape[1])))
        rows = distinct_rows(fractions, separation)[:limit]
        q = nearest_turns(robot, q, start, bounds, prefer == "q0")
        distinct_candidates = [replace(candidates[order[i]], q=q[order[i]]) for i in rows]
        return tuple(self._describe(targets, candidate, start) for candidate in distinct_candidates)

    def _rotated_candidates(
        self,
        targets: TargetBatch,
        postures: list[Array],
        limits: MotorBounds,
        prefer: str,
        query: CollisionQuery | None,
    ) -> list[_Candidate]:
        """Return solutions with the preferred rotations of the palm, if it is free to rotate."""
        hands = np.reshape(postures, (len(postures), len(self.robot.actuators)))
        solutions = hands if query is None else hands[query.free(hands)]
        owners = [np.zeros(len(q), dtype=np.intp) for q in (hands, solutions)]
        starts, count = targets.starts(self.robot.description), ALTERNATIVES.rotated_hands
        q, _ = self.with_free_rotations(
            targets, (hands, owners[0]), (solutions, owners[1]), (starts, prefer, query), count
        )
        rotated, number = q[len(solutions) :], len(postures)
        if self.robot.description.sides:
            return [_Candidate(configuration, number) for configuration in rotated]
        score = self._collision_aware_score(rotated, starts, prefer, query)
        candidates = []
        for i, row in enumerate(np.argsort(-score, kind="stable")[:count]):
            candidates += self._arm_candidates(
                targets, rotated[row], number + i, limits, prefer, query
            )
        return candidates

    def with_free_rotations(
        self,
        targets: TargetBatch,
        hands: tuple[Array, NDArray[np.intp]],
        solutions: tuple[Array, NDArray[np.intp]],
        ranking: tuple[Array, Preference, CollisionQuery | None],
        max_refined: int,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return solutions, followed by those with the preferred rotations of free palms.

        For a multi-arm robot the arms of all sides are searched successively.

        Args:
            targets: k targets.
            hands: (m, n) configurations with all distinct hands, and indices of their targets.
            solutions: (p, n) collision-free solutions, and indices of their targets.
            ranking: Initial configurations (k, n), preference, and the pairs that must not collide.
            max_refined: Maximum number of rotations of all targets that are refined.
        """
        robot = self.robot.description
        if self.arm_search is not None:
            fingers = list(range(len(robot.fingers)))
            rotations = FreeRotations.of_targets(robot, targets, fingers)
            q, owner = hands
            rows = np.flatnonzero(rotations.is_free[owner])
            search = RotationSearch(
                self.subproblems, self.arm_search, None, self.hand, rotations, targets, *ranking
            )
            return _concatenate(solutions, search.run(q[rows], owner[rows], max_refined))
        for number, arms in enumerate(self.side_searches):
            side, (_, hand) = robot.sides[number], robot.side_actuators[number]
            fingers = [robot.finger_names.index(name) for name in side.fingers]
            rotations = FreeRotations.of_targets(robot, targets, fingers)
            q, owner = solutions
            order = np.argsort(-self.score(q, ranking[0][owner], ranking[1]), kind="stable")
            search = RotationSearch(
                self.subproblems, arms, side.name, list(hand), rotations, targets, *ranking
            )
            solutions = _concatenate(solutions, search.run(q[order], owner[order], max_refined))
        return solutions

    def best_arm(self, targets: TargetBatch, q: Array, prefer: str) -> Array:
        """Return the solution (n,) with the best arm for the hand of a solution.

        Args:
            targets: One target.
            q: (n,) solution.
            prefer: One of `PREFERENCES`.
        """
        limits = self.subproblems.limits(targets).first
        candidates = self._arm_candidates(targets, q, 0, limits, prefer)
        solutions = np.stack([q, *(candidate.q for candidate in candidates)])
        solved = self.subproblems.solved(targets, solutions, targets.enforce_limits)
        solutions = solutions[solved] if solved.any() else q[None]
        (q0,) = targets.starts(self.robot.description)
        return solutions[int(np.argmax(self.score(solutions, q0, prefer)))]

    def _postures(self, targets: TargetBatch, limits: MotorBounds) -> list[Array]:
        """Return solutions (n,) with different hands, from all candidates of all restarts."""
        subproblems, method = self.subproblems, self.subproblems.method
        restarts = range(method.options.rounds)
        postures = np.concatenate([method.postures(targets, restart)[0] for restart in restarts])
        clipped = targets.starting_at(limits.clip(targets.starts(self.robot.description)))
        target_rows = np.zeros(1, dtype=np.intp)
        _, states, parameters = subproblems.hand_rows(clipped, target_rows, postures[None])
        original_parameters = parameters.copy()
        subproblems.set_tolerance(parameters, ALTERNATIVES.tight_tolerance)
        q = subproblems.run(states, parameters)
        tolerance = 10 * ALTERNATIVES.tight_tolerance
        exact = replace(targets, tolerance=Tolerance(tolerance, tolerance))
        solutions = q[subproblems.solved(exact, q, targets.enforce_limits)]
        if not len(solutions):
            # The target may be reachable only within its tolerances.
            q = np.concatenate([q, subproblems.run(states, original_parameters)])
            solutions = q[subproblems.solved(targets, q, targets.enforce_limits)]
        if not len(solutions):
            # The complete search also uses seeds that are not in the tables.
            q = method.run(targets).q
            solutions = q[subproblems.solved(targets, q, targets.enforce_limits)]
        rows = distinct_rows(self.hand_coordinates(solutions), ALTERNATIVES.min_difference)
        return [solutions[i] for i in rows]

    def hand_coordinates(self, q: Array) -> Array:
        """Return coordinates that distinguish hand poses: motors, and the palm pose with an arm.

        Args:
            q: (m, n) configurations.

        Returns:
            (m, h) motors of the hand divided by their ranges; with an arm (m, h + 12), followed by
            the pose of the palm (`palm_coordinates`). Some contacts, for example of two opposed
            fingers, leave the palm free, so that equal hand postures are different hand poses.
        """
        fractions = self._range_fractions(q, self.hand)
        if not self._arm_motors:
            return fractions
        return np.concatenate([fractions, palm_coordinates(self.robot.palm(q))], axis=1)

    def _arm_candidates(
        self,
        targets: TargetBatch,
        q: Array,
        posture: int,
        limits: MotorBounds,
        prefer: str,
        query: CollisionQuery | None = None,
    ) -> list[_Candidate]:
        """Return all arms for the hand of q; for a multi-arm robot, sampled trunks and arms."""
        if self.robot.description.sides:
            return [
                _Candidate(configuration, posture)
                for configuration in self._trunk_candidates(targets, q)
            ]
        if not self._arm_motors:
            return [_Candidate(q, posture)]

        def iterative_candidates() -> list[_Candidate]:
            arms = self._search_arms(targets, q, prefer)
            return [_Candidate(arm, posture) for arm in arms]

        if self._arm_branches is None:
            return iterative_candidates()
        (q0,) = targets.starts(self.robot.description)
        palm = self.robot.palm(q)
        bounds = (
            self._closed_form_bounds(limits.lower, limits),
            self._closed_form_bounds(limits.upper, limits),
        )

        def with_arm(arms: Array) -> Array:
            configurations = np.tile(q, (len(arms), 1))
            configurations[:, self._arm_motors] = arms
            return limits.clip(configurations)

        def score(arms: Array) -> Array:
            return self._collision_aware_score(with_arm(arms), q0, prefer, query, self._arm_motors)

        branches = self._arm_branches.find(palm, *bounds)
        best_arms = self._arm_branches.best(palm, branches, bounds, score)
        candidates = [
            _Candidate(with_arm(arm[None])[0], posture, branch, swivel)
            for branch, (arm, swivel) in zip(branches, best_arms, strict=True)
        ]
        if self._arm_branches.family.is_iterative:
            # An allowed interval may be shorter than the spacing of the samples.
            candidates += iterative_candidates()
            solutions = np.stack([candidate.q for candidate in candidates])
            fractions = self._range_fractions(solutions, self._arm_motors)
            return [candidates[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]
        return self._refine_candidates(targets, candidates) or [_Candidate(q, posture)]

    def _closed_form_bounds(self, bound: Array, limits: MotorBounds) -> Array:
        """Return bounds (a,) of the arm, with fixed joints in the revolution of the closed form."""
        middle = (self.robot.lower + self.robot.upper) / 2
        revolutions = np.floor((bound - middle + np.pi) / FULL_TURN)
        shifted = np.where(limits.lower < limits.upper, bound, bound - FULL_TURN * revolutions)
        return shifted[self._arm_motors]

    def _refine_candidates(
        self, targets: TargetBatch, candidates: list[_Candidate]
    ) -> list[_Candidate]:
        """Refine the candidates of an arm whose closed form is only approximate."""
        family = self.subproblems.method.step.arm
        if not candidates or family is None or family.is_exact:
            return candidates
        starts = np.stack([candidate.q for candidate in candidates])
        target_rows = np.zeros(len(candidates), np.intp)
        refined = LocalRefinement(self.subproblems, targets).run(target_rows, starts)
        return [replace(candidate, q=q) for candidate, q in zip(candidates, refined, strict=True)]

    def _trunk_candidates(self, targets: TargetBatch, q: Array) -> list[Array]:
        """Return solutions of a multi-arm robot with the hands of q and other trunks and arms."""
        palms, target_rows = side_palms(self.robot, q[None]), np.zeros(1, np.intp)
        configurations, _ = sample_trunks(
            self.subproblems, targets, q[None], palms, target_rows, 0, ALTERNATIVES.trunks
        )
        configurations = np.concatenate([q[None], configurations])
        solutions = configurations[
            self.subproblems.solved(targets, configurations, targets.enforce_limits)
        ]
        moving = [i for i in range(solutions.shape[1]) if i not in self.hand]
        fractions = self._range_fractions(solutions, moving)
        return [solutions[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]

    def _search_arms(self, targets: TargetBatch, q: Array, prefer: str) -> list[Array]:
        """Return solutions with different arms, refined from every branch and from random arms."""
        starts = self.robot.random(np.random.default_rng(targets.seed), ALTERNATIVES.random_arms)
        starts[:, self.hand] = q[self.hand]
        if self._arm_branches is None and self.arm_search is not None:
            limits, no_bound = self.subproblems.limits(targets).first, np.full(1, np.inf)
            bounds = limits.lower, limits.upper
            preference = "limits" if prefer == CLEARANCE else prefer
            q0 = targets.starts(self.robot.description)
            arms = self.arm_search.choose(q[None], q0, bounds, preference, None, no_bound, True)
            starts = np.concatenate([arms.q, starts])
        starts = np.concatenate([q[None], starts])
        configurations = LocalRefinement(self.subproblems, targets).run(
            np.zeros(len(starts), np.intp), starts
        )
        configurations = np.concatenate([q[None], configurations])
        hand_differences = np.abs(self._range_fractions(configurations - q, self.hand))
        has_same_hand = (hand_differences < ALTERNATIVES.min_difference).all(axis=1)
        solved = self.subproblems.solved(targets, configurations, targets.enforce_limits)
        solutions = configurations[has_same_hand & solved]
        fractions = self._range_fractions(solutions, self._arm_motors)
        return [solutions[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]

    def _range_fractions(self, q: Array, columns: list[int]) -> Array:
        """Return columns of configurations divided by the motors' ranges."""
        return q[:, columns] / (self.robot.upper - self.robot.lower)[columns]

    def arm_margins(self, q: Array) -> Array:
        """Return the limit margins (k,) of the arm: smallest distance to a limit / half range."""
        return self._limit_margins(q, self._arm_motors)

    def _limit_margins(self, q: Array, columns: list[int]) -> Array:
        half_range = (self.robot.upper - self.robot.lower)[columns] / 2
        margins = np.minimum(q - self.robot.lower, self.robot.upper - q)[:, columns] / half_range
        return margins.min(axis=1) if columns else np.ones(len(q))

    def _collision_aware_score(
        self,
        q: Array,
        q0: Array,
        prefer: str,
        query: CollisionQuery | None,
        columns: list[int] | None = None,
    ) -> Array:
        """Return `score` (k,); colliding configurations rank below all others."""
        surplus = None if query is None else query.check(q).surplus
        score = self.score(q, q0, prefer, columns, surplus)
        if surplus is None:
            return score
        return np.where(surplus >= 0, score, surplus - ALTERNATIVES.collision_penalty)

    def score(
        self,
        q: Array,
        q0: Array,
        prefer: Preference,
        columns: list[int] | None = None,
        surplus: Array | None = None,
    ) -> Array:
        """Return the scores (k,) of configurations; higher is better.

        Args:
            q: (k, n) configurations.
            q0: (n,) or (k, n) initial configurations.
            prefer: The preference.
            columns: Motors that enter the limit margin; None: all.
            surplus: (k,) clearances beyond the margin [m], for the preference "clearance".
        """
        if callable(prefer):
            return np.asarray(prefer(q), dtype=float)
        if prefer == CLEARANCE and surplus is not None:
            return surplus
        all_columns = list(range(q.shape[1]))
        if prefer == "limits":
            return self._limit_margins(q, all_columns if columns is None else columns)
        if prefer == "q0":
            return -np.linalg.norm(self._range_fractions(q - q0, all_columns), axis=1)
        return self._manipulability_values(q)

    def _manipulability_values(self, q: Array) -> Array:
        has_arm = self._arm_motors or self.robot.description.sides
        return self.manipulability(q)[0] if has_arm else np.zeros(len(q))

    def _describe(self, targets: TargetBatch, candidate: _Candidate, q0: Array) -> Alternative:
        q = candidate.q[None]
        verdict = judge(self.robot, targets, q)
        return Alternative(
            q=candidate.q,
            contacts=verdict.contacts(0, self.robot.fingers, targets.tolerances),
            posture=candidate.posture,
            branch=candidate.branch,
            swivel=candidate.swivel,
            margin=float(self.score(q, q0, "limits")[0]),
            manipulability=float(self._manipulability_values(q)[0]),
            distance=float(-self.score(q, q0, "q0")[0]),
        )


def _concatenate(
    a: tuple[Array, NDArray[np.intp]], b: tuple[Array, NDArray[np.intp]]
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations, and indices of their targets, of both."""
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])


def side_links(robot: RobotDescription) -> list[tuple[frozenset[str], frozenset[str]]]:
    """Return the links of arm and hand for each side of a multi-arm robot."""
    movable_links = [robot.links_moved(arm) for arm, _ in robot.side_actuators]
    hands = [robot.links_moved(arm[-1:]) for arm, _ in robot.side_actuators]
    return [(links - hand, hand) for links, hand in zip(movable_links, hands, strict=True)]


def check_separation(separation: float) -> float:
    """Return the minimum difference of alternatives as a float.

    Raises:
        InputError: It is not a number from 0 to 1.
    """
    is_number = isinstance(separation, (int, float, np.integer, np.floating))
    if not is_number or isinstance(separation, bool) or not 0 <= separation <= 1:
        raise InputError(f"apart: found {separation!r}, expected a number from 0 to 1")
    return float(separation)
