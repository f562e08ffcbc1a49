"""Joints and motors as frozen data, ranges of motors, and trees of joints.

Trees have an order of joints, chains and forward kinematics.
Forward kinematics are in NumPy, for one or many configurations: no graph is built or compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.model.couplings import Coupling


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of the kinematic tree.

    Attributes:
        name: Unique name.
        parent: Parent link.
        child: Child link; its frame is the joint's frame.
        type: "revolute" [rad], "prismatic" [m] or "fixed".
        placement: (4, 4) pose of the joint frame in the parent link at position zero.
        axis: (3,) unit axis in the joint frame.
        lower: Lower limit [rad or m].
        upper: Upper limit [rad or m].
        velocity: Velocity limit [rad/s or m/s], inf if unknown.
        coupling: Coupling to an actuator or another joint; None for a joint that an actuator drives
            directly.
        part: "arm", "mount" or "hand".
        effort: Largest torque or force [N m or N], inf if unknown.
    """

    name: str
    parent: str
    child: str
    type: str
    placement: Array
    axis: Array
    lower: float
    upper: float
    velocity: float
    coupling: Coupling | None
    part: str
    effort: float = np.inf


@dataclass(frozen=True)
class Actuator:
    """A motor: a coordinate of q.

    Attributes:
        name: Unique name.
        unit: "rad" or "m".
        lower: Lower limit of the motor alone; `RobotDescription.lower` includes limits of joints.
        upper: Upper limit of the motor alone.
        velocity: Velocity limit [unit/s], inf if unknown.
        part: "arm" or "hand".
        effort: Largest torque or force at the motor [N m or N], inf if unknown.
        continuous: True for a motor without limits; lower and upper are then the range that is
            searched, one turn to either side of zero.
    """

    name: str
    unit: str
    lower: float
    upper: float
    velocity: float
    part: str
    effort: float = np.inf
    continuous: bool = False


class TreeEdge(Protocol):
    """A connection of a parent and a child link."""

    @property
    def parent(self) -> str:
        """Parent link."""
        ...

    @property
    def child(self) -> str:
        """Child link."""
        ...


class TypedEdge(TreeEdge, Protocol):
    """A connection with a type: "fixed", or a type of joint that moves."""

    @property
    def type(self) -> str:
        """Type of the connection."""
        ...


class PlacedEdge(TypedEdge, Protocol):
    """A joint with the geometry that forward kinematics needs."""

    @property
    def name(self) -> str:
        """Name of the joint."""
        ...

    @property
    def placement(self) -> Array:
        """(4, 4) pose of the child link in the parent link at position zero."""
        ...

    @property
    def axis(self) -> Array:
        """(3,) unit axis in the frame of the child link."""
        ...


L = TypeVar("L", bound=TreeEdge)
J = TypeVar("J", bound=TypedEdge)
J_co = TypeVar("J_co", bound=TypedEdge, covariant=True)


class JointTree(Protocol[J_co]):
    """A tree of links and joints: of a file, a part or a robot."""

    @property
    def root(self) -> str:
        """Root link."""
        ...

    @property
    def joints(self) -> Sequence[J_co]:
        """Joints, parents before children."""
        ...


def parents_first(joints: Iterable[L], root: str) -> tuple[L, ...]:
    """Return joints with parents before children, otherwise in their order.

    Joints that are not connected to the root are omitted.
    """
    connected, remaining = {root}, list(joints)
    ordered: list[L] = []
    while remaining:
        joint = next((joint for joint in remaining if joint.parent in connected), None)
        if joint is None:
            break
        remaining.remove(joint)
        ordered.append(joint)
        connected.add(joint.child)
    return tuple(ordered)


def require_name(name: str, names: Collection[str], noun: str, location: str) -> str:
    """Return the name of a link or joint if it exists.

    Raises:
        DescriptionError: The name does not exist; the message lists those that do.
    """
    if name not in names:
        raise DescriptionError(f"{location}: unknown {noun} {name!r}; known: {', '.join(names)}")
    return name


def links_of(tree: JointTree[TypedEdge]) -> tuple[str, ...]:
    """Return all links, the root first."""
    return (tree.root, *(joint.child for joint in tree.joints))


def chain_to(tree: JointTree[J], link: str, start: str | None = None) -> list[J]:
    """Return the joints from the root, or from the link `start`, to a link, in order."""
    by_child = {joint.child: joint for joint in tree.joints}
    chain: list[J] = []
    while link != start and link in by_child:
        chain.append(by_child[link])
        link = by_child[link].parent
    return chain[::-1]


