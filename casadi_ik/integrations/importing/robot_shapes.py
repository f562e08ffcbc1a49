"""Collision shapes of a robot from the files of its parts, and the pairs that may overlap.

Shapes are larger than the meshes that they enclose. Pairs of links whose shapes overlap although
their meshes do not are found by random sampling of configurations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import between_segments
from casadi_ik.files.arrays import Array
from casadi_ik.files.progress import progress
from casadi_ik.integrations.importing.capsules import SHAPE_FIT, fit_links
from casadi_ik.integrations.importing.meshes import IndexedMesh, link_meshes
from casadi_ik.integrations.importing.triangle_tree import CollisionTree
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import joint_positions, joints_below, link_poses, rigid_bodies
from casadi_ik.model.link_shapes import Touching, capsules_of
from casadi_ik.model.parts import HAND_PREFIX, RobotPart
from casadi_ik.model.pose import inverse
from casadi_ik.model.schema import ShapeEntry
from casadi_ik.model.xml_tree import RobotTree


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


def _near_rows(centers: Array, other_centers: Array, distance: float) -> NDArray[np.intp]:
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

    def intersects(
        self, configurations: NDArray[np.intp], stop_at_first: bool = False
    ) -> NDArray[np.bool_]:
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
