"""Placement of an upright base from which an arm reaches as many palm poses as possible.

Branch and bound over boxes of base poses: interval bounds of the margins count the palm poses that
some base of a box may reach, an upper bound; the base in the middle of a box gives a lower bound.
If the first joint of the arm is vertical, the yaw of the base only shifts this joint, so that the
upper bound ignores yaw and the limits of the joint. A local search improves the best base.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.files.input_checks import checked_pose
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import Free
from casadi_ik.planning.object_pose import pose_matrices
from casadi_ik.planning.reach.decide import (
    REACH_PARAMETERS,
    PalmReach,
    Reachability,
    exact_family,
    redundancy_range,
)
from casadi_ik.planning.reach.margins import MarginKernels

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
        polish_steps: Initial steps of the local search: length [m] and yaw [rad].
        polish_end: Length of the last step [m].
        radian_length: Length that counts as much as a radian of yaw [m].
    """

    redundancy_parts: int = 4
    yaws: int = 12
    samples: int = 12
    batch: int = 16
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
        counts: (m,) number of palm poses that each of them reaches.
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

    def __repr__(self) -> str:
        return (
            f"<BasePlacement reaches {self.count} of {len(self.reached)} palm poses, "
            f"at most {self.upper_bound}>"
        )


def place_base(
    solver: Any,
    grasps: ArrayLike | Sequence[Grasp],
    region: Free | ArrayLike,
    resolution: float = 0.02,
    max_time: float = 10.0,
) -> BasePlacement:
    """Return the upright base pose from which the arm reaches most palm poses exactly.

    Collisions are not considered.

    Args:
        solver: A `Solver`.
        grasps: Palm poses (k, 4, 4) in the world frame, or grasps with palm poses.
        region: Lower and upper corner (2, 3) of a box of base positions [m], with any yaw; or a
            `Free` pose with roll and pitch zero. Components may be fixed.
        resolution: Size of boxes that are not divided further [m].
        max_time: Time after which the search ends [s]; the bound holds nevertheless, but the
            result then depends on the speed of the machine.

    Raises:
        InputError: An argument has an invalid value.
        UnsupportedError: The robot does not have one arm with an exact closed form.

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
    palms = _palm_poses(grasps)
    lower, upper = _base_bounds(region)
    if not isinstance(resolution, int | float) or not 0 < resolution < np.inf:
        raise InputError(f"resolution: found {resolution!r}, expected a length > 0 [m]")
    reach = PalmReach(robot, family, solver.limits == "enforce", solver._engine.compiled)
    search = _PlacementSearch(reach, palms, lower, upper, resolution)
    search.run(time.perf_counter() + max_time)  # compiling does not count
    search.polish()
    decision = reach.decide(_in_base(palms, search.best))
    is_reached = decision.code == Reachability.REACHABLE
    return BasePlacement(
        search.best,
        is_reached,
        decision.q,
        max(search.upper_bound, int(is_reached.sum())),
        np.array(search.bases),
        np.array(search.counts, dtype=np.int64),
        time.perf_counter() - started,
    )


def _palm_poses(grasps: ArrayLike | Sequence[Grasp]) -> Array:
    if isinstance(grasps, Sequence) and grasps and isinstance(grasps[0], Grasp):
        palms = [grasp.single_palm if isinstance(grasp, Grasp) else None for grasp in grasps]
        if any(palm is None for palm in palms):
            row = next(i for i, palm in enumerate(palms) if palm is None)
            raise InputError(f"grasps: grasp {row} has no palm pose; expected one in each")
        return checked_pose(np.array(palms), "grasps")
    poses = checked_pose(grasps, "grasps")  # type: ignore[arg-type]
    if poses.ndim != 3 or not len(poses):
        raise InputError(f"grasps: found shape {poses.shape}, expected (k, 4, 4)")
    return poses


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
        self, reach: PalmReach, palms: Array, lower: Array, upper: Array, resolution: float
    ) -> None:
        self._reach, self._palms, self._resolution = reach, palms, resolution
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
            for bound, lower, upper, palms in self._bounded(batch):
                if bound <= self.best_count:
                    continue
                self.evaluate((lower + upper) / 2, palms)
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

    def evaluate(self, base: Array, rows: Rows, yaws: Array | None = None) -> int:
        """Count the palm poses that are reached from a base; update the best one.

        Args:
            base: Base; its yaw is replaced.
            rows: Palm poses that may be reached.
            yaws: Yaw angles to try [rad]; None: spread over the region.
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
        count = int(counts[index])
        self.bases.append(bases[index])
        self.counts.append(count)
        if count > self.best_count:
            self.best, self.best_count = bases[index], count
        return count

    def polish(self) -> None:
        """Improve the best base by steps along the coordinates, which shrink."""
        lower, upper = self._region
        length, angle = PLACEMENT_PARAMETERS.polish_steps
        rows = np.arange(len(self._palms))
        while length >= PLACEMENT_PARAMETERS.polish_end:
            previous_count = self.best_count
            for step in np.diag([length, length, length, angle]):
                for sign in (1.0, -1.0):
                    base = np.clip(self.best + sign * step, lower, upper)
                    if not np.array_equal(base, self.best):
                        self.evaluate(base, rows, base[3:])
            if self.best_count == previous_count:
                length, angle = length / 2, angle / 2
