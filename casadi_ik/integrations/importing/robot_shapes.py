"""Collision shapes of a robot from the files of its parts, and the pairs that may overlap.

Shapes are larger than the meshes that they enclose. Pairs of links whose shapes overlap although
their meshes do not are found by random sampling of configurations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import between_segments
from casadi_ik.errors import optional_import
from casadi_ik.files.arrays import Array, Rows
from casadi_ik.files.progress import progress
from casadi_ik.integrations.importing.capsules import SHAPE_FIT, fit_links
from casadi_ik.integrations.importing.meshes import IndexedMesh, link_meshes
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import joint_positions, joints_below, link_poses, rigid_bodies
from casadi_ik.model.link_shapes import Touching, capsules_of
from casadi_ik.model.parts import HAND_PREFIX, RobotPart
from casadi_ik.model.pose import inverse
from casadi_ik.model.schema import ShapeEntry
from casadi_ik.model.xml_tree import RobotTree

with optional_import("shapes of imported links"):
    from scipy.spatial import ConvexHull, QhullError

Boxes = tuple[Array, Array]
"""Centres and half edges (3, n) of axis-aligned boxes."""

MAX_PAIRS = 4096
"""Maximum number of pairs of boxes in one array operation; more do not fit into a core's cache."""

MAX_HULL_STEPS = 30
"""Maximum number of steps towards the nearest points of two convex hulls."""

MIN_GAP = 1e-9
"""Gap above which two convex hulls are regarded as separate, for rounding errors [m]."""


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """Return the links of the hand's file: those that the mount carries; none without a mount."""
    mounted = {joint.child for joint in robot.joints if joint.part == "mount"}
    descendants = {joint.child for link in mounted for joint in joints_below(robot, link)}
    return frozenset(mounted | descendants)


@dataclass(frozen=True)
class OverlapSampling:
    """Parameters of the test whether two links may overlap.

    Attributes:
        samples: Number of random configurations, seed 0.
        min_overlaps: Number of configurations with overlapping shapes below which a pair is not
            tested.
        tested: Maximum number of configurations with overlapping shapes in which meshes are tested.
        first: Number of these configurations that are tested before all others.
        nested: Fraction of the configurations above which intersecting meshes are regarded as built
            into each other.
        min_free_fraction: Minimum fraction of the configurations without intersection that an
            allowed overlap has to accept.
        depth_fraction: Fraction of the overlap at which meshes intersect that shapes may have.
        max_triangles: Number of triangles up to which a mesh is tested unchanged.
        cells: Cells of the grid to which a finer mesh is simplified, along its longest edge.
    """

    samples: int = 2000
    min_overlaps: int = 100
    tested: int = 300
    first: int = 10
    nested: float = 0.5
    min_free_fraction: float = 0.5
    depth_fraction: float = 0.9
    max_triangles: int = 3000
    cells: int = 48


OVERLAP_SAMPLING = OverlapSampling()

SPHERE_MARGIN = 1e-9
"""Distance up to which separate bounding spheres count as overlapping, for rounding errors [m]."""


def allowed_overlaps(
    part: RobotPart | RobotDescription,
    shapes: Mapping[str, Sequence[ShapeEntry]],
    meshes: Mapping[str, IndexedMesh],
    report: Callable[[int], object] | None = None,
) -> list[Touching]:
    """Return the pairs of links whose shapes may overlap, each with the reason.

    Args:
        part: An arm, a hand or a robot.
        shapes: Shapes by link.
        meshes: Meshes by link, which the shapes enclose.
        report: Function called with the number of links whose pairs have been tested since.
    """
    poses = _random_poses(part, np.random.default_rng(0))
    bodies, neighbours = rigid_bodies(part)
    capsules = {link: _posed_capsules(entries, poses[link]) for link, entries in shapes.items()}

    @cache
    def tree(link: str) -> CollisionTree:
        mesh = meshes[link].simplified(OVERLAP_SAMPLING.max_triangles, OVERLAP_SAMPLING.cells)
        return CollisionTree(mesh.points[mesh.triangles])

    touching: list[Touching] = []
    links = list(shapes)
    for i, link in enumerate(links):
        for other_link in links[i + 1 :]:
            if bodies[link] == bodies[other_link]:
                continue
            if frozenset((bodies[link], bodies[other_link])) in neighbours:
                continue
            clearance = _clearances(capsules[link], capsules[other_link])
            pair: MeshPair | None = None
            # Only the points of a mesh are known if it has too many triangles.
            if all(name in meshes and len(meshes[name].triangles) for name in (link, other_link)):
                pair = MeshPair(tree, (link, other_link), (poses[link], poses[other_link]))
            touching += _allowed_overlap((link, other_link), clearance, pair)
        if report is not None:
            report(1)
    return touching


