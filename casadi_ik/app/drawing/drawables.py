"""Geometry to draw: named, coloured shapes for pictures, the viewer and web pages.

Every function returns drawables in a frame that it documents. Pictures place them directly; pages
create a scene node per frame and move the node. A view is a viewing direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.surfaces import (
    Shape,
    arrow,
    ball,
    drum,
    join_surfaces,
    mesh_shape,
    ring,
    rod,
)
from casadi_ik.app.drawing.visual_meshes import visual_meshes
from casadi_ik.collision.clearance import ClosestPoints
from casadi_ik.collision.model import robot_solids
from casadi_ik.collision.scene import Obstacle, Scene
from casadi_ik.collision.solids import Solid
from casadi_ik.errors import UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.model.objects import load_object
from casadi_ik.model.pose import inverse

View = tuple[float, float]
"""Azimuth of the viewer about z, from x, and elevation above the horizon [rad]."""


def view_axes(view: View) -> Array:
    """Return the (3, 3) unit axes of a view as rows: right, up, and towards the viewer."""
    (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in view)
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def palm_positions(robot: ArmHand, q: ArrayLike, *sides: str | None) -> Array:
    """Return the (h, 3) palm positions of the given sides, or of all, in the base frame [m]."""
    return np.array([robot.palm(q, side)[:3, 3] for side in sides or robot.hands])


def close_view(robot: ArmHand, q: ArrayLike, *sides: str | None) -> View:
    """Return the view that separates fingertips and palm best and shows the pads from the side.

    Args:
        robot: The robot.
        q: (n,) Configuration [rad or m].
        sides: Sides whose hands are shown; empty: all.
    """
    fingers = [
        finger for pad_visibility in sides or robot.hands for finger in robot.hands[pad_visibility]
    ]
    points, normals = (values[fingers] for values in robot.contacts(q))
    links, palms = robot.links(q), palm_positions(robot, q, *sides)
    palm = palms.mean(axis=0)
    joints = [joint for joint in robot.description.joints if joint.part != "hand"]
    arm = np.mean([links[joint.parent][:3, 3] for joint in joints] or [palm], axis=0)
    markers = np.concatenate([points, palms])

    def score(view: View) -> float:
        axes = view_axes(view)
        projected = markers @ axes[:2].T
        gaps = np.linalg.norm(projected[:, None] - projected[None], axis=2)
        gap = gaps[np.triu_indices(len(markers), 1)].min()
        pad_visibility = 1 - np.abs(normals @ axes[2]).max()
        occlusion = max(0.0, float((arm - palm) @ axes[2]))  # by the arm
        return float(gap + 0.03 * pad_visibility - 0.05 * occlusion - 0.01 * abs(view[1] - 0.35))

    azimuths = np.deg2rad(np.arange(0, 360, 10)).tolist()
    return max(product(azimuths, np.deg2rad([5, 15, 25, 35]).tolist()), key=score)


def overview(target: Array, close_up: View) -> View:
    """Return a view from the side of an arm that reaches for a target.

    The side closer to the azimuth of the close-up is chosen.

    Args:
        target: (3,) Position of the target in the base frame [m].
        close_up: View of the close-up.
    """
    elevation = float(np.deg2rad(18.0))
    if np.hypot(target[0], target[1]) < 0.05:
        return close_up[0], elevation
    azimuth = float(np.arctan2(target[1], target[0]))
    sides = (azimuth + np.deg2rad(65.0), azimuth - np.deg2rad(65.0))
    return max(sides, key=lambda side: float(np.cos(side - close_up[0]))), elevation


ARM_RADIUS, FINGER_RADIUS = 0.035, 0.009
"""Radii of the rods that represent links without a known shape [m]."""

MARK_EXTENT = 0.04
"""Length by which a line extends past its ends, and radius of a plane's ring [m]."""


