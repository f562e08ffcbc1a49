"""Joints that hang on what moves, not on what is fixed to it: fewer products of poses in graphs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.robots.description import Joint, frozen


@dataclass(frozen=True, eq=False)
class FlatJoints:
    """The joints of a robot without chains of fixed ones.

    Attributes:
        joints: The joints, parents before children; fixed ones are leaves but for the palm's.
        places: By link the link it is fixed to (itself, if it moves) and its (4, 4) pose there.
    """

    joints: tuple[Joint, ...]
    places: dict[str, tuple[str, Array]]


def flattened(joints: list[Joint], root: str, palm: str) -> FlatJoints:
    """Hang every joint on the nearest link above it that moves, or on root or palm.

    Args:
        joints: Parents before children.
        root: The base link.
        palm: The link of the palm, where fingers begin.
    """
    places: dict[str, tuple[str, Array]] = {root: (root, np.eye(4))}
    found: list[Joint] = []
    for joint in joints:
        link, pose = places[joint.parent]
        placement = pose @ joint.placement
        if joint.type == "fixed" and joint.child != palm:
            places[joint.child] = (link, placement)
        else:
            places[joint.child] = (joint.child, np.eye(4))
        found.append(replace(joint, parent=link, placement=frozen(placement)))
    return FlatJoints(tuple(found), places)
