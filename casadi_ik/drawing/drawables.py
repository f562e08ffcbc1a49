"""What there is to draw: named shapes, made alike for pictures, for the viewer and for pages.

Every function gives drawables in a frame that it names. Pictures put them there at once; pages make
a node of the frame and move that. `Drawable.data` is what a page takes, as JSON.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.model import own_solids
from casadi_ik.collision.scene import Item, Scene
from casadi_ik.collision.solids import Solid
from casadi_ik.drawing.surfaces import (
    Shape,
    arrow,
    ball,
    coarser,
    drum,
    joined,
    mesh_of,
    ring,
    rod,
    stretched,
)
from casadi_ik.errors import CasadiIKError, UnknownNameError
from casadi_ik.files.reading import read_yaml
from casadi_ik.grasps import Contact, Grasp, load_object
from casadi_ik.grasps.pose import inverse
from casadi_ik.importing.imported import tree_of
from casadi_ik.importing.surfaces import Surface, link_surfaces
from casadi_ik.problem.clearance import Closest
from casadi_ik.robots.description import Finger, Joint, RobotDescription
from casadi_ik.robots.parts import PREFIX

ARM_RADIUS, FINGER_RADIUS = 0.048, 0.009
"""Of an arm's tubes, and of a finger whose pad does not say how far from its axis it is [m]."""

MOUNT = 0.09
"""How much of what holds a hand is thinner than the arm, or it would hide the palm [m]."""

BEYOND = 0.04
"""How far a line is drawn past what it is given by and reached at; radius of a plane's ring [m]."""


@dataclass(frozen=True, eq=False)
class Drawable:
    """A shape that is drawn.

    Attributes:
        name: What it is.
        shape: In its frame.
        color: As in `casadi_ik.palette`.
        frame: The frame that it moves with: a link, or "" for the base frame.
        role: What it belongs to: "arm", "hand", "pad", "object", "scene", "target", "reached",
            "missed" or "nearest".
    """

    name: str
    shape: Shape
    color: str
    frame: str = ""
    role: str = ""

    @property
    def surface(self) -> Surface:
        """Its triangles, in its frame."""
        return self.shape.surface

    def at(self, pose: Array) -> Drawable:
        """The same in the base frame, in which its frame has a (4, 4) pose."""
        return replace(self, shape=self.shape.moved(pose), frame="")

    def data(self) -> dict[str, Any]:
        """Name, role, colour, frame and shape as JSON has them."""
        own = {"name": self.name, "role": self.role, "color": self.color, "frame": self.frame}
        return own | self.shape.data()


# Robots.


def side_of(description: RobotDescription) -> dict[str, str]:
    """By link "arm" or "hand"."""
    first = "arm" if description.arm_actuators else "hand"
    return {description.root: first} | {
        joint.child: "hand"
        if joint.part == "hand" or joint.child == description.palm_link
        else "arm"
        for joint in description.joints
    }


def bodies(robot: ArmHand, q: ArrayLike | None = None) -> list[Drawable]:
    """A robot in the frames of its links, with a pad at each fingertip.

    The links are those that the robot's files show. An arm or a hand of which they show nothing is
    drawn by its kinematics: thick tubes for an arm, thin ones for a hand, a palm. That is not the
    real shell, but any robot has one.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m]: what slides is as long as it is there; None: home.

    Raises:
        InputError: Bad q.
    """
    description = robot.description
    sides, meshes = side_of(description), meshes_of(description)
    shown = {sides[link] for link in meshes}
    found = [one for one in _skeleton(robot, q) if one.role not in shown]
    for link, surface in meshes.items():
        dark = palette.PALM if link == description.palm_link else palette.HAND
        color = _alternating(description, link) if sides[link] == "arm" else dark
        found.append(Drawable(link, mesh_of(surface), color, link, sides[link]))
    return found + [_pad(finger) for finger in description.fingers]


def collision_bodies(robot: ArmHand) -> list[Drawable]:
    """The shapes that collisions are checked with, in the frames of links."""
    description = robot.description
    shapes, sides = description.shapes, side_of(description)
    found = [
        (one.link, rod(one.center - one.half, one.center + one.half, one.radius))
        for one in shapes.capsules
        if one.covers < 0
    ]
    for one, solid in zip(shapes.solids, own_solids(description), strict=True):
        found.append((one.link, mesh_of(Surface(*solid.mesh())).moved(one.pose)))

    def color(link: str) -> str:
        return _alternating(description, link) if sides[link] == "arm" else palette.HAND

    return [Drawable(link, shape, color(link), link, sides[link]) for link, shape in found]


