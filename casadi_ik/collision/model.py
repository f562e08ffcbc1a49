"""The shapes of a robot, and which of them are checked against each other and against a scene."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import Table, from_solid, pose_row
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Solid, box, cylinder
from casadi_ik.errors import DescriptionError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Pose, actuated
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.link_shapes import LinkCapsule, Shapes, Touching
from casadi_ik.model.linkage import rigid_bodies


@dataclass(frozen=True, eq=False)
class CollisionModel:
    """A robot's capsules.

    Attributes:
        robot: The description.
        capsules: Its capsules.
        bodies: By link the link it is fixed to that moves, or the root.
        pairs: (p, 2) what is checked against each other: a capsule; another, or a solid of the
            robot, counted on behind the capsules.
        excluded: Links that are not, and why.
        allowed: Links that are, but may overlap a little, and why.
    """

    robot: RobotDescription
    capsules: tuple[LinkCapsule, ...]
    bodies: dict[str, str]
    pairs: NDArray[np.int32]
    excluded: tuple[Touching, ...]
    allowed: tuple[Touching, ...] = ()

    @property
    def radii(self) -> Array:
        """(s,) radii [m]."""
        return np.array([one.radius for one in self.capsules])

    @property
    def halves(self) -> Array:
        """(s,) half lengths of the segments [m]."""
        return np.array([float(np.linalg.norm(one.half)) for one in self.capsules])

    @property
    def links(self) -> tuple[str, ...]:
        """(s,) the link of each capsule."""
        return tuple(one.link for one in self.capsules)

    def names(self, i: int, j: int) -> tuple[str, str]:
        """The links of a pair."""
        return self.capsules[i].link, _link(self.robot.shapes, j)

    def is_fixed(self, link: str) -> bool:
        """Whether a link cannot move."""
        return self.bodies[link] == self.bodies[self.robot.root]

    @property
    def moving(self) -> frozenset[str]:
        """Links that the arm may move while the palm stays: between the base and the palm."""
        palm = self.bodies[self.robot.palm_link]
        carried = {self.robot.root} if palm == self.bodies[self.robot.root] else set[str]()
        for joint in self.robot.joints:
            if joint.parent in carried or self.bodies[joint.child] == palm:
                carried.add(joint.child)
        return frozenset(
            link for link in self.bodies if link not in carried and not self.is_fixed(link)
        )

    def without(self, more: Iterable[Touching]) -> CollisionModel:
        """The same with more links that may touch."""
        added = tuple(more)
        names = {frozenset(one.links) for one in added}
        kept = [frozenset(self.names(i, j)) not in names for i, j in self.pairs.tolist()]
        return CollisionModel(
            self.robot,
            self.capsules,
            self.bodies,
            self.pairs[np.array(kept, dtype=bool)],
            self.excluded + added,
            self.allowed,
        )

    @property
    def offsets(self) -> Array:
        """(p,) what is added to what a pair has to be apart: minus what it may overlap [m]."""
        depths = {frozenset(one.links): one.depth for one in self.allowed}
        return np.array([-depths.get(frozenset(self.names(i, j)), 0.0) for i, j in self.pairs])


def collision_model(robot: RobotDescription) -> CollisionModel:
    """The model of a robot: all pairs but those of one body, of neighbours, and that may touch.

    Raises:
        UnsupportedError: The arm or the hand has no shapes.
    """
    capsules = robot.shapes.capsules
    part = {joint.child: joint.part for joint in robot.joints}
    described = {part.get(one.link, "base") for one in capsules}
    for name in sorted({joint.part for joint in robot.movable}):
        if name not in described:
            raise UnsupportedError(
                f"robot {robot.name!r}: its {name} has no shapes, which a scene needs; write "
                "'collision:' in its description (docs/collision.md)"
            )
    bodies, neighbours = rigid_bodies(robot)
    excluded: dict[frozenset[str], Touching] = {
        frozenset(one.links): one for one in robot.shapes.touching if math.isinf(one.depth)
    }

    def checked(one: str, other: str) -> bool:
        names = frozenset((one, other))
        if bodies[one] == bodies[other]:
            return False
        if names not in excluded and frozenset((bodies[one], bodies[other])) in neighbours:
            excluded[names] = Touching((one, other), "a joint holds them together")
        return names not in excluded

    found = [
        pair
        for pair in _pairs(robot.shapes)
        if checked(capsules[pair[0]].link, _link(robot.shapes, pair[1]))
    ]
    pairs = np.array(found, dtype=np.int32).reshape(-1, 2)
    allowed = tuple(one for one in robot.shapes.touching if not math.isinf(one.depth))
    return CollisionModel(robot, capsules, bodies, pairs, tuple(excluded.values()), allowed)


def _pairs(shapes: Shapes) -> Iterator[tuple[int, int]]:
    """All pairs of shapes: capsule and capsule, capsule and solid; of two solids one's capsules."""
    count = len(shapes.capsules)
    itself = [i for i, one in enumerate(shapes.capsules) if one.covers < 0]
    yield from combinations(itself, 2)
    for k in range(len(shapes.solids)):
        for i in itself:
            yield i, count + k
        for i, one in enumerate(shapes.capsules):
            if one.covers > k:
                yield i, count + k


def _link(shapes: Shapes, number: int) -> str:
    """The link of a capsule, or of a solid behind them."""
    count = len(shapes.capsules)
    return shapes.capsules[number].link if number < count else shapes.solids[number - count].link


