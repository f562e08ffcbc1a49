"""The page on which guessed pads are corrected: fingertips and normals dragged on the hand.

What is saved goes into the text of the description: all else in it stays as it was written.
"""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import asked_marks, bodies, collision_bodies, lowest
from casadi_ik.app.drawing.surfaces import facing
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.page import DraggedPage, in_turn
from casadi_ik.app.viewer.panel import block, legend, on_press, on_set
from casadi_ik.app.viewer.request import PageRequest, request_of
from casadi_ik.app.viewer.viser_scene import DrawnRobot, Handles, cameras, light_lamp
from casadi_ik.errors import CasadiIKError, DescriptionError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
from casadi_ik.files.writing import atomic_write
from casadi_ik.integrations.importing.surfaces import Surface, together
from casadi_ik.integrations.importing.write import vector
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.pose import inverse

GUESS, CORRECTED = "GUESS:", "corrected by hand"
"""What `casadi-ik import` marks a guess with, and what that becomes."""


@dataclass(frozen=True, eq=False)
class LinkPad:
    """A pad in the frame of the link that moves it.

    Attributes:
        point: (3,) [m].
        normal: (3,) outward, unit.
    """

    point: Array
    normal: Array


class PadPage(DraggedPage):
    """A hand whose pads are corrected, the robot at home.

    Attributes:
        path: Its description.
        said: What came of saving.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        path: Path,
        surfaces: Mapping[str, Surface],
        writable: bool = True,
        dark: bool = False,
    ) -> None:
        """Draw it.

        Args:
            server: What serves it.
            robot: The robot of the description.
            path: The description.
            surfaces: What its files show, by link.
            writable: Whether whoever sees the page may have the file written.
            dark: Whether the page is dark.
        """
        skin = [one for one in bodies(robot) if one.role != "pad"]
        asked = request_of(robot, None, None)
        super().__init__(server, robot, asked, f"pads of {robot.name}", lowest(robot), dark)
        self.path, self.said, self._first = path, "", asked
        self._surfaces, self._links = dict(surfaces), robot.links(robot.home)
        contacts = asked.grasp.contacts.values()
        marks = [mark for one in contacts for mark in asked_marks(one, one.point)]
        camera = next(iter(cameras(robot, robot.home, marks).values()))
        camera.show(server)
        light_lamp(server, camera)
        self._drawn = DrawnRobot(server, robot, skin=skin)
        self._handles = Handles(server, asked, self)
        self._add_panel(writable)
        self.begin()
        self.select(robot.fingers[0])

    def selected(self, name: str) -> None:
        """Show which pad has handles."""
        self._handles.select(name)
        if self._chosen.value != name:
            self._chosen.value = name

    def changed_by_hand(self) -> None:
        """What was said of another state is not said of this one."""
        self.said = ""

    def onto_skin(self, finger: str) -> None:
        """Put a pad where its normal's line meets the skin, and face as the skin does there."""

        def put(asked: PageRequest) -> PageRequest:
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

        self.change(f"skin {finger}", put)

    @in_turn
    def save(self) -> None:
        """Write what was changed into the description."""
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

    @property
    def changed(self) -> list[str]:
        """Fingers whose pads are not as in the file."""
        return [
            name
            for name, held in self.asked.held.items()
            if not np.allclose(held.control, self._first.held[name].control, atol=1e-7)
        ]

    def pads(self, asked: PageRequest) -> dict[str, LinkPad]:
        """The pads in the frames of their links."""
        found: dict[str, LinkPad] = {}
        for finger, held in asked.held.items():
            link = self.robot.description.finger(finger).link
            local = inverse(self._links[link]) @ held.control
            found[finger] = LinkPad(local[:3, 3], local[:3, 0])
        return found

    def _skin(self, link: str) -> Surface | None:
        """All that moves with a link, in its frame."""
        rigid, back = {link}, inverse(self._links[link])
        for joint in self.robot.description.joints:
            if joint.type == "fixed" and joint.parent in rigid:
                rigid.add(joint.child)
        skins = [one for one in collision_bodies(self.robot) if one.frame not in self._surfaces]
        parts = [(one.frame, one.surface) for one in skins] + list(self._surfaces.items())
        return together([one.moved(back @ self._links[at]) for at, one in parts if at in rigid])

    def _add_panel(self, writable: bool) -> None:
        gui = self.server.gui
        self._told = gui.add_html("")
        self._chosen = gui.add_dropdown("Pad", self.robot.fingers)
        skin = gui.add_button("Put it on the skin", icon=None)
        self.add_steps()
        self._save = gui.add_button(
            f"Save to {self.path.name}", icon=None, color="green", disabled=not writable
        )
        gui.add_html(legend([(palette.TARGET, "pad and its normal: drag ball, arrow, rings")]))
        if writable:  # a disabled button can be pressed by who writes the messages by hand
            on_press(self._save, lambda _: self.save())
        on_set(self._chosen, lambda finger: self.select(str(finger)))
        on_press(skin, lambda _: self.onto_skin(str(self._chosen.value)))
        self.add_dark()

    def refresh(self) -> None:
        """Draw the pads and what is said of them."""
        with self.server.atomic():
            self._handles.place(self.asked, self._dragged)
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
            color = palette.LINES[0] if new else "inherit"
            rows.append(
                f'<tr style="color:{color}" class="ik-pad"><td><b>{html.escape(finger)}</b><br>'
                f'<span style="color:{palette.FAINT}">{html.escape(link)}</span></td>'
                f'<td style="{cell}">{point} mm<br>{normal}</td>'
                f'<td style="{cell}">{moved}</td></tr>'
            )
        table = f'<table style="width:100%;border-collapse:collapse">{"".join(rows)}</table>'
        said = f'<div class="ik-said"><b>{html.escape(self.said)}</b></div>' if self.said else ""
        return block(table + said, 0.72)


