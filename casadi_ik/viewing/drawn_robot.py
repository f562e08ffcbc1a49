"""A robot on a page: a mesh per link, moved by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.viewing.frames import quaternions
from casadi_ik.viewing.robot_parts import LinkPart

STILL = 1e-7
"""Links that move by less [m, or in their axes] are left where they are."""


class DrawnRobot:
    """The links of a robot."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: ArmHand,
        parts: Sequence[LinkPart],
        name: str = "/robot",
        opacity: float | None = None,
        tint: str | None = None,
    ) -> None:
        """Draw it at home.

        Args:
            server: The page.
            robot: The robot.
            parts: Its links as they are seen.
            name: Of its node.
            opacity: 0 to 1; None: opaque.
            tint: One colour for all of it; None: its own.
        """
        self._server, self._robot = server, robot
        server.scene.add_frame(name, show_axes=False)
        self._meshes = [
            server.scene.add_mesh_simple(
                f"{name}/{part.link}",
                part.surface.points.astype(np.float32),
                part.surface.triangles.astype(np.uint32),
                color=palette.rgb(tint or part.color),
                opacity=opacity,
                side="double",
                cast_shadow=opacity is None,
                receive_shadow=opacity is None,
            )
            for part in parts
        ]
        names = robot.description.links
        self._links = [names.index(part.link) for part in parts]
        self._poses = np.full((len(parts), 4, 4), np.nan)
        self.q = robot.home
        self.place(robot.home)

    def place(self, q: Array) -> None:
        """Move it to q (n,) [rad or m]."""
        self.q = np.array(q)
        every = list(self._robot.links(q).values())
        poses = np.array([every[i] for i in self._links])
        moved = ~(np.abs(poses - self._poses).max(axis=(1, 2)) < STILL)
        turned = quaternions(poses[:, :3, :3])
        with self._server.atomic():
            for i in np.flatnonzero(moved):
                self._meshes[i].position = poses[i, :3, 3]
                self._meshes[i].wxyz = turned[i]
        self._poses[moved] = poses[moved]

    def show(self, visible: bool) -> None:
        """Show or hide it."""
        for mesh in self._meshes:
            mesh.visible = visible
