"""Collision-free paths: checks between postures, and planning of paths.

The distance of two shapes changes by at most as much as they move. Between two postures a pair
therefore keeps at least half of the sum of its clearances at both ends, less half of its motion in
between. `check_path` evaluates the middle posture where this bound does not suffice, and then both
halves. A segment with free ends on which no shape moves by more than `PATH_RESOLUTION` counts as
free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.arm_hand import ArmHand

PATH_RESOLUTION = 1e-4
"""Motion below which a segment is not divided [m]; clearances may be lower by half of it."""


@dataclass(frozen=True, eq=False)
class PathCheck:
    """Result of checking k - 1 straight segments.

    Attributes:
        free: (k - 1,) True if a segment is free of collisions.
        worst: (k - 1, n) evaluated posture with the minimum clearance on each segment.
        surplus: (k - 1,) clearance of this posture beyond the margin [m]. On a free segment other
            postures have less by at most the motion to the next evaluated posture.
        distance: (k - 1,) clearance of this posture, see `Clearances` [m].
        pairs: (k - 1,) index of its nearest pair, see `Clearances`.
    """

    free: Bools
    worst: Array
    surplus: Array
    distance: Array
    pairs: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Evaluated postures.

    Attributes:
        q: (m, n) postures.
        solid_poses: (m, s, 12) poses of the scene's solids.
        shapes: (m, p) positions of the robot's shapes, see `ClearanceKernel.shape_poses`.
        clearances: (m, 3) columns: clearance beyond the margin [m], clearance [m], and index of the
            nearest pair.
    """

    q: Array
    solid_poses: Array
    shapes: Array
    clearances: Array

    @property
    def surplus(self) -> Array:
        return self.clearances[:, 0]

    def rows(self, rows: NDArray[np.intp] | slice) -> _Samples:
        return _Samples(
            self.q[rows], self.solid_poses[rows], self.shapes[rows], self.clearances[rows]
        )

    @classmethod
    def concatenate(cls, first: _Samples, second: _Samples) -> _Samples:
        pairs = (
            (first.q, second.q),
            (first.solid_poses, second.solid_poses),
            (first.shapes, second.shapes),
            (first.clearances, second.clearances),
        )
        return cls(*(np.concatenate(pair) for pair in pairs))


class _Sampler:
    """Evaluates postures in a scene whose solids may move with them."""

    def __init__(self, query: CollisionQuery) -> None:
        self._query, table = query, query.table
        reach = np.array([solid.reach for solid in table.solids])
        # A half-space may translate, but scenes do not rotate it.
        bounded_reach = np.where(np.isfinite(reach), reach, 0.0)
        self._robot_reach = bounded_reach[: table.n_robot_solids]
        self._scene_reach = bounded_reach[table.n_robot_solids :]
        self._capsules = len(table.radii)

    def evaluate(self, q: Array, solid_poses: Array, block: int = 4096) -> _Samples:
        """Evaluate postures (m, n) with solids at (m, s, 12), `block` of them at once."""
        query, clearances, shapes = self._query, list[Array](), list[Array]()
        for first in range(0, len(q), block):
            rows = slice(first, first + block)
            block_query = CollisionQuery(query.kernel, query.table, solid_poses[rows], query.margin)
            check = block_query.check(q[rows])
            columns = check.surplus, check.distance, check.pairs.astype(float)
            clearances.append(np.stack(columns, axis=1))
            shapes.append(query.kernel.shape_poses(q[rows])[0])
        return _Samples(q, solid_poses, np.concatenate(shapes), np.concatenate(clearances))

    def approach_bound(self, start: _Samples, end: _Samples) -> Array:
        """Return upper bounds (m,) of the change of clearances on each segment [m].

        The bound is twice the maximum motion of a shape.
        """
        split, count = 6 * self._capsules, len(start.q)
        change = end.shapes - start.shapes
        axes = change[:, :split].reshape(count, -1, 2, 3)
        end_motion = np.stack([axes[:, :, 0] + axes[:, :, 1], axes[:, :, 0] - axes[:, :, 1]])
        motion = np.linalg.norm(end_motion, axis=-1).max(axis=(0, 2), initial=0.0)
        for pose_change, reach in (
            (change[:, split:].reshape(count, -1, 12), self._robot_reach),
            (end.solid_poses - start.solid_poses, self._scene_reach),
        ):
            if pose_change.shape[1]:
                rotation = np.linalg.norm(pose_change[..., :9], axis=-1) * reach
                solids = np.linalg.norm(pose_change[..., 9:], axis=-1) + rotation
                motion = np.maximum(motion, solids.max(axis=1))
        # Revolute joints move shapes on arcs: this bounds their distance from the chord.
        radius = np.linalg.norm(start.shapes[:, :split].reshape(count, -1, 3), axis=-1).max(
            axis=1, initial=0.0
        )
        angle = np.abs(end.q - start.q).sum(axis=1)
        return 2 * (motion + radius * angle**2 / 4)

    def midpoints(self, start: _Samples, end: _Samples) -> _Samples:
        """Evaluate the middle postures, with solids at the middle of their motion."""
        solid_poses = _middle_poses(start.solid_poses, end.solid_poses)
        return self.evaluate((start.q + end.q) / 2, solid_poses)


