"""Where a box of hands puts the wrist, against the distances from the shoulder an arm can hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.solving.diagnosis.box_contacts import SLACK, BoxContact
from casadi_ik.solving.diagnosis.pair_rows import Row
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
class Ball:
    """What holds a point or a direction of the palm, base frame.

    Attributes:
        centre: (3, 1).
        radius: Of the ball.
        shares: What each coordinate of the box adds to it, h of them.
    """

    centre: Expr
    radius: Expr
    shares: list[Expr]


@dataclass(frozen=True, eq=False)
class Carrier:
    """Contacts that carry what is fixed in the palm, as a weighted sum.

    With contacts x, normals n and any coefficients a point of the palm is sum(a x) + sum(b n) +
    rest; the same sum of what is asked for differs by at most sum(|a| radius) + sum(|b| chord) +
    |rest|. The coefficients are those with the least weighted sum of squares.
    """

    contacts: list[BoxContact]

    def point(self, point: Expr) -> Ball:
        """The ball that holds a point of the palm [m]."""
        a, b = self._coefficients(point - self._mean[0])
        whole = [w + p for w, p in zip(self._share, a, strict=True)]
        return self._ball(point, whole, b)

    def direction(self, direction: Expr) -> Ball:
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

    def _ball(self, palm: Expr, a: list[Expr], b: list[Expr]) -> Ball:
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
        # What moves the contacts as a whole moves the palm among them.
        shares = _columns(slopes)
        sloped += sum(shares, ca.SX(0))
        return Ball(centre, safe_norm(rest) + SLACK + ca.fmin(radius, sloped), shares)


@dataclass(frozen=True, eq=False)
class Seen:
    """Where the palm sees a point of the base: the same sum, of what is asked for.

    The coefficients are those that give the point with the least weighted sum of squares. In the
    palm frame the wrist stands still, and it is known which way a slope carries the point.

    Attributes:
        centre: (3, 1) in the middle of the box [m], palm frame.
        slopes: (3, h) by u [m].
        loose: How far the point can be from there besides [m].
    """

    centre: Expr
    slopes: Expr
    loose: Expr

    @classmethod
    def point(cls, contacts: list[BoxContact], point: Expr) -> Seen:
        """A point (3, 1) of the base."""
        heavy = [contact.placed / contact.radius**2 for contact in contacts]
        total = sum(heavy, ca.SX(1e-300))
        share = [w / total for w in heavy]
        mean = sum((w * c.target for w, c in zip(share, contacts, strict=True)), ca.SX(3, 1))
        columns, weights = [], []
        for w, contact in zip(heavy, contacts, strict=True):
            columns += [contact.target - mean, contact.facing]
            weights += [w, contact.faced / contact.chord**2]
        A, W = ca.horzcat(*columns), ca.diag(ca.vertcat(*weights))
        normal = A @ W @ A.T
        normal += REGULAR * (normal[0, 0] + normal[1, 1] + normal[2, 2] + 1e-300) * ca.DM.eye(3)
        found = W @ A.T @ solve_spd(ca.densify(normal), point - mean)
        left = 1 - sum((found[2 * i] for i in range(len(contacts))), ca.SX(0))
        centre, rest = ca.SX(3, 1), point
        slopes, loose = ca.SX(3, contacts[0].moves.shape[1]), ca.SX(SLACK)
        for i, contact in enumerate(contacts):
            # The mean draws on every contact, too.
            p, n = found[2 * i] + share[i] * left, found[2 * i + 1]
            centre += p * contact.point + n * contact.normal
            rest -= p * contact.target + n * contact.facing
            slopes += p * contact.moves + n * contact.turns
            loose += ca.fabs(p) * contact.near + ca.fabs(n) * contact.close
        return cls(centre, slopes, loose + safe_norm(rest))

    def distances(self, other: Expr) -> tuple[Expr, Expr, Expr]:
        """Smallest and largest distance from a point (3, 1) of the palm [m].

        And (1, h) what each coordinate adds to what is between.
        """
        away = self.centre - other
        length = safe_norm(away)
        line = away / length
        along = line.T @ self.slopes
        aside = self.slopes - line @ along
        shares = ca.fabs(along)
        ahead, far = ca.sum2(shares), sum(_columns(aside), ca.SX(0))
        most = ca.sqrt((length + ahead) ** 2 + far**2) + self.loose
        return length - ahead - self.loose, most, shares


def _columns(matrix: Expr) -> list[Expr]:
    return [safe_norm(matrix[:, k]) for k in range(matrix.shape[1])]


def wrist_excess(
    contacts: list[BoxContact], wrist: Wrist, span: Expr, ball: Ball
) -> tuple[list[Expr], list[Row]]:
    """Tests that are > 0 if the wrist is out of the arm's span, and rows of what decides them.

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
    seen = Seen.point(contacts, shoulder)
    least, most, shares = seen.distances(point)
    away = safe_norm(seen.centre - point)
    found += [least - far, near - most]
    rows = [Row(_outside(away, span), ca.fmax(away - least, most - away), ca.horzsplit(shares))]
    # Far from the contacts the shoulder is seen less sharply than the wrist.
    away = safe_norm(ball.centre - shoulder)
    found += [away - ball.radius - far, near - away - ball.radius]
    return found, [*rows, Row(_outside(away, span), ball.radius, ball.shares)]


def _outside(distance: Expr, span: Expr) -> Expr:
    return ca.fmax(ca.fmax(distance - span[1], span[0] - distance), 0.0)
