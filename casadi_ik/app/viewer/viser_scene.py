"""Drawables on a page by viser: robots, contacts and things that are dragged, light and camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import ArrayLike
from viser.transforms import SO3

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    View,
    asked_marks,
    axes_of,
    bodies,
    close_view,
    collision_bodies,
    item_of,
    merged,
    object_of,
    placed,
    reached_marks,
    whole_view,
)
from casadi_ik.app.drawing.surfaces import joined, mesh_of, sharp
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.request import OBJECT, Held, PageRequest
from casadi_ik.collision.clearance import Closest
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import rotations_from_quaternions
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.solve.verdict import ContactVerdict

if TYPE_CHECKING:
    from casadi_ik.app.viewer.page import DraggedPage


def add_drawable(server: viser.ViserServer, name: str, one: Drawable, **look: Any) -> Any:
    """A mesh of a page; `look` as `add_mesh_simple` of viser has it."""
    surface = sharp(one.surface)
    return server.scene.add_mesh_simple(
        name,
        surface.points.astype(np.float32),
        surface.triangles.astype(np.uint32),
        color=palette.rgb(one.color),
        **look,
    )


def quaternions(rotations: Array) -> Array:
    """(..., 4) unit quaternions, scalar first, of rotations (..., 3, 3)."""
    return np.asarray(SO3.from_matrix(rotations).wxyz, dtype=np.float64)


def pose_of(position: ArrayLike, wxyz: ArrayLike) -> Array:
    """(4, 4) of a position (3,) and a quaternion (4,) that a browser has sent.

    Raises:
        ValueError: They are not of these sizes, or not finite.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotations_from_quaternions(usable(wxyz, 4)[None])[0]
    pose[:3, 3] = usable(position, 3)
    if not np.isfinite(pose).all():
        raise ValueError("found a quaternion of no length")
    return pose


