"""The patch of an object's surface that a pad may touch, as CasADi graphs.

A patch maps coordinates u to a point [m] and the unit outward normal in the object frame, both
(3, 1). The synthesis keeps the thumb's contact on the hand's mirror plane and the other two fingers
symmetric about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.mesh_shape import MeshShape
from casadi_ik.model.objects import GraspObject
from casadi_ik.model.shapes import (
    BentCapsule,
    Box,
    Cylinder,
    EllipticCylinder,
    Shape,
    Sphere,
)


def primitive(item: GraspObject) -> Shape:
    """Return the shape of an object; built-in objects are not meshes."""
    assert not isinstance(item.shape, MeshShape)
    return item.shape


@dataclass(frozen=True)
class Patch:
    """Surface coordinates of a shape near one finger.

    Attributes:
        shape: The shape.
        side: +1 where the thumb presses (towards the palm's +y), -1 opposite.
        axis: For a box the axis (0, 1, 2) whose two faces are pinched.
        margin: Distance the contact keeps from edges [m].
    """

    shape: Shape
    side: int
    axis: int = 2
    margin: float = 0.0

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (2,) of u."""
        s = self.shape
        if isinstance(s, Sphere):
            return np.array([-np.pi, -1.4]), np.array([np.pi, 1.4])
        if isinstance(s, BentCapsule):
            return np.array([-s.half_angle, -1.4]), np.array([s.half_angle, 1.4])
        if isinstance(s, Box):
            half_size = np.delete(np.asarray(s.size) / 2, self.axis) - self.margin
            return -half_size, half_size
        half_size = s.height / 2 - self.margin
        return np.array([-half_size, -1.4]), np.array([half_size, 1.4])

    def middle(self, offset: float) -> Array:
        """Return (2,) coordinates of a contact on the mirror plane of the hand; NaN where free.

        Args:
            offset: Where the mirror plane cuts the object, from its middle [m].
        """
        if isinstance(self.shape, Sphere):
            return np.array([np.pi / 2, np.nan])
        return np.array([offset, np.nan])

    def at(self, u: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Point and outward normal at u (2, 1).

        Sphere: azimuth and elevation. Cylinders: height along z and the angle of the normal from
        side * y (elliptic: side * x). Bent capsule: angle along the arc and angle of the normal
        from the bend's inside (thumb) or outside (fingers). Box: the two coordinates in the face.
        """
        s = self.shape
        if isinstance(s, Sphere):
            n = ca.vertcat(ca.cos(u[1]) * ca.cos(u[0]), ca.cos(u[1]) * ca.sin(u[0]), ca.sin(u[1]))
            return s.diameter / 2 * n, n
        if isinstance(s, Cylinder):
            n = ca.vertcat(ca.sin(u[1]), self.side * ca.cos(u[1]), 0)
            return s.diameter / 2 * n + ca.vertcat(0, 0, u[0]), n
        if isinstance(s, EllipticCylinder):
            a, b = s.width / 2, s.depth / 2
            n = ca.vertcat(self.side * ca.cos(u[1]), ca.sin(u[1]), 0)
            scale = ca.sqrt((a * n[0]) ** 2 + (b * n[1]) ** 2)
            return ca.vertcat(a**2 * n[0] / scale, b**2 * n[1] / scale, u[0]), n
        if isinstance(s, BentCapsule):
            inward = ca.vertcat(-ca.sin(u[0]), ca.cos(u[0]), 0)
            spine = s.radius * (ca.vertcat(0, 1, 0) - inward)
            n = self.side * ca.cos(u[1]) * inward + ca.vertcat(0, 0, ca.sin(u[1]))
            return spine + s.diameter / 2 * n, n
        n = np.zeros(3)
        n[self.axis] = self.side
        point = [u[0], u[1]]
        point.insert(self.axis, ca.SX(self.side * s.size[self.axis] / 2))
        return ca.vertcat(*point), ca.SX(ca.DM(n))
