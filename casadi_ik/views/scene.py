"""An arm-hand at its contacts: the whole robot, and the hand and the object from close by."""

from __future__ import annotations

from os import PathLike

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Grasp, load_object
from casadi_ik.solvers import Solution
from casadi_ik.views.camera import Camera, camera_at
from casadi_ik.views.picture import DPI, FAINT, INK, new_figure, save_picture
from casadi_ik.views.render import Layer, render
from casadi_ik.views.robot_body import robot_body
from casadi_ik.views.solids import Solid, arrow, ball
from casadi_ik.views.viewpoint import close_view, whole_view

Array = NDArray[np.float64]

OBJECT_COLOR = "#8cc4e8"
TARGET_COLOR = "#f0b400"
MET_COLOR, MISSED_COLOR = "#1f9d55", "#d62f3c"

SIZE = (12.0, 6.6)
"""Of the picture [inch]."""

PANELS = {"whole": (0.0, 0.06, 0.40, 0.82), "close": (0.40, 0.06, 0.60, 0.82)}
"""Left, bottom, width and height of the panels, as parts of the picture."""


def draw_solution(
    robot: ArmHand,
    solution: Solution,
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    view: tuple[float, float] | None = None,
    dpi: float = DPI,
) -> Figure:
    """Draw what became of a grasp.

    Args:
        robot: The robot that was solved for.
        solution: The answer.
        grasp: The question; if it names its object, that is drawn too.
        path: PNG file to write, if any.
        view: Azimuth and elevation [rad] from which the close-up is seen; None: chosen so that
            the fingertips are well apart.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written.
        DescriptionError: The grasp names an object that is malformed.
        UnknownNameError: The grasp names an object that is not shipped.
        InputError: The grasp has a finger that the robot has not.
    """
    figure = new_figure(*SIZE, dpi)
    body = robot_body(robot, solution.q)
    things = _object(grasp)
    marks = _marks(robot, solution, grasp)
    focus = _focus(robot, solution, grasp, things)
    close = view or close_view(robot, solution.q)

    pixels = {name: _pixels(figure, box) for name, box in PANELS.items()}
    reach = np.concatenate([body.outline, *(thing.vertices for thing in things)])
    cameras = {
        "whole": camera_at(*whole_view(robot, solution.q, close), reach, pixels["whole"], 0.12),
        "close": camera_at(*close, focus, pixels["close"], 0.022),
    }
    floor = float(robot.links(solution.q)[robot.description.root][2, 3])
    for name, camera in cameras.items():
        axes = _panel(figure, PANELS[name], camera)
        whole = name == "whole"
        robot_layers = (
            [Layer([*body.arm, *body.hand])]
            if whole
            else [Layer(body.arm, 0.25), Layer(body.hand)]  # a pale arm: it may stand in the way
        )
        layers = [*robot_layers, Layer(things, 0.6), Layer(marks, 1.0, 0.45)]
        axes.imshow(render(camera, layers, floor if whole else None))
        if name == "close":
            _label_fingers(axes, camera, robot, solution, grasp)
    _title(figure, solution, grasp)
    _legend(figure, robot, solution, things)
    if path is not None:
        save_picture(figure, path)
    return figure


def _object(grasp: Grasp) -> list[Solid]:
    if not grasp.object or grasp.object_pose is None:
        return []
    vertices, faces = load_object(grasp.object).mesh(64)
    pose = grasp.object_pose
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
        if not np.isnan(asked_normals[row, 0]):
            marks.append(arrow(asked_points[row], asked_normals[row], 0.030, 0.0048, TARGET_COLOR))
    return marks


def _focus(robot: ArmHand, solution: Solution, grasp: Grasp, things: list[Solid]) -> Array:
    """(k, 3) what the close-up has to show: the hand, the object, the contacts asked for."""
    links = robot.links(solution.q)
    hand = [joint.child for joint in robot.description.joints if joint.part == "hand"]
    points = [links[robot.description.palm_link][:3, 3], *(links[name][:3, 3] for name in hand)]
    asked, _ = grasp.arrays(robot.fingers)
    asked = asked[~np.isnan(asked[:, 0])]
    reached, _ = robot.contacts(solution.q)
    return np.concatenate([points, reached, asked, *(thing.vertices for thing in things)])


