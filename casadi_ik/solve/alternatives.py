"""Search for alternative solutions of a grasp: hand postures, arm branches and their ranking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.cancellation import stop_if_cancelled
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import SIGNS, ArmFamily, ClosedForm
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.forward import Pose, actuated
from casadi_ik.kinematics.linear_algebra import manipulability
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.request import CLEARANCE, resolve_preference
from casadi_ik.solve.row_selection import distinct_rows
from casadi_ik.solve.solution import Alternative, ArmBranch
from casadi_ik.solve.subproblems import (
    Bounds,
    LocalRefinement,
    SubproblemSolver,
    palm_coordinates,
    sample_trunks,
    side_palms,
)
from casadi_ik.solve.turns import nearest_turns, search_start
from casadi_ik.solve.verdict import contact_verdicts, judge

DEFAULT_SEPARATION = 0.25
"""Default minimum difference of alternatives, see `AlternativeFinder.find`."""

FULL_TURN = 2 * np.pi


@dataclass(frozen=True)
class AlternativeParameters:
    """Effort of the search for alternatives.

    Attributes:
        min_difference: Hands and arms are distinct if a motor differs by more than this [fraction
            of its range].
        tight_tolerance: Tolerance [m, rad] of the first fit of hand postures, which makes
            duplicates recognisable.
        trunks: Number of trunks of a multi-arm robot that are tried with each hand.
        random_arms: Number of random starts of an arm without a closed form.
        collision_penalty: Reduction of the score of colliding solutions; larger than any score.
        samples: Number of samples of the redundancy if its breakpoints are unknown.
        iterative_samples: Number of samples for an iterative family, each of which costs a search
            for all roots.
        peak_steps: Number of ternary search steps around a sample, which find an allowed interval
            between two samples.
        bisection_steps: Number of bisection steps that find the end of an allowed interval.
        branch_samples: Number of samples of an allowed interval for its best arm.
        zooms: Number of refinements around the best sample, each with a sixteenth of the spacing.
    """

    min_difference: float = 0.05
    tight_tolerance: float = 1e-7
    trunks: int = 64
    random_arms: int = 64
    collision_penalty: float = 1e6
    samples: int = 361
    iterative_samples: int = 37
    peak_steps: int = 12
    bisection_steps: int = 45
    branch_samples: int = 33
    zooms: int = 2


ALTERNATIVES = AlternativeParameters()


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A solution before it is checked and ranked."""

    q: Array
    posture: int
    branch: ArmBranch | None = None
    swivel: float | None = None


