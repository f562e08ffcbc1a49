"""Pairs of shapes as arrays, and their distances in numpy.

The compiled driver (``compile/runtime/clearance.c``) gives the same distances; numpy serves where
there is no compiler, and where few distances are wanted: gaps between things, nearest points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.scene import Item
from casadi_ik.collision.solids import Kind, Solid, along_rays, spread
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint
from casadi_ik.model.linkage import joint_positions


@dataclass(frozen=True, eq=False)
class Table:
    """What a distance kernel works on.

    Attributes:
        radii: (s,) radii of the robot's capsules [m].
        halves: (s,) half lengths of their segments [m].
        pairs: (p, 2) a capsule; another, or s + a solid.
        own: How many solids are the robot's own; they come first.
        offsets: (p,) how much farther than the scene's margin a pair has to be apart [m].
        solids: The solids.
        places: Pose (4, 4) of every other solid in its item's frame.
        items: Name of the item of every other solid.
        names: (p, 2) what each pair is called: links, or a link and an item.
        moving: Links that an arm may move while its palm stays.
        margins: (p,) what each pair has to be apart, beyond what its shapes may overlap [m].
    """

    radii: Array
    halves: Array
    pairs: NDArray[np.int32]
    offsets: Array
    own: int
    solids: tuple[Solid, ...]
    places: tuple[Array, ...]
    items: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    moving: frozenset[str] = frozenset()
    margins: Array = field(default_factory=lambda: np.zeros(0))
    _parted: dict[frozenset[str], tuple[Table, Table]] = field(
        default_factory=dict, init=False, repr=False
    )

    def poses(
        self, items: dict[str, Item], moved: str | None = None, to: Array | None = None
    ) -> Array:
        """(n, 12) rotation row by row and origin of every solid of a scene, or (k, n, 12).

        Args:
            items: Where things are, by name.
            moved: The item that is elsewhere in every row.
            to: (k, 4, 4) where it is.
        """
        found = [
            pose_row((to if name == moved and to is not None else items[name].pose) @ place)
            for place, name in zip(self.places, self.items, strict=True)
        ]
        return np.stack(np.broadcast_arrays(*found), axis=-2) if found else np.zeros((0, 12))

    @cached_property
    def for_driver(self) -> tuple[NDArray[np.void], Array]:
        """The solids (n, 7 of 8 bytes) and the planes (m, 4) as the driver has them."""
        form = [("kind", "<i8"), ("size", "<f8", 3), ("reach", "<f8"), ("first", "<i8")]
        rows = np.zeros(len(self.solids), dtype=np.dtype([*form, ("planes", "<i8")]))
        first = 0
        for i, solid in enumerate(self.solids):
            rows[i] = (solid.kind, solid.size, solid.reach, first, len(solid.planes))
            first += len(solid.planes)
        return rows, np.concatenate([np.zeros((0, 4)), *(one.planes for one in self.solids)])

    @cached_property
    def held(self) -> Table:
        """The pairs whose distances follow from the hand and where its palm is."""
        return self.only(~self._swinging)

    @cached_property
    def swung(self) -> Table:
        """The pairs whose distances depend on the arm that holds the palm."""
        return self.only(self._swinging)

    @cached_property
    def of_robot(self) -> Table:
        """The pairs of the robot with itself."""
        return self.only(self.within)

    @cached_property
    def of_scene(self) -> Table:
        """The pairs of the robot with what stands about it."""
        return self.only(~self.within)

    def parted(self, links: frozenset[str]) -> tuple[Table, Table]:
        """The pairs that one of some links is in, and all others; worked out once."""
        if links not in self._parted:
            within = np.array([not links.isdisjoint(pair) for pair in self.names], dtype=bool)
            self._parted[links] = self.only(within), self.only(~within)
        return self._parted[links]

    @property
    def _swinging(self) -> NDArray[np.bool_]:
        return np.array([not self.moving.isdisjoint(pair) for pair in self.names], dtype=bool)

    @property
    def within(self) -> NDArray[np.bool_]:
        """(p,) which pairs are of the robot with itself."""
        return self.pairs[:, 1] < len(self.radii) + self.own

    def only(self, rows: NDArray[np.bool_]) -> Table:
        """The same with some of the pairs."""
        names = tuple(name for name, kept in zip(self.names, rows.tolist(), strict=True) if kept)
        return replace(
            self,
            pairs=np.ascontiguousarray(self.pairs[rows]),
            offsets=self.offsets[rows],
            names=names,
            margins=self.margins[rows],
        )


def pose_row(pose: Array) -> Array:
    """(..., 12) rotation row by row, then the origin, of poses (..., 4, 4)."""
    turn = pose[..., :3, :3].reshape(*pose.shape[:-2], 9)
    return np.concatenate([turn, pose[..., :3, 3]], axis=-1)


def nearest(where: Array, poses: Array, table: Table) -> tuple[Array, Array]:
    """Distances of all pairs of a table.

    Args:
        where: (k, ...) where the robot's shapes are, as `collision.model.placed` gives it.
        poses: (k, n, 12) or (n, 12) of a scene's solids.
        table: The pairs.

    Returns:
        (k, p) distances [m], the pairs' offsets taken off; (k, p) where on the first segment it is
        nearest, -1 to 1 from its middle.
    """
    k, p, s = len(where), len(table.pairs), len(table.radii)
    segments = where[:, : 6 * s].reshape(k, s, 6)
    own = where[:, 6 * s : 6 * s + 12 * table.own].reshape(k, table.own, 12)
    places = np.concatenate([own, np.broadcast_to(poses, (k, *poses.shape[-2:]))], axis=1)
    one, other = table.pairs[:, 0], table.pairs[:, 1]
    distance, along = np.empty((k, p)), np.empty((k, p))
    robot = np.flatnonzero(other < s)
    distance[:, robot], along[:, robot] = between_segments(
        segments[:, one[robot]], segments[:, other[robot]]
    )
    distance[:, robot] -= table.radii[other[robot]]
    for number, solid in enumerate(table.solids):
        rows = np.flatnonzero(other == s + number)
        if len(rows):
            distance[:, rows], along[:, rows] = from_solid(
                solid, segments[:, one[rows]], places[:, number]
            )
    return distance - (table.radii[one] + table.offsets), along


def between_segments(a: Array, b: Array) -> tuple[Array, Array]:
    """Least distances (...) [m] of segments (..., 6), middles and halves; and where on the first.

    Source: C. Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    r, g, h = a[..., :3] - b[..., :3], a[..., 3:], b[..., 3:]
    tiny = 1e-30  # of squares [m^2]: a segment of no length is a point

    def dot(x: Array, y: Array) -> Array:
        return np.einsum("...i,...i->...", x, y)

    aa, bb, both, d, f = dot(g, g), dot(h, h), dot(g, h), dot(g, r), dot(h, r)
    t = np.clip((both * f - bb * d) / np.maximum(aa * bb - both * both, tiny), -1, 1)
    u = np.clip((both * t + f) / np.maximum(bb, tiny), -1, 1)
    t = np.clip((both * u - d) / np.maximum(aa, tiny), -1, 1)
    return np.linalg.norm(r + t[..., None] * g - u[..., None] * h, axis=-1), t


