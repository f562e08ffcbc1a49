"""The object and what stands about the robot, on a page, to be dragged."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Item, Scene
from casadi_ik.errors import UnknownNameError
from casadi_ik.grasps import load_object
from casadi_ik.grasps.pose import inverse
from casadi_ik.importing.surfaces import Surface
from casadi_ik.viewing.asked import Asked
from casadi_ik.viewing.bodies import body_of, sharp
from casadi_ik.viewing.frames import pose_of, quaternion

OBJECT = "object"
"""What the object is called among the things that can be dragged."""

SIZE = 0.16
"""Of the control of a thing [m]."""


def draw_scene(server: viser.ViserServer, scene: Scene, above: str) -> None:
    """Draw what stands about a robot, to be looked at only.

    Args:
        server: The page.
        scene: The scene.
        above: The node that the robot's base is.
    """
    for name, item in scene.items.items():
        for i, surface in enumerate(_item_surfaces(item)):
            server.scene.add_mesh_simple(
                f"{above}/things/{name}/{i}",
                surface.points.astype(np.float32),
                surface.triangles.astype(np.uint32),
                color=palette.rgb(palette.SCENE),
                opacity=0.8,
                position=item.pose[:3, 3],
                wxyz=quaternion(item.pose[:3, :3]),
                cast_shadow=False,
                receive_shadow=0.15,
            )


def lowest(scene: Scene | None) -> float:
    """Height of the ground: that of the robot's base, or below all that stands there [m]."""
    heights = [0.0]
    for item in () if scene is None else scene.items.values():
        for solid, place in item.parts:
            if np.isfinite(solid.reach):
                points = body_of(solid, np.zeros(3)).moved(item.pose @ place).points
                heights.append(float(points[:, 2].min()) - 1e-3)
            else:
                heights.append(float((item.pose @ place)[2, 3]) - 4e-3)
    return min(heights)


class DrawnThings:
    """The object that is grasped and the items of the scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        asked: Asked,
        moved: Callable[[str, Array], None],
        selected: Callable[[str], None],
    ) -> None:
        """Draw them.

        Args:
            server: The page.
            asked: What is asked first.
            moved: Told of a thing and its new (4, 4) pose when it is dragged.
            selected: Told of a thing that is clicked.
        """
        self._controls: dict[str, viser.TransformControlsHandle] = {}
        self._poses: dict[str, Array] = {}
        surface = _object_surface(asked.object)
        if surface is not None and asked.object_pose is not None:
            self._add(server, OBJECT, [(surface, palette.OBJECT, 0.4)], moved, selected)
        for name, item in () if asked.scene is None else asked.scene.items.items():
            if name != asked.object:
                parts = [(one, palette.SCENE, 0.8) for one in _item_surfaces(item)]
                self._add(server, name, parts, moved, selected)
        self.place(asked)

    @property
    def names(self) -> tuple[str, ...]:
        """What can be dragged."""
        return tuple(self._controls)

    def place(self, asked: Asked, dragged: str = "") -> None:
        """Put everything where it is; what is being dragged is where the hand has it."""
        for name, control in self._controls.items():
            if name == OBJECT and asked.object_pose is not None:
                pose = asked.object_pose
            elif asked.scene is not None and name in asked.scene.items:
                pose = asked.scene.items[name].pose
            else:
                continue
            if pose is self._poses.get(name):
                continue
            self._poses[name] = pose
            if name == dragged:
                continue
            control.position, control.wxyz = pose[:3, 3], quaternion(pose[:3, :3])

    def select(self, name: str) -> None:
        """Give one thing its arrows and rings to be dragged by."""
        for other, control in self._controls.items():
            off = other != name
            control.disable_axes = control.disable_sliders = control.disable_rotations = off

    def _add(
        self,
        server: viser.ViserServer,
        name: str,
        parts: list[tuple[Surface, str, float]],
        moved: Callable[[str, Array], None],
        selected: Callable[[str], None],
    ) -> None:
        control = server.scene.add_transform_controls(
            f"/things/{name}",
            scale=SIZE,
            line_width=3.0,
            depth_test=False,
            disable_axes=True,
            disable_sliders=True,
            disable_rotations=True,
        )
        self._controls[name] = control

        @control.on_update
        async def _(_: Any) -> None:
            with suppress(ValueError):
                moved(name, pose_of(control.position, control.wxyz))

        for i, (surface, color, opacity) in enumerate(parts):
            mesh = server.scene.add_mesh_simple(
                f"/things/{name}/{i}",
                surface.points.astype(np.float32),
                surface.triangles.astype(np.uint32),
                color=palette.rgb(color),
                opacity=opacity,
                cast_shadow=name == OBJECT,
                receive_shadow=0.15,
            )

            @mesh.on_click
            async def _(_: Any) -> None:
                selected(name)


def _object_surface(name: str) -> Surface | None:
    if not name:
        return None
    try:
        points, triangles = load_object(name).mesh(48)
    except UnknownNameError:
        return None
    return sharp(Surface(points, np.asarray(triangles, dtype=np.int64)))


def _item_surfaces(item: Item) -> list[Surface]:
    about = inverse(item.pose)[:3, 3]
    return [
        body_of(solid, inverse(place)[:3] @ np.append(about, 1.0)).moved(place)
        for solid, place in item.parts
    ]
