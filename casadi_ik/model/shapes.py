"""Shapes of objects: exact signed distance, outward normal, a mesh; primitives and meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import DescriptionError, optional_import
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks.units import warn_of_large_mesh
from casadi_ik.files.limits import LIMITS, raise_hint, scaled_limit
from casadi_ik.files.units import Size
from casadi_ik.model.urdf_body import read_body

Mesh = tuple[Array, NDArray[np.int64]]
"""Vertices (v, 3) [m] and triangles (t, 3) of vertex indices, outward by the right-hand rule."""


def circle(count: int) -> Array:
    """(count, 3) points of the unit circle in the plane z = 0, counter-clockwise."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def tube_mesh(rings: Array, first: Array, last: Array) -> Mesh:
    """A closed tube.

    Args:
        rings: (r, n, 3) rings of n points, counter-clockwise seen from the end.
        first: (3,) the point that closes the start.
        last: (3,) the point that closes the end.
    """
    count, size = rings.shape[:2]
    here = np.arange(size)
    ahead = (here + 1) % size
    faces = []
    for ring in range(count - 1):
        a, b, c, d = (ring * size + here, ring * size + ahead, here, ahead)
        c, d = c + (ring + 1) * size, d + (ring + 1) * size
        faces += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    start, end, top = count * size, count * size + 1, (count - 1) * size
    faces.append(np.stack([np.full(size, start), ahead, here], axis=1))
    faces.append(np.stack([np.full(size, end), top + here, top + ahead], axis=1))
    vertices = np.concatenate([rings.reshape(-1, 3), [first, last]])
    return vertices.astype(float), np.concatenate(faces).astype(np.int64)


def prism_mesh(ring: Array, height: float) -> Mesh:
    """A prism along z over a (n, 3) ring in the plane z = 0, counter-clockwise, with two lids."""
    up = np.array([0.0, 0.0, height / 2])
    return tube_mesh(np.stack([ring - up, ring + up]), -up, up)


def box_mesh(half: Array, middle: Array | float = 0.0) -> Mesh:
    """A box by half its edges (3,) [m]."""
    x, y, z = half
    ring = np.array([[x, y, 0.0], [-x, y, 0.0], [-x, -y, 0.0], [x, -y, 0.0]])
    points, triangles = prism_mesh(ring, 2 * z)
    return points + middle, triangles


def capsule_mesh(radius: float, half: float, around: int = 32) -> Mesh:
    """A capsule along z, or a ball, by its radius and half its segment [m]."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1)[1:-1]
    rings = circle(around)[None] * (radius * np.cos(angles))[:, None, None]
    rings[..., 2] = (radius * np.sin(angles) + np.where(angles < 0, -half, half))[:, None]
    if half > 0:  # the equator twice, once at each end of the segment
        below = rings[len(angles) // 2].copy()
        below[..., 2] = -half
        rings = np.insert(rings, len(angles) // 2, below, axis=0)
    end = np.array([0.0, 0.0, radius + half])
    return tube_mesh(rings, -end, end)


class Body:
    """What a shape says of points, once it says what of it is nearest to them."""

    __slots__ = ()

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (k,) and unit outward normal (k, 3) for points (k, 3)."""
        raise NotImplementedError(type(self).__name__)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Vertices (v, 3) [m] on the surface and triangles (t, 3), outward by the right hand."""
        raise NotImplementedError(type(self).__name__)

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside: (k,) for (k, 3), () for (3,)."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[0].reshape(array.shape[:-1])

    def normal(self, points: ArrayLike) -> Array:
        """Unit outward normal at the nearest surface point, same shape as the points."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[1].reshape(array.shape)


class Primitive(
    Body, msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", kw_only=True
):
    """A shape of an object file.

    Attributes:
        source: Tags of the sources of its numbers.
    """

    source: str

    def check(self) -> str:
        """What is wrong with the numbers together, as "key: found, expected", or ""."""
        return ""


