"""A ROS 2 node without a ROS installation: contacts in and joint states out, in cdr over zenoh.

Messages are `geometry_msgs/PoseArray` (a pose per finger, in the order of `robot.fingers`: its
position is the contact, its x axis the outward normal of the pad) and `sensor_msgs/JointState`.
Keys of zenoh are names of topics without the first slash, as zenoh-bridge-ros2dds has them.
"""

# pyright: reportMissingImports=false
from __future__ import annotations

import os
import struct
import sys
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.api import Solver
from casadi_ik.errors import CasadiIKError, InputError, InvalidPoseError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import lost_contacts_reason
from casadi_ik.files.input_checks.poses import unit_quaternions
from casadi_ik.kinematics.arm_hand import load_robot
from casadi_ik.logs.cdr import CdrReader, cdr, cdr_message
from casadi_ik.logs.container import CDR_HEADER
from casadi_ik.solve.status import Status

try:
    import zenoh
except ImportError as error:
    raise MissingExtraError(
        "the ROS 2 node needs eclipse-zenoh, which is not installed: pip install 'casadi-ik[ros2]'"
    ) from error

POSE = 7
"""Numbers of a pose: x y z [m] and a quaternion x y z w."""


def encode_contacts(points: ArrayLike, normals: ArrayLike, frame: str = "base") -> bytes:
    """Points (f, 3) [m] and normals (f, 3) as a PoseArray; NaN marks what is free."""
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    poses = np.empty((len(points), POSE))
    poses[:, :3] = points
    # The half-way rotation that takes x to the normal; opposite to x, half a turn about z.
    x = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    turn = np.column_stack([np.zeros(len(x)), -x[:, 2], x[:, 1], 1 + x[:, 0]])
    turn[x[:, 0] < -1 + 1e-12] = 0, 0, 1, 0
    poses[:, 3:] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    head = cdr((_now(), frame, len(poses)))
    return CDR_HEADER + head + bytes(-len(head) % 8) + poses.astype("<f8").tobytes()


def decode_contacts(data: bytes) -> tuple[Array, Array]:
    """Points (f, 3) [m] and normals (f, 3) of a PoseArray.

    Raises:
        InputError: The bytes are no such message.
        InvalidPoseError: The orientation of a pose is not a unit quaternion.
    """
    try:
        reader = CdrReader(data[len(CDR_HEADER) :])
        reader.place = 8  # the stamp
        reader.text()
        count = reader.number("<I")
        reader.place += -reader.place % 8
        values = np.frombuffer(reader.data, "<f8", count * POSE, reader.place)
    except (struct.error, ValueError) as error:
        raise InputError(f"contacts: no geometry_msgs/PoseArray in cdr: {error}") from error
    poses = values.reshape(count, POSE)
    unit, invalid = unit_quaternions(poses[:, 3:])
    wrong = invalid & np.isfinite(poses[:, 3:]).all(axis=1)  # NaN marks a free normal
    if wrong.any():
        i = int(np.argmax(wrong))
        raise InvalidPoseError(
            f"contacts: poses[{i}].orientation: found {poses[i, 3:].tolist()}; expected a "
            "quaternion of length 1"
        )
    x, y, z, w = unit.T
    normals = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
    return poses[:, :3].copy(), np.column_stack(normals)


class ContactNode:
    """Answers each PoseArray with a JointState of the motors, in microseconds.

    Where contacts cannot be met, or a message is malformed, nothing is sent: the last command
    holds.

    Attributes:
        status: Of the last target.
        refused: Why the last malformed message was refused, or "".

    Example:
        >>> with ContactNode(ik.Solver(robot)) as node:
        ...     node.wait()  # until Ctrl-C
    """

    def __init__(
        self,
        solver: Solver,
        contacts: str = "contacts",
        joints: str = "joint_commands",
        q0: ArrayLike | None = None,
        config: Any = None,
    ) -> None:
        """Open a session of zenoh and subscribe.

        Args:
            solver: Of the robot; without a scene.
            contacts: Key of what is asked.
            joints: Key of the answers.
            q0: (n,) where the robot is [rad or m]; answers stay near the last one. None: at home.
            config: Of zenoh; None: what the environment's ZENOH_CONFIG says, else the default.
        """
        self.status, self.refused = Status.SOLVED, ""
        self._fast, self._names = solver.fast(), list(solver.robot.actuators)
        self._q = solver.robot.configuration(q0, "q0")
        self._none = np.empty(0)
        self._session = zenoh.open(_config() if config is None else config)
        self._out = self._session.declare_publisher(joints)
        self._in = self._session.declare_subscriber(contacts, self._answer)

    def _answer(self, sample: Any) -> None:
        try:
            points, normals = decode_contacts(bytes(sample.payload))
            self.refused = lost_contacts_reason(points)
            if self.refused:
                return
            q, self.status = self._fast(points, normals, self._q)
        except CasadiIKError as error:
            self.refused = str(error)
            return
        self.refused = ""
        if self.status is Status.SOLVED:
            self._q = q.copy()
            self._out.put(cdr_message(_now(), "", self._names, self._q, self._none, self._none))

    def wait(self) -> None:
        """Answer until the process is interrupted."""
        threading.Event().wait()

    def __enter__(self) -> ContactNode:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


def _config() -> Any:
    return zenoh.Config.from_env() if "ZENOH_CONFIG" in os.environ else zenoh.Config()


def _now() -> tuple[int, int]:
    return divmod(time.time_ns(), 1_000_000_000)


if __name__ == "__main__":  # python -m casadi_ik.integrations.ros2 ROBOT
    with ContactNode(Solver(load_robot(sys.argv[1]))) as node:
        node.wait()
