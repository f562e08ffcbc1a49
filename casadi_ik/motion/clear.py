"""Motions that touch nothing: between postures, from one to another, from cycle to cycle.

*Between postures*, all along and not at samples alone (`between`). How far two shapes are apart
changes by no more than they move. So between two postures they keep at least half of what they have
at both ends together, less half of what they move on the way; where that is not enough, the middle
is looked at, and both halves. What moves by less than `RESOLUTION` between two postures that are
free is taken as free.

*From cycle to cycle* (`Guard`) two things keep a follower clear. The goal keeps away softly, as far
as the contacts leave it free: small clearances are rows of its least squares. And a step is made
only if the robot can come to rest after it without being too near to anything in any cycle; else
motors brake. Since the step before was made under the same condition, braking is safe: by induction
the robot never comes nearer than the margin to what stands still. Cycles are left out between which
a pair has no time to come near, and pairs that were far apart when all were looked at: by steps of
motors times levers (`collision.distances.levers`). A pair that motors of one hand alone can part
holds these back, one that an arm moves all of its side, and one that a trunk moves all motors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import ROUNDING, Clearances, CollisionQuery
from casadi_ik.collision.clearance_kernel import OBSTACLES, Guarding
from casadi_ik.collision.distances import levers
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.inputs import FollowerInputs, FollowPlan


def stopping_way(moved: Array, change: Array) -> Array:
    """(n,) how far motors go on that come to rest as fast as they may.

    Args:
        moved: (n,) their last steps.
        change: (n,) by how much a step may differ from the last.
    """
    after = np.floor(np.abs(moved) / change)
    return np.sign(moved) * (np.abs(moved) * after - change * after * (after + 1) / 2)


def stopping_path(q: Array, step: Array, change: Array) -> Array:
    """Where motors are in every cycle that make a step, and then come to rest as fast as they may.

    Args:
        q: (n,) where they are.
        step: (n,).
        change: (n,) by how much a step may differ from the last.

    Returns:
        (k, n), after the step the first and the place of rest the last.
    """
    speed = np.abs(step)
    after = np.floor(speed / change)
    steps = np.minimum(np.arange(after.max() + 1)[:, None], after)
    return q + step + np.sign(step) * (speed * steps - change * steps * (steps + 1) / 2)


RESOLUTION = 1e-4
"""Motion [m] that is not looked into: by half of it things may be nearer than their margin."""


@dataclass(frozen=True, eq=False)
class Between:
    """What was found on k - 1 straight ways.

    Attributes:
        free: (k - 1,) whether they touch nothing.
        worst: (k - 1, n) the posture with least room that was looked at on each.
        surplus: (k - 1,) clearance beyond the margin [m]; no posture on a free way has less by more
            than what it moves to the next that was looked at.
        distance: (k - 1,) its clearance, see `Clearances` [m].
        pairs: (k - 1,) number of its pair, see `Clearances`.
    """

    free: Bools
    worst: Array
    surplus: Array
    distance: Array
    pairs: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Postures:
    """Postures, and all that is known of them.

    Attributes:
        q: (m, n).
        poses: (m, s, 12) of the solids.
        places: (m, p) where shapes are, see `ClearanceKernel.placed`.
        found: (m, 3) room, clearance and number of its pair.
    """

    q: Array
    poses: Array
    places: Array
    found: Array

    @property
    def surplus(self) -> Array:
        return self.found[:, 0]

    def rows(self, rows: NDArray[np.intp] | slice) -> _Postures:
        return _Postures(self.q[rows], self.poses[rows], self.places[rows], self.found[rows])

    @classmethod
    def joined(cls, one: _Postures, other: _Postures) -> _Postures:
        pairs = (
            (one.q, other.q),
            (one.poses, other.poses),
            (one.places, other.places),
            (one.found, other.found),
        )
        return cls(*(np.concatenate(pair) for pair in pairs))


class _Looking:
    """What is looked at, in surroundings whose solids may move with the postures."""

    def __init__(self, query: CollisionQuery) -> None:
        self._query, table = query, query.table
        reach = np.array([solid.reach for solid in table.solids])
        # What is unbounded (a half-space) may move, too, but no scene turns it under a robot.
        self._own = np.where(np.isfinite(reach), reach, 0.0)[: table.own]
        self._reach = np.where(np.isfinite(reach), reach, 0.0)[table.own :]
        self._capsules = len(table.radii)

    def at(self, q: Array, poses: Array, together: int = 4096) -> _Postures:
        """Postures (m, n) with solids at (m, s, 12), so many checked at once."""
        parts = [slice(i, i + together) for i in range(0, len(q), together)]
        query, found, places = self._query, list[Array](), list[Array]()
        for part in parts:
            here = CollisionQuery(query.kernel, query.table, poses[part], query.margin)
            seen = here.check(q[part])
            found.append(np.stack([seen.surplus, seen.distance, seen.pairs.astype(float)], axis=1))
            places.append(query.kernel.shape_poses(q[part])[0])
        return _Postures(q, poses, np.concatenate(places), np.concatenate(found))

    def motion(self, one: _Postures, other: _Postures) -> Array:
        """(m,) how much nearer two shapes may come on the way [m], twice the largest motion."""
        split = 6 * self._capsules
        both = (other.places - one.places)[:, :split].reshape(len(one.q), -1, 2, 3)
        ends = np.stack([both[:, :, 0] + both[:, :, 1], both[:, :, 0] - both[:, :, 1]])
        moved = np.linalg.norm(ends, axis=-1).max(axis=(0, 2), initial=0.0)
        for change, reach in (
            ((other.places - one.places)[:, split:].reshape(len(one.q), -1, 12), self._own),
            (other.poses - one.poses, self._reach),
        ):
            if change.shape[1]:
                turned = np.linalg.norm(change[..., :9], axis=-1) * reach
                solids = np.linalg.norm(change[..., 9:], axis=-1) + turned
                moved = np.maximum(moved, solids.max(axis=1))
        # Joints that turn move things on arcs: how far these are off the straight line at most.
        far = np.linalg.norm(one.places[:, :split].reshape(len(one.q), -1, 3), axis=-1).max(
            axis=1, initial=0.0
        )
        turn = np.abs(other.q - one.q).sum(axis=1)
        return 2 * (moved + far * turn**2 / 4)

    def middle(self, one: _Postures, other: _Postures) -> _Postures:
        """The postures half way; what is carried turns half way, too."""
        return self.at((one.q + other.q) / 2, _half_way(one.poses, other.poses))


def between(query: CollisionQuery, q: Array, least: bool = False) -> Between:
    """What is on the straight ways from each of k postures to the next.

    Args:
        query: What must not be touched, the same for all, or at each posture.
        q: (k, n).
        least: Whether the least room of all is looked for, too: where all is free it is nowhere
            less than the smallest of `Between.surplus` by more than `RESOLUTION`.
    """
    count, n = max(len(q) - 1, 0), q.shape[1]
    poses = query.poses
    if poses.ndim == 3 and len(poses) != len(q):
        poses = poses[0]
    poses = np.broadcast_to(poses, (len(q), *poses.shape[-2:]))
    looking = _Looking(query)
    free, found = np.ones(count, dtype=bool), np.full((count, 3), np.inf)
    found[:, 2] = -1
    surplus, worst = found[:, 0], np.empty((count, n))
    every = looking.at(q, np.ascontiguousarray(poses))
    way = np.arange(count)
    one, other = every.rows(slice(0, count)), every.rows(slice(1, count + 1))

    def seen(some: _Postures, whose: NDArray[np.intp]) -> None:
        order = np.argsort(-some.surplus, kind="stable")
        less = order[some.surplus[order] < surplus[whose[order]]]
        # Behind each other the least comes last, and is what stays.
        found[whose[less]], worst[whose[less]] = some.found[less], some.q[less]
        free[whose[~(some.surplus >= -ROUNDING)]] = False

    seen(one, way)
    seen(other, way)
    while len(way):
        motion = looking.motion(one, other)
        floor = max(float(surplus.min()) - RESOLUTION, 0.0) if least else 0.0
        near = one.surplus + other.surplus < motion + 2 * floor
        kept = near & (motion > 2 * RESOLUTION) & free[way]
        rows = np.flatnonzero(kept)
        if not len(rows):
            break
        one, other, way = one.rows(rows), other.rows(rows), way[rows]
        middle = looking.middle(one, other)
        seen(middle, way)
        one, other = _Postures.joined(one, middle), _Postures.joined(middle, other)
        way = np.concatenate([way, way])
    return Between(free, worst, surplus, found[:, 1], found[:, 2].astype(np.int64))


def least_clearance(query: CollisionQuery, q: Array) -> tuple[float, str]:
    """The least clearance on the straight ways from each of k postures to the next.

    Args:
        query: As for `between`.
        q: (k, n).

    Returns:
        The clearance [m]: it is nowhere less by more than `RESOLUTION`, if all is free; and what
        touches, "": nothing does.
    """
    if len(q) < 2:
        q = np.concatenate([q, q])
    ways = between(query, q, least=True)
    clearance = float(ways.distance.min())
    if ways.free.all():
        return clearance, ""
    pair = query.table.names[ways.pairs[int(ways.surplus.argmin())]]
    return clearance, f"{pair[0]} and {pair[1]} touch"


def _half_way(one: Array, other: Array) -> Array:
    """(m, s, 12) poses half way: origins and rotations."""
    mean = (one + other) / 2
    turned = np.flatnonzero((one[..., :9] != other[..., :9]).any(axis=(1, 2)))
    if len(turned):
        u, _, v = np.linalg.svd(mean[turned, :, :9].reshape(len(turned), -1, 3, 3))
        mean[turned, :, :9] = (u @ v).reshape(len(turned), -1, 9)
    return mean


class Held(Protocol):
    """A robot with what it holds: what is free of collisions is for it to say."""

    def blocked(self, q: Array) -> str:
        """What is in the way between postures (k, n); "": nothing."""
        ...

    def in_the_way(self, q: Array) -> str:
        """What touches in one posture (1, n); "": nothing."""
        ...


def _blocked(query: CollisionQuery | Held, q: Array) -> bool:
    """Whether anything is in the way from each of some postures (k, n) to the next."""
    if isinstance(query, CollisionQuery):
        return not between(query, q).free.all()
    return bool(query.blocked(q))


def _touching(query: CollisionQuery | Held, q: Array) -> str:
    """What touches in one posture (1, n); "": nothing."""
    if not isinstance(query, CollisionQuery):
        return query.in_the_way(q)
    if query.free(q)[0]:
        return ""
    return f"{' and '.join(query.check(q).pair(0) or ())} touch"


STRIDES = (0.02, 0.005, 0.002)
"""Longest steps of a motor between postures that a planner looks at [rad, or part of its range]:
finer ones where a way turns out not to be free between them."""


def motor_units(robot: ArmHand) -> Array:
    """(n,) what counts as a unit of each motor: 1 rad, or the range of a slider."""
    slides = np.array([actuator.unit == "m" for actuator in robot.description.actuators])
    return np.where(slides, robot.upper - robot.lower, 1.0)


def free_way(
    robot: ArmHand,
    start: Array,
    end: Array,
    query: CollisionQuery | Held | None,
    seed: int,
    limit: float = 5.0,
) -> tuple[Array | None, str]:
    """Corners (k, n) of a way that touches nothing, straight if that is free.

    Args:
        robot: The robot.
        start: (n,).
        end: (n,).
        query: What must not be touched; None: nothing is checked.
        seed: Of the planner.
        limit: Time that it has [s].

    Returns:
        The corners, None if no way was found; and how it was found, or why not.
    """
    units, straight = motor_units(robot), np.stack([start, end])
    if query is None or not _blocked(query, straight):
        return straight, "straight"
    for posture, name in ((start, "start"), (end, "pre-grasp")):
        if touching := _touching(query, posture[None]):
            return None, f"the {name} is not free: {touching}"
    try:
        from ompl import base, geometric, util
    except ImportError:
        return None, "the straight way is not free, and OMPL is not installed (casadi-ik[motion])"
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # OMPL takes the first of a process
    n = len(start)
    endless = robot.description.continuous
    lower = np.where(endless, np.minimum(start, end) - np.pi, robot.lower)
    upper = np.where(endless, np.maximum(start, end) + np.pi, robot.upper)
    if not (query is None or isinstance(query, CollisionQuery)):
        # What is held stays held: but for rounding the hand does not move.
        hand = np.isin(np.arange(n), robot.description.hand_actuators)
        lower = np.where(hand, np.minimum(start, end) - 1e-7, lower)
        upper = np.where(hand, np.maximum(start, end) + 1e-7, upper)
    space = base.RealVectorStateSpace(n)
    bounds = base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(lower[i] / units[i]))
        bounds.setHigh(i, float(upper[i] / units[i]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(
        lambda state: not _touching(query, units * _numbers(state, n)[None])
    )
    states: list[Any] = []
    for posture in (start, end):
        state: Any = space.allocState()
        for i in range(n):
            state[i] = float(posture[i] / units[i])
        states.append(state)
    setup.setStartAndGoalStates(*states)
    information = setup.getSpaceInformation()
    for stride in STRIDES:
        setup.clear()
        information.setStateValidityCheckingResolution(stride / space.getMaximumExtent())
        setup.setPlanner(geometric.RRTConnect(information))
        setup.solve(limit)
        if not setup.haveExactSolutionPath():
            return None, f"the straight way is not free, and OMPL found no other in {limit:g} s"
        setup.simplifySolution(limit / 5)
        found_way = setup.getSolutionPath().getStates()
        corners = units * np.array([_numbers(state, n) for state in found_way])
        corners[0], corners[-1] = start, end
        if not _blocked(query, corners):
            return corners, "OMPL, RRT-Connect"
    return None, "the ways that OMPL found are not free between the postures it looked at"


def _numbers(state: Any, n: int) -> Array:
    """A state of OMPL, whose annotations do not know that it has elements, as (n,)."""
    return np.array([state[i] for i in range(n)])


class Guard:
    """The scene about a follower.

    Attributes:
        near: Clearance beyond the margin from which on the goal keeps away [m].
        nudge: Part of a motor's unit by which slopes of clearances are measured [rad or m].
        exact: What distances of solids are worked out to, and a little more [m].
        shares: Parts of the wanted step, beside braking, that are tried in turn.
    """

    near = 0.01
    nudge = 1e-4
    exact = 1e-6
    shares = (1.0,)

    def __init__(self, plan: FollowPlan) -> None:
        """Take the scene, every finger in contact."""
        assert plan.check is not None
        self._check, self._robot = plan.check, plan.robot.description
        fingers, n = len(plan.robot.fingers), len(plan.robot.actuators)
        self._n, self._change = n, plan.rates.steps(plan.period)[1]
        self._hand = np.isin(np.arange(n), self._robot.hand_actuators).astype(float)
        self._side = np.zeros(n)
        self._side[list(self._robot.trunk_actuators)] = -1
        for number, motors in enumerate(self._robot.side_actuators):
            self._side[list(sum(motors, ()))] = number
        anywhere = np.zeros((1, fingers, 3))
        self._query = self._at(plan.request.of_arrays(anywhere, anywhere + 1.0, None))
        self._lay_out()

    def surround(self, problem: TargetBatch) -> None:
        """Mind one target: which fingers touch, and where the object is."""
        query, before = self._at(problem), self._query
        self._query = query
        if query.table is not before.table:
            self._lay_out()
        elif self._compiled is not None and not np.array_equal(query.poses, before.poses):
            self._compiled.surround(query.poses)

    def _at(self, problem: TargetBatch) -> CollisionQuery:
        return self._check.collision_query(problem).rows(np.zeros(1, dtype=np.intp))

    def _lay_out(self) -> None:
        """Memory for the distances that are looked at."""
        query = self._query
        self._enough, self._minded = query.margin + self.exact, query.margin + self.near
        self._levers = levers(self._robot, query.table)
        self._compiled = None
        if query.kernel.entry is not None:
            self._compiled = Guarding(
                query.kernel,
                query.poses,
                query.table,
                self._levers,
                self._hand,
                self._side,
                self._change,
                self.shares,
                enough=self._enough,
                minded=self._minded,
                nudge=self.nudge,
            )

    def clearance(self, q: Array) -> Clearances:
        """Of a configuration (n,)."""
        return self._query.check(q[None])

    def are_free(self, q: Array) -> bool:
        """Return whether configurations (m, n) are free."""
        return bool((self._query.check(q).surplus >= self.exact).all())

    def step(self, asked: FollowerInputs, step: Array | None = None) -> tuple[Array, bool]:
        """Make a step, or the part of it after which the motors can stop in time.

        Args:
            asked: The graph.
            step: (n,) step of the motors; None: that of the graph.

        Returns:
            The state, and whether the motors had to brake.
        """
        n, run = self._n, asked.run
        before = run.state
        if step is None:
            rooms, slopes = asked.views["rooms"], asked.views["slopes"]
            rooms[...], slopes[...] = self._obstacles(before[2 * n : 3 * n])
            after = run.step()
        else:
            after = asked.step_by(step)
        q, wanted = before[:n], after[n : 2 * n]
        part, step, rest = self._free_step(q, before[n : 2 * n], wanted)
        held = part < 1.0
        if not held.any():
            return after, False
        after[:n], after[n : 2 * n] = q + step, step
        # A goal that runs ahead where nobody can follow would be reached through the obstacle.
        np.copyto(after[2 * n : 3 * n], rest, where=held)
        after[3 * n] = 0.0
        return after, True

    def _free_step(self, q: Array, last: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """What of a wanted step is free, and can end free.

        Motors that move a pair nearer than is free, or than it is if that is less, make less of
        theirs, and brake at last: where all motors of a pair brake was free in the cycle before.

        Returns:
            (n,) the part that each motor makes of it; the step; where it ends.
        """
        if (guarding := self._compiled) is not None:
            guarding.q[...], guarding.last[...], guarding.wanted[...] = q, last, wanted
            guarding.stop_in_time()
            return guarding.part, guarding.step, guarding.rest
        braked = np.sign(last) * np.maximum(np.abs(last) - self._change, 0.0)
        shares, tried = np.array([*self.shares, 0.0]), np.zeros(self._n, dtype=int)
        while True:
            step = braked + shares[tried] * (wanted - braked)
            path = stopping_path(q, step, self._change)
            here, *every = self._query.kernel.all_distances(
                np.concatenate([q[None], path]), self._query.poses, self._query.table
            )
            touching = ~(every >= np.minimum(here, self._enough)).all(axis=0)
            less = self._held(self._levers[touching] > 0)
            less &= tried < len(self.shares)
            if not less.any():
                return shares[tried], step, path[-1]
            tried += less

    def _held(self, moving: Bools) -> Bools:
        """(n,) motors that pairs hold back which the motors (p, n) move, as in guard.c."""
        arms = (moving & (self._hand == 0)).any(axis=0)
        sides = np.isin(self._side, self._side[arms]) | (self._side[arms] < 0).any()
        return moving.any(axis=0) | sides

    def _obstacles(self, goal: Array) -> tuple[Array, Array]:
        """What the nearest pairs at a goal lack (o,) [m], and how that shrinks (o, n)."""
        if (guarding := self._compiled) is not None:
            guarding.goal[...] = goal
            guarding.keep_away()
            return guarding.rooms, guarding.slopes
        rooms, slopes = np.zeros(OBSTACLES), np.zeros((OBSTACLES, self._n))
        nudged = goal + np.concatenate([np.zeros((1, self._n)), self.nudge * np.eye(self._n)])
        every = self._query.kernel.all_distances(nudged, self._query.poses, self._query.table)
        order = np.argsort(every[0], kind="stable")
        nearest, omitted = order[:OBSTACLES], order[OBSTACLES : OBSTACLES + 1]
        count, minded = len(nearest), every[0, omitted].min(initial=self._minded)
        rooms[:count] = np.maximum(minded - every[0, nearest], 0.0)
        slopes[:count] = ((every[1:, nearest] - every[0, nearest]) / self.nudge).T
        return rooms, slopes
