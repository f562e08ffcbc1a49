"""Robots derived from the shipped one: other links, other mounts, an offset elbow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toy_robots import copy_shipped_robot, edited

import casadi_ik as ik


def derived_robot(
    folder: Path,
    heights: dict[str, float] | None = None,
    mount: tuple[list[float], list[float]] | None = None,
    elbow_offset: float = 0.0,
    wrist_offset: float = 0.0,
) -> ik.ArmHand:
    """The shipped arm-hand with changes.

    Args:
        folder: Where its files are written.
        heights: z of a joint's origin [m], by the joint's number "1" to "7".
        mount: xyz [m] and rpy [rad] of the hand on the flange.
        elbow_offset: By how much axis 4 is moved off the links [m]: no S-R-S arm any more.
        wrist_offset: The same of axis 6: no closed form at all.
    """
    path = copy_shipped_robot(folder)
    with edited(folder / "arm.yaml") as arm:
        for joint in arm["joints"]:
            number, origin = joint["name"][-1], joint["origin"]
            z = (heights or {}).get(number)
            if z is not None:
                origin["xyz"] = [0, 0, z]
            for pair, offset in (("45", elbow_offset), ("67", wrist_offset)):
                if number in pair and offset:
                    origin["xyz"] = [offset if number == pair[0] else -offset, 0, origin["xyz"][2]]
    if mount is not None:
        with edited(path) as data:
            data["mount"] = {"xyz": mount[0], "rpy": mount[1]}
    return ik.load_robot(path)


def part_of_the_arm(folder: Path, joints: slice) -> Path:
    """Write the shipped hand on some joints of the shipped arm in series."""
    path = copy_shipped_robot(folder)
    with edited(folder / "arm.yaml") as arm:
        arm["joints"] = arm["joints"][joints]
        arm["joints"][0]["parent"] = arm["root"]
        arm["tip"]["link"] = arm["joints"][-1]["child"]
        names = [joint["name"] for joint in arm["joints"]]
        arm["home"] = {name: value for name, value in arm["home"].items() if name in names}
        del arm["collision"]
    with edited(path) as data:
        home_entries = data["home"].items()
        data["home"] = {n: v for n, v in home_entries if n in names or n.startswith("bh")}
        data.pop("collision", None)
    return path


def thumb_of(folder: Path, joints: int) -> ik.ArmHand:
    """The shipped arm-hand with a thumb of one to four joints.

    The distal joint is fixed for one; a turning base comes first for three, and a
    rolling link too for four.
    """
    path = copy_shipped_robot(folder)
    with edited(folder / "hand.yaml") as hand:
        proximal, distal = hand["joints"][:2]
        if joints == 1:
            distal |= {"type": "fixed", "limits": [0, 0]}
            del hand["actuators"][distal["name"]]
            with edited(path) as data:
                del data["home"][distal["name"]]
        extra_lines = []
        if joints >= 3:
            place = {"xyz": proximal["origin"]["xyz"], "rpy": [0, 0, 0]}
            extra_lines.append(
                _revolute("thumb_turn", proximal["parent"], "thumb_base", [0, 0, 1], place)
            )
            proximal["parent"] = "thumb_base"
            proximal["origin"]["xyz"] = [0, 0, 0]
        if joints == 4:
            place = {"xyz": [0.03, 0, 0], "rpy": [0, 0, 0]}
            extra_lines.append(
                _revolute("thumb_roll", distal["parent"], "thumb_rolling", [1, 0, 0], place)
            )
            distal["parent"] = "thumb_rolling"
            distal["origin"]["xyz"] = [0.04, 0, 0]
        hand["joints"] = sorted(
            extra_lines + hand["joints"], key=lambda joint: joint["name"] != "thumb_turn"
        )
        if joints == 4:
            roll = hand["joints"].index(extra_lines[1])
            hand["joints"].insert(2, hand["joints"].pop(roll))
        hand["actuators"] = {joint["name"]: {} for joint in extra_lines} | hand["actuators"]
    return ik.load_robot(path)


def _revolute(name: str, parent: str, child: str, axis: list[int], origin: dict) -> dict:
    """Return a joint with limits of plus and minus 40 deg."""
    limits = ["-40 deg", "40 deg"]
    entry = {"name": name, "parent": parent, "child": child, "axis": axis, "origin": origin}
    return entry | {"limits": limits, "source": "assumed", "velocity": "2 rad/s"}


def with_fixed_motor(robot: ik.ArmHand, motor: str) -> ik.ArmHand:
    """Return a robot in which the joint of a motor is fixed at zero."""
    body = robot.description
    assert motor in body.actuator_names
    moving = [i for i, actuator in enumerate(body.actuators) if actuator.name != motor]
    joints = tuple(
        replace(joint, type="fixed") if joint.name == motor else joint for joint in body.joints
    )
    motors = tuple(body.actuators[i] for i in moving)
    name = f"{body.name}_without_{motor}"
    return ik.ArmHand(
        replace(body, name=name, joints=joints, actuators=motors, home=body.home[moving])
    )