def from_solid(solid: Solid, segments: Array, pose: Array) -> tuple[Array, Array]:
    """Least distances (k, p) [m] of segments (k, p, 6) from a solid at poses (k, 12).

    Returns:
        The distances, and where on the segments they are, -1 to 1 from their middles.
    """
    rotation, origin = pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
    c = np.einsum("kji,kpj->kpi", rotation, segments[..., :3] - origin[:, None])
    h = np.einsum("kji,kpj->kpi", rotation, segments[..., 3:])
    if solid.kind is not Kind.CLOUD:
        return _least(lambda t: solid.distance(c + t[..., None] * h), np.linalg.norm(h, axis=-1))
    distance, along = np.empty(c.shape[:-1]), np.empty(c.shape[:-1])
    long = np.maximum((h * h).sum(axis=-1), 1e-30)
    for row, (middles, halves) in enumerate(zip(c, h, strict=True)):  # not convex: every point
        away = solid.points - middles[:, None]
        t = np.clip(np.einsum("pmi,pi->pm", away, halves) / long[row, :, None], -1, 1)
        apart = np.linalg.norm(away - t[..., None] * halves[:, None], axis=-1)
        distance[row] = apart.min(axis=1) - solid.size[0]
        along[row] = np.take_along_axis(t, apart.argmin(axis=1)[:, None], axis=1)[:, 0]
    return distance, along