class Sphere(Primitive, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        diameter: [m].
    """

    diameter: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points, np.array([0.0, 0.0, 1.0]))
        return distance - self.diameter / 2, normal

    def mesh(self, resolution: int = 32) -> Mesh:
        """Rings of latitude."""
        return capsule_mesh(self.diameter / 2, 0.0, resolution)


class Cylinder(Primitive, frozen=True, tag="cylinder", kw_only=True):
    """A circular cylinder along z.

    Attributes:
        diameter: [m].
        height: [m].
    """

    diameter: Size
    height: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _polar(points[:, :2], np.array([1.0, 0.0]))
        return _extruded(distance - self.diameter / 2, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """A prism with two lids."""
        return prism_mesh(self.diameter / 2 * circle(resolution), self.height)


class EllipticCylinder(Primitive, frozen=True, tag="elliptic-cylinder", kw_only=True):
    """An elliptic cylinder along z.

    Attributes:
        width: Full axis along x [m].
        depth: Full axis along y [m].
        height: [m].
    """

    width: Size
    depth: Size
    height: Size

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = _ellipse(points[:, :2], np.array([self.width / 2, self.depth / 2]))
        return _extruded(distance, normal, points[:, 2], self.height)

    def mesh(self, resolution: int = 32) -> Mesh:
        """A prism with two lids."""
        axes = np.array([self.width / 2, self.depth / 2, 0.0])
        return prism_mesh(axes * circle(resolution), self.height)


class Box(Primitive, frozen=True, tag="box", kw_only=True):
    """A box with edges along x, y and z.

    Attributes:
        size: Along x, y and z [m].
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
        """Twelve triangles; the resolution does not matter."""
        del resolution
        return box_mesh(np.asarray(self.size) / 2)


class BentCapsule(Primitive, frozen=True, tag="bent-capsule", kw_only=True):
    """A round tube along a circular arc, with hemispheres on its ends: a banana.

    The arc lies in the plane z = 0, its middle in the origin with the tangent x; it bends towards
    +y. The numbers are those of a bounding box, as published lists give them.

    Attributes:
        diameter: Of the tube [m].
        length: Along x, from end to end in a straight line [m].
        width: Along y, from the convex side's middle to the tips [m].
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
        """What is wrong with the numbers together, as "key: found, expected", or ""."""
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
        ring = circle(resolution)
        rings = spine[:, None] + radii[:, None, None] * (
            ring[None, :, :1] * side[:, None] + ring[None, :, 1:2] * np.array([0.0, 0.0, 1.0])
        )
        ends = self.centreline(np.array([-self.half_angle, self.half_angle]))
        return tube_mesh(rings, ends[0] - tube * tangent[0], ends[1] + tube * tangent[-1])


Shape = Sphere | Cylinder | EllipticCylinder | Box | BentCapsule
"""What an object may look like, beside a mesh."""


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


@dataclass(frozen=True)
class MeshDistance:
    """How distances to meshes are found.

    Attributes:
        at_once: Pairs of a point and a triangle that are looked at together.
        rounded: How far a distance may be off that says only which triangles are near [m].
        beside: A triangle is inside another piece if what is so far before it is [m].
    """

    at_once: int = 2_000_000
    rounded: float = 1e-6
    beside: float = 1e-6


MESHES = MeshDistance()

RAYS = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]
"""(3, 3, 3) axes of whose third a ray goes."""


@dataclass(frozen=True, eq=False)
class MeshShape(Body):
    """A body bounded by triangles, in connected pieces.

    Attributes:
        pieces: Corners (v, 3) [m] and triangles (t, 3) of each.
        notes: Defects of the files, and how they were repaired.
    """

    pieces: tuple[Mesh, ...]
    notes: tuple[str, ...] = ()

    def mesh(self, resolution: int = 32) -> Mesh:
        """Its corners and triangles; the resolution does not matter."""
        del resolution
        starts = np.cumsum([0, *(len(points) for points, _ in self.pieces)])
        triangles = [faces + start for (_, faces), start in zip(self.pieces, starts, strict=False)]
        return np.concatenate([points for points, _ in self.pieces]), np.concatenate(triangles)

    @cached_property
    def _triangles(self) -> Array:
        """(t, 3, 3) corners of all triangles."""
        return np.concatenate([points[faces] for points, faces in self.pieces])

    @cached_property
    def _outside(self) -> Array:
        """(t, 3, 3) corners of the triangles that are not inside another, convex, piece."""
        kept = []
        for i, (points, faces) in enumerate(self.pieces):
            corners = points[faces]
            before = corners.mean(axis=1) + MESHES.beside * _normals(corners)
            hidden = np.zeros(len(corners), dtype=bool)
            for j, (others, planes) in enumerate(self.pieces):
                if i != j:
                    hidden |= _in_convex(others[planes], before)
            kept.append(corners[~hidden])
        found = np.concatenate(kept)
        return found if len(found) else self._triangles

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        size = max(1, MESHES.at_once // len(self._triangles))
        for start in range(0, len(points), size):
            some = slice(start, start + size)
            away, face = _to_triangles(points[some], self._outside)
            length = np.linalg.norm(away, axis=1)
            sign = np.where(_inside(points[some], self._triangles), -1.0, 1.0)
            far = length > 1e-9
            distance[some] = sign * length
            unit = away / np.where(far, length, 1.0)[:, None]
            normal[some] = np.where(far[:, None], sign[:, None] * unit, face)
        return distance, normal


def load_mesh_shape(files: Sequence[Path], scale: float, location: str) -> MeshShape:
    """The body that meshes make together.

    Args:
        files: Of meshes; what hangs together in a file is a piece.
        scale: By what factor it is larger than they say.
        location: File and key that name them, for messages.

    Raises:
        DescriptionError: A file is missing, no mesh, or has too many pieces.
    """
    pieces, notes = list[Mesh](), list[str]()
    for file in files:
        points, triangles = read_body(file, location)
        points = scale * points
        warn_of_large_mesh(
            points, location if str(file) in location else f"{location}: {file.name}"
        )
        points, single = single_sided(points, triangles)
        if len(single) < len(triangles):
            notes.append(f"{len(triangles) - len(single):,} triangles were there twice: used once")
        pieces += pieces_of(points, single)
    if len(pieces) > scaled_limit(LIMITS.object_pieces):
        hint = raise_hint(len(pieces), LIMITS.object_pieces)
        most = f"at most {scaled_limit(LIMITS.object_pieces)} {hint}"
        raise DescriptionError(f"{location}: found {len(pieces)} pieces, expected {most}")
    return MeshShape(tuple(pieces), tuple(notes))


MOSTLY_DOUBLE = 0.5
"""A mesh is double-sided if more than this share of its triangles have another on the same corners.

Bodies that touch share few: two cubes side by side 4 of 24.
"""


def single_sided(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return a double-sided mesh with every triangle once, facing outward; another as it is.

    Exporters write both sides of every triangle where a viewer is to draw the inside, too.

    Args:
        points: (v, 3) corners [m].
        triangles: (t, 3) triangles.
    """
    _, numbers = np.unique(points, axis=0, return_inverse=True)
    merged = numbers.reshape(-1)[triangles]
    _, first, copies = np.unique(
        np.sort(merged, axis=1), axis=0, return_index=True, return_counts=True
    )
    if copies[copies > 1].sum() <= MOSTLY_DOUBLE * len(triangles):
        return points, triangles
    first = np.sort(first)
    return points, _oriented(points, triangles[first], merged[first])


def _oriented(
    points: Array, triangles: NDArray[np.int64], merged: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return triangles turned so that neighbours agree and each component faces outward.

    Args:
        points: (v, 3) corners [m].
        triangles: (t, 3) triangles.
        merged: (t, 3) the same, corners at the same place being one.
    """
    with optional_import("meshes"):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

    t = len(triangles)
    starts, ends = merged[:, [0, 1, 2]].T.ravel(), merged[:, [1, 2, 0]].T.ravel()
    keys = np.stack([np.minimum(starts, ends), np.maximum(starts, ends)], axis=1)
    _, edges, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    edges = edges.reshape(-1)
    order = np.argsort(edges, kind="stable")
    pairs = order[counts[edges[order]] == 2].reshape(-1, 2)
    # Neighbours agree if they run along their common edge in opposite directions.
    agree = (starts[pairs[:, 0]] < ends[pairs[:, 0]]) != (starts[pairs[:, 1]] < ends[pairs[:, 1]])
    one, other = (pairs % t).T
    # Each triangle is two nodes, as it is and turned; edges connect the nodes that agree.
    across = np.where(agree, 0, t)
    rows = np.concatenate([one, one + t])
    columns = np.concatenate([other + across, other + t - across])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * t, 2 * t))
    sides = connected_components(graph, directed=False)[1][:t]
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(t, t))
    count, labels = connected_components(graph, directed=False)
    roots = np.unique(labels, return_index=True)[1]
    turned = sides != sides[roots[labels]]
    corners = points[triangles]
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    inward = np.bincount(labels, np.where(turned, -volumes, volumes), count) < 0
    return np.where((turned ^ inward[labels])[:, None], triangles[:, ::-1], triangles)


def pieces_of(points: Array, triangles: NDArray[np.int64]) -> list[Mesh]:
    """What of a mesh hangs together at edges.

    Where a file has every triangle by itself (STL), corners are those at the same place. Where
    bodies touch there, those triangles of an edge belong together that come after one another.
    """
    edges, counts = _edges(triangles)
    if (counts < 2).any():
        points, numbers = np.unique(points, axis=0, return_inverse=True)
        triangles = numbers.reshape(-1)[triangles]
        edges, counts = _edges(triangles)
    of_triangle = np.arange(len(edges)) % len(triangles)
    order = np.lexsort((of_triangle, edges))
    of_two = of_triangle[order[counts[edges[order]] % 2 == 0]].reshape(-1, 2)
    with optional_import("meshes"):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

    meeting = coo_array((np.ones(len(of_two)), of_two.T), shape=(len(triangles),) * 2)
    _, labels = connected_components(meeting, directed=False)
    order = np.argsort(labels, kind="stable")
    pieces: list[Mesh] = []
    for members in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        kept, numbers = np.unique(triangles[members], return_inverse=True)
        pieces.append((points[kept], numbers.reshape(-1, 3).astype(np.int64)))
    return pieces


def _edges(triangles: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Number of each of the edges (3 t), all first ones first, and how many triangles have it."""
    ends = np.sort(np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    _, numbers, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return numbers.reshape(-1), counts


def _normals(corners: Array) -> Array:
    """(t, 3) unit normals of triangles (t, 3, 3), zero of those without area."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.where(length > 0, length, 1.0)


def _in_convex(corners: Array, points: Array) -> Bools:
    """(k,) whether points are behind the planes of all triangles."""
    ways = _normals(corners)
    offsets = np.sum(ways * corners[:, 0], axis=1)
    found = np.zeros(len(points), dtype=bool)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    size = max(1, MESHES.at_once // len(corners))
    for start in range(0, len(near), size):
        some = near[start : start + size]
        found[some] = (points[some] @ ways.T < offsets).all(axis=1)
    return found


def _inside(points: Array, corners: Array) -> Bools:
    """(k,) whether points are enclosed by triangles (t, 3, 3).

    Along a ray, triangles that face it and those that face away are counted against each other; of
    three rays in odd directions two decide, so that a small hole does no harm.
    """
    votes = np.zeros(len(points), dtype=int)
    for turn in RAYS:
        flat, rays = corners @ turn, points @ turn
        low, high = flat[:, :, :2].min(axis=1), flat[:, :, :2].max(axis=1)
        crossed = np.ones((len(points), len(corners)), dtype=bool)
        for axis in range(2):
            place = rays[:, axis, None]
            crossed &= (place > low[:, axis]) & (place < high[:, axis])
        here, one = np.nonzero(crossed)
        sides = flat[one, :, :2] - rays[here, None, :2]
        x, y = sides[..., 0], sides[..., 1]
        areas = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - y[:, [1, 2, 0]] * x[:, [2, 0, 1]]
        through = (areas > 0).all(axis=1) | (areas < 0).all(axis=1)
        whole = areas.sum(axis=1)
        height = (areas * flat[one, :, 2]).sum(axis=1) / np.where(through, whole, 1.0)
        ahead = through & (height > rays[here, 2])
        count = np.bincount(here[ahead], np.sign(whole[ahead]), len(points))
        votes += np.abs(count) > 0.5
    return votes >= 2


def _to_triangles(points: Array, corners: Array) -> tuple[Array, Array]:
    """From the nearest point of triangles (t, 3, 3) to points: (k, 3), and its unit normal."""
    middles = corners.mean(axis=1)
    radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    squares = (points**2).sum(axis=1)[:, None] + (middles**2).sum(axis=1)
    to_middle = np.sqrt(np.maximum(squares - 2 * points @ middles.T, 0.0))
    away, face = np.empty((len(points), 3)), np.empty((len(points), 3))
    with optional_import("meshes"):
        from trimesh.triangles import closest_point

    for i, point in enumerate(points):
        near = np.flatnonzero(to_middle[i] - radii <= to_middle[i].min() + MESHES.rounded)
        off = point - closest_point(corners[near], np.tile(point, (len(near), 1)))
        best = int(np.argmin(np.einsum("ti,ti->t", off, off)))
        away[i] = off[best]
        face[i] = _normals(corners[near[best : best + 1]])[0]
    return away, face
