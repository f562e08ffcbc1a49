"""What is written on the picture of a grasp."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Grasp
from casadi_ik.solvers import Solution
from casadi_ik.views.camera import Camera
from casadi_ik.views.picture import FAINT, INK

OBJECT_COLOR = "#8cc4e8"
TARGET_COLOR = "#f0b400"
MET_COLOR, MISSED_COLOR = "#1f9d55", "#d62f3c"


def label_fingers(
    axes: Axes, camera: Camera, robot: ArmHand, solution: Solution, grasp: Grasp
) -> None:
    """Name and errors of every finger, at the edge of the picture with a line to its contact."""
    points, _ = robot.contacts(solution.q)
    width, height = camera.pixels
    seen = camera.project(points)
    rows = [row for row, finger in enumerate(robot.fingers) if finger in grasp.contacts]
    middle = (seen[rows, 0].min() + seen[rows, 0].max()) / 2
    sides: dict[bool, list[int]] = {False: [], True: []}
    for row in sorted(rows, key=lambda row: seen[row, 1]):
        sides[bool(seen[row, 0] > middle)].append(row)
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
                x,
                y - 0.006 * height,
                finger,
                ha=align,
                va="bottom",
                size=11,
                color=INK,
                weight="bold",
            )
            axes.text(
                x,
                y + 0.006 * height,
                _errors(verdict.position_error, verdict.angle_error),
                ha=align,
                va="top",
                size=9.5,
                color=color,
            )
            shoulder = x + (-0.16 if on_right else 0.16) * width
            axes.plot(
                [x, shoulder, seen[row, 0]], [y, y, seen[row, 1]], color=FAINT, lw=0.8, alpha=0.8
            )


def _errors(position: float, angle: float) -> str:
    parts = [] if np.isnan(position) else [f"{1e3 * position:.2f} mm"]
    return "  ".join(parts if np.isnan(angle) else [*parts, f"{np.rad2deg(angle):.2f}°"])


def add_title(figure: Figure, solution: Solution, grasp: Grasp) -> None:
    """What was asked, how it ended, and the largest errors."""
    worst = [
        np.nanmax([getattr(verdict, name) for verdict in solution.contacts.values()] + [0.0])
        for name in ("position_error", "angle_error")
    ]
    color = MET_COLOR if solution.success else MISSED_COLOR
    what = f"{grasp.name} · {solution.robot}" if grasp.name else solution.robot
    limits = "" if solution.limits_ok else " · beyond a limit"
    figure.text(0.02, 0.945, what, size=16, color=INK, weight="bold", va="center")
    figure.text(
        0.98,
        0.945,
        solution.status.name,
        size=16,
        color=color,
        weight="bold",
        va="center",
        ha="right",
    )
    figure.text(
        0.02,
        0.90,
        f"{solution.method} · {solution.iterations} iterations · "
        f"largest errors {_errors(*worst)}{limits}",
        size=11,
        color=FAINT,
        va="center",
    )


def add_legend(figure: Figure, solution: Solution, has_object: bool) -> None:
    """What the arrows mean."""
    states = {solution.contacts[finger].ok for finger in solution.contacts}
    handles: list[Line2D | Patch] = [_mark(TARGET_COLOR, "contact asked for, pad normal", 4.5)]
    if True in states:
        handles.append(_mark(MET_COLOR, "reached, within tolerance", 2.0))
    if False in states:
        handles.append(_mark(MISSED_COLOR, "reached, out of tolerance", 2.0))
    if has_object:
        handles.append(Patch(color=OBJECT_COLOR, label="object"))
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles),
        frameon=False,
        fontsize=10,
        labelcolor=INK,
        bbox_to_anchor=(0.5, 0.0),
    )


def _mark(color: str, label: str, width: float) -> Line2D:
    return Line2D([], [], color=color, lw=width, marker="o", markersize=6, label=label)
