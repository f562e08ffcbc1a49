"""Motors to be moved by hand, and joints between their limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.viewing.frames import usable
from casadi_ik.viewing.words import bars, block

if TYPE_CHECKING:
    from casadi_ik.viewing.grasp_page import GraspPage

STEPS = 1000
"""Of a slider."""


class Motors:
    """A slider per motor and a bar per joint."""

    def __init__(self, page: GraspPage) -> None:
        """Build them.

        Args:
            page: Whose they are; told of what is set.
        """
        self._page, gui, robot = page, page.server.gui, page.robot
        description = robot.description
        self._scales = np.array(
            [np.rad2deg(1.0) if one.unit == "rad" else 1e3 for one in description.actuators]
        )
        self._sliders: list[Any] = []
        gui.add_html(block("Moved by hand, nothing is solved; drag a contact to solve again."))
        with gui.add_folder("Motors", expand_by_default=True):
            for i, motor in enumerate(description.actuators):
                unit = "°" if motor.unit == "rad" else "mm"
                low, high = self._range(i)
                value = float(np.clip(page.answer.q[i] * self._scales[i], low, high))
                slider = gui.add_slider(
                    f"{motor.name} [{unit}]", low, high, _step(low, high), value
                )
                self._sliders.append(slider)
                self._connect(slider)
        with gui.add_folder("Joints and their limits", expand_by_default=True):
            self._bars = gui.add_html("")
        self.tell(page.answer.q, robot.joints(page.answer.q))

    def tell(self, q: Array, joints: Mapping[str, float]) -> None:
        """Show where they are."""
        for i, slider in enumerate(self._sliders):
            low, high = self._range(i)
            value = float(np.clip(q[i] * self._scales[i], low, high))
            if abs(slider.value - value) > 1e-6 * (high - low):
                slider.value = value
        description = self._page.robot.description
        self._bars.content = bars(
            list(joints),
            np.array(list(joints.values())),
            description.joint_lower,
            description.joint_upper,
            ["m" if joint.type == "prismatic" else "rad" for joint in description.movable],
        )

    def _range(self, i: int) -> tuple[float, float]:
        robot, scale = self._page.robot, self._scales[i]
        return float(robot.lower[i] * scale), float(robot.upper[i] * scale)

    def _connect(self, slider: Any) -> None:
        @slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                robot = self._page.robot
                q = usable([one.value for one in self._sliders], len(self._sliders)) / self._scales
                self._page.drag_motors(np.clip(q, robot.lower, robot.upper))


def _step(low: float, high: float) -> float:
    return float((high - low) / STEPS) or 1e-6
