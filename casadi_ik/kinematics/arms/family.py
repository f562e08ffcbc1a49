"""What every family of arms offers: all arms for a palm pose at a value of its redundancy.

An arm of six joints has up to eight arms for a palm pose: two by two *bends* of three joints, and
for each of them two ends, the three joints that are left. An arm of seven joints has as many for
every value of its redundancy: the position of one of its joints, or the swivel of its elbow. An arm
of which joints are locked has a redundancy of several numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.screws import Screws, Turn
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, shared

SIGNS = tuple(product((1, -1), (1, -1), (1, -1)))
"""The three signs of a branch, in the order of the branches."""

EXACT = 1e-9
"""A family whose model error is smaller [m and rad] solves the real arm."""

ALIGNED = 1e-24
"""Squared sine of the tilt below which first and third axis of a sphere count as aligned."""


@dataclass(frozen=True)
class Redundancy:
    """One number that the palm pose leaves free.

    Attributes:
        joint: Number of the joint whose position it is; None: an angle that goes all around.
    """

    joint: int | None

    def bounds(self, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
        """First and last value [rad] within bounds of the arm (n,); a whole turn at most."""
        if self.joint is None:
            return -np.pi, np.pi
        low, high = lower[self.joint], upper[self.joint]
        half = ca.fmin((high - low) / 2, np.pi)
        return (low + high) / 2 - half, (low + high) / 2 + half


@dataclass(frozen=True, eq=False)
class Bend:
    """One way to bend an arm.

    Attributes:
        joints: Angle [rad] by number of the joint.
        ends: Of joints that can be turned in two ways both ways; each pair by itself.
        slack: >= 0 where the palm pose can be reached like this.
    """

    joints: dict[int, Expr]
    ends: tuple[tuple[dict[int, Expr], dict[int, Expr]], ...]
    slack: Expr

    def arms(self) -> list[Expr]:
        """Every arm (n, 1) [rad] with this bend."""
        found = []
        for chosen in product(*self.ends):
            joints = dict(self.joints)
            for end in chosen:
                joints |= end
            found.append(ca.vertcat(*(joints[i] for i in range(len(joints)))))
        return found


class Score(ABC):
    """How arms are compared; `n` joints."""

    @abstractmethod
    def moved(self, joint: int, angle: Expr, lower: Expr, upper: Expr, near: Expr) -> Expr:
        """An angle of a joint that turns more than once in the turn that is wanted."""

    @abstractmethod
    def cost(self, joints: dict[int, Expr], near: Expr) -> Expr:
        """What adds up over joints; smaller is better."""

    @abstractmethod
    def total(self, cost: Expr, margin: Expr) -> Expr:
        """Of a cost and the least distance to a bound [rad], higher is better."""

    @abstractmethod
    def part(self, joints: Sequence[int]) -> Score:
        """The same of an arm of some of the joints."""


class ArmFamily(ABC):
    """An arm that is solved for its palm pose.

    Attributes:
        screws: Of the arm.
        model_error: How far the nominal arm that is solved is from the real one [m and rad].
        rows: Branches at a value of the redundancy.
        roots: Branches of the same three signs.
        starts: Places that a search within the family may begin at.
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
        """What the arm is, in a few words."""

    @property
    @abstractmethod
    def parts(self) -> tuple[str, str, str]:
        """Which part of the arm the three signs are of: shoulder, elbow, wrist."""

    @property
    @abstractmethod
    def redundancy(self) -> tuple[Redundancy, ...]:
        """What the palm pose leaves free."""

    @abstractmethod
    def arms(self) -> ca.Function:
        """All branches at a value of the redundancy.

        Returns:
            (rotation (3, 3), origin (3, 1) [m], redundancy (r, 1) [rad]) -> branches (rows, n)
            [rad], `roots` rows for each of `SIGNS`, and the slack (rows, 1) of each: >= 0 within
            reach.
        """

    @abstractmethod
    def best(self, name: str, score: Score) -> ca.Function:
        """The best arm at a value of the redundancy.

        Args:
            name: Of the function.
            score: How arms are compared.

        Returns:
            (redundancy (r, 1), rotation, origin, lower (n, 1), upper (n, 1), near (n, 1)) -> arm
            (n, 1) [rad] and its score.
        """

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr | None:
        """How far [m] a palm is out of reach for certain, 0 where it may be in reach.

        Args:
            palm: Pose of the palm, base frame.
            lower: (n, 1) bounds of the arm [rad].
            upper: (n, 1).

        Returns:
            Positive if it is too far away, negative if too near. None: nothing is known.
        """
        del palm, lower, upper
        return None

    @property
    def size(self) -> int:
        """Numbers that say the redundancy: without any one that is not looked at."""
        return max(len(self.redundancy), 1)

    @property
    def exact(self) -> bool:
        """Whether the nominal arm is the real one."""
        return self.model_error <= EXACT

    @property
    def complete(self) -> bool:
        """Whether no arm is missed where all of the redundancy is looked at."""
        return self.exact and not self.locked

    @property
    def is_iterative(self) -> bool:
        """Whether the branches are roots that are searched for."""
        return self.roots > 1


