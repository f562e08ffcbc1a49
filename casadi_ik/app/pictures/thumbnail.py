"""Small picture of a robot in a configuration, drawn without OpenGL, for notebooks."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    bodies_at,
    close_view,
    overview,
    palm_positions,
    view_axes,
    visual_bodies,
)
from casadi_ik.app.drawing.surfaces import decimate, mesh_shape
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

LIGHT_DIRECTION = np.array([0.3, 0.5, 0.81])
"""Direction of the light: right, up and towards the viewer."""

MAX_TRIANGLES = 300
"""Maximum number of triangles of a drawable."""


def thumbnail(robot: ArmHand, q: Array, inches: float = 2.6) -> bytes:
    """Return a PNG of the whole robot and a close-up of its hand.

    Args:
        robot: The robot.
        q: (n,) Configuration [rad or m].
        inches: Width and height of each of the two pictures [inch].
    """
    close_up = close_view(robot, q)
    palm = palm_positions(robot, q).mean(axis=0)
    bodies = bodies_at(robot, q, _coarse_bodies(robot))
    hand = [body for body in bodies if body.role in ("hand", "pad")]
    figure = Figure((2 * inches, inches), dpi=100)
    FigureCanvasAgg(figure)
    for x_offset, drawables, view in (
        (0.0, bodies, overview(palm, close_up)),
        (0.5, hand, close_up),
    ):
        axes = figure.add_axes((x_offset, 0.0, 0.5, 1.0), aspect="equal")
        axes.set_axis_off()
        _draw(axes, drawables, view_axes(view))
    stream = BytesIO()
    figure.savefig(stream, format="png", transparent=True)
    return stream.getvalue()


@lru_cache(maxsize=4)
def _coarse_bodies(robot: ArmHand) -> list[Drawable]:
    """Return the visual geometry with few triangles, in the frames of the links."""
    return [
        replace(body, shape=mesh_shape(decimate(body.surface, MAX_TRIANGLES)))
        for body in visual_bodies(robot)
    ]


def _draw(axes: Axes, drawables: list[Drawable], view: Array) -> None:
    """Draw triangles from back to front without those that face away."""
    corners, colors = [], []
    for drawable in drawables:
        surface = drawable.surface
        triangles = (surface.points @ view.T)[surface.triangles]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normals, axis=1)
        is_facing = (normals[:, 2] > 0) & (length > 0)
        shade = 0.55 + 0.45 * np.clip(
            normals[is_facing] @ LIGHT_DIRECTION / length[is_facing], 0.0, 1.0
        )
        corners.append(triangles[is_facing])
        colors.append(shade[:, None] * np.array(palette.rgb(drawable.color)) / 255)
    triangles, shades = np.concatenate(corners), np.concatenate(colors)
    order = np.argsort(triangles[:, :, 2].mean(axis=1))
    polygons, shades = triangles[order][:, :, :2], shades[order]
    axes.add_collection(PolyCollection(list(polygons), facecolors=shades, antialiaseds=False))
    axes.autoscale_view()
