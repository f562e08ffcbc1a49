"""LeRobot adapter: a replacement of `RobotKinematics`, and a processor step for contacts.

Written against lerobot 0.4 (`lerobot.model.kinematics`, `lerobot.processor`).
"""

# pyright: reportMissingImports=false
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.api import Solver
from casadi_ik.errors import InputError, InvalidPoseError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import single_pose
from casadi_ik.files.keypoints import lost_contacts_reason
from casadi_ik.kinematics.arm_hand import load_robot
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.solve.status import Status

with optional_import("integrations.lerobot"):
    from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
    from lerobot.processor import ProcessorStepRegistry, RobotActionProcessorStep

POINT_KEYS, NORMAL_KEYS = ("x", "y", "z"), ("nx", "ny", "nz")
"""Suffixes of the keys of a contact in an action."""


PRECISION = 1e-5
"""Position tolerance of a pose [m]: larger errors are minimised."""

MAX_ANGLE_TOLERANCE = math.radians(30)
"""Largest tolerance that a small orientation weight leads to [rad]."""


class ArmKinematics:
    """Exact, global kinematics of a palm or tool with the interface of LeRobot's `kinematics`.

    Replaces `lerobot.model.kinematics.RobotKinematics` in `InverseKinematicsEEToJoints`,
    `EEReferenceAndDelta` and other steps: positions in degrees, poses (4, 4) [m]. Values after
    those of the arm (such as a gripper's) are unchanged. Where no configuration has the pose, out
    of reach or with five axes, the arm moves to the minimum of the weighted squared errors that is
    reached from its current positions, see `status`.

    Attributes:
        joint_names: Motors of the arm, in the order of all arrays.
        status: Status of the last inverse kinematics: SOLVED, NEAREST, or INVALID if the pose was
            not rigid or finite, so that the arm did not move.
    """

    def __init__(self, solver: Solver) -> None:
        """Store a solver; its robot is an arm alone, or with a hand whose palm is posed."""
        self._solver, self._robot = solver, solver.robot
        self._arm = list(solver.robot.description.arm_actuators)
        self.joint_names = [solver.robot.actuators[i] for i in self._arm]
        self.status = Status.SOLVED

    def _configuration(self, degrees: ArrayLike) -> Array:
        q = self._robot.home.copy()
        q[self._arm] = np.deg2rad(np.asarray(degrees, dtype=float)[: len(self._arm)])
        return q

    def forward_kinematics(self, joint_pos_deg: ArrayLike) -> Array:
        """Return the (4, 4) pose of the palm at positions [deg]."""
        return self._robot.palm(self._configuration(joint_pos_deg))

    def inverse_kinematics(
        self,
        current_joint_pos: ArrayLike,
        desired_ee_pose: ArrayLike,
        position_weight: float = 1.0,
        orientation_weight: float = 0.01,
    ) -> Array:
        """Return positions [deg] near the current ones at which the palm has the desired pose.

        Args:
            current_joint_pos: Positions of the arm [deg], followed by values that are unchanged.
            desired_ee_pose: (4, 4) Pose in the base frame.
            position_weight: Weight of squared position errors [1/m^2].
            orientation_weight: Weight of squared angles [1/rad^2]; 0: only the position is
                constrained (arms without a hand).
        """
        positions = np.array(current_joint_pos, dtype=float)
        q0 = self._configuration(positions)
        try:
            pose = single_pose(desired_ee_pose, "desired_ee_pose")
        except InvalidPoseError:  # the tracker has lost the hand: the arm does not move
            self.status = Status.INVALID
            return positions
        grasp = self._grasp(pose, position_weight, orientation_weight)
        solution = self._solver.solve(
            grasp, q0=q0, prefer="q0", diagnose=False, best_effort="local"
        )
        self.status = solution.status
        if solution.status in (Status.SOLVED, Status.NEAREST):
            positions[: len(self._arm)] = np.rad2deg(solution.q[self._arm])
        return positions

    def _grasp(self, pose: Array, position_weight: float, orientation_weight: float) -> Grasp:
        robot = self._robot
        if robot.description.hand_actuators:
            if not orientation_weight:
                raise InputError("orientation_weight: found 0, expected an arm without a hand")
            posture = {
                robot.actuators[i]: float(robot.home[i]) for i in robot.description.hand_actuators
            }
            return Grasp(palm=pose, posture=posture)
        tip = pose @ np.linalg.inv(robot.palm(robot.home)) @ robot.contact_frames(robot.home)[0]
        finger = robot.fingers[0]
        if not orientation_weight:
            return Grasp({finger: Contact(tip[:3, 3])})
        ratio = math.sqrt(position_weight / orientation_weight)
        tolerance = Tolerance(PRECISION, min(PRECISION * ratio, MAX_ANGLE_TOLERANCE))
        return Grasp({finger: dataclasses.replace(Contact.from_pose(tip), tolerance=tolerance)})


