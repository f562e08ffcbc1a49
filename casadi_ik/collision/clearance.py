"""Whether a robot in a configuration is clear of itself and of a scene, by how much, and where."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance_kernel import ClearanceKernel
from casadi_ik.collision.distances import Table, from_solid, pose_row
from casadi_ik.collision.model import CollisionModel, check_base, collision_model, pair_table
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Solid, capsule
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.targets import TargetBatch

ROUNDING = 1e-9
"""What a distance may be below the margin [m]."""

Pair = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Clearances:
    """What was found for k configurations.

    Attributes:
        distance: (k,) of the pair that is nearest to being too near [m], counted from what shapes
            may overlap; negative: penetration; infinite where there is nothing to hit; NaN for
            NaN.
        free: (k,) whether every pair is as far apart as it has to be.
        pairs: (k,) number of that pair in `names`, -1: none.
        names: What pairs are called.
        surplus: (k,) what the distance has to spare beyond what is asked of its pair [m].
    """

    distance: Array
    free: NDArray[np.bool_]
    pairs: NDArray[np.int64]
    names: tuple[Pair, ...]
    surplus: Array

    def pair(self, row: int) -> Pair | None:
        """The nearest pair of a configuration."""
        number = int(self.pairs[row])
        return None if number < 0 else self.names[number]


@dataclass(frozen=True, eq=False)
class CollisionQuery:
    """What k targets are checked against.

    Attributes:
        kernel: Distances of the robot's capsules.
        table: The pairs.
        poses: (n, 12) of the solids, or (k, n, 12).
        margin: Distance to keep [m].
    """

    kernel: ClearanceKernel
    table: Table
    poses: Array
    margin: float

    def rows(self, rows: NDArray[np.intp]) -> CollisionQuery:
        """Those of some targets, which may be there several times."""
        if self.poses.ndim == 2:
            return self
        poses = self.poses[0] if len(self.poses) == 1 else self.poses[rows]
        return CollisionQuery(self.kernel, self.table, poses, self.margin)

    def among(self, table: Table) -> CollisionQuery:
        """With the pairs of a table alone."""
        return CollisionQuery(self.kernel, table, self.poses, self.margin)

    def parted(self, links: frozenset[str]) -> tuple[CollisionQuery, CollisionQuery]:
        """With the pairs alone that one of some links is in, and with all others."""
        within, others = self.table.parted(links)
        return self.among(within), self.among(others)

    @property
    def held(self) -> CollisionQuery:
        """With the pairs alone that the hand and its palm's pose decide."""
        return self.among(self.table.held)

    @property
    def swung(self) -> CollisionQuery:
        """With the pairs alone that the arm decides which holds the palm."""
        return self.among(self.table.swung)

    def check(self, q: Array) -> Clearances:
        """Clearances of configurations (k, n)."""
        surplus, pairs = self.kernel.least(q, self.poses, self.table)
        margins = np.append(self.table.margins, self.margin)[pairs]
        unknown = ~np.isfinite(q).all(axis=1)
        surplus = np.where(unknown, np.nan, surplus - self.margin)
        free = surplus >= -ROUNDING
        return Clearances(surplus + margins, free, pairs, self.table.names, surplus)

    def free(self, q: Array) -> NDArray[np.bool_]:
        """(k,) whether configurations (k, n) are free; quicker than `check`."""
        enough = self.margin - ROUNDING
        least, _ = self.kernel.least(q, self.poses, self.table, self.margin, enough)
        return (least >= enough) & np.isfinite(q).all(axis=1)


