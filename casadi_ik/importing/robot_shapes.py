"""The collision shapes of a whole robot from the files of its parts.

Links whose shapes touch although the meshes that they hold do not are told from sampled postures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Protocol

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import between_segments
from casadi_ik.importing.capsules import FIT, fitted
from casadi_ik.importing.posture import Jointed, Postures
from casadi_ik.importing.surfaces import Surface, link_surfaces
from casadi_ik.robots.collision import Touching, capsules_of
from casadi_ik.robots.description import Actuator, Joint, RobotDescription
from casadi_ik.robots.parts import PREFIX
from casadi_ik.robots.poses import joint_positions
from casadi_ik.robots.robot_files.tree import RobotTree
from casadi_ik.robots.schema import ShapeEntry


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """The links that the mount carries: all of the hand's file; none if there is no mount."""
    found: set[str] = set()
    more = {joint.child for joint in robot.joints if joint.part == "mount"}
    while more:
        found |= more
        more = {joint.child for joint in robot.joints if joint.parent in more}
    return frozenset(found)


@dataclass(frozen=True)
class ContactSampling:
    """How it is told whether links whose shapes touch may touch.

    Attributes:
        samples: Random configurations, seed 0.
        enough: Configurations in which shapes touch that are enough to say that meshes never do.
        looked_at: Of those, in so many the meshes are looked at.
        nested: Meshes that meet in a larger part of the configurations are built into each other.
        told_apart: Part of the configurations without contact that an allowed overlap has to leave
            free.
        depth: Part of the depth at which meshes meet that shapes may overlap.
    """

    samples: int = 2000
    enough: int = 100
    looked_at: int = 300
    nested: float = 0.5
    told_apart: float = 0.5
    depth: float = 0.9


SAMPLING = ContactSampling()


class Moved(Jointed, Protocol):
    """Links, joints and motors: a part, or a robot."""

    @property
    def actuators(self) -> Sequence[Actuator]:
        """The motors."""
        ...


def may_touch(
    part: Moved, shapes: Mapping[str, Sequence[ShapeEntry]], surfaces: Mapping[str, Surface]
) -> list[Touching]:
    """Pairs of links that may touch, and why.

    Args:
        part: An arm, a hand or a robot.
        shapes: By link its shapes.
        surfaces: By link the meshes they hold.
    """
    postures, rng = Postures(part), np.random.default_rng(0)
    joints = {joint.name: joint for joint in part.joints}
    motors = list(part.actuators)
    poses = [postures.poses(_values(joints, motors, rng)) for _ in range(SAMPLING.samples)]
    bodies = {part.root: part.root}
    neighbours = set()
    for joint in part.joints:
        parent = bodies[joint.parent]
        bodies[joint.child] = parent if joint.type == "fixed" else joint.child
        neighbours.add(frozenset((parent, bodies[joint.child])))
    capsules = {
        link: [c for one in found for c in capsules_of(one)] for link, found in shapes.items()
    }
    segments = {link: _segments(found, poses, link) for link, found in capsules.items()}
    meshes = _Meshes(surfaces)
    found: list[Touching] = []
    for one, other in combinations(shapes, 2):
        if bodies[one] == bodies[other] or frozenset((bodies[one], bodies[other])) in neighbours:
            continue
        least = np.full(SAMPLING.samples, np.inf)
        for i, (_, _, radius) in enumerate(capsules[one]):
            for j, (_, _, wide) in enumerate(capsules[other]):
                apart, _ = between_segments(segments[one][:, i], segments[other][:, j])
                least = np.minimum(least, apart - radius - wide)
        found += _verdict((one, other), least, meshes, poses)
    return found