def _contacts_of(points: dict[str, list[float]], normals: dict[str, list[float]]) -> Grasp | None:
    """Return the contacts of an action; None if they are those of a tracker without a hand."""
    if lost_contacts_reason(np.array(list(points.values()), dtype=float)):
        return None
    try:
        return Grasp(
            {
                name: Contact(point, None if np.isnan(normals[name]).any() else normals[name])
                for name, point in points.items()
                if np.isfinite(point).all()
            }
        )
    except InputError:  # all contacts are free, or a normal is zero or infinite
        return None


@ProcessorStepRegistry.register("casadi_ik_contacts_to_joints")
@dataclass
class ContactsToJoints(RobotActionProcessorStep):
    """Processor step from contacts in an action to targets of all motors of arm and hand.

    `FINGER.x`, `.y`, `.z` [m] and `.nx`, `.ny`, `.nz` (outward normal of the pad, optional) are
    replaced by `MOTOR.pos` [rad or m]. If the contacts are out of reach, the motors move to the
    nearest configuration of their branch.

    Attributes:
        solver: Solver of the robot, or the name of the robot, from which a solver is made.
        q: (n,) Last targets; None: home.
        status: Status of the last contacts; INVALID if the tracker had lost the hand.
    """

    solver: Solver | str
    q: Array | None = None
    status: Status = field(default=Status.SOLVED, init=False)

    def __post_init__(self) -> None:
        """Make the solver of a robot that is specified by name."""
        name = self.solver
        self._solver = Solver(load_robot(name)) if isinstance(name, str) else name

    def get_config(self) -> dict[str, Any]:
        """Return the arguments of the step, with which LeRobot stores a pipeline."""
        return {"solver": self._solver.robot.description.name}

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Replace the contacts of an action by motor targets."""
        robot = self._solver.robot
        q0 = robot.home if self.q is None else self.q
        points, normals = (
            {name: [action.pop(f"{name}.{key}", np.nan) for key in keys] for name in robot.fingers}
            for keys in (POINT_KEYS, NORMAL_KEYS)
        )
        grasp = _contacts_of(points, normals)
        if grasp is None:
            self.status, self.q = Status.INVALID, q0
        else:
            solution = self._solver.solve(
                grasp, q0=q0, prefer="q0", diagnose=False, best_effort="local"
            )
            self.status = solution.status
            self.q = solution.q if solution.status in (Status.SOLVED, Status.NEAREST) else q0
        return action | {
            f"{name}.pos": float(value) for name, value in zip(robot.actuators, self.q, strict=True)
        }

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        """Replace the features of contacts by features of motors."""
        action_features, robot = features[PipelineFeatureType.ACTION], self._solver.robot
        for name in (f"{x}.{key}" for x in robot.fingers for key in (*POINT_KEYS, *NORMAL_KEYS)):
            action_features.pop(name, None)
        for name in robot.actuators:
            action_features[f"{name}.pos"] = PolicyFeature(type=FeatureType.ACTION, shape=(1,))
        return features

    def reset(self) -> None:
        """Restart from home."""
        self.q = None