def joints_below(tree: JointTree[J], link: str) -> list[J]:
    """Return all joints that a link carries, directly or indirectly."""
    links, joints = {link}, []
    for joint in tree.joints:
        if joint.parent in links:
            links.add(joint.child)
            joints.append(joint)
    return joints


def rigid_links(tree: JointTree[TypedEdge], link: str) -> list[str]:
    """Return a link and all links below that are fixed to it."""
    links = [link]
    for joint in tree.joints:
        if joint.type == "fixed" and joint.parent in links:
            links.append(joint.child)
    return links


def moving_below(tree: JointTree[J], link: str) -> list[J]:
    """Return the first moving joints below a link, including those behind fixed joints."""
    links = rigid_links(tree, link)
    return [joint for joint in tree.joints if joint.type != "fixed" and joint.parent in links]


def joint_depth(tree: JointTree[TypedEdge], link: str) -> int:
    """Return the largest number of moving joints in series below a link."""
    depths = (1 + joint_depth(tree, joint.child) for joint in moving_below(tree, link))
    return max(depths, default=0)


def leaf_links(tree: JointTree[TypedEdge], link: str) -> list[str]:
    """Return the links below a link that have no children."""
    parents = {joint.parent for joint in tree.joints}
    return [joint.child for joint in joints_below(tree, link) if joint.child not in parents]


def rigid_bodies(tree: JointTree[TypedEdge]) -> tuple[dict[str, str], set[frozenset[str]]]:
    """Return the moving link that each link is fixed to, and the pairs that share a joint."""
    bodies, neighbours = {tree.root: tree.root}, set()
    for joint in tree.joints:
        parent = bodies[joint.parent]
        bodies[joint.child] = parent if joint.type == "fixed" else joint.child
        neighbours.add(frozenset((parent, bodies[joint.child])))
    return bodies, neighbours


