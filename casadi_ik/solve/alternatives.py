"""Several solutions of one grasp: hand postures, arm branches, and which of them to prefer."""

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
from casadi_ik.solve.hand_first.body import BodyStep
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.request import CLEARANCE, resolve_preference
from casadi_ik.solve.solution import Alternative, ArmBranch
from casadi_ik.solve.trials import (
    Bounds,
    LocalRefinement,
    Subproblems,
    distinct_rows,
    palm_coordinates,
    sample_trunks,
    side_palms,
)
from casadi_ik.solve.turns import nearest_turns, search_start
from casadi_ik.solve.verdict import contact_verdicts, judge

APART = 0.25
"""Least difference of alternatives unless said otherwise, see `AlternativeFinder.find`."""

TURN = 2 * np.pi


@dataclass(frozen=True)
class AlternativeParameters:
    """How several solutions are found: hands, arms, the stretches of a redundancy that are allowed.

    Attributes:
        distinct: Hands and arms that are searched count as different if a motor differs by this
            part of its range.
        close: Tolerance [m, rad] that hand postures are brought to first, so that equals are seen
            as equal.
        trunks: Of a body, that are tried with each hand.
        arms: Random ones that an arm without a closed form is solved from.
        blocked: Taken off the score of what is not free: more than any score.
        positions: Looked at along the bounds, where breakpoints are not known.
        iterative_positions: Of an iterative family: each costs a search for all roots.
        thirds: That the neighbourhood of a position is cut down by, to find a short stretch within.
        halvings: Of a step between two positions, to find the end of a stretch.
        samples: Looked at along a stretch for its best arm, and again around the best of them.
        zooms: How often; each time the steps shrink to a sixteenth.
    """

    distinct: float = 0.05
    close: float = 1e-7
    trunks: int = 64
    arms: int = 64
    blocked: float = 1e6
    positions: int = 361
    iterative_positions: int = 37
    thirds: int = 12
    halvings: int = 45
    samples: int = 33
    zooms: int = 2


SEEKING = AlternativeParameters()


@dataclass(frozen=True, eq=False)
class _Found:
    q: Array
    posture: int
    branch: ArmBranch | None = None
    swivel: float | None = None