def _verdict(
    links: tuple[str, str], least: Array, meshes: _Meshes, poses: Sequence[Mapping[str, Array]]
) -> list[Touching]:
    """What is to be said of two links whose shapes are `least` (k,) [m] apart."""
    hit = np.flatnonzero(least < 0)
    if len(hit) < SAMPLING.enough:
        return []
    looked, always = hit[: SAMPLING.looked_at], len(hit) == SAMPLING.samples
    said = f"their shapes touch in {len(hit)} of {SAMPLING.samples} random configurations, seed 0, "
    if not meshes.known:
        return [Touching(links, said + "their meshes were not looked at")] if always else []
    if not any(meshes.touch(poses[row], *links) for row in looked.tolist()):
        return [Touching(links, said + "their meshes in none")]
    if not always:
        return []
    meet = np.array([meshes.touch(poses[row], *links) for row in looked.tolist()])
    said += f"their meshes in {meet.sum()} of {len(looked)}"
    # As deep as where the meshes meet they may not be, if that tells the two apart.
    depths = -least[looked]
    depth = math.floor(SAMPLING.depth * float(depths[meet].min()) * FIT.grid) / FIT.grid
    if meet.mean() > SAMPLING.nested or (depths[~meet] < depth).mean() < SAMPLING.told_apart:
        return [Touching(links, said + ", which these shapes cannot tell")]
    return [Touching(links, said + ", all deeper", depth)]


def _values(
    joints: Mapping[str, Joint], motors: Sequence[Actuator], rng: np.random.Generator
) -> dict[str, float]:
    """Random positions of all joints, couplings minded where they are of one joint or motor."""
    drawn = {one.name: rng.uniform(one.lower, one.upper) for one in motors}
    found = joint_positions(joints.values(), drawn)
    return {name: float(value[0]) for name, value in found.items()}


def _segments(
    capsules: Sequence[tuple[Array, Array, float]], poses: Sequence[Mapping[str, Array]], link: str
) -> Array:
    """(k, c, 6) middles and halves of a link's capsules in the root's frame."""
    stacked = np.stack([pose[link] for pose in poses])
    rotations, origins = stacked[:, :3, :3], stacked[:, None, :3, 3]
    middles, halves = (np.stack([one[i] for one in capsules]) for i in (0, 1))
    turned = (np.einsum("kij,cj->kci", rotations, points) for points in (middles, halves))
    middle, half = turned
    return np.concatenate([middle + origins, half], axis=2)


class _Meshes:
    """Meshes of links, made when they are asked for."""

    def __init__(self, surfaces: Mapping[str, Surface]) -> None:
        self._surfaces = surfaces
        self._made: dict[str, Any] = {}
        try:
            import coal
        except ImportError:  # it comes with pinocchio, of which there is none for Windows
            self._coal: Any = None
        else:
            self._coal = coal

    @property
    def known(self) -> bool:
        """Whether there is coal, which tells."""
        return self._coal is not None

    def touch(self, pose: Mapping[str, Array], one: str, other: str) -> bool:
        """Whether the meshes of two links meet."""
        coal = self._coal
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        places = [coal.Transform3s(pose[x][:3, :3], pose[x][:3, 3]) for x in (one, other)]
        first, second = self._mesh(one), self._mesh(other)
        return bool(coal.collide(first, places[0], second, places[1], request, result))

    def _mesh(self, link: str) -> Any:
        if link not in self._made:
            surface, model = self._surfaces[link], self._coal.BVHModelOBBRSS()
            model.beginModel(len(surface.triangles), len(surface.points))
            model.addVertices(np.asarray(surface.points, dtype=float))
            model.addTriangles(np.asarray(surface.triangles))
            model.endModel()
            self._made[link] = model
        return self._made[link]


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
    surfaces: dict[str, Surface] = {}
    simple: dict[str, list[ShapeEntry]] = {}
    notes: list[str] = []
    taken: set[str] = set()
    hand = hand_links(robot)
    for file in files:
        if file is None:
            continue
        ours = {link: _ours(link, robot.links, taken) for link in file.links}
        wanted = {
            link: name
            for link, name in ours.items()
            if name in robot.links and (None in files or (name in hand) == (file is files[1]))
        }
        found, said = link_surfaces(file, wanted)
        surfaces |= {wanted[link]: surface for link, surface in found.items()}
        entries = file.shapes.entries
        simple |= {wanted[link]: list(entries[link]) for link in wanted if link in entries}
        notes += said
        taken |= set(file.links)
    ordered = {link: surfaces[link] for link in robot.links if link in surfaces}
    shapes = fitted(ordered, {robot.palm_link}, simple)
    return shapes, may_touch(robot, shapes, surfaces), notes


def _ours(link: str, links: tuple[str, ...], taken: set[str]) -> str:
    """What a link of a file is called in the robot."""
    prefixed = PREFIX + link
    return prefixed if prefixed in links and link in taken else link
