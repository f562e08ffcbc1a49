"""Links held together by joints: what carries what, of files, parts and robots alike, and where.

Forward kinematics are in numpy, of one or many configurations: nothing is built or compiled.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.model.joints import Joint


class TreeEdge(Protocol):
    """What hangs a link on another one."""

    @property
    def parent(self) -> str:
        """The link above."""
        ...

    @property
    def child(self) -> str:
        """The link below."""
        ...


class TypedEdge(TreeEdge, Protocol):
    """The same, of a type: "fixed" or one that moves."""

    @property
    def type(self) -> str:
        """The type."""
        ...


L = TypeVar("L", bound=TreeEdge)
J = TypeVar("J", bound=TypedEdge)
J_co = TypeVar("J_co", bound=TypedEdge, covariant=True)


class JointTree(Protocol[J_co]):
    """Links held together by joints: a file's, a part's or a robot's."""

    @property
    def root(self) -> str:
        """The base link."""
        ...

    @property
    def joints(self) -> Sequence[J_co]:
        """The joints, parents before children."""
        ...


def parents_first(joints: Iterable[L], root: str) -> tuple[L, ...]:
    """The order of the file, moved only where a child stands before its parent.

    Joints that do not hang on the root are left out.
    """
    hung, waiting = {root}, list(joints)
    placed: list[L] = []
    while waiting:
        joint = next((one for one in waiting if one.parent in hung), None)
        if joint is None:
            break
        waiting.remove(joint)
        placed.append(joint)
        hung.add(joint.child)
    return tuple(placed)


def require_name(name: str, names: Collection[str], noun: str, where: str) -> str:
    """The name of a link or joint, if it is among some.

    Raises:
        DescriptionError: It is not; the message lists them.
    """
    if name not in names:
        raise DescriptionError(f"{where}: unknown {noun} {name!r}; known: {', '.join(names)}")
    return name


def links_of(tree: JointTree[TypedEdge]) -> tuple[str, ...]:
    """All links, the root first."""
    return (tree.root, *(joint.child for joint in tree.joints))


def chain_to(tree: JointTree[J], link: str, top: str | None = None) -> list[J]:
    """The joints down to a link, in order: from the root, or from a link above it."""
    by_child = {joint.child: joint for joint in tree.joints}
    found: list[J] = []
    while link != top and link in by_child:
        found.append(by_child[link])
        link = by_child[link].parent
    return found[::-1]


def joints_below(tree: JointTree[J], link: str) -> list[J]:
    """All joints that a link carries, directly or not."""
    carried, found = {link}, []
    for joint in tree.joints:
        if joint.parent in carried:
            carried.add(joint.child)
            found.append(joint)
    return found


def rigid_links(tree: JointTree[TypedEdge], link: str) -> list[str]:
    """A link and all that is fixed to it below."""
    found = [link]
    for joint in tree.joints:
        if joint.type == "fixed" and joint.parent in found:
            found.append(joint.child)
    return found


def moving_below(tree: JointTree[J], link: str) -> list[J]:
    """The first moving joints below a link, those behind fixed ones included."""
    carried = rigid_links(tree, link)
    return [one for one in tree.joints if one.type != "fixed" and one.parent in carried]


def joint_depth(tree: JointTree[TypedEdge], link: str) -> int:
    """The most moving joints in a row below a link."""
    return max((1 + joint_depth(tree, one.child) for one in moving_below(tree, link)), default=0)


def leaf_links(tree: JointTree[TypedEdge], link: str) -> list[str]:
    """The links below a link that carry nothing."""
    parents = {joint.parent for joint in tree.joints}
    return [joint.child for joint in joints_below(tree, link) if joint.child not in parents]


def rigid_bodies(tree: JointTree[TypedEdge]) -> tuple[dict[str, str], set[frozenset[str]]]:
    """By link the link it is fixed to that moves, or the root; and which of these share a joint."""
    bodies, neighbours = {tree.root: tree.root}, set()
    for joint in tree.joints:
        parent = bodies[joint.parent]
        bodies[joint.child] = parent if joint.type == "fixed" else joint.child
        neighbours.add(frozenset((parent, bodies[joint.child])))
    return bodies, neighbours


def joint_positions(joints: Iterable[Joint], motors: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Positions (k,) of all movable joints behind their couplings, by name.

    Args:
        joints: All joints that couplings refer to, in any order.
        motors: Positions by motor [rad or m], numbers or (k,).
    """
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    found = {name: np.atleast_1d(np.asarray(value, float)) for name, value in motors.items()}

    def position(name: str) -> Array:
        if name not in found:
            coupling = by_name[name].coupling
            assert coupling is not None, f"joint {name!r} has no motor"
            found[name] = coupling.followed(position(coupling.of))
        return found[name]

    return {name: position(name) for name in by_name}


def link_poses(
    root: str, joints: Iterable[Joint], values: Mapping[str, ArrayLike]
) -> dict[str, Array]:
    """Poses of links in the root's frame, by name.

    Args:
        root: The base link.
        joints: Joints from the root outwards: all, or those of some chains.
        values: Positions by joint name [rad or m], numbers or (k,); joints that are not named
            stay at zero.

    Returns:
        (4, 4) each, or (k, 4, 4) of links that a joint with k positions moves.
    """
    poses = {root: np.eye(4)}
    for joint in joints:
        pose = poses[joint.parent] @ joint.placement
        if joint.name in values:
            pose = pose @ joint_motion(joint.type, joint.axis, values[joint.name])
        poses[joint.child] = pose
    return poses


def joint_motion(kind: str, axis: Array, positions: ArrayLike) -> Array:
    """(4, 4) or (k, 4, 4): what a joint of a type does at positions () or (k,) [rad or m]."""
    value = np.asarray(positions, dtype=float)[..., None, None]
    moved = np.zeros((*value.shape[:-2], 4, 4)) + np.eye(4)
    if kind == "prismatic":
        moved[..., :3, 3] = value[..., 0] * axis
    elif kind == "revolute":
        # Rodrigues' formula.
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        moved[..., :3, :3] += np.sin(value) * cross + (1 - np.cos(value)) * (cross @ cross)
    return moved
