"""The collision model of a robot: its shapes, and the pairs that are checked."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import PairTable, from_solid, pose_row
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Solid, box, cylinder
from casadi_ik.errors import DescriptionError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Pose, actuated
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import rigid_bodies
from casadi_ik.model.link_shapes import LinkCapsule, Shapes, Touching


@dataclass(frozen=True, eq=False)
class CollisionModel:
    """The capsules of a robot and their collision pairs.

    Attributes:
        robot: Description of the robot.
        capsules: Capsules of the links.
        bodies: Movable link, or the root, that each link is fixed to.
        pairs: (p, 2) pairs to check: index of a capsule; index of a second one, or number of
            capsules + index of a solid of the robot.
        excluded: Links that are not checked, with the reason.
        allowed: Links that may overlap by a given depth, with the reason.
    """

    robot: RobotDescription
    capsules: tuple[LinkCapsule, ...]
    bodies: dict[str, str]
    pairs: NDArray[np.int32]
    excluded: tuple[Touching, ...]
    allowed: tuple[Touching, ...] = ()

    @property
    def radii(self) -> Array:
        """Radii of the capsules [m], (s,)."""
        return np.array([capsule.radius for capsule in self.capsules])

    @property
    def half_lengths(self) -> Array:
        """Half lengths of the segments of the capsules [m], (s,)."""
        return np.array([float(np.linalg.norm(capsule.half_axis)) for capsule in self.capsules])

    @property
    def links(self) -> tuple[str, ...]:
        """Link of each capsule, (s,)."""
        return tuple(capsule.link for capsule in self.capsules)

    def names(self, i: int, j: int) -> tuple[str, str]:
        """Return the links of a pair of shapes."""
        return self.capsules[i].link, _link(self.robot.shapes, j)

    def is_fixed(self, link: str) -> bool:
        """Return whether no joint moves a link."""
        return self.bodies[link] == self.bodies[self.robot.root]

    @property
    def moving(self) -> frozenset[str]:
        """Links between the base and the palm, which the arm may move while the palm is fixed."""
        palm = self.bodies[self.robot.palm_link]
        hand_links = {self.robot.root} if palm == self.bodies[self.robot.root] else set[str]()
        for joint in self.robot.joints:
            if joint.parent in hand_links or self.bodies[joint.child] == palm:
                hand_links.add(joint.child)
        return frozenset(
            link for link in self.bodies if link not in hand_links and not self.is_fixed(link)
        )

    def with_excluded(self, touching: Iterable[Touching]) -> CollisionModel:
        """Return the model with further links that may touch."""
        added = tuple(touching)
        names = {frozenset(entry.links) for entry in added}
        is_checked = [frozenset(self.names(i, j)) not in names for i, j in self.pairs.tolist()]
        return CollisionModel(
            self.robot,
            self.capsules,
            self.bodies,
            self.pairs[np.array(is_checked, dtype=bool)],
            self.excluded + added,
            self.allowed,
        )

    @property
    def offsets(self) -> Array:
        """Offset of the margin of each pair: minus the allowed overlap [m], (p,)."""
        depths = {frozenset(entry.links): entry.depth for entry in self.allowed}
        return np.array([-depths.get(frozenset(self.names(i, j)), 0.0) for i, j in self.pairs])


def collision_model(robot: RobotDescription) -> CollisionModel:
    """Return the collision model of a robot.

    Pairs of links on the same body, on adjacent bodies, or that may touch are not checked.

    Raises:
        UnsupportedError: The arm or the hand has no shapes.
    """
    capsules = robot.shapes.capsules
    part_of = {joint.child: joint.part for joint in robot.joints}
    described = {part_of.get(capsule.link, "base") for capsule in capsules}
    for name in sorted({joint.part for joint in robot.movable}):
        if name not in described:
            raise UnsupportedError(
                f"robot {robot.name!r}: {name} has no shapes, which a scene requires; write "
                "'collision:' in its description (docs/collision.md)"
            )
    bodies, neighbours = rigid_bodies(robot)
    excluded: dict[frozenset[str], Touching] = {
        frozenset(entry.links): entry for entry in robot.shapes.touching if math.isinf(entry.depth)
    }

    def is_checked(first: str, second: str) -> bool:
        names = frozenset((first, second))
        if bodies[first] == bodies[second]:
            return False
        if names not in excluded and frozenset((bodies[first], bodies[second])) in neighbours:
            excluded[names] = Touching((first, second), "a joint connects the links")
        return names not in excluded

    checked_pairs = [
        pair
        for pair in _pairs(robot.shapes)
        if is_checked(capsules[pair[0]].link, _link(robot.shapes, pair[1]))
    ]
    pairs = np.array(checked_pairs, dtype=np.int32).reshape(-1, 2)
    allowed = tuple(entry for entry in robot.shapes.touching if not math.isinf(entry.depth))
    return CollisionModel(robot, capsules, bodies, pairs, tuple(excluded.values()), allowed)


def _pairs(shapes: Shapes) -> Iterator[tuple[int, int]]:
    """Yield all pairs of shapes.

    A pair consists of two capsules, or of a capsule and a solid. In a pair of two solids, the
    capsules that cover one of them represent it.
    """
    count = len(shapes.capsules)
    plain = [i for i, capsule in enumerate(shapes.capsules) if capsule.covers < 0]
    yield from combinations(plain, 2)
    for k in range(len(shapes.solids)):
        for i in plain:
            yield i, count + k
        for i, capsule in enumerate(shapes.capsules):
            if capsule.covers > k:
                yield i, count + k


def _link(shapes: Shapes, number: int) -> str:
    """Return the link of a shape by its index; capsules precede solids."""
    count = len(shapes.capsules)
    return shapes.capsules[number].link if number < count else shapes.solids[number - count].link


def shape_poses(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Return the poses of the shapes in the base frame [m] as a column.

    Each capsule has six numbers, center and half-axis of its segment; each solid has twelve,
    rotation (row-major) and origin. Capsules precede solids.
    """
    links = actuated(robot, q).kinematics.links
    fixed_joints = {joint.child: joint for joint in robot.joints if joint.type == "fixed"}

    def movable_link(link: str) -> tuple[Pose, Array]:
        placement = np.eye(4)
        while link in fixed_joints:  # Fold constants before the graph is built.
            placement = fixed_joints[link].placement @ placement
            link = fixed_joints[link].parent
        return links[link], placement

    rows = []
    for capsule in robot.shapes.capsules:
        pose, placement = movable_link(capsule.link)
        center = placement[:3, :3] @ capsule.center + placement[:3, 3]
        rows += [
            pose.origin + pose.rotate(center),
            pose.rotate(placement[:3, :3] @ capsule.half_axis),
        ]
    for solid in robot.shapes.solids:
        pose, placement = movable_link(solid.link)
        solid_pose = pose.compose(placement @ solid.pose)
        rows += [ca.vec(solid_pose.rotation.T), solid_pose.origin]
    return ca.densify(ca.vertcat(ca.SX(0, 1), *rows))


