"""Collision pairs as arrays, and their distances in numpy.

The compiled driver (``compile/runtime/clearance.c``) computes the same distances. The numpy version
is used without a compiler, and for few distances such as closest points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.scene import Obstacle
from casadi_ik.collision.solids import Kind, Solid, ray_points, sphere_directions
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint, joint_positions


@dataclass(frozen=True, eq=False)
class PairTable:
    """The collision pairs of a robot and a scene.

    Attributes:
        radii: (s,) radii of the robot's capsules [m].
        half_lengths: (s,) half lengths of the segments of the capsules [m].
        pairs: (p, 2) index of a capsule; index of a second one, or s + index of a solid.
        n_robot_solids: Number of solids of the robot, which precede those of the scene.
        offsets: (p,) distance that each pair must keep in addition to the scene's margin [m].
        solids: The solids.
        placements: (4, 4) pose of each solid of the scene, in the frame of its obstacle.
        items: Name of the obstacle of each solid of the scene.
        names: (p, 2) names of each pair: links, or a link and an obstacle.
        moving: Links that an arm may move while its palm is fixed.
        margins: (p,) margin of each pair, beyond the overlap that it is allowed [m].
    """

    radii: Array
    half_lengths: Array
    pairs: NDArray[np.int32]
    offsets: Array
    n_robot_solids: int
    solids: tuple[Solid, ...]
    placements: tuple[Array, ...]
    items: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    moving: frozenset[str] = frozenset()
    margins: Array = field(default_factory=lambda: np.zeros(0))
    _split: dict[frozenset[str], tuple[PairTable, PairTable]] = field(
        default_factory=dict, init=False, repr=False
    )

    def poses(
        self,
        items: dict[str, Obstacle],
        varied_item: str | None = None,
        varied_poses: Array | None = None,
    ) -> Array:
        """Return the poses of the scene's solids as rows of rotation (row-major) and origin.

        Args:
            items: Obstacles of the scene by name.
            varied_item: Name of an obstacle with another pose in each row.
            varied_poses: (k, 4, 4) poses of that obstacle.

        Returns:
            (n, 12), or (k, n, 12) with varied poses.
        """
        item_poses = {name: obstacle.pose for name, obstacle in items.items()}
        if varied_item is not None and varied_poses is not None:
            item_poses[varied_item] = varied_poses
        rows = [
            pose_row(item_poses[name] @ placement)
            for placement, name in zip(self.placements, self.items, strict=True)
        ]
        return np.stack(np.broadcast_arrays(*rows), axis=-2) if rows else np.zeros((0, 12))

    @cached_property
    def driver_arrays(self) -> tuple[NDArray[np.void], Array]:
        """Structs of the solids (n,) and rows of planes or points (m, 4) for the driver."""
        fields = [("kind", "<i8"), ("size", "<f8", 3), ("reach", "<f8"), ("first", "<i8")]
        rows = np.zeros(len(self.solids), dtype=np.dtype([*fields, ("planes", "<i8")]))
        first = 0
        for i, solid in enumerate(self.solids):
            rows[i] = (solid.kind, solid.size, solid.reach, first, len(solid.planes))
            first += len(solid.planes)
        return rows, np.concatenate([np.zeros((0, 4)), *(solid.planes for solid in self.solids)])

    @cached_property
    def hand_pairs(self) -> PairTable:
        """Pairs whose distances follow from the hand and its palm pose."""
        return self.select(~self._is_arm_pair)

    @cached_property
    def arm_pairs(self) -> PairTable:
        """Pairs whose distances depend on the arm."""
        return self.select(self._is_arm_pair)

    @cached_property
    def self_pairs(self) -> PairTable:
        """Pairs of the robot with itself."""
        return self.select(self.is_self_pair)

    @cached_property
    def scene_pairs(self) -> PairTable:
        """Pairs of the robot with the scene."""
        return self.select(~self.is_self_pair)

    def split_by_links(self, links: frozenset[str]) -> tuple[PairTable, PairTable]:
        """Return the pairs that involve one of the links, and all others; cached."""
        if links not in self._split:
            involves = np.array([not links.isdisjoint(pair) for pair in self.names], dtype=bool)
            self._split[links] = self.select(involves), self.select(~involves)
        return self._split[links]

    @property
    def _is_arm_pair(self) -> NDArray[np.bool_]:
        return np.array([not self.moving.isdisjoint(pair) for pair in self.names], dtype=bool)

    @property
    def is_self_pair(self) -> NDArray[np.bool_]:
        """True for the pairs of the robot with itself, (p,)."""
        return self.pairs[:, 1] < len(self.radii) + self.n_robot_solids

    def select(self, rows: NDArray[np.bool_]) -> PairTable:
        """Return the table with a selection (p,) of its pairs."""
        selected = zip(self.names, rows.tolist(), strict=True)
        names = tuple(name for name, is_selected in selected if is_selected)
        return replace(
            self,
            pairs=np.ascontiguousarray(self.pairs[rows]),
            offsets=self.offsets[rows],
            names=names,
            margins=self.margins[rows],
        )


def pose_row(pose: Array) -> Array:
    """Return poses (..., 4, 4) as rows (..., 12) of rotation (row-major) and origin."""
    rotation = pose[..., :3, :3].reshape(*pose.shape[:-2], 9)
    return np.concatenate([rotation, pose[..., :3, 3]], axis=-1)


def pair_distances(shapes: Array, poses: Array, table: PairTable) -> tuple[Array, Array]:
    """Compute the distances of all pairs of a table.

    Args:
        shapes: (k, ...) poses of the robot's shapes, from `collision.model.shape_poses`.
        poses: (k, n, 12) or (n, 12) poses of the scene's solids.
        table: The pairs.

    Returns:
        (k, p) distances [m] minus the offsets of the pairs; (k, p) positions of the closest points
        on the segment of the first shape, -1 to 1 from its center.
    """
    k, p, s = len(shapes), len(table.pairs), len(table.radii)
    segments = shapes[:, : 6 * s].reshape(k, s, 6)
    m = table.n_robot_solids
    robot_solid_poses = shapes[:, 6 * s : 6 * s + 12 * m].reshape(k, m, 12)
    scene_solid_poses = np.broadcast_to(poses, (k, *poses.shape[-2:]))
    solid_poses = np.concatenate([robot_solid_poses, scene_solid_poses], axis=1)
    first, second = table.pairs[:, 0], table.pairs[:, 1]
    distance, position = np.empty((k, p)), np.empty((k, p))
    capsules = np.flatnonzero(second < s)
    distance[:, capsules], position[:, capsules] = between_segments(
        segments[:, first[capsules]], segments[:, second[capsules]]
    )
    distance[:, capsules] -= table.radii[second[capsules]]
    for number, solid in enumerate(table.solids):
        rows = np.flatnonzero(second == s + number)
        if len(rows):
            distance[:, rows], position[:, rows] = from_solid(
                solid, segments[:, first[rows]], solid_poses[:, number]
            )
    return distance - (table.radii[first] + table.offsets), position


def between_segments(a: Array, b: Array) -> tuple[Array, Array]:
    """Compute the distances of segments, given by centers and half-axes (..., 6).

    Returns:
        (...) distances [m], and positions of the closest points on the first segments, -1 to 1.
    Source: C. Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    r, g, h = a[..., :3] - b[..., :3], a[..., 3:], b[..., 3:]
    tiny = 1e-30  # [m^2] or [m^4]; avoids division by zero for segments of zero length

    def dot(x: Array, y: Array) -> Array:
        return np.einsum("...i,...i->...", x, y)

    aa, bb, gh, d, f = dot(g, g), dot(h, h), dot(g, h), dot(g, r), dot(h, r)
    t = np.clip((gh * f - bb * d) / np.maximum(aa * bb - gh * gh, tiny), -1, 1)
    u = np.clip((gh * t + f) / np.maximum(bb, tiny), -1, 1)
    t = np.clip((gh * u - d) / np.maximum(aa, tiny), -1, 1)
    return np.linalg.norm(r + t[..., None] * g - u[..., None] * h, axis=-1), t


