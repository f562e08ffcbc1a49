"""Palms that are given, with the posture of the hand: what that says of every fingertip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.problem.problems import Problems

DETERMINED = 0.15
"""Contacts that move by less than this when their palm moves by 1 (turned [rad], or shifted by
`LENGTH`) do not say where it is. Those of all shipped hands with three fingers or more move by 0.17
at least."""

ROUNDING = 1e-6
"""A posture may be so far beyond a limit [rad or m]; it is then at the limit."""


def hand_posture(robot: ArmHand, posture: Mapping[str, float], name: str = "posture") -> Array:
    """(n,) positions of all motors that move fingers; NaN for the others.

    Args:
        robot: The robot.
        posture: Position by actuator [rad or m].
        name: What to call it in an error.

    Raises:
        UnknownNameError: No such actuator.
        InputError: One that is missing or moves no finger, or not a number within limits.
    """
    motors = robot.description.finger_motors
    values = np.full(len(robot.actuators), np.nan)
    for key, value in posture.items():
        if key not in motors:
            error = InputError if key in robot.actuators else UnknownNameError
            found = "moves no finger" if key in robot.actuators else "no such actuator"
            raise error(f"{name}.{key}: {found}, expected {', '.join(motors)}")
        i = robot.actuators.index(key)
        low, high = robot.lower[i], robot.upper[i]
        number = isinstance(value, (int, float, np.integer, np.floating))
        if not (number and low - ROUNDING <= value <= high + ROUNDING):
            raise InputError(
                f"{name}.{key}: found {value!r}, expected a number from {low:g} to {high:g}"
            )
        values[i] = min(max(float(value), low), high)
    missing = [key for key in motors if key not in posture]
    if missing:
        raise InputError(f"{name}.{missing[0]}: missing, expected a number for every finger motor")
    return values


def postures_of(robot: ArmHand, postures: Sequence[Mapping[str, float]]) -> Array:
    """(k, n) as `hand_posture` gives them, of many that name the same motors."""
    motors = robot.description.finger_motors
    columns = [robot.actuators.index(name) for name in motors]
    found = np.full((len(postures), len(robot.actuators)), np.nan)
    try:
        given = np.array([[posture[name] for name in motors] for posture in postures], dtype=float)
    except (KeyError, TypeError, ValueError):
        given = np.full((len(postures), len(motors)), np.nan)
    low, high = robot.lower[columns], robot.upper[columns]
    within = np.asarray(((given >= low - ROUNDING) & (given <= high + ROUNDING)).all(axis=1))
    found[:, columns] = np.clip(given, low, high)
    for row, posture in enumerate(postures):
        if not within[row] or len(posture) != len(motors):
            found[row] = hand_posture(robot, posture)  # which says best what is wrong
    return found


def hand_postures(
    robot: ArmHand, postures: Mapping[str, ArrayLike] | ArrayLike, count: int
) -> Array:
    """(k, n) positions of all motors that move fingers; NaN for the others.

    Args:
        robot: The robot.
        postures: Positions (k,), or one for all, by actuator [rad or m]; or configurations (k, n)
            or (n,), of which the motors that move fingers count.
        count: k.

    Raises:
        UnknownNameError: No such actuator.
        InputError: As for `hand_posture`, or another number of positions; the message names the
            row.
    """
    if not isinstance(postures, Mapping):
        every = robot.configuration(postures, "postures")
        motors = [robot.actuators.index(name) for name in robot.description.finger_motors]
        postures = {robot.actuators[i]: every[..., i] for i in motors}
    columns: dict[str, Array] = {}
    for name, value in postures.items():
        try:
            columns[name] = np.broadcast_to(np.asarray(value, dtype=float), (count,))
        except (TypeError, ValueError) as error:
            raise InputError(f"postures.{name}: expected {count} numbers, or one") from error
    return np.array(
        [
            hand_posture(
                robot,
                {name: float(column[row]) for name, column in columns.items()},
                f"postures: row {row}",
            )
            for row in range(count)
        ]
    )


def touched(robot: ArmHand, palms: Array, postures: Array) -> tuple[Array, Array, dict[str, Array]]:
    """Where fingertips are if hands of given postures have their palms at poses.

    Args:
        robot: The robot.
        palms: (k, 4, 4) poses of its palm frame in the base frame.
        postures: (k, n) as `hand_posture` gives them.

    Returns:
        Contact points (k, f, 3) [m] and normals (k, f, 3), base frame; and "tangents" (k, f, 3)
        where points and normals leave the palm free, as those of two opposed fingers do: NaN where
        they do not, no entry if they never do.
    """
    q = np.where(np.isnan(postures), robot.home, postures)
    points, normals = robot.contacts(q)
    here = robot.palm(q)
    turn = palms[:, :3, :3] @ np.swapaxes(here[:, :3, :3], 1, 2)
    back = np.swapaxes(turn, 1, 2)
    points = (points - here[:, None, :3, 3]) @ back + palms[:, None, :3, 3]
    normals = normals @ back
    free = _leave_free(points, normals)
    if not free.any():
        return points, normals, {}
    tangents = robot.contact_frames(q)[..., :3, 1] @ back
    return points, normals, {"tangents": np.where(free[:, None, None], tangents, np.nan)}


def free_palms(robot: ArmHand, problems: Problems) -> NDArray[np.bool_]:
    """(k,) whether a hand that meets its contacts can still move as a whole.

    A line or a plane is taken for the point it goes through.
    """
    if not robot.description.arm_actuators:
        return np.zeros(len(problems), dtype=bool)
    facing = np.concatenate([problems.vectors(name) for name in ("normals", "tangents")], axis=1)
    return _leave_free(problems.points, facing)


def _leave_free(points: Array, facing: Array) -> NDArray[np.bool_]:
    """(k,) whether points (k, f, 3) [m] and directions (k, m, 3) leave the palm free; NaN: none."""
    placed, known = (~np.isnan(vectors[..., :1]) for vectors in (points, facing))
    count = np.maximum(placed.sum(axis=1, keepdims=True), 1)
    off = (points - np.nansum(points, axis=1, keepdims=True) / count) / LENGTH
    f = points.shape[1]
    moved = np.zeros((len(points), 6, f + facing.shape[1], 3))
    for i, axis in enumerate(np.eye(3)):
        moved[:, i, :f] = axis * placed
        moved[:, 3 + i, :f] = np.cross(axis, np.where(placed, off, 0.0))
        moved[:, 3 + i, f:] = np.cross(axis, np.where(known, facing, 0.0))
    values = np.linalg.svd(moved.reshape(len(points), 6, -1), compute_uv=False)
    return np.asarray(values[:, -1] < DETERMINED)


def held_too(postures: Array, fixed: Array | None, actuators: Sequence[str]) -> Array:
    """(k, n) what is held by postures and by the caller.

    Raises:
        InputError: The caller holds a motor of the hand.
    """
    if fixed is None:
        return postures
    both = ~np.isnan(fixed) & ~np.isnan(postures).all(axis=0)
    if both.any():
        name = actuators[int(np.flatnonzero(both)[0])]
        raise InputError(f"fixed.{name}: the grasp's posture holds it already")
    return np.where(np.isnan(postures), fixed, postures)