def _least(distance: Callable[[Array], Array], half: Array) -> tuple[Array, Array]:
    """Lower bound of convex functions' least value between -1 and 1, and where: golden section.

    Args:
        distance: Values (...) at places (...).
        half: (...) how fast it may grow.
    """
    golden = (np.sqrt(5) - 1) / 2
    low, high = np.full(half.shape, -1.0), np.ones(half.shape)
    inner = low + (1 - golden) * 2, low + golden * 2
    left, right = map(distance, inner)
    for _ in range(46):
        falls = left > right
        low, high = np.where(falls, inner[0], low), np.where(falls, high, inner[1])
        width = high - low
        new = np.where(falls, low + golden * width, high - golden * width)
        value = distance(new)
        inner = np.where(falls, inner[1], new), np.where(falls, new, inner[0])
        left, right = np.where(falls, right, value), np.where(falls, value, left)
    middle = (low + high) / 2
    return distance(middle) - half * (high - low), middle


def gaps(item: Item, others: Sequence[Item], poses: Array) -> Array:
    """Distances (k,) [m] of a thing at poses (k, 4, 4) from others; negative: they overlap.

    Points of either's surface against the other: exact to a few millimetres.

    Args:
        item: What is moved.
        others: The rest.
        poses: Of the item, base frame.
    """
    least = np.full(len(poses), np.inf)
    placed = [(solid, other.pose @ place) for other in others for solid, place in other.parts]
    for (solid, part), (other, place) in product(item.parts, placed):
        points = surface_points(solid)[: 0 if other.kind is Kind.CLOUD else None]
        theirs = surface_points(other)
        for row, pose in enumerate(poses @ part):
            seen = np.linalg.inv(place) @ pose
            here = _points_from(points, seen, other) - _around(solid)
            there = _points_from(theirs, np.linalg.inv(seen), solid) - _around(other)
            least[row] = min(least[row], here, there)
    return least


def _around(solid: Solid) -> float:
    """How far a solid reaches beyond its `surface_points` [m]."""
    return float(solid.size[0]) if solid.kind is Kind.CLOUD else 0.0


def _points_from(points: Array, pose: Array, solid: Solid) -> float:
    """Least distance of points (m, 3), which are at a pose in the frame of a solid, from it."""
    if not len(points):
        return np.inf
    return float(solid.distance(points @ pose[:3, :3].T + pose[:3, 3]).min())


@lru_cache(maxsize=256)
def surface_points(solid: Solid, rays: int = 256, steps: int = 12) -> Array:
    """(k, 3) points of a solid's surface in its frame, along its edges too.

    Of a half-space, or of a body whose origin is not in it, none; of a cloud its points.

    Args:
        solid: The solid.
        rays: How many points all around.
        steps: Points along a sharp edge that is as long as the solid.
    """
    if solid.kind is Kind.CLOUD:
        return solid.points
    if not np.isfinite(solid.reach) or solid.distance(np.zeros(3)) >= 0:
        return np.zeros((0, 3))
    step = solid.reach / steps
    edges = [
        np.linspace(one, other, 2 + int(np.linalg.norm(other - one) / step))
        for one, other in zip(*_sharp_edges(*solid.mesh()), strict=True)
    ]
    return np.concatenate([along_rays(solid, spread(rays)), *edges])


