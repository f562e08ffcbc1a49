"""Primitive shapes of objects: exact signed distance, outward normal and mesh."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.files.units import Size

Mesh = tuple[Array, NDArray[np.int64]]
"""Vertices (v, 3) [m] and triangles (t, 3) of vertex indices, outward by the right-hand rule."""


def circle(count: int) -> Array:
    """Return (count, 3) points of the unit circle in the plane z = 0, counter-clockwise."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def tube_mesh(rings: Array, first: Array, last: Array) -> Mesh:
    """Return a closed tube.

    Args:
        rings: (r, n, 3) rings of n points, counter-clockwise seen from the end.
        first: (3,) point that closes the start.
        last: (3,) point that closes the end.
    """
    count, size = rings.shape[:2]
    index = np.arange(size)
    next_index = (index + 1) % size
    faces = []
    for ring in range(count - 1):
        a, b = ring * size + index, ring * size + next_index
        c, d = a + size, b + size
        faces += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    start, end, top = count * size, count * size + 1, (count - 1) * size
    faces.append(np.stack([np.full(size, start), next_index, index], axis=1))
    faces.append(np.stack([np.full(size, end), top + index, top + next_index], axis=1))
    vertices = np.concatenate([rings.reshape(-1, 3), [first, last]])
    return vertices.astype(float), np.concatenate(faces).astype(np.int64)


def prism_mesh(ring: Array, height: float) -> Mesh:
    """Return a prism along z with a (n, 3) cross-section in the plane z = 0, counter-clockwise."""
    up = np.array([0.0, 0.0, height / 2])
    return tube_mesh(np.stack([ring - up, ring + up]), -up, up)


def box_mesh(half_size: Array, center: Array | float = 0.0) -> Mesh:
    """Return a box with half edges (3,) [m]."""
    x, y, z = half_size
    ring = np.array([[x, y, 0.0], [-x, y, 0.0], [-x, -y, 0.0], [x, -y, 0.0]])
    points, triangles = prism_mesh(ring, 2 * z)
    return points + center, triangles


def capsule_mesh(radius: float, half_length: float, resolution: int = 32) -> Mesh:
    """Return a capsule along z; a ball if the half length of its segment [m] is 0."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, resolution // 2 + 1)[1:-1]
    rings = circle(resolution)[None] * (radius * np.cos(angles))[:, None, None]
    shift = np.where(angles < 0, -half_length, half_length)
    rings[..., 2] = (radius * np.sin(angles) + shift)[:, None]
    if half_length > 0:  # the equator is repeated at the lower end of the segment
        lower_equator = rings[len(angles) // 2].copy()
        lower_equator[..., 2] = -half_length
        rings = np.insert(rings, len(angles) // 2, lower_equator, axis=0)
    end = np.array([0.0, 0.0, radius + half_length])
    return tube_mesh(rings, -end, end)


class BaseShape:
    """Base class of shapes: signed distance and normal from the nearest surface point."""

    __slots__ = ()

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        """Return signed distances (k,) and unit outward normals (k, 3) for points (k, 3)."""
        raise NotImplementedError(type(self).__name__)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return vertices (v, 3) [m] on the surface and triangles (t, 3), facing outward."""
        raise NotImplementedError(type(self).__name__)

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return distances to the surface [m], negative inside: (k,) for (k, 3), () for (3,)."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[0].reshape(array.shape[:-1])

    def normal(self, points: ArrayLike) -> Array:
        """Return unit outward normals at the nearest surface points, in the shape of the points."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[1].reshape(array.shape)


class Primitive(
    BaseShape,
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    tag_field="kind",
    kw_only=True,
):
    """A shape of an object file.

    Attributes:
        source: Tags of the sources of the numbers.
    """

    source: str

    def check(self) -> str:
        """Return the error of a combination of numbers, as "key: found, expected", or ""."""
        return ""


class Sphere(Primitive, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        diameter: Diameter [m].
    """

    diameter: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points, np.array([0.0, 0.0, 1.0]))
        return distance - self.diameter / 2, normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return rings of latitude."""
        return capsule_mesh(self.diameter / 2, 0.0, resolution)


class Cylinder(Primitive, frozen=True, tag="cylinder", kw_only=True):
    """A circular cylinder along z.

    Attributes:
        diameter: Diameter [m].
        height: Height [m].
    """

    diameter: Size
    height: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points[:, :2], np.array([1.0, 0.0]))
        return _extruded(distance - self.diameter / 2, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return a prism."""
        return prism_mesh(self.diameter / 2 * circle(resolution), self.height)


