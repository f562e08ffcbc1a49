"""Collision checks of a robot with itself and with a scene, with clearances and closest pairs."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance_kernel import ClearanceKernel
from casadi_ik.collision.distances import PairTable, from_solid, pose_row
from casadi_ik.collision.model import CollisionModel, check_base, collision_model, pair_table
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import PosedSolid, Solid, capsule
from casadi_ik.files.arrays import Array
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.targets import TargetBatch

DISTANCE_ROUNDING = 1e-9
"""Rounding error by which a distance may fall below the margin [m]."""

Pair = tuple[str, str]


@dataclass(frozen=True, eq=False, repr=False)
class Clearances(RecordReprMixin):
    """Clearances of k configurations.

    Attributes:
        distance: (k,) distance of the pair with the smallest surplus [m], beyond the overlap that
            the pair is allowed; negative: penetration; infinite without any pair; NaN for NaN.
        free: (k,) True if every pair keeps its margin.
        pairs: (k,) index of that pair in `names`; -1: none.
        names: Names of the pairs.
        surplus: (k,) distance beyond the margin of that pair [m]; negative: collision.
    """

    distance: Array
    free: NDArray[np.bool_]
    pairs: NDArray[np.int64]
    names: tuple[Pair, ...]
    surplus: Array

    def pair(self, row: int) -> Pair | None:
        """Return the names of the closest pair of a configuration; None without any pair."""
        number = int(self.pairs[row])
        return None if number < 0 else self.names[number]


@dataclass(frozen=True, eq=False)
class CollisionQuery:
    """The collision pairs and obstacle poses of k targets.

    Attributes:
        kernel: Kernel for the distances of the robot's capsules.
        table: The pairs.
        poses: (n, 12) poses of the solids of the scene, or (k, n, 12) by target.
        margin: Required clearance [m].
    """

    kernel: ClearanceKernel
    table: PairTable
    poses: Array
    margin: float

    def rows(self, rows: NDArray[np.intp]) -> CollisionQuery:
        """Return the query for targets by index, which may repeat."""
        if self.poses.ndim == 2:
            return self
        poses = self.poses[0] if len(self.poses) == 1 else self.poses[rows]
        return CollisionQuery(self.kernel, self.table, poses, self.margin)

    def with_table(self, table: PairTable) -> CollisionQuery:
        """Return the query with the pairs of another table."""
        return CollisionQuery(self.kernel, table, self.poses, self.margin)

    def split_by_links(self, links: frozenset[str]) -> tuple[CollisionQuery, CollisionQuery]:
        """Return the queries with the pairs that involve one of the links, and with all others."""
        involved, uninvolved = self.table.split_by_links(links)
        return self.with_table(involved), self.with_table(uninvolved)

    @property
    def hand_pairs(self) -> CollisionQuery:
        """Query with the pairs whose distances follow from the hand and its palm pose."""
        return self.with_table(self.table.hand_pairs)

    @property
    def arm_pairs(self) -> CollisionQuery:
        """Query with the pairs whose distances depend on the arm."""
        return self.with_table(self.table.arm_pairs)

    def check(self, q: Array) -> Clearances:
        """Return the clearances of configurations (k, n)."""
        surplus, pairs = self.kernel.min_distances(q, self.poses, self.table)
        margins = np.append(self.table.margins, self.margin)[pairs]
        is_invalid = ~np.isfinite(q).all(axis=1)
        surplus = np.where(is_invalid, np.nan, surplus - self.margin)
        free = surplus >= -DISTANCE_ROUNDING
        return Clearances(surplus + margins, free, pairs, self.table.names, surplus)

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Return whether configurations (k, n) are collision-free, (k,); faster than `check`."""
        threshold = self.margin - DISTANCE_ROUNDING
        distances, _ = self.kernel.min_distances(q, self.poses, self.table, self.margin, threshold)
        return (distances >= threshold) & np.isfinite(q).all(axis=1)