def from_solid(solid: Solid, segments: Array, pose: Array) -> tuple[Array, Array]:
    """Compute the distances (k, p) [m] of segments (k, p, 6) from a solid at poses (k, 12).

    Returns:
        (k, p) distances, and positions of the closest points on the segments, -1 to 1.
    """
    rotation, origin = pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
    c = np.einsum("kji,kpj->kpi", rotation, segments[..., :3] - origin[:, None])
    h = np.einsum("kji,kpj->kpi", rotation, segments[..., 3:])
    if solid.kind is not Kind.CLOUD:
        half_length = np.linalg.norm(h, axis=-1)
        return _min_convex(lambda t: solid.distance(c + t[..., None] * h), half_length)
    distance, position = np.empty(c.shape[:-1]), np.empty(c.shape[:-1])
    squared_length = np.maximum((h * h).sum(axis=-1), 1e-30)
    # A cloud is not convex: every point is compared.
    for row, (centers, half_axes) in enumerate(zip(c, h, strict=True)):
        offset = solid.points - centers[:, None]
        t = np.einsum("pmi,pi->pm", offset, half_axes) / squared_length[row, :, None]
        t = np.clip(t, -1, 1)
        distances = np.linalg.norm(offset - t[..., None] * half_axes[:, None], axis=-1)
        distance[row] = distances.min(axis=1) - solid.size[0]
        position[row] = np.take_along_axis(t, distances.argmin(axis=1)[:, None], axis=1)[:, 0]
    return distance, position


