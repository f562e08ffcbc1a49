"""Which links of a robot are whose: names of files may clash."""

from __future__ import annotations

from casadi_ik.robots.description import RobotDescription


def hand_links(robot: RobotDescription) -> frozenset[str]:
    """The links that the mount carries: all of the hand's file; none if there is no mount."""
    found: set[str] = set()
    more = {joint.child for joint in robot.joints if joint.part == "mount"}
    while more:
        found |= more
        more = {joint.child for joint in robot.joints if joint.parent in more}
    return frozenset(found)
