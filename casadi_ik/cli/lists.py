"""`casadi-ik robots`, `methods` and `grasps`: what there is."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import fields, table
from casadi_ik.files.reading import convert, read_yaml
from casadi_ik.files.shipped import resolve, shipped_names
from casadi_ik.grasps.load import GraspFile
from casadi_ik.methods.registry import METHODS, method_summary
from casadi_ik.robots import load_description
from casadi_ik.robots.schema import ArmHandFile


def robots() -> Answer:
    """The shipped robots.

    Raises:
        DescriptionError: A shipped file is damaged.
    """
    parts: list[RenderableType] = []
    for name in shipped_names("arm_hands"):
        path = resolve(name, "arm_hands")
        robot = load_description(path)
        fingers = (f"{f} (placed first)" if f == robot.thumb else f for f in robot.finger_names)
        pairs = {
            "fingers": f"{len(robot.fingers)}: {', '.join(fingers)}",
            "actuators": f"{len(robot.actuators)}: {', '.join(robot.actuator_names)}",
        }
        description = convert(read_yaml(path), ArmHandFile, path).description
        parts += [Text(name, "bold"), Text(f"  {description}"), fields(pairs)]
    return Answer(Group(*parts))


def methods() -> Answer:
    """The methods, the default first."""
    rows = table("method", "what it does")
    for name in METHODS:
        default = " (default)" if name == METHODS[0] else ""
        rows.add_row(name, method_summary(name) + default)
    return Answer(rows)


def grasps() -> Answer:
    """The shipped grasps.

    Raises:
        DescriptionError: A shipped file is damaged.
    """
    by_robot: dict[str, Table] = {}
    for name in shipped_names("grasps"):
        path = resolve(name, "grasps")
        entry = convert(read_yaml(path), GraspFile, path)
        rows = by_robot.setdefault(entry.robot, table("grasp", "object", "description"))
        rows.add_row(name, entry.object.name if entry.object else "", entry.description)
    parts: list[RenderableType] = []
    for robot, rows in by_robot.items():
        parts += [Text.assemble("robot ", (robot or "any", "bold")), rows]
    return Answer(Group(*parts))
