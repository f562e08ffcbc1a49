"""Where a box of hands puts the wrist, against the distances from the shoulder an arm can hold."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.solving.diagnosis.box_contacts import SLACK, BoxContact
from casadi_ik.symbolic.linear_algebra import solve_spd
from casadi_ik.symbolic.smooth import Expr, safe_norm

REGULAR = 1e-9
"""Added to the diagonal of the wrist's equations; what it changes is accounted for."""


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


def wrist_excess(contacts: list[BoxContact], wrist: Wrist, span: Expr) -> list[Expr]:
    """Tests that are > 0 if the wrist is out of the arm's span.

    Args:
        contacts: Of the box.
        wrist: The arm.
        span: Smallest and largest distance [m].
    """
    shoulder, near, far = ca.SX(ca.DM(wrist.shoulder)), span[0], span[1]
    point, found = ca.SX(ca.DM(wrist.wrist)), []
    for contact in contacts:
        away = safe_norm(contact.target - shoulder)
        arm = safe_norm(point - contact.point)
        found.append(contact.placed * (away - arm - contact.radius - far))
        found.append(contact.placed * (arm - contact.radius - away - far))
        found.append(contact.placed * (near - away - arm - contact.radius))
    centre, radius = carried(contacts, point)
    away = safe_norm(centre - shoulder)
    return [*found, away - radius - far, near - away - radius]


def carried(contacts: list[BoxContact], point: Expr) -> tuple[Expr, Expr]:
    """A ball that holds a point of the palm: the contacts carry it as a weighted sum.

    With contacts x, normals n and any coefficients the point is sum(a x) + sum(b n) + rest; the
    same sum of what is asked for differs by at most sum(|a| radius) + sum(|b| chord) + |rest|. The
    coefficients are those with the least weighted sum of squares.
    """
    heavy = [contact.placed / contact.radius**2 for contact in contacts]
    total = sum(heavy, ca.SX(1e-300))
    share = [w / total for w in heavy]
    there = sum((w * c.target for w, c in zip(share, contacts, strict=True)), ca.SX(3, 1))
    here = sum((w * c.point for w, c in zip(share, contacts, strict=True)), ca.SX(3, 1))
    columns, weights = [], []
    for w, contact in zip(heavy, contacts, strict=True):
        columns += [contact.point - here, contact.normal]
        weights += [w, contact.faced / contact.chord**2]
    A, W = ca.horzcat(*columns), ca.diag(ca.vertcat(*weights))
    normal = A @ W @ A.T
    scale = normal[0, 0] + normal[1, 1] + normal[2, 2]
    normal += REGULAR * (scale + 1e-300) * ca.DM.eye(3)
    coefficients = W @ (A.T @ solve_spd(normal, point - here))
    rest = point - here - A @ coefficients
    centre, radius, drawn = there, safe_norm(rest) + SLACK, ca.SX(0)
    for i, contact in enumerate(contacts):
        a, b = coefficients[2 * i], coefficients[2 * i + 1]
        centre += a * (contact.target - there) + b * contact.facing
        radius += ca.fabs(b) * contact.chord
        drawn += a
    for i, contact in enumerate(contacts):
        # The mean draws on every contact, too.
        radius += ca.fabs(coefficients[2 * i] + share[i] * (1 - drawn)) * contact.radius
    return centre, radius