class AlternativeFinder:
    """A finder of all solutions of grasps on one robot.

    Attributes:
        robot: The robot.
        subproblems: The loop of the hand-first method.
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
            palm = body.kinematics.links[carrier.palm_link].at(carrier.palm_placement)
            jacobian = ca.vertcat(*body.twist(carrier.palm_link, palm.origin, arm))
            values.append(manipulability(jacobian))
        measure = ca.mmin(ca.vertcat(*values))
        return FunctionKernel(ca.Function("arm_manipulability", [q], [measure]), self._compiled)

    def find(
        self,
        targets: TargetBatch,
        q0: Array,
        seed: int,
        limit: int,
        prefer: str,
        apart: float = DEFAULT_SEPARATION,
        query: CollisionQuery | None = None,
    ) -> tuple[Alternative, ...]:
        """Return different solutions of one target, best first.

        All solutions are ranked; one that differs too little from a better one is left out.

        Args:
            targets: One target.
            q0: (n,) initial configuration.
            seed: Seed of the starts of arms without a closed form.
            limit: Maximum number of solutions.
            prefer: One of `PREFERENCES`.
            apart: Minimum difference: in any two solutions at least one motor differs by this
                fraction of its range. Motors of a hand with free closure and elbows with a free
                swivel would otherwise fill the list with nearly equal solutions.
            query: Pairs that must not collide; None: nothing is checked.

        Raises:
            InputError: The limit, the preference or the difference is invalid.
        """
        if not isinstance(limit, (int, np.integer)) or limit < 1:
            raise InputError(f"limit: found {limit!r}, expected an integer >= 1")
        resolve_preference(prefer, has_start=True)
        apart = check_separation(apart)
        limits = self.subproblems.limits(targets).first
        robot, bounds, start = self.robot.description, (limits.lower, limits.upper), q0
        q0 = search_start(robot, start)
        candidates: list[_Candidate] = []
        for number, q in enumerate(self._postures(targets, q0, limits)):
            candidates += self._arm_candidates(targets, q, number, limits, q0, seed, prefer, query)
        if not candidates:
            return ()
        q = np.stack([candidate.q for candidate in candidates])
        q = nearest_turns(robot, q, q0, bounds, prefer == "q0")
        solved = self.subproblems.solved(targets, q, targets.enforce_limits)
        if query is not None:
            solved &= query.free(q)
        keys = np.stack(
            [
                self._collision_aware_score(q, q0, prefer, query),
                self._limit_margins(q, self._arm_motors),
            ]
        )
        order = [int(i) for i in np.lexsort(-keys[::-1]) if solved[i]]
        fractions = self._range_fractions(q[order], list(range(q.shape[1])))
        rows = distinct_rows(fractions, apart)[:limit]
        q = nearest_turns(robot, q, start, bounds, prefer == "q0")
        chosen = [replace(candidates[order[i]], q=q[order[i]]) for i in rows]
        return tuple(self._describe(targets, candidate, start) for candidate in chosen)

    def best_arm(self, targets: TargetBatch, q: Array, q0: Array, seed: int, prefer: str) -> Array:
        """Return the solution (n,) with the best arm for the hand of a given solution.

        Args:
            targets: One target.
            q: (n,) a solution.
            q0: (n,) initial configuration.
            seed: Seed of the starts of arms without a closed form.
            prefer: One of `PREFERENCES`.
        """
        limits = self.subproblems.limits(targets).first
        candidates = self._arm_candidates(targets, q, 0, limits, q0, seed, prefer)
        solutions = np.stack([q, *(candidate.q for candidate in candidates)])
        solved = self.subproblems.solved(targets, solutions, targets.enforce_limits)
        solutions = solutions[solved] if solved.any() else q[None]
        return solutions[int(np.argmax(self.score(solutions, q0, prefer)))]

    def _postures(self, targets: TargetBatch, q0: Array, limits: Bounds) -> list[Array]:
        """Return solutions (n,) with different hands, from all candidates of all restarts."""
        subproblems, method = self.subproblems, self.subproblems.method
        restarts = range(method.options.rounds)
        postures = np.concatenate([method.postures(targets, restart)[0] for restart in restarts])
        start, first = limits.clip(q0)[None], np.zeros(1, dtype=np.intp)
        _, states, parameters = subproblems.hand_rows(targets, first, start, postures[None])
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
            # The restarts of the whole search find what the tables of seeds miss.
            q = method.run(targets, q0[None], 0, trace=False).q
            solutions = q[subproblems.solved(targets, q, targets.enforce_limits)]
        rows = distinct_rows(self.hand_coordinates(solutions), ALTERNATIVES.min_difference)
        return [solutions[i] for i in rows]

    def hand_coordinates(self, q: Array) -> Array:
        """Return the numbers that distinguish hand poses: motors, and the palm that an arm moves.

        Args:
            q: (m, n) configurations.

        Returns:
            (m, h) motors of the hand divided by their ranges; with an arm (m, h + 12), followed by
            the pose of the palm (`palm_coordinates`). Contacts such as those of two opposed fingers
            leave the palm free, so that equal postures of the hand are different hand poses.
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
        limits: Bounds,
        q0: Array,
        seed: int,
        prefer: str,
        query: CollisionQuery | None = None,
    ) -> list[_Candidate]:
        """Return all arms for the hand of q; for a multi-arm robot a sample of trunks and arms."""
        if self.robot.description.sides:
            return [_Candidate(other, posture) for other in self._trunk_candidates(targets, q)]
        if not self._arm_motors:
            return [_Candidate(q, posture)]

        def iterative_candidates() -> list[_Candidate]:
            arms = self._search_arms(targets, q, seed, q0, prefer)
            return [_Candidate(arm, posture) for arm in arms]

        if self._arm_branches is None:
            return iterative_candidates()
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
            q_all = np.stack([candidate.q for candidate in candidates])
            fractions = self._range_fractions(q_all, self._arm_motors)
            return [candidates[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]
        return self._refine_candidates(targets, candidates) or [_Candidate(q, posture)]

    def _closed_form_bounds(self, end: Array, limits: Bounds) -> Array:
        """Return bounds (a,) of the arm, with fixed joints in the turn of the closed form."""
        middle = (self.robot.lower + self.robot.upper) / 2
        turns = np.floor((end - middle + np.pi) / FULL_TURN)
        moved = np.where(limits.lower < limits.upper, end, end - FULL_TURN * turns)
        return moved[self._arm_motors]

    def _refine_candidates(
        self, targets: TargetBatch, candidates: list[_Candidate]
    ) -> list[_Candidate]:
        """Refine the candidates of an arm whose closed form is only approximate."""
        family = self.subproblems.method.step.arm
        if not candidates or family is None or family.is_exact:
            return candidates
        starts = np.stack([candidate.q for candidate in candidates])
        first = np.zeros(len(candidates), np.intp)
        ends = LocalRefinement(self.subproblems, targets).run(first, starts)
        return [replace(candidate, q=end) for candidate, end in zip(candidates, ends, strict=True)]

    def _trunk_candidates(self, targets: TargetBatch, q: Array) -> list[Array]:
        """Return solutions with different trunks and arms of a multi-arm robot, hands as in q."""
        palms, first = side_palms(self.robot, q[None]), np.zeros(1, np.intp)
        ends, _ = sample_trunks(
            self.subproblems, targets, q[None], palms, first, 0, ALTERNATIVES.trunks
        )
        ends = np.concatenate([q[None], ends])
        solutions = ends[self.subproblems.solved(targets, ends, targets.enforce_limits)]
        moving = [i for i in range(solutions.shape[1]) if i not in self.hand]
        fractions = self._range_fractions(solutions, moving)
        return [solutions[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]

    def _search_arms(
        self, targets: TargetBatch, q: Array, seed: int, q0: Array, prefer: str
    ) -> list[Array]:
        """Return solutions with different arms, refined from every branch and from random arms."""
        starts = self.robot.random(np.random.default_rng(seed), ALTERNATIVES.random_arms)
        starts[:, self.hand] = q[self.hand]
        if self._arm_branches is None and self.arm_search is not None:
            limits, no_bound = self.subproblems.limits(targets).first, np.full(1, np.inf)
            bounds, order = (limits.lower, limits.upper), {CLEARANCE: "limits"}.get(prefer, prefer)
            arms = self.arm_search.choose(q[None], q0[None], bounds, order, None, no_bound, True)
            starts = np.concatenate([arms.q, starts])
        starts = np.concatenate([q[None], starts])
        ends = LocalRefinement(self.subproblems, targets).run(
            np.zeros(len(starts), np.intp), starts
        )
        ends = np.concatenate([q[None], ends])
        hand_differences = np.abs(self._range_fractions(ends - q, self.hand))
        has_same_hand = (hand_differences < ALTERNATIVES.min_difference).all(axis=1)
        solved = self.subproblems.solved(targets, ends, targets.enforce_limits)
        solutions = ends[has_same_hand & solved]
        fractions = self._range_fractions(solutions, self._arm_motors)
        return [solutions[i] for i in distinct_rows(fractions, ALTERNATIVES.min_difference)]

    def _range_fractions(self, q: Array, columns: list[int]) -> Array:
        """Return columns of configurations divided by the motors' ranges."""
        return q[:, columns] / (self.robot.upper - self.robot.lower)[columns]

    def arm_margins(self, q: Array) -> Array:
        """Return the limit margins (k,) of the arm: smallest distance / half the range."""
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
            columns: Motors whose limit margins count; None: all.
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
        errors = verdict.position_error, verdict.angle_error, verdict.ok
        return Alternative(
            q=candidate.q,
            contacts=contact_verdicts(self.robot.fingers, targets.tolerances, *errors)[0],
            posture=candidate.posture,
            branch=candidate.branch,
            swivel=candidate.swivel,
            margin=float(self.score(q, q0, "limits")[0]),
            manipulability=float(self._manipulability_values(q)[0]),
            distance=float(-self.score(q, q0, "q0")[0]),
        )


def side_links(body: RobotDescription) -> list[tuple[frozenset[str], frozenset[str]]]:
    """Return for each side of a multi-arm robot the links of its arm and those of its hand."""
    moved = [body.links_moved(arm) for arm, _ in body.side_actuators]
    hands = [body.links_moved(arm[-1:]) for arm, _ in body.side_actuators]
    return [(links - hand, hand) for links, hand in zip(moved, hands, strict=True)]


def check_separation(apart: float) -> float:
    """Return the minimum difference of alternatives as a float.

    Raises:
        InputError: It is not a number from 0 to 1.
    """
    is_number = isinstance(apart, (int, float, np.integer, np.floating))
    if not is_number or isinstance(apart, bool) or not 0 <= apart <= 1:
        raise InputError(f"apart: found {apart!r}, expected a number from 0 to 1")
    return float(apart)


class ArmBranches:
    """The arms of a family with at most one redundancy parameter."""

    def __init__(self, family: ArmFamily, compiled: bool = True) -> None:
        """Compile the closed form of the arm or load it from the cache."""
        self.family = family
        self._closed_form = FunctionKernel(family.arms(), compiled)
        breakpoints = _breakpoints(family)
        self._breakpoints_kernel = (
            None if breakpoints is None else FunctionKernel(breakpoints, compiled)
        )

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Return every allowed interval of the redundancy of every branch.

        The limit margin of the arm is evaluated along the redundancy. Between two breakpoints it is
        either positive everywhere or nowhere. If the breakpoints are unknown, the margin is
        sampled, with a ternary search around its maxima, which finds intervals between two samples;
        bisection finds their ends. A joint with several turns takes the middle one. Intervals of an
        iterative family end at samples.

        Args:
            palm: (4, 4) palm pose, base frame.
            lower: (n,) lower bounds [rad].
            upper: (n,) upper bounds [rad].
        """

        def margins(values: Array) -> Array:
            return self._limit_margins(palm, values, lower, upper)

        if not self.family.redundancy:
            allowed = margins(np.zeros(1))[0] >= ARM_SEARCH.tolerance
            return [self._branch(int(row), None) for row in np.flatnonzero(allowed)]
        samples = self._samples(palm, lower, upper)
        is_sampled = self._breakpoints_kernel is None and not self.family.is_iterative
        if is_sampled:
            samples = np.unique(np.concatenate([samples, _margin_peaks(samples, margins)]))
        allowed = margins(samples) >= ARM_SEARCH.tolerance
        # Padding gives every interval a beginning and an end.
        padded = np.pad(allowed, ((1, 1), (0, 0)))
        rows, first = np.nonzero((padded[1:-1] & ~padded[:-2]).T)
        last = np.nonzero((padded[1:-1] & ~padded[2:]).T)[1]
        starts, stops = samples[first], samples[last]
        if is_sampled:
            outer = np.concatenate(
                [np.maximum(first - 1, 0), np.minimum(last + 1, len(samples) - 1)]
            )
            ends = np.concatenate([starts, stops])
            ends = _bisect_ends(ends, samples[outer], np.tile(rows, 2), margins)
            starts, stops = np.split(ends, 2)
        intervals = list(zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True))
        joined = self._join_intervals(intervals)
        return [self._branch(row, (first, last)) for row, first, last in joined]

    def arms(self, palm: Array, branch: ArmBranch, values: Array) -> Array:
        """Return the arms (k, n) [rad] of a branch at values (k,) of the redundancy."""
        arms, _ = self._closed_form(palm[:3, :3], palm[:3, 3], values)
        return arms[:, self._row(branch)]

    def _row(self, branch: ArmBranch) -> int:
        signs = tuple(getattr(branch, name) for name in self.family.sign_names)
        return SIGNS.index(signs) * self.family.roots + branch.root

    def best(
        self,
        palm: Array,
        branches: list[ArmBranch],
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> list[tuple[Array, float | None]]:
        """Return the arm of each branch with the highest score, and its redundancy.

        Args:
            palm: (4, 4) palm pose, base frame.
            branches: Branches with their allowed intervals.
            bounds: (n,) lower and (n,) upper bounds, those of `find`.
            score: Function from arms (k, n) to scores (k,).
        """
        if self.family.redundancy:
            return [self._best(palm, branch, bounds, score) for branch in branches]
        arms, _ = self._closed_form(palm[:3, :3], palm[:3, 3], np.zeros(1))
        return [(arms[0, self._row(branch)], None) for branch in branches]

    def _best(
        self,
        palm: Array,
        branch: ArmBranch,
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> tuple[Array, float | None]:
        """Return the best arm of a branch with an allowed interval, see `best`."""
        stop_if_cancelled()
        assert branch.swivel is not None
        first, last = branch.swivel
        values, zooms = np.linspace(first, last, ALTERNATIVES.branch_samples), ALTERNATIVES.zooms
        if self.family.is_iterative:
            values, zooms = self._samples(palm, *bounds), 0
            values = values[(values >= first) & (values <= last)]
        for _ in range(zooms):
            i = int(np.argmax(score(self.arms(palm, branch, values))))
            step = values[1] - values[0]
            ends = max(first, values[i] - step), min(last, values[i] + step)
            values = np.linspace(*ends, ALTERNATIVES.branch_samples)
        arms = self.arms(palm, branch, values)
        i = int(np.argmax(score(arms)))
        return arms[i], float(values[i])

    def _samples(self, palm: Array, lower: Array, upper: Array) -> Array:
        """Return the sorted values of the redundancy at which arms are computed."""
        low, high = (float(bound) for bound in self.family.redundancy[0].bounds(lower, upper))
        if self._breakpoints_kernel is not None:
            signs = np.array([1.0, -1.0])
            (breakpoints,) = self._breakpoints_kernel(
                palm[:3, :3], palm[:3, 3], signs, lower, upper
            )
            breakpoints = np.mod(breakpoints.ravel() - low, FULL_TURN) + low
            breakpoints = np.unique(np.append(breakpoints, [low, high]))
            return np.unique(
                np.concatenate([breakpoints, (breakpoints[1:] + breakpoints[:-1]) / 2])
            )
        if self.family.is_iterative:
            # Inside the bounds of the swept joint, where the other joints decide.
            count = ALTERNATIVES.iterative_samples
            return low + (high - low) * (np.arange(count) + 0.5) / count
        return np.linspace(low, high, ALTERNATIVES.samples)

    def _limit_margins(self, palm: Array, values: Array, lower: Array, upper: Array) -> Array:
        """Return the limit margins (k, rows) of all branches; out of reach the reach margin."""
        arms, reach_margin = self._closed_form(palm[:3, :3], palm[:3, 3], values)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        reach_margin = reach_margin.reshape(margin.shape)
        return np.where(reach_margin < 0, np.minimum(margin, reach_margin), margin)

    def _join_intervals(
        self, intervals: list[tuple[int, float, float]]
    ) -> list[tuple[int, float, float]]:
        """Join the intervals of an unbounded angle across +-pi."""
        if self.family.redundancy[0].joint is not None:
            return intervals
        joined = []
        for row in sorted({row for row, *_ in intervals}):
            row_intervals = [interval for interval in intervals if interval[0] == row]
            first, last = row_intervals[0], row_intervals[-1]
            if len(row_intervals) > 1 and first[1] <= -np.pi and last[2] >= np.pi:
                row_intervals = [*row_intervals[1:-1], (row, last[1], first[2] + FULL_TURN)]
            joined += row_intervals
        return joined

    def _branch(self, row: int, interval: tuple[float, float] | None) -> ArmBranch:
        number, root = divmod(row, self.family.roots)
        signs = dict(zip(self.family.sign_names, SIGNS[number], strict=True))
        return ArmBranch(**signs, swivel=interval, root=root)


def _breakpoints(family: ArmFamily) -> ca.Function | None:
    """Return (rotation, origin, elbow sign, lower, upper) -> redundancies with joints at bounds."""
    if not isinstance(family, ClosedForm):
        return None
    n, sign = len(family.screws), ca.SX.sym("sign")
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = ca.SX.sym("lower", n), ca.SX.sym("upper", n)
    values = family.breakpoints(Pose(rotation, origin), (sign,), lower, upper)
    if values is None:
        return None
    return ca.Function("breakpoints", [rotation, origin, sign, lower, upper], [values])


def _margin_peaks(grid: Array, margins: Callable[[Array], Array]) -> Array:
    """Return the maxima of the margins of branches between samples that are all outside."""
    margin = margins(grid)
    padded = np.pad(margin, ((1, 1), (0, 0)), constant_values=-np.inf)
    is_peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    sample, rows = np.nonzero(is_peak & (margin < ARM_SEARCH.tolerance))
    step, numbers = grid[1] - grid[0], np.arange(len(sample))
    first, last = (
        np.maximum(grid[sample] - step, grid[0]),
        np.minimum(grid[sample] + step, grid[-1]),
    )
    for _ in range(ALTERNATIVES.peak_steps if len(sample) else 0):
        lower_third, upper_third = first + (last - first) / 3, last - (last - first) / 3
        rises = margins(lower_third)[numbers, rows] < margins(upper_third)[numbers, rows]
        first, last = np.where(rises, lower_third, first), np.where(rises, last, upper_third)
    return (first + last) / 2


def _bisect_ends(
    inner: Array, outer: Array, rows: NDArray[np.intp], margins: Callable[[Array], Array]
) -> Array:
    """Return the ends of allowed intervals between allowed (inner) and other (outer) values."""
    numbers = np.arange(len(inner))
    for _ in range(ALTERNATIVES.bisection_steps if len(inner) else 0):
        middle = (inner + outer) / 2
        allowed = margins(middle)[numbers, rows] >= ARM_SEARCH.tolerance
        inner, outer = np.where(allowed, middle, inner), np.where(allowed, outer, middle)
    return inner
