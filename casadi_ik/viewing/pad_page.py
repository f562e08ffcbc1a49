"""The page on which guessed pads are corrected: fingertips and normals dragged on the hand."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import CasadiIKError
from casadi_ik.grasps.pose import inverse
from casadi_ik.importing.surfaces import Surface, together
from casadi_ik.viewing.asked import Asked, asked_of
from casadi_ik.viewing.drawn_contacts import Drags, DrawnContacts
from casadi_ik.viewing.drawn_robot import DrawnRobot
from casadi_ik.viewing.newest import Newest
from casadi_ik.viewing.pad_text import LinkPad, save_pads
from casadi_ik.viewing.robot_parts import robot_parts
from casadi_ik.viewing.skin import on_skin
from casadi_ik.viewing.stage import legend, look_at_hand, set_stage
from casadi_ik.viewing.words import block

LEGEND = ((palette.TARGET, "pad and its outward normal: drag ball, arrow, rings"),)


class PadPage:
    """A hand whose pads are corrected; all of it belongs to the thread of `work`.

    Attributes:
        robot: The robot.
        path: Its description.
        asked: The pads as contacts, in the base frame, the robot at home.
        work: What everything is done by.
        said: What came of saving.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        path: Path,
        surfaces: Mapping[str, Surface],
        writable: bool = True,
    ) -> None:
        """Draw it.

        Args:
            server: The page.
            robot: The robot of the description.
            path: The description.
            surfaces: What its files show, by link.
            writable: Whether whoever sees the page may have the file written.
        """
        self.server, self.robot, self.path, self.said = server, robot, path, ""
        self._surfaces = dict(surfaces)
        self.asked = self._first = asked_of(robot, None, None)
        self._links, self._dragged = robot.links(robot.home), ""
        parts = robot_parts(robot, surfaces)
        lowest = min(
            float(part.surface.moved(self._links[part.link]).points[:, 2].min()) for part in parts
        )
        set_stage(server, f"pads of {robot.name}", min(lowest, 0.0))
        look_at_hand(server, robot, robot.home)
        # Paler than elsewhere, so that edges and skin are seen.
        self._drawn = DrawnRobot(
            server, robot, [replace(part, color=palette.FAINT) for part in parts]
        )
        self._contacts = DrawnContacts(
            server,
            self.asked,
            Drags(self.drag_control, self.drag_point, self.drag_normal, self.select),
            tips=False,
            size=0.7,
        )
        self._add_panel(writable)
        self.work = Newest(self._draw)
        self.select(robot.fingers[0])

    def drag_control(self, finger: str, pose: Array) -> None:
        """A pad dragged by its control to a (4, 4) pose."""
        self._change(finger, lambda asked: asked.with_control(finger, pose), finger)

    def drag_point(self, finger: str, point: Array) -> None:
        """A pad dragged by its ball to a point (3,)."""
        self._change(finger, lambda asked: asked.with_point(finger, point))

    def drag_normal(self, finger: str, normal: Array) -> None:
        """A pad turned to face a way (3,)."""
        self._change(finger, lambda asked: asked.with_normal(finger, normal))

    def select(self, finger: str) -> None:
        """Give a pad its handles."""

        def work() -> None:
            self._contacts.select(finger)
            if self._chosen.value != finger:
                self._chosen.value = finger

        self.work.put("selected", work)

    def onto_skin(self, finger: str) -> None:
        """Put a pad where its normal's line meets the skin, and face as the skin does there."""

        def put(asked: Asked) -> Asked:
            link = self.robot.description.finger(finger).link
            surface = self._skin(link)
            if surface is None or not len(surface.triangles):
                self.said = f"{finger}: its link has no shape to be put on"
                return asked
            pad = self.pads(asked)[finger]
            found = on_skin(surface, pad.point, pad.normal)
            if found is None:
                self.said = f"{finger}: its normal's line does not meet the skin"
                return asked
            pose = self._links[link]
            moved = asked.with_point(finger, (pose @ np.append(found[0], 1.0))[:3])
            moved = moved.with_normal(finger, pose[:3, :3] @ found[1])
            if np.allclose(moved.held[finger].control, asked.held[finger].control, atol=1e-7):
                self.said = f"{finger}: it is on the skin, and faces as the skin does"
            return moved

        self._change(f"skin {finger}", put)

    def reset(self) -> None:
        """The pads as the file has them."""
        self._change("reset", lambda _: self._first)

    def save(self) -> None:
        """Write what was changed into the description."""

        def work() -> None:
            changed = {name: self.pads(self.asked)[name] for name in self.changed}
            if not changed:
                self.said = "nothing was changed"
                return
            try:
                save_pads(self.path, changed)
            except CasadiIKError as error:
                self.said = str(error)
                return
            self._first = self.asked
            self.said = f"saved to {self.path.name}: {', '.join(changed)}"

        self.work.put("save", work)

    @property
    def changed(self) -> list[str]:
        """Fingers whose pads are not as in the file."""
        return [
            name
            for name, held in self.asked.held.items()
            if not np.allclose(held.control, self._first.held[name].control, atol=1e-7)
        ]

    def pads(self, asked: Asked) -> dict[str, LinkPad]:
        """The pads in the frames of their links."""
        found: dict[str, LinkPad] = {}
        for finger, held in asked.held.items():
            link = self.robot.description.finger(finger).link
            local = inverse(self._links[link]) @ held.control
            found[finger] = LinkPad(local[:3, 3], local[:3, 0])
        return found

    def stop(self) -> None:
        """End its thread."""
        self.work.stop()

    def _change(self, key: str, change: Callable[[Asked], Asked], dragged: str = "") -> None:
        def work() -> None:
            self.said = ""
            self.asked, self._dragged = change(self.asked), dragged

        self.work.put(key, work)

    def _skin(self, link: str) -> Surface | None:
        """All that moves with a link, in its frame."""
        rigid, back = {link}, inverse(self._links[link])
        for joint in self.robot.description.joints:
            if joint.type == "fixed" and joint.parent in rigid:
                rigid.add(joint.child)
        skins = {part.link: part.surface for part in robot_parts(self.robot)} | self._surfaces
        return together([skins[one].moved(back @ self._links[one]) for one in skins.keys() & rigid])

    def _add_panel(self, writable: bool) -> None:
        gui = self.server.gui
        self._told = gui.add_html("")
        self._chosen = gui.add_dropdown("Pad", self.robot.fingers)
        skin = gui.add_button("Put it on the skin", icon=None)
        back = gui.add_button("As in the file", icon=None, color="gray")
        self._save = gui.add_button(
            f"Save to {self.path.name}", icon=None, color="green", disabled=not writable
        )
        gui.add_html(legend(LEGEND))
        if writable:  # a disabled button can be pressed by who writes the messages by hand

            @self._save.on_click
            async def _(_: Any) -> None:
                self.save()

        @self._chosen.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self.select(str(self._chosen.value))

        @skin.on_click
        async def _(_: Any) -> None:
            self.onto_skin(str(self._chosen.value))

        @back.on_click
        async def _(_: Any) -> None:
            self.reset()

    def _draw(self) -> None:
        with self.server.atomic():
            self._contacts.place(self.asked, self._dragged)
            self._told.content = self._words()
        self.server.flush()
        self._dragged = ""

    def _words(self) -> str:
        changed, rows = self.changed, []
        cell = "padding:0.1em 0 0.1em 0.8em;text-align:right;font-variant-numeric:tabular-nums"
        before = self.pads(self._first)
        for finger, pad in self.pads(self.asked).items():
            new = finger in changed
            step = 1e3 * float(np.linalg.norm(pad.point - before[finger].point))
            cosine = float(np.clip(pad.normal @ before[finger].normal, -1.0, 1.0))
            turn = float(np.rad2deg(np.arccos(cosine)))
            moved = f"{step:.1f} mm, {turn:.1f}°" if new else "as in the file"
            link = self.robot.description.finger(finger).link
            point = " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in pad.point)
            normal = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in pad.normal)
            color = palette.LINES[0] if new else palette.INK
            rows.append(
                f'<tr style="color:{color}" class="ik-pad"><td><b>{html.escape(finger)}</b><br>'
                f'<span style="color:{palette.FAINT}">{html.escape(link)}</span></td>'
                f'<td style="{cell}">{point} mm<br>{normal}</td>'
                f'<td style="{cell}">{moved}</td></tr>'
            )
        table = f'<table style="width:100%;border-collapse:collapse">{"".join(rows)}</table>'
        said = f'<div class="ik-said"><b>{html.escape(self.said)}</b></div>' if self.said else ""
        return block(table + said, 0.72)