def check_path(query: CollisionQuery, q: Array, find_minimum: bool = False) -> PathCheck:
    """Check the straight segments between consecutive postures for collisions.

    Args:
        query: Scene at each posture, or one scene for all of them.
        q: (k, n) postures.
        find_minimum: True to find the minimum clearance: on a free path the minimum of
            `PathCheck.surplus` then exceeds the true minimum by at most `PATH_RESOLUTION`.
    """
    count, n = max(len(q) - 1, 0), q.shape[1]
    solid_poses = query.poses
    if solid_poses.ndim == 3 and len(solid_poses) != len(q):
        solid_poses = solid_poses[0]
    solid_poses = np.broadcast_to(solid_poses, (len(q), *solid_poses.shape[-2:]))
    sampler = _Sampler(query)
    free, clearances = np.ones(count, dtype=bool), np.full((count, 3), np.inf)
    clearances[:, 2] = -1
    surplus, worst = clearances[:, 0], np.empty((count, n))
    samples = sampler.evaluate(q, np.ascontiguousarray(solid_poses))
    segment = np.arange(count)
    start, end = samples.rows(slice(0, count)), samples.rows(slice(1, count + 1))

    def record(samples: _Samples, segment: NDArray[np.intp]) -> None:
        order = np.argsort(-samples.surplus, kind="stable")
        smaller = order[samples.surplus[order] < surplus[segment[order]]]
        # Among several samples of a segment the last assignment counts: the minimum clearance.
        clearances[segment[smaller]] = samples.clearances[smaller]
        worst[segment[smaller]] = samples.q[smaller]
        free[segment[~(samples.surplus >= -DISTANCE_ROUNDING)]] = False

    record(start, segment)
    record(end, segment)
    while len(segment):
        bound = sampler.approach_bound(start, end)
        floor = max(float(surplus.min()) - PATH_RESOLUTION, 0.0) if find_minimum else 0.0
        is_uncertain = start.surplus + end.surplus < bound + 2 * floor
        is_uncertain &= (bound > 2 * PATH_RESOLUTION) & free[segment]
        rows = np.flatnonzero(is_uncertain)
        if not len(rows):
            break
        start, end, segment = start.rows(rows), end.rows(rows), segment[rows]
        middle = sampler.midpoints(start, end)
        record(middle, segment)
        start, end = _Samples.concatenate(start, middle), _Samples.concatenate(middle, end)
        segment = np.concatenate([segment, segment])
    return PathCheck(free, worst, surplus, clearances[:, 1], clearances[:, 2].astype(np.int64))


def minimum_clearance(query: CollisionQuery, q: Array) -> tuple[float, str]:
    """Return the minimum clearance on the straight segments between consecutive postures.

    Args:
        query: As in `check_path`.
        q: (k, n) postures.

    Returns:
        Minimum clearance [m], with an error of at most `PATH_RESOLUTION` on a free path; and the
        colliding pair as text, "" on a free path.
    """
    if len(q) < 2:
        q = np.concatenate([q, q])
    check = check_path(query, q, find_minimum=True)
    clearance = float(check.distance.min())
    if check.free.all():
        return clearance, ""
    pair = query.table.names[check.pairs[int(check.surplus.argmin())]]
    return clearance, f"{pair[0]} and {pair[1]} touch"


def _middle_poses(start: Array, end: Array) -> Array:
    """Return the poses (m, s, 12) with mean origins and mean rotations."""
    mean = (start + end) / 2
    rotates = (start[..., :9] != end[..., :9]).any(axis=(1, 2))
    rows = np.flatnonzero(rotates)
    if len(rows):
        u, _, v = np.linalg.svd(mean[rows, :, :9].reshape(len(rows), -1, 3, 3))
        mean[rows, :, :9] = (u @ v).reshape(len(rows), -1, 9)
    return mean


