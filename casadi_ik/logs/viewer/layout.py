"""The panels in which Foxglove and Lichtblick show a viewer file.

The shipped ``models/viewer/layout.json`` suits the KUKA arm with the Barrett hand and the paper's
methods; for another robot or method its plots and its frame are filled in from the solve.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import LogError
from casadi_ik.files.shipped import models_folder
from casadi_ik.files.writing import written_whole
from casadi_ik.logs.read.one_solve import OneSolve

COLORS = ("#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6", "#c2334d", "#0f8b8d")
"""Of the lines of a plot."""

Line = tuple[str, str]
"""Message path and label."""


def shipped_layout() -> Path:
    """The layout file that comes with the package."""
    return models_folder() / "viewer" / "layout.json"


def layout_of(solve: OneSolve, robot: ArmHand) -> dict[str, Any]:
    """The shipped layout, its plots and its frame filled in for a solve.

    Args:
        solve: The solve; its fields are what is plotted.
        robot: The robot that it was solved for.
    """
    layout = json.loads(shipped_layout().read_text(encoding="utf-8"))
    panels = layout["configById"]
    panels["3D!robot"]["followTf"] = robot.description.root
    for name in ("position_error", "angle_error"):
        panels[f"Plot!{name}"]["paths"] = _paths(_lines(solve, name))
    sigmas = [name for name in solve.layout.names if name.startswith("sigma_")]
    panels["Plot!sigma"]["paths"] = _paths(line for name in sigmas for line in _lines(solve, name))
    panels["Plot!joints"]["paths"] = _paths(
        (f"/joint_states.position[{i}]", joint)
        for i, joint in enumerate(robot.description.joint_names)
    )
    return layout


def write_layout(path: str | os.PathLike[str], layout: dict[str, Any]) -> None:
    """Write a layout file, to be imported by the viewer.

    Raises:
        LogError: It cannot be written.
    """
    try:
        with written_whole(Path(path)) as part:
            part.write_text(json.dumps(layout, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot write the layout: {reason}") from error


def _lines(solve: OneSolve, name: str) -> list[Line]:
    """A line per element of a field of the log."""
    fields = {item.name: item for item in solve.layout}
    if name not in fields:
        return []
    if not fields[name].shape:
        return [(f"/ik/iteration.{name}", name.removeprefix("sigma_"))]
    return [
        (f"/ik/iteration.{name}[{i}]", solve.name_of(name, i)) for i in range(fields[name].size)
    ]


def _paths(lines: Iterable[Line]) -> list[dict[str, Any]]:
    return [
        {
            "value": value,
            "label": label,
            "enabled": True,
            "timestampMethod": "receiveTime",
            "color": COLORS[i % len(COLORS)],
        }
        for i, (value, label) in enumerate(lines)
    ]
