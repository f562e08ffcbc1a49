"""Ranges of motors that follow from the limits of the joints behind their couplings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.model.joints import Actuator, Joint


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
