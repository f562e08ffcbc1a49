"""Adapters hold the robot while the tracker has lost the hand."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import casadi_ik as ik

LOST_VALUES = {
    "NaN": np.full((4, 4), np.nan),
    "zeros": np.zeros((4, 4)),
    "minus one": -np.ones((4, 4)),
    "stretched": np.diag([1.0, 1.0, 1.1, 1.0]),
}


@pytest.fixture
def lerobot(monkeypatch):
    """Adapter for LeRobot, with stand-ins for missing imports."""
    types, processor = ModuleType("lerobot.configs.types"), ModuleType("lerobot.processor")
    for name in ("FeatureType", "PipelineFeatureType", "PolicyFeature"):
        setattr(types, name, SimpleNamespace)
    registry = SimpleNamespace(register=lambda _: lambda step: step)
    processor.__dict__.update(ProcessorStepRegistry=registry, RobotActionProcessorStep=object)
    parts = {"lerobot": ModuleType("lerobot"), "lerobot.configs": ModuleType("lerobot.configs")}
    parts |= {"lerobot.configs.types": types, "lerobot.processor": processor}
    for name, module in parts.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "casadi_ik.integrations.lerobot", raising=False)
    adapter = importlib.import_module("casadi_ik.integrations.lerobot")
    yield adapter
    sys.modules.pop("casadi_ik.integrations.lerobot", None)


@pytest.mark.parametrize("name", LOST_VALUES)
def test_lerobot_arm_holds_after_bad_input(lerobot, name):
    robot = ik.load_robot("ur5e")
    arm = lerobot.ArmKinematics(ik.Solver(robot))
    angles = np.rad2deg(robot.home)
    np.testing.assert_array_equal(arm.inverse_kinematics(angles, LOST_VALUES[name]), angles)
    assert arm.status is ik.Status.INVALID
    rounded = np.round(robot.palm(robot.home), 3)
    arm.inverse_kinematics(angles, rounded)
    assert arm.status is ik.Status.SOLVED


@pytest.mark.parametrize("number", [0.0, -1.0, np.nan, np.inf])
def test_lerobot_contacts_hold_after_bad_input(lerobot, robot, number):
    step = lerobot.ContactsToJoints(ik.Solver(robot))
    action = {f"{name}.{key}": number for name in robot.fingers for key in "xyz"}
    done = step.action(action)
    assert step.status is ik.Status.INVALID
    np.testing.assert_array_equal([done[f"{name}.pos"] for name in robot.actuators], robot.home)


def test_ros_messages_without_orientation_are_refused(robot):
    ros2 = pytest.importorskip("casadi_ik.integrations.ros2")
    points, normals = robot.contacts(robot.home)
    message = bytearray(ros2.encode_contacts(points, normals))
    values = np.frombuffer(message, "<f8", offset=len(message) - 8 * 7 * len(points))
    without_orientation = values.reshape(-1, 7).copy()
    start = len(message) - without_orientation.nbytes
    without_orientation[:, 3:] *= 1.004  # two decimals
    message[start:] = without_orientation.tobytes()
    np.testing.assert_allclose(ros2.decode_contacts(bytes(message))[1], normals, atol=1e-12)
    without_orientation[1, 3:] = 0.0
    message = message[:start] + without_orientation.tobytes()
    with pytest.raises(ik.errors.InvalidPoseError, match=r"poses\[1\]"):
        ros2.decode_contacts(bytes(message))