def _min_convex(distance: Callable[[Array], Array], slope: Array) -> tuple[Array, Array]:
    """Minimize convex functions between -1 and 1 by golden section search.

    Args:
        distance: Function from positions (...) to values (...).
        slope: (...) upper bounds of the slopes.

    Returns:
        (...) lower bounds of the minima, and their positions.
    """
    golden = (np.sqrt(5) - 1) / 2
    low, high = np.full(slope.shape, -1.0), np.ones(slope.shape)
    inner = low + (1 - golden) * 2, low + golden * 2
    lower_value, upper_value = map(distance, inner)
    for _ in range(46):
        falls = lower_value > upper_value
        low, high = np.where(falls, inner[0], low), np.where(falls, high, inner[1])
        width = high - low
        new = np.where(falls, low + golden * width, high - golden * width)
        value = distance(new)
        inner = np.where(falls, inner[1], new), np.where(falls, new, inner[0])
        lower_value, upper_value = (
            np.where(falls, upper_value, value),
            np.where(falls, value, lower_value),
        )
    middle = (low + high) / 2
    return distance(middle) - slope * (high - low), middle


def gaps(item: Obstacle, obstacles: Sequence[Obstacle], poses: Array) -> Array:
    """Compute the distances (k,) [m] of an object at poses (k, 4, 4) from obstacles.

    Surface points of each solid are checked against the other solid, which is accurate to a few
    millimetres. A negative distance means overlap.

    Args:
        item: The object.
        obstacles: Obstacles at fixed poses.
        poses: (k, 4, 4) poses of the object in the base frame.
    """
    distances = np.full(len(poses), np.inf)
    fixed_parts = [
        (solid, obstacle.pose @ pose) for obstacle in obstacles for solid, pose in obstacle.parts
    ]
    for (solid, placement), (fixed_solid, fixed_pose) in product(item.parts, fixed_parts):
        points = surface_points(solid)[: 0 if fixed_solid.kind is Kind.CLOUD else None]
        fixed_points = surface_points(fixed_solid)
        for row, pose in enumerate(poses @ placement):
            relative = np.linalg.inv(fixed_pose) @ pose
            forward = _min_point_distance(points, relative, fixed_solid) - _ball_radius(solid)
            backward = _min_point_distance(fixed_points, np.linalg.inv(relative), solid)
            backward -= _ball_radius(fixed_solid)
            distances[row] = min(distances[row], forward, backward)
    return distances


def _ball_radius(solid: Solid) -> float:
    """Return the radius of the balls around the `surface_points` of a solid [m]."""
    return float(solid.size[0]) if solid.kind is Kind.CLOUD else 0.0


def _min_point_distance(points: Array, pose: Array, solid: Solid) -> float:
    """Return the smallest distance of points (m, 3) at a pose in the frame of a solid from it."""
    if not len(points):
        return np.inf
    return float(solid.distance(points @ pose[:3, :3].T + pose[:3, 3]).min())


@lru_cache(maxsize=256)
def surface_points(solid: Solid, rays: int = 256, steps: int = 12) -> Array:
    """Return points (k, 3) on the surface of a solid in its frame, also along its edges.

    A half-space and a solid that does not contain its origin have no points. The points of a cloud
    are returned unchanged.

    Args:
        solid: The solid.
        rays: Number of points over all directions.
        steps: Number of points along a sharp edge as long as the solid's reach.
    """
    if solid.kind is Kind.CLOUD:
        return solid.points
    if not np.isfinite(solid.reach) or solid.distance(np.zeros(3)) >= 0:
        return np.zeros((0, 3))
    step = solid.reach / steps
    edges = [
        np.linspace(start, end, 2 + int(np.linalg.norm(end - start) / step))
        for start, end in zip(*_sharp_edges(*solid.mesh()), strict=True)
    ]
    return np.concatenate([ray_points(solid, sphere_directions(rays)), *edges])


