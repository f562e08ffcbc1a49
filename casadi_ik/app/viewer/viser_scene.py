"""Scene of a page in viser: robots, contacts and draggable items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import viser
from numpy.typing import ArrayLike
from viser.transforms import SO3

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    bodies_at,
    collision_bodies,
    fingertip_marks,
    item_drawables,
    merge_by_frame,
    object_drawable,
    target_marks,
    visual_bodies,
)
from casadi_ik.app.drawing.surfaces import join_surfaces, mesh_shape, split_sharp_edges
from casadi_ik.app.viewer.request import OBJECT_ITEM, DraggableContact, PageRequest
from casadi_ik.collision.clearance import ClosestPoints
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import rotations_from_quaternions
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.solve.verdict import ContactVerdict


class DragListener(Protocol):
    """Callbacks for clicks and drags."""

    def select(self, name: str) -> None:
        """Give an item its arrows and rings."""

    def drag(self, name: str, pose: Array) -> None:
        """Move an item to a (4, 4) pose."""

    def drag_point(self, finger: str, point: Array) -> None:
        """Move a contact to a point (3,) [m]."""

    def drag_normal(self, finger: str, normal: Array) -> None:
        """Rotate a contact to a normal (3,)."""


def add_drawable(server: viser.ViserServer, name: str, drawable: Drawable, **options: Any) -> Any:
    """Add a drawable to the scene; `options` are those of viser's `add_mesh_simple`."""
    surface = split_sharp_edges(drawable.surface)
    return server.scene.add_mesh_simple(
        name,
        surface.points.astype(np.float32),
        surface.triangles.astype(np.uint32),
        color=palette.rgb(drawable.color),
        **options,
    )


def quaternions(rotations: Array) -> Array:
    """Return the (..., 4) unit quaternions, scalar first, of rotations (..., 3, 3)."""
    return np.asarray(SO3.from_matrix(rotations).wxyz, dtype=np.float64)


def pose_of(position: ArrayLike, wxyz: ArrayLike) -> Array:
    """Return the (4, 4) pose of a position (3,) and a quaternion (4,) from a browser.

    Raises:
        ValueError: The sizes are wrong, or a number is not finite.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotations_from_quaternions(finite_numbers(wxyz, 4)[None])[0]
    pose[:3, 3] = finite_numbers(position, 3)
    if not np.isfinite(pose).all():
        raise ValueError(f"wxyz: found {wxyz}, expected a quaternion of non-zero length")
    return pose


def finite_numbers(numbers: ArrayLike, count: int) -> Array:
    """Validate numbers (count,) from a browser.

    Raises:
        ValueError: They are not numeric, not finite or too large, or their count is wrong.
    """
    try:
        values = np.asarray(numbers, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if values.shape != (count,) or not (np.abs(values) <= 1e6).all():
        raise ValueError(f"found {values}, expected {count} finite numbers up to 1e6")
    return values


def frames_by_finger(robot: ArmHand, q: Array) -> dict[str, Array]:
    """Return the contact frames (4, 4) at q (n,) by finger, base frame."""
    return dict(zip(robot.fingers, robot.contact_frames(q), strict=True))


class RobotView:
    """The links of a robot as a tree of nodes, so that only joint motion is sent to browsers.

    Attributes:
        q: (n,) Configuration shown [rad or m].
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        name: str = "/robot",
        drawables: Sequence[Drawable] | None = None,
    ) -> None:
        """Draw the robot at home.

        Args:
            server: Server of the page.
            robot: The robot.
            name: Name of the root node.
            drawables: Geometry in the frames of links; None: the visual geometry.
        """
        self._server, self._robot = server, robot
        links, parents = robot.description.links, _parent_indices(robot)
        nodes: list[str] = []
        for link, parent in zip(links, parents, strict=True):
            nodes.append(f"{nodes[parent] if parent >= 0 else name}/{link}")
        server.scene.add_frame(name, show_axes=False)
        self._nodes = dict(zip(links, nodes, strict=True))
        self._frames = [server.scene.add_frame(node, show_axes=False) for node in nodes]
        self._parents = parents
        self._poses = np.full((len(links), 4, 4), np.nan)
        self._geometries: dict[str, list[Any]] = {}
        self._add_geometry("visual", visual_bodies(robot) if drawables is None else drawables)
        self.update(robot.home)

    def show_geometry(self, name: str) -> None:
        """Show the visual geometry ("visual") or the collision shapes ("collision")."""
        if name not in self._geometries:
            self._add_geometry(name, collision_bodies(self._robot))
        for key, meshes in self._geometries.items():
            for mesh in meshes:
                mesh.visible = key == name

    def _add_geometry(self, name: str, drawables: Sequence[Drawable]) -> None:
        nodes = [
            f"{self._nodes[drawable.frame]}/{name}_{i}"
            for i, drawable in enumerate(merge_by_frame(drawables))
        ]
        self._geometries[name] = [
            add_drawable(self._server, node, drawable, side="double", receive_shadow=False)
            for node, drawable in zip(nodes, merge_by_frame(drawables), strict=True)
        ]

    def update(self, q: Array) -> None:
        """Show the robot at q (n,) [rad or m]."""
        self.q = np.array(q)
        link_poses = np.array(list(self._robot.links(q).values()))
        # Index -1 is the base frame.
        parent_poses = np.concatenate([link_poses, np.eye(4)[None]])[self._parents]
        poses = np.linalg.inv(parent_poses) @ link_poses
        changed_entries = ~(np.abs(poses - self._poses) < 1e-9)
        translated = changed_entries[:, :3, 3].any(axis=1)
        rotated = changed_entries[:, :3, :3].any(axis=(1, 2))
        wxyz = quaternions(poses[:, :3, :3])
        with self._server.atomic():
            for i in np.flatnonzero(translated):
                self._frames[i].position = poses[i, :3, 3]
            for i in np.flatnonzero(rotated):
                self._frames[i].wxyz = wxyz[i]
        self._poses[translated, :3, 3] = poses[translated, :3, 3]
        self._poses[rotated, :3, :3] = poses[rotated, :3, :3]


