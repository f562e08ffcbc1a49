"""The collision shapes of a whole robot from the files of its parts.

Links whose shapes touch although the meshes that they hold do not are told from sampled postures.
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
from casadi_ik.model.link_shapes import Touching, capsules_of
from casadi_ik.model.linkage import joint_positions, joints_below, link_poses, rigid_bodies
from casadi_ik.model.parts import HAND_PREFIX, RobotPart
from casadi_ik.model.schema import ShapeEntry
from casadi_ik.model.xml_tree import RobotTree


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """The links that the mount carries: all of the hand's file; none if there is no mount."""
    mounted = {joint.child for joint in robot.joints if joint.part == "mount"}
    carried = {joint.child for link in mounted for joint in joints_below(robot, link)}
    return frozenset(mounted | carried)


@dataclass(frozen=True)
class ContactSampling:
    """How it is told whether links whose shapes touch may touch.

    Attributes:
        samples: Random configurations, seed 0.
        enough: Configurations in which shapes touch that are enough to say that meshes never do.
        looked_at: Of those, in so many the meshes are looked at.
        first: Of these, the number that are examined before all others.
        nested: Meshes that meet in a larger part of the configurations are built into each other.
        told_apart: Part of the configurations without contact that an allowed overlap has to leave
            free.
        depth: Part of the depth at which meshes meet that shapes may overlap.
        triangles: Number of triangles up to which a mesh is tested as it is.
        cells: Cells of the grid to which a finer mesh is simplified, along its longest edge.
    """

    samples: int = 2000
    enough: int = 100
    looked_at: int = 300
    first: int = 10
    nested: float = 0.5
    told_apart: float = 0.5
    depth: float = 0.9
    triangles: int = 3000
    cells: int = 48


SAMPLING = ContactSampling()


def may_touch(
    part: RobotPart | RobotDescription,
    shapes: Mapping[str, Sequence[ShapeEntry]],
    surfaces: Mapping[str, IndexedMesh],
    report: Callable[[int], object] | None = None,
) -> list[Touching]:
    """Return the pairs of links whose shapes may overlap, each with the reason.

    Args:
        part: An arm, a hand or a robot.
        shapes: Shapes by link.
        surfaces: Meshes by link, which the shapes enclose.
        report: Function called with the number of links whose pairs have been tested since.
    """
    poses = _random_poses(part, np.random.default_rng(0))
    bodies, neighbours = rigid_bodies(part)
    capsules = {
        link: [capsule for entry in entries for capsule in capsules_of(entry)]
        for link, entries in shapes.items()
    }
    segments = {link: _segments(entries, poses[link]) for link, entries in capsules.items()}

    @cache
    def tree(link: str) -> CollisionTree:
        mesh = surfaces[link].simplified(SAMPLING.triangles, SAMPLING.cells)
        return CollisionTree(mesh.points[mesh.triangles])

    touching: list[Touching] = []
    links = list(shapes)
    for i, link in enumerate(links):
        for other in links[i + 1 :]:
            if bodies[link] == bodies[other]:
                continue
            if frozenset((bodies[link], bodies[other])) in neighbours:
                continue
            clearance = _clearances(
                (capsules[link], capsules[other]), (segments[link], segments[other])
            )
            pair: MeshPair | None = None
            # Only the points of a mesh are known if it has too many triangles.
            if all(name in surfaces and len(surfaces[name].triangles) for name in (link, other)):
                relative = _inverse(poses[link]) @ poses[other]
                pair = MeshPair(tree, (link, other), relative)
            touching += _allowed_overlap((link, other), clearance, pair)
        if report is not None:
            report(1)
    return touching


def _random_poses(part: RobotPart | RobotDescription, rng: np.random.Generator) -> dict[str, Array]:
    """Return the pose (k, 4, 4) of every link in random configurations."""
    lower, upper = (
        np.array([getattr(motor, end) for motor in part.actuators]) for end in ("lower", "upper")
    )
    drawn = rng.uniform(lower, upper, (SAMPLING.samples, len(lower)))
    motors = {motor.name: drawn[:, i] for i, motor in enumerate(part.actuators)}
    poses = link_poses(part.root, part.joints, joint_positions(part.joints, motors))
    return {link: np.broadcast_to(pose, (SAMPLING.samples, 4, 4)) for link, pose in poses.items()}


def _inverse(poses: Array) -> Array:
    """Return the inverses of poses (k, 4, 4)."""
    inverses = np.zeros(poses.shape) + np.eye(4)
    inverses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    inverses[:, :3, 3] = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])
    return inverses


Capsules = Sequence[tuple[Array, Array, float]]


def _clearances(capsules: tuple[Capsules, Capsules], segments: tuple[Array, Array]) -> Array:
    """Return the least distance (k,) of the capsules of two links [m], negative if they overlap."""
    clearance = np.full(SAMPLING.samples, np.inf)
    for i, (_, _, radius) in enumerate(capsules[0]):
        for j, (_, _, other_radius) in enumerate(capsules[1]):
            distance, _ = between_segments(segments[0][:, i], segments[1][:, j])
            clearance = np.minimum(clearance, distance - radius - other_radius)
    return clearance