@dataclass(frozen=True, eq=False)
class Drawable:
    """A coloured shape in a frame.

    Attributes:
        name: Name of the shape.
        shape: Shape in the frame `frame`.
        color: Colour as in `casadi_ik.app.drawing.palette`.
        frame: Link that the shape moves with; "" for the base frame.
        role: Kind of thing: "arm", "hand", "pad", "object", "scene", "target", "reached",
            "missed" or "nearest".
    """

    name: str
    shape: Shape
    color: str
    frame: str = ""
    role: str = ""

    @property
    def surface(self) -> IndexedMesh:
        """Triangles in the frame of the drawable."""
        return self.shape.surface

    def transformed(self, pose: Array) -> Drawable:
        """Return the drawable in the base frame, given the (4, 4) pose of its frame."""
        return replace(self, shape=self.shape.transformed(pose), frame="")


# Robots.


def visual_bodies(robot: ArmHand) -> list[Drawable]:
    """Return the visual geometry of a robot in the frames of its links, with a pad per fingertip.

    Links are drawn as the meshes of the robot's files or of installed packages (see
    `casadi_ik.app.drawing.visual_meshes`), otherwise as collision shapes, otherwise as rods to
    their child joints.

    Args:
        robot: The robot.
    """
    description, meshes = robot.description, visual_meshes(robot.description)
    styles, covered = link_styles(description), meshes.covered_links
    drawables = [
        _link_drawable(link, mesh_shape(part.mesh), styles, part.color)
        for link, parts in meshes.by_link.items()
        for part in parts
    ]
    drawables += [body for body in collision_bodies(robot) if body.frame not in covered]
    drawn_links = covered | {drawable.frame for drawable in drawables}
    links = robot.links(robot.home)
    for joint in description.joints:
        if joint.parent not in drawn_links:
            role, end = styles[joint.parent][0], inverse(links[joint.parent]) @ links[joint.child]
            drawables.append(_link_drawable(joint.parent, _link_rod(end[:3, 3], role), styles))
    for finger in description.fingers:
        if finger.link not in drawn_links:
            drawables.append(
                _link_drawable(finger.link, _link_rod(finger.placement[:3, 3], "hand"), styles)
            )
    return drawables + [_pad(finger) for finger in description.fingers]


def collision_bodies(robot: ArmHand) -> list[Drawable]:
    """Return the collision shapes in the frames of their links."""
    description = robot.description
    shapes, styles = description.shapes, link_styles(description)
    link_shapes = [
        (
            capsule.link,
            rod(
                capsule.center - capsule.half_axis,
                capsule.center + capsule.half_axis,
                capsule.radius,
            ),
        )
        for capsule in shapes.capsules
        if capsule.covers < 0
    ]
    for attached, solid in zip(shapes.solids, robot_solids(description), strict=True):
        mesh = mesh_shape(IndexedMesh(*solid.mesh()))
        link_shapes.append((attached.link, mesh.transformed(attached.pose)))
    return [_link_drawable(link, shape, styles) for link, shape in link_shapes]


def bodies_at(
    robot: ArmHand, q: ArrayLike, drawables: Sequence[Drawable] | None = None
) -> list[Drawable]:
    """Return drawables of links (None: the visual geometry) at q (n,), in the base frame.

    Raises:
        InputError: q is invalid.
    """
    poses = robot.links(q)
    drawables = visual_bodies(robot) if drawables is None else drawables
    return [drawable.transformed(poses[drawable.frame]) for drawable in drawables]


def ground_height(robot: ArmHand, scene: Scene | None = None) -> float:
    """Return the height of the ground [m]: 0, or below the robot at home and the scene."""
    drawables = [*bodies_at(robot, robot.home), *([] if scene is None else scene_drawables(scene))]
    return min(
        0.0, min(float(drawable.surface.points[:, 2].min()) for drawable in drawables) - 1e-3
    )


def merge_by_frame(drawables: Sequence[Drawable]) -> list[Drawable]:
    """Merge drawables of one frame and colour into one mesh each, so that fewer nodes move."""
    groups: dict[tuple[str, str], list[Drawable]] = {}
    for drawable in drawables:
        groups.setdefault((drawable.frame, drawable.color), []).append(drawable)
    return [
        replace(group[0], shape=mesh_shape(join_surfaces([drawable.surface for drawable in group])))
        for group in groups.values()
    ]