class PathChecker(Protocol):
    """Collision checks of a robot that carries an object."""

    def path_obstruction(self, q: Array) -> str:
        """Return the reason why the straight path through postures (k, n) is not free, or ""."""
        ...

    def contact_at(self, q: Array) -> str:
        """Return the colliding pair of a posture (1, n) as text, "" if it is free."""
        ...


def _is_obstructed(query: CollisionQuery | PathChecker, q: Array) -> bool:
    """Return True if the straight path through postures (k, n) is not free."""
    if isinstance(query, CollisionQuery):
        return not check_path(query, q).free.all()
    return bool(query.path_obstruction(q))


def _contact_at(query: CollisionQuery | PathChecker, q: Array) -> str:
    """Return the colliding pair of a posture (1, n) as text, "" if it is free."""
    if not isinstance(query, CollisionQuery):
        return query.contact_at(q)
    if query.free(q)[0]:
        return ""
    return f"{' and '.join(query.check(q).pair(0) or ())} touch"


STRIDES = (0.02, 0.005, 0.002)
"""Maximum motor steps between the postures that the planner checks [rad, or fraction of the range].

A finer step is used if a path is not free between these postures.
"""


def motor_units(robot: ArmHand) -> Array:
    """Return the unit (n,) of each motor: 1 rad, or the range of a slider [m]."""
    slides = np.array([actuator.unit == "m" for actuator in robot.description.actuators])
    return np.where(slides, robot.upper - robot.lower, 1.0)


def plan_path(
    robot: ArmHand,
    start: Array,
    end: Array,
    query: CollisionQuery | PathChecker | None,
    seed: int,
    limit: float = 5.0,
) -> tuple[Array | None, str]:
    """Plan a collision-free path, which is straight if the straight line is free.

    Args:
        robot: Robot that moves.
        start: (n,) first posture.
        end: (n,) last posture.
        query: Collision checks; None checks nothing.
        seed: Seed of the planner.
        limit: Time limit of the planner [s].

    Returns:
        Corners (k, n) of the path, None on failure; and how it was planned, or the reason of the
        failure.
    """
    units, straight = motor_units(robot), np.stack([start, end])
    if query is None or not _is_obstructed(query, straight):
        return straight, "straight"
    for posture, name in ((start, "start"), (end, "pre-grasp")):
        if contact := _contact_at(query, posture[None]):
            return None, f"the {name} is not free: {contact}"
    try:
        from ompl import base, geometric, util
    except ImportError:
        return None, "the straight path is not free, and OMPL is not installed (casadi-ik[motion])"
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # OMPL uses the first seed of a process
    n = len(start)
    lower, upper = _search_bounds(robot, start, end, carries=not isinstance(query, CollisionQuery))
    space = base.RealVectorStateSpace(n)
    bounds = base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(lower[i] / units[i]))
        bounds.setHigh(i, float(upper[i] / units[i]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(
        lambda state: not _contact_at(query, units * _numbers(state, n)[None])
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
            reason = f"the straight path is not free, and OMPL has not found another in {limit:g} s"
            return None, reason
        setup.simplifySolution(limit / 5)
        path_states = setup.getSolutionPath().getStates()
        corners = units * np.array([_numbers(state, n) for state in path_states])
        corners[0], corners[-1] = start, end
        if not _is_obstructed(query, corners):
            return corners, "OMPL, RRT-Connect"
    return None, "the paths of OMPL are not free between the postures that it checked"


def _search_bounds(robot: ArmHand, start: Array, end: Array, carries: bool) -> tuple[Array, Array]:
    """Return the bounds (n,) of the postures on a path.

    Args:
        robot: Robot that moves.
        start: (n,) first posture.
        end: (n,) last posture.
        carries: True if the hand carries an object, so that its posture must not change.
    """
    # A continuous joint may take half a turn beyond both ends.
    is_endless = robot.description.continuous
    lower = np.where(is_endless, np.minimum(start, end) - np.pi, robot.lower)
    upper = np.where(is_endless, np.maximum(start, end) + np.pi, robot.upper)
    if carries:
        # The interval allows for rounding.
        is_hand = np.isin(np.arange(len(start)), robot.description.hand_actuators)
        lower = np.where(is_hand, np.minimum(start, end) - 1e-7, lower)
        upper = np.where(is_hand, np.maximum(start, end) + 1e-7, upper)
    return lower, upper


def _numbers(state: Any, n: int) -> Array:
    """Return a state of OMPL as (n,); its annotations do not declare elements."""
    return np.array([state[i] for i in range(n)])
