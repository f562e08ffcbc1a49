"""Where a box of hands puts the wrist, against the distances from the shoulder an arm can hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.solving.diagnosis.box_contacts import SLACK, BoxContact
from casadi_ik.symbolic.linear_algebra import solve_spd
from casadi_ik.symbolic.smooth import Expr, safe_norm

REGULAR = 1e-9
"""Added to the diagonal of the carrier's equations; what it changes is accounted for."""


@dataclass(frozen=True, eq=False)
class Wrist:
    """An arm holds a point of the palm at some distances from a point of the base.

    Attributes:
        shoulder: (3,) the point of the base [m].
        wrist: (3,) the point in the palm frame [m].
    """

    shoulder: Array
    wrist: Array

    @property
    def points(self) -> tuple[Array, Array]:
        """Both."""
        return self.shoulder, self.wrist


@dataclass(frozen=True, eq=False)
class Carrier:
    """Contacts that carry what is fixed in the palm, as a weighted sum.

    With contacts x, normals n and any coefficients a point of the palm is sum(a x) + sum(b n) +
    rest; the same sum of what is asked for differs by at most sum(|a| radius) + sum(|b| chord) +
    |rest|. The coefficients are those with the least weighted sum of squares.
    """

    contacts: list[BoxContact]

    def point(self, point: Expr) -> tuple[Expr, Expr]:
        """Centre (3, 1) and radius of a ball that holds a point of the palm [m], base frame."""
        a, b = self._coefficients(point - self._mean[0])
        whole = [w + p for w, p in zip(self._share, a, strict=True)]
        return self._ball(point, whole, b)

    def direction(self, direction: Expr) -> tuple[Expr, Expr]:
        """The same of a unit vector of the palm."""
        return self._ball(direction, *self._coefficients(direction))

    @cached_property
    def _share(self) -> list[Expr]:
        heavy = [contact.placed / contact.radius**2 for contact in self.contacts]
        total = sum(heavy, ca.SX(1e-300))
        return [w / total for w in heavy]

    @cached_property
    def _mean(self) -> tuple[Expr, Expr]:
        """Mean contact in the palm frame, and of what is asked for."""
        pairs = list(zip(self._share, self.contacts, strict=True))
        here = sum((w * contact.point for w, contact in pairs), ca.SX(3, 1))
        return here, sum((w * contact.target for w, contact in pairs), ca.SX(3, 1))

    @cached_property
    def _system(self) -> tuple[Expr, Expr]:
        """Columns (3, 2 f) and W A' (2 f, 3) over its normal matrix."""
        columns, weights = [], []
        for contact in self.contacts:
            columns += [contact.point - self._mean[0], contact.normal]
            weights += [contact.placed / contact.radius**2, contact.faced / contact.chord**2]
        A, W = ca.horzcat(*columns), ca.diag(ca.vertcat(*weights))
        normal = A @ W @ A.T
        scale = normal[0, 0] + normal[1, 1] + normal[2, 2]
        normal += REGULAR * (scale + 1e-300) * ca.DM.eye(3)
        return normal, W @ A.T

    def _coefficients(self, vector: Expr) -> tuple[list[Expr], list[Expr]]:
        """Of points and normals; those of the points sum to nothing."""
        normal, weighted = self._system
        found = weighted @ solve_spd(normal, vector)
        a = [found[2 * i] for i in range(len(self.contacts))]
        drawn = sum(a, ca.SX(0))
        # The mean draws on every contact, too.
        return (
            [p - w * drawn for p, w in zip(a, self._share, strict=True)],
            [found[2 * i + 1] for i in range(len(self.contacts))],
        )

    def _ball(self, palm: Expr, a: list[Expr], b: list[Expr]) -> tuple[Expr, Expr]:
        """The same sum of what is asked for; the radius by balls or by slopes, the smaller one."""
        centre, rest = ca.SX(3, 1), palm
        slopes = ca.SX(3, self.contacts[0].moves.shape[1])
        radius, sloped = ca.SX(0), ca.SX(0)
        for p, n, contact in zip(a, b, self.contacts, strict=True):
            centre += p * contact.target + n * contact.facing
            rest -= p * contact.point + n * contact.normal
            slopes += p * contact.moves + n * contact.turns
            radius += ca.fabs(p) * contact.radius + ca.fabs(n) * contact.chord
            sloped += ca.fabs(p) * contact.near + ca.fabs(n) * contact.close
        for k in range(slopes.shape[1]):
            # What moves the contacts as a whole moves the palm among them.
            sloped += safe_norm(slopes[:, k])
        return centre, safe_norm(rest) + SLACK + ca.fmin(radius, sloped)


def wrist_excess(
    contacts: list[BoxContact], wrist: Wrist, span: Expr, ball: tuple[Expr, Expr]
) -> list[Expr]:
    """Tests that are > 0 if the wrist is out of the arm's span.

    Args:
        contacts: Of the box.
        wrist: The arm.
        span: Smallest and largest distance [m].
        ball: That holds the wrist, of `Carrier.point`.
    """
    shoulder, near, far = ca.SX(ca.DM(wrist.shoulder)), span[0], span[1]
    point, found = ca.SX(ca.DM(wrist.wrist)), []
    for contact in contacts:
        away = safe_norm(contact.target - shoulder)
        arm = safe_norm(point - contact.point)
        found.append(contact.placed * (away - arm - contact.radius - far))
        found.append(contact.placed * (arm - contact.radius - away - far))
        found.append(contact.placed * (near - away - arm - contact.radius))
    centre, radius = ball
    away = safe_norm(centre - shoulder)
    return [*found, away - radius - far, near - away - radius]