class EllipticCylinder(Primitive, frozen=True, tag="elliptic-cylinder", kw_only=True):
    """An elliptic cylinder along z.

    Attributes:
        width: Axis along x [m].
        depth: Axis along y [m].
        height: Height [m].
    """

    width: Size
    depth: Size
    height: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _ellipse(points[:, :2], np.array([self.width / 2, self.depth / 2]))
        return _extruded(distance, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return a prism."""
        axes = np.array([self.width / 2, self.depth / 2, 0.0])
        return prism_mesh(axes * circle(resolution), self.height)


class Box(Primitive, frozen=True, tag="box", kw_only=True):
    """A box with edges along x, y and z.

    Attributes:
        size: Edges along x, y and z [m].
    """

    size: tuple[Size, Size, Size]

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
        """Return twelve triangles; the resolution is ignored."""
        del resolution
        return box_mesh(np.asarray(self.size) / 2)


class BentCapsule(Primitive, frozen=True, tag="bent-capsule", kw_only=True):
    """A round tube along a circular arc with hemispherical ends, such as a banana.

    The arc lies in the plane z = 0. Its middle is at the origin, with tangent x, and it bends
    towards +y. The dimensions are those of a bounding box, as published lists state them.

    Attributes:
        diameter: Diameter of the tube [m].
        length: Straight distance between the ends, along x [m].
        width: Distance from the middle of the convex side to the ends, along y [m].
    """

    diameter: Size
    length: Size
    width: Size

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
        """Return the error of a combination of numbers, as "key: found, expected", or ""."""
        sagitta = self.width - self.diameter
        if not 0 < sagitta < (self.length - self.diameter) / 2:
            return (
                f"width: found {self.width:g}, expected between the diameter {self.diameter:g} "
                f"and (diameter + length) / 2 = {(self.diameter + self.length) / 2:g}"
            )
        return ""

    def centreline(self, angle: Array) -> Array:
        """Return points (k, 3) [m] of the arc at angles (k,) [rad] from its middle."""
        flat = np.zeros_like(angle)
        return self.radius * np.stack([np.sin(angle), 1 - np.cos(angle), flat], axis=-1)

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        angle = np.arctan2(points[:, 0], self.radius - points[:, 1])
        foot = self.centreline(np.clip(angle, -self.half_angle, self.half_angle))
        distance, normal = _polar(points - foot, np.array([0.0, 0.0, 1.0]))
        return distance - self.diameter / 2, normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return rings along the arc, which shrink at the ends."""
        tube = self.diameter / 2
        cap = np.linspace(-np.pi / 2, 0, resolution // 4 + 1)[1:]
        middle = np.linspace(-self.half_angle, self.half_angle, resolution)[1:-1]
        angle = np.concatenate([np.full(len(cap), -self.half_angle), middle])
        angle = np.concatenate([angle, np.full(len(cap), self.half_angle)])
        cap_shift = tube * np.concatenate([np.sin(cap), np.zeros(len(middle)), -np.sin(cap[::-1])])
        radii = tube * np.concatenate([np.cos(cap), np.ones(len(middle)), np.cos(cap[::-1])])
        tangent = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        side = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=1)
        spine = self.centreline(angle) + cap_shift[:, None] * tangent
        ring = circle(resolution)
        rings = spine[:, None] + radii[:, None, None] * (
            ring[None, :, :1] * side[:, None] + ring[None, :, 1:2] * np.array([0.0, 0.0, 1.0])
        )
        start, end = self.centreline(np.array([-self.half_angle, self.half_angle]))
        return tube_mesh(rings, start - tube * tangent[0], end + tube * tangent[-1])


Shape = Sphere | Cylinder | EllipticCylinder | Box | BentCapsule
"""Shapes of objects, except meshes."""


def _polar(points: Array, fallback: Array) -> tuple[Array, Array]:
    """Return distances from the origin (k,) and directions (k, d); `fallback` at the origin."""
    distance = np.linalg.norm(points, axis=1)
    safe = np.where(distance > 0, distance, 1.0)[:, None]
    return distance, np.where(distance[:, None] > 0, points / safe, fallback)


def _extruded(distance: Array, normal: Array, z: Array, height: float) -> tuple[Array, Array]:
    """Return the distances (k,) and normals (k, 3) of a prism from those of its cross-section.

    Args:
        distance: (k,) signed distances from the cross-section [m].
        normal: (k, 2) normals of the cross-section.
        z: (k,) coordinates along the prism [m].
        height: Height of the prism [m].
    """
    axial = np.abs(z) - height / 2
    outside = np.maximum(np.stack([distance, axial], axis=1), 0.0)
    length = np.linalg.norm(outside, axis=1)
    weights = np.where(
        length[:, None] > 0,
        outside / np.where(length > 0, length, 1.0)[:, None],
        np.stack([distance >= axial, distance < axial], axis=1),
    )
    normal_z = weights[:, 1:] * np.where(z < 0, -1.0, 1.0)[:, None]
    total = np.where(length > 0, length, np.maximum(distance, axial))
    return total, np.concatenate([weights[:, :1] * normal, normal_z], axis=1)


def _ellipse(points: Array, axes: Array) -> tuple[Array, Array]:
    """Return signed distances (k,) and normals (k, 2) of an ellipse with semi-axes (2,).

    The nearest point of the first quadrant is (a^2 x / (t + a^2), b^2 y / (t + b^2)) with t the
    largest root of (a x / (t + a^2))^2 + (b y / (t + b^2))^2 = 1, found by bisection.
    """
    order = np.argsort(-axes)
    major, minor = axes[order]
    x, y = np.abs(points[:, order]).T

    def excess(t: Array) -> Array:
        denominator = np.maximum(t + minor**2, 1e-300)
        return (major * x / (t + major**2)) ** 2 + (minor * y / denominator) ** 2 - 1

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
    """Return the roots of decreasing functions by bisection, up to rounding."""
    for _ in range(100):
        middle = 0.5 * (low + high)
        positive = function(middle) > 0
        low, high = np.where(positive, middle, low), np.where(positive, high, middle)
    return 0.5 * (low + high)