def _sharp_edges(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the ends (e, 3), (e, 3) of edges at which a closed surface bends by over 35 deg."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    faces = (order // 3).reshape(-1, 2)  # each edge belongs to two triangles
    cosine = (normals[faces[:, 0]] * normals[faces[:, 1]]).sum(axis=1)
    sharp = edges[order[::2][cosine < np.cos(np.deg2rad(35.0))]]
    return points[sharp[:, 0]], points[sharp[:, 1]]


COUPLING_SAMPLES = 1025
"""Number of motor positions at which the rate of a coupled joint is computed."""


def levers(robot: RobotDescription, table: PairTable) -> Array:
    """Return upper bounds of the rates at which the motors change the distances of the pairs.

    A distance changes at most as much as points of one shape move relative to the other. Joints
    that carry both shapes move them together and do not count.

    Args:
        robot: A robot with collision shapes.
        table: The pairs.

    Returns:
        (p, n) [m per rad or m].
    """
    shapes = robot.shapes
    lever_arms = [
        _lever_arms(robot, capsule.link, _segment_ends(capsule.center, capsule.half_axis), 0.0)
        for capsule in shapes.capsules
    ]
    for shape, solid in zip(shapes.solids, table.solids, strict=False):
        lever_arms.append(_lever_arms(robot, shape.link, shape.pose[None, :3, 3], solid.reach))
    # Motors do not move the solids of the scene.
    lever_arms += [np.zeros(len(robot.movable))] * (len(table.solids) - table.n_robot_solids)
    first, second = np.array(lever_arms)[table.pairs.T]
    moves_both = (first > 0) & (second > 0)
    return np.where(moves_both, 0.0, first + second) @ _max_joint_rates(robot)


def _segment_ends(center: Array, half_axis: Array) -> Array:
    return np.stack([center - half_axis, center + half_axis])


def _lever_arms(robot: RobotDescription, link: str, points: Array, radius: float) -> Array:
    """Return the largest distances of points of a link from the joints that carry it.

    Args:
        robot: Description of the robot.
        link: Name of the link.
        points: (k, 3) points in the frame of the link.
        radius: Radius of the balls around the points [m].

    Returns:
        (m,) distances from the axes of the movable joints [m]; 1 for a prismatic joint; 0 only for
        joints that do not carry the link.
    """
    lever_arms = np.zeros(len(robot.movable))
    rows = {id(joint): i for i, joint in enumerate(robot.movable)}
    for joint in reversed(robot.chain(link)):
        if joint.type != "fixed":
            lever_arms[rows[id(joint)]] = _lever_arm(joint, points, radius)
            # The joint may rotate the points into any direction.
            radius += float(np.sqrt((points * points).sum(axis=1).max()))
            if joint.type == "prismatic":
                radius += max(abs(joint.lower), abs(joint.upper))
            points = np.zeros((1, 3))
        points = points @ joint.placement[:3, :3].T + joint.placement[:3, 3]
    return lever_arms


def _lever_arm(joint: Joint, points: Array, radius: float) -> float:
    if joint.type == "prismatic":
        return 1.0
    axial = points @ joint.axis
    radial = np.sqrt(np.maximum((points * points).sum(axis=1) - axial * axial, 0.0))
    return max(float(radial.max()) + radius, np.finfo(float).tiny)


def _max_joint_rates(robot: RobotDescription) -> Array:
    """Return the largest rates (m, n) of each joint per unit of its motor."""
    motors = {name: i for i, name in enumerate(robot.actuator_names)}
    motor_positions = np.linspace(robot.lower, robot.upper, COUPLING_SAMPLES)
    positions = joint_positions(robot.joints, dict(zip(motors, motor_positions.T, strict=True)))
    joints = {joint.name: joint for joint in robot.movable}
    rates = np.zeros((len(joints), len(motors)))
    for row, joint in zip(rates, robot.movable, strict=True):
        motor = joint.name
        while motor not in motors and (coupling := joints[motor].coupling) is not None:
            motor = coupling.of
        steps = np.diff(motor_positions[:, motors[motor]])
        row[motors[motor]] = np.abs(np.diff(positions[joint.name]) / steps).max()
    return rates