class SceneCheck:
    """A scene about a robot; may be shared by threads.

    Attributes:
        robot: The robot.
        scene: The scene.
        model: The robot's shapes and their pairs.
    """

    def __init__(self, robot: ArmHand, scene: Scene, compiled: bool = True) -> None:
        """Find the pairs and compile the placing of the shapes.

        Args:
            robot: With shapes.
            scene: What stands about it.
            compiled: False keeps to the virtual machine and numpy.

        Raises:
            UnsupportedError: The arm or the hand has no shapes.
            DescriptionError: The scene does not fit the robot.
        """
        self.robot = robot
        self.scene = scene
        self.kernel = ClearanceKernel(robot.description, compiled)
        self.model = self._as_it_stands(collision_model(robot.description))
        self._held: dict[str, Scene] = {}
        self._tables: dict[tuple[str, frozenset[str], bool], Table] = {}
        (placed,) = self.kernel.placed(robot.home)
        check_base(self.model, scene, placed, scene.items)
        self.table(scene, frozenset())

    def moved(self, name: str, pose: Array) -> SceneCheck:
        """The same with an item of the scene at another (4, 4) pose: its pairs are the same.

        Raises:
            UnknownNameError: There is no such item.
            InputError: No pose.
            DescriptionError: It stands in the robot's base there.
        """
        other = copy(self)
        other.scene = self.scene.moved(name, pose)
        (placed,) = self.kernel.placed(self.robot.home)
        check_base(self.model, other.scene, placed, {name})
        other._held = {}
        return other

    def _as_it_stands(self, model: CollisionModel, samples: int = 256) -> CollisionModel:
        """Without links that touch always; those that touch at home may overlap as much as there.

        Shapes are larger than what they hold: where fingers lie side by side they overlap though
        the fingers do not. Links that overlap at home may do so by half a millimetre more.
        """
        table = pair_table(model, Scene(), ())
        drawn = self.robot.random(np.random.default_rng(0), samples)
        q = np.concatenate([self.robot.home[None], drawn])
        distances = self.kernel.every(q, np.zeros((0, 12)), table)
        nearest_of: dict[Pair, Array] = {}
        for i, names in enumerate(table.names):
            known = nearest_of.get(names)
            here = distances[:, i]
            nearest_of[names] = here if known is None else np.minimum(known, here)
        why = f"their shapes touch in all of {samples} random configurations, seed 0"
        always = [Touching(names, why) for names, d in nearest_of.items() if (d < 0).all()]
        why = "their shapes overlap at home, where the robot is taken to be free"
        given = {frozenset(one.links): one.depth for one in model.allowed}
        home = [
            Touching(names, why, 0.5e-3 - float(d[0]) + given.get(frozenset(names), 0.0))
            for names, d in nearest_of.items()
            if d[0] < 0
        ]
        kept = model.without(always)
        return replace(kept, allowed=kept.allowed + tuple(home))

    @cached_property
    def bodies_of_fingers(self) -> dict[str, frozenset[str]]:
        """By finger the links that may touch what it grasps: all that are fixed to its pad's.

        Of a finger that no joint moves against the palm, a gripper's fixed jaw, its link alone:
        fixed to it are the palm and the end of the arm.
        """
        bodies = self.model.bodies
        return {
            finger.name: frozenset(k for k, v in bodies.items() if v == bodies[finger.link])
            if finger.joints
            else frozenset({finger.link})
            for finger in self.robot.description.fingers
        }

    def collision_query(self, targets: TargetBatch, carried: bool = False) -> CollisionQuery:
        """What targets are checked against.

        Args:
            targets: The targets.
            carried: Whether the hand carries what it grasps.

        Raises:
            UnknownNameError: They grasp an object that there is not.
        """
        scene, name = self.scene, targets.object or self.scene.grasped
        pose = targets.object_pose
        if name is not None and name not in scene.items and pose is not None:
            scene = self._holding(name, pose[0])
        elif name != scene.grasped and name in scene.items:
            scene = self._holding(name, scene.items[name].pose)
        fingers = ~np.isnan(targets.points[..., 0]).all(axis=0)
        named = [
            name for name, on in zip(self.robot.fingers, np.atleast_1d(fingers), strict=True) if on
        ]
        touched = frozenset().union(*(self.bodies_of_fingers[name] for name in named))
        table, moved = self.table(scene, touched, carried), name if pose is not None else None
        poses = table.poses(scene.items, moved, pose)
        return CollisionQuery(self.kernel, table, poses, scene.margin)

    def _holding(self, name: str, pose: Array) -> Scene:
        """The scene with an object that is grasped, wherever it was first: its pose goes aside."""
        if name not in self._held:
            self._held[name] = self.scene.holding(name, pose)
        return self._held[name]

    def table(self, scene: Scene, touched: frozenset[str], carried: bool = False) -> Table:
        """The pairs of a scene that differs from this one in what is grasped and where it is.

        Args:
            scene: The scene.
            touched: Links that may touch what is grasped.
            carried: Whether the hand carries it.
        """
        key = scene.grasped or "", touched, carried
        if key not in self._tables:
            self._tables[key] = pair_table(self.model, scene, sorted(touched), carried)
        return self._tables[key]