def _parent_indices(robot: ArmHand) -> list[int]:
    """Return the index of each link's parent link; -1 for the base frame."""
    links = robot.description.links
    parents = {joint.child: links.index(joint.parent) for joint in robot.description.joints}
    return [parents.get(link, -1) for link in links]


class Control:
    """A node with drawables; arrows and rings to drag it appear while it is selected.

    Attributes:
        meshes: Meshes below the node by name.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        item: str,
        drawables: Sequence[Drawable],
        listener: DragListener | None,
        size: float,
        **options: Any,
    ) -> None:
        """Add the node.

        Args:
            server: Server of the page.
            name: Name of the node.
            item: Name of the item in callbacks.
            drawables: Drawables in the frame of the node.
            listener: Receiver of clicks and drags; None: the node is fixed.
            size: Length of the arrows [m].
            options: Options of viser's `add_mesh_simple`.
        """
        self._pose: Array | None = None
        self.handle = server.scene.add_transform_controls(
            name,
            scale=size,
            line_width=2.5,
            depth_test=False,
            disable_sliders=True,  # the squares between the arrows would cover small objects
        )
        self.select(False)
        self.meshes = {
            drawable.name: add_drawable(server, f"{name}/{drawable.name}", drawable, **options)
            for drawable in drawables
        }
        if listener is None:
            return

        # Asynchronous callbacks keep their order. Invalid poses are ignored here, because viser
        # would print them to the terminal.
        @self.handle.on_update
        async def _(_: Any) -> None:
            with suppress(ValueError):
                listener.drag(item, pose_of(self.handle.position, self.handle.wxyz))

        for mesh in self.meshes.values():

            @mesh.on_click
            async def _(_: Any) -> None:
                listener.select(item)

    def update(self, pose: Array, is_dragged: bool) -> None:
        """Move the node to a (4, 4) pose, unless the browser that drags it has moved it already."""
        if pose is not self._pose:
            self._pose = pose
            if not is_dragged:
                self.handle.position = pose[:3, 3]
                self.handle.wxyz = quaternions(pose[:3, :3])

    def select(self, is_selected: bool) -> None:
        """Show or hide arrows and rings."""
        handle = self.handle
        handle.disable_axes = handle.disable_rotations = not is_selected


class Handles:
    """The draggable items of a page: contacts, the object, the items of a scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        request: PageRequest,
        listener: DragListener | None = None,
        parent: str = "",
    ) -> None:
        """Draw the items.

        Args:
            server: Server of the page.
            request: Initial request.
            listener: Receiver of clicks and drags; None: the items are fixed.
            parent: Parent node; "": the base frame.
        """
        self._controls: dict[str, Control] = {}
        for name, draggable in request.contacts.items():
            marks = target_marks(draggable.contact, np.zeros(3))
            node = f"{parent}/contacts/{name}"
            self._controls[name] = Control(
                server, node, name, marks, listener, 0.05, cast_shadow=False
            )
        if listener is not None:
            for finger in request.contacts:
                self._add_drag_callbacks(finger, listener)
        items = {} if request.scene is None else dict(request.scene.items)
        items.pop(request.object, None)
        shapes_and_options: dict[str, tuple[list[Drawable], dict[str, Any]]] = {
            name: (item_drawables(item), {"opacity": 0.8, "cast_shadow": False})
            for name, item in items.items()
        }
        object_shape = object_drawable(request.object)
        if object_shape is not None and request.object_pose is not None:
            shapes_and_options = {
                OBJECT_ITEM: ([object_shape], {"opacity": 0.4, "cast_shadow": True})
            } | shapes_and_options
        for name, (shapes, options) in shapes_and_options.items():
            node = f"{parent}/things/{name}"
            self._controls[name] = Control(
                server, node, name, shapes, listener, 0.07, receive_shadow=0.15, **options
            )
        self.names = (*shapes_and_options, *request.contacts)
        self.update(request)

    def _add_drag_callbacks(self, finger: str, listener: DragListener) -> None:
        """Let the ball of a contact move it and the tip of its arrow rotate it."""
        control = self._controls[finger]
        for part, mesh in control.meshes.items():

            @mesh.on_drag("left")
            async def _(event: Any, part: str = part) -> None:
                with suppress(ValueError):
                    cursor = finite_numbers(event.end_position, 3)
                    if part != "normal":
                        listener.drag_point(finger, cursor)
                        return
                    direction = cursor - finite_numbers(control.handle.position, 3)
                    if np.linalg.norm(direction) > 1e-3:
                        listener.drag_normal(finger, direction)

    def update(self, request: PageRequest, dragged: str = "") -> None:
        """Move all items to the poses of a request, except the item that is being dragged."""
        for name, pose in request.poses.items():
            if name in self._controls:
                self._controls[name].update(pose, name == dragged)
        for finger, draggable in request.contacts.items():
            for part, mesh in self._controls[finger].meshes.items():
                mesh.visible = draggable.is_used and (
                    draggable.uses_normal or part not in ("normal", "tangent")
                )

    def select(self, name: str) -> None:
        """Show arrows and rings of one item; "": of none."""
        for item, control in self._controls.items():
            control.select(item == name)


