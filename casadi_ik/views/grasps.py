"""A picture of the best grasps of an object side by side: hand and object, each from its side."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from os import PathLike

import numpy as np
from matplotlib.figure import Figure

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.collision.scene import Scene
from casadi_ik.drawing.cameras import close_view
from casadi_ik.drawing.drawables import (
    Drawable,
    object_of,
    placed,
    reached_marks,
    scene_of,
)
from casadi_ik.errors import InputError
from casadi_ik.touch.grasps import FoundGrasp
from casadi_ik.views.charts import DPI, new_figure, save_picture
from casadi_ik.views.stage import Image, Stage, one_at_a_time, over, points_of

CELL = (3.4, 3.3)
"""Width and height of one of them [inch]."""

HEAD = 0.6
"""Height of the title [inch]."""

NEAR = 0.16
"""So much of the arm is seen behind the palm [m]."""


def draw_grasps(
    robot: ArmHand,
    found: Sequence[FoundGrasp],
    path: str | PathLike[str] | None = None,
    *,
    scene: Scene | None = None,
    most: int = 9,
    columns: int = 3,
    dpi: float = DPI,
) -> Figure:
    """Draw the best grasps that `Solver.grasps_of` has found, side by side.

    Args:
        robot: The robot that they were found for.
        found: The grasps, best first, at least one.
        path: PNG file to write, if any.
        scene: What stands about, drawn where it is near.
        most: How many are drawn at most.
        columns: Pictures in a row.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        InputError: No grasp.
    """
    if not len(found):
        raise InputError("found: there is no grasp to draw, expected at least one")
    shown = found[:most]
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    height = rows * CELL[1] + HEAD
    figure = new_figure(columns * CELL[0], height, dpi)
    share = CELL[1] / height
    pixels = round(CELL[0] * dpi), round(0.84 * CELL[1] * dpi)
    for number, one in enumerate(shown):
        row, column = divmod(number, columns)
        box = (column / columns, (rows - row - 1) * share, 1 / columns, 0.84 * share)
        axes = figure.add_axes(box)
        axes.set_axis_off()
        axes.imshow(np.clip(_image(robot, one, scene, pixels), 0.0, 1.0))
        axes.set_title(_words(number, one), color=palette.INK, fontsize=9.5)
    name = shown[0].grasp.name.partition(" ")[0]
    more = f", the best {len(shown)}" if len(found) > len(shown) else ""
    title = f"{len(found)} grasps of {name} · {robot.name}{more}"
    figure.text(0.02, 1 - 0.5 * HEAD / height, title, size=13, weight="bold", va="center")
    if path is not None:
        save_picture(figure, path)
    return figure


def _words(number: int, one: FoundGrasp) -> str:
    room = "" if one.clearance is None else f" · clearance {1e3 * one.clearance:.1f} mm"
    return f"{number + 1}. load {one.load:.2f} N/N{room}\n{', '.join(one.grasp.contacts)}"


def _image(robot: ArmHand, one: FoundGrasp, scene: Scene | None, pixels: tuple[int, int]) -> Image:
    """(h, w, 3) hand and object, the wrist pale, contacts through both."""
    grasp, thing = one.grasp, object_of(one.grasp.object)
    body, palm = placed(robot, one.q), robot.palm(one.q)[:3, 3]
    hand = [part for part in body if part.role != "arm"]
    wrist = [part for part in body if part.role == "arm" and _apart(part, palm) < NEAR]
    frames = zip(robot.fingers, robot.contact_frames(one.q), strict=True)
    marks = [
        mark.at(frame)
        for name, frame in frames
        if name in grasp.contacts
        for mark in reached_marks(palette.TARGET)
    ]
    pose = grasp.known_pose
    things = [] if thing is None or pose is None else [thing.at(pose)]
    seen = points_of([*hand, *things])
    with one_at_a_time, closing(Stage()) as stage:
        stage.add("wrist", wrist)
        stage.add("hand", hand)
        stage.add("object", things, 0.75)
        stage.add("marks", marks)
        if scene is not None:
            stage.add("scene", scene_of(scene, grasp.object))
        stage.aim(close_view(robot, one.q), seen, pixels, (0.04, 0.04))
        image = over(1.0, stage.shoot("scene"), 0.35) if scene is not None else 1.0
        image = over(image, stage.shoot("wrist"), 0.3)
        image = over(image, stage.shoot("hand", "object", "marks"))
        return over(image, stage.shoot("marks"), 0.5)


def _apart(part: Drawable, place: np.ndarray) -> float:
    return float(np.linalg.norm(part.surface.points - place, axis=1).min())
