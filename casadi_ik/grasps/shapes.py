"""Primitive shapes: exact signed distance, outward normal and a mesh; numpy only.

Every shape is centred in its own frame. Points and normals are (k, 3) or (3,); a distance is
negative inside. A normal is the gradient of the distance; on an edge, where it is not unique, it
is that of one of the faces.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.files.units import Length
from casadi_ik.grasps import meshes
from casadi_ik.grasps.meshes import Mesh


class Surface(Protocol):
    """What each shape has to say of itself; the type checker asks every member of `Shape` for it.

    A Protocol, as msgspec's structs cannot have abstract methods.
    """

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (k,) and unit outward normal (k, 3) for points (k, 3)."""
        ...

    def mesh(self, resolution: int = 32) -> Mesh:
        """Vertices (v, 3) [m] on the surface and triangles (t, 3), outward by the right hand."""
        ...


class Primitive(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", kw_only=True
):
    """A shape of an object file.

    Attributes:
        source: Tags of the sources of its numbers.
    """

    source: str

    def signed_distance(self: Surface, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside: (k,) for (k, 3), () for (3,)."""
        rows, shape = _rows(points)
        return self._nearest(rows)[0].reshape(shape[:-1])

    def normal(self: Surface, points: ArrayLike) -> Array:
        """Unit outward normal at the nearest surface point, same shape as the points."""
        rows, shape = _rows(points)
        return self._nearest(rows)[1].reshape(shape)

    def check(self) -> str:
        """What is wrong with the numbers, as "key: found, expected", or ""."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, (int, float)) and not 0 < number < np.inf:
                    return f"{name}: found {number}, expected a positive finite length"
        return ""


class Sphere(Primitive, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        diameter: [m].
    """

    diameter: Length

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points, np.array([0.0, 0.0, 1.0]))
        return distance - self.diameter / 2, normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Rings of latitude."""
        latitude = np.linspace(-np.pi / 2, np.pi / 2, resolution // 2 + 1)[1:-1]
        radius = self.diameter / 2
        rings = meshes.circle(resolution)[None] * (radius * np.cos(latitude))[:, None, None]
        rings[..., 2] = radius * np.sin(latitude)[:, None]
        return meshes.tube(rings, np.array([0, 0, -radius]), np.array([0, 0, radius]))


class Cylinder(Primitive, frozen=True, tag="cylinder", kw_only=True):
    """A circular cylinder along z.

    Attributes:
        diameter: [m].
        height: [m].
    """

    diameter: Length
    height: Length

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points[:, :2], np.array([1.0, 0.0]))
        return _extruded(distance - self.diameter / 2, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """A prism with two lids."""
        return meshes.prism(self.diameter / 2 * meshes.circle(resolution), self.height)


class EllipticCylinder(Primitive, frozen=True, tag="elliptic-cylinder", kw_only=True):
    """An elliptic cylinder along z.

    Attributes:
        width: Full axis along x [m].
        depth: Full axis along y [m].
        height: [m].
    """

    width: Length
    depth: Length
    height: Length

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _ellipse(points[:, :2], np.array([self.width / 2, self.depth / 2]))
        return _extruded(distance, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """A prism with two lids."""
        axes = np.array([self.width / 2, self.depth / 2, 0.0])
        return meshes.prism(axes * meshes.circle(resolution), self.height)


class Box(Primitive, frozen=True, tag="box", kw_only=True):
    """A box with edges along x, y and z.

    Attributes:
        size: Along x, y and z [m].
    """

    size: tuple[Length, Length, Length]

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        excess = np.abs(points) - np.asarray(self.size) / 2
        outside = np.maximum(excess, 0.0)
        length = np.linalg.norm(outside, axis=1)
        face = np.argmax(excess, axis=1)
        rows = np.arange(len(points))
        normal = np.where(length[:, None] > 0, outside, 0.0)
        normal /= np.where(length > 0, length, 1.0)[:, None]
        normal[rows, face] = np.where(length > 0, normal[rows, face], 1.0)
        normal *= np.where(points < 0, -1.0, 1.0)
        return np.where(length > 0, length, excess[rows, face]), normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Twelve triangles; the resolution does not matter."""
        del resolution
        x, y, z = np.asarray(self.size) / 2
        ring = np.array([[x, y, 0.0], [-x, y, 0.0], [-x, -y, 0.0], [x, -y, 0.0]])
        return meshes.prism(ring, 2 * z)


class BentCapsule(Primitive, frozen=True, tag="bent-capsule", kw_only=True):
    """A round tube along a circular arc, with hemispheres on its ends: a banana.

    The arc lies in the plane z = 0, its middle in the origin with the tangent x; it bends towards
    +y. The numbers are those of a bounding box, as published lists give them.

    Attributes:
        diameter: Of the tube [m].
        length: Along x, from end to end in a straight line [m].
        width: Along y, from the convex side's middle to the tips [m].
    """

    diameter: Length
    length: Length
    width: Length

    @property
    def radius(self) -> float:
        """Radius of the arc [m]."""
        half_chord, sagitta = (self.length - self.diameter) / 2, self.width - self.diameter
        return (half_chord**2 + sagitta**2) / (2 * sagitta)

    @property
    def half_angle(self) -> float:
        """Half the angle of the arc [rad]."""
        return float(np.arcsin((self.length - self.diameter) / 2 / self.radius))

    def check(self) -> str:
        """What is wrong with the numbers, as "key: found, expected", or ""."""
        problem = super().check()
        if problem:
            return problem
        sagitta = self.width - self.diameter
        if not 0 < sagitta < (self.length - self.diameter) / 2:
            return (
                f"width: found {self.width:g}, expected between the diameter {self.diameter:g} "
                f"and (diameter + length) / 2 = {(self.diameter + self.length) / 2:g}"
            )
        return ""

    def centreline(self, angle: Array) -> Array:
        """Points (k, 3) [m] of the arc at the angles (k,) [rad] from its middle."""
        flat = np.zeros_like(angle)
        return self.radius * np.stack([np.sin(angle), 1 - np.cos(angle), flat], axis=-1)

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        angle = np.arctan2(points[:, 0], self.radius - points[:, 1])
        foot = self.centreline(np.clip(angle, -self.half_angle, self.half_angle))
        distance, normal = _polar(points - foot, np.array([0.0, 0.0, 1.0]))
        return distance - self.diameter / 2, normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Rings along the arc, shrinking over the ends."""
        tube = self.diameter / 2
        cap = np.linspace(-np.pi / 2, 0, resolution // 4 + 1)[1:]
        middle = np.linspace(-self.half_angle, self.half_angle, resolution)[1:-1]
        angle = np.concatenate([np.full(len(cap), -self.half_angle), middle])
        angle = np.concatenate([angle, np.full(len(cap), self.half_angle)])
        ahead = tube * np.concatenate([np.sin(cap), np.zeros(len(middle)), -np.sin(cap[::-1])])
        radii = tube * np.concatenate([np.cos(cap), np.ones(len(middle)), np.cos(cap[::-1])])
        tangent = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        side = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=1)
        spine = self.centreline(angle) + ahead[:, None] * tangent
        circle = meshes.circle(resolution)
        rings = spine[:, None] + radii[:, None, None] * (
            circle[None, :, :1] * side[:, None] + circle[None, :, 1:2] * np.array([0.0, 0.0, 1.0])
        )
        ends = self.centreline(np.array([-self.half_angle, self.half_angle]))
        return meshes.tube(rings, ends[0] - tube * tangent[0], ends[1] + tube * tangent[-1])


Shape = Sphere | Cylinder | EllipticCylinder | Box | BentCapsule
"""What an object may look like, beside a mesh."""


def _rows(points: ArrayLike) -> tuple[Array, tuple[int, ...]]:
    array = np.asarray(points, dtype=float)
    return array.reshape(-1, 3), array.shape


def _polar(points: Array, fallback: Array) -> tuple[Array, Array]:
    """Distance from the origin (k,) and direction (k, d), `fallback` in the origin itself."""
    distance = np.linalg.norm(points, axis=1)
    safe = np.where(distance > 0, distance, 1.0)[:, None]
    return distance, np.where(distance[:, None] > 0, points / safe, fallback)


def _extruded(distance: Array, normal: Array, z: Array, height: float) -> tuple[Array, Array]:
    """Distance and normal of a prism from those of its cross-section: (k,), (k, 2) and z (k,)."""
    above = np.abs(z) - height / 2
    out = np.maximum(np.stack([distance, above], axis=1), 0.0)
    length = np.linalg.norm(out, axis=1)
    weights = np.where(
        length[:, None] > 0,
        out / np.where(length > 0, length, 1.0)[:, None],
        np.stack([distance >= above, distance < above], axis=1),
    )
    lid = weights[:, 1:] * np.where(z < 0, -1.0, 1.0)[:, None]
    total = np.where(length > 0, length, np.maximum(distance, above))
    return total, np.concatenate([weights[:, :1] * normal, lid], axis=1)


def _ellipse(points: Array, axes: Array) -> tuple[Array, Array]:
    """Signed distance (k,) and normal (k, 2) of an ellipse with semi-axes (2,).

    The nearest point of the first quadrant is (a^2 x / (t + a^2), b^2 y / (t + b^2)) with t the
    largest root of (a x / (t + a^2))^2 + (b y / (t + b^2))^2 = 1, found by bisection.
    """
    order = np.argsort(-axes)
    major, minor = axes[order]
    x, y = np.abs(points[:, order]).T

    def excess(t: Array) -> Array:
        below = np.maximum(t + minor**2, 1e-300)
        return (major * x / (t + major**2)) ** 2 + (minor * y / below) ** 2 - 1

    t = _bisect(excess, minor * y - minor**2, np.hypot(major * x, minor * y) - minor**2)
    foot_x = np.minimum(major**2 * x / np.maximum(t + major**2, 1e-300), major)
    gap = t + minor**2
    on_axis = gap < 1e-12 * minor**2
    foot_y = np.where(
        on_axis,
        minor * np.sqrt(np.maximum(1 - (foot_x / major) ** 2, 0.0)),
        minor**2 * y / np.where(on_axis, 1.0, gap),
    )
    _, normal = _polar(np.stack([foot_x / major**2, foot_y / minor**2], axis=1), np.array([1.0, 0]))
    distance = (x - foot_x) * normal[:, 0] + (y - foot_y) * normal[:, 1]
    signed = np.empty_like(normal)
    signed[:, order] = normal
    return distance, signed * np.where(points < 0, -1.0, 1.0)


def _bisect(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Where a falling function crosses zero, to rounding."""
    for _ in range(100):
        middle = 0.5 * (low + high)
        positive = function(middle) > 0
        low, high = np.where(positive, middle, low), np.where(positive, high, middle)
    return 0.5 * (low + high)