def placed(robot: ArmHand, q: ArrayLike, drawables: Sequence[Drawable]) -> list[Drawable]:
    """Drawables of links where they are at q (n,) [rad or m], in the base frame."""
    poses = robot.links(q)
    return [one.at(poses[one.frame]) for one in drawables]


def merged(drawables: Sequence[Drawable]) -> list[Drawable]:
    """Those of one frame and colour as one mesh each: fewer things to be moved."""
    groups: dict[tuple[str, str], list[Drawable]] = {}
    for one in drawables:
        groups.setdefault((one.frame, one.color), []).append(one)
    return [
        replace(many[0], shape=mesh_of(joined([one.surface for one in many])))
        for many in groups.values()
    ]


def _alternating(description: RobotDescription, link: str) -> str:
    return palette.ARM_JOINT if description.links.index(link) % 2 == 0 else palette.ARM


def _skeleton(robot: ArmHand, q: ArrayLike | None) -> list[Drawable]:
    description = robot.description
    poses = robot.links(robot.configuration(q))
    found = [*_foot(description), *_palm(description, poses)]
    for joint in description.joints:
        end = (inverse(poses[joint.parent]) @ poses[joint.child])[:3, 3]
        link = _finger_link if joint.part == "hand" else _arm_link
        found += link(description, joint, end)
    for finger in description.fingers:
        radius = _pad_radius(finger)
        place, normal = finger.placement[:3, 3], finger.placement[:3, :3] @ finger.normal
        tip = rod(np.zeros(3), place - radius * normal, radius)
        found.append(Drawable(f"tip {finger.name}", tip, palette.HAND, finger.link, "hand"))
    return found


def _pad_radius(finger: Finger) -> float:
    """How far the pad is from the axis of the last link, along the normal [m]."""
    height = float(finger.placement[:3, 3] @ finger.placement[:3, :3] @ finger.normal)
    return height if 0.004 < height < 0.02 else FINGER_RADIUS


def _pad(finger: Finger) -> Drawable:
    radius, normal = _pad_radius(finger), finger.placement[:3, :3] @ finger.normal
    center = finger.placement[:3, 3] - 0.13 * radius * normal
    pad = drum(center, normal, 0.62 * radius, 0.36 * radius)
    return Drawable(f"pad {finger.name}", pad, palette.PAD, finger.link, "pad")


def _foot(description: RobotDescription) -> list[Drawable]:
    """Of an arm; a hand alone stands on its palm."""
    if not description.arm_actuators:
        return []
    z = np.array([0.0, 0.0, 1.0])
    foot = drum(0.0125 * z, z, 1.9 * ARM_RADIUS, 0.025)
    return [Drawable("foot", foot, palette.ARM_JOINT, description.root, "arm")]


def _arm_link(description: RobotDescription, joint: Joint, end: Array) -> list[Drawable]:
    found, length = [], float(np.linalg.norm(end))
    if length > 2e-3:
        # The round end of the lowest link must not come out below the foot.
        lowest = joint.parent == description.root
        begin = min(1.0, ARM_RADIUS / length) * end if lowest else np.zeros(3)
        thin = min(MOUNT, length) if joint.part == "mount" else 0.0
        middle = (1 - thin / length) * end
        if thin < length:
            tube = rod(begin, middle, ARM_RADIUS)
            found.append(Drawable(f"tube {joint.name}", tube, palette.ARM, joint.parent, "arm"))
        if thin > 0:
            tube = rod(middle, end, 0.6 * ARM_RADIUS)
            found.append(Drawable("mount", tube, palette.ARM_JOINT, joint.parent, "arm"))
    if joint.type == "revolute":
        # A roll joint is a band around the tube, a pitch joint a drum across it.
        way = joint.placement[:3, :3].T @ end
        along = length > 2e-3 and abs(joint.axis @ way) > 0.9 * length
        radius, width = (1.09, 0.35) if along else (1.12, 2.5)
        band = drum(np.zeros(3), joint.axis, radius * ARM_RADIUS, width * ARM_RADIUS)
        found.append(Drawable(joint.name, band, palette.ARM_JOINT, joint.child, "arm"))
    return found


def _finger_link(description: RobotDescription, joint: Joint, end: Array) -> list[Drawable]:
    found = []
    if joint.parent != description.palm_link and np.linalg.norm(end) > 2e-3:
        tube = rod(np.zeros(3), end, 1.15 * FINGER_RADIUS)
        found.append(Drawable(f"tube {joint.name}", tube, palette.HAND, joint.parent, "hand"))
    if joint.type == "revolute":
        knuckle = drum(np.zeros(3), joint.axis, 1.3 * FINGER_RADIUS, 2.7 * FINGER_RADIUS)
        found.append(Drawable(joint.name, knuckle, palette.HAND_JOINT, joint.child, "hand"))
    return found


