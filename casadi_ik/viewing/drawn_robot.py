"""A robot on a page: a mesh per link that hangs on the link before it.

What a joint moves is moved by the browser: a posture is sent as a turn per joint, not as a pose per
link.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.viewing.frames import quaternions
from casadi_ik.viewing.robot_parts import LinkPart

STILL = 1e-9
"""Links that move by less on the one before [m, or in their axes] are left where they are."""


class DrawnRobot:
    """The links of a robot."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        parts: Sequence[LinkPart],
        name: str = "/robot",
    ) -> None:
        """Draw it at home.

        Args:
            server: The page.
            robot: The robot.
            parts: Its links as they are seen.
            name: Of its node.
        """
        self._server, self._robot = server, robot
        server.scene.add_frame(name, show_axes=False)
        self._before = _drawn_before(robot, parts)
        names: list[str] = []
        for part, before in zip(parts, self._before, strict=True):
            names.append(f"{names[before] if before >= 0 else name}/{part.link}")
        self._meshes = [
            server.scene.add_mesh_simple(
                node,
                part.surface.points.astype(np.float32),
                part.surface.triangles.astype(np.uint32),
                color=palette.rgb(part.color),
                side="double",
                receive_shadow=False,
            )
            for node, part in zip(names, parts, strict=True)
        ]
        self._links = [robot.description.links.index(part.link) for part in parts]
        self._poses = np.full((len(parts), 4, 4), np.nan)
        self.q = robot.home
        self.place(robot.home)

    def place(self, q: Array) -> None:
        """Move it to q (n,) [rad or m]."""
        self.q = np.array(q)
        every = np.array(list(self._robot.links(q).values()))[self._links]
        # The last stands for the base frame, which the first links hang on.
        on = np.concatenate([every, np.eye(4)[None]])[self._before]
        poses = np.linalg.inv(on) @ every
        gone = ~(np.abs(poses - self._poses) < STILL)
        shifted, turned = gone[:, :3, 3].any(axis=1), gone[:, :3, :3].any(axis=(1, 2))
        wxyz = quaternions(poses[:, :3, :3])
        with self._server.atomic():
            for i in np.flatnonzero(shifted):
                self._meshes[i].position = poses[i, :3, 3]
            for i in np.flatnonzero(turned):
                self._meshes[i].wxyz = wxyz[i]
        self._poses[shifted, :3, 3] = poses[shifted, :3, 3]
        self._poses[turned, :3, :3] = poses[turned, :3, :3]


def _drawn_before(robot: ArmHand, parts: Sequence[LinkPart]) -> list[int]:
    """By part the number of the part that it hangs on; -1: none of them."""
    drawn = {part.link: i for i, part in enumerate(parts)}
    parents = {joint.child: joint.parent for joint in robot.description.joints}
    found = []
    for part in parts:
        link = parents.get(part.link)
        while link is not None and link not in drawn:
            link = parents.get(link)
        found.append(-1 if link is None else drawn[link])
    return found
