"""Kinematics for LeRobot: in place of its `RobotKinematics`, and a step for contacts.

Written against lerobot 0.4 (`lerobot.model.kinematics`, `lerobot.processor`).
"""

# pyright: reportMissingImports=false
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.api import Solver
from casadi_ik.errors import InputError, InvalidPoseError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import lost_contacts_reason
from casadi_ik.files.input_checks.poses import single_pose
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.solve.status import Status

try:
    from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
    from lerobot.processor import ProcessorStepRegistry, RobotActionProcessorStep
except ImportError as error:
    raise MissingExtraError(
        "the adapter needs lerobot, which is not installed: pip install 'casadi-ik[lerobot]'"
    ) from error

PLACE, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")


class ArmKinematics:
    """What the steps of LeRobot call `kinematics`, exact and global, for a palm's or a tool's pose.

    Takes the place of `lerobot.model.kinematics.RobotKinematics` in `InverseKinematicsEEToJoints`,
    `EEReferenceAndDelta` and the other steps: positions in degrees, poses (4, 4) [m]. Values after
    those of the arm (a gripper's) stay as they are. A pose that cannot be reached leaves the arm
    where it is, see `status`.

    Attributes:
        joint_names: The arm's motors, in the order of all arrays.
        status: Of the last inverse kinematics; INVALID if the pose was not rigid or not finite.
    """

    def __init__(self, solver: Solver) -> None:
        """Take a solver; its robot is an arm alone or with a hand, whose palm is posed."""
        self._solver, self._robot = solver, solver.robot
        self._arm = list(solver.robot.description.arm_actuators)
        self.joint_names = [solver.robot.actuators[i] for i in self._arm]
        self.status = Status.SOLVED

    def _configuration(self, degrees: ArrayLike) -> Array:
        q = self._robot.home.copy()
        q[self._arm] = np.deg2rad(np.asarray(degrees, dtype=float)[: len(self._arm)])
        return q

    def forward_kinematics(self, joint_pos_deg: ArrayLike) -> Array:
        """(4, 4) pose of the palm from positions [deg]."""
        return self._robot.palm(self._configuration(joint_pos_deg))

    def inverse_kinematics(
        self,
        current_joint_pos: ArrayLike,
        desired_ee_pose: ArrayLike,
        position_weight: float = 1.0,
        orientation_weight: float = 0.01,
    ) -> Array:
        """Positions [deg] at which the palm has a pose, near the current ones.

        Args:
            current_joint_pos: The arm's [deg], and what stays as it is.
            desired_ee_pose: (4, 4) in the base frame.
            position_weight: Not used: the pose is met within the solver's tolerance.
            orientation_weight: 0: the position alone counts (of an arm without a hand).
        """
        del position_weight
        found = np.array(current_joint_pos, dtype=float)
        q0 = self._configuration(found)
        try:
            pose = single_pose(desired_ee_pose, "desired_ee_pose")
        except InvalidPoseError:  # of a tracker that has lost the hand: the arm is held
            self.status = Status.INVALID
            return found
        grasp = self._grasp(pose, orientation_weight != 0)
        solution = self._solver.solve(grasp, q0=q0, prefer="q0", diagnose=False)
        self.status = solution.status
        if solution.success:
            found[: len(self._arm)] = np.rad2deg(solution.q[self._arm])
        return found

    def _grasp(self, pose: Array, turned: bool) -> Grasp:
        robot = self._robot
        if robot.description.hand_actuators:
            if not turned:
                raise InputError("orientation_weight: found 0, expected an arm without a hand")
            posture = {
                robot.actuators[i]: float(robot.home[i]) for i in robot.description.hand_actuators
            }
            return Grasp(palm=pose, posture=posture)
        tip = pose @ np.linalg.inv(robot.palm(robot.home)) @ robot.contact_frames(robot.home)[0]
        return Grasp({robot.fingers[0]: Contact.at(tip) if turned else Contact(tip[:3, 3])})


def _contacts_of(places: dict[str, list[float]], normals: dict[str, list[float]]) -> Grasp | None:
    """Return the contacts of an action; None if they are those of a tracker without a hand."""
    if lost_contacts_reason(np.array(list(places.values()), dtype=float)):
        return None
    try:
        return Grasp(
            {
                name: Contact(point, None if np.isnan(normals[name]).any() else normals[name])
                for name, point in places.items()
                if np.isfinite(point).all()
            }
        )
    except InputError:  # no contact is left, or a normal is zero or infinite
        return None


@ProcessorStepRegistry.register("casadi_ik_contacts_to_joints")
@dataclass
class ContactsToJoints(RobotActionProcessorStep):
    """Turns contacts of an action into targets of all motors of arm and hand.

    `FINGER.x`, `.y`, `.z` [m] and `.nx`, `.ny`, `.nz` (the pad's outward normal, may be left out)
    become `MOTOR.pos` [rad or m]. Contacts that cannot be met leave the motors where they are.

    Attributes:
        solver: Of the robot.
        q: (n,) the last targets; None: the robot's home.
        status: Of the last contacts; INVALID if they were those of a tracker without a hand.
    """

    solver: Solver
    q: Array | None = None
    status: Status = field(default=Status.SOLVED, init=False)

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Replace the contacts of an action."""
        robot = self.solver.robot
        here = robot.home if self.q is None else self.q
        places, normals = (
            {name: [action.pop(f"{name}.{key}", np.nan) for key in keys] for name in robot.fingers}
            for keys in (PLACE, NORMAL)
        )
        grasp = _contacts_of(places, normals)
        if grasp is None:
            self.status, self.q = Status.INVALID, here
        else:
            solution = self.solver.solve(grasp, q0=here, prefer="q0", diagnose=False)
            self.status = solution.status
            self.q = solution.q if solution.success else here
        return action | {
            f"{name}.pos": float(value) for name, value in zip(robot.actuators, self.q, strict=True)
        }

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        """The same of the features: numbers per motor instead of numbers per contact."""
        known, robot = features[PipelineFeatureType.ACTION], self.solver.robot
        for name in (f"{x}.{key}" for x in robot.fingers for key in (*PLACE, *NORMAL)):
            known.pop(name, None)
        for name in robot.actuators:
            known[f"{name}.pos"] = PolicyFeature(type=FeatureType.ACTION, shape=(1,))
        return features

    def reset(self) -> None:
        """Begin again from the robot's home."""
        self.q = None
