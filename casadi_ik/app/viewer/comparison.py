"""Solution of another method, drawn next to the robot of a page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.camera import Camera
from casadi_ik.app.viewer.request import PageRequest, SolveResult
from casadi_ik.app.viewer.viser_scene import (
    FingertipMarks,
    Handles,
    RobotView,
    frames_by_finger,
)
from casadi_ik.kinematics.arm_hand import ArmHand

ROOT_NODE = "/beside"
"""Name of the root node of the second robot."""


class ComparisonView:
    """Second robot with the contacts of the request."""

    def __init__(self, server: Server, robot: ArmHand, camera: Camera) -> None:
        """Store the arguments; nothing is drawn.

        Args:
            server: Server of the page.
            robot: The robot.
            camera: Viewpoint of the first robot; the second one is to the right of it.
        """
        self._server, self._robot, self._camera = server, robot, camera
        self._items: tuple[RobotView, Handles, FingertipMarks] | None = None

    @property
    def is_visible(self) -> bool:
        """True while the second robot is drawn."""
        return self._items is not None

    def show(self, request: PageRequest, result: SolveResult) -> None:
        """Draw a result of a request."""
        if self._items is None:
            self._items = self._add_items(request)
        robot_view, handles, tips = self._items
        robot_view.update(result.q)
        handles.update(request)
        tips.update(request, frames_by_finger(self._robot, result.q), result.verdicts)

    def hide(self) -> None:
        """Remove the second robot."""
        self._server.scene.remove_by_name(ROOT_NODE)
        self._items = None

    def _add_items(self, request: PageRequest) -> tuple[RobotView, Handles, FingertipMarks]:
        server, view = self._server, self._camera.view
        frame = server.scene.add_frame(ROOT_NODE, show_axes=False)
        direction = np.array([-view[1], view[0], 0.0])
        frame.position = 1.6 * self._camera.radius * direction / np.linalg.norm(direction)
        return (
            RobotView(server, self._robot, f"{ROOT_NODE}/robot"),
            Handles(server, replace(request, scene=None), None, ROOT_NODE),
            FingertipMarks(server, request, ROOT_NODE),
        )
