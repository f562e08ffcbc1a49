"""A small picture of a robot in a posture, drawn without OpenGL: for tables in notebooks."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    axes_of,
    close_view,
    palm_places,
    placed,
    whole_view,
)
from casadi_ik.app.drawing.surfaces import coarser
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

LIGHT = np.array([0.3, 0.5, 0.81])
"""Where light comes from: right, up and towards the viewer."""

TRIANGLES = 300
"""Of a body, at most."""


def thumbnail(robot: ArmHand, q: Array, inches: float = 2.6) -> bytes:
    """The whole robot and its hand from near, side by side, as a PNG.

    Args:
        robot: The robot.
        q: (n,) where it is [rad or m].
        inches: Of a side of each picture.
    """
    close = close_view(robot, q)
    palm = palm_places(robot, q).mean(axis=0)
    every = placed(robot, q)
    hand = [one for one in every if one.role in ("hand", "pad")]
    figure = Figure((2 * inches, inches), dpi=100)
    FigureCanvasAgg(figure)
    for place, shown, view in ((0.0, every, whole_view(palm, close)), (0.5, hand, close)):
        axes = figure.add_axes((place, 0.0, 0.5, 1.0), aspect="equal")
        axes.set_axis_off()
        _draw(axes, shown, axes_of(view))
    stream = BytesIO()
    figure.savefig(stream, format="png", transparent=True)
    return stream.getvalue()


def _draw(axes: Axes, shown: list[Drawable], view: Array) -> None:
    """Triangles, the farthest first; those that face away are left out."""
    corners, colors = [], []
    for one in shown:
        surface = coarser(one.surface, TRIANGLES)
        triangles = (surface.points @ view.T)[surface.triangles]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normals, axis=1)
        seen = (normals[:, 2] > 0) & (length > 0)
        shade = 0.55 + 0.45 * np.clip(normals[seen] @ LIGHT / length[seen], 0.0, 1.0)
        corners.append(triangles[seen])
        colors.append(shade[:, None] * np.array(palette.rgb(one.color)) / 255)
    triangles, shades = np.concatenate(corners), np.concatenate(colors)
    order = np.argsort(triangles[:, :, 2].mean(axis=1))
    flat, shades = triangles[order][:, :, :2], shades[order]
    axes.add_collection(PolyCollection(list(flat), facecolors=shades, antialiaseds=False))
    axes.autoscale_view()
