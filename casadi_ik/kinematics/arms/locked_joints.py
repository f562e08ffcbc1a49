"""Arms with more joints than a family: joints at the ends are locked, the others are solved.

A hand with a wrist turns an arm of seven joints into one of nine. With the wrist locked, the other
joints belong to their family, for a palm pose that is moved by the wrist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.kinematics.arms.family import ArmFamily, Redundancy, Score
from casadi_ik.kinematics.arms.screws import Screws
from casadi_ik.kinematics.forward import axis_rotation
from casadi_ik.kinematics.se3 import Transform, compose, inverse
from casadi_ik.kinematics.smooth import Expr


@dataclass(frozen=True, eq=False)
class LockedJointArm(ArmFamily):
    """An arm that belongs to a family when some of its joints are locked.

    Attributes:
        inner: Family of the solved joints, numbered from 0.
        screws: Screws of the whole arm.
        solved: Consecutive numbers of the solved joints.
        locked: Numbers of the locked joints; they are redundancy parameters of the arm.
    """

    inner: ArmFamily
    screws: Screws
    solved: tuple[int, ...]
    locked: tuple[int, ...]  # type: ignore[misc]

    @property
    def kind(self) -> str:
        """Description of the inner arm, and the locked joints."""
        joints = ", ".join(str(joint + 1) for joint in self.locked)
        return f"{describe_family(self.inner)}, joints {joints} held"

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """Value of the inner arm."""
        return self.inner.sign_names

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The locked joints, then the redundancy parameters of the inner arm."""
        inner = [
            Redundancy(None if parameter.joint is None else self.solved[parameter.joint])
            for parameter in self.inner.redundancy
        ]
        return (*(Redundancy(joint) for joint in self.locked), *inner)

    @property
    def model_error(self) -> float:  # type: ignore[override]
        """Model error of the inner arm."""
        return self.inner.model_error

    @property
    def rows(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.rows

    @property
    def roots(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.roots

    @property
    def starts(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.starts

    def arms(self) -> ca.Function:
        """Value of the inner arm."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        locked, free = self._split(redundancy)
        branches, slack = self.inner.arms()(*self._inner_palm()(rotation, origin, locked), free)
        join = self._joined_arm()
        rows = [join(branches[i, :].T, locked).T for i in range(self.rows)]
        return ca.Function("arms", [rotation, origin, redundancy], [ca.vertcat(*rows), slack])

    def best(self, name: str, score: Score) -> ca.Function:
        """Return the function of the best branch of the inner arm; locked joints are not scored."""
        n, solved = len(self.screws), list(self.solved)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        bounds = [ca.MX.sym(word, n) for word in ("lower", "upper", "near")]
        locked, free = self._split(redundancy)
        inner_palm = self._inner_palm()(rotation, origin, locked)
        best = self.inner.best(f"{name}_inner", score.restrict(solved))
        branches, total = best(free, *inner_palm, *(end[solved] for end in bounds))
        outputs = [self._joined_arm()(branches, locked), total]
        return ca.Function(name, [redundancy, rotation, origin, *bounds], outputs)

    def _split(self, redundancy: Expr) -> tuple[Expr, Expr]:
        """Split the redundancy into locked joints and inner parameters (at least one number)."""
        count = len(self.locked)
        return redundancy[:count], redundancy[count:] if self.inner.redundancy else redundancy[:1]

    def _inner_palm(self) -> ca.Function:
        """Return (rotation, origin, locked joints) -> the palm pose for the solved joints."""
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        angles = ca.SX.sym("locked", len(self.locked))
        indices = range(len(self.locked))
        proximal = [index for index in indices if self.locked[index] < self.solved[0]]
        distal = [index for index in indices if self.locked[index] > self.solved[-1]]
        start: Transform = ca.DM(self.screws.rotation), ca.DM(self.screws.origin)
        motion = compose(self._inverse_motion(proximal, angles), (rotation, origin))
        motion = compose(compose(motion, inverse(start)), self._inverse_motion(distal, angles))
        outputs = [ca.densify(sub_chain) for sub_chain in compose(motion, start)]
        return ca.Function("left", [rotation, origin, angles], outputs)

    def _inverse_motion(self, indices: Sequence[int], angles: Expr) -> Transform:
        """Return the inverse motion of some locked joints."""
        motion: Transform = (ca.SX.eye(3), ca.SX.zeros(3, 1))
        for index in reversed(indices):
            joint = self.locked[index]
            point = ca.DM(self.screws.points[joint])
            turn = axis_rotation(self.screws.axes[joint], -angles[index])
            motion = compose(motion, (turn, point - turn @ point))
        return motion

    def _joined_arm(self) -> ca.Function:
        """Return (solved joints, locked joints) -> all joints of the arm (n, 1)."""
        solved, locked = (
            ca.SX.sym("solved", len(self.solved)),
            ca.SX.sym("locked", len(self.locked)),
        )
        values = dict(zip(self.solved, ca.vertsplit(solved), strict=True))
        values |= dict(zip(self.locked, ca.vertsplit(locked), strict=True))
        return ca.Function(
            "join", [solved, locked], [ca.vertcat(*(v for _, v in sorted(values.items())))]
        )


def describe_family(family: ArmFamily) -> str:
    """Describe an arm in words."""
    is_approximate = not family.is_exact and not family.is_iterative and not family.locked
    return f"nearly {family.kind}" if is_approximate else family.kind


def sub_chain(screws: Screws, indices: Sequence[int]) -> Screws:
    """Return consecutive joints of an arm as an arm."""
    rows = list(indices)
    return replace(
        screws,
        joints=tuple(range(len(rows))),
        axes=np.array(screws.axes[rows]),
        points=np.array(screws.points[rows]),
        lower=np.array(screws.lower[rows]),
        upper=np.array(screws.upper[rows]),
    )