class SceneCheck:
    """The collision check of a robot in a scene; threads may share it.

    Attributes:
        robot: The robot.
        scene: The scene.
        model: The robot's shapes and their pairs.
    """

    def __init__(self, robot: ArmHand, scene: Scene, compiled: bool = True) -> None:
        """Collect the pairs and compile the kernel of the shapes.

        Args:
            robot: A robot with collision shapes.
            scene: The obstacles.
            compiled: Use compiled kernels; False: the virtual machine and numpy.

        Raises:
            UnsupportedError: The arm or the hand has no shapes.
            DescriptionError: The scene does not fit the robot.
        """
        self.robot = robot
        self.scene = scene
        self.kernel = ClearanceKernel(robot.description, compiled)
        self.model = self._allow_overlaps_at_home(collision_model(robot.description))
        self._grasping_scenes: dict[str, Scene] = {}
        self._pair_tables: dict[tuple[str, frozenset[str], bool], PairTable] = {}
        (shape_poses,) = self.kernel.shape_poses(robot.home)
        check_base(self.model, scene, shape_poses, scene.items)
        self.table(scene, frozenset())

    def moved(self, name: str, pose: Array) -> SceneCheck:
        """Return this check with an obstacle at another (4, 4) pose; the pairs stay the same.

        Raises:
            UnknownNameError: The scene has no obstacle of this name.
            InputError: The pose is not rigid.
            DescriptionError: The obstacle penetrates the robot's base.
        """
        check = copy(self)
        check.scene = self.scene.moved(name, pose)
        (shape_poses,) = self.kernel.shape_poses(self.robot.home)
        check_base(self.model, check.scene, shape_poses, {name})
        check._grasping_scenes = {}
        return check

    def _allow_overlaps_at_home(self, model: CollisionModel, samples: int = 256) -> CollisionModel:
        """Exclude pairs that always overlap, and allow the overlaps at home.

        Shapes enclose their links. Therefore the shapes of adjacent fingers may overlap although
        the fingers do not touch. Pairs that overlap at home may overlap by 0.5 mm more.
        """
        table = pair_table(model, Scene(), ())
        random = self.robot.random(np.random.default_rng(0), samples)
        q = np.concatenate([self.robot.home[None], random])
        distances = self.kernel.all_distances(q, np.zeros((0, 12)), table)
        distances_of: dict[Pair, Array] = {}
        for i, names in enumerate(table.names):
            minimum = distances_of.get(names, np.inf)
            distances_of[names] = np.minimum(minimum, distances[:, i])
        reason = f"the shapes touch in all of {samples} random configurations, seed 0"
        always = [Touching(names, reason) for names, d in distances_of.items() if (d < 0).all()]
        reason = "the shapes overlap at home, where the robot is assumed to be collision-free"
        depths = {frozenset(entry.links): entry.depth for entry in model.allowed}
        at_home = [
            Touching(names, reason, 0.5e-3 - float(d[0]) + depths.get(frozenset(names), 0.0))
            for names, d in distances_of.items()
            if d[0] < 0
        ]
        reduced = model.with_excluded(always)
        return replace(reduced, allowed=reduced.allowed + tuple(at_home))

    @cached_property
    def finger_bodies(self) -> dict[str, frozenset[str]]:
        """Links that may touch the grasped object, by finger: links fixed to the link of its pad.

        A finger without joints, such as the fixed jaw of a gripper, has only the link of its pad,
        because palm and arm are fixed to it.
        """
        bodies = self.model.bodies
        return {
            finger.name: frozenset(k for k, v in bodies.items() if v == bodies[finger.link])
            if finger.joints
            else frozenset({finger.link})
            for finger in self.robot.description.fingers
        }

    def collision_query(self, targets: TargetBatch, is_carried: bool = False) -> CollisionQuery:
        """Return the collision query of targets.

        Args:
            targets: The targets.
            is_carried: True if the hand carries the grasped object.

        Raises:
            UnknownNameError: Neither an obstacle nor a shipped object has the object's name.
        """
        scene, name = self.scene, targets.object or self.scene.grasped
        pose = targets.object_pose
        if name is not None and name not in scene.items and pose is not None:
            scene = self._grasping(name, pose[0])
        elif name != scene.grasped and name in scene.items:
            scene = self._grasping(name, scene.items[name].pose)
        has_contact = np.atleast_1d(~np.isnan(targets.points[..., 0]).all(axis=0))
        fingers = zip(self.robot.fingers, has_contact, strict=True)
        bodies = (self.finger_bodies[finger] for finger, touches in fingers if touches)
        table = self.table(scene, frozenset().union(*bodies), is_carried)
        poses = table.poses(scene.items, name if pose is not None else None, pose)
        return CollisionQuery(self.kernel, table, poses, scene.margin)

    def _grasping(self, name: str, pose: Array) -> Scene:
        """Return the scene with a grasped object; the pose of the first call is reused."""
        if name not in self._grasping_scenes:
            self._grasping_scenes[name] = self.scene.holding(name, pose)
        return self._grasping_scenes[name]

    def table(
        self, scene: Scene, touching_links: frozenset[str], is_carried: bool = False
    ) -> PairTable:
        """Return the pairs of this scene, possibly with another grasped object.

        Args:
            scene: The scene.
            touching_links: Links that may touch the grasped object.
            is_carried: True if the hand carries the object.
        """
        key = scene.grasped or "", touching_links, is_carried
        if key not in self._pair_tables:
            self._pair_tables[key] = pair_table(
                self.model, scene, sorted(touching_links), is_carried
            )
        return self._pair_tables[key]


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The closest points of a pair.

    Attributes:
        points: (2, 3) closest points of the first and of the second shape, base frame [m]; for
            overlapping shapes, the points of deepest penetration.
        distance: Distance [m]; negative: penetration.
        shapes: The two shapes, each with its (4, 4) pose in the base frame.
    """

    points: Array
    distance: float
    shapes: tuple[PosedSolid, PosedSolid]


def closest_points(
    robot: ArmHand, q: Array, scene: Scene, pair: tuple[str, str]
) -> ClosestPoints | None:
    """Return the closest points of a pair.

    Args:
        robot: A robot with collision shapes.
        q: (n,) actuator positions [rad or m].
        scene: The scene, including a grasped object.
        pair: Two links, or a link and an obstacle.

    Returns:
        None if one of them has no shape.
    """
    best: ClosestPoints | None = None
    second_shapes = link_capsules(robot, q, pair[1]) or [
        (solid, pose) for name, solid, pose in scene_solids(scene) if name == pair[1]
    ]
    for link_capsule, capsule_pose in link_capsules(robot, q, pair[0]):
        radius, half_length = link_capsule.size[:2]
        segment = np.append(capsule_pose[:3, 3], half_length * capsule_pose[:3, 2])
        for solid, solid_pose in second_shapes:
            distances, positions = from_solid(
                solid, segment[None, None], pose_row(solid_pose)[None]
            )
            distance, position = distances.item() - radius, positions.item()
            if best is None or distance < best.distance:
                point = segment[:3] + position * segment[3:]
                direction = _outward(solid, solid_pose, point)
                surface_point = point - radius * direction
                points = np.stack([surface_point, surface_point - distance * direction])
                shapes = (link_capsule, capsule_pose), (solid, solid_pose)
                best = ClosestPoints(points, distance, shapes)
    return best


def _outward(solid: Solid, pose: Array, point: Array) -> Array:
    """Return the unit gradient (3,) of the distance of a solid at a pose, at a point."""
    steps = 1e-6 * np.concatenate([np.eye(3), -np.eye(3)])
    local = (point + steps - pose[:3, 3]) @ pose[:3, :3]
    ahead, behind = solid.distance(local).reshape(2, 3)
    gradient = ahead - behind
    return gradient / max(float(np.linalg.norm(gradient)), 1e-30)


def scene_solids(scene: Scene) -> Iterator[tuple[str, Solid, Array]]:
    """Yield every solid of a scene: name of its obstacle, solid, (4, 4) pose in the base frame."""
    for name, obstacle in scene.items.items():
        for solid, pose in obstacle.parts:
            yield name, solid, obstacle.pose @ pose


def link_capsules(robot: ArmHand, q: Array, link: str) -> list[PosedSolid]:
    """Return the capsules of a link, each along z of its (4, 4) pose in the base frame."""
    capsules = []
    for shape in robot.description.shapes.capsules:
        if shape.link == link:
            half_length = float(np.linalg.norm(shape.half_axis))
            placement = np.eye(4)
            if half_length > 0:
                z = shape.half_axis / half_length
                x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
                x /= np.linalg.norm(x)
                placement[:3, :3] = np.column_stack([x, np.cross(z, x), z])
            placement[:3, 3] = shape.center
            solid = capsule(shape.radius, half_length)
            capsules.append((solid, robot.links(q)[link] @ placement))
    return capsules
