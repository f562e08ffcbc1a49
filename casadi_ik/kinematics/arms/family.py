"""Arm families: closed-form solutions for a palm pose at a value of the redundancy parameter.

An arm of six joints has up to eight solutions for a palm pose: four *elbow branches*, which fix
three joints, with two *wrist flips* each for the other three. An arm of seven joints has as many
for every value of its redundancy parameter: the position of a joint, or the swivel angle of the
elbow. An arm with locked joints has several redundancy parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.screws import CosSin, Screws
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, with_cse

SIGNS = tuple(product((1, -1), (1, -1), (1, -1)))
"""The three signs of each branch, in the order of the branches."""

EXACT_MODEL_ERROR = 1e-9
"""Model error below which a family solves the real arm [m and rad]."""

FULL_TURN_MARGIN = 1e-4
"""Distance of half a joint range from half a turn below which the joint has no limits [rad]."""

ALIGNED_SINE_SQUARED = 1e-24
"""Squared sine of the second angle below which the first and third axis count as aligned."""


@dataclass(frozen=True)
class Redundancy:
    """A redundancy parameter: a number that the palm pose leaves free.

    Attributes:
        joint: Number of the joint whose position it is; None: an angle without limits.
    """

    joint: int | None

    def bounds(self, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
        """Return the interval of the parameter within bounds of the arm [rad], at most a turn."""
        if self.joint is None:
            return -np.pi, np.pi
        low, high = lower[self.joint], upper[self.joint]
        half_range = ca.fmin((high - low) / 2, np.pi)
        return (low + high) / 2 - half_range, (low + high) / 2 + half_range


@dataclass(frozen=True, eq=False)
class JointAngle:
    """An angle of a joint, and the direction from which it is computed.

    Attributes:
        value: Angle, centred on the range of the joint [rad].
        direction: Cosine and sine of the angle plus the offset, times the length.
        length: Length of the direction; zero where the angle is undetermined.
        offset: Constant offset [rad].
    """

    value: Expr
    direction: CosSin
    length: Expr = 1.0
    offset: float = 0.0

    def limit_margin(self, lower: float, upper: float) -> Expr | None:
        """Return a number that is >= 0 where the angle is within limits [rad].

        It is the length times (cosine of the distance from the middle of the range, minus the
        cosine of half the range). None: the range is a full turn.
        """
        half_range, middle = (upper - lower) / 2, (upper + lower) / 2 + self.offset
        if half_range >= np.pi - FULL_TURN_MARGIN:
            return None
        aligned = self.direction.cosine * np.cos(middle) + self.direction.sine * np.sin(middle)
        return aligned - self.length * np.cos(half_range)


JointAngles = dict[int, JointAngle]
"""Angles by joint number."""


@dataclass(frozen=True, eq=False)
class ElbowBranch:
    """A branch of an arm before the choice of wrist flips.

    Attributes:
        joints: Angles by joint number.
        wrist_flips: Pairs of alternative angles; the pairs are independent of each other.
        slack: Reach margin: >= 0 if the branch reaches the palm pose.
    """

    joints: JointAngles
    wrist_flips: tuple[tuple[JointAngles, JointAngles], ...]
    slack: Expr

    def arms(self) -> list[Expr]:
        """Return the solutions (n, 1) of this branch with all wrist flips [rad]."""
        arms = []
        for flips in product(*self.wrist_flips):
            joints = dict(self.joints)
            for flip in flips:
                joints |= flip
            arms.append(ca.vertcat(*(joints[i].value for i in range(len(joints)))))
        return arms

    def limit_margin(self, lower: Array, upper: Array) -> Expr:
        """Return a number that is >= 0 if the branch exists within limits (n,) [rad]."""
        margins = [self.slack, *_limit_margins(self.joints, lower, upper)]
        for pair in self.wrist_flips:
            flips = [_limit_margins(flip, lower, upper) for flip in pair]
            if all(flips):
                margins.append(ca.fmax(*(ca.mmin(ca.vertcat(*flip)) for flip in flips)))
        return ca.mmin(ca.vertcat(*margins))


def _limit_margins(joints: JointAngles, lower: Array, upper: Array) -> list[Expr]:
    margins = [angle.limit_margin(float(lower[i]), float(upper[i])) for i, angle in joints.items()]
    return [margin for margin in margins if margin is not None]


class Score(ABC):
    """An order of the solutions of an arm of n joints."""

    @abstractmethod
    def unwrap(self, joint: int, angle: Expr, lower: Expr, upper: Expr, reference: Expr) -> Expr:
        """Shift an angle of a multi-turn joint to the preferred turn."""

    @abstractmethod
    def cost(self, joints: dict[int, Expr], reference: Expr) -> Expr:
        """Return the cost of some joints, a sum over joints; smaller is better."""

    @abstractmethod
    def total(self, cost: Expr, margin: Expr) -> Expr:
        """Return the score from the cost and the smallest limit margin [rad]; higher is better."""

    @abstractmethod
    def restrict(self, joints: Sequence[int]) -> Score:
        """Return the order for an arm of some of the joints."""


class ArmFamily(ABC):
    """An arm with closed-form (or root-finding) inverse kinematics.

    Attributes:
        screws: Screws of the arm.
        model_error: Deviation of the nominal arm that is solved from the real one [m and rad].
        rows: Number of branches at a value of the redundancy parameter.
        roots: Number of branches with the same three signs.
        starts: Number of starts of an iterative search within the family.
        locked: Numbers of joints that are locked while the others are solved for.
    """

    screws: Screws
    model_error: float
    rows: int = len(SIGNS)
    roots: int = 1
    starts: int = 1
    locked: tuple[int, ...] = ()

    @property
    @abstractmethod
    def kind(self) -> str:
        """Short description of the arm's geometry."""

    @property
    @abstractmethod
    def sign_names(self) -> tuple[str, str, str]:
        """The part of the arm that each of the three signs flips: shoulder, elbow, wrist."""

    @property
    @abstractmethod
    def redundancy(self) -> tuple[Redundancy, ...]:
        """Redundancy parameters."""

    @abstractmethod
    def arms(self) -> ca.Function:
        """Return the function of all branches at a value of the redundancy parameters.

        Returns:
            (rotation (3, 3), origin (3, 1) [m], redundancy (r, 1) [rad]) -> branches (rows, n)
            [rad], `roots` rows for each of `SIGNS`, and their reach margins (rows, 1), >= 0 within
            reach.
        """

    @abstractmethod
    def best(self, name: str, score: Score) -> ca.Function:
        """Return the function of the best branch at a value of the redundancy parameters.

        Args:
            name: Name of the function.
            score: Order of the branches.

        Returns:
            (redundancy (r, 1), rotation, origin, lower (n, 1), upper (n, 1), near (n, 1)) -> arm
            (n, 1) [rad] and its score.
        """

    def distance_out_of_reach(self, palm: Pose, lower: Expr, upper: Expr) -> Expr | None:
        """Return a lower bound of the distance of a palm from the workspace [m].

        Args:
            palm: Pose of the palm in the base frame.
            lower: (n, 1) lower bounds of the arm [rad].
            upper: (n, 1) upper bounds of the arm [rad].

        Returns:
            Positive if the palm is too far away, negative if it is too near, 0 if it may be in
            reach; None if no bound is known.
        """
        del palm, lower, upper
        return None

    @property
    def size(self) -> int:
        """Length of the redundancy input, at least 1 (ignored without redundancy)."""
        return max(len(self.redundancy), 1)

    @property
    def is_exact(self) -> bool:
        """True if the nominal arm is the real one."""
        return self.model_error <= EXACT_MODEL_ERROR

    @property
    def is_complete(self) -> bool:
        """True if a full sweep of the redundancy parameters misses no solution."""
        return self.is_exact and not self.locked

    @property
    def is_iterative(self) -> bool:
        """True if the branches are found by root finding."""
        return self.roots > 1


