"""A position to start from, away from limits and from where the arm is singular."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.posture import moved
from casadi_ik.robots.description import Joint, RobotDescription

SAMPLES = 300
"""Postures of the arm that are compared, if it has no more joints than `USUAL`."""

USUAL = 12
"""Joints of an arm."""

TURN = np.pi / 2
"""A joint is not turned further than this from the middle of its range, however wide it is."""

STEP = 1e-6
"""Of the differences that a Jacobian is made of [rad or m]."""


def guess_home(robot: RobotDescription) -> Array:
    """(n,) the hand half closed, the arm well within its limits and able to move every way."""
    middle = (robot.lower + robot.upper) / 2
    arm = list(robot.arm_actuators)
    if not arm:
        return _round(middle, robot)
    chain = robot.chain(robot.palm_link)
    rng = np.random.default_rng(0)
    half = np.minimum((robot.upper - robot.lower)[arm] / 4, TURN)
    best, found = -1.0, middle
    # What a posture takes grows with the square of the joints.
    for i in range(max(1, int(SAMPLES * min(1.0, (USUAL / len(arm)) ** 2)))):
        q = middle.copy()
        if i:
            q[arm] += half * rng.uniform(-1, 1, len(arm))
        value = _freedom(robot, chain, q, arm)
        if value > best:
            best, found = value, q
    return _round(found, robot)


def _freedom(robot: RobotDescription, chain: tuple[Joint, ...], q: Array, arm: list[int]) -> float:
    """The least that the palm moves for a motion of the arm's motors, a metre as a radian."""
    pose = _palm(robot, chain, q)
    columns = []
    for i in arm:
        other = q.copy()
        other[i] += STEP
        change = (_palm(robot, chain, other) - pose) @ np.linalg.inv(pose) / STEP
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(values[: min(6, len(arm))].min())


def _palm(robot: RobotDescription, chain: tuple[Joint, ...], q: Array) -> Array:
    values = {name: q[i : i + 1] for i, name in enumerate(robot.actuator_names)}
    joints = {joint.name: joint for joint in robot.movable}

    def value(name: str) -> Array:
        coupling = None if name not in joints else joints[name].coupling
        if coupling is None:
            return values[name]
        return coupling.followed(value(coupling.of))

    pose = np.eye(4)
    for joint in chain:
        angle = 0.0 if joint.type == "fixed" else float(value(joint.name)[0])
        pose = pose @ joint.placement @ moved(joint, angle)
    return pose


def _round(q: Array, robot: RobotDescription) -> Array:
    """Two digits where they are within the limits."""
    short = np.where(robot.upper - robot.lower > 0.5, np.round(q, 2), np.round(q, 4))
    inside = (short > robot.lower) & (short < robot.upper)
    return np.where(inside, short, q)
