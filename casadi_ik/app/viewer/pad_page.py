"""The page on which guessed pads of an imported robot are corrected by dragging.

Pads are written into the text of the description; the rest of the text is unchanged.
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
from casadi_ik.app.drawing.drawables import (
    collision_bodies,
    ground_height,
    target_marks,
    visual_bodies,
)
from casadi_ik.app.drawing.surfaces import pose_with_x_axis
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.camera import add_lamp, cameras
from casadi_ik.app.viewer.page import InteractivePage, on_page_thread
from casadi_ik.app.viewer.panel import block, legend, on_press, on_set
from casadi_ik.app.viewer.request import PageRequest, request_of
from casadi_ik.app.viewer.viser_scene import Handles, RobotView
from casadi_ik.errors import CasadiIKError, DescriptionError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
from casadi_ik.files.writing import atomic_write
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
from casadi_ik.integrations.importing.write import vector
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.pose import inverse

GUESS_MARK, CORRECTED_MARK = "GUESS:", "corrected by hand"
"""Mark of a guess in comments of `casadi-ik import`, and its replacement for corrected pads."""


@dataclass(frozen=True, eq=False)
class LinkPad:
    """A pad in the frame of its moving link.

    Attributes:
        point: (3,) Contact point [m].
        normal: (3,) Unit normal, outward.
    """

    point: Array
    normal: Array


class PadPage(InteractivePage):
    """A page with a hand at home and its draggable pads.

    Attributes:
        path: Path of the description.
        message: Result of the last action.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        path: Path,
        surfaces: Mapping[str, IndexedMesh],
        writable: bool = True,
        dark: bool | None = None,
    ) -> None:
        """Draw the hand and its pads.

        Args:
            server: Server of the page.
            robot: Robot of the description.
            path: Path of the description.
            surfaces: Meshes of the robot's files by link.
            writable: Allow users of the page to save.
            dark: Use the dark theme; None: follow the browser.
        """
        drawables = [drawable for drawable in visual_bodies(robot) if drawable.role != "pad"]
        request = request_of(robot, None, None)
        super().__init__(
            server, robot, request, f"pads of {robot.name}", ground_height(robot), dark
        )
        self.path, self.message, self._initial_request = path, "", request
        self._surfaces, self._links = dict(surfaces), robot.links(robot.home)
        contacts = request.grasp.contacts.values()
        marks = [mark for contact in contacts for mark in target_marks(contact, contact.point)]
        camera = next(iter(cameras(robot, robot.home, marks).values()))
        camera.show(server)
        add_lamp(server, camera)
        self._robot_view = RobotView(server, robot, drawables=drawables)
        self._handles = Handles(server, request, self)
        self._add_panel(writable)
        self.start()
        self.select(robot.fingers[0])

    def show_selection(self, name: str) -> None:
        """Show the handles of the selected pad."""
        self._handles.select(name)
        if self._finger_menu.value != name:
            self._finger_menu.value = name

    def on_request_change(self) -> None:
        """Clear the message of the previous state."""
        self.message = ""

    def snap_to_surface(self, finger: str) -> None:
        """Move a pad along its normal onto the surface, and align it with the surface."""

        def snap(request: PageRequest) -> PageRequest:
            link = self.robot.description.finger(finger).link
            surface = self._link_surface(link)
            if surface is None or not len(surface.triangles):
                self.message = f"{finger}: {link} has no mesh to snap to"
                return request
            pad = self.pads(request)[finger]
            hit = surface_hit(surface, pad.point, pad.normal)
            if hit is None:
                self.message = f"{finger}: the line along the normal does not meet the surface"
                return request
            pose = self._links[link]
            snapped = request.with_point(finger, (pose @ np.append(hit[0], 1.0))[:3])
            snapped = snapped.with_normal(finger, pose[:3, :3] @ hit[1])
            if np.allclose(
                snapped.contacts[finger].control, request.contacts[finger].control, atol=1e-7
            ):
                self.message = f"{finger}: the pad is on the surface already"
            return snapped

        self.change(f"snap {finger}", snap)

    @on_page_thread
    def save(self) -> None:
        """Write the changed pads into the description."""
        changed_fingers = {name: self.pads(self.request)[name] for name in self.changed_fingers}
        if not changed_fingers:
            self.message = "no pad was changed"
            return
        try:
            save_pads(self.path, changed_fingers)
        except CasadiIKError as error:
            self.message = str(error)
            return
        self._initial_request = self.request
        self.message = f"saved to {self.path.name}: {', '.join(changed_fingers)}"

    @property
    def changed_fingers(self) -> list[str]:
        """Fingers whose pads differ from the file."""
        return [
            name
            for name, contact in self.request.contacts.items()
            if not np.allclose(
                contact.control, self._initial_request.contacts[name].control, atol=1e-7
            )
        ]

    def pads(self, request: PageRequest) -> dict[str, LinkPad]:
        """Return the pads of a request in the frames of their links."""
        pads_by_finger: dict[str, LinkPad] = {}
        for finger, contact in request.contacts.items():
            link = self.robot.description.finger(finger).link
            local = inverse(self._links[link]) @ contact.control
            pads_by_finger[finger] = LinkPad(local[:3, 3], local[:3, 0])
        return pads_by_finger

    def _link_surface(self, link: str) -> IndexedMesh | None:
        """Return the surface that moves rigidly with a link, in its frame."""
        rigid_links, to_link = {link}, inverse(self._links[link])
        for joint in self.robot.description.joints:
            if joint.type == "fixed" and joint.parent in rigid_links:
                rigid_links.add(joint.child)
        drawables = [
            drawable
            for drawable in collision_bodies(self.robot)
            if drawable.frame not in self._surfaces
        ]
        parts = [(drawable.frame, drawable.surface) for drawable in drawables] + list(
            self._surfaces.items()
        )
        return merge_meshes(
            [
                surface.transformed(to_link @ self._links[frame])
                for frame, surface in parts
                if frame in rigid_links
            ]
        )

    def _add_panel(self, writable: bool) -> None:
        gui = self.server.gui
        self._table = gui.add_html("")
        self._finger_menu = gui.add_dropdown("Pad", self.robot.fingers)
        snap_button = gui.add_button("Snap to surface", icon=None)
        self.add_undo_buttons()
        self._save_button = gui.add_button(
            f"Save to {self.path.name}", icon=None, color="green", disabled=not writable
        )
        gui.add_html(legend([(palette.TARGET, "pad and normal: drag ball, arrow or rings")]))
        if writable:  # a crafted message can press a disabled button
            on_press(self._save_button, lambda _: self.save())
        on_set(self._finger_menu, lambda finger: self.select(str(finger)))
        on_press(snap_button, lambda _: self.snap_to_surface(str(self._finger_menu.value)))
        self.add_theme_switch()

    def refresh(self) -> None:
        """Draw the pads, their table, and the message."""
        with self.server.atomic():
            self._handles.update(self.request, self._dragged)
            self._table.content = self._panel_html()
        self.server.flush()
        self._dragged = ""

    def _panel_html(self) -> str:
        changed_fingers, rows = self.changed_fingers, []
        cell = "padding:0.1em 0 0.1em 0.8em;text-align:right;font-variant-numeric:tabular-nums"
        initial_pads = self.pads(self._initial_request)
        for finger, pad in self.pads(self.request).items():
            is_changed = finger in changed_fingers
            distance = 1e3 * float(np.linalg.norm(pad.point - initial_pads[finger].point))
            cosine = float(np.clip(pad.normal @ initial_pads[finger].normal, -1.0, 1.0))
            angle = float(np.rad2deg(np.arccos(cosine)))
            change = f"{distance:.1f} mm, {angle:.1f}°" if is_changed else "as in the file"
            link = self.robot.description.finger(finger).link
            point = " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in pad.point)
            normal = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in pad.normal)
            color = palette.LINE_COLORS[0] if is_changed else "inherit"
            rows.append(
                f'<tr style="color:{color}" class="ik-pad"><td><b>{html.escape(finger)}</b><br>'
                f'<span style="color:{palette.FAINT}">{html.escape(link)}</span></td>'
                f'<td style="{cell}">{point} mm<br>{normal}</td>'
                f'<td style="{cell}">{change}</td></tr>'
            )
        rows_html = f'<table style="width:100%;border-collapse:collapse">{"".join(rows)}</table>'
        message = (
            f'<div class="ik-said"><b>{html.escape(self.message)}</b></div>' if self.message else ""
        )
        return block(rows_html + message, 0.72)