def _pixels(figure: Figure, box: tuple[float, float, float, float]) -> tuple[int, int]:
    width, height = figure.get_size_inches() * figure.dpi
    return round(width * box[2]), round(height * box[3])


def _panel(figure: Figure, box: tuple[float, float, float, float], camera: Camera) -> Axes:
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.set_xlim(0, camera.pixels[0])
    axes.set_ylim(camera.pixels[1], 0)
    return axes


def _label_fingers(
    axes: Axes, camera: Camera, robot: ArmHand, solution: Solution, grasp: Grasp
) -> None:
    """Name and errors of every finger, at the edge of the picture with a line to its contact."""
    points, _ = robot.contacts(solution.q)
    width, height = camera.pixels
    seen = camera.project(points)
    rows = [row for row, finger in enumerate(robot.fingers) if finger in grasp.contacts]
    middle = float(np.median(seen[rows, 0]))
    sides: dict[bool, list[int]] = {False: [], True: []}
    for row in sorted(rows, key=lambda row: seen[row, 1]):
        on_right = seen[row, 0] > middle or (seen[row, 0] == middle and not sides[True])
        sides[bool(on_right)].append(row)
    for on_right, members in sides.items():
        lowest = -np.inf
        for row in members:
            finger = robot.fingers[row]
            y = max(seen[row, 1], lowest + 0.12 * height, 0.08 * height)
            lowest = y
            verdict = solution.contacts[finger]
            color = MET_COLOR if verdict.ok else MISSED_COLOR
            x = (0.985 if on_right else 0.015) * width
            align = "right" if on_right else "left"
            axes.text(
                x, y - 0.006 * height, finger, ha=align, va="bottom", size=11, color=INK, weight="bold"
            )
            axes.text(
                x, y + 0.006 * height, _errors(verdict.position_error, verdict.angle_error),
                ha=align, va="top", size=9.5, color=color,
            )
            shoulder = x + (-0.16 if on_right else 0.16) * width
            axes.plot(
                [x, shoulder, seen[row, 0]], [y, y, seen[row, 1]], color=FAINT, lw=0.8, alpha=0.8
            )


def _errors(position: float, angle: float) -> str:
    parts = [] if np.isnan(position) else [f"{1e3 * position:.2f} mm"]
    return "  ".join(parts if np.isnan(angle) else [*parts, f"{np.rad2deg(angle):.2f}°"])


def _title(figure: Figure, solution: Solution, grasp: Grasp) -> None:
    worst = [
        np.nanmax([getattr(verdict, name) for verdict in solution.contacts.values()] + [0.0])
        for name in ("position_error", "angle_error")
    ]
    color = MET_COLOR if solution.success else MISSED_COLOR
    what = f"{grasp.name} · {solution.robot}" if grasp.name else solution.robot
    limits = "" if solution.limits_ok else " · beyond a limit"
    figure.text(0.02, 0.945, what, size=16, color=INK, weight="bold", va="center")
    figure.text(0.98, 0.945, solution.status.name, size=16, color=color, weight="bold",
                va="center", ha="right")
    figure.text(
        0.02, 0.90,
        f"{solution.method} · {solution.iterations} iterations · "
        f"largest errors {_errors(*worst)}{limits}",
        size=11, color=FAINT, va="center",
    )


def _legend(figure: Figure, robot: ArmHand, solution: Solution, things: list[Solid]) -> None:
    states = {solution.contacts[finger].ok for finger in solution.contacts}
    handles: list[Line2D | Patch] = [_mark(TARGET_COLOR, "contact asked for, pad normal", 4.5)]
    if True in states:
        handles.append(_mark(MET_COLOR, "reached, within tolerance", 2.0))
    if False in states:
        handles.append(_mark(MISSED_COLOR, "reached, out of tolerance", 2.0))
    if things:
        handles.append(Patch(color=OBJECT_COLOR, label="object"))
    figure.legend(
        handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=10,
        labelcolor=INK, bbox_to_anchor=(0.5, 0.0),
    )


def _mark(color: str, label: str, width: float) -> Line2D:
    return Line2D([], [], color=color, lw=width, marker="o", markersize=6, label=label)