def shape_pose_size(robot: RobotDescription) -> int:
    """Return the length of the column of `shape_poses`."""
    return 6 * len(robot.shapes.capsules) + 12 * len(robot.shapes.solids)


def robot_solids(robot: RobotDescription) -> tuple[Solid, ...]:
    """Return the boxes and cylinders of a robot."""
    solids = []
    for shape in robot.shapes.solids:
        x, y, z = shape.size.tolist()
        solids.append(box((x, y, z)) if shape.kind == "box" else cylinder(x, y))
    return tuple(solids)


def pair_table(
    model: CollisionModel, scene: Scene, touching_links: Sequence[str], is_carried: bool = False
) -> PairTable:
    """Return the collision pairs of a robot and a scene.

    Args:
        model: Collision model of the robot.
        scene: The scene.
        touching_links: Links that may touch the grasped object.
        is_carried: True if the grasped object moves with the hand; it is then also checked against
            fixed links.

    Raises:
        DescriptionError: The scene names an unknown link or obstacle.
    """
    links, valid_names = model.links, set(model.robot.links) | set(scene.items)
    may_touch = {frozenset(entry.links) for entry in scene.touching}
    entries = [("touching", i, entry.links) for i, entry in enumerate(scene.touching)]
    entries += [("margins", i, tuple(pair)) for i, pair in enumerate(scene.margins)]
    for key, i, pair in entries:
        for name in sorted(set(pair) - valid_names):
            raise DescriptionError(
                f"{scene.name}: {key}[{i}].links: {name!r} is unknown; expected one of: "
                + ", ".join([*scene.items, *model.robot.links])
            )
    solids, count = robot_solids(model.robot), len(model.capsules)
    fingers = _finger_links(model.robot) if scene.enveloping else frozenset[str]()
    parts = [(obstacle, *part) for obstacle in scene.items.values() for part in obstacle.parts]
    rows: list[tuple[tuple[int, int], float, float, tuple[str, str]]] = []

    def add(pair: tuple[int, int], names: tuple[str, str], margin: float, offset: float) -> None:
        if frozenset(names) not in may_touch:
            margin = scene.margins.get(frozenset(names), margin)
            rows.append((pair, offset + (margin - scene.margin), margin, names))

    for k, (obstacle, _, _) in enumerate(parts, start=count + len(solids)):
        is_grasped = obstacle.name == scene.grasped
        for i, link in enumerate(links):
            # No solution could change the distance of two fixed shapes.
            is_fixed = model.is_fixed(link) and not (is_carried and is_grasped)
            if not is_fixed and not (is_grasped and link in touching_links):
                margin = scene.margin if obstacle.margin is None else obstacle.margin
                may_penetrate = is_grasped and link in fingers
                margin, offset = (0.0, -scene.enveloping) if may_penetrate else (margin, 0.0)
                add((i, k), (link, obstacle.name), margin, offset)
    for (i, j), offset in zip(model.pairs.tolist(), model.offsets.tolist(), strict=True):
        add((i, j), model.names(i, j), scene.margin, offset)
    return PairTable(
        radii=model.radii,
        half_lengths=model.half_lengths,
        pairs=np.array([pair for pair, _, _, _ in rows], dtype=np.int32).reshape(-1, 2),
        offsets=np.array([offset for _, offset, _, _ in rows]),
        n_robot_solids=len(solids),
        solids=(*solids, *(solid for _, solid, _ in parts)),
        placements=tuple(placement for _, _, placement in parts),
        items=tuple(obstacle.name for obstacle, _, _ in parts),
        names=tuple(names for _, _, _, names in rows),
        margins=np.array([margin for _, _, margin, _ in rows]),
        moving=model.moving,
    )


