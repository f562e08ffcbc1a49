"""Remedies that make a grasp solvable: relaxed limits, and free fingers or normals.

Remedies for targets whose solutions all collide are a shift of the object, and a finger without
contact. Every remedy is verified by a solution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.distances import gaps
from casadi_ik.collision.scene import Obstacle, Scene
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.diagnosis import ReleasedContact, Relief, Remedies
from casadi_ik.solve.solution import BatchSolution, SuggestedFix
from casadi_ik.solve.subproblems import (
    LocalRefinement,
    MotorBounds,
    SubproblemSolver,
    repeat_target,
)

RELAXATION_HALVINGS = 8
"""Number of bisection steps that minimize the relaxation of limits."""

MIN_LIMIT_EXCESS = 1e-9
"""Excess over a limit above which it is part of a remedy [rad or m]."""


@dataclass(frozen=True)
class RelaxedLimits:
    """Actuators whose limits are relaxed together.

    Attributes:
        name: Name of an actuator, or "arm", "hand" or "all".
        columns: Positions of the actuators in q.
    """

    name: str
    columns: tuple[int, ...]

    def widen(self, robot: ArmHand, bounds: MotorBounds, row: int) -> None:
        """Widen the bounds of a row by pi, or by the range of a prismatic actuator."""
        for i in self.columns:
            is_angle = robot.description.actuators[i].unit == "rad"
            extension = np.pi if is_angle else float(robot.upper[i] - robot.lower[i])
            bounds.lower[row, i] -= extension
            bounds.upper[row, i] += extension


def relaxation_candidates(
    robot: ArmHand, movable: NDArray[np.bool_], may_block: NDArray[np.bool_], hand_only: bool
) -> list[RelaxedLimits]:
    """Return the relaxations that may help.

    Args:
        robot: The robot.
        movable: (n,) True for actuators with a range.
        may_block: (n,) True for actuators whose limit alone may block the target.
        hand_only: True if the hand does not fit, so that the arm cannot help.
    """
    columns = tuple(map(int, np.flatnonzero(movable)))
    arm = tuple(i for i in columns if i in robot.description.arm_actuators)
    hand = tuple(i for i in columns if i in robot.description.hand_actuators)
    blocking = [i for i in (hand if hand_only else columns) if may_block[i]]
    single = [RelaxedLimits(robot.actuators[i], (i,)) for i in blocking]
    groups = {"hand": hand} if hand_only else {"arm": arm, "hand": hand, "all": columns}
    return single + [RelaxedLimits(name, group) for name, group in groups.items() if group]


def relax_limits(
    subproblems: SubproblemSolver,
    targets: TargetBatch,
    limits: MotorBounds,
    solved: list[tuple[RelaxedLimits, Array]],
    q: Array,
) -> Iterator[Relief]:
    """Yield the smallest relaxations that have a solution.

    Args:
        subproblems: Solver of subproblems.
        targets: One target.
        limits: The original limits.
        solved: Relaxations, each with a solution (n,).
        q: (n,) nearest configuration within the limits, from which a second fit starts.
    """
    if not solved:
        return
    count, robot = len(solved), subproblems.robot
    best = np.stack([solution for _, solution in solved])
    descent, rows = LocalRefinement(subproblems, targets), np.zeros(2 * count, dtype=np.intp)
    # The smallest relaxation lies between zero and that of the solution.
    lower, upper = np.zeros((count, 1)), np.ones((count, 1))
    violation = limits.violation(best)
    for _ in range(RELAXATION_HALVINGS):
        fraction = (lower + upper) / 2
        bounds = MotorBounds(
            limits.lower + np.minimum(violation, 0) * fraction,
            limits.upper + np.maximum(violation, 0) * fraction,
        )
        twice = MotorBounds(np.tile(bounds.lower, (2, 1)), np.tile(bounds.upper, (2, 1)))
        starts = np.concatenate([best, np.tile(q, (count, 1))])
        refined = descent.run(rows, starts, twice)
        solved_rows = subproblems.solved(targets, refined, limits=False).reshape(2, count)
        refined = refined.reshape(2, count, -1)
        new = np.where(solved_rows[0][:, None], refined[0], refined[1])
        either = np.logical_or(solved_rows[0], solved_rows[1])[:, None]
        best = np.where(either, new, best)
        upper = np.where(either, fraction, upper)
        lower = np.where(either, lower, fraction)
    units = {actuator.name: actuator.unit for actuator in robot.description.actuators}
    for (relaxation, _), solution in zip(solved, best, strict=True):
        violation_of_solution = limits.violation(solution)
        excess = {
            name: float(value)
            for name, value in zip(robot.actuators, violation_of_solution, strict=True)
            if abs(value) > MIN_LIMIT_EXCESS
        }
        yield Relief(relaxation.name, excess, units, solution)


@dataclass(frozen=True, eq=False)
class RemedyFinder:
    """A search for remedies that solves relaxed versions of a grasp.

    Attributes:
        subproblems: Solver of subproblems.
        targets: One target.
        q: (n,) nearest configuration of the failed solve.
        may_block: (n,) True for actuators whose limit alone may block the target.
        hand_only: True if the hand does not fit, so that the arm cannot help.
    """

    subproblems: SubproblemSolver
    targets: TargetBatch
    q: Array
    may_block: NDArray[np.bool_]
    hand_only: bool

    def find(self) -> Remedies:
        """Return all remedies."""
        return Remedies(tuple(self._reliefs()), tuple(self._with_free_contacts()))

    def limits_help(self) -> bool:
        """Return True if relaxed limits make the target solvable."""
        relaxations = self._relaxations()
        if not relaxations:
            return False
        candidates, bounds = (
            repeat_target(self.targets, len(relaxations)),
            self._relaxed_bounds(relaxations),
        )
        if self._solves(candidates, self._refine(candidates, bounds), bounds).any():
            return True
        # All limits relaxed together help if any of them does.
        last = MotorBounds(bounds.lower[-1:], bounds.upper[-1:])
        q = self.subproblems.search(self.targets, last)
        return bool(self._solves(self.targets, q, last)[0])

    def _reliefs(self) -> Iterator[Relief]:
        relaxations = self._relaxations()
        candidates = repeat_target(self.targets, len(relaxations))
        solutions = self._solutions(candidates, self._relaxed_bounds(relaxations))
        solved = [(relaxations[i], q) for i, q in solutions.items()]
        return relax_limits(self.subproblems, self.targets, self._limits, solved, self.q)

    def _with_free_contacts(self) -> Iterator[ReleasedContact]:
        freeings = self._relaxed_targets()
        if freeings:
            candidates = replace(
                self.targets,
                points=np.concatenate([targets.points for _, _, targets in freeings]),
                normals=np.concatenate([targets.normals for _, _, targets in freeings]),
                extra_vectors={
                    name: np.concatenate(
                        [targets.extra_vectors[name] for _, _, targets in freeings]
                    )
                    for name in self.targets.extra_vectors
                },
                row_numbers=None,
                # A remedy concerns contacts only.
                object_pose=None,
                palms=None,
            )
            for i, q in self._solutions(candidates, self._limits.tiled(len(candidates))).items():
                item, finger, _ = freeings[i]
                yield ReleasedContact(item, finger, q)

    @property
    def _limits(self) -> MotorBounds:
        return self.subproblems.limits(self.targets)

    def _relaxations(self) -> list[RelaxedLimits]:
        if not self.targets.enforce_limits:
            return []
        movable = self._limits.lower < self._limits.upper
        return relaxation_candidates(
            self.subproblems.robot, movable, movable & self.may_block, self.hand_only
        )

    def _relaxed_bounds(self, relaxations: list[RelaxedLimits]) -> MotorBounds:
        bounds = self._limits.tiled(len(relaxations))
        for i, relaxation in enumerate(relaxations):
            relaxation.widen(self.subproblems.robot, bounds, i)
        return bounds

    def _relaxed_targets(self) -> list[tuple[str, str, TargetBatch]]:
        """Return copies of the target with a free finger, a free normal or all normals free."""
        targets, relaxed_targets = self.targets, []
        has_point = ~np.isnan(targets.points[0, :, 0])
        has_normal = ~np.isnan(targets.normals[0, :, 0])
        for i, name in enumerate(self.subproblems.robot.fingers):
            points, normals = targets.points.copy(), targets.normals.copy()
            normals[0, i] = np.nan
            if has_normal[i]:
                relaxed_targets.append(
                    ("normal", name, _with_free_contacts(targets, points, normals))
                )
            if has_point[i] and has_point.sum() > 1:
                points[0, i] = np.nan
                relaxed_targets.append(
                    ("finger", name, _with_free_contacts(targets, points, normals))
                )
        if has_normal.sum() > 1:
            no_normals = np.full_like(targets.normals, np.nan)
            relaxed_targets.append(
                ("normal", "all", _with_free_contacts(targets, targets.points, no_normals))
            )
        return relaxed_targets

    def _solutions(self, candidates: TargetBatch, bounds: MotorBounds) -> dict[int, Array]:
        """Return solutions by row, fitted from the nearest configuration or found by a search."""
        q = self._refine(candidates, bounds)
        solved_rows = self._solves(candidates, q, bounds)
        failed = np.flatnonzero(~solved_rows)
        if len(failed):
            remaining_bounds = MotorBounds(bounds.lower[failed], bounds.upper[failed])
            remaining = candidates.rows(failed)
            q[failed] = self.subproblems.search(remaining, remaining_bounds)
            solved_rows[failed] = self._solves(remaining, q[failed], remaining_bounds)
        return {int(i): q[i] for i in np.flatnonzero(solved_rows)}

    def _refine(self, candidates: TargetBatch, bounds: MotorBounds) -> Array:
        rows = np.arange(len(candidates))
        starts = np.tile(self.q, (len(rows), 1))
        return LocalRefinement(self.subproblems, candidates).run(rows, starts, bounds)

    def _solves(self, candidates: TargetBatch, q: Array, bounds: MotorBounds) -> NDArray[np.bool_]:
        is_within_bounds = (bounds.violation(q) == 0).all(axis=1)
        return np.logical_and(
            is_within_bounds, self.subproblems.solved(candidates, q, limits=False)
        )


def _with_free_contacts(targets: TargetBatch, points: Array, normals: Array) -> TargetBatch:
    """Return a target with new points and normals, and no extra vectors of free contacts."""
    has_point, has_normal = ~np.isnan(points), ~np.isnan(normals)
    extra_vectors = {
        name: np.where(has_point & has_normal if name == "tangents" else has_point, array, np.nan)
        for name, array in targets.extra_vectors.items()
    }
    return replace(targets, points=points.copy(), normals=normals, extra_vectors=extra_vectors)


SHIFTS = (0.01, 0.02, 0.04, 0.08, 0.16)
"""Distances by which the object is shifted [m], in the order of the trials."""

SHIFT_HALVINGS = 4
"""Number of bisection steps that minimize a shift."""

SHIFT_DIRECTIONS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z],
    dtype=float,
)
SHIFT_DIRECTIONS /= np.linalg.norm(SHIFT_DIRECTIONS, axis=1, keepdims=True)
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""

DISTANCE_ROUNDING = 1e-9
"""Rounding error of distances of a shifted object [m]."""

SolveFree = Callable[[TargetBatch], NDArray[np.bool_]]
"""Function of k targets that returns (k,) True where a collision-free solution exists."""


def add_collision_remedies(
    solve_free: SolveFree, check: SceneCheck, targets: TargetBatch, batch: BatchSolution
) -> BatchSolution:
    """Add remedies to the collision report of a target.

    Args:
        solve_free: Function that solves targets without collisions.
        check: Collision check of the robot in its scene.
        targets: One target.
        batch: Its solution.

    Returns:
        The solution; unchanged if it does not collide.
    """
    (report,) = batch.collisions
    if report is None:
        return batch
    scene, target = check.scene, targets
    if targets.object_pose is None and scene.grasped in scene.items:
        target = targets.holding(scene.grasped or "", scene.items[scene.grasped or ""].pose)
    shift = _shortest_shift(target, _keeps_object_clearance(check, target), solve_free)
    fix = SuggestedFix(
        shift, SHIFTS[-1], _removable_fingers(target, check.robot.fingers, solve_free)
    )
    return replace(batch, collisions=(replace(report, way_out=fix),))


def _keeps_object_clearance(
    check: SceneCheck, targets: TargetBatch
) -> Callable[[Array], NDArray[np.bool_]]:
    """Return a function of shifts (k, 3) that is True where the object penetrates no deeper."""
    scene: Scene = check.scene
    name, pose = targets.object or scene.grasped or "", targets.object_pose
    if name and pose is not None:
        scene = scene.holding(name, pose[0])
    item = scene.items.get(name)
    obstacles: list[Obstacle] = [obstacle for key, obstacle in scene.items.items() if key != name]

    def keeps_clearance(shifts: Array) -> NDArray[np.bool_]:
        if item is None or not obstacles:
            return np.ones(len(shifts), dtype=bool)
        poses = np.repeat(item.pose[None], 1 + len(shifts), axis=0)
        poses[1:, :3, 3] += shifts
        distances = gaps(item, obstacles, poses)
        return distances[1:] >= min(float(distances[0]), 0.0) - DISTANCE_ROUNDING

    return keeps_clearance


def _shortest_shift(
    targets: TargetBatch,
    keeps_clearance: Callable[[Array], NDArray[np.bool_]],
    solve_free: SolveFree,
) -> tuple[float, float, float] | None:
    """Return the shortest shift with a collision-free solution; None if no shift has one."""

    def helps(shifts: Array) -> NDArray[np.bool_]:
        is_solved = keeps_clearance(shifts)
        if is_solved.any():
            is_solved[is_solved] = solve_free(_shifted(targets, shifts[is_solved]))
        return is_solved

    shorter_step = 0.0
    for step in SHIFTS:
        directions = SHIFT_DIRECTIONS[helps(step * SHIFT_DIRECTIONS)]
        if len(directions):
            low, high = np.full(len(directions), shorter_step), np.full(len(directions), step)
            for _ in range(SHIFT_HALVINGS):
                middle = (low + high) / 2
                is_solved = helps(middle[:, None] * directions)
                low, high = np.where(is_solved, low, middle), np.where(is_solved, middle, high)
                # Drop directions whose lower bound exceeds the smallest upper bound.
                is_shorter = low < high.min()
                low, high, directions = low[is_shorter], high[is_shorter], directions[is_shorter]
            x, y, z = (high[:, None] * directions)[int(high.argmin())].tolist()
            return x, y, z
        shorter_step = step
    return None


def _shifted(targets: TargetBatch, shifts: Array) -> TargetBatch:
    """Return copies of a target, moved by shifts (k, 3)."""
    candidates = targets.rows(np.zeros(len(shifts), dtype=np.intp))
    pose = candidates.object_pose
    if pose is not None:
        pose = pose.copy()
        pose[:, :3, 3] += shifts
    return replace(
        candidates,
        points=candidates.points + shifts[:, None],
        object_pose=pose,
        row_numbers=None,
        first_row=0,
    )


def _removable_fingers(
    targets: TargetBatch, fingers: Sequence[str], solve_free: SolveFree
) -> tuple[str, ...]:
    """Return the fingers whose removal makes a collision-free solution possible."""
    has_point = ~np.isnan(targets.points[0]).all(axis=1)
    has_normal = ~np.isnan(targets.normals[0]).all(axis=1)
    constrained = np.flatnonzero(has_point | has_normal)
    # Removing a finger with extra vectors would require a solver for other contact kinds.
    removable = [
        i
        for i in constrained.tolist()
        if all(np.isnan(v[0, i]).all() for v in targets.extra_vectors.values())
    ]
    if len(constrained) < 2:
        return ()
    return tuple(fingers[i] for i in removable if solve_free(_without_finger(targets, i))[0])


def _without_finger(targets: TargetBatch, finger: int) -> TargetBatch:
    """Return a target without the contact of a finger."""
    points, normals = targets.points.copy(), targets.normals.copy()
    points[:, finger], normals[:, finger] = np.nan, np.nan
    return replace(targets, points=points, normals=normals)