def usable(numbers: ArrayLike, count: int) -> Array:
    """Numbers (count,) that a browser has sent.

    Raises:
        ValueError: They are none, not so many, not finite, or too large to be drawn.
    """
    try:
        found = np.asarray(numbers, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if found.shape != (count,) or not (np.abs(found) <= 1e6).all():
        raise ValueError(f"found {found}, expected {count} numbers up to 1e6")
    return found


class DrawnRobot:
    """The links of a robot: each hangs on the one before, so a joint's turn is all that is sent.

    Attributes:
        q: (n,) where it is [rad or m].
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        name: str = "/robot",
        skin: Sequence[Drawable] | None = None,
    ) -> None:
        """Draw it at home.

        Args:
            server: The page.
            robot: The robot.
            name: Of its node.
            skin: What it is drawn with, in the frames of links; None: its bodies.
        """
        self._server, self._robot = server, robot
        links, before = robot.description.links, _hung_on(robot)
        nodes: list[str] = []
        for link, on in zip(links, before, strict=True):
            nodes.append(f"{nodes[on] if on >= 0 else name}/{link}")
        server.scene.add_frame(name, show_axes=False)
        self._nodes = dict(zip(links, nodes, strict=True))
        self._frames = [server.scene.add_frame(node, show_axes=False) for node in nodes]
        self._before = before
        self._poses = np.full((len(links), 4, 4), np.nan)
        self._skins: dict[str, list[Any]] = {}
        self._add_skin("bodies", bodies(robot) if skin is None else skin)
        self.place(robot.home)

    def skin(self, name: str) -> None:
        """Show its bodies ("bodies"), or what collisions are checked with ("collision shapes")."""
        if name not in self._skins:
            self._add_skin(name, collision_bodies(self._robot))
        for other, meshes in self._skins.items():
            for mesh in meshes:
                mesh.visible = other == name

    def _add_skin(self, name: str, skin: Sequence[Drawable]) -> None:
        nodes = [f"{self._nodes[one.frame]}/{name}_{i}" for i, one in enumerate(merged(skin))]
        self._skins[name] = [
            add_drawable(self._server, node, one, side="double", receive_shadow=False)
            for node, one in zip(nodes, merged(skin), strict=True)
        ]

    def place(self, q: Array) -> None:
        """Move it to q (n,) [rad or m]."""
        self.q = np.array(q)
        every = np.array(list(self._robot.links(q).values()))
        # The last stands for the base frame, which the first link hangs on.
        on = np.concatenate([every, np.eye(4)[None]])[self._before]
        poses = np.linalg.inv(on) @ every
        gone = ~(np.abs(poses - self._poses) < 1e-9)
        shifted, turned = gone[:, :3, 3].any(axis=1), gone[:, :3, :3].any(axis=(1, 2))
        wxyz = quaternions(poses[:, :3, :3])
        with self._server.atomic():
            for i in np.flatnonzero(shifted):
                self._frames[i].position = poses[i, :3, 3]
            for i in np.flatnonzero(turned):
                self._frames[i].wxyz = wxyz[i]
        self._poses[shifted, :3, 3] = poses[shifted, :3, 3]
        self._poses[turned, :3, :3] = poses[turned, :3, :3]


def _hung_on(robot: ArmHand) -> list[int]:
    """By link the number of the one that it hangs on; -1: the base frame."""
    links = robot.description.links
    parents = {joint.child: links.index(joint.parent) for joint in robot.description.joints}
    return [parents.get(link, -1) for link in links]


class Control:
    """A frame that drawables hang on, with arrows and rings to be dragged by while it is selected.

    Attributes:
        meshes: What hangs on it, by name.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        what: str,
        drawables: Sequence[Drawable],
        page: DraggedPage | None,
        size: float,
        **look: Any,
    ) -> None:
        """Make it.

        Args:
            server: The page.
            name: Of its node.
            what: What it is called.
            drawables: In its frame.
            page: Told where it is dragged, and that it is clicked; None: nobody.
            size: Of the arrows [m].
            look: As `add_mesh_simple` of viser has it.
        """
        self._pose: Array | None = None
        self.handle = server.scene.add_transform_controls(
            name, scale=size, line_width=3.0, depth_test=False
        )
        self.select(False)
        self.meshes = {
            one.name: add_drawable(server, f"{name}/{one.name}", one, **look) for one in drawables
        }
        if page is None:
            return

        # Asynchronous callbacks keep their order; they only put down what is to be done. What is
        # no place is left out: viser would tell the terminal.
        @self.handle.on_update
        async def _(_: Any) -> None:
            with suppress(ValueError):
                page.drag(what, pose_of(self.handle.position, self.handle.wxyz))

        for mesh in self.meshes.values():

            @mesh.on_click
            async def _(_: Any) -> None:
                page.select(what)

    def place(self, pose: Array, held: bool) -> None:
        """Put it at a (4, 4) pose, unless a hand holds it: then it is where the hand has it."""
        if pose is not self._pose:
            self._pose = pose
            if not held:
                self.handle.position = pose[:3, 3]
                self.handle.wxyz = quaternions(pose[:3, :3])

    def select(self, on: bool) -> None:
        """Show its arrows and rings, or hide them."""
        handle = self.handle
        handle.disable_axes = handle.disable_sliders = handle.disable_rotations = not on