class FingertipMarks:
    """Fingertips of a robot with the errors of missed contacts."""

    def __init__(self, server: viser.ViserServer, request: PageRequest, parent: str = "") -> None:
        """Draw the fingertips below the node `parent`."""
        self._marks = {
            finger: _FingertipMark(server, finger, parent) for finger in request.contacts
        }

    def update(
        self,
        request: PageRequest,
        frames: Mapping[str, Array],
        verdicts: Mapping[str, ContactVerdict],
    ) -> None:
        """Move the marks to contact frames (4, 4), whose x axes are pad normals; show errors."""
        for finger, tip in self._marks.items():
            draggable = request.contacts[finger]
            tip.update(
                frames[finger], draggable, verdicts.get(finger) if draggable.is_used else None
            )


class _FingertipMark:
    """Fingertip of one finger."""

    def __init__(self, server: viser.ViserServer, finger: str, parent: str) -> None:
        scene, name = server.scene, f"{parent}/tips/{finger}"
        self._finger, self._frame = finger, scene.add_frame(name, show_axes=False)
        (mark,) = merge_by_frame(fingertip_marks(palette.MET))
        self._mesh = add_drawable(server, f"{name}/reached", mark, cast_shadow=False)
        self._label = scene.add_label(
            f"{name}/errors", "", anchor="bottom-center", font_screen_scale=0.85, visible=False
        )
        self._gap = _line(server, f"{parent}/gaps/{finger}", palette.MISSED, 0.0016)

    def update(
        self, frame: Array, draggable: DraggableContact, verdict: ContactVerdict | None
    ) -> None:
        self._frame.position, self._frame.wxyz = frame[:3, 3], quaternions(frame[:3, :3])
        is_met = verdict is None or verdict.ok
        color = palette.FAINT if verdict is None else palette.MET if is_met else palette.MISSED
        if self._mesh.color != palette.rgb(color):
            self._mesh.color = palette.rgb(color)
        self._gap.visible = self._label.visible = not is_met
        if verdict is not None and not is_met:
            segment = np.stack([frame[:3, 3], draggable.control[:3, 3]])[None]
            self._gap.points = segment.astype(np.float32)
            self._label.text = f"{self._finger}  {'  '.join(error_texts(verdict)) or 'free'}"