def _random_poses(part: RobotPart | RobotDescription, rng: np.random.Generator) -> dict[str, Array]:
    """Return the pose (k, 4, 4) of every link in random configurations."""
    lower, upper = (
        np.array([getattr(motor, end) for motor in part.actuators]) for end in ("lower", "upper")
    )
    positions = rng.uniform(lower, upper, (OVERLAP_SAMPLING.samples, len(lower)))
    motors = {motor.name: positions[:, i] for i, motor in enumerate(part.actuators)}
    poses = link_poses(part.root, part.joints, joint_positions(part.joints, motors))
    return {
        link: np.broadcast_to(pose, (OVERLAP_SAMPLING.samples, 4, 4))
        for link, pose in poses.items()
    }


@dataclass(frozen=True, eq=False)
class PosedCapsules:
    """The capsules of a link in k configurations, in the root's frame.

    Attributes:
        segments: (k, c, 6) centres and half axes [m].
        radii: (c,) radii [m].
        center: (k, 3) centre of a sphere around all capsules [m].
        radius: Radius of this sphere [m].
    """

    segments: Array
    radii: Array
    center: Array
    radius: float


def _posed_capsules(entries: Sequence[ShapeEntry], poses: Array) -> PosedCapsules:
    """Return the capsules of a link at poses (k, 4, 4)."""
    capsules = [capsule for entry in entries for capsule in capsules_of(entry)]
    centers, half_axes, radii = (np.array(values) for values in zip(*capsules, strict=True))
    middle = centers.mean(axis=0)
    reach = np.linalg.norm(centers - middle, axis=1) + np.linalg.norm(half_axes, axis=1) + radii
    rotations, origins = poses[:, :3, :3], poses[:, :3, 3]
    segments = np.concatenate(
        [
            np.einsum("kij,cj->kci", rotations, centers) + origins[:, None],
            np.einsum("kij,cj->kci", rotations, half_axes),
        ],
        axis=2,
    )
    return PosedCapsules(segments, radii, rotations @ middle + origins, float(reach.max()))


def _near_rows(centers: Array, other_centers: Array, distance: float) -> Rows:
    """Return the rows of points (k, 3) whose distance is below a value [m]."""
    offsets = centers - other_centers
    return np.flatnonzero(np.einsum("ki,ki->k", offsets, offsets) < (distance + SPHERE_MARGIN) ** 2)


def _clearances(first: PosedCapsules, second: PosedCapsules) -> Array:
    """Return the overlaps of the capsules of two links as negative distances (k,) [m].

    Configurations in which the bounding spheres of all capsules are separate get infinity.
    """
    clearance = np.full(OVERLAP_SAMPLING.samples, np.inf)
    near_rows = _near_rows(first.center, second.center, first.radius + second.radius)
    if not len(near_rows):
        return clearance
    for i, radius in enumerate(first.radii):
        for j, other_radius in enumerate(second.radii):
            segments, other_segments = first.segments[near_rows, i], second.segments[near_rows, j]
            radii = radius + other_radius
            half_lengths = np.linalg.norm(segments[0, 3:]) + np.linalg.norm(other_segments[0, 3:])
            rows = _near_rows(segments[:, :3], other_segments[:, :3], half_lengths + radii)
            distance, _ = between_segments(segments[rows], other_segments[rows])
            clearance[near_rows[rows]] = np.minimum(clearance[near_rows[rows]], distance - radii)
    return clearance


