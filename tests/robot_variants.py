"""Robots derived from the shipped one: other links, other mounts, an elbow off the links."""

from __future__ import annotations

from pathlib import Path

import yaml
from toy_robots import copy_shipped_robot

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
    arm = yaml.safe_load((folder / "arm.yaml").read_text())
    for joint in arm["joints"]:
        number = joint["name"][-1]
        z = (heights or {}).get(number)
        if z is not None:
            joint["origin"]["xyz"] = [0, 0, z]
        if number in "45" and elbow_offset:
            x = elbow_offset if number == "4" else -elbow_offset
            joint["origin"]["xyz"] = [x, 0, joint["origin"]["xyz"][2]]
        if number in "67" and wrist_offset:
            x = wrist_offset if number == "6" else -wrist_offset
            joint["origin"]["xyz"] = [x, 0, joint["origin"]["xyz"][2]]
    (folder / "arm.yaml").write_text(yaml.safe_dump(arm))
    if mount is not None:
        whole = yaml.safe_load(path.read_text())
        whole["mount"] = {"xyz": mount[0], "rpy": mount[1]}
        path.write_text(yaml.safe_dump(whole))
    return ik.load_robot(path)


def thumb_of(folder: Path, joints: int) -> ik.ArmHand:
    """The shipped arm-hand with a thumb of one to four joints.

    The distal joint is fixed for one; a turning base comes first for three, and a
    rolling link too for four.
    """
    path = copy_shipped_robot(folder)
    hand = yaml.safe_load((folder / "hand.yaml").read_text())
    proximal, distal = hand["joints"][:2]
    if joints == 1:
        distal |= {"type": "fixed", "limits": [0, 0]}
        del hand["actuators"][distal["name"]]
        whole = yaml.safe_load(path.read_text())
        del whole["home"][distal["name"]]
        path.write_text(yaml.safe_dump(whole))
    more = []
    if joints >= 3:
        place = {"xyz": proximal["origin"]["xyz"], "rpy": [0, 0, 0]}
        more.append(_revolute("thumb_turn", proximal["parent"], "thumb_base", [0, 0, 1], place))
        proximal["parent"] = "thumb_base"
        proximal["origin"]["xyz"] = [0, 0, 0]
    if joints == 4:
        place = {"xyz": [0.03, 0, 0], "rpy": [0, 0, 0]}
        more.append(_revolute("thumb_roll", distal["parent"], "thumb_rolling", [1, 0, 0], place))
        distal["parent"] = "thumb_rolling"
        distal["origin"]["xyz"] = [0.04, 0, 0]
    hand["joints"] = sorted(more + hand["joints"], key=lambda joint: joint["name"] != "thumb_turn")
    if joints == 4:
        roll = hand["joints"].index(more[1])
        hand["joints"].insert(2, hand["joints"].pop(roll))
    hand["actuators"] = {joint["name"]: {} for joint in more} | hand["actuators"]
    (folder / "hand.yaml").write_text(yaml.safe_dump(hand, sort_keys=False))
    return ik.load_robot(path)


def _revolute(name: str, parent: str, child: str, axis: list[int], origin: dict) -> dict:
    """A joint of plus and minus 40 deg."""
    limits = ["-40 deg", "40 deg"]
    entry = {"name": name, "parent": parent, "child": child, "axis": axis, "origin": origin}
    return entry | {"limits": limits, "source": "assumed", "velocity": "2 rad/s"}
