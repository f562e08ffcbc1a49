"""Independent oracle: pinocchio with the URDF that a robot writes."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

import casadi_ik as ik


class PinocchioRobot:
    """Robot in pinocchio, in which every joint is independent."""

    def __init__(self, robot: ik.ArmHand) -> None:
        self.robot = robot
        self.model = pin.buildModelFromXML(robot.urdf())
        self.data = self.model.createData()

    def configuration(self, q) -> np.ndarray:
        """Return the configuration in pinocchio of actuator positions."""
        values = np.zeros(self.model.nq)
        for name, value in self.robot.joints(q).items():
            values[self.model.joints[self.model.getJointId(name)].idx_q] = value
        return values

    def frames(self, q) -> dict[str, np.ndarray]:
        """Return the pose (4, 4) of every link, including contact links."""
        pin.framesForwardKinematics(self.model, self.data, self.configuration(q))
        return {
            frame.name: self.data.oMf[i].homogeneous
            for i, frame in enumerate(self.model.frames)
            if frame.type == pin.FrameType.BODY
        }

    def contacts(self, q) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals like `ArmHand.contacts`."""
        frames = self.frames(q)
        fingers = self.robot.description.fingers
        poses = [frames[f"{finger.name}_contact"] for finger in fingers]
        points = np.array([pose[:3, 3] for pose in poses])
        normals = [
            pose[:3, :3] @ finger.normal for pose, finger in zip(poses, fingers, strict=True)
        ]
        return points, np.array(normals)

    def jacobian(self, q, frame: str, reference: pin.ReferenceFrame) -> np.ndarray:
        """Return the twist (6, m) [v; w] of a frame per movable joint of the description."""
        pin.computeJointJacobians(self.model, self.data, self.configuration(q))
        pin.updateFramePlacements(self.model, self.data)
        frame_jacobian = pin.getFrameJacobian(
            self.model, self.data, self.model.getFrameId(frame, pin.FrameType.BODY), reference
        )
        ids = [self.model.getJointId(name) for name in self.robot.description.joint_names]
        return frame_jacobian[:, [self.model.joints[i].idx_v for i in ids]]


def verdict(oracle: PinocchioRobot, q, points, normals) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [m] and angles [rad] of a configuration from targets (f, 3)."""
    p, n = oracle.contacts(q)
    cosine = np.einsum("ij,ij->i", n, normals)
    sine = np.linalg.norm(np.cross(n, normals), axis=1)
    return np.linalg.norm(p - points, axis=1), np.arctan2(sine, cosine)


def assert_verdicts(oracle: PinocchioRobot, batch, points, normals, enforce: bool = True) -> None:
    """Assert errors, limits and success of every row of a batch, recomputed from q alone."""
    robot, model = oracle.robot, oracle.model
    usual = ik.Tolerance()
    for row, q in enumerate(batch.q):
        position, angle = verdict(oracle, q, points[row], normals[row])
        np.testing.assert_allclose(batch.position_error[row], position, atol=1e-11)
        np.testing.assert_allclose(batch.angle_error[row], angle, atol=1e-11)
        theta = oracle.configuration(q)
        is_within_limits = np.all(theta >= model.lowerPositionLimit - 1e-9)
        is_within_limits &= np.all(theta <= model.upperPositionLimit + 1e-9)
        is_within_limits &= np.all(q >= robot.lower - 1e-9) and np.all(q <= robot.upper + 1e-9)
        assert batch.limits_ok[row] == is_within_limits
        is_met = np.all(position <= usual.position) and np.all(angle <= usual.angle)
        assert batch.success[row] == (is_met and (is_within_limits or not enforce))
