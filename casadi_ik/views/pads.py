"""A hand with its pads: the shapes of its file, the contact points and which way they face."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from os import PathLike
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.importing.surfaces import Surface
from casadi_ik.views.captions import MET_COLOR, TARGET_COLOR
from casadi_ik.views.picture import DPI, FAINT, INK, new_figure, save_picture
from casadi_ik.views.robot_body import HAND_COLOR, robot_body
from casadi_ik.views.shapes import Solid, arrow, capsule
from casadi_ik.views.stage import Stage, over
from casadi_ik.views.viewpoint import View

SIZE = (12.0, 6.6)
"""Of the picture [inch]."""

VIEWS: tuple[View, View] = (
    (np.deg2rad(25.0), np.deg2rad(20.0)),
    (np.deg2rad(115.0), np.deg2rad(20.0)),
)
"""Two sides of the palm frame, whose z is up and whose y goes to the thumb."""

PANELS = ((0.0, 0.0, 0.5, 0.88), (0.5, 0.0, 0.5, 0.88))
"""Left, bottom, width and height of the two, as parts of the picture."""

SHELL = 0.55
"""Opacity of the hand, through which its pads are seen."""

THUMB_COLOR = TARGET_COLOR


def draw_pads(
    robot: ArmHand,
    surfaces: Mapping[str, Surface],
    path: str | PathLike[str] | None = None,
    *,
    dpi: float = DPI,
) -> Figure:
    """Draw the hand of a robot at home from two sides, with a mark at every pad.

    Args:
        robot: The robot.
        surfaces: Shapes of the hand's links in the links' frames, by link of the robot; without
            any the hand is drawn from its joints.
        path: PNG file to write, if any.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
    """
    q = robot.home
    inverse = np.asarray(np.linalg.inv(robot.palm(q)), dtype=np.float64)
    points, normals = robot.contacts(q)
    points = points @ inverse[:3, :3].T + inverse[:3, 3]
    normals = normals @ inverse[:3, :3].T
    hand = _hand(robot, surfaces, inverse)
    size = float(np.ptp(np.concatenate([points, *(m.points for m, _ in hand)]), axis=0).max())
    marks: list[Solid] = []
    for name, point, normal in zip(robot.fingers, points, normals, strict=True):
        color = THUMB_COLOR if name == robot.description.named_thumb else MET_COLOR
        marks += [
            (capsule(point, point, 0.014 * size), color),
            (arrow(point, normal, 0.16 * size, 0.012 * size), color),
        ]
    figure = new_figure(*SIZE, dpi)
    everything = np.concatenate([mesh.points for mesh, _ in [*hand, *marks]])
    for view, panel in zip(VIEWS, PANELS, strict=True):
        pixels = round(SIZE[0] * dpi * panel[2]), round(SIZE[1] * dpi * panel[3])
        with closing(Stage()) as stage:
            stage.add("hand", hand)
            stage.add("marks", marks)
            stage.aim(view, everything, pixels, (0.12, 0.04))
            image = over(over(1.0, stage.shoot("hand")), stage.shoot("marks"), SHELL)
            image = over(image, stage.shoot("hand", "marks"), 1 - SHELL)
            places = stage.project(points)
        axes = figure.add_axes(panel)
        axes.set_axis_off()
        axes.imshow(np.clip(image, 0.0, 1.0))
        _label(axes, dict(zip(robot.fingers, places, strict=True)), pixels)
    figure.text(0.02, 0.955, robot.name, size=15, weight="bold", color=INK, va="center")
    note = "pads and their outward normals; the thumb is yellow; seen from two sides, palm's z up"
    figure.text(0.02, 0.91, note, size=10, color=FAINT, va="center")
    if path is not None:
        save_picture(figure, path)
    return figure


def _hand(robot: ArmHand, surfaces: Mapping[str, Surface], inverse: Array) -> list[Solid]:
    """What there is to see of a hand, in the palm's frame."""
    links = robot.links(robot.home)
    found: list[Solid] = []
    for link, surface in surfaces.items():
        if link not in links or not len(surface.triangles):
            continue
        placed = surface.moved(inverse @ links[link])
        mesh: Any = pv.PolyData.from_regular_faces(placed.points, placed.triangles)
        mesh.clean(inplace=True)
        mesh.compute_normals(
            auto_orient_normals=True, split_vertices=True, feature_angle=35.0, inplace=True
        )
        found.append((mesh, HAND_COLOR))
    if found:
        return found
    _, hand = robot_body(robot, robot.home)
    for mesh, _ in hand:
        mesh.transform(inverse, inplace=True)
    return hand


def _label(axes: Axes, places: Mapping[str, Array], pixels: tuple[int, int]) -> None:
    """The fingers' names at the edges, a line from each to its pad."""
    width, height = pixels
    middle = float(np.median([x for x, _ in places.values()]))
    for side, edge, sign in (("left", 0.01, 1), ("right", 0.99, -1)):
        chosen = [item for item in places.items() if (item[1][0] <= middle) == (side == "left")]
        level = 0.0
        for name, (x, y) in sorted(chosen, key=lambda item: float(item[1][1])):
            level = max(float(y), level + 0.06 * height, 0.03 * height)
            axes.text(edge * width, level, name, ha=side, va="center", size=10, color=INK)
            start = (edge + sign * 0.011 * len(name) + sign * 0.02) * width
            axes.plot([start, x], [level, y], color=FAINT, lw=0.8)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