def joint_positions(joints: Iterable[Joint], motors: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the positions (k,) of all movable joints, after couplings, by name.

    Args:
        joints: All joints that couplings refer to, in any order.
        motors: Positions by motor [rad or m], numbers or (k,).
    """
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    positions = {name: np.atleast_1d(np.asarray(value, float)) for name, value in motors.items()}

    def position(name: str) -> Array:
        if name not in positions:
            coupling = by_name[name].coupling
            assert coupling is not None, f"joint {name!r} has no motor"
            positions[name] = coupling.joint_position(position(coupling.of))
        return positions[name]

    return {name: position(name) for name in by_name}


def link_poses(
    root: str, joints: Iterable[PlacedEdge], values: Mapping[str, ArrayLike]
) -> dict[str, Array]:
    """Return the poses of links in the root's frame by name.

    Args:
        root: Root link.
        joints: Joints from the root outwards: all, or those of some chains.
        values: Positions by joint name [rad or m], numbers or (k,); other joints are at zero.

    Returns:
        (4, 4) each, or (k, 4, 4) for links that a joint with k positions moves.
    """
    poses = {root: np.eye(4)}
    for joint in joints:
        pose = poses[joint.parent] @ joint.placement
        if joint.name in values:
            pose = pose @ joint_motion(joint.type, joint.axis, values[joint.name])
        poses[joint.child] = pose
    return poses


def joint_motion(kind: str, axis: Array, positions: ArrayLike) -> Array:
    """Return the displacement (..., 4, 4) of a joint at positions (...) [rad or m]."""
    value = np.asarray(positions, dtype=float)[..., None, None]
    pose = np.zeros((*value.shape[:-2], 4, 4)) + np.eye(4)
    if kind == "prismatic":
        pose[..., :3, 3] = value[..., 0] * axis
    elif kind in ("revolute", "continuous"):
        # Rodrigues' formula.
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        pose[..., :3, :3] += np.sin(value) * cross + (1 - np.cos(value)) * (cross @ cross)
    return pose


@dataclass(frozen=True)
class RangeSearch:
    """Parameters of the search for ranges of motors in which all joints are within limits.

    Attributes:
        grid: Grid points over the range of a motor.
        zooms: Number of refinements of the grid around the worst positions.
        zoomed: Number of positions around which the grid is refined.
        rounding: Excess of a joint over its limit that rounding may cause [rad or m].
        halvings: Bisections of an interval of the grid: down to neighbouring numbers.
    """

    grid: int = 1025
    zooms: int = 2
    zoomed: int = 8
    rounding: float = 1e-12
    halvings: int = 80


SEARCH = RangeSearch()


def motor_ranges(
    joints: Sequence[Joint], actuators: Sequence[Actuator], reference: Array, location: str
) -> tuple[Array, Array]:
    """Return the limits (n,) of the motors that imply those of the joints.

    If joint limits leave several intervals to a motor, the result is the interval that contains the
    reference position, or otherwise the widest.

    Args:
        joints: Movable joints.
        actuators: The motors.
        reference: (n,) positions of the motors.
        location: Name of the robot in messages.

    Raises:
        DescriptionError: A motor has no position at which all of its joints are within limits.
    """
    lower, upper = [], []
    for actuator, position in zip(actuators, reference.tolist(), strict=True):
        followers = _driven_joints(actuator.name, joints)
        interval = _feasible_interval(followers, actuator, position)
        if interval is None:
            names = ", ".join(repr(joint.name) for joint, _ in followers)
            raise DescriptionError(
                f"{location}: actuators.{actuator.name}: limits: no position from "
                f"{actuator.lower:.6g} to {actuator.upper:.6g} keeps its joints ({names}) within "
                "their limits"
            )
        lower.append(interval[0])
        upper.append(interval[1])
    return np.array(lower), np.array(upper)


Follower = tuple["Joint", Callable[[Array], Array]]
"""A joint, and its position as a function of positions (k,) of its motor."""


def _driven_joints(motor: str, joints: Sequence[Joint]) -> list[Follower]:
    """Return the joints that a motor moves; followers may be listed before their leaders."""
    maps: dict[str, Callable[[Array], Array]] = {motor: lambda q: q}
    followers: list[Follower] = []
    remaining = list(joints)
    while remaining:
        ready = [j for j in remaining if (j.coupling.of if j.coupling else j.name) in maps]
        if not ready:
            break
        for joint in ready:
            maps[joint.name] = _position_map(joint, maps)
            followers.append((joint, maps[joint.name]))
            remaining.remove(joint)
    return followers


def _position_map(
    joint: Joint, maps: dict[str, Callable[[Array], Array]]
) -> Callable[[Array], Array]:
    """Return the function from motor positions to positions of a joint.

    Args:
        joint: The joint.
        maps: Functions of the joints or motors that it may follow, by name.
    """
    coupling = joint.coupling
    if coupling is None:
        return maps[joint.name]
    source = maps[coupling.of]
    return lambda q: coupling.joint_position(source(q))


def _feasible_interval(
    driven: list[Follower], actuator: Actuator, reference: float
) -> tuple[float, float] | None:
    """Return the interval of a motor in which its joints are within limits; None if there is none.

    If no joint narrows the range, the result is the range of the motor, bit for bit.
    """
    followers = [
        (joint, position)
        for joint, position in driven
        if joint.coupling or joint.lower > actuator.lower or joint.upper < actuator.upper
    ]
    if not followers:
        return actuator.lower, actuator.upper

    def excess(q: Array) -> Array:
        excesses = [
            np.maximum(joint.lower - position(q), position(q) - joint.upper)
            for joint, position in followers
        ]
        worst: Array = np.max(excesses, axis=0) - SEARCH.rounding
        return worst

    start = min(max(reference, actuator.lower), actuator.upper)
    grid: Array = np.append(np.linspace(actuator.lower, actuator.upper, SEARCH.grid), start)
    grid.sort()
    for _ in range(SEARCH.zooms):
        grid = _refined(grid, excess(grid))
    edges = np.flatnonzero(np.diff(excess(grid) <= 0, prepend=False, append=False)).tolist()
    runs = [(first, last - 1) for first, last in zip(edges[::2], edges[1::2], strict=True)]
    if not runs:
        return None
    q: list[float] = grid.tolist()
    first, last = max(
        runs, key=lambda run: (q[run[0]] <= start <= q[run[1]], q[run[1]] - q[run[0]])
    )
    low = q[0] if first == 0 else _edge(excess, q[first - 1], q[first])
    high = q[-1] if last == len(q) - 1 else _edge(excess, q[last + 1], q[last])
    return (low, high) if low < high else None


def _refined(q: Array, excess: Array) -> Array:
    """Return the grid with additional positions around local extrema of the excess."""
    steps = np.diff(excess)
    extreme = np.flatnonzero(steps[:-1] * steps[1:] <= 0) + 1
    worst = extreme[np.argsort(np.abs(excess[extreme]), kind="stable")[: SEARCH.zoomed]]
    finer = [np.linspace(q[i - 1], q[i + 1], SEARCH.grid) for i in worst.tolist()]
    return np.unique(np.concatenate([q, *finer]))


def _edge(excess: Callable[[Array], Array], infeasible: float, feasible: float) -> float:
    """Return the last feasible position before a limit is exceeded, by bisection."""
    for _ in range(SEARCH.halvings):
        middle = (infeasible + feasible) / 2
        if excess(np.array([middle]))[0] <= 0:
            feasible = middle
        else:
            infeasible = middle
    return feasible