def _palm(description: RobotDescription, poses: Mapping[str, Array]) -> list[Drawable]:
    """Drums upright in the palm frame, at the palm's origin and where the fingers begin, in one."""
    link = description.palm_link
    back = inverse(poses[link])
    bases = [
        (back @ poses[joint.child])[:3, 3]
        for joint in description.joints
        if joint.part == "hand" and joint.parent == link
    ]
    if not bases:
        return []
    corners, up = np.array([np.zeros(3), *bases]), description.palm_placement[:3, 2]
    heights, radius = corners @ up, 2.2 * FINGER_RADIUS
    middle = (heights.min() + heights.max()) / 2 * up
    block = drum(middle, up, radius, max(float(np.ptp(heights)), 2 * radius))
    body = stretched(block.surface, corners - heights[:, None] * up)
    return [Drawable("palm", mesh_of(body), palette.PALM, link, "hand")]


@lru_cache(maxsize=8)
def meshes_of(description: RobotDescription) -> dict[str, Surface]:
    """By link what the files show that a description points to, coarse enough to be drawn."""
    try:
        found = {} if description.path is None else file_meshes(description, seen=True)
    except CasadiIKError:  # the files are gone, the kinematics are not
        return {}
    return {link: coarser(one) for link, one in found.items() if len(one.triangles)}


def file_meshes(description: RobotDescription, seen: bool = False) -> dict[str, Surface]:
    """Shapes that the files have to which a description points.

    Args:
        description: The robot; it was read from a file.
        seen: Whether those that are seen are wanted, else those for collisions.

    Returns:
        By link its surface in its frame; links of which no file has a shape are left out.

    Raises:
        CasadiIKError: A file cannot be read.
    """
    path = description.path
    assert path is not None
    raw, links = read_yaml(path), set(description.links)
    found: dict[str, Surface] = {}
    for key in ("arm", "hand", "robot"):
        entry = raw.get(key)
        if not isinstance(entry, dict) or "file" not in entry:
            continue
        prefix = PREFIX if key == "hand" else ""
        # A name that arm and hand both have is prefixed in the hand.
        named = {link.removeprefix(prefix) if prefix else link: link for link in links}
        named |= {link: link for link in links if f"{prefix}{link}" not in links or not prefix}
        surfaces, _ = link_surfaces(tree_of(path, entry), list(named), seen)
        for link, surface in surfaces.items():
            found.setdefault(named[link], surface)
    return found


# Contacts.


def target_place(contact: Contact, tip: Array) -> Array:
    """(3,) of the places a contact allows the nearest to a fingertip (3,) [m]."""
    if np.isnan(contact.point[0]):
        return tip
    gap = tip - contact.point
    if contact.line is not None:
        return contact.point + contact.line * (contact.line @ gap)
    if contact.plane is not None:
        return tip - contact.plane * (contact.plane @ gap)
    return contact.point


def asked_marks(contact: Contact, tip: Array, size: float = 1.0) -> list[Drawable]:
    """What a contact asks for: thick and short marks, in the contact's frame.

    A line is a rod, a plane a ring about the place in it that is nearest to the fingertip; second
    axes have arrows shorter than the normals'. Where the fingertip may be anywhere, what it must
    face is drawn where it is.

    Args:
        contact: The contact.
        tip: (3,) where the fingertip is [m].
        size: Of balls and arrows, as a part of the usual.
    """
    place, found = target_place(contact, tip), {}
    if contact.line is not None:
        along = float(contact.line @ (place - contact.point))
        low, high = min(0.0, along) - BEYOND, max(0.0, along) + BEYOND
        start, end = (contact.point + t * contact.line for t in (low, high))
        found["line"] = rod(start, end, 0.0020)
    elif contact.plane is not None:
        found["plane"] = ring(place, contact.plane, BEYOND, 0.0016)
    elif not np.isnan(contact.point[0]):
        found["point"] = ball(0.0036 * size, place)
    facing = contact.ball if contact.normal is None else contact.normal
    if facing is not None:
        found["normal"] = arrow(place, facing, 0.030 * size, 0.0048 * size)
    if contact.tangent is not None:
        found["tangent"] = arrow(place, contact.tangent, 0.021 * size, 0.0048 * size)
    return [Drawable(name, one, palette.TARGET, role="target") for name, one in found.items()]