def placed(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Where the shapes are, base frame [m], one below the other.

    Six numbers for each capsule: middle and half of its segment; then twelve for each solid: its
    rotation row by row and its origin.
    """
    links = actuated(robot, q).kinematics.links
    holders = {joint.child: joint for joint in robot.joints if joint.type == "fixed"}

    def held(link: str) -> tuple[Pose, Array]:
        place = np.eye(4)
        while link in holders:  # constants fold before the graph is made
            place = holders[link].placement @ place
            link = holders[link].parent
        return links[link], place

    rows = []
    for one in robot.shapes.capsules:
        pose, place = held(one.link)
        center = place[:3, :3] @ one.center + place[:3, 3]
        rows += [pose.origin + pose.rotate(center), pose.rotate(place[:3, :3] @ one.half)]
    for solid in robot.shapes.solids:
        pose, place = held(solid.link)
        whole = pose.at(place @ solid.pose)
        rows += [ca.vec(whole.rotation.T), whole.origin]
    return ca.densify(ca.vertcat(ca.SX(0, 1), *rows))


def size_of(robot: RobotDescription) -> int:
    """How many numbers `placed` gives."""
    return 6 * len(robot.shapes.capsules) + 12 * len(robot.shapes.solids)


def own_solids(robot: RobotDescription) -> tuple[Solid, ...]:
    """The robot's boxes and cylinders."""
    found = []
    for one in robot.shapes.solids:
        x, y, z = one.size.tolist()
        found.append(box((x, y, z)) if one.kind == "box" else cylinder(x, y))
    return tuple(found)


def pair_table(
    model: CollisionModel, scene: Scene, touched_by: Sequence[str], carried: bool = False
) -> Table:
    """The pairs of a robot and a scene.

    Args:
        model: The robot's shapes.
        scene: What stands about it.
        touched_by: Links that may touch what is grasped.
        carried: Whether what is grasped moves with the hand: then links that cannot move count.

    Raises:
        DescriptionError: The scene speaks of a link or a solid that is not there, or of one that
            stands in the robot's base.
    """
    links, known = model.links, set(model.robot.links) | set(scene.items)
    stated = {frozenset(one.links) for one in scene.touching}
    named = [("touching", i, one.links) for i, one in enumerate(scene.touching)]
    named += [("margins", i, tuple(pair)) for i, pair in enumerate(scene.margins)]
    for key, i, pair in named:
        for name in sorted(set(pair) - known):
            raise DescriptionError(
                f"{scene.name}: {key}[{i}].links: unknown {name!r}; known: "
                + ", ".join([*scene.items, *model.robot.links])
            )
    own, count = own_solids(model.robot), len(model.capsules)
    fingers = _finger_links(model.robot) if scene.enveloping else frozenset[str]()
    parts = [(item, *part) for item in scene.items.values() for part in item.parts]
    rows: list[tuple[tuple[int, int], float, float, tuple[str, str]]] = []

    def add(pair: tuple[int, int], names: tuple[str, str], usual: float, overlap: float) -> None:
        if frozenset(names) not in stated:
            margin = scene.margins.get(frozenset(names), usual)
            rows.append((pair, overlap + (margin - scene.margin), margin, names))

    for k, (item, _, _) in enumerate(parts, start=count + len(own)):
        grasped = item.name == scene.grasped
        for i, link in enumerate(links):
            # What cannot move is where it was put: no answer could change that.
            fixed = model.is_fixed(link) and not (carried and grasped)
            if not fixed and not (grasped and link in touched_by):
                usual = scene.margin if item.margin is None else item.margin
                deep = grasped and link in fingers
                usual, overlap = (0.0, -scene.enveloping) if deep else (usual, 0.0)
                add((i, k), (link, item.name), usual, overlap)
    for (i, j), overlap in zip(model.pairs.tolist(), model.offsets.tolist(), strict=True):
        add((i, j), model.names(i, j), scene.margin, overlap)
    return Table(
        radii=model.radii,
        halves=model.halves,
        pairs=np.array([pair for pair, _, _, _ in rows], dtype=np.int32).reshape(-1, 2),
        offsets=np.array([offset for _, offset, _, _ in rows]),
        own=len(own),
        solids=(*own, *(solid for _, solid, _ in parts)),
        places=tuple(place for _, _, place in parts),
        items=tuple(item.name for item, _, _ in parts),
        names=tuple(names for _, _, _, names in rows),
        margins=np.array([margin for _, _, margin, _ in rows]),
        moving=model.moving,
    )


def _finger_links(robot: RobotDescription) -> frozenset[str]:
    """Links that joints of fingers move."""
    joints = {name for finger in robot.fingers for name in finger.joints}
    return frozenset(k for k in robot.links if any(one.name in joints for one in robot.chain(k)))


def check_base(model: CollisionModel, scene: Scene, where: Array, names: Collection[str]) -> None:
    """Refuse a scene with something in the robot's base: all would be in collision.

    A base's shapes are larger than the base, so that a table under it may touch them; what is
    deeper than a shape's radius is meant by nobody.

    Args:
        model: The robot's shapes.
        scene: The scene.
        where: Where the shapes are, as `placed` gives it.
        names: The items that are looked at.

    Raises:
        DescriptionError: The middle line of a shape of the base is inside a solid.
    """
    stated = {frozenset(one.links) for one in scene.touching}
    for name in names:
        item = scene.items[name]
        for i, link in enumerate(model.links):
            if not model.is_fixed(link) or frozenset((link, name)) in stated:
                continue
            segment = where[6 * i : 6 * i + 6].reshape(1, 1, 6)
            depths = [
                -float(from_solid(solid, segment, pose_row(item.pose @ place)[None])[0].item())
                for solid, place in item.parts
            ]
            if max(depths) > 0:
                deep = f"stands {1e3 * max(depths):.1f} mm inside"
                how = deep if max(depths) >= 0.05e-3 else "touches"
                raise DescriptionError(
                    f"{scene.name}: solids.{name}: {how} {link!r}, which cannot move; "
                    "expected it beside the robot's base (or the two under 'touching')"
                )