class AlternativeFinder:
    """Finds all solutions of grasps on one robot.

    Attributes:
        robot: The robot.
        trials: The loop of hand-first.
        hand: Positions in q of the hand's actuators.
    """

    def __init__(self, robot: ArmHand, method: HandSearch, compiled: bool = True) -> None:
        """Take the robot and hand-first on it."""
        self.robot = robot
        self.trials = Subproblems(robot, method)
        self._compiled = compiled
        self._arm = list(robot.description.arm_actuators)
        self.hand = list(robot.description.hand_actuators)

    @cached_property
    def _branches(self) -> ArmBranches | None:
        """None where locked joints leave more than stretches to enumerate."""
        arm = self.trials.method.step.arm
        return None if arm is None or arm.locked else ArmBranches(arm, self._compiled)

    @cached_property
    def arm_search(self) -> ArmSearch | None:
        """All arms of hands; None for an arm of no family, and without an arm."""
        family = self.trials.method.step.arm
        return None if family is None else self._arm_search(family, self._arm)

    @cached_property
    def side_searches(self) -> list[ArmSearch]:
        """The same for every side of a body; none where one is of no family."""
        step, arms = self.trials.method.step, self.robot.description.side_actuators
        families = [side.family for side in step.sides] if isinstance(step, BodyStep) else []
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
        """Of the arm, for a configuration; of a body the least of its arms."""
        robot, q = self.robot.description, ca.SX.sym("q", len(self.robot.actuators))
        body, found = actuated(robot, q), list[ca.SX]()
        arms = [arm for arm, _ in robot.side_actuators] or [self._arm]
        for carrier, arm in zip(robot.sides or [robot], arms, strict=True):
            palm = body.kinematics.links[carrier.palm_link].at(carrier.palm_placement)
            jacobian = ca.vertcat(*body.twist(carrier.palm_link, palm.origin, arm))
            found.append(manipulability(jacobian))
        measure = ca.mmin(ca.vertcat(*found))
        return FunctionKernel(ca.Function("arm_manipulability", [q], [measure]), self._compiled)

    def find(
        self,
        targets: TargetBatch,
        q0: Array,
        seed: int,
        limit: int,
        prefer: str,
        apart: float = APART,
        query: CollisionQuery | None = None,
    ) -> tuple[Alternative, ...]:
        """Different solutions of one target, best first.

        All that are found are ranked; one that is closer than `apart` to a better one is left out.

        Args:
            targets: One target.
            q0: (n,) where the robot is.
            seed: Of the starts of arms without a closed form.
            limit: How many at most.
            prefer: One of `PREFERENCES`.
            apart: Of any two, at least one motor differs by this part of its range. The motors of
                a hand that may close as it likes, and elbows that may swing a little further,
                would else fill the list with what is hardly to be told apart.

            query: What solutions must not touch; None: nothing is checked.

        Raises:
            InputError: Bad limit, preference or distance.
        """
        if not isinstance(limit, (int, np.integer)) or limit < 1:
            raise InputError(f"limit: found {limit!r}, expected an integer >= 1")
        resolve_preference(prefer, has_start=True)
        apart = checked_distance(apart)
        limits = self.trials.limits(targets).first
        robot, bounds, start = self.robot.description, (limits.lower, limits.upper), q0
        q0 = search_start(robot, start)
        found: list[_Found] = []
        for number, q in enumerate(self._postures(targets, q0, limits)):
            found += self._arms(targets, q, number, limits, q0, seed, prefer, query)
        if not found:
            return ()
        q = np.stack([item.q for item in found])
        q = nearest_turns(robot, q, q0, bounds, prefer == "q0")
        solved = self.trials.solved(targets, q, targets.enforce_limits)
        if query is not None:
            solved &= query.free(q)
        keys = np.stack([self._valued(q, q0, prefer, query), self._margins(q, self._arm)])
        order = [int(i) for i in np.lexsort(-keys[::-1]) if solved[i]]
        parts = self._parts(q[order], list(range(q.shape[1])))
        kept = distinct_rows(parts, apart)[:limit]
        q = nearest_turns(robot, q, start, bounds, prefer == "q0")
        chosen = [replace(found[order[i]], q=q[order[i]]) for i in kept]
        return tuple(self._described(targets, alternative, start) for alternative in chosen)

    def best_arm(self, targets: TargetBatch, q: Array, q0: Array, seed: int, prefer: str) -> Array:
        """The solution (n,) with the hand where a given one has it, and the best arm for it.

        Args:
            targets: One target.
            q: (n,) a solution.
            q0: (n,) where the robot is.
            seed: Of the starts of arms without a closed form.
            prefer: One of `PREFERENCES`.
        """
        limits = self.trials.limits(targets).first
        found = self._arms(targets, q, 0, limits, q0, seed, prefer)
        every = np.stack([q, *(item.q for item in found)])
        solved = self.trials.solved(targets, every, targets.enforce_limits)
        every = every[solved] if solved.any() else q[None]
        return every[int(np.argmax(self.score(every, q0, prefer)))]

    def _postures(self, targets: TargetBatch, q0: Array, limits: Bounds) -> list[Array]:
        """Solutions (n,) with different hands, from every candidate of every round."""
        trials, method = self.trials, self.trials.method
        rounds = range(method.options.rounds)
        postures = np.concatenate([method.postures(targets, number)[0] for number in rounds])
        start, first = limits.clip(q0)[None], np.zeros(1, dtype=np.intp)
        _, states, parameters = trials.hand_rows(targets, first, start, postures[None])
        loose = parameters.copy()
        trials.set_tolerance(parameters, SEEKING.close)
        q = trials.run(states, parameters)
        exact = replace(targets, tolerance=Tolerance(10 * SEEKING.close, 10 * SEEKING.close))
        kept = q[trials.solved(exact, q, targets.enforce_limits)]
        if not len(kept):
            # Reachable thanks to the tolerances only, if at all.
            q = np.concatenate([q, trials.run(states, loose)])
            kept = q[trials.solved(targets, q, targets.enforce_limits)]
        if not len(kept):
            # The restarts of the whole search find what the rounds from tables miss.
            q = method.run(targets, q0[None], 0, trace=False).q
            kept = q[trials.solved(targets, q, targets.enforce_limits)]
        return [kept[i] for i in distinct_rows(self.hand_parts(kept), SEEKING.distinct)]

    def hand_parts(self, q: Array) -> Array:
        """Return the numbers that distinguish hand poses: motors, and the palm that an arm moves.

        Args:
            q: (m, n) configurations.

        Returns:
            (m, h) motors of the hand divided by their ranges; with an arm (m, h + 12), followed by
            the pose of the palm (`palm_coordinates`). Contacts such as those of two opposed fingers
            leave the palm free, so that equal postures of the hand are different hand poses.
        """
        parts = self._parts(q, self.hand)
        if not self._arm:
            return parts
        return np.concatenate([parts, palm_coordinates(self.robot.palm(q))], axis=1)

    def _arms(
        self,
        targets: TargetBatch,
        q: Array,
        posture: int,
        limits: Bounds,
        q0: Array,
        seed: int,
        prefer: str,
        query: CollisionQuery | None = None,
    ) -> list[_Found]:
        """Every arm that brings the hand of q where it is; of a body some trunks and arms."""
        if self.robot.description.sides:
            return [_Found(one, posture) for one in self._other_trunks(targets, q)]
        if not self._arm:
            return [_Found(q, posture)]
        if self._branches is None:
            return [_Found(arm, posture) for arm in self._searched(targets, q, seed, q0, prefer)]
        palm = self.robot.palm(q)
        lower, upper = (self._seen_by_form(end, limits) for end in (limits.lower, limits.upper))

        def with_arm(arms: Array) -> Array:
            whole = np.tile(q, (len(arms), 1))
            whole[:, self._arm] = arms
            return limits.clip(whole)

        def valued(arms: Array) -> Array:
            return self._valued(with_arm(arms), q0, prefer, query, self._arm)

        branches = self._branches.find(palm, lower, upper)
        found = [
            _Found(with_arm(arm[None])[0], posture, branch, swivel)
            for branch, (arm, swivel) in zip(
                branches, self._branches.best(palm, branches, (lower, upper), valued), strict=True
            )
        ]
        if self._branches.family.is_iterative:
            # A stretch may be shorter than the positions are apart.
            found += [_Found(arm, posture) for arm in self._searched(targets, q, seed, q0, prefer)]
            parts = self._parts(np.stack([item.q for item in found]), self._arm)
            return [found[i] for i in distinct_rows(parts, SEEKING.distinct)]
        return self._exact(targets, found) or [_Found(q, posture)]

    def _seen_by_form(self, end: Array, limits: Bounds) -> Array:
        """(a,) bounds of the arm, those of held joints in the turn in which a form gives them."""
        middle = (self.robot.lower + self.robot.upper) / 2
        turns = np.floor((end - middle + np.pi) / TURN)
        moved = np.where(limits.lower < limits.upper, end, end - TURN * turns)
        return moved[self._arm]

    def _exact(self, targets: TargetBatch, found: list[_Found]) -> list[_Found]:
        """Arms that are only nearly of their form are brought to the contacts."""
        family = self.trials.method.step.arm
        if not found or family is None or family.is_exact:
            return found
        starts = np.stack([item.q for item in found])
        ends = LocalRefinement(self.trials, targets).run(np.zeros(len(found), np.intp), starts)
        return [replace(item, q=end) for item, end in zip(found, ends, strict=True)]

    def _other_trunks(self, targets: TargetBatch, q: Array) -> list[Array]:
        """Different trunks and arms of a body, its hands as in q."""
        palms, first = side_palms(self.robot, q[None]), np.zeros(1, np.intp)
        ends, _ = sample_trunks(self.trials, targets, q[None], palms, first, 0, SEEKING.trunks)
        ends = np.concatenate([q[None], ends])
        kept = ends[self.trials.solved(targets, ends, targets.enforce_limits)]
        moving = [i for i in range(kept.shape[1]) if i not in self.hand]
        return [kept[i] for i in distinct_rows(self._parts(kept, moving), SEEKING.distinct)]

    def _searched(
        self, targets: TargetBatch, q: Array, seed: int, q0: Array, prefer: str
    ) -> list[Array]:
        """Different arms: the preferred of every branch, and those found from random ones."""
        starts = self.robot.random(np.random.default_rng(seed), SEEKING.arms)
        starts[:, self.hand] = q[self.hand]
        if self._branches is None and self.arm_search is not None:
            limits, no_cap = self.trials.limits(targets).first, np.full(1, np.inf)
            bounds, order = (limits.lower, limits.upper), {CLEARANCE: "limits"}.get(prefer, prefer)
            found = self.arm_search.choose(q[None], q0[None], bounds, order, None, no_cap, True)
            starts = np.concatenate([found.q, starts])
        starts = np.concatenate([q[None], starts])
        ends = LocalRefinement(self.trials, targets).run(np.zeros(len(starts), np.intp), starts)
        ends = np.concatenate([q[None], ends])
        same = (np.abs(self._parts(ends - q, self.hand)) < SEEKING.distinct).all(axis=1)
        kept = ends[same & self.trials.solved(targets, ends, targets.enforce_limits)]
        return [kept[i] for i in distinct_rows(self._parts(kept, self._arm), SEEKING.distinct)]

    def _parts(self, q: Array, columns: list[int]) -> Array:
        """Some columns of configurations as parts of their ranges."""
        return q[:, columns] / (self.robot.upper - self.robot.lower)[columns]

    def arm_margins(self, q: Array) -> Array:
        """(k,) smallest distance of the arm from its limits, as a part of half its range."""
        return self._margins(q, self._arm)

    def _margins(self, q: Array, columns: list[int]) -> Array:
        half = (self.robot.upper - self.robot.lower)[columns] / 2
        inside = np.minimum(q - self.robot.lower, self.robot.upper - q)[:, columns] / half
        return inside.min(axis=1) if columns else np.ones(len(q))

    def _valued(
        self,
        q: Array,
        q0: Array,
        prefer: str,
        query: CollisionQuery | None,
        columns: list[int] | None = None,
    ) -> Array:
        """(k,) `score`; what is not free comes last."""
        surplus = None if query is None else query.check(q).surplus
        score = self.score(q, q0, prefer, columns, surplus)
        return (
            score if surplus is None else np.where(surplus >= 0, score, surplus - SEEKING.blocked)
        )

    def score(
        self,
        q: Array,
        q0: Array,
        prefer: Preference,
        columns: list[int] | None = None,
        surplus: Array | None = None,
    ) -> Array:
        """(k,) what is preferred of configurations, higher is better.

        Args:
            q: (k, n).
            q0: (n,) or (k, n) where the robot is.
            prefer: What is preferred.
            columns: Motors whose distance from the limits counts; None: all.
            surplus: (k,) for "clearance".
        """
        if callable(prefer):
            return np.asarray(prefer(q), dtype=float)
        if prefer == CLEARANCE and surplus is not None:
            return surplus
        every = list(range(q.shape[1]))
        if prefer == "limits":
            return self._margins(q, every if columns is None else columns)
        if prefer == "q0":
            return -np.linalg.norm(self._parts(q - q0, every), axis=1)
        return self._measured(q)

    def _measured(self, q: Array) -> Array:
        held = self._arm or self.robot.description.sides
        return self.manipulability(q)[0] if held else np.zeros(len(q))

    def _described(self, targets: TargetBatch, found: _Found, q0: Array) -> Alternative:
        q = found.q[None]
        verdict = judge(self.robot, targets, q)
        errors = verdict.position_error, verdict.angle_error, verdict.ok
        return Alternative(
            q=found.q,
            contacts=contact_verdicts(self.robot.fingers, targets.tolerances, *errors)[0],
            posture=found.posture,
            branch=found.branch,
            swivel=found.swivel,
            margin=float(self.score(q, q0, "limits")[0]),
            manipulability=float(self._measured(q)[0]),
            distance=float(-self.score(q, q0, "q0")[0]),
        )


