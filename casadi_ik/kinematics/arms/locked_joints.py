"""Arms of more joints than a family has: those at their ends are locked, the rest is solved.

A hand with a wrist makes an arm of seven joints one of nine. With the wrist locked at any angles
the other joints are of the family that they are of without it, for a palm pose that is moved by
the wrist.
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
    """An arm that is of a family when some of its joints are locked.

    Attributes:
        inner: Of the joints that are solved for, numbered from 0.
        screws: Of the whole arm.
        solved: Numbers of these joints, one after the other.
        locked: Numbers of the others; with the inner redundancy they are the arm's.
    """

    inner: ArmFamily
    screws: Screws
    solved: tuple[int, ...]
    locked: tuple[int, ...]  # type: ignore[misc]

    @property
    def kind(self) -> str:
        """That of the inner arm, and which joints are locked."""
        joints = ", ".join(str(joint + 1) for joint in self.locked)
        return f"{in_words(self.inner)}, joints {joints} held"

    @property
    def parts(self) -> tuple[str, str, str]:
        """Those of the inner arm."""
        return self.inner.parts

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The locked joints, then what the inner arm leaves free."""
        inner = [
            Redundancy(None if one.joint is None else self.solved[one.joint])
            for one in self.inner.redundancy
        ]
        return (*(Redundancy(joint) for joint in self.locked), *inner)

    @property
    def model_error(self) -> float:  # type: ignore[override]
        """That of the inner arm."""
        return self.inner.model_error

    @property
    def rows(self) -> int:  # type: ignore[override]
        """Those of the inner arm."""
        return self.inner.rows

    @property
    def roots(self) -> int:  # type: ignore[override]
        """Those of the inner arm."""
        return self.inner.roots

    @property
    def starts(self) -> int:  # type: ignore[override]
        """Those of the inner arm."""
        return self.inner.starts

    def arms(self) -> ca.Function:
        """Those of the inner arm."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        locked, free = self._split(redundancy)
        found, slack = self.inner.arms()(*self._left()(rotation, origin, locked), free)
        joined = self._join()
        rows = [joined(found[i, :].T, locked).T for i in range(self.rows)]
        return ca.Function("arms", [rotation, origin, redundancy], [ca.vertcat(*rows), slack])

    def best(self, name: str, score: Score) -> ca.Function:
        """That of the inner arm; by the locked joints it is not scored."""
        n, solved = len(self.screws), list(self.solved)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        ends = [ca.MX.sym(word, n) for word in ("lower", "upper", "near")]
        locked, free = self._split(redundancy)
        left = self._left()(rotation, origin, locked)
        best = self.inner.best(f"{name}_inner", score.part(solved))
        found, total = best(free, *left, *(end[solved] for end in ends))
        outputs = [self._join()(found, locked), total]
        return ca.Function(name, [redundancy, rotation, origin, *ends], outputs)

    def _split(self, redundancy: Expr) -> tuple[Expr, Expr]:
        """The locked joints, and the inner redundancy: any number if there is none."""
        count = len(self.locked)
        return redundancy[:count], redundancy[count:] if self.inner.redundancy else redundancy[:1]

    def _left(self) -> ca.Function:
        """(rotation, origin, locked joints) -> the palm pose left to the solved joints."""
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        angles = ca.SX.sym("locked", len(self.locked))
        places = range(len(self.locked))
        before = [place for place in places if self.locked[place] < self.solved[0]]
        after = [place for place in places if self.locked[place] > self.solved[-1]]
        start: Transform = ca.DM(self.screws.rotation), ca.DM(self.screws.origin)
        moved = compose(self._undone(before, angles), (rotation, origin))
        moved = compose(compose(moved, inverse(start)), self._undone(after, angles))
        outputs = [ca.densify(part) for part in compose(moved, start)]
        return ca.Function("left", [rotation, origin, angles], outputs)

    def _undone(self, places: Sequence[int], angles: Expr) -> Transform:
        """The inverse of what some of the locked joints move by."""
        moved: Transform = (ca.SX.eye(3), ca.SX.zeros(3, 1))
        for place in reversed(places):
            joint = self.locked[place]
            point = ca.DM(self.screws.points[joint])
            turn = axis_rotation(self.screws.axes[joint], -angles[place])
            moved = compose(moved, (turn, point - turn @ point))
        return moved

    def _join(self) -> ca.Function:
        """(solved joints, locked joints) -> the whole arm (n, 1)."""
        solved, locked = (
            ca.SX.sym("solved", len(self.solved)),
            ca.SX.sym("locked", len(self.locked)),
        )
        values = dict(zip(self.solved, ca.vertsplit(solved), strict=True))
        values |= dict(zip(self.locked, ca.vertsplit(locked), strict=True))
        return ca.Function(
            "join", [solved, locked], [ca.vertcat(*(v for _, v in sorted(values.items())))]
        )


def in_words(family: ArmFamily) -> str:
    """What an arm is, for a reader."""
    nearly = not family.exact and not family.is_iterative and not family.locked
    return f"nearly {family.kind}" if nearly else family.kind


def part(screws: Screws, places: Sequence[int]) -> Screws:
    """Some joints of an arm, one after the other, as an arm of their own."""
    rows = list(places)
    return replace(
        screws,
        joints=tuple(range(len(rows))),
        axes=np.array(screws.axes[rows]),
        points=np.array(screws.points[rows]),
        lower=np.array(screws.lower[rows]),
        upper=np.array(screws.upper[rows]),
    )