class ClosedForm(ArmFamily):
    """An arm whose branches are expressions of palm pose and redundancy parameters."""

    @abstractmethod
    def bends(
        self, palm: Pose, redundancy: Expr, signs: tuple[Expr, ...] | None = None
    ) -> list[ElbowBranch]:
        """Return all elbow branches; out of reach the nearest, with negative reach margins.

        Args:
            palm: Desired pose of the palm in the base frame.
            redundancy: (r, 1) redundancy parameters [rad].
            signs: Signs (1 or -1) of a single branch; None: all branches.
        """

    def breakpoints(
        self, palm: Pose, signs: tuple[Expr, ...], lower: Expr, upper: Expr
    ) -> Expr | None:
        """Return the values of the redundancy parameter at which a joint may reach a bound.

        Args:
            palm: Desired pose of the palm in the base frame.
            signs: Signs of the elbow branch.
            lower: (n, 1) lower bounds of the arm [rad].
            upper: (n, 1) upper bounds of the arm [rad].

        Returns:
            (k, 1) ends of the feasible intervals; None if they are not known.
        """
        del palm, signs, lower, upper
        return None

    def arms(self) -> ca.Function:
        """Return the function of all branches, in the order of the elbow branches."""
        palm, inputs = _palm_symbols()
        redundancy = ca.SX.sym("redundancy", self.size)
        bends = self.bends(palm, redundancy)
        arms = [arm for bend in bends for arm in bend.arms()]
        slack = ca.vertcat(*(bend.slack for bend in bends for _ in bend.arms()))
        outputs = with_cse(ca.horzcat(*arms).T, slack)
        return ca.Function("arms", [*inputs, redundancy], outputs)

    def best(self, name: str, score: Score) -> ca.Function:
        """Return the function of the best branch; each pair of wrist flips is chosen separately."""
        palm, inputs = _palm_symbols()
        redundancy = ca.SX.sym("redundancy", self.size)
        n = len(self.screws)
        symbols = [ca.SX.sym(word, n) for word in ("lower", "upper", "near")]
        best = self.best_of(self.bends(palm, redundancy), score, *symbols)
        return ca.Function(name, [redundancy, *inputs, *symbols], with_cse(*best))

    def best_of(
        self, bends: Sequence[ElbowBranch], score: Score, lower: Expr, upper: Expr, reference: Expr
    ) -> tuple[Expr, Expr]:
        """Return the best solution (n, 1) of some elbow branches, and its score."""
        best: tuple[Expr, ...] = ()
        for bend in bends:
            joints, cost, margin = self._evaluate(bend.joints, score, lower, upper, reference)
            for pair in bend.wrist_flips:
                first, second = (
                    self._evaluate(flip, score, lower, upper, reference) for flip in pair
                )
                selected = _better_flip(first, second, score)
                joints |= selected[0]
                cost, margin = cost + selected[1], ca.fmin(margin, selected[2])
            # Out of reach the margin is the reach margin.
            margin = ca.fmin(margin, ca.if_else(bend.slack < 0, bend.slack, np.inf))
            arm = ca.vertcat(*(joints[i] for i in range(len(joints))))
            best = better(best, (score.total(cost, margin), arm))
        return best[1], best[0]

    def _evaluate(
        self, joints: JointAngles, score: Score, lower: Expr, upper: Expr, reference: Expr
    ) -> tuple[dict[int, Expr], Expr, Expr]:
        """Return joints in their preferred turns, their cost and their limit margin."""
        multi_turn = self.screws.multi_turn_joints
        unwrapped = {
            i: score.unwrap(i, angle.value, lower, upper, reference)
            if i in multi_turn
            else angle.value
            for i, angle in joints.items()
        }
        return unwrapped, score.cost(unwrapped, reference), margin(unwrapped, lower, upper)

    def angle(self, index: int, cos_sin: CosSin) -> JointAngles:
        """Return the angle of a screw's joint, centred on its range."""
        value = self.screws.centred(index, cos_sin.angle)
        return {self.screws.joints[index]: JointAngle(value, cos_sin)}