# Files.


def save_pads(path: Path, pads: Mapping[str, LinkPad]) -> None:
    """Write corrected pads into a description, and verify them by reading the file back.

    Args:
        path: Path of the description.
        pads: Pads by finger.

    Raises:
        DescriptionError: The description does not list pads, or cannot be written.
    """
    with os_errors(f"{path}: cannot be read", DescriptionError):
        text = path.read_text(encoding="utf-8")
    frames = read_yaml(path).get("fingers")
    if not isinstance(frames, dict):
        raise DescriptionError(f"{path}: fingers: expected pads by finger")
    description = load_description(path)
    for finger, pad in pads.items():
        entry = frames.get(finger)
        if not isinstance(entry, dict):
            raise DescriptionError(f"{path}: fingers.{finger}: missing, expected a pad")
        placement = description.finger(finger).placement
        xyz, rpy = (tuple(entry.get(key, (0.0, 0.0, 0.0))) for key in ("xyz", "rpy"))
        # The link in the file may be fixed to the moving link of the finger.
        link_pose = placement @ inverse(frame_matrix(Frame(xyz, rpy)))
        point = (inverse(link_pose) @ np.append(pad.point, 1.0))[:3]
        text = with_corrected_pad(text, finger, point, placement[:3, :3].T @ pad.normal)
    on_error = os_errors(f"{path}: cannot be written", DescriptionError)
    with on_error, atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
        _check_saved_pads(temporary, pads)


