"""The collision shapes of a whole robot from the files of its parts.

Links whose shapes touch although the meshes that they hold do not are told from sampled postures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import between_segments
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.capsules import FIT, Rows, fitted
from casadi_ik.integrations.importing.surfaces import Surface, link_surfaces
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.link_shapes import Touching, capsules_of
from casadi_ik.model.linkage import below, joint_positions, link_poses, rigid_bodies
from casadi_ik.model.parts import PREFIX, Part
from casadi_ik.model.schema import ShapeEntry
from casadi_ik.model.xml_tree import RobotTree


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """The links that the mount carries: all of the hand's file; none if there is no mount."""
    mounted = {joint.child for joint in robot.joints if joint.part == "mount"}
    carried = {joint.child for link in mounted for joint in below(robot, link)}
    return frozenset(mounted | carried)


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


def may_touch(
    part: Part | RobotDescription,
    shapes: Mapping[str, Sequence[ShapeEntry]],
    surfaces: Mapping[str, Surface],
) -> list[Touching]:
    """Pairs of links that may touch, and why.

    Args:
        part: An arm, a hand or a robot.
        shapes: By link its shapes.
        surfaces: By link the meshes they hold.
    """
    rng = np.random.default_rng(0)
    poses = [
        link_poses(part.root, part.joints, _values(part, rng)) for _ in range(SAMPLING.samples)
    ]
    bodies, neighbours = rigid_bodies(part)
    capsules = {
        link: [c for one in found for c in capsules_of(one)] for link, found in shapes.items()
    }
    segments = {link: _segments(found, poses, link) for link, found in capsules.items()}
    trees = cache(lambda link: TriangleTree(surfaces[link].points[surfaces[link].triangles]))

    def meet(rows: Sequence[int], one: str, other: str) -> Iterator[bool]:
        """Whether the meshes of two links meet in some configurations."""
        for row in rows:
            between = np.linalg.inv(poses[row][one]) @ poses[row][other]
            yield trees(one).meets(trees(other), between)

    found: list[Touching] = []
    for one, other in combinations(shapes, 2):
        if bodies[one] == bodies[other] or frozenset((bodies[one], bodies[other])) in neighbours:
            continue
        least = np.full(SAMPLING.samples, np.inf)
        for i, (_, _, radius) in enumerate(capsules[one]):
            for j, (_, _, wide) in enumerate(capsules[other]):
                apart, _ = between_segments(segments[one][:, i], segments[other][:, j])
                least = np.minimum(least, apart - radius - wide)
        # Of too fine a mesh only points are kept.
        known = all(len(surfaces[link].triangles) for link in (one, other))
        found += _verdict((one, other), least, meet if known else None)
    return found


def _verdict(
    links: tuple[str, str],
    least: Array,
    meet: Callable[[Sequence[int], str, str], Iterator[bool]] | None,
) -> list[Touching]:
    """What is to be said of two links whose shapes are `least` (k,) [m] apart.

    Args:
        links: Their names.
        least: In every configuration.
        meet: In which of some configurations their meshes meet; None: they are not known.
    """
    hit = np.flatnonzero(least < 0)
    if len(hit) < SAMPLING.enough:
        return []
    looked, always = hit[: SAMPLING.looked_at], len(hit) == SAMPLING.samples
    said = f"their shapes touch in {len(hit)} of {SAMPLING.samples} random configurations, seed 0, "
    if meet is None:
        return [Touching(links, said + "their meshes were not looked at")] if always else []
    if not any(meet(looked.tolist(), *links)):
        return [Touching(links, said + "their meshes in none")]
    if not always:
        return []
    met = np.array([*meet(looked.tolist(), *links)])
    said += f"their meshes in {met.sum()} of {len(looked)}"
    # As deep as where the meshes meet they may not be, if that tells the two apart.
    depths = -least[looked]
    depth = math.floor(SAMPLING.depth * float(depths[met].min()) * FIT.grid) / FIT.grid
    if met.mean() > SAMPLING.nested or (depths[~met] < depth).mean() < SAMPLING.told_apart:
        return [Touching(links, said + ", which these shapes cannot tell")]
    return [Touching(links, said + ", all deeper", depth)]


def _values(part: Part | RobotDescription, rng: np.random.Generator) -> dict[str, float]:
    """Random positions of all joints, couplings minded where they are of one joint or motor."""
    drawn = {one.name: rng.uniform(one.lower, one.upper) for one in part.actuators}
    found = joint_positions(part.joints, drawn)
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