@dataclass(frozen=True, eq=False)
class MeshPair:
    """The meshes of two links.

    Attributes:
        tree: Function that returns the tree of a link's mesh.
        links: Names of the links.
        poses: (k, 4, 4) poses of both links by configuration.
    """

    tree: Callable[[str], CollisionTree]
    links: tuple[str, str]
    poses: tuple[Array, Array]

    def intersects(self, configurations: Rows, stop_at_first: bool = False) -> NDArray[np.bool_]:
        """Return in which configurations the meshes intersect; see `CollisionTree.intersects`."""
        first, second = map(self.tree, self.links)
        pose, other_pose = (poses[configurations] for poses in self.poses)
        return first.intersects(second, inverse(pose) @ other_pose, stop_at_first)


def _allowed_overlap(
    links: tuple[str, str], clearance: Array, meshes: MeshPair | None
) -> list[Touching]:
    """Return the entry of two links whose shapes may overlap; [] if they may not.

    Args:
        links: Names of the links.
        clearance: (k,) distance of their shapes by configuration [m].
        meshes: Their meshes; None if they are unknown.
    """
    overlaps = np.flatnonzero(clearance < 0)
    if len(overlaps) < OVERLAP_SAMPLING.min_overlaps:
        return []
    tested, always = overlaps[: OVERLAP_SAMPLING.tested], len(overlaps) == OVERLAP_SAMPLING.samples
    reason = (
        f"their shapes touch in {len(overlaps)} of {OVERLAP_SAMPLING.samples} random "
        "configurations, seed 0, "
    )
    if meshes is None:
        return [Touching(links, reason + "their meshes are unknown")] if always else []
    # Most pairs that intersect do so in one of the first configurations.
    batches = (tested[: OVERLAP_SAMPLING.first], tested[OVERLAP_SAMPLING.first :])
    if not any(meshes.intersects(batch, stop_at_first=True).any() for batch in batches):
        return [Touching(links, reason + "their meshes in none")]
    if not always:
        return []
    intersecting = meshes.intersects(tested)
    reason += f"their meshes in {intersecting.sum()} of {len(tested)}"
    # The allowed overlap is below the smallest one at which the meshes intersect, unless that
    # would forbid most of the configurations in which they do not.
    depths = -clearance[tested]
    depth = (
        math.floor(
            OVERLAP_SAMPLING.depth_fraction * float(depths[intersecting].min()) * SHAPE_FIT.grid
        )
        / SHAPE_FIT.grid
    )
    if (
        intersecting.mean() > OVERLAP_SAMPLING.nested
        or (depths[~intersecting] < depth).mean() < OVERLAP_SAMPLING.min_free_fraction
    ):
        return [Touching(links, reason + ", which these shapes cannot distinguish")]
    return [Touching(links, reason + ", all deeper", depth)]


def robot_shapes(
    robot: RobotDescription, files: tuple[RobotTree | None, RobotTree]
) -> tuple[dict[str, list[ShapeEntry]], list[Touching], list[str]]:
    """Return shapes by link, pairs of links that may overlap, and messages about unreadable files.

    Simple shapes are used unchanged. Collision meshes, or visual meshes of links without collision
    shapes, are enclosed by few capsules or boxes.

    Args:
        robot: The robot, imported from the files.
        files: Files of the arm and of the hand; the first is None if there is no file of the arm.
    """
    meshes: dict[str, IndexedMesh] = {}
    simple: dict[str, list[ShapeEntry]] = {}
    notes: list[str] = []
    arm_names: set[str] = set()
    hand = hand_links(robot)
    for file in files:
        if file is None:
            continue
        robot_names = {link: name_in_robot(link, robot.links, arm_names) for link in file.links}
        robot_names = {
            link: name
            for link, name in robot_names.items()
            if name in robot.links and (None in files or (name in hand) == (file is files[1]))
        }
        file_meshes, messages = link_meshes(file, robot_names)
        meshes |= {robot_names[link]: mesh for link, mesh in file_meshes.items()}
        entries = file.shapes.entries
        simple |= {
            name: list(entries[link]) for link, name in robot_names.items() if link in entries
        }
        notes += messages
        arm_names |= set(file.links)
    ordered = {link: meshes[link] for link in robot.links if link in meshes}
    palms = {side.palm_link for side in robot.sides} or {robot.palm_link}
    with progress(2 * len(ordered)) as report:
        shapes = fit_links(ordered, palms, simple, report=report)
        touching = allowed_overlaps(robot, shapes, meshes, report)
    return shapes, touching, notes


