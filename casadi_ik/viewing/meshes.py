"""The meshes of a robot's files, by link of the robot."""

from __future__ import annotations

from pathlib import Path

from casadi_ik.arm_hand import ArmHand
from casadi_ik.files.reading import read_yaml
from casadi_ik.importing.imported import tree_of
from casadi_ik.importing.surfaces import Surface, link_surfaces
from casadi_ik.robots.parts import PREFIX


def robot_meshes(robot: ArmHand, path: Path) -> dict[str, Surface]:
    """What the files that a description points to show of its links.

    Args:
        robot: The robot of the description.
        path: The description.

    Returns:
        By link its surface in its frame; links of which no file has a shape are left out.

    Raises:
        CasadiIKError: The description cannot be read.
    """
    raw, links = read_yaml(path), set(robot.description.links)
    found: dict[str, Surface] = {}
    for key in ("arm", "hand", "robot"):
        entry = raw.get(key)
        if not isinstance(entry, dict) or "file" not in entry:
            continue
        prefix = PREFIX if key == "hand" else ""
        # A name that arm and hand both have is prefixed in the hand.
        named = {link.removeprefix(prefix) if prefix else link: link for link in links}
        named |= {link: link for link in links if f"{prefix}{link}" not in links or not prefix}
        surfaces, _ = link_surfaces(tree_of(path, entry), list(named))
        for link, surface in surfaces.items():
            found.setdefault(named[link], surface)
    return found
