"""Viewpoints, lights, ground and theme of a page in viser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    View,
    bodies_at,
    close_view,
    overview,
    view_axes,
    visual_bodies,
)
from casadi_ik.app.viewer.access import Server
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

FIELD_OF_VIEW = np.deg2rad(40.0)
"""Vertical field of view of the camera [rad]."""

NARROW_ASPECT = 0.8
"""Aspect ratio (width / height) below which the panel is placed at the bottom of the screen."""


def set_up_scene(server: Server, title: str, floor: float, dark: bool) -> None:
    """Add light, a ground with a grid of 0.1 m and 0.5 m, and the theme of the panel.

    Args:
        server: Server of the page.
        title: Title of the panel and of the browser's tab.
        floor: Height of the ground [m].
        dark: True for the dark theme.
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
        control_width="medium",
        show_logo=False,
        show_share_button=False,
        dark_mode=dark,
        brand_color=palette.rgb("#2f6db3"),
    )
    gui.main_panel.dock_right()
    gui.set_panel_label(title)
    server.access.title = title


@dataclass(frozen=True)
class Camera:
    """A viewpoint.

    Attributes:
        target: (3,) Centre of the view [m].
        radius: Radius of the ball around the target that is in view [m].
        view: (3,) Unit vector from the target towards the camera.
    """

    target: Array
    radius: float
    view: Array

    def position(self, aspect: float = 1.0) -> Array:
        """Return the (3,) camera position at which the ball fits a screen of an aspect ratio."""
        half_angle = min(FIELD_OF_VIEW / 2, np.arctan(np.tan(FIELD_OF_VIEW / 2) * aspect))
        return self.target + self.radius / np.sin(half_angle) * self.view

    def show(self, server: Server) -> None:
        """Apply the viewpoint in all browsers, including those that connect later."""
        initial = server.initial_camera
        initial.fov, initial.look_at, initial.position = FIELD_OF_VIEW, self.target, self.position()
        if server.camera is None:
            # Browsers that connect later use the current camera at that time.
            server.on_client_connect(lambda client: server.camera.apply_if_portrait(client))
        server.camera = self
        for client in server.get_clients().values():
            self.apply(client)

    def apply_if_portrait(self, client: Any) -> None:
        """Apply the viewpoint in a browser with a portrait screen."""
        if client.camera.aspect < 1.0:
            self.apply(client)

    def apply(self, client: Any) -> None:
        """Apply the viewpoint in one browser."""
        aspect, position = client.camera.aspect, self.position(client.camera.aspect)
        offset = np.zeros(3)
        if aspect < NARROW_ASPECT:
            # The panel covers the lower half of a narrow screen.
            up = np.array([0.0, 0.0, 1.0]) - self.view[2] * self.view
            height = np.linalg.norm(position - self.target) * np.tan(FIELD_OF_VIEW / 2)
            offset = -0.45 * height * up / np.linalg.norm(up)
        with client.atomic():
            client.camera.position = position + offset
            client.camera.look_at = self.target + offset


def cameras(robot: ArmHand, q: Array, objects: Sequence[Drawable] = ()) -> dict[str, Camera]:
    """Return viewpoints by name for a robot at q (n,): each hand, and the whole robot.

    The first viewpoint is the initial one: the hand, or the whole robot if it has several hands.

    Args:
        robot: The robot.
        q: (n,) Configuration [rad or m].
        objects: Grasped objects in the base frame.
    """
    drawables, has_several_hands = visual_bodies(robot), len(robot.hands) > 1
    robot_drawables = bodies_at(robot, q, drawables)
    view = overview(robot.contacts(q)[0].mean(axis=0), close_view(robot, q))
    result = (
        {"Robot": _fitted_camera([*robot_drawables, *objects], view)} if has_several_hands else {}
    )
    for side in robot.hands:
        links = robot.description.side(side).links if side else robot.description.links
        hand = [
            posed
            for drawable, posed in zip(drawables, robot_drawables, strict=True)
            if drawable.role != "arm" and drawable.frame in links
        ]
        name = side.capitalize() if side and has_several_hands else "Hand"
        result[name] = _fitted_camera([*hand, *objects], close_view(robot, q, side), 1.15)
    return (
        result
        if has_several_hands
        else result | {"Robot": _fitted_camera([*robot_drawables, *objects], view)}
    )


def _fitted_camera(drawables: Sequence[Drawable], view: View, scale: float = 1.0) -> Camera:
    points = np.concatenate([drawable.surface.points for drawable in drawables])
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = scale * float(np.linalg.norm(points - center, axis=1).max())
    return Camera(center, max(radius, 0.05), view_axes(view)[2])


def add_lamp(server: viser.ViserServer, camera: Camera) -> None:
    """Add a spot light above the view; its shadows cost less than those of directional lights."""
    direction = np.array([0.55, -0.45, 1.9])
    server.scene.add_light_spot(
        "/light/lamp",
        color=(255, 250, 242),
        intensity=2.2,
        decay=0.0,
        angle=0.95,
        penumbra=0.3,
        position=tuple((camera.target + 2 * camera.radius * direction).tolist()),
        direction=tuple((-direction).tolist()),
        cast_shadow=True,
    )
