"""What is written on the picture of a grasp."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from casadi_ik import palette
from casadi_ik.answers.solution import Solution
from casadi_ik.arrays import Array
from casadi_ik.grasps import Grasp
from casadi_ik.views.picture import LIGHT, Ground

OBJECT_COLOR = palette.OBJECT
TARGET_COLOR = palette.TARGET
MET_COLOR, MISSED_COLOR = palette.MET, palette.MISSED
NEAREST_COLOR = palette.NEAREST


def label_fingers(
    axes: Axes,
    places: dict[str, Array],
    solution: Solution,
    grasp: Grasp,
    ground: Ground = LIGHT,
) -> None:
    """Name and errors of every finger, at the edge of the picture with a line to its contact.

    Args:
        axes: With the picture.
        places: Where the contact of each finger is in it [pixels].
        solution: The answer.
        grasp: The question.
        ground: What is drawn on.
    """
    height, width = axes.images[0].get_size()
    asked = grasp.contacts or places  # of a palm that is given all fingers follow
    seen = {finger: place for finger, place in places.items() if finger in asked}
    middle = (min(x for x, _ in seen.values()) + max(x for x, _ in seen.values())) / 2
    lowest = {"left": -np.inf, "right": -np.inf}
    for finger, (x, y) in sorted(seen.items(), key=lambda item: item[1][1]):
        verdict = solution.contacts[finger]
        side = "right" if x > middle else "left"
        level = lowest[side] = max(y, lowest[side] + 0.12 * height, 0.08 * height)
        edge, shoulder = (0.985, 0.825) if side == "right" else (0.015, 0.175)
        above = {"ha": side, "va": "bottom", "size": 11, "color": ground.ink, "weight": "bold"}
        axes.text(edge * width, level - 0.006 * height, finger, **above)
        color = MET_COLOR if verdict.ok else MISSED_COLOR
        below = {"ha": side, "va": "top", "size": 9.5, "color": color}
        errors = _errors(verdict.position_error, verdict.angle_error)
        axes.text(edge * width, level + 0.006 * height, errors, **below)
        line = [edge * width, shoulder * width, x], [level, level, y]
        axes.plot(*line, color=ground.faint, lw=0.8, alpha=0.8)


def _errors(position: float, angle: float) -> str:
    parts = [] if np.isnan(position) else [f"{1e3 * position:.2f} mm"]
    return "  ".join(parts if np.isnan(angle) else [*parts, f"{np.rad2deg(angle):.2f}°"])


def add_title(figure: Figure, solution: Solution, grasp: Grasp, ground: Ground = LIGHT) -> None:
    """What was asked, how it ended, and the largest errors."""
    worst = [
        np.nanmax([getattr(verdict, name) for verdict in solution.contacts.values()] + [0.0])
        for name in ("position_error", "angle_error")
    ]
    what = f"{grasp.name} · {solution.robot}" if grasp.name else solution.robot
    large = {"size": 16, "weight": "bold", "va": "center"}
    figure.text(0.02, 0.945, what, color=ground.ink, **large)
    color = MET_COLOR if solution.success else MISSED_COLOR
    figure.text(0.98, 0.945, solution.status.name, color=color, ha="right", **large)
    limits = "" if solution.limits_ok else " · beyond a limit"
    how = f"{solution.method} · {solution.iterations} iterations"
    how += f" · largest errors {_errors(*worst)}{limits}"
    figure.text(0.02, 0.90, how, size=11, color=ground.faint, va="center")


def add_legend(
    figure: Figure,
    solution: Solution,
    grasp: Grasp,
    has_object: bool,
    has_scene: bool = False,
    ground: Ground = LIGHT,
) -> None:
    """What the arrows mean."""
    states = {verdict.ok for verdict in solution.contacts.values()}
    handles: list[Line2D | Patch] = [_mark(TARGET_COLOR, _asked(grasp), 4.5)]
    if True in states:
        handles.append(_mark(MET_COLOR, "reached, within tolerance", 2.0))
    if False in states:
        handles.append(_mark(MISSED_COLOR, "reached, out of tolerance", 2.0))
    if has_object:
        handles.append(Patch(color=OBJECT_COLOR, label="object"))
    if has_scene and solution.closest is not None and solution.clearance is not None:
        pair = " and ".join(solution.closest)
        label = f"nearest: {pair}, {1e3 * solution.clearance:.1f} mm"
        handles.append(Line2D([], [], color=NEAREST_COLOR, lw=3.0, label=label))
    style = {"frameon": False, "fontsize": 10, "labelcolor": ground.ink}
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), **style)


def _asked(grasp: Grasp) -> str:
    """What the marks of a target are."""
    if grasp.palm is not None:
        return "asked for: palm and posture"
    contacts = grasp.contacts.values()
    placed = [contact for contact in contacts if not np.isnan(contact.point[0])]
    marks = {
        "contact": any(c.line is None and c.plane is None for c in placed),
        "line (rod)": any(c.line is not None for c in placed),
        "plane (ring)": any(c.plane is not None for c in placed),
        "pad normal": any(c.normal is not None for c in contacts),
        "second axis (shorter)": any(c.tangent is not None for c in contacts),
    }
    return "asked for: " + ", ".join(name for name, there in marks.items() if there)


def _mark(color: str, label: str, width: float) -> Line2D:
    return Line2D([], [], color=color, lw=width, marker="o", markersize=6, label=label)