def link_styles(description: RobotDescription) -> dict[str, tuple[str, str]]:
    """Return the role of each link ("arm" or "hand"), and a colour unlike that of its parent."""
    palms = {description.palm_link, *(side.palm_link for side in description.sides)}
    is_hand_alone = not (description.arm_actuators or description.sides)
    depth, roles = {description.root: 0}, {description.root: "hand" if is_hand_alone else "arm"}
    for joint in description.joints:
        depth[joint.child] = depth[joint.parent] + 1
        roles[joint.child] = "hand" if joint.part == "hand" or joint.child in palms else "arm"
    colors = {"arm": (palette.ARM_JOINT, palette.ARM), "hand": (palette.HAND, palette.PALM)}
    return {link: (role, colors[role][depth[link] % 2]) for link, role in roles.items()}


def _link_drawable(
    link: str, shape: Shape, styles: Mapping[str, tuple[str, str]], file_color: str = ""
) -> Drawable:
    role, color = styles[link]
    return Drawable(link, shape, file_color or color, link, role)


def _link_rod(end: Array, role: str) -> Shape:
    return rod(np.zeros(3), end, ARM_RADIUS if role == "arm" else FINGER_RADIUS)


def _pad(finger: Finger) -> Drawable:
    """Return a disc whose radius follows from the height of the pad above the axis of its link."""
    normal = finger.placement[:3, :3] @ finger.normal
    height = float(finger.placement[:3, 3] @ normal)
    radius = height if 0.004 < height < 0.02 else FINGER_RADIUS
    center = finger.placement[:3, 3] - 0.13 * radius * normal
    pad = drum(center, normal, 0.62 * radius, 0.36 * radius)
    return Drawable(f"pad {finger.name}", pad, palette.PAD, finger.link, "pad")


# Contacts.


def nearest_target_point(contact: Contact, tip: Array) -> Array:
    """Return the point (3,) allowed by a contact that is nearest to a fingertip (3,) [m]."""
    if np.isnan(contact.point[0]):
        return tip
    gap = tip - contact.point
    if contact.line is not None:
        return contact.point + contact.line * (contact.line @ gap)
    if contact.plane is not None:
        return tip - contact.plane * (contact.plane @ gap)
    return contact.point


def target_marks(contact: Contact, tip: Array, size: float = 1.0) -> list[Drawable]:
    """Return thick, short marks of the constraints of a contact, in the contact's frame.

    A line is drawn as a rod, a plane as a ring about its point nearest to the fingertip. Arrows of
    tangents are shorter than those of normals. A contact without a point is drawn at the fingertip.

    Args:
        contact: The contact.
        tip: (3,) Position of the fingertip [m].
        size: Scale of balls and arrows.
    """
    position, shapes = nearest_target_point(contact, tip), {}
    if contact.line is not None:
        offset = float(contact.line @ (position - contact.point))
        low, high = min(0.0, offset) - MARK_EXTENT, max(0.0, offset) + MARK_EXTENT
        start, end = (contact.point + t * contact.line for t in (low, high))
        shapes["line"] = rod(start, end, 0.0020)
    elif contact.plane is not None:
        shapes["plane"] = ring(position, contact.plane, MARK_EXTENT, 0.0016)
    elif not np.isnan(contact.point[0]):
        shapes["point"] = ball(0.0036 * size, position)
    normal = contact.ball if contact.normal is None else contact.normal
    if normal is not None:
        shapes["normal"] = arrow(position, normal, 0.030 * size, 0.0048 * size)
    if contact.tangent is not None:
        shapes["tangent"] = arrow(position, contact.tangent, 0.021 * size, 0.0048 * size)
    return [Drawable(name, shape, palette.TARGET, role="target") for name, shape in shapes.items()]


def fingertip_marks(color: str, tangent: bool = False) -> list[Drawable]:
    """Return long, thin arrows of a fingertip in its contact frame (x: pad normal)."""
    x, y, _ = np.eye(3)
    shapes = [ball(0.0042), arrow(np.zeros(3), x, 0.046, 0.0022)]
    if tangent:
        shapes.append(arrow(np.zeros(3), y, 0.034, 0.0022))
    return [Drawable("reached", shape, color, role="reached") for shape in shapes]


