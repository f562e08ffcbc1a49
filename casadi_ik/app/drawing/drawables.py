"""What there is to draw: named shapes, made alike for pictures, for the viewer and for pages.

Every function gives drawables in a frame that it names. Pictures put them there at once; pages make
a node of the frame and move that. A view is where they are looked at from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.surfaces import (
    Shape,
    arrow,
    ball,
    coarser,
    drum,
    joined,
    mesh_of,
    ring,
    rod,
)
from casadi_ik.collision.clearance import Closest
from casadi_ik.collision.model import own_solids
from casadi_ik.collision.scene import Item, Scene
from casadi_ik.collision.solids import Solid
from casadi_ik.errors import CasadiIKError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import read_yaml
from casadi_ik.integrations.importing.imported import tree_of
from casadi_ik.integrations.importing.surfaces import Surface, link_surfaces
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.model.objects import load_object
from casadi_ik.model.parts import HAND_PREFIX
from casadi_ik.model.pose import inverse

View = tuple[float, float]
"""Azimuth about z from x, and elevation above the horizon, of the viewer [rad]."""


def axes_of(view: View) -> Array:
    """(3, 3) unit rows: to the right, up, and towards the viewer."""
    (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in view)
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def palm_places(robot: ArmHand, q: ArrayLike, *sides: str | None) -> Array:
    """(h, 3) where the palms of some hands are, or of all, base frame [m]."""
    return np.array([robot.palm(q, side)[:3, 3] for side in sides or robot.hands])


def close_view(robot: ArmHand, q: ArrayLike, *sides: str | None) -> View:
    """Where fingertips and palm are furthest apart in the image, and pads are seen from the side.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].
        sides: The hands that are looked at; none: all.
    """
    fingers = [finger for side in sides or robot.hands for finger in robot.hands[side]]
    points, normals = (values[fingers] for values in robot.contacts(q))
    links, palms = robot.links(q), palm_places(robot, q, *sides)
    palm = palms.mean(axis=0)
    joints = [joint for joint in robot.description.joints if joint.part != "hand"]
    arm = np.mean([links[joint.parent][:3, 3] for joint in joints] or [palm], axis=0)
    spots = np.concatenate([points, palms])

    def score(view: View) -> float:
        axes = axes_of(view)
        flat = spots @ axes[:2].T
        gaps = np.linalg.norm(flat[:, None] - flat[None], axis=2)
        gap = gaps[np.triu_indices(len(spots), 1)].min()
        side = 1 - np.abs(normals @ axes[2]).max()
        hidden = max(0.0, float((arm - palm) @ axes[2]))  # behind the arm
        return float(gap + 0.03 * side - 0.05 * hidden - 0.01 * abs(view[1] - 0.35))

    azimuths = np.deg2rad(np.arange(0, 360, 10)).tolist()
    return max(product(azimuths, np.deg2rad([5, 15, 25, 35]).tolist()), key=score)


def whole_view(target: Array, close: View) -> View:
    """From the side of an arm that reaches for a target, on the side of the close-up.

    Args:
        target: (3,) what is to be grasped, in the base frame [m].
        close: How the close-up is seen.
    """
    elevation = float(np.deg2rad(18.0))
    if np.hypot(target[0], target[1]) < 0.05:
        return close[0], elevation
    along = float(np.arctan2(target[1], target[0]))
    sides = (along + np.deg2rad(65.0), along - np.deg2rad(65.0))
    return max(sides, key=lambda side: float(np.cos(side - close[0]))), elevation


ARM_RADIUS, FINGER_RADIUS = 0.035, 0.009
"""Of rods that stand for links of which no shape is known [m]."""

BEYOND = 0.04
"""How far a line is drawn past what it is given by and reached at; radius of a plane's ring [m]."""