@dataclass(frozen=True, eq=False)
class Closest:
    """What is nearest.

    Attributes:
        ends: (2, 3) the nearest points of the first and of the second shape, base frame [m]; where
            the shapes overlap, as far beyond each other as they do.
        distance: Between them [m], negative where shapes overlap.
        shapes: The two, each with its (4, 4) pose in the base frame.
    """

    ends: Array
    distance: float
    shapes: tuple[tuple[Solid, Array], tuple[Solid, Array]]


def closest_points(robot: ArmHand, q: Array, scene: Scene, pair: tuple[str, str]) -> Closest | None:
    """The nearest points of a pair.

    Args:
        robot: With shapes.
        q: (n,) actuator positions [rad or m].
        scene: With what is grasped.
        pair: Two links, or a link and an item of the scene.

    Returns:
        None if one of them has no shape.
    """
    best: Closest | None = None
    others = link_capsules(robot, q, pair[1]) or [
        (solid, pose) for name, solid, pose in scene_solids(scene) if name == pair[1]
    ]
    for one, pose in link_capsules(robot, q, pair[0]):
        radius, half = one.size[:2]
        segment = np.append(pose[:3, 3], half * pose[:3, 2])
        for solid, place in others:
            found = from_solid(solid, segment[None, None], pose_row(place)[None])
            apart, along = found[0].item() - radius, found[1].item()
            if best is None or apart < best.distance:
                nearest = segment[:3] + along * segment[3:]
                way = _outward(solid, place, nearest)
                start = nearest - radius * way
                ends = np.stack([start, start - apart * way])
                best = Closest(ends, apart, ((one, pose), (solid, place)))
    return best


def _outward(solid: Solid, pose: Array, point: Array) -> Array:
    """(3,) the way in which the distance of a solid at a pose grows, at a point."""
    steps = 1e-6 * np.concatenate([np.eye(3), -np.eye(3)])
    local = (point + steps - pose[:3, 3]) @ pose[:3, :3]
    ahead, behind = solid.distance(local).reshape(2, 3)
    way = ahead - behind
    return way / max(float(np.linalg.norm(way)), 1e-30)


def scene_solids(scene: Scene) -> Iterator[tuple[str, Solid, Array]]:
    """Every solid of a scene: the name of its item, itself, and its (4, 4) pose."""
    for name, item in scene.items.items():
        for solid, place in item.parts:
            yield name, solid, item.pose @ place


def link_capsules(robot: ArmHand, q: Array, link: str) -> list[tuple[Solid, Array]]:
    """The capsules of a link, each along z at its (4, 4) pose in the base frame."""
    found = []
    for one in robot.description.shapes.capsules:
        if one.link == link:
            half = float(np.linalg.norm(one.half))
            place = np.eye(4)
            if half > 0:
                z = one.half / half
                x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
                x /= np.linalg.norm(x)
                place[:3, :3] = np.column_stack([x, np.cross(z, x), z])
            place[:3, 3] = one.center
            found.append((capsule(one.radius, half), robot.links(q)[link] @ place))
    return found