def with_corrected_pad(text: str, finger: str, point: Array, normal: Array) -> str:
    """Return the text of a description with another pad.

    Args:
        text: The YAML text.
        finger: Finger of the pad.
        point: (3,) Contact point in the frame of the link in the file [m].
        normal: (3,) Normal in the contact frame.

    Raises:
        DescriptionError: The text has no such pad.
    """
    key, entry = _pad_nodes(text, finger)
    values = {"xyz": vector(point, 7), "normal": vector(normal, 7)}
    edits: list[tuple[int, int, str]] = []
    nodes = {name.value: value for name, value in entry.value}
    for name, value in values.items():
        if name in nodes:
            node = nodes[name]
            edits.append((node.start_mark.index, node.end_mark.index, value))
        elif entry.flow_style:
            edits.append((entry.end_mark.index - 1, entry.end_mark.index - 1, f", {name}: {value}"))
        else:
            first_key, _ = entry.value[0]
            indent = " " * first_key.start_mark.column
            position = first_key.start_mark.index
            edits.append((position, position, f"{name}: {value}\n{indent}"))
    for start, end, value in sorted(edits, reverse=True):
        text = text[:start] + value + text[end:]
    return _with_comment(text, key.start_mark.line)


def _pad_nodes(text: str, finger: str) -> tuple[yaml.ScalarNode, yaml.MappingNode]:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for name in ("fingers", finger):
        pairs = root.value if isinstance(root, yaml.MappingNode) else []
        pair = next(((key, value) for key, value in pairs if key.value == name), None)
        if pair is None:
            raise DescriptionError(f"fingers.{finger}: not in the description")
        key, root = pair
    if not isinstance(root, yaml.MappingNode):
        raise DescriptionError(f"fingers.{finger}: expected a pad (link, xyz, normal)")
    return key, root


def _with_comment(text: str, line: int) -> str:
    """Mark the pad on a line as corrected in the comment above, which keeps the guess."""
    lines = text.split("\n")
    comment = lines[line - 1] if line else ""
    indent = re.match(r"\s*", lines[line])
    if comment.lstrip().startswith("#") and GUESS_MARK in comment:
        lines[line - 1] = comment.replace(GUESS_MARK, f"{CORRECTED_MARK}; the guess was:")
    elif CORRECTED_MARK not in comment:
        lines.insert(line, f"{indent[0] if indent else ''}# {CORRECTED_MARK}")
    return "\n".join(lines)


def _check_saved_pads(temporary: Path, pads: Mapping[str, LinkPad]) -> None:
    """Verify that a file has the given pads.

    Raises:
        DescriptionError: A pad differs.
    """
    description = load_description(temporary)
    for finger, pad in pads.items():
        entry = description.finger(finger)
        normal = entry.placement[:3, :3] @ entry.normal
        point = entry.placement[:3, 3]
        if np.abs(np.concatenate([point - pad.point, normal - pad.normal])).max() > 1e-6:
            raise DescriptionError(f"fingers.{finger}: pad could not be corrected in the text")


# Surface of a link.


def surface_hit(surface: IndexedMesh, point: Array, normal: Array) -> tuple[Array, Array] | None:
    """Return the point where the line along a pad normal leaves a surface, and the normal there.

    The line is cast from 6 cm outside; the normal is estimated from four points 2 mm apart.

    Args:
        surface: Mesh that moves with the pad.
        point: (3,) Contact point [m].
        normal: (3,) Unit normal.

    Returns:
        Point (3,) and unit normal (3,); None if the line misses the surface.
    """
    start = point + 0.06 * normal
    hit = surface.first_hit(start, -normal)
    if hit is None:
        return None
    x, y = 0.002 * pose_with_x_axis(point, normal)[:3, 1:3].T
    hits = (surface.first_hit(start + step, -normal) for step in (x, y, -x, -y))
    neighbours = [neighbour for neighbour in hits if neighbour is not None]
    if len(neighbours) < 4:
        return hit, normal
    plus_x, plus_y, minus_x, minus_y = neighbours
    direction = np.cross(plus_x - minus_x, plus_y - minus_y)
    return hit, direction / np.linalg.norm(direction)
