"""Tests of the processing steps of LeRobot; they run where `lerobot` is installed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import casadi_ik as ik

pytest.importorskip("lerobot.processor")
from lerobot.configs.types import PipelineFeatureType
from lerobot.processor import RobotProcessorPipeline
from lerobot.processor.converters import (
    robot_action_observation_to_transition,
    transition_to_robot_action,
)
from lerobot.robots.so_follower.robot_kinematic_processor import (
    InverseKinematicsEEToJoints,
)
from lerobot.utils.rotation import Rotation

from casadi_ik.integrations.lerobot import ArmKinematics, ContactsToJoints


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(ik.Solver(ik.load_robot("ur5e")))


def pipeline(*steps):
    return RobotProcessorPipeline(
        list(steps),
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )


def test_tool_pose_through_lerobot_step(arm, rng):
    names = [*arm.joint_names, "gripper"]
    step = InverseKinematicsEEToJoints(kinematics=arm, motor_names=names)
    robot = ik.load_robot("ur5e")
    positions = [*np.rad2deg(robot.home), 30.0]
    observation = {f"{name}.pos": value for name, value in zip(names, positions, strict=True)}
    for q in robot.random(rng, 10):
        pose = arm.forward_kinematics(np.rad2deg(q))
        np.testing.assert_allclose(pose, robot.palm(q), atol=1e-9)
        action = {f"ee.{key}": value for key, value in zip("xyz", pose[:3, 3], strict=True)}
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        action |= {f"ee.w{key}": value for key, value in zip("xyz", turn, strict=True)}
        done = pipeline(step)((action | {"ee.gripper_pos": 42.0}, observation))
        assert arm.status is ik.Status.SOLVED
        assert done.pop("gripper.pos") == 42.0
        pose_sent = robot.palm(np.deg2rad([done[f"{name}.pos"] for name in arm.joint_names]))
        assert np.linalg.norm(pose_sent[:3, 3] - pose[:3, 3]) < 5e-3
        assert np.linalg.norm(pose_sent[:3, :3] - pose[:3, :3]) < 0.1


def test_palm_pose_of_arm_with_hand(rng):
    robot = ik.load_robot("panda+allegro_right")
    arm = ArmKinematics(ik.Solver(robot))
    assert arm.joint_names == list(robot.actuators[:7])
    q = robot.random(rng, 1)[0][:7]
    pose = arm.forward_kinematics(np.rad2deg(q))
    angles = arm.inverse_kinematics(np.rad2deg(robot.home[:7]), pose)
    assert arm.status is ik.Status.SOLVED
    np.testing.assert_allclose(arm.forward_kinematics(angles)[:3, 3], pose[:3, 3], atol=5e-3)
    with pytest.raises(ik.errors.InputError, match="expected an arm without a hand"):
        arm.inverse_kinematics(angles, pose, orientation_weight=0)


def test_unreachable_pose_is_approached_by_position(arm):
    robot = ik.load_robot("ur5e")
    angles_before = np.array([*np.rad2deg(robot.home), 30.0])
    pose = np.eye(4)
    pose[:3, 3] = 0.4, 0.2, 0.5
    angles = arm.inverse_kinematics(angles_before, pose, orientation_weight=0.0)
    np.testing.assert_allclose(arm.forward_kinematics(angles)[:3, 3], pose[:3, 3], atol=5e-3)
    assert angles[-1] == 30.0
    pose[:3, 3] = 9, 9, 9
    pose_reached = arm.forward_kinematics(arm.inverse_kinematics(angles_before, pose))
    assert arm.status is ik.Status.NEAREST
    assert pose_reached[:3, 3] @ np.ones(3) / np.sqrt(3) > 0.8
    np.testing.assert_array_equal(
        arm.inverse_kinematics(angles_before, np.full((4, 4), np.nan)), angles_before
    )
    assert arm.status is ik.Status.INVALID


CASES = [
    ("ur5e", "outwards", 0.01),
    ("ur5e", "outwards", 0.001),
    ("so101", "sideways", 0.01),
    ("so101", "upwards", 0.01),
]


@pytest.mark.parametrize(("name", "way", "orientation_weight"), CASES)
def test_unreachable_path_follows_least_squares(name, way, orientation_weight):
    """LeRobot's weights multiply squared errors; five axes cannot have most poses."""
    robot = ik.load_robot(name)
    arm = ArmKinematics(ik.Solver(robot))
    degrees = np.rad2deg(robot.home)
    pose = robot.palm(robot.home).copy()
    directions = {"sideways": [0, 1, 0], "upwards": [0, 0, 1], "outwards": pose[:3, 3]}
    direction = np.array(directions[way]) / np.linalg.norm(directions[way])
    count = 120 if name == "ur5e" else 20
    bounds = robot.lower - 1e-9, robot.upper + 1e-9

    def residual(q):
        palm = robot.palm(q)
        axes = (palm[:3, :3] - pose[:3, :3]).ravel() / np.sqrt(2)
        return np.concatenate([palm[:3, 3] - pose[:3, 3], np.sqrt(orientation_weight) * axes])

    for _ in range(count):
        pose[:3, 3] += 5e-3 * direction
        previous, degrees = (
            degrees,
            arm.inverse_kinematics(degrees, pose, orientation_weight=orientation_weight),
        )
        assert 0 < np.abs(degrees - previous).max() < 30
        best = least_squares(
            residual, np.deg2rad(degrees), bounds=bounds, xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        expected = robot.palm(best.x)[:3, 3]
        assert np.linalg.norm(arm.forward_kinematics(degrees)[:3, 3] - expected) < 2e-4
    if way != "upwards":
        assert arm.status is ik.Status.NEAREST


def test_action_contacts_become_motor_targets(rng):
    robot = ik.load_robot("panda+allegro_right")
    step = ContactsToJoints(ik.Solver(robot))
    points, normals = robot.contacts(robot.random(rng, 1)[0])
    action = {}
    for name, point, normal in zip(robot.fingers, points, normals, strict=True):
        action |= {f"{name}.{key}": value for key, value in zip("xyz", point, strict=True)}
        action |= {f"{name}.n{key}": value for key, value in zip("xyz", normal, strict=True)}
    done = pipeline(step)((action | {"speed": 1.0}, {}))
    assert set(done) == {f"{name}.pos" for name in robot.actuators} | {"speed"}
    points_reached, _ = robot.contacts(np.array([done[f"{name}.pos"] for name in robot.actuators]))
    assert np.linalg.norm(points_reached - points, axis=1).max() < 5e-3
    unreachable = {key: value + 9 for key, value in action.items()}
    result = pipeline(step)((unreachable, {}))
    assert step.status is ik.Status.NEAREST
    q = np.array([result[f"{name}.pos"] for name in robot.actuators])
    assert robot.contacts(q)[0].mean(axis=0).sum() > points_reached.mean(axis=0).sum()
    features = step.transform_features({PipelineFeatureType.ACTION: dict.fromkeys(action)})
    assert set(features[PipelineFeatureType.ACTION]) == set(done) - {"speed"}
    step.reset()
    assert step.q is None


def test_plugin_is_discovered_and_its_step_is_stored_by_name(monkeypatch, tmp_path):
    from lerobot.processor import ProcessorStepRegistry
    from lerobot.utils.import_utils import register_third_party_plugins

    plugin = Path(__file__).parents[2] / "plugins/lerobot_robot_casadi_ik"
    name = plugin.name
    metadata = tmp_path / f"{name}-0.1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(str(plugin))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, name, raising=False)
    register_third_party_plugins()
    assert name in sys.modules
    assert ProcessorStepRegistry.get("casadi_ik_contacts_to_joints") is ContactsToJoints
    pipeline(ContactsToJoints("panda+allegro_right")).save_pretrained(tmp_path / "steps")
    (config,) = (tmp_path / "steps").glob("*.json")
    loaded = RobotProcessorPipeline.from_pretrained(
        tmp_path / "steps",
        config.name,
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    robot = ik.load_robot("panda+allegro_right")
    assert set(loaded(({}, {}))) == {f"{motor}.pos" for motor in robot.actuators}
