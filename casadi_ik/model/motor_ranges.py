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
    """How the ranges of motors are found that keep all joints within limits.

    Attributes:
        grid: Positions of a motor's range that are looked at first.
        zooms: How often the surroundings of the worst positions are looked at once more, as finely.
        zoomed: Positions about which the grid is made finer.
        rounding: By how much a joint may be beyond a limit [rad or m] by the arithmetic of its
            coupling.
        halvings: Bisections of an interval of the grid: down to neighbouring numbers.
    """

    grid: int = 1025
    zooms: int = 2
    zoomed: int = 8
    rounding: float = 1e-12
    halvings: int = 80


SEARCH = RangeSearch()


def motor_ranges(
    joints: Sequence[Joint], actuators: Sequence[Actuator], near: Array, where: str
) -> tuple[Array, Array]:
    """Limits (n,) of the motors that imply those of the joints.

    Where a joint's limits leave a motor several intervals, it keeps the one that holds `near`, or
    else the widest.

    Args:
        joints: The joints that move.
        actuators: The motors.
        near: (n,) positions of the motors.
        where: What to call the robot in an error.

    Raises:
        DescriptionError: A motor has no position at which its joints keep their limits.
    """
    lower, upper = [], []
    for actuator, position in zip(actuators, near.tolist(), strict=True):
        moved = _moved(actuator.name, joints)
        ends = _narrowed(moved, actuator, position)
        if ends is None:
            names = ", ".join(repr(joint.name) for joint, _ in moved)
            raise DescriptionError(
                f"{where}: actuators.{actuator.name}: limits: nowhere from {actuator.lower:.6g} to "
                f"{actuator.upper:.6g} are all of its joints ({names}) within their own limits"
            )
        lower.append(ends[0])
        upper.append(ends[1])
    return np.array(lower), np.array(upper)


Follower = tuple["Joint", Callable[[Array], Array]]
"""A joint, and its position for positions (k,) of its motor."""


def _moved(motor: str, joints: Sequence[Joint]) -> list[Follower]:
    """The joints a motor moves; followers may stand before what they follow."""
    found: dict[str, Callable[[Array], Array]] = {motor: lambda q: q}
    moved: list[Follower] = []
    waiting = list(joints)
    while waiting:
        ready = [j for j in waiting if (j.coupling.of if j.coupling else j.name) in found]
        if not ready:
            break
        for joint in ready:
            found[joint.name] = _after(joint, found)
            moved.append((joint, found[joint.name]))
            waiting.remove(joint)
    return moved


def _after(joint: Joint, found: dict[str, Callable[[Array], Array]]) -> Callable[[Array], Array]:
    coupling = joint.coupling
    if coupling is None:
        return found[joint.name]
    source = found[coupling.of]
    return lambda q: coupling.followed(source(q))


def _narrowed(moved: list[Follower], actuator: Actuator, near: float) -> tuple[float, float] | None:
    """The interval of a motor's range in which its joints keep their limits; None: there is none.

    Where nothing is beyond a limit, the motor's own range to the last digit.
    """
    followers = [
        (joint, position)
        for joint, position in moved
        if joint.coupling or joint.lower > actuator.lower or joint.upper < actuator.upper
    ]
    if not followers:
        return actuator.lower, actuator.upper

    def excess(q: Array) -> Array:
        beyond = [
            np.maximum(joint.lower - position(q), position(q) - joint.upper)
            for joint, position in followers
        ]
        worst: Array = np.max(beyond, axis=0) - SEARCH.rounding
        return worst

    inside = min(max(near, actuator.lower), actuator.upper)
    grid: Array = np.append(np.linspace(actuator.lower, actuator.upper, SEARCH.grid), inside)
    grid.sort()
    for _ in range(SEARCH.zooms):
        grid = _finer(grid, excess(grid))
    edges = np.flatnonzero(np.diff(excess(grid) <= 0, prepend=False, append=False)).tolist()
    runs = [(first, last - 1) for first, last in zip(edges[::2], edges[1::2], strict=True)]
    if not runs:
        return None
    q: list[float] = grid.tolist()
    first, last = max(
        runs, key=lambda run: (q[run[0]] <= inside <= q[run[1]], q[run[1]] - q[run[0]])
    )
    low = q[0] if first == 0 else _edge(excess, q[first - 1], q[first])
    high = q[-1] if last == len(q) - 1 else _edge(excess, q[last + 1], q[last])
    return (low, high) if low < high else None


def _finer(q: Array, excess: Array) -> Array:
    """The grid with more positions about the local extremes of the excess."""
    before, here, after = excess[:-2], excess[1:-1], excess[2:]
    extreme = np.flatnonzero((here - before) * (after - here) <= 0) + 1
    worst = extreme[np.argsort(np.abs(excess[extreme]), kind="stable")[: SEARCH.zoomed]]
    more = [np.linspace(q[i - 1], q[i + 1], SEARCH.grid) for i in worst.tolist()]
    return np.unique(np.concatenate([q, *more]))


def _edge(excess: Callable[[Array], Array], outside: float, inside: float) -> float:
    """The last position inside, by bisection."""
    for _ in range(SEARCH.halvings):
        middle = (outside + inside) / 2
        if excess(np.array([middle]))[0] <= 0:
            inside = middle
        else:
            outside = middle
    return inside