def error_texts(verdict: ContactVerdict) -> list[str]:
    """Return distance and angle in words; unconstrained errors are omitted."""
    parts = [(1e3 * verdict.position_error, " mm"), (np.rad2deg(verdict.angle_error), "°")]
    return [f"{value:.2f}{unit}" for value, unit in parts if not np.isnan(value)]


def _line(server: viser.ViserServer, name: str, color: str, width: float) -> Any:
    """Add an invisible line segment."""
    points = np.zeros((1, 2, 3), dtype=np.float32)
    return server.scene.add_line_segments(
        name, points, palette.rgb(color), thickness=width, visible=False
    )


class ClearanceLine:
    """A line between the closest pair of shapes, labelled with the clearance."""

    def __init__(self, server: viser.ViserServer) -> None:
        """Add the line, invisible."""
        self._rod = _line(server, "/closest/rod", palette.NEAREST, 0.003)
        self._label = server.scene.add_label(
            "/closest/length", "", anchor="top-center", font_screen_scale=0.8, visible=False
        )

    def update(
        self, closest: ClosestPoints | None, clearance: float | None = None, show_label: bool = True
    ) -> None:
        """Show the line between two points, or hide it.

        Args:
            closest: The nearest points; None or more than 0.25 m apart: the line is hidden.
            clearance: Clearance in the label [m]; None: the distance between the points.
            show_label: Show the label; False where it would cover the errors of contacts.
        """
        is_visible = closest is not None and closest.distance < 0.25
        self._rod.visible, self._label.visible = is_visible, is_visible and show_label
        if closest is None or not is_visible:
            return
        self._rod.points = closest.points[None].astype(np.float32)
        self._label.position = closest.points.mean(axis=0)
        length = closest.distance if clearance is None else clearance
        self._label.text = f"{1e3 * length:.1f} mm"


class GhostRobots:
    """Translucent copies of an arm, or of a hand alone, in different colours."""

    def __init__(self, server: viser.ViserServer, robot: ArmHand) -> None:
        """Store the robot; nothing is drawn."""
        self._server, self._robot, self._drawables = server, robot, []
        self._role = "arm" if robot.description.arm_actuators else "hand"

    def show(self, configurations: Sequence[tuple[Array, str]]) -> None:
        """Replace the ghosts by one for each pair of q (n,) and colour."""
        with self._server.atomic():
            for drawable in self._drawables:
                drawable.remove()
            self._drawables = []
            for i, (q, color) in enumerate(configurations):
                drawables = [
                    drawable
                    for drawable in visual_bodies(self._robot)
                    if drawable.role == self._role
                ]
                parts = [drawable.surface for drawable in bodies_at(self._robot, q, drawables)]
                ghost = Drawable("ghost", mesh_shape(join_surfaces(parts)), color)
                options = {"opacity": 0.25, "cast_shadow": False, "receive_shadow": False}
                self._drawables.append(add_drawable(self._server, f"/ghosts/{i}", ghost, **options))
