"""ROS 2 node without a ROS installation: contacts in, joint states out, in CDR over zenoh.

Messages are `geometry_msgs/PoseArray` (a pose per finger in the order of `robot.fingers`; the
position is the contact point, the x axis the outward normal of the pad) and
`sensor_msgs/JointState`. Zenoh keys are topic names without the leading slash, as in
zenoh-bridge-ros2dds.
"""

# pyright: reportMissingImports=false
from __future__ import annotations

import argparse
import os
import struct
import sys
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.api import Solver
from casadi_ik.errors import CasadiIKError, InputError, InvalidPoseError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import unit_quaternions
from casadi_ik.files.keypoints import lost_contacts_reason
from casadi_ik.kinematics.arm_hand import load_robot
from casadi_ik.logs.cdr import CdrReader, cdr, cdr_message
from casadi_ik.logs.chunks import CDR_HEADER
from casadi_ik.solve.status import Status

with optional_import("integrations.ros2"):
    import zenoh

POSE_SIZE = 7
"""Numbers of a pose: x y z [m] and a quaternion x y z w."""


def encode_contacts(points: ArrayLike, normals: ArrayLike, frame: str = "base") -> bytes:
    """Encode points (f, 3) [m] and normals (f, 3) as a PoseArray; NaN marks free components."""
    points, normals = np.asarray(points, dtype=float), np.asarray(normals, dtype=float)
    poses = np.empty((len(points), POSE_SIZE))
    poses[:, :3] = points
    # Shortest rotation from x to the normal; for -x, a rotation by pi about z.
    x = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    quaternions = np.column_stack([np.zeros(len(x)), -x[:, 2], x[:, 1], 1 + x[:, 0]])
    quaternions[x[:, 0] < -1 + 1e-12] = 0, 0, 1, 0
    poses[:, 3:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    header = cdr((_time_stamp(), frame, len(poses)))
    return CDR_HEADER + header + bytes(-len(header) % 8) + poses.astype("<f8").tobytes()


def decode_contacts(data: bytes) -> tuple[Array, Array]:
    """Decode points (f, 3) [m] and normals (f, 3) from a PoseArray.

    Raises:
        InputError: The bytes are not a PoseArray.
        InvalidPoseError: The orientation of a pose is not a unit quaternion.
    """
    try:
        reader = CdrReader(data[len(CDR_HEADER) :])
        reader.position = 8  # the stamp
        reader.text()
        count = reader.number("<I")
        reader.position += -reader.position % 8
        values = np.frombuffer(reader.data, "<f8", count * POSE_SIZE, reader.position)
    except (struct.error, ValueError) as error:
        raise InputError(
            f"contacts: message is not a geometry_msgs/PoseArray in CDR: {error}"
        ) from error
    poses = values.reshape(count, POSE_SIZE)
    unit, invalid = unit_quaternions(poses[:, 3:])
    malformed = invalid & np.isfinite(poses[:, 3:]).all(axis=1)  # NaN marks a free normal
    if malformed.any():
        i = int(np.argmax(malformed))
        raise InvalidPoseError(
            f"contacts: poses[{i}].orientation: found {poses[i, 3:].tolist()}; expected a "
            "quaternion of length 1"
        )
    x, y, z, w = unit.T
    normals = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
    return poses[:, :3].copy(), np.column_stack(normals)


class ContactNode:
    """Node that replies to each PoseArray with a JointState of the motors, in microseconds.

    If the contacts are out of reach or a message is malformed, nothing is published, so the last
    command stays valid.

    Attributes:
        status: Status of the last target.
        refused: Reason why the last message was refused; "" if it was accepted.

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
        """Open a zenoh session and subscribe.

        Args:
            solver: Solver of the robot, without a scene.
            contacts: Key of the contacts.
            joints: Key of the joint states.
            q0: (n,) Initial configuration [rad or m]; solutions stay near the previous one. None:
                home.
            config: Zenoh configuration; None: that of ZENOH_CONFIG in the environment, or the
                default.
        """
        self.status, self.refused = Status.SOLVED, ""
        self._fast_solver, self._names = solver.fast(), list(solver.robot.actuators)
        self._q = solver.robot.configuration(q0, "q0")
        self._empty = np.empty(0)
        self._session = zenoh.open(_config() if config is None else config)
        self._publisher = self._session.declare_publisher(joints)
        self._subscriber = self._session.declare_subscriber(contacts, self._on_contacts)

    def _on_contacts(self, sample: Any) -> None:
        try:
            points, normals = decode_contacts(bytes(sample.payload))
            self.refused = lost_contacts_reason(points)
            if self.refused:
                return
            q, self.status = self._fast_solver(points, normals, self._q)
        except CasadiIKError as error:
            self.refused = str(error)
            return
        self.refused = ""
        if self.status is Status.SOLVED:
            self._q = q.copy()
            self._publisher.put(
                cdr_message(_time_stamp(), "", self._names, self._q, self._empty, self._empty)
            )

    def wait(self) -> None:
        """Serve until the process is interrupted."""
        threading.Event().wait()

    def __enter__(self) -> ContactNode:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


def _config() -> Any:
    return zenoh.Config.from_env() if "ZENOH_CONFIG" in os.environ else zenoh.Config()


def _time_stamp() -> tuple[int, int]:
    """Return the current time in seconds and nanoseconds."""
    return divmod(time.time_ns(), 1_000_000_000)


def main(arguments: list[str] | None = None) -> None:
    """Run a node from the command line until Ctrl-C.

    Args:
        arguments: Words of the command line; None: those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m casadi_ik.integrations.ros2",
        description="Reply to each PoseArray of contacts with a JointState of the motors.",
    )
    parser.add_argument("robot", help="robot name or YAML file")
    parser.add_argument("--contacts", default="contacts", help="key of the contacts")
    parser.add_argument("--joints", default="joint_commands", help="key of the joint states")
    options = parser.parse_args(arguments)
    solver = Solver(load_robot(options.robot))
    with ContactNode(solver, options.contacts, options.joints) as node:
        sys.stderr.write(
            f"{options.robot}: replies to {options.contacts!r} on {options.joints!r}; Ctrl-C ends\n"
        )
        node.wait()


if __name__ == "__main__":
    main()