@dataclass(frozen=True, eq=False)
class Drawable:
    """A shape that is drawn.

    Attributes:
        name: What it is.
        shape: In its frame.
        color: As in `casadi_ik.app.drawing.palette`.
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


# Robots.


def bodies(robot: ArmHand) -> list[Drawable]:
    """A robot in the frames of its links, with a pad at each fingertip.

    An arm or a hand looks as the robot's files show it, else as the shapes that collisions are
    checked with; a link that has none is drawn as rods to the joints that it carries.

    Args:
        robot: The robot.
    """
    description, seen = robot.description, meshes_of(robot.description)
    looks = looks_of(description)
    shown = {looks[link][0] for link in seen}
    found = [_of_link(link, mesh_of(surface), looks) for link, surface in seen.items()]
    found += [one for one in collision_bodies(robot) if one.role not in shown]
    known, links = {one.frame for one in found}, robot.links(robot.home)
    for joint in description.joints:
        role, end = looks[joint.parent][0], inverse(links[joint.parent]) @ links[joint.child]
        if role not in shown and joint.parent not in known:
            found.append(_of_link(joint.parent, _rod_to(end[:3, 3], role), looks))
    for finger in description.fingers:
        if looks[finger.link][0] not in shown and finger.link not in known:
            found.append(_of_link(finger.link, _rod_to(finger.placement[:3, 3], "hand"), looks))
    return found + [_pad(finger) for finger in description.fingers]


def collision_bodies(robot: ArmHand) -> list[Drawable]:
    """The shapes that collisions are checked with, in the frames of links."""
    description = robot.description
    shapes, looks = description.shapes, looks_of(description)
    found = [
        (one.link, rod(one.center - one.half, one.center + one.half, one.radius))
        for one in shapes.capsules
        if one.covers < 0
    ]
    for one, solid in zip(shapes.solids, own_solids(description), strict=True):
        found.append((one.link, mesh_of(Surface(*solid.mesh())).moved(one.pose)))
    return [_of_link(link, shape, looks) for link, shape in found]


def placed(
    robot: ArmHand, q: ArrayLike, drawables: Sequence[Drawable] | None = None
) -> list[Drawable]:
    """Drawables of links (None: its bodies) at q (n,) [rad or m], in the base frame.

    Raises:
        InputError: Bad q.
    """
    poses = robot.links(q)
    return [one.at(poses[one.frame]) for one in (bodies(robot) if drawables is None else drawables)]


def lowest(robot: ArmHand, scene: Scene | None = None) -> float:
    """Height of the ground [m]: that of a robot's base, or below all of it at home and a scene."""
    things = [*placed(robot, robot.home), *([] if scene is None else scene_of(scene))]
    return min(0.0, min(float(one.surface.points[:, 2].min()) for one in things) - 1e-3)


def merged(drawables: Sequence[Drawable]) -> list[Drawable]:
    """Those of one frame and colour as one mesh each: fewer things to be moved."""
    groups: dict[tuple[str, str], list[Drawable]] = {}
    for one in drawables:
        groups.setdefault((one.frame, one.color), []).append(one)
    return [
        replace(many[0], shape=mesh_of(joined([one.surface for one in many])))
        for many in groups.values()
    ]


def looks_of(description: RobotDescription) -> dict[str, tuple[str, str]]:
    """By link "arm" or "hand", and its colour, another than that of the link before it."""
    palms = {description.palm_link, *(side.palm_link for side in description.sides)}
    alone = not (description.arm_actuators or description.sides)
    depth, roles = {description.root: 0}, {description.root: "hand" if alone else "arm"}
    for joint in description.joints:
        depth[joint.child] = depth[joint.parent] + 1
        roles[joint.child] = "hand" if joint.part == "hand" or joint.child in palms else "arm"
    colors = {"arm": (palette.ARM_JOINT, palette.ARM), "hand": (palette.HAND, palette.PALM)}
    return {link: (role, colors[role][depth[link] % 2]) for link, role in roles.items()}


def _of_link(link: str, shape: Shape, looks: Mapping[str, tuple[str, str]]) -> Drawable:
    role, color = looks[link]
    return Drawable(link, shape, color, link, role)


def _rod_to(end: Array, role: str) -> Shape:
    return rod(np.zeros(3), end, ARM_RADIUS if role == "arm" else FINGER_RADIUS)


def _pad(finger: Finger) -> Drawable:
    """A disc; the pad's height above the axis of its link says how large it is."""
    normal = finger.placement[:3, :3] @ finger.normal
    height = float(finger.placement[:3, 3] @ normal)
    radius = height if 0.004 < height < 0.02 else FINGER_RADIUS
    center = finger.placement[:3, 3] - 0.13 * radius * normal
    pad = drum(center, normal, 0.62 * radius, 0.36 * radius)
    return Drawable(f"pad {finger.name}", pad, palette.PAD, finger.link, "pad")


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
        prefix = HAND_PREFIX if key == "hand" else ""
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


def item_of(item: Item) -> list[Drawable]:
    """Something that stands in a scene, in its frame; without end, the part near the base."""
    near = inverse(item.pose)[:3, 3]
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


def scene_of(scene: Scene, without: str = "") -> list[Drawable]:
    """Everything of a scene but an object that is drawn by itself, in the base frame."""
    drawn = {without} if object_of(without) is not None else set[str]()
    items = [item for name, item in scene.items.items() if name not in drawn]
    return [one.at(item.pose) for item in items for one in item_of(item)]


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