def contact_marks(
    robot: ArmHand, q: ArrayLike, grasp: Grasp, colors: Mapping[str, str]
) -> list[Drawable]:
    """Return contacts, fingertips and lines to missed contacts, in the base frame.

    Args:
        robot: The robot.
        q: (n,) Configuration [rad or m].
        grasp: The grasp.
        colors: Colour of the fingertip marks by finger; `palette.MISSED` for a missed contact.

    Raises:
        InputError: The grasp names a finger that the robot does not have.
    """
    grasp.arrays(robot.fingers)
    drawables: list[Drawable] = []
    for finger, frame in zip(robot.fingers, robot.contact_frames(q), strict=True):
        contact, tip = grasp.contacts.get(finger), frame[:3, 3]
        if contact is not None:
            drawables += target_marks(contact, tip)
            marks = fingertip_marks(colors[finger], contact.tangent is not None)
            drawables += [mark.transformed(frame) for mark in marks]
            if colors[finger] == palette.MISSED:
                gap = rod(tip, nearest_target_point(contact, tip), 0.0006)
                drawables.append(Drawable("gap", gap, palette.MISSED, role="missed"))
    return drawables


# Objects and scenes.


def object_drawable(name: str) -> Drawable | None:
    """Return the grasped object in its frame, or None if no description of it exists.

    Raises:
        DescriptionError: The description of the object is malformed.
    """
    if not name:
        return None
    try:
        points, triangles = load_object(name).mesh(64)
    except UnknownNameError:
        return None
    shape = mesh_shape(IndexedMesh(points, np.asarray(triangles, np.int64)))
    return Drawable("object", shape, palette.OBJECT, role="object")


def item_drawables(item: Obstacle) -> list[Drawable]:
    """Return an item of a scene in its frame; of an unbounded solid, the part near the base."""
    base = inverse(item.pose)[:3, 3]
    return [
        Drawable(f"{item.name} {i}", _placed_solid(solid, pose, base), palette.SCENE, role="scene")
        for i, (solid, pose) in enumerate(item.parts)
    ]


def _placed_solid(solid: Solid, pose: Array, point: Array) -> Shape:
    """Return a solid at a (4, 4) pose; of an unbounded solid, the part near a point (3,)."""
    surface = IndexedMesh(*solid.mesh())
    if not np.isfinite(solid.reach):
        x, y, _ = pose[:3, :3].T @ (point - pose[:3, 3])
        surface = IndexedMesh(surface.points + np.array([x, y, 0.0]), surface.triangles)
    return mesh_shape(surface).transformed(pose)


def scene_drawables(scene: Scene, excluded: str = "") -> list[Drawable]:
    """Return all items of a scene but an object that is drawn separately, in the base frame."""
    excluded_names = {excluded} if object_drawable(excluded) is not None else set[str]()
    items = [item for name, item in scene.items.items() if name not in excluded_names]
    return [drawable.transformed(item.pose) for item in items for drawable in item_drawables(item)]


def scene_with_object(scene: Scene, grasp: Grasp | None) -> Scene:
    """Return the scene with the object of a grasp at its pose, if the grasp has one."""
    if grasp is not None and grasp.object and grasp.known_pose is not None:
        return scene.holding(grasp.object, grasp.known_pose)
    return scene


def clearance_marks(closest: ClosestPoints, show_shapes: bool = False) -> list[Drawable]:
    """Return a rod between the nearest points of two shapes, in the base frame.

    Args:
        closest: The pair of shapes.
        show_shapes: True to return the bounded shapes of the pair instead, enlarged by a millimetre
            for visibility.
    """
    start, end = closest.points
    shapes = [rod(start, end, 0.0012), ball(0.0022, start), ball(0.0022, end)]
    if show_shapes:
        shapes = []
        for solid, pose in closest.shapes:
            if np.isfinite(solid.reach):
                points, triangles = solid.mesh()
                enlarged = IndexedMesh(points * (1 + 1e-3 / solid.reach), triangles)
                shapes.append(mesh_shape(enlarged).transformed(pose))
    return [Drawable("nearest", shape, palette.NEAREST, role="nearest") for shape in shapes]