def side_links(body: RobotDescription) -> list[tuple[frozenset[str], frozenset[str]]]:
    """Of every side of a body the links that it moves: its arm's, and those with the palm."""
    moved = [body.links_moved(arm) for arm, _ in body.side_actuators]
    hands = [body.links_moved(arm[-1:]) for arm, _ in body.side_actuators]
    return [(links - hand, hand) for links, hand in zip(moved, hands, strict=True)]


def checked_distance(apart: float) -> float:
    """A least difference of configurations.

    Raises:
        InputError: It is none.
    """
    number = isinstance(apart, (int, float, np.integer, np.floating))
    if not number or isinstance(apart, bool) or not 0 <= apart <= 1:
        raise InputError(f"apart: found {apart!r}, expected a number from 0 to 1")
    return float(apart)


class ArmBranches:
    """Enumerates the arms of a family with one number of redundancy or none."""

    def __init__(self, family: ArmFamily, compiled: bool = True) -> None:
        """Compile the functions of the arm or load them from the cache."""
        self.family = family
        self._at = FunctionKernel(family.arms(), compiled)
        edges = _breakpoints(family)
        self._edges = None if edges is None else FunctionKernel(edges, compiled)

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every stretch of every branch, its ends as exact as the margins are.

        The margin (the least distance of a joint from its bounds) is looked at all along the
        redundancy: between two breakpoints all are allowed or none. Where they are not known,
        closer wherever it is largest: a stretch between two positions is found by its peak. Of a
        joint that turns more than once the middle turn is taken. Stretches of an iterative family
        end at positions that were looked at.

        Args:
            palm: (4, 4) pose of the palm, base frame.
            lower: (n,) bounds [rad].
            upper: (n,).
        """

        def margins(values: Array) -> Array:
            return self._margins(palm, values, lower, upper)

        if not self.family.redundancy:
            allowed = margins(np.zeros(1))[0] >= ARM_SEARCH.tolerance
            return [self._branch(int(row), None) for row in np.flatnonzero(allowed)]
        positions = self._positions(palm, lower, upper)
        refined = self._edges is None and not self.family.is_iterative
        if refined:
            peaks = _peaks(positions, margins)
            positions = np.unique(np.concatenate([positions, peaks]))
        allowed = margins(positions) >= ARM_SEARCH.tolerance
        # With a row of none on either side every stretch has a beginning and an end.
        padded = np.pad(allowed, ((1, 1), (0, 0)))
        rows, first = np.nonzero((padded[1:-1] & ~padded[:-2]).T)
        last = np.nonzero((padded[1:-1] & ~padded[2:]).T)[1]
        starts, stops = positions[first], positions[last]
        if refined:
            outer = np.concatenate(
                [np.maximum(first - 1, 0), np.minimum(last + 1, len(positions) - 1)]
            )
            ends = np.concatenate([starts, stops])
            starts, stops = np.split(_ends(ends, positions[outer], np.tile(rows, 2), margins), 2)
        stretches = zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True)
        joined = self._joined(list(stretches))
        return [self._branch(row, (first, last)) for row, first, last in joined]

    def arms(self, palm: Array, branch: ArmBranch, values: Array) -> Array:
        """Configurations (k, n) [rad] of a branch at values (k,) of the redundancy."""
        arms, _ = self._at(palm[:3, :3], palm[:3, 3], values)
        return arms[:, self._row(branch)]

    def _row(self, branch: ArmBranch) -> int:
        signs = tuple(getattr(branch, part) for part in self.family.sign_names)
        return SIGNS.index(signs) * self.family.roots + branch.root

    def best(
        self,
        palm: Array,
        branches: list[ArmBranch],
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> list[tuple[Array, float | None]]:
        """Of every branch the arm with the highest score, and its redundancy.

        Args:
            palm: (4, 4).
            branches: With their stretches.
            bounds: (n,) and (n,), those that they were found with.
            score: Of configurations (k, n) -> (k,).
        """
        if self.family.redundancy:
            return [self._best(palm, branch, bounds, score) for branch in branches]
        arms, _ = self._at(palm[:3, :3], palm[:3, 3], np.zeros(1))
        return [(arms[0, self._row(branch)], None) for branch in branches]

    def _best(
        self,
        palm: Array,
        branch: ArmBranch,
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> tuple[Array, float | None]:
        """See `best`; of a branch with a stretch."""
        stop_if_cancelled()
        assert branch.swivel is not None
        first, last = branch.swivel
        values, zooms = np.linspace(first, last, SEEKING.samples), SEEKING.zooms
        if self.family.is_iterative:
            values, zooms = self._positions(palm, *bounds), 0
            values = values[(values >= first) & (values <= last)]
        for _ in range(zooms):
            i = int(np.argmax(score(self.arms(palm, branch, values))))
            step = values[1] - values[0]
            ends = max(first, values[i] - step), min(last, values[i] + step)
            values = np.linspace(*ends, SEEKING.samples)
        arms = self.arms(palm, branch, values)
        i = int(np.argmax(score(arms)))
        return arms[i], float(values[i])

    def _positions(self, palm: Array, lower: Array, upper: Array) -> Array:
        """Values of the redundancy that are looked at, sorted."""
        low, high = (float(end) for end in self.family.redundancy[0].bounds(lower, upper))
        if self._edges is not None:
            sides = np.array([1.0, -1.0])
            (edges,) = self._edges(palm[:3, :3], palm[:3, 3], sides, lower, upper)
            edges = np.unique(np.append(np.mod(edges.ravel() - low, TURN) + low, [low, high]))
            return np.unique(np.concatenate([edges, (edges[1:] + edges[:-1]) / 2]))
        if self.family.is_iterative:
            # Away from the ends: the swept joint is within its limits, the others tell apart.
            count = SEEKING.iterative_positions
            return low + (high - low) * (np.arange(count) + 0.5) / count
        return np.linspace(low, high, SEEKING.positions)

    def _margins(self, palm: Array, values: Array, lower: Array, upper: Array) -> Array:
        """(k, rows) of every branch; the slack where it is out of reach."""
        arms, slack = self._at(palm[:3, :3], palm[:3, 3], values)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        slack = slack.reshape(margin.shape)
        return np.where(slack < 0, np.minimum(margin, slack), margin)

    def _joined(self, stretches: list[tuple[int, float, float]]) -> list[tuple[int, float, float]]:
        """Those of an angle that goes all around are joined where the turn ends."""
        if self.family.redundancy[0].joint is not None:
            return stretches
        joined = []
        for row in sorted({row for row, *_ in stretches}):
            own = [stretch for stretch in stretches if stretch[0] == row]
            if len(own) > 1 and own[0][1] <= -np.pi and own[-1][2] >= np.pi:
                own = [*own[1:-1], (row, own[-1][1], own[0][2] + TURN)]
            joined += own
        return joined

    def _branch(self, row: int, stretch: tuple[float, float] | None) -> ArmBranch:
        number, root = divmod(row, self.family.roots)
        signs = dict(zip(self.family.sign_names, SIGNS[number], strict=True))
        return ArmBranch(**signs, swivel=stretch, root=root)


def _breakpoints(family: ArmFamily) -> ca.Function | None:
    """(rotation, origin, sign of the bend, lower, upper) -> where joints may stand at bounds."""
    if not isinstance(family, ClosedForm):
        return None
    n, sign = len(family.screws), ca.SX.sym("sign")
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = ca.SX.sym("lower", n), ca.SX.sym("upper", n)
    found = family.breakpoints(Pose(rotation, origin), (sign,), lower, upper)
    if found is None:
        return None
    return ca.Function("breakpoints", [rotation, origin, sign, lower, upper], [found])


def _peaks(grid: Array, margins: Callable[[Array], Array]) -> Array:
    """Where the margin of a branch is largest between positions that are all outside."""
    margin = margins(grid)
    padded = np.pad(margin, ((1, 1), (0, 0)), constant_values=-np.inf)
    top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    at, rows = np.nonzero(top & (margin < ARM_SEARCH.tolerance))
    step, each = grid[1] - grid[0], np.arange(len(at))
    first, last = np.maximum(grid[at] - step, grid[0]), np.minimum(grid[at] + step, grid[-1])
    for _ in range(SEEKING.thirds if len(at) else 0):
        near, far = first + (last - first) / 3, last - (last - first) / 3
        rising = margins(near)[each, rows] < margins(far)[each, rows]
        first, last = np.where(rising, near, first), np.where(rising, last, far)
    return (first + last) / 2


def _ends(
    inner: Array, outer: Array, rows: NDArray[np.intp], margins: Callable[[Array], Array]
) -> Array:
    """Where branches cease to be allowed from an allowed value to one that is not."""
    each = np.arange(len(inner))
    for _ in range(SEEKING.halvings if len(inner) else 0):
        middle = (inner + outer) / 2
        allowed = margins(middle)[each, rows] >= ARM_SEARCH.tolerance
        inner, outer = np.where(allowed, middle, inner), np.where(allowed, outer, middle)
    return inner
