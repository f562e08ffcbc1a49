"""The pair that is nearest to touching, on a page: a red rod between them, with its length."""

from __future__ import annotations

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.problem.clearance import Closest

FAR = 0.25
"""Beyond this nothing is near [m]; the rod would cross the picture."""


class DrawnClosest:
    """The rod."""

    def __init__(self, server: viser.ViserServer) -> None:
        """Draw nothing yet."""
        color = palette.rgb(palette.NEAREST)
        self._rod = server.scene.add_line_segments(
            "/closest/rod", np.zeros((1, 2, 3), np.float32), color, thickness=0.003, visible=False
        )
        self._label = server.scene.add_label(
            "/closest/length", "", anchor="top-center", font_screen_scale=0.8, visible=False
        )

    def place(
        self, closest: Closest | None, clearance: float | None = None, told: bool = True
    ) -> None:
        """Put it where two shapes are nearest, with their clearance [m]; None: nowhere.

        Args:
            closest: The two points.
            clearance: What is told of them; None: how far they are from each other.
            told: Whether anything is: not where it would lie over what matters more.
        """
        shown = closest is not None and closest.distance < FAR
        self._rod.visible, self._label.visible = shown, shown and told
        if closest is None or not shown:
            return
        self._rod.points = closest.ends[None].astype(np.float32)
        self._label.position = closest.ends.mean(axis=0)
        length = closest.distance if clearance is None else clearance
        self._label.text = f"{1e3 * length:.1f} mm"
