"""An arm-hand at its contacts: the whole robot, and the hand and the object from close by."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import UnknownNameError
from casadi_ik.grasps import Grasp, load_object
from casadi_ik.solvers import Solution
from casadi_ik.views.camera import Camera, camera_at
from casadi_ik.views.captions import (
    MET_COLOR,
    MISSED_COLOR,
    OBJECT_COLOR,
    TARGET_COLOR,
    add_legend,
    add_title,
    label_fingers,
)
from casadi_ik.views.picture import DPI, new_figure, save_picture
from casadi_ik.views.render import Layer, render
from casadi_ik.views.robot_body import RobotBody, robot_body
from casadi_ik.views.solids import Solid, arrow, ball, capsule
from casadi_ik.views.viewpoint import View, close_view, whole_view

Array = NDArray[np.float64]

SIZE = (12.0, 6.6)
"""Of the picture [inch]."""

WHOLE = (0.0, 0.06, 0.40, 0.82)
CLOSE = (0.40, 0.06, 0.60, 0.82)
"""Left, bottom, width and height of the panels, as parts of the picture."""

WRIST = 0.10
"""Of the arm, the close-up shows what is no further than this from the palm [m]."""

NEAR = 0.35
"""An object or a contact further than this from the palm is not in the close-up [m]."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to see.

    Attributes:
        body: The robot.
        things: The object, if any.
        marks: The contacts.
        palm: (3,) where the palm is [m].
        target: (3,) middle of the contacts asked for [m].
        floor: Height of the robot's foot [m].
    """

    body: RobotBody
    things: list[Solid]
    marks: list[Solid]
    palm: Array
    target: Array
    floor: float


def draw_solution(
    robot: ArmHand,
    solution: Solution,
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    view: View | None = None,
    dpi: float = DPI,
) -> Figure:
    """Draw what became of a grasp.

    Args:
        robot: The robot that was solved for.
        solution: The answer.
        grasp: The question; if it names an object that has a description, that is drawn too.
        path: PNG file to write, if any.
        view: Azimuth and elevation [rad] from which the close-up is seen; None: chosen so that
            the fingertips are well apart.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written.
        DescriptionError: The description of the object is malformed.
        InputError: The grasp has a finger that the robot has not.
    """
    figure = new_figure(*SIZE, dpi)
    scene = _scene(robot, solution, grasp)
    close = view or close_view(robot, solution.q)
    _draw_whole(figure, scene, whole_view(scene.target, close))
    axes, camera = _draw_close(figure, scene, close)
    label_fingers(axes, camera, robot, solution, grasp)
    add_title(figure, solution, grasp)
    add_legend(figure, solution, bool(scene.things))
    if path is not None:
        save_picture(figure, path)
    return figure


def _scene(robot: ArmHand, solution: Solution, grasp: Grasp) -> Scene:
    root = robot.links(solution.q)[robot.description.root]
    asked, _ = grasp.arrays(robot.fingers)
    return Scene(
        body=robot_body(robot, solution.q),
        things=_object(grasp),
        marks=_marks(robot, solution, grasp),
        palm=robot.palm(solution.q)[:3, 3],
        target=np.nanmean(asked, axis=0),
        floor=float(root[2, 3]),
    )


def _draw_whole(figure: Figure, scene: Scene, view: View) -> None:
    body, pixels = scene.body, _pixels(figure, WHOLE)
    solids = [*body.arm, *body.hand, *scene.things, *scene.marks]
    camera = camera_at(*view, _vertices(solids), pixels, (0.03, 0.10))
    robot = Layer([*body.arm, *body.hand])
    layers = [robot, Layer(scene.things, 0.5), Layer(scene.marks, 1.0, 0.45)]
    _panel(figure, WHOLE, camera).imshow(render(camera, layers, scene.floor))


def _draw_close(figure: Figure, scene: Scene, view: View) -> tuple[Axes, Camera]:
    body, pixels = scene.body, _pixels(figure, CLOSE)
    near = [
        solid
        for solid in (*scene.things, *scene.marks)
        if np.linalg.norm(solid.vertices.mean(axis=0) - scene.palm) < NEAR
    ]
    camera = camera_at(*view, _vertices([*body.hand, *near]), pixels, (0.17, 0.02))
    wrist = [
        solid
        for solid in body.arm
        if np.linalg.norm(solid.vertices - scene.palm, axis=1).min() < WRIST
    ]
    # The arm is pale: it may stand in the way.
    layers = [
        Layer(wrist, 0.3, fading=True),
        Layer(body.hand),
        Layer(scene.things, 0.5),
        Layer(scene.marks, 1.0, 0.45),
    ]
    axes = _panel(figure, CLOSE, camera)
    axes.imshow(render(camera, layers))
    return axes, camera


def _object(grasp: Grasp) -> list[Solid]:
    """The object, if there is a description of it and its place is given."""
    pose = grasp.object_pose
    if not grasp.object or pose is None:
        return []
    try:
        vertices, faces = load_object(grasp.object).mesh(64)
    except UnknownNameError:
        return []
    return [Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, OBJECT_COLOR)]


def _marks(robot: ArmHand, solution: Solution, grasp: Grasp) -> list[Solid]:
    """Arrows of the contacts: asked for thick and short, reached thin and long."""
    asked_points, asked_normals = grasp.arrays(robot.fingers)
    points, normals = robot.contacts(solution.q)
    marks = []
    for row, finger in enumerate(robot.fingers):
        if np.isnan(asked_points[row, 0]):
            continue
        color = MET_COLOR if solution.contacts[finger].ok else MISSED_COLOR
        marks += [
            ball(asked_points[row], 0.0036, TARGET_COLOR),
            ball(points[row], 0.0042, color),
            arrow(points[row], normals[row], 0.046, 0.0022, color),
        ]
        if not solution.contacts[finger].ok:
            marks.append(capsule(points[row], asked_points[row], 0.0006, color))
        if not np.isnan(asked_normals[row, 0]):
            marks.append(arrow(asked_points[row], asked_normals[row], 0.030, 0.0048, TARGET_COLOR))
    return marks


def _vertices(solids: list[Solid]) -> Array:
    return np.concatenate([solid.vertices for solid in solids])


def _pixels(figure: Figure, box: tuple[float, float, float, float]) -> tuple[int, int]:
    width, height = figure.get_size_inches() * figure.dpi
    return round(width * box[2]), round(height * box[3])


def _panel(figure: Figure, box: tuple[float, float, float, float], camera: Camera) -> Axes:
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.set_xlim(0, camera.pixels[0])
    axes.set_ylim(camera.pixels[1], 0)
    return axes
