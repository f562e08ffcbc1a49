"""Postures that a robot's hand can take, nearest to those that data have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array, Bools
from casadi_ik.datasets.hands import palms_of
from casadi_ik.errors import DescriptionError
from casadi_ik.problem.hand_motors import finger_joints, hand_motors
from casadi_ik.robots.description import RobotDescription

BEYOND = 0.02
"""A joint may be so far beyond its limits [rad or m]; it is then at the limit."""

APART = 0.02
"""How far a joint may be from where its coupling puts it [rad or m]."""

STEPS = 40
"""Of the search for the nearest posture, at most."""

SMALL = 1e-7
"""A motor moves so far for a derivative [rad or m]."""

STAY = 1e-6
"""Squared metres at a fingertip that a radian of a motor counts as: what decides between postures
whose fingertips are as near."""

SETTLED = 1e-6
"""Steps are over when no motor moves farther [rad or m]."""


@dataclass(frozen=True, eq=False)
class HandPostures:
    """Postures of a hand that its motors can take.

    Attributes:
        motors: That move fingers.
        positions: (k, m) of these, within their limits [rad or m].
        beyond: By row what is beyond its limits in the data.
        shift: (k,) how far the fingertip that is moved farthest is from where the data have it [m].
        joints: Positions (k,) of all joints as the data have them, what they do not say as it
            follows [rad or m].
    """

    motors: tuple[str, ...]
    positions: Array
    beyond: Mapping[int, str]
    shift: Array
    joints: Mapping[str, Array]


def hand_postures(robot: ArmHand, where: str, joints: Mapping[str, Array]) -> HandPostures:
    """The nearest postures that a hand can take.

    What is beyond its limits is put there. Where a joint is not where its coupling has it, the
    motors of its finger are those that bring the fingertip nearest to where the data have it, in
    the frame of the palm.

    Args:
        robot: The robot.
        where: File, for messages.
        joints: Positions (k,) by joint or motor.

    Raises:
        DescriptionError: A motor is not among the joints, nor follows from them.
    """
    described = robot.description
    motors = hand_motors(described)
    moved = _motors_of(described, joints)
    for name in motors:
        if name not in moved:
            raise DescriptionError(f"{where}: {name}: missing, expected a position")
    columns = [robot.actuators.index(name) for name in motors]
    given = np.stack([moved[name] for name in motors], axis=1)
    found = np.clip(given, robot.lower[columns], robot.upper[columns])
    said = {name: joints[name] for name in finger_joints(described) if name in joints}
    whole = joints_at(robot, motors, found) | said
    wanted = _tips_of_joints(robot, whole)
    free = _free(robot, columns, said, joints_at(robot, motors, given))
    rows = np.flatnonzero(free.any(axis=1))
    if len(rows):
        found[rows] = _nearest(robot, columns, found[rows], free[rows], wanted[rows])
    shift = np.linalg.norm(_tips(robot, columns, found) - wanted, axis=2).max(axis=1)
    return HandPostures(motors, found, _beyond(robot, motors, given, said), shift, whole)


def joints_at(robot: ArmHand, motors: tuple[str, ...], positions: Array) -> dict[str, Array]:
    """Positions (k,) of all joints with motors at (k, m), the others where they are at home."""
    return robot.joints(
        _configurations(robot, [robot.actuators.index(n) for n in motors], positions)
    )


def _configurations(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    q = np.tile(robot.home, (len(positions), 1))
    q[:, columns] = positions
    return q


def _motors_of(robot: RobotDescription, joints: Mapping[str, Array]) -> dict[str, Array]:
    """The joints, and the motors whose joints are given alone: by the first that follows them."""
    found = dict(joints)
    for joint in robot.movable:
        slope = joint.coupling.slope if joint.coupling is not None else None
        if joint.coupling is None or slope is None or joint.name not in joints:
            continue
        if joint.coupling.of in robot.actuator_names:
            found.setdefault(joint.coupling.of, (joints[joint.name] - slope[1]) / slope[0])
    return found


def _beyond(
    robot: ArmHand, motors: tuple[str, ...], given: Array, said: Mapping[str, Array]
) -> dict[int, str]:
    """By row the joint or motor that is farthest beyond its limits."""
    described = robot.description
    places = [described.joint_names.index(name) for name in said if name not in motors]
    columns = [robot.actuators.index(name) for name in motors]
    names = (*motors, *(described.joint_names[i] for i in places))
    lower = np.concatenate([robot.lower[columns], described.joint_lower[places]])
    upper = np.concatenate([robot.upper[columns], described.joint_upper[places]])
    values = np.column_stack([given, *(said[described.joint_names[i]] for i in places)])
    excess = np.maximum(lower - values, values - upper)
    worst = excess.argmax(axis=1)
    return {
        int(
            row
        ): f"{names[i]}: found {values[row, i]:.4g}, expected {lower[i]:.4g} to {upper[i]:.4g}"
        for row, i in enumerate(worst)
        if excess[row, i] > BEYOND
    }


def _free(
    robot: ArmHand, columns: list[int], said: Mapping[str, Array], reached: Mapping[str, Array]
) -> Bools:
    """(k, m) motors of the fingers whose joints are not where their couplings have them."""
    described = robot.description
    free = np.zeros((len(next(iter(reached.values()))), len(columns)), dtype=bool)
    for finger in described.fingers:
        mine = np.isin(columns, described.finger_actuators(finger.name))
        for name in finger.joints:
            if name in said:
                free |= (np.abs(said[name] - reached[name]) > APART)[:, None] & mine
    return free


def _tips_of_joints(robot: ArmHand, joints: Mapping[str, Array]) -> Array:
    """(k, f, 3) fingertips in the palm frame, of joints whatever couples them."""
    described = robot.description
    here = np.tile(np.eye(4), (len(next(iter(joints.values()))), 1, 1))
    palms, points, _ = palms_of(robot, described.palm_link, here, joints)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _tips(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    """(k, f, 3) fingertips in the palm frame, with motors at (k, m)."""
    q = _configurations(robot, columns, positions)
    points, palms = robot.contacts(q)[0], robot.palm(q)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _nearest(robot: ArmHand, columns: list[int], start: Array, free: Bools, wanted: Array) -> Array:
    """Postures (k, m) within limits whose fingertips are nearest to where they are wanted.

    Damped steps (Levenberg-Marquardt), by row; a motor at its limit that would go beyond is held.

    Args:
        robot: The robot.
        columns: Of the motors.
        start: (k, m) where to begin, and what to stay near where fingertips are as near.
        free: (k, m) motors that may move.
        wanted: (k, f, 3) fingertips in the palm frame [m].
    """
    lower, upper = robot.lower[columns], robot.upper[columns]
    count, m = start.shape

    def off(x: Array) -> Array:
        return (wanted - _tips(robot, columns, x)).reshape(count, -1)

    def cost(x: Array, miss: Array) -> Array:
        return (miss**2).sum(axis=1) + STAY * ((x - start) ** 2).sum(axis=1)

    x, miss = start.copy(), off(start)
    least, damping = cost(x, miss), np.full(count, 1e-4)
    for _ in range(STEPS):
        slopes = [miss - off(x + SMALL * one) for one in np.eye(m)]
        jacobian = np.stack(slopes, axis=2) / SMALL
        pull = np.einsum("krm,kr->km", jacobian, miss) - STAY * (x - start)
        held = ~free | ((x <= lower) & (pull < 0)) | ((x >= upper) & (pull > 0))
        jacobian = np.where(held[:, None], 0.0, jacobian)
        square = np.swapaxes(jacobian, 1, 2) @ jacobian + (damping + STAY)[:, None, None] * np.eye(
            m
        )
        step = np.linalg.solve(square, np.where(held, 0.0, pull)[..., None])[..., 0]
        tried = np.clip(np.asarray(x + step, dtype=np.float64), lower, upper)
        new = off(tried)
        value = cost(tried, new)
        better = value < least
        moved = np.abs(tried - x).max(axis=1)
        x, miss = np.where(better[:, None], tried, x), np.where(better[:, None], new, miss)
        least = np.where(better, value, least)
        damping = np.where(better, damping / 10, damping * 10)
        if (moved < SETTLED).all():
            break
    return x