class Handles:
    """What can be dragged: contacts asked for, the object, the items of a scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        asked: PageRequest,
        page: DraggedPage | None = None,
        above: str = "",
    ) -> None:
        """Draw them.

        Args:
            server: The page.
            asked: What is asked first.
            page: Told of drags; None: nobody.
            above: The node that they hang on; "": the base frame.
        """
        self._controls: dict[str, Control] = {}
        for name, held in asked.held.items():
            marks = asked_marks(held.contact, np.zeros(3))
            node = f"{above}/contacts/{name}"
            self._controls[name] = Control(server, node, name, marks, page, 0.05, cast_shadow=False)
        if page is not None:
            for finger in asked.held:
                self._drag_parts(finger, page)
        things = {} if asked.scene is None else dict(asked.scene.items)
        things.pop(asked.object, None)
        looks: dict[str, tuple[list[Drawable], dict[str, Any]]] = {
            name: (item_of(item), {"opacity": 0.8, "cast_shadow": False})
            for name, item in things.items()
        }
        body = object_of(asked.object)
        if body is not None and asked.object_pose is not None:
            looks = {OBJECT: ([body], {"opacity": 0.4, "cast_shadow": True})} | looks
        for name, (shapes, look) in looks.items():
            node = f"{above}/things/{name}"
            self._controls[name] = Control(
                server, node, name, shapes, page, 0.07, receive_shadow=0.15, **look
            )
        self.names = (*looks, *asked.held)
        self.place(asked)

    def _drag_parts(self, finger: str, page: DraggedPage) -> None:
        """The ball of a contact moves it, the tip of its arrow turns it."""
        control = self._controls[finger]
        for part, mesh in control.meshes.items():

            @mesh.on_drag("left")
            async def _(event: Any, part: str = part) -> None:
                with suppress(ValueError):
                    end = usable(event.end_position, 3)
                    if part != "normal":
                        page.drag_point(finger, end)
                        return
                    way = end - usable(control.handle.position, 3)
                    if np.linalg.norm(way) > 1e-3:
                        page.drag_normal(finger, way)

    def place(self, asked: PageRequest, dragged: str = "") -> None:
        """Put them where they are; what is being dragged is where the hand has it."""
        for name, pose in asked.places.items():
            if name in self._controls:
                self._controls[name].place(pose, name == dragged)
        for finger, held in asked.held.items():
            for part, mesh in self._controls[finger].meshes.items():
                mesh.visible = held.used and (held.normal or part not in ("normal", "tangent"))

    def select(self, name: str) -> None:
        """Give one its arrows and rings to be dragged by; "": none."""
        for other, control in self._controls.items():
            control.select(other == name)


class Tips:
    """What the fingers reach, and by how much each misses."""

    def __init__(self, server: viser.ViserServer, asked: PageRequest, above: str = "") -> None:
        """Draw them; `above`: the node that they hang on."""
        self._tips = {finger: _Tip(server, finger, above) for finger in asked.held}

    def place(
        self,
        asked: PageRequest,
        frames: Mapping[str, Array],
        verdicts: Mapping[str, ContactVerdict],
    ) -> None:
        """Put the fingertips where they are: frames (4, 4) with the normal as x axis."""
        for finger, tip in self._tips.items():
            held = asked.held[finger]
            tip.place(frames[finger], held, verdicts.get(finger) if held.used else None)


class _Tip:
    """What a finger reaches."""

    def __init__(self, server: viser.ViserServer, finger: str, above: str) -> None:
        scene, name = server.scene, f"{above}/tips/{finger}"
        self._finger, self._frame = finger, scene.add_frame(name, show_axes=False)
        (mark,) = merged(reached_marks(palette.MET))
        self._mesh = add_drawable(server, f"{name}/reached", mark, cast_shadow=False)
        self._label = scene.add_label(
            f"{name}/errors", "", anchor="bottom-center", font_screen_scale=0.85, visible=False
        )
        self._gap = _segment(server, f"{above}/gaps/{finger}", palette.MISSED, 0.0016)

    def place(self, frame: Array, held: Held, verdict: ContactVerdict | None) -> None:
        self._frame.position, self._frame.wxyz = frame[:3, 3], quaternions(frame[:3, :3])
        met = verdict is None or verdict.ok
        color = palette.FAINT if verdict is None else palette.MET if met else palette.MISSED
        if self._mesh.color != palette.rgb(color):
            self._mesh.color = palette.rgb(color)
        self._gap.visible = self._label.visible = not met
        if verdict is not None and not met:
            ends = np.stack([frame[:3, 3], held.control[:3, 3]])[None]
            self._gap.points = ends.astype(np.float32)
            self._label.text = f"{self._finger}  {'  '.join(errors_of(verdict)) or 'free'}"


def errors_of(verdict: ContactVerdict) -> list[str]:
    """Distance and angle in words; what is free is left out."""
    parts = [(1e3 * verdict.position_error, " mm"), (np.rad2deg(verdict.angle_error), "°")]
    return [f"{value:.2f}{unit}" for value, unit in parts if not np.isnan(value)]


def _segment(server: viser.ViserServer, name: str, color: str, width: float) -> Any:
    """A line between two points, not seen yet."""
    points = np.zeros((1, 2, 3), dtype=np.float32)
    return server.scene.add_line_segments(
        name, points, palette.rgb(color), thickness=width, visible=False
    )


class DrawnClosest:
    """The pair that is nearest to touching: a red line between them, with its length."""

    def __init__(self, server: viser.ViserServer) -> None:
        """Draw nothing yet."""
        self._rod = _segment(server, "/closest/rod", palette.NEAREST, 0.003)
        self._label = server.scene.add_label(
            "/closest/length", "", anchor="top-center", font_screen_scale=0.8, visible=False
        )

    def place(
        self, closest: Closest | None, clearance: float | None = None, told: bool = True
    ) -> None:
        """Put it where two shapes are nearest, with their clearance [m]; None: nowhere.

        Args:
            closest: The two points; farther apart than 0.25 m nothing is drawn.
            clearance: What is told of them; None: how far they are from each other.
            told: Whether anything is: not where it would lie over what matters more.
        """
        shown = closest is not None and closest.distance < 0.25
        self._rod.visible, self._label.visible = shown, shown and told
        if closest is None or not shown:
            return
        self._rod.points = closest.ends[None].astype(np.float32)
        self._label.position = closest.ends.mean(axis=0)
        length = closest.distance if clearance is None else clearance
        self._label.text = f"{1e3 * length:.1f} mm"


class Ghosts:
    """An arm, or a hand alone, several times, seen through, each in a colour of its own."""

    def __init__(self, server: viser.ViserServer, robot: ArmHand) -> None:
        """Draw nothing yet."""
        self._server, self._robot, self._drawn = server, robot, []
        self._role = "arm" if robot.description.arm_actuators else "hand"

    def show(self, many: Sequence[tuple[Array, str]]) -> None:
        """Draw the robot at each q (n,) in a colour; of none nothing."""
        with self._server.atomic():
            for one in self._drawn:
                one.remove()
            self._drawn = []
            for i, (q, color) in enumerate(many):
                seen = [one for one in bodies(self._robot) if one.role == self._role]
                parts = [one.surface for one in placed(self._robot, q, seen)]
                ghost = Drawable("ghost", mesh_of(joined(parts)), color)
                look = {"opacity": 0.25, "cast_shadow": False, "receive_shadow": False}
                self._drawn.append(add_drawable(self._server, f"/ghosts/{i}", ghost, **look))


# Light, ground, camera.

FOV = np.deg2rad(40.0)
"""Of the camera, from below to above [rad]."""

PHONE = 0.8
"""Screens that are narrower have the panel below [width by height]."""


def set_stage(server: Server, title: str, floor: float, dark: bool) -> None:
    """Daylight, a ground with a grid of 0.1 m and 0.5 m, and the look of the panel.

    Args:
        server: The page.
        title: On the panel.
        floor: Height of the ground [m].
        dark: Whether the page is dark.
    """
    scene, gui = server.scene, server.gui
    scene.set_up_direction("+z")
    scene.world_axes.visible = False
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(214, 210, 204), intensity=2.1
    )
    scene.add_light_directional("/light/fill", intensity=0.6, position=(-2.0, 2.0, 1.0))
    scene.add_grid(
        "/ground",
        width=4.0,
        height=4.0,
        cell_size=0.1,
        section_size=0.5,
        cell_color=(52, 58, 66) if dark else (226, 228, 231),
        section_color=(78, 86, 96) if dark else (200, 204, 209),
        shadow_opacity=0.35 if dark else 0.22,
        plane_opacity=0.0,
        position=(0.0, 0.0, floor),
    )
    gui.configure_theme(
        control_layout="collapsible",
        control_width="medium",
        show_logo=False,
        show_share_button=False,
        dark_mode=dark,
        brand_color=palette.rgb("#2f6db3"),
    )
    gui.set_panel_label(title)
    server.access.title = title


@dataclass(frozen=True)
class Camera:
    """Where from, and what.

    Attributes:
        target: (3,) middle of what is seen [m].
        radius: Of a ball that holds it [m].
        view: (3,) unit, from there towards the camera.
    """

    target: Array
    radius: float
    view: Array

    def place(self, aspect: float = 1.0) -> Array:
        """(3,) where the camera stands, so that all of it is seen on a screen so wide."""
        half = min(FOV / 2, np.arctan(np.tan(FOV / 2) * aspect))
        return self.target + self.radius / np.sin(half) * self.view

    def show(self, server: Server) -> None:
        """Look from there in every browser, and in those that open the page later."""
        initial = server.initial_camera
        initial.fov, initial.look_at, initial.position = FOV, self.target, self.place()
        if server.camera is None:
            # Those that come later look from where the page then says.
            server.on_client_connect(lambda client: server.camera.first_on(client))
        server.camera = self
        for client in server.get_clients().values():
            self.on(client)

    def first_on(self, client: Any) -> None:
        """Look from there in a browser that opens the page, if its screen is upright."""
        if client.camera.aspect < 1.0:
            self.on(client)

    def on(self, client: Any) -> None:
        """Look from there in one browser."""
        aspect, position = client.camera.aspect, self.place(client.camera.aspect)
        lower = np.zeros(3)
        if aspect < PHONE:
            # The panel covers the lower half there.
            up = np.array([0.0, 0.0, 1.0]) - self.view[2] * self.view
            height = np.linalg.norm(position - self.target) * np.tan(FOV / 2)
            lower = -0.45 * height * up / np.linalg.norm(up)
        with client.atomic():
            client.camera.position = position + lower
            client.camera.look_at = self.target + lower


def cameras(robot: ArmHand, q: Array, things: Sequence[Drawable] = ()) -> dict[str, Camera]:
    """Where a robot at q (n,) is seen from, by name: its hand, or each, and the whole of it.

    The first is where a page begins: near the only hand, else away from all of them.

    Args:
        robot: The robot.
        q: (n,) [rad or m].
        things: What is grasped, in the base frame.
    """
    seen, many = bodies(robot), len(robot.hands) > 1
    body = placed(robot, q, seen)
    whole = whole_view(robot.contacts(q)[0].mean(axis=0), close_view(robot, q))
    found = {"Robot": _camera([*body, *things], whole)} if many else {}
    for side in robot.hands:
        links = robot.description.side(side).links if side else robot.description.links
        hand = [
            part
            for one, part in zip(seen, body, strict=True)
            if one.role != "arm" and one.frame in links
        ]
        name = side.capitalize() if side and many else "Hand"
        found[name] = _camera([*hand, *things], close_view(robot, q, side), 1.15)
    return found if many else found | {"Robot": _camera([*body, *things], whole)}


def _camera(parts: Sequence[Drawable], view: View, room: float = 1.0) -> Camera:
    points = np.concatenate([one.surface.points for one in parts])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = room * float(np.linalg.norm(points - middle, axis=1).max())
    return Camera(middle, max(radius, 0.05), axes_of(view)[2])


def light_lamp(server: viser.ViserServer, camera: Camera) -> None:
    """Light what a camera sees from above; its shadows cost less than those of a sun."""
    lamp = np.array([0.55, -0.45, 1.9])
    server.scene.add_light_spot(
        "/light/lamp",
        color=(255, 250, 242),
        intensity=2.2,
        decay=0.0,
        angle=0.95,
        penumbra=0.3,
        position=tuple((camera.target + 2 * camera.radius * lamp).tolist()),
        direction=tuple((-lamp).tolist()),
        cast_shadow=True,
    )
