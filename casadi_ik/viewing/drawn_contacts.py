"""Contacts on a page: what is asked, to be dragged, and what is reached."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arrays import Array
from casadi_ik.importing.surfaces import Surface, together
from casadi_ik.problem.verdict import ContactVerdict
from casadi_ik.viewing.asked import Asked, Held
from casadi_ik.viewing.bodies import arrow, ball, tube
from casadi_ik.viewing.frames import facing, pose_of, quaternion, usable
from casadi_ik.viewing.words import errors

SIZE = 0.06
"""Of a contact's control [m]."""

BEYOND = 0.04
"""Half the length of what is drawn of a line, radius of what is drawn of a plane [m]."""

Dragged = Callable[[str, Array], None]
"""What is told of a finger and what it was given: a pose (4, 4), a point or a normal (3,)."""


@dataclass(frozen=True)
class Drags:
    """Who is told of drags."""

    control: Dragged
    point: Dragged
    normal: Dragged
    selected: Callable[[str], None]


class DrawnContacts:
    """The contacts of all fingers."""

    def __init__(
        self,
        server: viser.ViserServer,
        asked: Asked,
        drags: Drags,
        name: str = "",
        tips: bool = True,
        size: float = 1.0,
    ) -> None:
        """Draw them.

        Args:
            server: The page.
            asked: What is asked first.
            drags: Who is told.
            name: Of the node that they hang on; "": the base frame.
            tips: Whether what is reached is drawn too.
            size: Of the marks, as a part of the usual.
        """
        self._targets = {
            finger: _Target(server, finger, held, drags, name, size)
            for finger, held in asked.held.items()
        }
        self._tips = {finger: _Tip(server, finger, name) for finger in asked.held if tips}
        self.place(asked)

    def place(self, asked: Asked, dragged: str = "") -> None:
        """Put the targets where they are; one that is being dragged is where the hand has it."""
        for finger, held in asked.held.items():
            self._targets[finger].place(held, moved=finger != dragged)

    def reach(
        self, asked: Asked, frames: Mapping[str, Array], verdicts: Mapping[str, ContactVerdict]
    ) -> None:
        """Put the fingertips where they are: frames (4, 4) with the normal as x axis."""
        for finger, tip in self._tips.items():
            held = asked.held[finger]
            tip.place(frames[finger], held, verdicts.get(finger) if held.used else None)

    def select(self, finger: str) -> None:
        """Give one contact its arrows and rings to be dragged by; "" none."""
        for name, target in self._targets.items():
            target.handles(name == finger)


class _Target:
    """What is asked of a finger."""

    def __init__(
        self,
        server: viser.ViserServer,
        finger: str,
        held: Held,
        drags: Drags,
        above: str,
        size: float,
    ) -> None:
        contact, name = held.contact, f"{above}/contacts/{finger}"
        self._held: Held | None = None
        self.control = server.scene.add_transform_controls(
            name, scale=size * SIZE, line_width=3.0, depth_test=False
        )
        color = palette.rgb(palette.TARGET)

        def mesh(part: str, surface: Surface, opacity: float | None = None) -> Any:
            return server.scene.add_mesh_simple(
                f"{name}/{part}",
                surface.points.astype(np.float32),
                surface.triangles.astype(np.uint32),
                color=color,
                opacity=opacity,
                cast_shadow=False,
            )

        self._parts = [mesh("point", ball(size * 0.0065))]
        self._arrow = mesh("normal", arrow(size * 0.045, size * 0.0052))
        if contact.line is not None:
            ends = contact.point - BEYOND * contact.line, contact.point + BEYOND * contact.line
            self._parts.append(mesh("line", tube(*ends, 0.002)))
        if contact.plane is not None:
            disc = tube(np.zeros(3), np.zeros(3), BEYOND)
            flat = Surface(disc.points * np.array([0.02, 1.0, 1.0]), disc.triangles)
            self._parts.append(
                mesh("plane", flat.moved(facing(contact.point, contact.plane)), opacity=0.35)
            )
        self._connect(finger, drags)
        self.handles(False)

    def _connect(self, finger: str, drags: Drags) -> None:
        # Asynchronous callbacks keep their order; they only put down what is to be done. What is
        # no place is left out: viser would tell the terminal.
        @self.control.on_update
        async def _(_: Any) -> None:
            with suppress(ValueError):
                drags.control(finger, pose_of(self.control.position, self.control.wxyz))

        for part in self._parts:

            @part.on_drag("left")
            async def _(event: Any) -> None:
                with suppress(ValueError):
                    drags.point(finger, usable(event.end_position, 3))

            @part.on_click
            async def _(_: Any) -> None:
                drags.selected(finger)

        @self._arrow.on_drag("left")
        async def _(event: Any) -> None:
            with suppress(ValueError):
                way = usable(event.end_position, 3) - usable(self.control.position, 3)
                if np.linalg.norm(way) > 1e-3:
                    drags.normal(finger, way)

        @self._arrow.on_click
        async def _(_: Any) -> None:
            drags.selected(finger)

    def place(self, held: Held, moved: bool) -> None:
        if held is self._held:
            return
        self._held = held
        if moved:
            self.control.position = held.control[:3, 3]
            self.control.wxyz = quaternion(held.control[:3, :3])
        for part in self._parts:
            part.visible = held.used
        self._arrow.visible = held.used and held.normal

    def handles(self, on: bool) -> None:
        control = self.control
        control.disable_axes = control.disable_sliders = control.disable_rotations = not on


class _Tip:
    """What a finger reaches."""

    def __init__(self, server: viser.ViserServer, finger: str, above: str) -> None:
        scene, name = server.scene, f"{above}/tips/{finger}"
        self._frame = scene.add_frame(name, show_axes=False)
        # One mesh for point and normal: what a frame costs is counted in meshes.
        surface = together([ball(0.0048), arrow(0.062, 0.0026)])
        assert surface is not None
        self._mesh = scene.add_mesh_simple(
            f"{name}/reached", surface.points, surface.triangles, cast_shadow=False
        )
        self._label = scene.add_label(
            f"{name}/errors", "", anchor="bottom-center", font_screen_scale=0.85, visible=False
        )
        self._gap = scene.add_line_segments(
            f"{above}/gaps/{finger}",
            np.zeros((1, 2, 3), dtype=np.float32),
            palette.rgb(palette.MISSED),
            thickness=0.0016,
            visible=False,
        )
        self._finger = finger

    def place(self, frame: Array, held: Held, verdict: ContactVerdict | None) -> None:
        self._frame.position, self._frame.wxyz = frame[:3, 3], quaternion(frame[:3, :3])
        met = verdict is None or verdict.ok
        color = palette.FAINT if verdict is None else palette.MET if met else palette.MISSED
        if self._mesh.color != palette.rgb(color):
            self._mesh.color = palette.rgb(color)
        self._gap.visible = self._label.visible = not met
        if verdict is not None and not met:
            ends = np.stack([frame[:3, 3], held.control[:3, 3]])[None]
            self._gap.points = ends.astype(np.float32)
            self._label.text = f"{self._finger}  {errors(verdict)}"