def margin(joints: dict[int, Expr], lower: Expr, upper: Expr) -> Expr:
    """Return the smallest distance of joints from their bounds [rad], negative outside."""
    distances = [ca.fmin(angle - lower[i], upper[i] - angle) for i, angle in joints.items()]
    return ca.mmin(ca.vertcat(*distances)) if distances else ca.SX(np.inf)


def better(first: tuple[Expr, ...], second: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """Return the tuple with the larger first entry; the second one if the first is empty."""
    if not first:
        return second
    keep_first = first[0] >= second[0]
    return tuple(ca.if_else(keep_first, a, b) for a, b in zip(first, second, strict=True))


def _better_flip(
    first: tuple[dict[int, Expr], Expr, Expr],
    second: tuple[dict[int, Expr], Expr, Expr],
    score: Score,
) -> tuple[dict[int, Expr], Expr, Expr]:
    """Return the better of two alternatives of the same joints."""
    keep_first = score.total(*first[1:]) >= score.total(*second[1:])
    joints = {i: ca.if_else(keep_first, angle, second[0][i]) for i, angle in first[0].items()}
    return (
        joints,
        ca.if_else(keep_first, first[1], second[1]),
        ca.if_else(keep_first, first[2], second[2]),
    )


def _palm_symbols() -> tuple[Pose, list[Expr]]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    return Pose(rotation, origin), [rotation, origin]


@dataclass(frozen=True, eq=False)
class SphericalJoints:
    """A spherical joint: three screws through a point, each perpendicular to the next.

    Attributes:
        indices: Indices of the screws.
        point: (3,) common point [m].
        frame: (3, 3) columns x, y, z with z along the first axis and y along the second.
        offset: Angle from z to the third axis about y [rad].
    """

    indices: tuple[int, int, int]
    point: Array
    frame: Array
    offset: float

    def triples(self, screws: Screws, rotation: Expr) -> tuple[JointAngles, JointAngles]:
        """Return both triples of angles by joint that produce a rotation (3, 3)."""
        return self.angles_of(screws, self.euler_matrix(rotation))

    def euler_matrix(self, rotation: Expr) -> Expr:
        """Return a rotation as the matrix of Rz(t1) Ry(t2 + offset) Rz(t3), (3, 3)."""
        local = ca.DM(self.frame.T) @ rotation @ ca.DM(self.frame)
        # Rotate z of the frame to the third axis.
        c, s = float(np.cos(self.offset)), float(np.sin(self.offset))
        return local @ ca.sparsify(ca.DM([[c, 0, s], [0, 1, 0], [-s, 0, c]]))

    def angles_of(self, screws: Screws, matrix: Expr) -> tuple[JointAngles, JointAngles]:
        """Return both triples of angles of an `euler_matrix`, by joint.

        If the first and third axis are aligned, the first angle is zero and the third makes the
        whole rotation.
        """
        squared = matrix[0, 2] ** 2 + matrix[1, 2] ** 2
        tilted = squared > ALIGNED_SINE_SQUARED
        sine = ca.sqrt(ca.fmax(squared, ALIGNED_SINE_SQUARED))
        cos_first = ca.if_else(tilted, matrix[0, 2] / sine, 1.0)
        sin_first = ca.if_else(tilted, matrix[1, 2] / sine, 0.0)
        first = ca.atan2(sin_first, cos_first)
        second = ca.atan2(ca.if_else(tilted, sine, 0.0), matrix[2, 2])
        # From the rest of the rotation, so that both together are accurate for any second angle.
        third = ca.atan2(
            cos_first * matrix[1, 0] - sin_first * matrix[0, 0],
            cos_first * matrix[1, 1] - sin_first * matrix[0, 1],
        )
        pi = np.pi
        triples = []
        # The directions of the first and third angle shrink to zero where their axes align.
        length = ca.sqrt(squared)
        for sign, angles in (
            (1.0, (first, second, third)),
            (-1.0, (first + pi, -second, third + pi)),
        ):
            shifted = (angles[0], angles[1] - self.offset, angles[2])
            directions = (
                (CosSin(sign * matrix[0, 2], sign * matrix[1, 2]), length, 0.0),
                (CosSin(matrix[2, 2], sign * length), 1.0, self.offset),
                (CosSin(-sign * matrix[2, 0], sign * matrix[2, 1]), length, 0.0),
            )
            triples.append(
                {
                    screws.joints[index]: JointAngle(screws.centred(index, angle), *direction)
                    for index, angle, direction in zip(
                        self.indices, shifted, directions, strict=True
                    )
                }
            )
        return triples[0], triples[1]
