"""Joints and motors of a robot as frozen data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        coupling: Coupling to an actuator or another joint; None if the joint is its own actuator.
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