def name_in_robot(name: str, names: tuple[str, ...], arm_names: set[str]) -> str:
    """Return the name in the robot of a link or joint of a file.

    Args:
        name: Name in the file.
        names: Names of all links or joints of the robot.
        arm_names: Names in the arm's file; a hand's name that is among them is prefixed.
    """
    prefixed = HAND_PREFIX + name
    return prefixed if prefixed in names and name in arm_names else name


class CollisionTree:
    """A mesh in a balanced binary tree of axis-aligned boxes, and its convex hull.

    Level k has 2^k boxes; each box of the last level holds one triangle. Triangles are repeated to
    fill the last level. Hull and tree are built when they are needed.
    """

    def __init__(self, triangles: Array) -> None:
        """Store the triangles (t, 3, 3) [m]."""
        self.triangles = triangles

    @cached_property
    def hull(self) -> Array:
        """Return the vertices (v, 3) of the convex hull; all vertices of a flat mesh."""
        points = self.triangles.reshape(-1, 3)
        try:
            return points[ConvexHull(points).vertices]
        except (QhullError, ValueError):  # the points are in a plane, or too few
            return points

    @cached_property
    def leaves(self) -> Array:
        """Return the triangles (n, 3, 3) in the order of the boxes of the last level."""
        depth = max(len(self.triangles) - 1, 0).bit_length()
        order = np.resize(np.arange(len(self.triangles)), 2**depth)[None]
        centroids = self.triangles.mean(axis=1)
        while order.shape[1] > 1:  # halve each box along its longest edge
            points = centroids[order]
            longest = np.ptp(points, axis=1).argmax(axis=1)
            coordinates = np.take_along_axis(points, longest[:, None, None], axis=2)[:, :, 0]
            middle = order.shape[1] // 2
            partition = coordinates.argpartition(middle, axis=1)
            order = np.take_along_axis(order, partition, axis=1)
            order = order.reshape(2 * len(order), -1)
        return self.triangles[order[:, 0]]

    @cached_property
    def corners(self) -> Array:
        """Return the leaves as (3, 3, n): corner, coordinate, triangle."""
        return np.ascontiguousarray(self.leaves.transpose(1, 2, 0))

    @cached_property
    def levels(self) -> list[Boxes]:
        """Return the boxes of each level, from the box of the mesh to those of the triangles."""
        low, high = self.leaves.min(axis=1), self.leaves.max(axis=1)
        levels = [_boxes(low, high)]
        while len(low) > 1:
            low = low.reshape(-1, 2, 3).min(axis=1)
            high = high.reshape(-1, 2, 3).max(axis=1)
            levels.insert(0, _boxes(low, high))
        return levels

    def intersects(
        self, other_tree: CollisionTree, poses: Array, stop_at_first: bool = False
    ) -> NDArray[np.bool_]:
        """Return in which relative poses a triangle of this mesh crosses one of another mesh.

        Triangles in a common plane do not count as crossing.

        Args:
            other_tree: Tree of the other mesh.
            poses: (k, 4, 4) poses of the other mesh's frame in the frame of this one.
            stop_at_first: Whether to return as soon as one pose with an intersection is known.

        Returns:
            (k,) True where the meshes intersect; with `stop_at_first` at least one of these poses.
        """
        crossing = np.zeros(len(poses), bool)
        rows = np.flatnonzero(~hulls_are_separate(self.hull, other_tree.hull, poses))
        if len(rows):  # most meshes that do not intersect are separated by a plane
            crossing[rows] = self._triangles_cross(other_tree, poses[rows], stop_at_first)
        return crossing

    def _triangles_cross(
        self, other_tree: CollisionTree, poses: Array, stop_at_first: bool
    ) -> NDArray[np.bool_]:
        """Return the result of `intersects` by traversal of both trees."""
        crossing = np.zeros(len(poses), bool)
        rotations = np.ascontiguousarray(poses[:, :3, :3].transpose(1, 2, 0))
        translations = np.ascontiguousarray(poses[:, :3, 3].T)
        zeros = np.zeros(len(poses), np.intp)
        stack = [(0, 0, zeros, zeros, np.arange(len(poses)))]
        last = len(self.levels) - 1, len(other_tree.levels) - 1
        while stack:
            level, other_level, rows, columns, pose = stack.pop()
            if len(rows) > MAX_PAIRS:  # depth first: an intersection makes the rest unnecessary
                stack.append(
                    (level, other_level, rows[MAX_PAIRS:], columns[MAX_PAIRS:], pose[MAX_PAIRS:])
                )
                rows, columns, pose = rows[:MAX_PAIRS], columns[:MAX_PAIRS], pose[:MAX_PAIRS]
            pending = ~crossing[pose]
            if not pending.all():
                rows, columns, pose = rows[pending], columns[pending], pose[pending]
            rotation, translation = rotations[:, :, pose], translations[:, pose]
            overlaps = _overlap(
                [part[:, rows] for part in self.levels[level]],
                [part[:, columns] for part in other_tree.levels[other_level]],
                rotation,
                translation,
            )
            rows, columns, pose = rows[overlaps], columns[overlaps], pose[overlaps]
            if not len(rows):
                continue
            if (level, other_level) == last:
                rotation, translation = rotation[:, :, overlaps], translation[:, overlaps]
                corners = [
                    _dot(rotation, corner[:, columns]) + translation
                    for corner in other_tree.corners
                ]
                crossed = _cross(self.corners[:, :, rows], np.stack(corners))
                crossing[pose[crossed]] = True
                if stop_at_first and crossed.any():
                    break
                continue
            # The larger boxes are split first, so that both trees shrink alike.
            if level < last[0]:
                rows = np.concatenate([2 * rows, 2 * rows + 1])
                columns, pose = np.concatenate([columns] * 2), np.concatenate([pose] * 2)
            if other_level < last[1]:
                columns = np.concatenate([2 * columns, 2 * columns + 1])
                rows, pose = np.concatenate([rows] * 2), np.concatenate([pose] * 2)
            stack.append(
                (min(level + 1, last[0]), min(other_level + 1, last[1]), rows, columns, pose)
            )
        return crossing