class ClosedForm(ArmFamily):
    """An arm all of whose branches are one expression of palm pose and redundancy."""

    @abstractmethod
    def bends(
        self, palm: Pose, redundancy: Expr, signs: tuple[Expr, ...] | None = None
    ) -> list[Bend]:
        """All bends; those out of reach are the nearest, with a negative slack.

        Args:
            palm: Desired pose of the palm, base frame.
            redundancy: (r, 1) [rad].
            signs: Of the one bend that is wanted (1 or -1); None: all are.
        """

    def breakpoints(
        self, palm: Pose, signs: tuple[Expr, ...], lower: Expr, upper: Expr
    ) -> Expr | None:
        """(k, 1) values of the redundancy of a bend at which a joint may stand at a bound.

        Args:
            palm: Desired pose of the palm, base frame.
            signs: Of the bend.
            lower: (n, 1) bounds of the arm [rad].
            upper: (n, 1).

        Returns:
            Where the allowed values begin and end; None: they are not known.
        """
        del palm, signs, lower, upper
        return None

    def arms(self) -> ca.Function:
        """All branches, in the order of the bends."""
        palm, inputs = _palm()
        redundancy = ca.SX.sym("redundancy", self.size)
        bends = self.bends(palm, redundancy)
        found = [arm for bend in bends for arm in bend.arms()]
        slack = ca.vertcat(*(bend.slack for bend in bends for _ in bend.arms()))
        outputs = shared(ca.horzcat(*found).T, slack)
        return ca.Function("arms", [*inputs, redundancy], outputs)

    def best(self, name: str, score: Score) -> ca.Function:
        """The ends choose their ways independently of each other."""
        palm, inputs = _palm()
        redundancy = ca.SX.sym("redundancy", self.size)
        n = len(self.screws)
        ends = [ca.SX.sym(word, n) for word in ("lower", "upper", "near")]
        best = self.best_of(self.bends(palm, redundancy), score, *ends)
        return ca.Function(name, [redundancy, *inputs, *ends], shared(*best))

    def best_of(
        self, bends: Sequence[Bend], score: Score, lower: Expr, upper: Expr, near: Expr
    ) -> tuple[Expr, Expr]:
        """The best arm (n, 1) of some bends, and its score."""
        best: tuple[Expr, ...] = ()
        for bend in bends:
            joints, cost, margin = self._weighed(bend.joints, score, lower, upper, near)
            for pair in bend.ends:
                one, other = (self._weighed(end, score, lower, upper, near) for end in pair)
                chosen = _better(one, other, score)
                joints |= chosen[0]
                cost, margin = cost + chosen[1], ca.fmin(margin, chosen[2])
            # Out of reach the margin says by how much.
            margin = ca.fmin(margin, ca.if_else(bend.slack < 0, bend.slack, np.inf))
            arm = ca.vertcat(*(joints[i] for i in range(len(joints))))
            best = better(best, (score.total(cost, margin), arm))
        return best[1], best[0]

    def _weighed(
        self, joints: dict[int, Expr], score: Score, lower: Expr, upper: Expr, near: Expr
    ) -> tuple[dict[int, Expr], Expr, Expr]:
        """Some joints in the turns that are wanted, their cost and their margin."""
        wide = self.screws.turning
        moved = {
            i: score.moved(i, angle, lower, upper, near) if i in wide else angle
            for i, angle in joints.items()
        }
        return moved, score.cost(moved, near), margin(moved, lower, upper)

    def angle(self, place: int, turn: Turn) -> dict[int, Expr]:
        """The angle of a screw's joint in the turn centred on its range."""
        return {self.screws.joints[place]: self.screws.centred(place, turn.angle)}


