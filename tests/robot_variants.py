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
) -> ik.ArmHand:
    """The shipped arm-hand with changes.

    Args:
        folder: Where its files are written.
        heights: z of a joint's origin [m], by the joint's number "1" to "7".
        mount: xyz [m] and rpy [rad] of the hand on the flange.
        elbow_offset: By how much axis 4 is moved off the links [m]: no S-R-S arm any more.
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
    (folder / "arm.yaml").write_text(yaml.safe_dump(arm))
    if mount is not None:
        whole = yaml.safe_load(path.read_text())
        whole["mount"] = {"xyz": mount[0], "rpy": mount[1]}
        path.write_text(yaml.safe_dump(whole))
    return ik.load_robot(path)