def hulls_are_separate(points: Array, other_points: Array, poses: Array) -> NDArray[np.bool_]:
    """Return in which relative poses a plane between two convex hulls is found (k,).

    The method of Frank and Wolfe moves a point of the difference of the hulls towards the origin.
    The hulls are separate if the whole difference is on the far side of a plane through the origin
    that is perpendicular to the vector to this point. Hulls that nearly touch may not be decided.

    Args:
        points: (v, 3) vertices of the first hull.
        other_points: (w, 3) vertices of the second hull, in its frame.
        poses: (k, 4, 4) poses of the second frame in the first one.

    Source: E. G. Gilbert, An iterative procedure for computing the minimum of a quadratic form on a
    convex set, 1966.
    """
    rotations, origins = poses[:, :3, :3], poses[:, :3, 3]
    is_separate = np.zeros(len(poses), bool)
    difference = points.mean(axis=0) - (rotations @ other_points.mean(axis=0) + origins)
    rows = np.arange(len(poses))
    for _ in range(MAX_HULL_STEPS):
        rotation, vector = rotations[rows], difference[rows]
        nearest = points[(vector @ points.T).argmin(axis=1)]
        local_vector = np.einsum("kij,ki->kj", rotation, vector)
        other_nearest = other_points[(local_vector @ other_points.T).argmax(axis=1)]
        other_nearest = np.einsum("kij,kj->ki", rotation, other_nearest) + origins[rows]
        extreme = nearest - other_nearest
        gap = np.einsum("ki,ki->k", extreme, vector)
        is_separate[rows] = gap > MIN_GAP * np.linalg.norm(vector, axis=1)
        step = extreme - vector
        squared_length = np.maximum(np.einsum("ki,ki->k", step, step), 1e-30)  # [m^2]
        fraction = np.clip(-np.einsum("ki,ki->k", vector, step) / squared_length, 0, 1)
        difference[rows] += fraction[:, None] * step
        rows = rows[~is_separate[rows]]
        if not len(rows):
            break
    return is_separate


