"""`casadi-ik robots`, `methods` and `grasps`: what there is."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik.arms.recognise import family_in_words
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import fields, table
from casadi_ik.files.reading import convert, read_yaml
from casadi_ik.files.shipped import resolve, shipped_names
from casadi_ik.grasps.load import GraspFile
from casadi_ik.registry import METHODS, method_summary
from casadi_ik.robots import load_description
from casadi_ik.robots.schema import ArmFile, ArmHandFile, HandFile


def robots() -> Answer:
    """The shipped robots.

    Raises:
        DescriptionError: A shipped file is damaged.
    """
    parts: list[RenderableType] = []
    for name in shipped_names("arm_hands"):
        path = resolve(name, "arm_hands")
        robot = load_description(path)
        thumb = robot.named_thumb
        fingers = (f"{f} (placed first)" if f == thumb else f for f in robot.finger_names)
        pairs = {
            "fingers": f"{len(robot.fingers)}: {', '.join(fingers)}",
            "actuators": f"{len(robot.actuators)}: {', '.join(robot.actuator_names)}",
        }
        if robot.arm_actuators:
            pairs["arm"] = f"closed form: {family_in_words(robot)}"
        description = convert(read_yaml(path), ArmHandFile, path).description
        parts += [Text(name, "bold"), Text(f"  {description}"), fields(pairs)]
    return Answer(Group(*parts, *_catalogue()))


def _catalogue() -> list[RenderableType]:
    """The arms and hands that are put together by their names."""
    arms = table("arm", "joints", "closed form", "what it is", right=("joints",))
    some_hand = shipped_names("hands")[0]
    for name in shipped_names("arms"):
        path = resolve(name, "arms")
        arm = convert(read_yaml(path), ArmFile, path)
        count = sum(joint.type != "fixed" for joint in arm.joints)
        form = family_in_words(load_description(f"{name}+{some_hand}"))
        arms.add_row(name, str(count), form, _short(arm.description))
    hands = table("hand", "motors", "fingers", "what it is", right=("motors", "fingers"))
    for name in shipped_names("hands"):
        path = resolve(name, "hands")
        hand = convert(read_yaml(path), HandFile, path)
        motors = hand.actuators or [
            joint for joint in hand.joints if joint.type != "fixed" and joint.coupling is None
        ]
        hands.add_row(name, str(len(motors)), str(len(hand.fingers)), _short(hand.description))
    example = 'any arm with any hand: load_robot("ARM+HAND"), --robot ARM+HAND, such as'
    return [Text(f"{example} panda+allegro_right", "bold"), arms, hands]


def _short(description: str) -> str:
    """The first sentence of a description."""
    return description.split(". ")[0].rstrip(".\n")


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