# Files.


def save_pads(path: Path, pads: Mapping[str, LinkPad]) -> None:
    """Write corrected pads into a description; what was written is read back before it counts.

    Args:
        path: The description.
        pads: By finger.

    Raises:
        DescriptionError: The description does not state its pads, or cannot be written.
    """
    with os_errors(f"{path}: cannot be read", DescriptionError):
        text = path.read_text(encoding="utf-8")
    frames = read_yaml(path).get("fingers")
    if not isinstance(frames, dict):
        raise DescriptionError(f"{path}: fingers: expected the pads of the fingers, by name")
    before = load_description(path)
    for finger, pad in pads.items():
        entry = frames.get(finger)
        if not isinstance(entry, dict):
            raise DescriptionError(f"{path}: fingers.{finger}: missing, expected a pad")
        place = before.finger(finger).placement
        xyz, rpy = (tuple(entry.get(key, (0.0, 0.0, 0.0))) for key in ("xyz", "rpy"))
        # The link that the file names may be fixed to the one that moves.
        named = place @ inverse(frame_matrix(Frame(xyz, rpy)))
        point = (inverse(named) @ np.append(pad.point, 1.0))[:3]
        text = corrected(text, finger, point, place[:3, :3].T @ pad.normal)
    refused = os_errors(f"{path}: cannot be written", DescriptionError)
    with refused, atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
        _check(part, pads)


def corrected(text: str, finger: str, point: Array, normal: Array) -> str:
    """A description with another pad.

    Args:
        text: The YAML.
        finger: Whose pad.
        point: (3,) in the link's frame [m].
        normal: (3,) in the contact frame.

    Raises:
        DescriptionError: The text has no such pad.
    """
    key, entry = _finger(text, finger)
    values = {"xyz": vector(point, 7), "normal": vector(normal, 7)}
    edits: list[tuple[int, int, str]] = []
    there = {name.value: value for name, value in entry.value}
    for name, value in values.items():
        if name in there:
            node = there[name]
            edits.append((node.start_mark.index, node.end_mark.index, value))
        elif entry.flow_style:
            edits.append((entry.end_mark.index - 1, entry.end_mark.index - 1, f", {name}: {value}"))
        else:
            first, _ = entry.value[0]
            indent = " " * first.start_mark.column
            at = first.start_mark.index
            edits.append((at, at, f"{name}: {value}\n{indent}"))
    for start, end, value in sorted(edits, reverse=True):
        text = text[:start] + value + text[end:]
    return _marked(text, key.start_mark.line)


def _finger(text: str, finger: str) -> tuple[yaml.ScalarNode, yaml.MappingNode]:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for above in ("fingers", finger):
        pairs = root.value if isinstance(root, yaml.MappingNode) else []
        found = next(((key, value) for key, value in pairs if key.value == above), None)
        if found is None:
            raise DescriptionError(f"fingers.{finger}: not in the description")
        key, root = found
    if not isinstance(root, yaml.MappingNode):
        raise DescriptionError(f"fingers.{finger}: expected a pad (link, xyz, normal)")
    return key, root


def _marked(text: str, line: int) -> str:
    """The comment above a finger says that it is no guess any more, and what the guess was."""
    lines = text.split("\n")
    above = lines[line - 1] if line else ""
    indent = re.match(r"\s*", lines[line])
    if above.lstrip().startswith("#") and GUESS in above:
        lines[line - 1] = above.replace(GUESS, f"{CORRECTED}; the guess was:")
    elif CORRECTED not in above:
        lines.insert(line, f"{indent[0] if indent else ''}# {CORRECTED}")
    return "\n".join(lines)


def _check(part: Path, pads: Mapping[str, LinkPad]) -> None:
    """See to it that what was written is what was meant.

    Raises:
        DescriptionError: It is not.
    """
    description = load_description(part)
    for finger, pad in pads.items():
        found = description.finger(finger)
        normal = found.placement[:3, :3] @ found.normal
        point = found.placement[:3, 3]
        if np.abs(np.concatenate([point - pad.point, normal - pad.normal])).max() > 1e-6:
            raise DescriptionError(f"fingers.{finger}: could not be corrected in the text")


# The skin.


def on_skin(surface: Surface, point: Array, normal: Array) -> tuple[Array, Array] | None:
    """The point where a pad's normal comes out of the skin, and the skin's normal there.

    The skin is looked for from 6 cm along the normal; how it faces is told by four points 2 mm
    about.

    Args:
        surface: Of what moves with the pad.
        point: (3,) the pad as it is [m].
        normal: (3,) its normal, unit.

    Returns:
        (3,) and (3,); None: the normal's line does not meet the skin.
    """
    start = point + 0.06 * normal
    found = surface.hit(start, -normal)
    if found is None:
        return None
    x, y = 0.002 * facing(point, normal)[:3, 1:3].T
    hits = (surface.hit(start + step, -normal) for step in (x, y, -x, -y))
    about = [one for one in hits if one is not None]
    if len(about) < 4:
        return found, normal
    right, up, left, down = about
    way = np.cross(right - left, up - down)
    return found, way / np.linalg.norm(way)