def margin(joints: dict[int, Expr], lower: Expr, upper: Expr) -> Expr:
    """Smallest distance [rad] of some joints from their bounds, negative outside."""
    ends = [ca.fmin(angle - lower[i], upper[i] - angle) for i, angle in joints.items()]
    return ca.mmin(ca.vertcat(*ends)) if ends else ca.SX(np.inf)


def better(one: tuple[Expr, ...], other: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """Whichever is first or has the larger first entry."""
    if not one:
        return other
    keep = one[0] >= other[0]
    return tuple(ca.if_else(keep, a, b) for a, b in zip(one, other, strict=True))


def _better(
    one: tuple[dict[int, Expr], Expr, Expr],
    other: tuple[dict[int, Expr], Expr, Expr],
    score: Score,
) -> tuple[dict[int, Expr], Expr, Expr]:
    """The better of two ways to turn the same joints."""
    keep = score.total(*one[1:]) >= score.total(*other[1:])
    joints = {i: ca.if_else(keep, angle, other[0][i]) for i, angle in one[0].items()}
    return joints, ca.if_else(keep, one[1], other[1]), ca.if_else(keep, one[2], other[2])


def _palm() -> tuple[Pose, list[Expr]]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    return Pose(rotation, origin), [rotation, origin]


@dataclass(frozen=True, eq=False)
class Sphere:
    """Three screws through one point, each perpendicular to the next.

    Attributes:
        places: Of the screws.
        point: (3,) where they meet [m].
        frame: (3, 3) columns x, y, z with z along the first axis and y along the second.
        offset: Angle by which the third axis is turned from z about y [rad].
    """

    places: tuple[int, int, int]
    point: Array
    frame: Array
    offset: float

    def triples(self, screws: Screws, rotation: Expr) -> tuple[dict[int, Expr], dict[int, Expr]]:
        """Both ways to make a rotation (3, 3), base frame: angles [rad] by joint."""
        return self.read(screws, self.euler_matrix(rotation))

    def euler_matrix(self, rotation: Expr) -> Expr:
        """The rotation as Rz(t1) Ry(t2 + offset) Rz(t3), (3, 3)."""
        local = ca.DM(self.frame.T) @ rotation @ ca.DM(self.frame)
        # The frame's z is not yet along the third axis.
        c, s = float(np.cos(self.offset)), float(np.sin(self.offset))
        return local @ ca.sparsify(ca.DM([[c, 0, s], [0, 1, 0], [-s, 0, c]]))

    def read(self, screws: Screws, matrix: Expr) -> tuple[dict[int, Expr], dict[int, Expr]]:
        """Both triples of angles [rad] behind an `euler_matrix`, by joint.

        Where first and third axis are aligned, the first stays at its zero and the third makes all
        of the turn.
        """
        squared = matrix[0, 2] ** 2 + matrix[1, 2] ** 2
        tilted = squared > ALIGNED
        sine = ca.sqrt(ca.fmax(squared, ALIGNED))
        cos_first = ca.if_else(tilted, matrix[0, 2] / sine, 1.0)
        sin_first = ca.if_else(tilted, matrix[1, 2] / sine, 0.0)
        first = ca.atan2(sin_first, cos_first)
        second = ca.atan2(ca.if_else(tilted, sine, 0.0), matrix[2, 2])
        # From what the first angle leaves, so that both together are right however small the tilt.
        third = ca.atan2(
            cos_first * matrix[1, 0] - sin_first * matrix[0, 0],
            cos_first * matrix[1, 1] - sin_first * matrix[0, 1],
        )
        pi = np.pi
        found = []
        for angles in ((first, second, third), (first + pi, -second, third + pi)):
            moved = (angles[0], angles[1] - self.offset, angles[2])
            found.append(
                {
                    screws.joints[place]: screws.centred(place, angle)
                    for place, angle in zip(self.places, moved, strict=True)
                }
            )
        return found[0], found[1]
