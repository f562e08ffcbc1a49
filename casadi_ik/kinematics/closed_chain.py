"""The arm and the reversed thumb as one closed chain (Qiu & Kermani 2021, section II-C).

The thumb's tip rests on its contact; a virtual revolute joint about the contact normal lets it
turn there. Seen from the tip, the palm is the platform of a parallel mechanism: one leg is the
reversed thumb (virtual joint, the thumb's motors from tip to palm, and some of the arm's last
motors), the other leg the rest of the arm. Both move the same platform, so their twists agree,
eq. (6). The coordinates of the reversed leg are the negative of the motors' own, because it is
read from tip to palm.

A chain with k coordinates and the constraint C qdot = 0 of eq. (6) moves in k - rank(C) ways. Any
choice of that many active coordinates commands it as long as the columns of the passive ones, H_p,
are regular; which choice is good depends on the configuration (`pivoted`).
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
        reversed_leg: `VIRTUAL`, the thumb's actuators from tip to palm, the borrowed arm
            actuators from palm to base.
        arm_leg: The arm's other actuators from the base on.
        active: The coordinates that are commanded, as many as the mobility.
        passive: The six that follow.
    """

    reversed_leg: tuple[int, ...]
    arm_leg: tuple[int, ...]
    active: tuple[int, ...]
    passive: tuple[int, ...]

    @property
    def columns(self) -> tuple[int, ...]:
        """All coordinates, the reversed leg first."""
        return self.reversed_leg + self.arm_leg


def split(robot: RobotDescription, borrowed: int = 1) -> ChainSplit:
    """Return the paper's choice of legs and active joints, for any arm and thumb.

    The mobility is the number of coordinates less six (Gruebler). Active are the virtual joint,
    the thumb's joints but the first, and as many of the arm's last joints as are missing; for the
    KUKA-Barrett: virtual, thumb 2, arm 7, arm 6.

    Args:
        robot: The description.
        borrowed: How many of the arm's last joints count to the reversed leg (the paper: 1).

    Raises:
        UnsupportedError: The arm has fewer than six joints, or fewer than are to be borrowed.
    """
    arm = robot.arm_actuators
    thumb = robot.finger_actuators(robot.thumb)
    mobility = 1 + len(thumb) + len(arm) - 6
    if mobility < 1 or len(arm) < 6:
        raise UnsupportedError(
            f"robot {robot.name!r}: the closed chain of arm ({len(arm)}), thumb ({len(thumb)}) and "
            f"virtual joint has mobility {mobility}; it needs an arm of at least six joints"
        )
    if not 0 <= borrowed < len(arm):
        raise UnsupportedError(
            f"robot {robot.name!r}: the reversed thumb cannot borrow {borrowed} arm joints; "
            f"the arm has {len(arm)} and has to keep one"
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
            columns times the rows of H (or unit rows) that belong to the arm leg.
    """

    split: ChainSplit
    constraint: ca.SX
    H_p: ca.SX
    H: ca.SX
    J_cc: ca.SX

    def motor_steps(self, active_step: ca.SX, n: int) -> ca.SX:
        """Return the change of every motor for a step of the active coordinates.

        Args:
            active_step: (mobility, 1).
            n: Number of actuators of the robot.

        Returns:
            (n, 1) change of q: the reversed leg with its sign turned, the virtual joint left out.
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
        platform: "arm-leg": eq. (8) as printed, the twist of the link that the arm leg ends at;
            "palm": the palm's own, with the borrowed arm joints added.
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
    """Return twist [v; w] of the palm, in the palm frame, for a unit rate of one coordinate (6, 1).

    In the reversed leg the palm moves against the tip as the tip moves against the palm in the
    motor's own sense, so the same column serves both.
    """
    kinematics = robot_kinematics.kinematics
    robot = robot_kinematics.robot
    palm = kinematics.palm
    if index == VIRTUAL:
        point, normal = kinematics.contact(robot.thumb)
        linear, angular = ca.cross(normal, palm.origin - point), normal
    else:
        # The column of a thumb motor is the twist of a body at the palm's place, not the palm's.
        link = robot.palm_link if index in robot.arm_actuators else robot.finger(robot.thumb).link
        linear, angular = robot_kinematics.twist(link, palm.origin, [index])
    rotation = palm.rotation
    return ca.densify(ca.vertcat(rotation.T @ linear / length, rotation.T @ angular))


def pivoted(constraint: Array) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the active and passive coordinates at one configuration.

    QR with column pivoting (Businger & Golub 1965) takes as passive the columns that are farthest
    from one another; one counts as dependent if less than 1e-9 of the largest is left of it.

    Args:
        constraint: C (r, k); rows should be scaled so that lengths and angles compare.

    Returns:
        Positions of the active columns, as many as the mobility, and of the passive ones, as many
        as the rank; both in rising order.
    """
    left = np.array(constraint, dtype=float)
    k = left.shape[1]
    floor = 1e-9 * np.linalg.norm(left, axis=0).max(initial=0.0)
    passive: list[int] = []
    for _ in range(min(left.shape)):
        lengths = np.linalg.norm(left, axis=0)
        best = int(lengths.argmax())
        if lengths[best] <= floor:
            break
        passive.append(best)
        direction = left[:, best] / lengths[best]
        left -= np.outer(direction, direction @ left)
        left[:, best] = 0.0
    active = tuple(i for i in range(k) if i not in passive)
    return active, tuple(sorted(passive))


def mobility(constraint: Array) -> int:
    """Return the mobility of a chain: its number of coordinates minus the rank of C."""
    return len(pivoted(constraint)[0])
