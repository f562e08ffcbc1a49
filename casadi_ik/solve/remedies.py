"""What would make a grasp solvable: limits lifted, fingers or normals left free.

Where every answer touches something: the object elsewhere, a finger fewer. Whatever is said to help
was solved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.distances import gaps
from casadi_ik.collision.scene import Item, Scene
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.diagnosis import Freed, Relief, Remedies
from casadi_ik.solve.solution import BatchSolution, SuggestedFix
from casadi_ik.solve.trials import Bounds, LocalRefinement, Subproblems, repeat_target

HALVINGS = 8
"""How often what a limit has to give is halved, while a solution remains."""

NOTHING = 1e-9
"""What counts as not beyond a limit [rad or m]."""


@dataclass(frozen=True)
class Lift:
    """Limits that are lifted together.

    Attributes:
        name: An actuator, or "arm", "hand" or "all".
        columns: Positions in q.
    """

    name: str
    columns: tuple[int, ...]

    def widen(self, robot: ArmHand, bounds: Bounds, row: int) -> None:
        """Move the bounds of a row outwards: by half a turn, or by the range of a slider."""
        for i in self.columns:
            turning = robot.description.actuators[i].unit == "rad"
            far = np.pi if turning else float(robot.upper[i] - robot.lower[i])
            bounds.lower[row, i] -= far
            bounds.upper[row, i] += far


def lifts(
    robot: ArmHand, movable: NDArray[np.bool_], pressed: NDArray[np.bool_], hand_only: bool
) -> list[Lift]:
    """All lifts worth trying.

    Args:
        robot: The robot.
        movable: (n,) whether an actuator may move at all.
        pressed: (n,) whether its limit alone may be what blocks.
        hand_only: Whether the arm cannot help, because the hand does not fit.
    """
    every = tuple(map(int, np.flatnonzero(movable)))
    arm = tuple(i for i in every if i in robot.description.arm_actuators)
    hand = tuple(i for i in every if i in robot.description.hand_actuators)
    asked = [i for i in (hand if hand_only else every) if pressed[i]]
    single = [Lift(robot.actuators[i], (i,)) for i in asked]
    groups = {"hand": hand} if hand_only else {"arm": arm, "hand": hand, "all": every}
    return single + [Lift(name, columns) for name, columns in groups.items() if columns]


def relax_limits(
    trials: Subproblems,
    targets: TargetBatch,
    limits: Bounds,
    solved: list[tuple[Lift, Array]],
    q: Array,
) -> Iterator[Relief]:
    """Draw lifted limits back towards where they are, as long as there is a solution.

    Args:
        trials: The loop.
        targets: One target.
        limits: The true limits.
        solved: Lifts with a solution (n,) each.
        q: (n,) the nearest configuration within the true limits, a second start.
    """
    if not solved:
        return
    count, robot = len(solved), trials.robot
    best = np.stack([solution for _, solution in solved])
    descent, rows = LocalRefinement(trials, targets), np.zeros(2 * count, dtype=np.intp)
    # What is given lies between two configurations: one within the limits, one that solves it.
    least, most = np.zeros((count, 1)), np.ones((count, 1))
    beyond = limits.beyond(best)
    for _ in range(HALVINGS):
        share = (least + most) / 2
        bounds = Bounds(
            limits.lower + np.minimum(beyond, 0) * share,
            limits.upper + np.maximum(beyond, 0) * share,
        )
        twice = Bounds(np.tile(bounds.lower, (2, 1)), np.tile(bounds.upper, (2, 1)))
        starts = np.concatenate([best, np.tile(q, (count, 1))])
        reached = descent.run(rows, starts, twice)
        ok = trials.solved(targets, reached, limits=False).reshape(2, count)
        reached = reached.reshape(2, count, -1)
        new = np.where(ok[0][:, None], reached[0], reached[1])
        either = np.logical_or(ok[0], ok[1])[:, None]
        best = np.where(either, new, best)
        most, least = np.where(either, share, most), np.where(either, least, share)
    units = {actuator.name: actuator.unit for actuator in robot.description.actuators}
    for (lift, _), solution in zip(solved, best, strict=True):
        over = limits.beyond(solution)
        far = {
            name: float(value)
            for name, value in zip(robot.actuators, over, strict=True)
            if abs(value) > NOTHING
        }
        yield Relief(lift.name, far, units, solution)


@dataclass(frozen=True, eq=False)
class RemedyFinder:
    """Solves a grasp again with less asked, and proves what helps by a solution.

    Attributes:
        trials: The loop.
        targets: One target.
        q0: (n,) start.
        q: (n,) the nearest configuration that was found.
        pressed: (n,) actuators whose limit alone may be what blocks.
        hand_only: Whether the arm cannot help, because the hand does not fit.
    """

    trials: Subproblems
    targets: TargetBatch
    q0: Array
    q: Array
    pressed: NDArray[np.bool_]
    hand_only: bool

    def find(self) -> Remedies:
        """Everything that helps."""
        return Remedies(tuple(self._reliefs()), tuple(self._freed()))

    def lifting_helps(self) -> bool:
        """Whether lifting limits helps at all: there are reliefs."""
        tried = self._lifts()
        if not tried:
            return False
        asked, bounds = repeat_target(self.targets, len(tried)), self._lifted(tried)
        if self._solves(asked, self._descended(asked, bounds), bounds).any():
            return True
        # Lifted all together they help if any of them does.
        last = Bounds(bounds.lower[-1:], bounds.upper[-1:])
        found = self.trials.search(self.targets, self.q0, last)
        return bool(self._solves(self.targets, found, last)[0])

    def _reliefs(self) -> Iterator[Relief]:
        tried = self._lifts()
        asked = repeat_target(self.targets, len(tried))
        solutions = self._solutions(asked, self._lifted(tried))
        solved = [(tried[i], q) for i, q in solutions.items()]
        return relax_limits(self.trials, self.targets, self._limits, solved, self.q)

    def _freed(self) -> Iterator[Freed]:
        freeings = self._freeings()
        if freeings:
            asked = replace(
                self.targets,
                points=np.concatenate([targets.points for _, _, targets in freeings]),
                normals=np.concatenate([targets.normals for _, _, targets in freeings]),
                more={
                    name: np.concatenate([targets.more[name] for _, _, targets in freeings])
                    for name in self.targets.more
                },
                picked=None,
                object_pose=None,  # contacts alone are looked at here
            )
            for i, q in self._solutions(asked, self._limits.tiled(len(asked))).items():
                part, finger, _ = freeings[i]
                yield Freed(part, finger, q)

    @property
    def _limits(self) -> Bounds:
        return self.trials.limits(self.targets)

    def _lifts(self) -> list[Lift]:
        if not self.targets.enforce_limits:
            return []
        movable = self._limits.lower < self._limits.upper
        return lifts(self.trials.robot, movable, movable & self.pressed, self.hand_only)

    def _lifted(self, tried: list[Lift]) -> Bounds:
        bounds = self._limits.tiled(len(tried))
        for i, lift in enumerate(tried):
            lift.widen(self.trials.robot, bounds, i)
        return bounds

    def _freeings(self) -> list[tuple[str, str, TargetBatch]]:
        """The target with a finger, a normal or all normals left free."""
        targets, found = self.targets, []
        known = ~np.isnan(targets.points[0, :, 0])
        faced = ~np.isnan(targets.normals[0, :, 0])
        for i, name in enumerate(self.trials.robot.fingers):
            points, normals = targets.points.copy(), targets.normals.copy()
            normals[0, i] = np.nan
            if faced[i]:
                found.append(("normal", name, _freed(targets, points, normals)))
            if known[i] and known.sum() > 1:
                points[0, i] = np.nan
                found.append(("finger", name, _freed(targets, points, normals)))
        if faced.sum() > 1:
            none = np.full_like(targets.normals, np.nan)
            found.append(("normal", "all", _freed(targets, targets.points, none)))
        return found

    def _solutions(self, asked: TargetBatch, bounds: Bounds) -> dict[int, Array]:
        """Solutions by row: from the nearest configuration, else by a search."""
        q = self._descended(asked, bounds)
        ok = self._solves(asked, q, bounds)
        rest = np.flatnonzero(~ok)
        if len(rest):
            left = Bounds(bounds.lower[rest], bounds.upper[rest])
            some = asked.rows(rest)
            q[rest] = self.trials.search(some, self.q0, left)
            ok[rest] = self._solves(some, q[rest], left)
        return {int(i): q[i] for i in np.flatnonzero(ok)}

    def _descended(self, asked: TargetBatch, bounds: Bounds) -> Array:
        rows = np.arange(len(asked))
        starts = np.tile(self.q, (len(rows), 1))
        return LocalRefinement(self.trials, asked).run(rows, starts, bounds)

    def _solves(self, asked: TargetBatch, q: Array, bounds: Bounds) -> NDArray[np.bool_]:
        inside = (bounds.beyond(q) == 0).all(axis=1)
        return np.logical_and(inside, self.trials.solved(asked, q, limits=False))


def _freed(targets: TargetBatch, points: Array, normals: Array) -> TargetBatch:
    """A target without what goes with the points and normals that are now free."""
    placed, faced = ~np.isnan(points), ~np.isnan(normals)
    more = {
        name: np.where(placed & faced if name == "tangents" else placed, array, np.nan)
        for name, array in targets.more.items()
    }
    return replace(targets, points=points.copy(), normals=normals, more=more)


SHIFTS = (0.01, 0.02, 0.04, 0.08, 0.16)
"""How far the object is moved [m], until it helps."""

SHIFT_HALVINGS = 4
"""By which the shortest way is found once one helps."""

WAYS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z],
    dtype=float,
)
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""

ROUNDING = 1e-9
"""By which a moved object may be nearer to something than it stands [m]."""

Free = Callable[[TargetBatch], NDArray[np.bool_]]
"""Of k targets, which have a free answer."""


def with_way_out(
    free: Free, check: SceneCheck, targets: TargetBatch, batch: BatchSolution
) -> BatchSolution:
    """The answer to one target that touches something, with what else would do in its report.

    Args:
        free: Solves targets.
        check: The scene about the robot.
        targets: The target.
        batch: The answer.
    """
    (report,) = batch.collisions
    if report is None:
        return batch
    scene, known = check.scene, targets
    if targets.object_pose is None and scene.grasped in scene.items:
        known = targets.holding(scene.grasped or "", scene.items[scene.grasped or ""].pose)
    moved = _moved(known, _standing(check, known), free)
    found = SuggestedFix(moved, SHIFTS[-1], _fewer(known, check.robot.fingers, free))
    return replace(batch, collisions=(replace(report, way_out=found),))


def _standing(check: SceneCheck, targets: TargetBatch) -> Callable[[Array], NDArray[np.bool_]]:
    """Which shifts (k, 3) let what is grasped stand as free as it stands now."""
    scene: Scene = check.scene
    name, pose = targets.object or scene.grasped or "", targets.object_pose
    if name and pose is not None:
        scene = scene.holding(name, pose[0])
    item = scene.items.get(name)
    others: list[Item] = [one for key, one in scene.items.items() if key != name]

    def stands(shifts: Array) -> NDArray[np.bool_]:
        if item is None or not others:
            return np.ones(len(shifts), dtype=bool)
        poses = np.repeat(item.pose[None], 1 + len(shifts), axis=0)
        poses[1:, :3, 3] += shifts
        every = gaps(item, others, poses)
        return every[1:] >= min(float(every[0]), 0.0) - ROUNDING

    return stands


def _moved(
    targets: TargetBatch, stands: Callable[[Array], NDArray[np.bool_]], free: Free
) -> tuple[float, float, float] | None:
    """The shortest shift that helps."""

    def helps(shifts: Array) -> NDArray[np.bool_]:
        good = stands(shifts)
        if good.any():
            good[good] = free(_shifted(targets, shifts[good]))
        return good

    before = 0.0
    for step in SHIFTS:
        ways = WAYS[helps(step * WAYS)]
        if len(ways):
            low, high = np.full(len(ways), before), np.full(len(ways), step)
            for _ in range(SHIFT_HALVINGS):
                middle = (low + high) / 2
                good = helps(middle[:, None] * ways)
                low, high = np.where(good, low, middle), np.where(good, middle, high)
                # The shortest is wanted: what is longer than another way already is left out.
                some = low < high.min()
                low, high, ways = low[some], high[some], ways[some]
            x, y, z = (high[:, None] * ways)[int(high.argmin())].tolist()
            return x, y, z
        before = step
    return None


def _shifted(targets: TargetBatch, shifts: Array) -> TargetBatch:
    """One target at as many places."""
    asked = targets.rows(np.zeros(len(shifts), dtype=np.intp))
    pose = asked.object_pose
    if pose is not None:
        pose = pose.copy()
        pose[:, :3, 3] += shifts
    return replace(
        asked, points=asked.points + shifts[:, None], object_pose=pose, picked=None, first_row=0
    )


def _fewer(targets: TargetBatch, fingers: Sequence[str], free: Free) -> tuple[str, ...]:
    """Fingers without whose contact there is a free answer."""
    placed = ~np.isnan(targets.points[0]).all(axis=1)
    facing = ~np.isnan(targets.normals[0]).all(axis=1)
    named = np.flatnonzero(placed | facing)
    # A finger with more than a point and a normal would make it a target of other kinds.
    plain = [
        i for i in named.tolist() if all(np.isnan(v[0, i]).all() for v in targets.more.values())
    ]
    if len(named) < 2:
        return ()
    return tuple(fingers[i] for i in plain if free(_without(targets, i))[0])


def _without(targets: TargetBatch, finger: int) -> TargetBatch:
    """One target with a finger free."""
    points, normals = targets.points.copy(), targets.normals.copy()
    points[:, finger], normals[:, finger] = np.nan, np.nan
    return replace(targets, points=points, normals=normals)
