"""Placement of an upright base from which an arm reaches as many palm poses as possible.

Branch and bound over boxes of base poses: interval bounds of the margins count the palm poses that
some base of a box may reach, an upper bound; the base in the middle of a box gives a lower bound.
If the first joint of the arm is vertical, the yaw of the base only shifts this joint, so that the
upper bound ignores yaw and the limits of the joint. A local search improves the best base. With a
scene, the search excludes bases that touch an obstacle, and counts of the best bases and of the
local search are those of collision-free arms; the upper bound ignores collisions.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.scene import Scene
from casadi_ik.errors import DescriptionError, InputError, UnsupportedError
from casadi_ik.files.arrays import Array, Bools, Rows, spread_points
from casadi_ik.files.input_checks import checked_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import Free, inverse
from casadi_ik.planning.object_pose import pose_matrices
from casadi_ik.planning.reach.compute_map import PalmDecider, reachable_box, with_scene
from casadi_ik.planning.reach.decide import (
    REACH_PARAMETERS,
    PalmReach,
    Reachability,
    exact_family,
    redundancy_range,
)
from casadi_ik.planning.reach.margins import MarginKernels

PREFERENCES = (None, "limits", "center")
"""Criteria among bases that reach equally many palm poses."""

VERTICAL_TOLERANCE = 1e-9
"""Deviation of a vertical first axis through the origin of the base [m and rad]."""


@dataclass(frozen=True)
class PlacementParameters:
    """Parameters of the branch and bound.

    Attributes:
        redundancy_parts: Number of parts of the redundancy range in interval bounds.
        yaws: Number of yaw angles at which a position is evaluated.
        samples: Number of samples of the redundancy parameter at which a base is evaluated.
        batch: Number of boxes that are bounded together.
        scene_bases: Number of bases that are tried in search of one that touches no obstacle.
        finalists: Maximum number of bases that are compared by collisions and preference.
        polish_steps: Initial steps of the local search: length [m] and yaw [rad].
        polish_end: Length of the last step [m].
        radian_length: Length that counts as much as a radian of yaw [m].
    """

    redundancy_parts: int = 4
    yaws: int = 12
    samples: int = 12
    batch: int = 16
    scene_bases: int = 64
    finalists: int = 24
    polish_steps: tuple[float, float] = (0.05, 0.3)
    polish_end: float = 1e-3
    radian_length: float = 0.5


PLACEMENT_PARAMETERS = PlacementParameters()


@dataclass(frozen=True, eq=False)
class BasePlacement:
    """The best base pose found for palm poses, and a bound that no base of the region exceeds.

    Attributes:
        base: Best base: x, y, z [m] and yaw [rad].
        reached: (k,) True for the palm poses that the arm reaches from there, with a witness.
        q: (k, a) witnesses of the arm [rad]; NaN for the other palm poses.
        upper_bound: Proved upper bound of the number of palm poses that any base reaches.
        bases: (m, 4) bases that were evaluated, for a heat map.
        counts: (m,) number of palm poses that each of them reaches, without collisions.
        time: Duration [s].

    Example:
        >>> palms = robot.palm(robot.random(np.random.default_rng(0), 20))
        >>> placement = solver.place_base(palms, ([-0.2, -0.2, 0], [0.2, 0.2, 0]), max_time=1.0)
        >>> placement.count <= placement.upper_bound
        True
    """

    base: Array
    reached: NDArray[np.bool_]
    q: Array
    upper_bound: int
    bases: Array
    counts: NDArray[np.int64]
    time: float

    @property
    def count(self) -> int:
        """Number of palm poses that the best base reaches."""
        return int(self.reached.sum())

    @property
    def pose(self) -> Array:
        """(4, 4) pose of the best base in the world frame."""
        x, y, z, yaw = self.base.tolist()
        return pose_matrices(np.array([[x, y, z, 0.0, 0.0, yaw]]))[0]

    def bases_reaching(self, count: int) -> Array:
        """Return the bases (m, 4) among `bases` that reach at least this many palm poses."""
        return self.bases[self.counts >= count]

    def __repr__(self) -> str:
        return (
            f"<BasePlacement reaches {self.count} of {len(self.reached)} palm poses, "
            f"at most {self.upper_bound}>"
        )


def place_base(
    solver: Any,
    grasps: ArrayLike | Sequence[Grasp],
    region: Free | ArrayLike | None = None,
    resolution: float = 0.02,
    max_time: float = 10.0,
    prefer: str | None = None,
    scene: Scene | None = None,
) -> BasePlacement:
    """Return the upright base pose from which the arm reaches most palm poses exactly.

    Args:
        solver: A `Solver`.
        grasps: Palm poses (k, 4, 4) in the world frame, or grasps. A grasp without a palm pose is
            represented by one palm pose from which the hand meets its contacts.
        region: Lower and upper corner (2, 3) of a box of base positions [m], with any yaw; or a
            `Free` pose with roll and pitch zero. Components may be fixed. None: at height 0, a box
            around the palm poses that is wider by the reach of the arm.
        resolution: Size of boxes that are not divided further [m].
        max_time: Time after which branch and bound ends [s]; the bound holds nevertheless, but the
            result then depends on the speed of the machine. With a scene, the local search
            takes at most as long again.
        prefer: Criterion among bases that reach equally many palm poses: "limits" (arms far from
            their limits on average) or "center" (near the center of the region). None: none.
        scene: Obstacles, world frame. Base and arm must then be free of collision, with the hand in
            its home posture. None: the scene of the solver.

    Raises:
        InputError: An argument has an invalid value, or the scene leaves no room for the base.
        UnsupportedError: The robot does not have one arm with an exact closed form, or no shapes.

    Example:
        >>> palms = robot.palm(robot.random(np.random.default_rng(0), 20))
        >>> placement = solver.place_base(palms, ([-0.2, -0.2, 0], [0.2, 0.2, 0]), max_time=1.0)
        >>> placement.pose.shape
        (4, 4)
    """
    started = time.perf_counter()
    robot = solver.robot
    robot.description.require_single_hand("place_base")
    family = exact_family(robot)
    if family is None:
        raise UnsupportedError(
            f"place_base: {robot.name} has no exact closed form "
            f"({describe_arm(robot.description)}); expected an arm with one"
        )
    if prefer not in PREFERENCES:
        names = ", ".join(map(repr, PREFERENCES))
        raise InputError(f"prefer: found {prefer!r}, expected one of {names}")
    palms = _palm_poses(solver, grasps)
    lower, upper = _base_bounds(_box_around(robot, palms) if region is None else region)
    if not isinstance(resolution, int | float) or not 0 < resolution < np.inf:
        raise InputError(f"resolution: found {resolution!r}, expected a length > 0 [m]")
    world_scene = solver.scene if scene is None else scene
    if scene is not None:
        solver = _solver_in_scene(solver, scene, lower, upper)
    reach = PalmReach(robot, family, solver.limits == "enforce", solver._engine.compiled)
    score = BaseScore(solver, reach, palms, prefer, (lower + upper) / 2, world_scene)
    search = _PlacementSearch(reach, palms, lower, upper, resolution, score)
    search.run(time.perf_counter() + max_time)  # compiling does not count
    search.polish(np.inf if world_scene is None else time.perf_counter() + max_time)
    is_reached, q = score.reach(search.best)
    return BasePlacement(
        search.best,
        is_reached,
        q,
        max(search.upper_bound, int(is_reached.sum())),
        np.array(search.bases),
        np.array(search.counts, dtype=np.int64),
        time.perf_counter() - started,
    )


def _solver_in_scene(solver: Any, scene: Scene, lower: Array, upper: Array) -> Any:
    """Return the solver with a scene as seen from some base that touches no obstacle.

    Raises:
        InputError: The scene is not a `Scene`, or each base that was tried touches an obstacle.
        UnsupportedError: The robot has no shapes.
    """
    if not isinstance(scene, Scene):
        raise InputError(f"scene: found {scene!r}, expected a Scene")
    count = PLACEMENT_PARAMETERS.scene_bases if (lower < upper)[:3].any() else 1
    problem = ""
    for fraction in spread_points(count, 4):
        base = lower + fraction * (upper - lower)
        scene_in_base = scene
        for name, item in scene.items.items():
            scene_in_base = scene_in_base.moved(name, _in_base(item.pose, base))
        try:
            return with_scene(solver, scene_in_base)
        except DescriptionError as error:
            problem = str(error)
    raise InputError(
        f"scene: touches the base at all of {count} places of the region; expected room for the "
        f"base: {problem}"
    )


class BaseScore:
    """Score of bases: the number of palm poses that are reached free of collision, and more.

    Attributes:
        has_criteria: True if collisions or a preference count.
    """

    def __init__(
        self,
        solver: Any,
        reach: PalmReach,
        palms: Array,
        prefer: str | None,
        center: Array,
        scene: Scene | None,
    ) -> None:
        self._solver, self._reach, self._palms = solver, reach, palms
        items = {} if scene is None else scene.items
        self._obstacles = {name: item.pose for name, item in items.items()}
        self._prefer, self._center = prefer, center
        self._decider = PalmDecider(solver)
        self.has_criteria = solver.scene is not None or prefer is not None

    def __call__(self, base: Array) -> tuple[int, float]:
        """Return the number of palm poses that a base (4,) reaches, and the preference."""
        is_reached, q = self.reach(base)
        preference = 0.0
        if self._prefer == "center":
            preference = -float(np.linalg.norm((base - self._center)[:3]))
        elif self._prefer == "limits" and is_reached.any():
            lower, upper = self._reach.lower, self._reach.upper
            margins = np.minimum(q - lower, upper - q)[is_reached] / (upper - lower)
            preference = float(margins.min(axis=1).mean())
        return int(is_reached.sum()), preference

    def reach(self, base: Array) -> tuple[Bools, Array]:
        """Return (k,) True for the palm poses that a base reaches, and the arms (k, a) [rad]."""
        solver = self._solver_at(base)
        if solver is None:
            count = len(self._palms), len(self._reach.lower)
            return np.zeros(count[0], dtype=bool), np.full(count, np.nan)
        code, q = self._decider.with_solver(solver).decide(_in_base(self._palms, base))
        return code == Reachability.REACHABLE, q

    def stands_free(self, base: Array) -> bool:
        """Return True if a base does not touch an obstacle."""
        return self._solver_at(base) is not None

    def _solver_at(self, base: Array) -> Any:
        """Return the solver with the scene as seen from a base; None if an obstacle touches it."""
        solver = self._solver
        try:
            for name, pose in self._obstacles.items():
                solver = solver.moved(name, _in_base(pose, base))
        except DescriptionError:
            return None
        return solver


def _box_around(robot: ArmHand, palms: Array) -> Array:
    """Return the corners (2, 3) of the bases at height 0 that may reach one of the palm poses."""
    corners = reachable_box(robot)
    reach = float(np.linalg.norm(np.abs(corners).max(axis=0)))
    origins = palms[:, :3, 3]
    box = np.array([origins.min(axis=0) - reach, origins.max(axis=0) + reach])
    box[:, 2] = 0.0
    return box


def _palm_poses(solver: Any, grasps: ArrayLike | Sequence[Grasp]) -> Array:
    """Return the palm poses (k, 4, 4) of grasps, world frame."""
    if isinstance(grasps, Sequence) and grasps and isinstance(grasps[0], Grasp):
        palms = [_palm_pose(solver, grasp, row) for row, grasp in enumerate(grasps)]
        return checked_pose(np.array(palms), "grasps")
    poses = checked_pose(grasps, "grasps")  # type: ignore[arg-type]
    if poses.ndim != 3 or not len(poses):
        raise InputError(f"grasps: found shape {poses.shape}, expected (k, 4, 4)")
    return poses


def _palm_pose(solver: Any, grasp: Any, row: int) -> Array:
    """Return the palm pose (4, 4) of a grasp, or one from which the hand meets its contacts."""
    if not isinstance(grasp, Grasp):
        raise InputError(f"grasps: row {row} is {grasp!r}; expected a Grasp")
    if grasp.palm is not None:
        if grasp.single_palm is None:
            raise InputError(f"grasps: row {row} has several palm poses; expected one")
        return grasp.single_palm
    # The arm's own workspace tells nothing about the hand, so that any reachable pose suffices.
    world = np.eye(4)
    world[:3, 3] = np.mean([contact.point for contact in grasp.contacts.values()], axis=0)
    corners = reachable_box(solver.robot)
    half_turns = (np.pi,) * 3
    free = Free(
        (*corners[0].tolist(), *np.negative(half_turns)), (*corners[1].tolist(), *half_turns)
    )
    contacts = Grasp(grasp.contacts).at(inverse(world)).contacts
    solution = with_scene(solver, None).solve(Grasp(contacts, object_pose=free))
    if not solution.success:
        raise InputError(
            f"grasps: row {row} has contacts that the hand does not meet; expected a palm pose"
        )
    return world @ inverse(solution.object_pose) @ solver.robot.palm(solution.q)


def _base_bounds(region: Free | ArrayLike) -> tuple[Array, Array]:
    """Return lower and upper bounds (4,) of x, y, z [m] and yaw [rad]."""
    if isinstance(region, Free):
        if any(region.lower[3:5]) or any(region.upper[3:5]):
            raise InputError(
                f"region: roll and pitch are within {region.lower[3:5]} and {region.upper[3:5]}, "
                "expected 0: only upright bases are placed"
            )
        corners = np.array([region.lower, region.upper])
        return corners[0, [0, 1, 2, 5]], corners[1, [0, 1, 2, 5]]
    try:
        corners = np.asarray(region, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"region: is not an array of numbers: {error}; expected (2, 3)") from error
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise InputError(f"region: found shape {corners.shape}, expected two finite corners (2, 3)")
    if (corners[1] < corners[0]).any():
        raise InputError(f"region: found {corners.tolist()}, expected the lower corner first")
    return np.append(corners[0], -np.pi), np.append(corners[1], np.pi)


def _in_base(palms: Array, base: Array) -> Array:
    """Return palm poses (..., 4, 4) in the frames of bases (..., 4)."""
    cosine, sine = np.cos(base[..., 3]), np.sin(base[..., 3])
    zero, unit = np.zeros_like(cosine), np.ones_like(cosine)
    rotation = np.stack(
        [cosine, sine, zero, -sine, cosine, zero, zero, zero, unit], axis=-1
    ).reshape(*cosine.shape, 3, 3)
    result = np.zeros(np.broadcast_shapes(palms.shape, (*cosine.shape, 4, 4)))
    result[..., :3, :3] = rotation @ palms[..., :3, :3]
    shifted = palms[..., :3, 3] - base[..., :3]
    result[..., :3, 3] = (rotation @ shifted[..., None])[..., 0]
    result[..., 3, 3] = 1
    return result


class _PlacementSearch:
    """Branch and bound for one robot and its palm poses.

    Attributes:
        best: (4,) best base so far.
        best_count: Number of palm poses that it reaches.
        upper_bound: Proved upper bound after `run`.
        bases: Bases that were evaluated.
        counts: Number of palm poses that each of them reaches.
    """

    def __init__(
        self,
        reach: PalmReach,
        palms: Array,
        lower: Array,
        upper: Array,
        resolution: float,
        score: BaseScore,
    ) -> None:
        self._reach, self._palms, self._resolution = reach, palms, resolution
        self._score = score
        self._region = lower, upper
        screws = reach.family.screws
        first = screws.joints.index(0)
        axis, point = screws.axes[first], screws.points[first]
        is_vertical = np.hypot(*axis[:2]) + np.hypot(*point[:2]) <= VERTICAL_TOLERANCE
        limits = reach.lower.copy(), reach.upper.copy()
        box_lower, box_upper = lower.copy(), upper.copy()
        if is_vertical:
            # The yaw only shifts the first joint.
            limits[0][0], limits[1][0] = -2 * np.pi, 2 * np.pi
            box_lower[3] = box_upper[3] = 0.0
        self._box = box_lower, box_upper
        description = reach.robot.description
        self._kernels = MarginKernels(
            description, reach.family, limits, reach.kernels.value.compiled, has_base=True
        )
        self._redundancy = redundancy_range(reach.family, *limits)
        yaws = PLACEMENT_PARAMETERS.yaws if upper[3] > lower[3] else 1
        fractions = (np.arange(yaws) + 0.5) / yaws
        self._yaws = lower[3] + (upper[3] - lower[3]) * fractions
        low, high = reach.redundancy_range
        samples = PLACEMENT_PARAMETERS.samples if high > low else 1
        self._samples = low + (high - low) * spread_points(samples, 1)[:, 0]
        self.best, self.best_count = (lower + upper) / 2, -1
        self.upper_bound = len(palms)
        self.bases: list[Array] = []
        self.counts: list[int] = []

    def run(self, deadline: float) -> None:
        """Divide the region until the bound is reached, boxes are small or time is over."""
        sizes = np.array([1.0, 1.0, 1.0, PLACEMENT_PARAMETERS.radian_length])
        every_palm = np.arange(len(self._palms))
        # Each box: upper bound, lower and upper base, palm poses that are not refuted.
        queue = [(len(every_palm), *self._box, every_palm)]
        leaf_bound = 0
        while queue and time.perf_counter() < deadline:
            queue.sort(key=lambda box: box[0])
            batch = [queue.pop() for _ in range(min(PLACEMENT_PARAMETERS.batch, len(queue)))]
            batch = [box for box in batch if box[0] > self.best_count]
            boxes = self._bounded(batch)
            # A base takes ten times as long as the bound of a box, so that only one is evaluated.
            for _, lower, upper, palms in sorted(boxes, key=lambda box: -box[0]):
                middle = (lower + upper) / 2
                if not self._score.stands_free(middle):
                    continue
                base, count = self.evaluate(middle, palms)
                if count > self.best_count and self._score.stands_free(base):
                    self.best, self.best_count = base, count
                break
            for bound, lower, upper, palms in boxes:
                if bound <= self.best_count:
                    continue
                widths = (upper - lower) * sizes
                widest = int(np.argmax(widths))
                if widths[widest] <= self._resolution:
                    leaf_bound = max(leaf_bound, bound)
                    continue
                for side in (lower, upper):
                    half_box = lower.copy(), upper.copy()
                    middle = (lower[widest] + upper[widest]) / 2
                    half_box[int(side is lower)][widest] = middle
                    queue.append((bound, *half_box, palms))
        open_bound = max((box[0] for box in queue), default=0)
        self.upper_bound = max(self.best_count, leaf_bound, open_bound)

    def _bounded(
        self, boxes: list[tuple[int, Array, Array, Rows]]
    ) -> list[tuple[int, Array, Array, Rows]]:
        """Return boxes with their upper bounds and the palm poses that are not refuted."""
        if not boxes:
            return []
        parts = PLACEMENT_PARAMETERS.redundancy_parts
        low, high = self._redundancy
        edges = np.linspace(low, high, (parts if high > low else 1) + 1)
        counts = [len(box[3]) for box in boxes]
        rows = np.concatenate([box[3] for box in boxes])
        lower = np.repeat(np.array([box[1] for box in boxes]), counts, axis=0)
        upper = np.repeat(np.array([box[2] for box in boxes]), counts, axis=0)
        width = REACH_PARAMETERS.exact + self._reach.deviation
        palms = self._palms[rows]
        rotation, origin = palms[:, :3, :3], palms[:, :3, 3]
        is_open = np.zeros(len(rows), dtype=bool)
        for first, last in pairwise(edges.tolist()):
            open_rows = np.flatnonzero(~is_open)
            if not len(open_rows):
                break
            _, bounds = self._kernels.bounds(
                rotation[open_rows] - width,
                origin[open_rows] - width,
                np.full(len(open_rows), first),
                lower[open_rows],
                rotation[open_rows] + width,
                origin[open_rows] + width,
                np.full(len(open_rows), last),
                upper[open_rows],
            )
            is_open[open_rows[~(bounds < 0)]] = True
        stops = np.cumsum(counts)
        masks = np.split(is_open, stops[:-1])
        return [
            (int(mask.sum()), box[1], box[2], box[3][mask])
            for mask, box in zip(masks, boxes, strict=True)
        ]

    def evaluate(self, base: Array, rows: Rows, yaws: Array | None = None) -> tuple[Array, int]:
        """Count the palm poses that are reached from a base at samples of the redundancy.

        Args:
            base: Base; its yaw is replaced.
            rows: Palm poses that may be reached.
            yaws: Yaw angles to try [rad]; None: spread over the region.

        Returns:
            The base (4,) with the best yaw, and its number of palm poses.
        """
        angles: Array = self._yaws if yaws is None else yaws
        bases = np.tile(base, (len(angles), 1))
        bases[:, 3] = angles
        palms = _in_base(self._palms[rows][None], bases[:, None]).reshape(-1, 4, 4)
        rotation, origin = palms[:, :3, :3].copy(), palms[:, :3, 3].copy()
        is_reached = np.zeros(len(palms), dtype=bool)
        for sample in self._samples:
            unreached = np.flatnonzero(~is_reached)
            if not len(unreached):
                break
            (margin,) = self._reach.kernels.value(rotation[unreached], origin[unreached], sample)
            is_reached[unreached[margin >= 0]] = True
        counts = is_reached.reshape(len(angles), len(rows)).sum(axis=1)
        index = int(np.argmax(counts))
        self.bases.append(bases[index])
        self.counts.append(int(counts[index]))
        return bases[index], int(counts[index])

    def polish(self, deadline: float) -> None:
        """Improve the best base by steps along the coordinates, which shrink."""
        score = self._choose_finalist(deadline)
        lower, upper = self._region
        length, angle = PLACEMENT_PARAMETERS.polish_steps
        rows = np.arange(len(self._palms))
        _, sampled_count = self.evaluate(self.best, rows, self.best[3:])
        while length >= PLACEMENT_PARAMETERS.polish_end and time.perf_counter() < deadline:
            previous_score = score
            for step in np.diag([length, length, length, angle]):
                for sign in (1.0, -1.0):
                    base = np.clip(self.best + sign * step, lower, upper)
                    if np.array_equal(base, self.best):
                        continue
                    _, count = self.evaluate(base, rows, base[3:])
                    is_promising = count >= min(sampled_count, score[0])
                    if is_promising and (base_score := self._score(base)) > score:
                        self.best, score, sampled_count = base, base_score, count
            if score == previous_score:
                length, angle = length / 2, angle / 2
        self.bases.append(self.best)
        self.counts.append(max(score[0], sampled_count))

    def _choose_finalist(self, deadline: float) -> tuple[int, float]:
        """Store the best of the evaluated bases by their scores; return its score."""
        score = self._score(self.best)
        if not self._score.has_criteria:
            return score
        candidates = 0
        for row in np.argsort(-np.array(self.counts), kind="stable").tolist():
            is_worse = self.counts[row] < score[0]
            if is_worse or candidates == PLACEMENT_PARAMETERS.finalists:
                break
            if time.perf_counter() > deadline or not self._score.stands_free(self.bases[row]):
                continue
            candidates += 1
            base_score = self._score(self.bases[row])
            if base_score > score:
                self.best, score = self.bases[row], base_score
        return score
