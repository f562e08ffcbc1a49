"""Closed chain of the arm and the reversed thumb (Qiu & Kermani 2021, section II-C).

The tip of the thumb rests on its contact; a virtual revolute joint about the contact normal lets it
rotate. Relative to the tip, the palm is the platform of a parallel mechanism with two legs: the
reversed thumb (virtual joint, motors of the thumb from tip to palm, and some of the last motors of
the arm) and the other motors of the arm. Both move the same platform, so their twists are equal,
eq. (6). The coordinates of the reversed leg are the negative motor positions, because the leg is
traversed from tip to palm.

A chain with k coordinates and the constraint C qdot = 0 of eq. (6) has k - rank(C) degrees of
freedom. Any choice of as many active coordinates is valid if the columns H_p of the passive ones
are regular; good choices depend on the configuration (`pivoted`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import ActuatedKinematics
from casadi_ik.kinematics.linear_algebra import solve
from casadi_ik.model.description import RobotDescription

VIRTUAL = -1
"""Index of the virtual joint among the indices of actuators in q."""


@dataclass(frozen=True)
class ChainSplit:
    """Active and passive coordinates of the closed chain, by index of the actuator in q.

    Attributes:
        reversed_leg: `VIRTUAL`, actuators of the thumb from tip to palm, and borrowed arm actuators
            from palm to base.
        arm_leg: Other actuators of the arm from base to tip.
        active: Commanded coordinates, as many as the mobility.
        passive: The six dependent coordinates.
    """

    reversed_leg: tuple[int, ...]
    arm_leg: tuple[int, ...]
    active: tuple[int, ...]
    passive: tuple[int, ...]

    @property
    def columns(self) -> tuple[int, ...]:
        """Coordinates of the reversed leg, followed by those of the arm leg."""
        return self.reversed_leg + self.arm_leg


def split(robot: RobotDescription, borrowed: int = 1) -> ChainSplit:
    """Return the paper's choice of legs and active joints for any arm and thumb.

    The mobility is the number of coordinates minus six (Gruebler). Active joints are the virtual
    joint, those of the thumb except the first, and the last joints of the arm up to the mobility;
    for the KUKA-Barrett: virtual, thumb 2, arm 7, arm 6.

    Args:
        robot: Description of the robot.
        borrowed: Number of the arm's last joints in the reversed leg (the paper: 1).

    Raises:
        UnsupportedError: The arm has fewer than six joints, or not more than `borrowed`.
    """
    arm = robot.arm_actuators
    thumb = robot.finger_actuators(robot.thumb)
    mobility = 1 + len(thumb) + len(arm) - 6
    if mobility < 1 or len(arm) < 6:
        raise UnsupportedError(
            f"robot {robot.name!r}: found {len(arm)} arm joints and {len(thumb)} thumb joints with "
            f"mobility {mobility}; expected at least 6 arm joints and mobility 1"
        )
    if not 0 <= borrowed < len(arm):
        raise UnsupportedError(
            f"robot {robot.name!r}: borrowed: found {borrowed}, expected 0 to {len(arm) - 1}"
        )
    reversed_leg = (VIRTUAL, *reversed(thumb), *reversed(arm[len(arm) - borrowed :]))
    preference = (VIRTUAL, *reversed(thumb[1:]), *reversed(arm))
    active = preference[:mobility]
    columns = reversed_leg + arm[: len(arm) - borrowed]
    passive = tuple(column for column in columns if column not in active)
    return ChainSplit(reversed_leg, arm[: len(arm) - borrowed], active, passive)


@dataclass(frozen=True, eq=False)
class ClosedChain:
    """Graphs of the chain at one configuration; twists are [v; w] in the palm frame.

    Attributes:
        split: Legs and active coordinates.
        constraint: (6, k) matrix [J_r, -J_arm] of eq. (6) over `split.columns`.
        H_p: (6, 6) columns of the passive coordinates, eq. (7).
        H: (6, mobility) passive over active coordinates, -H_p^-1 H_a of eq. (7).
        J_cc: (6, mobility) twist of the platform per active coordinate, eq. (8): the arm leg's
            columns times the rows of H (or unit rows) of the arm leg.
    """

    split: ChainSplit
    constraint: ca.SX
    H_p: ca.SX
    H: ca.SX
    J_cc: ca.SX

    def motor_steps(self, active_step: ca.SX, n: int) -> ca.SX:
        """Return the change of every motor for a step of the active coordinates.

        Args:
            active_step: (mobility, 1) step of the active coordinates.
            n: Number of actuators of the robot.

        Returns:
            (n, 1) change of q, with inverted signs for the reversed leg and without the virtual
            joint.
        """
        passive_step = self.H @ active_step
        step = ca.SX.zeros(n, 1)
        for names, values in ((self.split.active, active_step), (self.split.passive, passive_step)):
            for i, column in enumerate(names):
                if column != VIRTUAL:
                    sign = -1 if column in self.split.reversed_leg else 1
                    step[column] = sign * values[i]
        return step


def closed_chain(
    robot_kinematics: ActuatedKinematics,
    chain: ChainSplit,
    length: float = 1.0,
    platform: str = "arm-leg",
) -> ClosedChain:
    """Return the graphs of eqs. (6) to (8) at the symbolic configuration.

    Args:
        robot_kinematics: Kinematics over q.
        chain: Legs and active coordinates.
        length: Unit of the linear rows [m]; 1e-3 gives millimetres, as in the paper.
        platform: "arm-leg": eq. (8) as printed, the twist of the last link of the arm leg;
            "palm": the twist of the palm, which includes the borrowed arm joints.
    """
    robot = robot_kinematics.robot
    columns = {index: _column(robot_kinematics, index, length) for index in chain.columns}
    constraint = ca.horzcat(
        *(columns[index] for index in chain.reversed_leg),
        *(-columns[index] for index in chain.arm_leg),
    )
    position = {index: i for i, index in enumerate(chain.columns)}
    H_a = constraint[:, [position[index] for index in chain.active]]
    H_p = constraint[:, [position[index] for index in chain.passive]]
    H = -solve(ca.densify(H_p), ca.densify(H_a))
    carriers: Sequence[int] = robot.arm_actuators if platform == "palm" else chain.arm_leg
    rows, twists = [], []
    for index in carriers:
        if index in chain.passive:
            row = H[chain.passive.index(index), :]
        else:
            row = ca.SX(ca.DM.eye(len(chain.active))[chain.active.index(index), :])
        rows.append(-row if index in chain.reversed_leg else row)
        twists.append(columns[index])
    J_cc = ca.densify(ca.horzcat(*twists) @ ca.vertcat(*rows))
    return ClosedChain(chain, constraint, H_p, H, J_cc)


def _column(robot_kinematics: ActuatedKinematics, index: int, length: float) -> ca.SX:
    """Return the twist [v; w] of the palm, in the palm frame, for a unit rate of a coordinate.

    Coordinates of the reversed leg have inverted signs, and so has the motion of the palm relative
    to the tip; the column (6, 1) is therefore the same.
    """
    kinematics = robot_kinematics.kinematics
    robot = robot_kinematics.robot
    palm = kinematics.palm
    if index == VIRTUAL:
        point, normal = kinematics.contact(robot.thumb)
        linear, angular = ca.cross(normal, palm.origin - point), normal
    else:
        # The column of a thumb motor is the twist of the fingertip link at the palm origin.
        link = robot.palm_link if index in robot.arm_actuators else robot.finger(robot.thumb).link
        linear, angular = robot_kinematics.twist(link, palm.origin, [index])
    rotation = palm.rotation
    return ca.densify(ca.vertcat(rotation.T @ linear / length, rotation.T @ angular))


def pivoted(constraint: Array) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the active and passive coordinates at one configuration.

    QR with column pivoting (Businger & Golub 1965) selects the most independent columns as passive.
    A column counts as dependent if its norm has decreased to 1e-9 of the largest norm.

    Args:
        constraint: C (r, k) with rows scaled so that lengths and angles are comparable.

    Returns:
        Indices of the active columns, as many as the mobility, and of the passive columns, as many
        as the rank; both in ascending order.
    """
    residual = np.array(constraint, dtype=float)
    k = residual.shape[1]
    floor = 1e-9 * np.linalg.norm(residual, axis=0).max(initial=0.0)
    passive: list[int] = []
    for _ in range(min(residual.shape)):
        lengths = np.linalg.norm(residual, axis=0)
        best = int(lengths.argmax())
        if lengths[best] <= floor:
            break
        passive.append(best)
        direction = residual[:, best] / lengths[best]
        residual -= np.outer(direction, direction @ residual)
        residual[:, best] = 0.0
    active = tuple(i for i in range(k) if i not in passive)
    return active, tuple(sorted(passive))


def mobility(constraint: Array) -> int:
    """Return the mobility of a chain: its number of coordinates minus the rank of C."""
    return len(pivoted(constraint)[0])
