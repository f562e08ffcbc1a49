"""URDFs of robots for other solvers: joints that follow linearly, and limits of the motors."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw

FREE = 1.0
"""How far beyond what its motor permits a follower may go [rad or m]: its motor's limits hold it,
and its own, met in the same place, would leave a quadratic program without a solution."""

LINEAR = 1e-9
"""Largest error of a linear coupling [rad or m]."""


class Joints:
    """Our motors and the peers' joints: theta = C q.

    What a coupling adds to a follower is in the URDF, whose follower is zero where its motor is:
    peers that know ratios alone need no more.
    """

    def __init__(self, robot: ik.ArmHand) -> None:
        """Read the couplings off the robot."""
        n = len(robot.actuators)
        zero = np.array(list(robot.joints(np.zeros(n)).values()))
        self.names = list(robot.joints(robot.home))
        unit_positions = [list(robot.joints(row).values()) for row in np.eye(n)]
        self.C = np.stack(unit_positions, axis=1) - zero[:, None]
        self.offsets = zero
        """Return the constant terms of the couplings (k,) [rad or m]."""
        samples = robot.random(np.random.default_rng(0), 8)
        positions = np.stack(list(robot.joints(samples).values()), axis=-1)
        if np.abs(positions - zero - samples @ self.C.T).max() > LINEAR:
            raise SystemExit(f"peers: {robot.name} has a coupling that is not linear")
        rows = [np.flatnonzero(column) for column in self.C.T]
        self.leader = [int(row[0]) for row in rows]
        """A joint that moves as its motor does, for every motor."""
        if not np.array_equal(self.C[self.leader], np.eye(n)):
            raise SystemExit(f"peers: a motor of {robot.name} has no joint that moves as it does")
        self.pairs = [
            (int(row[0]), int(entry), float(self.C[entry, motor]))
            for motor, row in enumerate(rows)
            for entry in row[1:]
        ]
        """Leader, follower and how far this moves as the leader moves by one."""
        ends = np.sort([self.C @ robot.lower, self.C @ robot.upper], axis=0)
        slack = np.full(len(self.names), FREE)
        slack[self.leader] = 0.0
        self.lower, self.upper = ends[0] - slack, ends[1] + slack

    def order(self, names: list[str]) -> NDArray[np.intp]:
        """Return the indices of the joints among those of a peer."""
        return np.array([names.index(name) for name in self.names])


def peer_urdf(robot: ik.ArmHand, joints: Joints) -> str:
    """Return a URDF with motor limits, without mimic joints and without offsets."""
    root = ElementTree.fromstring(robot.urdf())
    places = {name: i for i, name in enumerate(joints.names)}
    described = {joint.name: joint for joint in robot.description.movable}
    for element in root.iter("joint"):
        name = element.get("name", "")
        if name not in places:
            continue
        i = places[name]
        for mimic in element.findall("mimic"):
            element.remove(mimic)
        for limit in element.findall("limit"):
            limit.set("lower", repr(float(joints.lower[i])))
            limit.set("upper", repr(float(joints.upper[i])))
        if joints.offsets[i]:
            joint = described[name]
            pose = joint.placement @ _joint_motion(joint.type, joint.axis, float(joints.offsets[i]))
            for origin in element.findall("origin"):
                origin.set("xyz", _numbers(pose[:3, 3]))
                origin.set("rpy", _numbers(np.asarray(roll_pitch_yaw(pose[:3, :3]))))
    return ElementTree.tostring(root, encoding="unicode")


def _joint_motion(kind: str, axis: Array, by: float) -> Array:
    """(4, 4) motion of a joint."""
    pose = np.eye(4)
    if kind == "prismatic":
        pose[:3, 3] = by * axis
    else:
        K = np.cross(np.eye(3), axis)
        pose[:3, :3] += np.sin(by) * K + (1 - np.cos(by)) * (K @ K)
    return pose


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
