"""An arm-hand at its contacts: the whole robot, and the hand and the object from close by."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from os import PathLike

import numpy as np
import pyvista as pv
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from casadi_ik import palette
from casadi_ik.answers.solution import Solution
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.grasps import Grasp, load_object
from casadi_ik.solving.alternatives.finder import Alternative
from casadi_ik.views.captions import (
    MET_COLOR,
    MISSED_COLOR,
    OBJECT_COLOR,
    add_legend,
    add_title,
    label_fingers,
)
from casadi_ik.views.marks import contact_marks, target_place
from casadi_ik.views.obstacles import in_scene, nearest_pair, scene_solids
from casadi_ik.views.picture import DARK, DPI, INK, LIGHT, new_figure, save_picture
from casadi_ik.views.robot_body import robot_body
from casadi_ik.views.shapes import Solid, with_edges
from casadi_ik.views.stage import Image, Stage, over
from casadi_ik.views.viewpoint import View, close_view, whole_view

SIZE = (12.0, 6.6)
"""Of the picture [inch]."""

SMALL = (3.2, 3.4)
"""Of one of several pictures [inch]."""

WHOLE = (0.0, 0.06, 0.40, 0.82)
CLOSE = (0.40, 0.06, 0.60, 0.82)
"""Left, bottom, width and height of the panels, as parts of the picture."""

WINDOW = (1200, 900)
"""Of `show` [pixels]."""

OBJECT, GHOST, WRIST, SCENE, TOUCHING = 0.5, 0.45, 0.3, 0.45, 0.35
"""Opacity of the object, of contacts that something hides, of the arm in the close-up, of what
stands about, and of what touches."""

AROUND = ("scene", "nearest", "touching")
"""Groups that there are where a scene is drawn."""

WRIST_LENGTH = 0.10
"""Of the arm, the close-up shows what is no further than this from the palm [m]."""

NEAR = 0.35
"""What reaches further than this from the palm need not be in the close-up [m]."""

_one_at_a_time = threading.Lock()


def draw_solution(
    robot: ArmHand,
    solution: Solution,
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    scene: Scene | None = None,
    view: View | None = None,
    dpi: float = DPI,
    dark: bool = False,
) -> Figure:
    """Draw the answer to a grasp.

    Args:
        robot: The robot that was solved for.
        solution: The answer.
        grasp: The question; if it names an object that has a description, that is drawn too.
        path: PNG file to write, if any.
        scene: What stood about the robot: that is drawn too, and of the pair that is nearest to
            touching the way between them in red; their shapes as well if they do touch.
        view: Azimuth and elevation [rad] from which the close-up is seen; None: chosen so that
            the fingertips are well apart.
        dpi: Dots per inch.
        dark: For a dark page.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
        InputError: The grasp has a finger that the robot has not.
    """
    ground = DARK if dark else LIGHT
    figure = new_figure(*SIZE, dpi, ground)
    paper = np.array(palette.rgb(ground.paper), np.float32) / 255
    colors = {
        finger: MET_COLOR if verdict.ok else MISSED_COLOR
        for finger, verdict in solution.contacts.items()
    }
    with _one_at_a_time, closing(Stage()) as stage:
        solids = _fill(stage, robot, solution.q, grasp, colors)
        if scene is not None:
            _around(stage, robot, solution, grasp, scene)
        view = view or close_view(robot, solution.q)
        target = _middle(robot, solution.q, grasp)
        pixels = _pixels(figure, WHOLE)
        stage.aim(whole_view(target, view), _points(*solids.values()), pixels, (0.03, 0.10))
        image = over(paper, stage.shoot("floor"), _inwards(pixels))
        image = over(image, stage.shoot("arm", "wrist", "hand", "object", "marks", *AROUND))
        _panel(figure, WHOLE, over(image, stage.shoot("marks", "nearest"), GHOST))

        palm = robot.palm(solution.q)[:3, 3]
        there = solids["object"] + solids["marks"]
        near = [solid for solid in there if _distances(solid, palm).max() < NEAR]
        pixels = _pixels(figure, CLOSE)
        stage.aim(view, _points(solids["hand"], near), pixels, (0.17, 0.02))
        # The arm is pale: it may stand in the way.
        image = over(paper, stage.shoot("wrist"), WRIST * _inwards(pixels))
        image = over(image, stage.shoot("hand", "object", "marks", "nearest", "touching"))
        axes = _panel(figure, CLOSE, over(image, stage.shoot("marks", "nearest"), GHOST))
        seen = stage.project(robot.contacts(solution.q)[0])
    label_fingers(axes, dict(zip(robot.fingers, seen, strict=True)), solution, grasp, ground)
    add_title(figure, solution, grasp, ground)
    add_legend(figure, solution, grasp, bool(solids["object"]), scene is not None, ground)
    if path is not None:
        save_picture(figure, path)
    return figure


def draw_alternatives(
    robot: ArmHand,
    alternatives: Sequence[Alternative],
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    columns: int = 4,
    view: View | None = None,
    dpi: float = DPI,
) -> Figure:
    """Draw several solutions of a grasp side by side, all seen from the same place.

    Args:
        robot: The robot that was solved for.
        alternatives: The solutions, at least one.
        grasp: The question; if it names an object that has a description, that is drawn too.
        path: PNG file to write, if any.
        columns: Pictures in a row.
        view: Azimuth and elevation [rad] of the camera; None: chosen for the first solution.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
        InputError: No solution, or the grasp has a finger that the robot has not.
    """
    if not alternatives:
        raise InputError("alternatives: found none, expected at least one")
    rows = -(-len(alternatives) // columns)
    figure = new_figure(SMALL[0] * columns, SMALL[1] * rows, dpi)
    first = alternatives[0].q
    target = robot.contacts(first)[0].mean(axis=0)
    view = view or whole_view(target, close_view(robot, first))
    bodies = [robot_body(robot, found.q) for found in alternatives]
    everything = _points(*(part for body in bodies for part in body))
    colors = dict.fromkeys(robot.fingers, MET_COLOR)
    for number, found in enumerate(alternatives):
        row, column = divmod(number, columns)
        box = (column / columns, 1 - (row + 1) / rows, 1 / columns, 0.86 / rows)
        with _one_at_a_time, closing(Stage()) as stage:
            _fill(stage, robot, found.q, grasp, colors)
            stage.aim(view, everything, _pixels(figure, box), (0.03, 0.03))
            axes = _panel(figure, box, over(1.0, stage.shoot()))
        axes.set_title(_bent(found), color=INK, fontsize=9)
    if path is not None:
        save_picture(figure, path)
    return figure


def _bent(found: Alternative) -> str:
    """How the arm is bent, and how far its elbow may swing."""
    branch = found.branch
    if branch is None:
        return f"hand posture {found.posture}"
    pairs = (("shoulder", branch.shoulder), ("elbow", branch.elbow), ("wrist", branch.wrist))
    signs = ", ".join(f"{name} {'+' if sign > 0 else '−'}" for name, sign in pairs)
    if branch.swivel is None:
        return signs
    start, end = branch.swivel
    return f"{signs}\nelbow swings {np.rad2deg(end - start):.0f}°"


def show(
    robot: ArmHand, q: ArrayLike, grasp: Grasp | None = None, *, window: bool = True
) -> pv.Plotter:
    """Open a window in which a robot can be looked at from all sides.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].
        grasp: Contacts and object to be shown too.
        window: Whether to open it, until it is closed; else only the plotter is made.

    Returns:
        The plotter, e.g. for its `export_gltf`.

    Raises:
        PictureError: There is no OpenGL to draw with.
        InputError: Bad q, or the grasp has a finger that the robot has not.
    """
    with _one_at_a_time:
        stage = Stage(off_screen=not window)
        solids = _fill(stage, robot, q, grasp, dict.fromkeys(robot.fingers, INK))
        target = robot.contacts(q)[0].mean(axis=0)
        view = whole_view(target, close_view(robot, q))
        stage.aim(view, _points(*solids.values()), WINDOW, (0.05, 0.05))
    if window:
        stage.plotter.show(auto_close=False)
    return stage.plotter


def _fill(
    stage: Stage, robot: ArmHand, q: ArrayLike, grasp: Grasp | None, colors: Mapping[str, str]
) -> dict[str, list[Solid]]:
    """Put all there is to see on the stage, and give it back by group."""
    arm, hand = robot_body(robot, q)
    palm = robot.palm(q)[:3, 3]
    solids: dict[str, list[Solid]] = {"arm": [], "wrist": [], "hand": hand}
    for solid in arm:
        solids["wrist" if _distances(solid, palm).min() < WRIST_LENGTH else "arm"].append(solid)
    for group, members in solids.items():
        stage.add(group, members)
    stage.add_floor(float(robot.links(q)[robot.description.root][2, 3]), arm + hand)
    solids["object"] = object_solids(grasp) if grasp else []
    solids["marks"] = contact_marks(robot, q, grasp, colors) if grasp else []
    stage.add("object", solids["object"], OBJECT)
    stage.add("marks", solids["marks"])
    return solids


def _around(stage: Stage, robot: ArmHand, solution: Solution, grasp: Grasp, scene: Scene) -> None:
    """Put what stands about on the stage, and what is nearest to touching."""
    whole = in_scene(scene, grasp)
    about = robot.links(solution.q)[robot.description.root][:3, 3]
    stage.add("scene", scene_solids(whole, about, grasp.object), SCENE)
    pair = solution.closest
    if pair is not None and np.isfinite(solution.q).all():
        rod, shapes = nearest_pair(robot, solution.q, whole, pair)
        stage.add("nearest", rod)
        stage.add("touching", [] if solution.success else shapes, TOUCHING)


def object_solids(grasp: Grasp) -> list[Solid]:
    """The object, if there is a description of it and its place is given."""
    pose = grasp.object_pose
    if not grasp.object or pose is None:
        return []
    try:
        vertices, faces = load_object(grasp.object).mesh(64)
    except UnknownNameError:
        return []
    mesh = pv.PolyData.from_regular_faces(vertices @ pose[:3, :3].T + pose[:3, 3], faces)
    return [(with_edges(mesh), OBJECT_COLOR)]


def _middle(robot: ArmHand, q: ArrayLike, grasp: Grasp) -> Array:
    """(3,) amid the contacts asked for [m]."""
    grasp.arrays(robot.fingers)
    tips = dict(zip(robot.fingers, robot.contacts(q)[0], strict=True))
    places = [target_place(contact, tips[name]) for name, contact in grasp.contacts.items()]
    return np.mean(places or list(tips.values()), axis=0)


def _points(*groups: list[Solid]) -> Array:
    return np.concatenate([mesh.points for group in groups for mesh, _ in group])


def _distances(solid: Solid, place: Array) -> Array:
    return np.linalg.norm(solid[0].points - place, axis=1)


def _inwards(pixels: tuple[int, int]) -> Image:
    """(h, w, 1) 0 at the edges of an image, 1 further in."""
    x, y = (np.linspace(0, 1, size, dtype=np.float32) for size in pixels)
    x, y = (np.clip(np.minimum(v, 1 - v) / 0.15, 0, 1) for v in (x, y))
    return y[:, None, None] * x[:, None]


def _pixels(figure: Figure, box: tuple[float, float, float, float]) -> tuple[int, int]:
    width, height = figure.get_size_inches() * figure.dpi
    return round(width * box[2]), round(height * box[3])


def _panel(figure: Figure, box: tuple[float, float, float, float], image: Image) -> Axes:
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.imshow(np.clip(image, 0.0, 1.0))
    return axes