def _sharp_edges(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """(e, 3) and (e, 3) the ends of edges at which a closed surface bends by more than 35 deg."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    faces = (order // 3).reshape(-1, 2)  # each edge is one of two triangles
    bent = (normals[faces[:, 0]] * normals[faces[:, 1]]).sum(axis=1) < np.cos(np.deg2rad(35.0))
    found = edges[order[::2][bent]]
    return points[found[:, 0]], points[found[:, 1]]


GRID = 1025
"""Positions of a motor between which the rate of a joint that follows it is taken."""


def levers(robot: RobotDescription, table: Table) -> Array:
    """How far a unit of each motor moves the shapes of each pair against each other at most.

    A distance changes by no more than points of one shape move seen from the other. Joints that
    carry both shapes move them as one and do not count.

    Args:
        robot: With shapes.
        table: The pairs.

    Returns:
        (p, n) [m per rad or m].
    """
    shapes = robot.shapes
    arms = [_arms(robot, one.link, _ends(one.center, one.half), 0.0) for one in shapes.capsules]
    for one, solid in zip(shapes.solids, table.solids, strict=False):
        arms.append(_arms(robot, one.link, one.pose[None, :3, 3], solid.reach))
    # What stands about the robot is moved by nothing.
    arms += [np.zeros(len(robot.movable))] * (len(table.solids) - table.own)
    one, other = np.array(arms)[table.pairs.T]
    return np.where((one > 0) & (other > 0), 0.0, one + other) @ _rates(robot)


def _ends(center: Array, half: Array) -> Array:
    return np.stack([center - half, center + half])


def _arms(robot: RobotDescription, link: str, points: Array, about: float) -> Array:
    """(m,) how far points of a link can be from the axes of the joints that carry it [m].

    Args:
        robot: The description.
        link: The link.
        points: (k, 3) in its frame.
        about: Radius of the balls about them [m].

    Returns:
        Never zero for a joint that carries the link; 1 for one that slides.
    """
    found, places = (
        np.zeros(len(robot.movable)),
        {id(one): i for i, one in enumerate(robot.movable)},
    )
    for joint in reversed(robot.chain(link)):
        if joint.type != "fixed":
            found[places[id(joint)]] = _arm(joint, points, about)
            # It may turn them any way.
            about += float(np.sqrt((points * points).sum(axis=1).max()))
            if joint.type == "prismatic":
                about += max(abs(joint.lower), abs(joint.upper))
            points = np.zeros((1, 3))
        points = points @ joint.placement[:3, :3].T + joint.placement[:3, 3]
    return found


def _arm(joint: Joint, points: Array, about: float) -> float:
    if joint.type == "prismatic":
        return 1.0
    along = points @ joint.axis
    off = np.sqrt(np.maximum((points * points).sum(axis=1) - along * along, 0.0))
    return max(float(off.max()) + about, np.finfo(float).tiny)


def _rates(robot: RobotDescription) -> Array:
    """(m, n) how fast each joint moves at most for a unit of the motor that it follows."""
    motors = {name: i for i, name in enumerate(robot.actuator_names)}
    swept = np.linspace(robot.lower, robot.upper, GRID)
    positions = joint_positions(robot.joints, dict(zip(motors, swept.T, strict=True)))
    joints = {joint.name: joint for joint in robot.movable}
    rates = np.zeros((len(joints), len(motors)))
    for row, joint in zip(rates, robot.movable, strict=True):
        motor = joint.name
        while motor not in motors and (coupling := joints[motor].coupling) is not None:
            motor = coupling.of
        steps = np.diff(swept[:, motors[motor]])
        row[motors[motor]] = np.abs(np.diff(positions[joint.name]) / steps).max()
    return rates
