"""Match the links of a published file with those of a description by their joint axes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh, link_meshes
from casadi_ik.model.joints import joints_below, link_poses
from casadi_ik.model.parts import RobotPart
from casadi_ik.model.urdf_mjcf import read_tree
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

ALIKE = 2e-4
"""Largest difference of equal axes [m, or of unit vectors]."""


@dataclass(frozen=True, eq=False)
class Axis:
    """Axis of a joint at zero."""

    joint: str
    parent: str
    child: str
    point: Array
    direction: Array


def in_our_links(
    part: RobotPart, file: Path, excluded: set[str], visual: bool = False
) -> dict[str, list[IndexedMesh]]:
    """Return the meshes of a file by link of the description, in the frame of that link."""
    tree = read_tree(file)
    theirs = tree_poses(tree)
    ours = link_poses(part.root, part.joints, {})
    our_axes = [
        Axis(j.name, j.parent, j.child, ours[j.child][:3, 3], ours[j.child][:3, :3] @ j.axis)
        for j in part.joints
        if j.type != "fixed"
    ]
    best: tuple[int, dict[str, TreeJoint], Array] = (-1, {}, np.eye(4))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    for link in tree.links:
        for turn in (np.eye(4), half_turn):
            base = np.asarray(turn @ np.linalg.inv(theirs[link]), dtype=np.float64)
            matched = match(part, our_axes, tree, theirs, base)
            if len(matched) > best[0]:
                best = (len(matched), matched, base)
    count, matched, base = best
    if count < len(our_axes):
        missing = [axis.joint for axis in our_axes if axis.joint not in matched]
        print(f"  joints not found in {file.name}: {missing}")
    parents = {joint.name: joint for joint in part.joints}
    holder = {matched[name].child: parents[name].child for name in matched}
    for name, joint in matched.items():  # what hangs on a joint that moves there and not here
        holder.setdefault(joint.parent, parents[name].parent)
    # The root's own body: all that is fixed to what the first joints hang on.
    first = next(j for j in part.joints if j.name in matched)
    body = rigid(tree, matched[first.name].parent)
    for link in sorted(body - excluded):
        holder.setdefault(link, part.root)
    changed = True
    while changed:
        changed = False
        for joint in tree.joints:
            if (
                joint.type == "fixed"
                and joint.parent in holder
                and joint.child not in {*holder, *excluded}
            ):
                holder[joint.child] = holder[joint.parent]
                changed = True
    found, missing = link_meshes(tree, [link for link in holder if link not in excluded], visual)
    for line in missing:
        print("  ", line)
    parts: dict[str, list[IndexedMesh]] = {}
    for link, surface in found.items():
        pose = np.linalg.inv(ours[holder[link]]) @ base @ theirs[link]
        if len(surface.triangles):
            parts.setdefault(holder[link], []).append(surface.transformed(pose))
    return {link: parts[link] for link in ours if link in parts}


def rigid(tree: RobotTree, link: str) -> set[str]:
    """Return all links of a rigid body."""
    body, grown = {link}, True
    while grown:
        connected = {j.child for j in tree.joints if j.type == "fixed" and j.parent in body}
        connected |= {j.parent for j in tree.joints if j.type == "fixed" and j.child in body}
        grown = not connected <= body
        body |= connected
    return body


def tree_poses(tree: RobotTree) -> dict[str, Array]:
    """Return the poses of the links of a file at zero."""
    poses = {tree.root: np.eye(4)}
    for joint in tree.joints:
        poses[joint.child] = poses[joint.parent] @ joint.placement
    return poses


def match(
    part: RobotPart, axes: list[Axis], tree: RobotTree, theirs: dict[str, Array], base: Array
) -> dict[str, TreeJoint]:
    """Return the joint of the file for each joint of the description."""
    by_child = {joint.child: joint for joint in part.joints}
    found: dict[str, TreeJoint] = {}
    for axis in axes:
        above: str | None = axis.parent
        while above in by_child and by_child[above].name not in found:
            above = by_child[above].parent
        start = found[by_child[above].name].child if above in by_child else tree.root
        for joint in joints_below(tree, start):
            pose = base @ theirs[joint.child]
            if joint.type == "fixed" or joint in found.values():
                continue
            direction = pose[:3, :3] @ joint.axis
            off = axis.point - pose[:3, 3]
            off = off - (off @ axis.direction) * axis.direction
            deviation = min(
                np.abs(direction - axis.direction).max(), np.abs(direction + axis.direction).max()
            )
            if deviation < 5e-3 and np.linalg.norm(off) < 20 * ALIKE:
                found[axis.joint] = joint
                break
    return found