def _finger_links(robot: RobotDescription) -> frozenset[str]:
    """Return the links that joints of fingers move."""
    joints = {name for finger in robot.fingers for name in finger.joints}
    return frozenset(
        k for k in robot.links if any(joint.name in joints for joint in robot.chain(k))
    )


def check_base(model: CollisionModel, scene: Scene, shapes: Array, names: Collection[str]) -> None:
    """Refuse a scene with an obstacle in the robot's base, where every target would collide.

    Shapes enclose the base, and a table below it may touch them. A penetration by more than the
    radius of a shape is an error of the scene.

    Args:
        model: Collision model of the robot.
        scene: The scene.
        shapes: (w,) or (1, w) poses of the shapes, from `shape_poses` of one configuration.
        names: Names of the obstacles to check.

    Raises:
        DescriptionError: The axis of a capsule of the base is inside a solid.
    """
    may_touch = {frozenset(entry.links) for entry in scene.touching}
    for name in names:
        obstacle = scene.items[name]
        for i, link in enumerate(model.links):
            if not model.is_fixed(link) or frozenset((link, name)) in may_touch:
                continue
            segment = shapes.flat[6 * i : 6 * i + 6].reshape(1, 1, 6)
            depths = [
                -float(from_solid(solid, segment, pose_row(obstacle.pose @ pose)[None])[0].item())
                for solid, pose in obstacle.parts
            ]
            if max(depths) > 0:
                depth = f"is {1e3 * max(depths):.1f} mm inside"
                problem = depth if max(depths) >= 0.05e-3 else "touches"
                raise DescriptionError(
                    f"{scene.name}: solids.{name}: {problem} {link!r}, which cannot move; expected "
                    "a pose outside of the robot's base (or both names under 'touching')"
                )
