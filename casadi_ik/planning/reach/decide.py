"""Decision of palm poses: reachable with a witness, refuted by intervals, or open.

A palm pose is decided in three steps:

1. The margin is bounded over the whole range of the redundancy parameter; most palm poses out of
   reach end there.
2. The margin is evaluated at samples of the parameter. The configuration of a sample with a margin
   >= 0 is checked by forward kinematics and within limits: it is the witness.
3. The range of the parameter is bisected: middles find witnesses, intervals refute parts of it.

A palm pose that is neither reached nor refuted is open.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Bools, Rows, spread_points
from casadi_ik.files.input_checks import rotations_from_quaternions
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import ClosedForm
from casadi_ik.kinematics.arms.recognise import arm_family
from casadi_ik.model.grasp import Tolerance
from casadi_ik.planning.reach.margins import MarginKernels, model_deviation
from casadi_ik.solve.verdict import LIMIT_SLACK


class Reachability(IntEnum):
    """Verdict about a palm pose.

    Example:
        >>> reach.counts["OPEN"] == int((reach.status == "OPEN").sum())
        True
    """

    OPEN = 0
    """Neither reached nor refuted."""
    REACHABLE = 1
    """A configuration within limits reaches the palm pose; it is stored as the witness."""
    UNREACHABLE = 2
    """Interval bounds show that no configuration within limits reaches the palm pose."""
    COLLIDING = 3
    """Reached, but no collision-free configuration is found; only in maps with a scene."""


class Meaning(StrEnum):
    """Meaning of the verdicts of a reachability map."""

    EXACT = "exact"
    """REACHABLE: the palm pose within 1e-10 m and rad. UNREACHABLE: no palm pose within 1e-10."""
    WITHIN_TOLERANCE = "within tolerance"
    """REACHABLE and UNREACHABLE as in `Status`: the palm pose within the solver's tolerance."""
    SAMPLED = "within tolerance, sampled"
    """Verdicts of the solver within its tolerance; nothing is UNREACHABLE, because the arm has no
    exact closed form."""
    CONTACTS = "contacts within tolerance"
    """Verdicts about object poses at which arm and hand take a grasp, as in `Status`."""


@dataclass(frozen=True)
class ReachParameters:
    """Parameters of the decision.

    Attributes:
        exact: Largest deviation of a palm pose that counts as this pose [m, rad].
        samples: Number of samples of the redundancy parameter.
        parts: Number of parts into which an interval of the parameter is divided.
        depth: Number of divisions.
        tolerance_depth: Number of divisions for palm poses with a tolerance, whose boundary is
            wider than the intervals of a deep division.
        rotation_parts: Number of parts of each coordinate of the rotations within a tolerance, for
            arms without and with redundancy, whose parts take more time.
        max_boxes: Maximum number of intervals of all palm poses of a chunk.
        chunk_size: Number of palm poses that are decided together.
        limit_tolerance: Smallest distance of a witness from its limits [rad]: rounding.
    """

    exact: float = 1e-10
    samples: int = 16
    parts: int = 8
    depth: int = 6
    tolerance_depth: int = 3
    rotation_parts: tuple[int, int] = (8, 4)
    max_boxes: int = 4_000_000
    chunk_size: int = 32_768
    limit_tolerance: float = -1e-9


REACH_PARAMETERS = ReachParameters()


@dataclass(frozen=True, eq=False)
class PalmDecision:
    """Verdicts about k palm poses.

    Attributes:
        code: (k,) verdict, see `Reachability`.
        q: (k, a) witness of the arm [rad]; NaN unless REACHABLE.
    """

    code: NDArray[np.int8]
    q: Array


def exact_family(robot: ArmHand) -> ClosedForm | None:
    """Return the family of a robot's arm if it is an exact closed form, else None."""
    description = robot.description
    if description.sides or not description.arm_actuators:
        return None
    family = arm_family(description)
    return family if isinstance(family, ClosedForm) and family.is_exact else None