@dataclass(frozen=True, eq=False)
class MeshPair:
    """The meshes of two links.

    Attributes:
        tree: Function that returns the tree of a link's mesh.
        links: Names of the links.
        relative: (k, 4, 4) pose of the second link in the first by configuration.
    """

    tree: Callable[[str], CollisionTree]
    links: tuple[str, str]
    relative: Array

    def intersects(
        self, configurations: NDArray[np.intp], stop_at_first: bool = False
    ) -> NDArray[np.bool_]:
        """Return in which configurations the meshes intersect; see `CollisionTree.intersects`."""
        first, second = map(self.tree, self.links)
        return first.intersects(second, self.relative[configurations], stop_at_first)


def _allowed_overlap(
    links: tuple[str, str], clearance: Array, meshes: MeshPair | None
) -> list[Touching]:
    """Return the entry of two links whose shapes may overlap; [] if they may not.

    Args:
        links: Names of the links.
        clearance: (k,) distance of their shapes by configuration [m].
        meshes: Their meshes; None if they are unknown.
    """
    hit = np.flatnonzero(clearance < 0)
    if len(hit) < SAMPLING.enough:
        return []
    examined, always = hit[: SAMPLING.looked_at], len(hit) == SAMPLING.samples
    reason = (
        f"their shapes touch in {len(hit)} of {SAMPLING.samples} random configurations, seed 0, "
    )
    if meshes is None:
        return [Touching(links, reason + "their meshes were not looked at")] if always else []
    # Most pairs that intersect do so in one of the first configurations.
    batches = (examined[: SAMPLING.first], examined[SAMPLING.first :])
    if not any(meshes.intersects(batch, stop_at_first=True).any() for batch in batches):
        return [Touching(links, reason + "their meshes in none")]
    if not always:
        return []
    intersecting = meshes.intersects(examined)
    reason += f"their meshes in {intersecting.sum()} of {len(examined)}"
    # The allowed overlap is less than where the meshes intersect, if that tells the two apart.
    depths = -clearance[examined]
    depth = (
        math.floor(SAMPLING.depth * float(depths[intersecting].min()) * SHAPE_FIT.grid)
        / SHAPE_FIT.grid
    )
    if (
        intersecting.mean() > SAMPLING.nested
        or (depths[~intersecting] < depth).mean() < SAMPLING.told_apart
    ):
        return [Touching(links, reason + ", which these shapes cannot tell")]
    return [Touching(links, reason + ", all deeper", depth)]


def _segments(capsules: Capsules, poses: Array) -> Array:
    """Return the centres and half axes (k, c, 6) of a link's capsules in the root's frame.

    Args:
        capsules: The capsules in the link's frame.
        poses: (k, 4, 4) poses of the link.
    """
    rotations, origins = poses[:, :3, :3], poses[:, None, :3, 3]
    centres, half_axes = (
        np.einsum("kij,cj->kci", rotations, np.stack([capsule[i] for capsule in capsules]))
        for i in (0, 1)
    )
    return np.concatenate([centres + origins, half_axes], axis=2)


def robot_shapes(
    robot: RobotDescription, files: tuple[RobotTree | None, RobotTree]
) -> tuple[dict[str, list[ShapeEntry]], list[Touching], list[str]]:
    """Shapes by link of the robot, links that may touch, and what could not be read.

    Simple shapes stay what they are; a mesh, or what is seen of a link that says nothing of
    collisions, is held by few capsules.

    Args:
        robot: The robot, imported from the files.
        files: The arm's, if it has one of its own, and the hand's.
    """
    surfaces: dict[str, IndexedMesh] = {}
    simple: dict[str, list[ShapeEntry]] = {}
    notes: list[str] = []
    taken: set[str] = set()
    hand = hand_links(robot)
    for file in files:
        if file is None:
            continue
        ours = {link: name_in_robot(link, robot.links, taken) for link in file.links}
        wanted = {
            link: name
            for link, name in ours.items()
            if name in robot.links and (None in files or (name in hand) == (file is files[1]))
        }
        found, said = link_meshes(file, wanted)
        surfaces |= {wanted[link]: surface for link, surface in found.items()}
        entries = file.shapes.entries
        simple |= {wanted[link]: list(entries[link]) for link in wanted if link in entries}
        notes += said
        taken |= set(file.links)
    ordered = {link: surfaces[link] for link in robot.links if link in surfaces}
    palms = {side.palm_link for side in robot.sides} or {robot.palm_link}
    with progress(2 * len(ordered)) as report:
        shapes = fit_links(ordered, palms, simple, report=report)
        touching = may_touch(robot, shapes, surfaces, report)
    return shapes, touching, notes


def name_in_robot(name: str, names: tuple[str, ...], taken: set[str]) -> str:
    """What a link or joint of a file is called in the robot."""
    prefixed = HAND_PREFIX + name
    return prefixed if prefixed in names and name in taken else name