class TriangleTree:
    """Triangles in a balanced tree of boxes, to find whether two meshes meet.

    Level k has 2^k boxes along the axes of the mesh's frame; the last level has one for each
    triangle, of which some are there twice to fill it.
    """

    def __init__(self, triangles: Array) -> None:
        """Sort triangles (t, 3, 3) [m] into boxes."""
        depth = max(len(triangles) - 1, 0).bit_length()
        order = np.resize(np.arange(len(triangles)), 2**depth)[None]
        middles = triangles.mean(axis=1)
        while order.shape[1] > 1:  # halve each box along its longest side
            inside = middles[order]
            longest = np.ptp(inside, axis=1).argmax(axis=1)
            along = np.take_along_axis(inside, longest[:, None, None], axis=2)[:, :, 0]
            order = np.take_along_axis(order, along.argsort(axis=1), axis=1)
            order = order.reshape(2 * len(order), -1)
        self.triangles = triangles[order[:, 0]]
        low, high = self.triangles.min(axis=1), self.triangles.max(axis=1)
        self.levels = [((low + high) / 2, (high - low) / 2)]
        for _ in range(depth):
            low = low.reshape(-1, 2, 3).min(axis=1)
            high = high.reshape(-1, 2, 3).max(axis=1)
            self.levels.insert(0, ((low + high) / 2, (high - low) / 2))

    def meets(self, other: TriangleTree, pose: Array) -> bool:
        """Whether a triangle of one crosses one of another mesh, whose frame has a (4, 4) pose."""
        waiting = [(0, 0, np.zeros(1, np.intp), np.zeros(1, np.intp))]
        ends = len(self.levels) - 1, len(other.levels) - 1
        while waiting:
            level, its, rows, columns = waiting.pop()
            if len(rows) > PAIRS_AT_ONCE:  # the rest later: a meeting found ends it all
                waiting.append((level, its, rows[PAIRS_AT_ONCE:], columns[PAIRS_AT_ONCE:]))
                rows, columns = rows[:PAIRS_AT_ONCE], columns[:PAIRS_AT_ONCE]
            near = self._near(level, rows, other.levels[its], columns, pose)
            rows, columns = rows[near], columns[near]
            if (level, its) == ends:
                theirs = other.triangles[columns] @ pose[:3, :3].T + pose[:3, 3]
                if _crossing(self.triangles[rows], theirs).any():
                    return True
            elif len(rows):
                if level < ends[0]:
                    rows, columns = np.r_[2 * rows, 2 * rows + 1], np.r_[columns, columns]
                if its < ends[1]:
                    rows, columns = np.r_[rows, rows], np.r_[2 * columns, 2 * columns + 1]
                waiting.append((min(level + 1, ends[0]), min(its + 1, ends[1]), rows, columns))
        return False

    def _near(
        self, level: int, rows: Rows, theirs: tuple[Array, Array], columns: Rows, pose: Array
    ) -> NDArray[np.bool_]:
        """Whether the boxes of some pairs overlap along the axes of either frame."""
        (middle, half), (at, reach) = self.levels[level], theirs
        turn = pose[:3, :3]
        apart = at[columns] @ turn.T + pose[:3, 3] - middle[rows]
        ours = np.abs(apart) <= half[rows] + reach[columns] @ np.abs(turn).T
        other = np.abs(apart @ turn) <= reach[columns] + half[rows] @ np.abs(turn)
        return ours.all(axis=1) & other.all(axis=1)


PAIRS_AT_ONCE = 256
"""Pairs of boxes that are looked at in one piece."""


def _crossing(first: Array, second: Array) -> NDArray[np.bool_]:
    """Whether an edge of one of two triangles (k, 3, 3) goes through the other (Moeller-Trumbore).

    Triangles in one plane do not cross.
    """
    found = np.zeros(len(first), bool)
    for one, other in ((first, second), (second, first)):
        corner = other[:, 0]
        side, edge = other[:, 1] - corner, other[:, 2] - corner
        for i in range(3):
            along, start = one[:, (i + 1) % 3] - one[:, i], one[:, i] - corner
            normal, turned = np.cross(along, edge), np.cross(start, side)
            scale = (side * normal).sum(axis=1)
            with np.errstate(all="ignore"):
                u = (start * normal).sum(axis=1) / scale
                v = (along * turned).sum(axis=1) / scale
                t = (edge * turned).sum(axis=1) / scale
                found |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
    return found


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
        ours = {link: name_in_robot(link, robot.links, taken) for link in file.links}
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
    palms = {side.palm_link for side in robot.sides} or {robot.palm_link}
    shapes = fitted(ordered, palms, simple)
    return shapes, may_touch(robot, shapes, surfaces), notes


def name_in_robot(name: str, names: tuple[str, ...], taken: set[str]) -> str:
    """What a link or joint of a file is called in the robot."""
    prefixed = PREFIX + name
    return prefixed if prefixed in names and name in taken else name