def _boxes(low: Array, high: Array) -> Boxes:
    return (
        np.ascontiguousarray((low + high).T) / 2,
        np.ascontiguousarray((high - low).T) / 2,
    )


def _dot(rotation: Array, vectors: Array) -> Array:
    """Return the products (3, m) of matrices (3, 3, m) and vectors (3, m)."""
    return np.stack(
        [row[0] * vectors[0] + row[1] * vectors[1] + row[2] * vectors[2] for row in rotation]
    )


def _overlap(
    box: list[Array], other_box: list[Array], rotation: Array, translation: Array
) -> NDArray[np.bool_]:
    """Return which pairs of boxes overlap along the axes of both frames (m,)."""
    absolute = np.abs(rotation)
    offset = _dot(rotation, other_box[0]) + translation - box[0]
    reach = box[1] + _dot(absolute, other_box[1])
    overlaps = (np.abs(offset) <= reach).all(axis=0)
    inverse, absolute = rotation.transpose(1, 0, 2), absolute.transpose(1, 0, 2)
    reach = other_box[1] + _dot(absolute, box[1])
    separated = (np.abs(_dot(inverse, offset)) > reach).any(axis=0)
    return np.logical_and(overlaps, ~separated)


def _vector_product(a: Array, b: Array) -> Array:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _inner(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _spans_plane(triangle: Array, other_triangle: Array) -> NDArray[np.bool_]:
    """Return for which pairs (3, 3, m) the second triangle crosses the plane of the first (m,)."""
    origin = triangle[0]
    normal = _vector_product(triangle[1] - origin, triangle[2] - origin)
    heights = np.stack([_inner(corner - origin, normal) for corner in other_triangle])
    return (heights.min(axis=0) <= 0) & (heights.max(axis=0) >= 0)


def _cross(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return which pairs of triangles (3, 3, m) cross: an edge of one passes through the other.

    Source: T. Moeller, B. Trumbore, Fast, minimum storage ray-triangle intersection, 1997.
    """
    crossed = np.zeros(first.shape[2], bool)
    candidates = np.flatnonzero(_spans_plane(first, second))
    candidates = candidates[_spans_plane(second[:, :, candidates], first[:, :, candidates])]
    if not len(candidates):
        return crossed
    first, second = first[:, :, candidates], second[:, :, candidates]
    through = np.zeros(len(candidates), bool)
    for edges, faces in ((first, second), (second, first)):
        corner = faces[0]
        side, edge = faces[1] - corner, faces[2] - corner
        for i in range(3):
            direction, start = edges[(i + 1) % 3] - edges[i], edges[i] - corner
            p, q = _vector_product(direction, edge), _vector_product(start, side)
            determinant = _inner(side, p)
            with np.errstate(all="ignore"):
                u = _inner(start, p) / determinant
                v = _inner(direction, q) / determinant
                t = _inner(edge, q) / determinant
                through |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
    crossed[candidates[through]] = True
    return crossed