class PalmReach:
    """Decision of palm poses for the arm of one robot.

    Attributes:
        robot: The robot.
        family: Family of its arm, an exact closed form.
        lower: (a,) lower limits of the arm [rad].
        upper: (a,) upper limits of the arm [rad].
        deviation: Bound of the deviation of the family's arm from the real one [m, rad].
    """

    def __init__(
        self, robot: ArmHand, family: ClosedForm, enforce_limits: bool = True, compiled: bool = True
    ) -> None:
        """Store the robot; the kernels are built at the first decision."""
        self.robot, self.family, self._compiled = robot, family, compiled
        self.lower, self.upper = arm_limits(robot, enforce_limits)
        self.deviation = model_deviation(robot.description, family)

    @cached_property
    def kernels(self) -> MarginKernels:
        """Kernels of the margin."""
        limits = self.lower, self.upper
        return MarginKernels(self.robot.description, self.family, limits, self._compiled)

    @cached_property
    def redundancy_range(self) -> tuple[float, float]:
        """Range of the redundancy parameter [rad]; a point without one."""
        return redundancy_range(self.family, self.lower, self.upper)

    def decide(self, palms: Array, tolerance: Tolerance | None = None) -> PalmDecision:
        """Decide k palm poses (k, 4, 4) in the base frame.

        Args:
            palms: Palm poses with exact rotations.
            tolerance: Tolerance within which no palm pose is reachable where the verdict is
                UNREACHABLE; None: the exact palm poses. Witnesses reach the exact palm poses.
        """
        code = np.zeros(len(palms), dtype=np.int8)
        q = np.full((len(palms), len(self.lower)), np.nan)
        for start in range(0, len(palms), REACH_PARAMETERS.chunk_size):
            rows = slice(start, start + REACH_PARAMETERS.chunk_size)
            chunk = _Chunk(self, palms[rows], tolerance)
            chunk.run()
            code[rows], q[rows] = chunk.code, chunk.q
        return PalmDecision(code, q)

    def refute_within(self, palms: Array, tolerance: Tolerance) -> Bools:
        """Return (k,) True for palm poses (k, 4, 4) without reachable poses within a tolerance.

        The poses within the tolerance are divided into smaller sets, which are refuted separately:
        the intervals of a set overestimate its rotations less.
        """
        is_refuted = np.zeros(len(palms), dtype=bool)
        has_redundancy = self.redundancy_range[0] < self.redundancy_range[1]
        parts, part_tolerance = _tolerance_parts(
            tolerance, REACH_PARAMETERS.rotation_parts[int(has_redundancy)]
        )
        step = max(REACH_PARAMETERS.chunk_size // len(parts), 1)
        for start in range(0, len(palms), step):
            rows = slice(start, start + step)
            poses = np.repeat(palms[rows, None], len(parts), axis=1)
            poses[:, :, :3, :3] = poses[:, :, :3, :3] @ parts[:, :3, :3]
            poses[:, :, :3, 3] += parts[:, :3, 3]
            code = self.decide(poses.reshape(-1, 4, 4), part_tolerance).code
            is_part_refuted = code.reshape(-1, len(parts)) == Reachability.UNREACHABLE
            is_refuted[rows] = is_part_refuted.all(axis=1)
        return is_refuted


def _tolerance_parts(tolerance: Tolerance, count: int) -> tuple[Array, Tolerance]:
    """Return relative poses (m, 4, 4) and the tolerance of sets that cover those of a tolerance.

    The rotation vectors are divided into cubes, `count` along each axis. The angle between two
    rotations is at most the distance of their rotation vectors.
    """
    width = tolerance.angle / count
    edges = width * (2 * np.arange(count) + 1 - count)
    vectors = np.array(list(product(edges, repeat=3)))
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    quaternions = np.hstack([np.cos(angles / 2), vectors * np.sinc(angles / (2 * np.pi)) / 2])
    shifts = np.array(list(product((-0.5, 0.5), repeat=3))) * tolerance.position
    parts = np.tile(np.eye(4), (len(vectors) * len(shifts), 1, 1))
    parts[:, :3, :3] = np.repeat(rotations_from_quaternions(quaternions), len(shifts), axis=0)
    parts[:, :3, 3] = np.tile(shifts, (len(vectors), 1))
    return parts, Tolerance(tolerance.position / 2, width * np.sqrt(3))


def arm_limits(robot: ArmHand, enforce_limits: bool) -> tuple[Array, Array]:
    """Return lower and upper limits (a,) of the arm [rad]; two turns if they are ignored."""
    columns = list(robot.description.arm_actuators)
    if not enforce_limits:
        return np.full(len(columns), -2 * np.pi), np.full(len(columns), 2 * np.pi)
    joints = [joint for joint in robot.description.movable if joint.part == "arm"]
    lower, upper = robot.description.actuator_limits
    return (
        np.maximum(lower[columns], [joint.lower for joint in joints]),
        np.minimum(upper[columns], [joint.upper for joint in joints]),
    )


def redundancy_range(family: ClosedForm, lower: Array, upper: Array) -> tuple[float, float]:
    """Return the range of the redundancy parameter [rad], rounded outward; 0 without one."""
    if not family.redundancy:
        return 0.0, 0.0
    low, high = (float(end) for end in family.redundancy[0].bounds(lower, upper))
    return low - LIMIT_SLACK, high + LIMIT_SLACK


class _Chunk:
    """Decision of some palm poses together.

    Attributes:
        code: (k,) verdicts so far.
        q: (k, a) witnesses so far.
    """

    def __init__(self, reach: PalmReach, palms: Array, tolerance: Tolerance | None) -> None:
        self._reach, self._tolerance = reach, tolerance
        self._rotation = np.ascontiguousarray(palms[:, :3, :3])
        self._origin = np.ascontiguousarray(palms[:, :3, 3])
        self.code = np.zeros(len(palms), dtype=np.int8)
        self.q = np.full((len(palms), len(reach.lower)), np.nan)
        exact = REACH_PARAMETERS.exact + reach.deviation
        self._origin_width = exact + (tolerance.position if tolerance else 0.0)
        self._rotation_width = exact
        if tolerance is not None:
            self._rotation_width += 2 * np.sin(min(tolerance.angle, np.pi) / 2)

    def run(self) -> None:
        """Decide all palm poses."""
        low, high = self._reach.redundancy_range
        rows = np.arange(len(self.code))
        values = low + (high - low) * spread_points(REACH_PARAMETERS.samples, 1)[:, 0]
        # A first sample decides more than half of the palm poses in reach at a tenth of the cost.
        rows = self._without_reached(rows, np.full(len(rows), values[0]))
        upper = self._upper_bounds(rows, np.full(len(rows), low), np.full(len(rows), high))
        self.code[rows[upper < 0]] = Reachability.UNREACHABLE
        if low == high:
            return
        rows = rows[upper >= 0]
        for value in values[1:]:
            rows = self._without_reached(rows, np.full(len(rows), value))
        self._bisect(rows, low, high)

    def _bisect(self, rows: Rows, low: float, high: float) -> None:
        parameters = REACH_PARAMETERS
        depth = parameters.depth if self._tolerance is None else parameters.tolerance_depth
        owner, lower, upper = rows, np.full(len(rows), low), np.full(len(rows), high)
        count = 0
        for _ in range(depth):
            owner, lower, upper = _divided(owner, lower, upper, parameters.parts)
            count += len(owner)
            if not len(owner) or count > parameters.max_boxes:
                break
            is_open = self._upper_bounds(owner, lower, upper) >= 0
            owner, lower, upper = owner[is_open], lower[is_open], upper[is_open]
            self._without_reached(owner, (lower + upper) / 2)
            is_open = self.code[owner] != Reachability.REACHABLE
            owner, lower, upper = owner[is_open], lower[is_open], upper[is_open]
        is_refuted = self.code[rows] == Reachability.OPEN
        is_refuted[np.isin(rows, owner)] = False
        self.code[rows[is_refuted]] = Reachability.UNREACHABLE

    def _upper_bounds(self, rows: Rows, lower: Array, upper: Array) -> Array:
        """Return upper bounds of the margins over intervals of the redundancy; inf if unknown."""
        rotation, origin = self._rotation[rows], self._origin[rows]
        ends = [
            (
                rotation + sign * self._rotation_width,
                origin + sign * self._origin_width,
                end + sign * LIMIT_SLACK,
            )
            for sign, end in ((-1, lower), (1, upper))
        ]
        _, bounds = self._reach.kernels.bounds(*ends[0], *ends[1])
        return np.where(np.isnan(bounds), np.inf, bounds)

    def _without_reached(self, rows: Rows, values: Array) -> Rows:
        """Store the witnesses of palm poses at values of the redundancy; return the other rows."""
        if not len(rows):
            return rows
        reach = self._reach
        (margin,) = reach.kernels.value(self._rotation[rows], self._origin[rows], values)
        hits = np.flatnonzero(margin >= 0)
        if not len(hits):
            return rows
        # A palm pose may own several intervals; the first witness suffices.
        _, first = np.unique(rows[hits], return_index=True)
        hits = hits[first]
        hit_rows = rows[hits]
        limits = reach.lower, reach.upper
        rotation, origin = self._rotation[hit_rows], self._origin[hit_rows]
        q, score = reach.kernels.best_arm(
            values[hits], rotation, origin, *limits, (limits[0] + limits[1]) / 2
        )
        q = np.clip(q, *limits)
        is_witness = (score >= REACH_PARAMETERS.limit_tolerance) & reaches(
            reach.robot, q, rotation, origin
        )
        self.code[hit_rows[is_witness]] = Reachability.REACHABLE
        self.q[hit_rows[is_witness]] = q[is_witness]
        return rows[self.code[rows] != Reachability.REACHABLE]


def reaches(robot: ArmHand, q: Array, rotation: Array, origin: Array) -> NDArray[np.bool_]:
    """Return (k,) True where arms (k, a) reach palm poses within `ReachParameters.exact`."""
    palms = robot.palm(with_home_hand(robot, q))
    miss = np.linalg.norm(palms[:, :3, 3] - origin, axis=1)
    turn = np.linalg.norm(palms[:, :3, :3] - rotation, axis=(1, 2))
    return np.maximum(miss, turn) <= REACH_PARAMETERS.exact


def with_home_hand(robot: ArmHand, q: Array) -> Array:
    """Return configurations (k, n) of arms (k, a) [rad], with the hand in its home posture."""
    configurations = np.tile(robot.home, (len(q), 1))
    configurations[:, list(robot.description.arm_actuators)] = q
    return configurations


def _divided(owner: Rows, lower: Array, upper: Array, parts: int) -> tuple[Rows, Array, Array]:
    """Return the equal parts of intervals, with their owners."""
    fractions = np.arange(parts + 1) / parts
    edges = lower[:, None] + (upper - lower)[:, None] * fractions
    return np.repeat(owner, parts), edges[:, :-1].ravel(), edges[:, 1:].ravel()