def reached_marks(color: str, tangent: bool = False) -> list[Drawable]:
    """What a finger reaches: thin and long arrows, in the frame of its contact (x its normal)."""
    x, y, _ = np.eye(3)
    parts = [ball(0.0042), arrow(np.zeros(3), x, 0.046, 0.0022)]
    if tangent:
        parts.append(arrow(np.zeros(3), y, 0.034, 0.0022))
    return [Drawable("reached", part, color, role="reached") for part in parts]


def contact_marks(
    robot: ArmHand, q: ArrayLike, grasp: Grasp, colors: Mapping[str, str]
) -> list[Drawable]:
    """Contacts asked for and reached, and a line to those that are missed, in the base frame.

    Args:
        robot: The robot.
        q: (n,) where it is [rad or m].
        grasp: What is asked for.
        colors: Of what is reached, by finger; `palette.MISSED` of what is missed.

    Raises:
        InputError: The grasp has a finger that the robot has not.
    """
    grasp.arrays(robot.fingers)
    found: list[Drawable] = []
    for finger, frame in zip(robot.fingers, robot.contact_frames(q), strict=True):
        contact, tip = grasp.contacts.get(finger), frame[:3, 3]
        if contact is not None:
            found += asked_marks(contact, tip)
            reached = reached_marks(colors[finger], contact.tangent is not None)
            found += [one.at(frame) for one in reached]
            if colors[finger] == palette.MISSED:
                gap = rod(tip, target_place(contact, tip), 0.0006)
                found.append(Drawable("gap", gap, palette.MISSED, role="missed"))
    return found


# Things.


def object_of(name: str) -> Drawable | None:
    """The object that is grasped, in its frame; None: there is no description of it.

    Raises:
        DescriptionError: Its description is malformed.
    """
    if not name:
        return None
    try:
        points, triangles = load_object(name).mesh(64)
    except UnknownNameError:
        return None
    shape = mesh_of(Surface(points, np.asarray(triangles, np.int64)))
    return Drawable("object", shape, palette.OBJECT, role="object")


def item_of(item: Item, about: Array) -> list[Drawable]:
    """Something that stands in a scene, in its frame.

    Args:
        item: The thing.
        about: (3,) what reaches without end is drawn near this, base frame [m].
    """
    near = (inverse(item.pose) @ np.append(about, 1.0))[:3]
    return [
        Drawable(f"{item.name} {i}", _placed(solid, place, near), palette.SCENE, role="scene")
        for i, (solid, place) in enumerate(item.parts)
    ]


def _placed(solid: Solid, pose: Array, near: Array) -> Shape:
    """A solid at a (4, 4) pose; of one that reaches without end the part near a point (3,)."""
    surface = Surface(*solid.mesh())
    if not np.isfinite(solid.reach):
        x, y, _ = pose[:3, :3].T @ (near - pose[:3, 3])
        surface = Surface(surface.points + np.array([x, y, 0.0]), surface.triangles)
    return mesh_of(surface).moved(pose)


def scene_of(scene: Scene, about: Array, without: str = "") -> list[Drawable]:
    """Everything of a scene but an object that is drawn by itself, in the base frame."""
    drawn = {without} if object_of(without) is not None else set[str]()
    items = [item for name, item in scene.items.items() if name not in drawn]
    return [one.at(item.pose) for item in items for one in item_of(item, about)]


def with_object(scene: Scene, grasp: Grasp | None) -> Scene:
    """The scene with what a grasp names as its object where it has it."""
    if grasp is not None and grasp.object and grasp.known_pose is not None:
        return scene.holding(grasp.object, grasp.known_pose)
    return scene


def nearest_pair(closest: Closest, touching: bool = False) -> list[Drawable]:
    """A rod between the nearest points of two shapes, a ball at each end, in the base frame.

    Args:
        closest: The pair.
        touching: Whether the two shapes are drawn instead, a millimetre larger to be seen; not
            what reaches without end.
    """
    start, end = closest.ends
    shapes = [rod(start, end, 0.0012), ball(0.0022, start), ball(0.0022, end)]
    if touching:
        shapes = []
        for solid, pose in closest.shapes:
            if np.isfinite(solid.reach):
                points, triangles = solid.mesh()
                larger = Surface(points * (1 + 1e-3 / solid.reach), triangles)
                shapes.append(mesh_of(larger).moved(pose))
    return [Drawable("nearest", one, palette.NEAREST, role="nearest") for one in shapes]
