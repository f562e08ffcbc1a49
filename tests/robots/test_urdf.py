"""The written URDF in pinocchio."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import PinocchioRobot

import casadi_ik as ik
from casadi_ik import model as robots


@pytest.fixture(params=["every coupling", *ik.shipped_names("arm_hands")])
def pair(request, coupled_robot, coupled_oracle):
    if request.param == "every coupling":
        return coupled_robot, coupled_oracle
    robot = ik.load_robot(request.param)
    return robot, PinocchioRobot(robot)


def test_frames_and_contacts(pair, rng):
    robot, oracle = pair
    for q in robot.random(rng, 40):
        frames, links = oracle.frames(q), robot.links(q)
        assert set(frames) == set(links) | {f"{finger}_contact" for finger in robot.fingers}
        for name, pose in links.items():
            np.testing.assert_allclose(pose, frames[name], atol=1e-12, err_msg=name)
        points, normals = robot.contacts(q)
        expected_points, expected_normals = oracle.contacts(q)
        np.testing.assert_allclose(points, expected_points, atol=1e-12)
        np.testing.assert_allclose(normals, expected_normals, atol=1e-12)


def test_limits_and_velocities(pair):
    robot, oracle = pair
    for joint in robot.description.movable:
        entry = oracle.model.joints[oracle.model.getJointId(joint.name)]
        assert oracle.model.lowerPositionLimit[entry.idx_q] == joint.lower
        assert oracle.model.upperPositionLimit[entry.idx_q] == joint.upper
        expected = joint.velocity if math.isfinite(joint.velocity) else 10.0
        assert oracle.model.velocityLimit[entry.idx_v] == expected


def test_mimic_joints_stand_for_the_linear_couplings(pair, rng):
    """With mimic joints only the independent joints are set."""
    robot, _ = pair
    model = pin.buildModelFromXML(robot.urdf(), mimic=True)
    data = model.createData()
    leaders = {"bh_finger_2_spread", "left_spread"}  # the first joint of a shared motor
    followers = {
        joint.name
        for joint in robot.description.movable
        if isinstance(joint.coupling, robots.Linear) and joint.name not in leaders
    }
    assert model.nq == len(robot.description.joint_names) - len(followers)
    for q in robot.random(rng, 20):
        values = np.zeros(model.nq)
        for name, value in robot.joints(q).items():
            if name not in followers:
                values[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, values)
        for name, pose in robot.links(q).items():
            frame_pose = data.oMf[model.getFrameId(name, pin.FrameType.BODY)].homogeneous
            np.testing.assert_allclose(pose, frame_pose, atol=1e-12, err_msg=name)


def test_every_part_has_a_visual(robot):
    tree = ElementTree.fromstring(robot.urdf())
    lengths = [float(node.get("length")) for node in tree.iter("cylinder")]
    assert len(lengths) > 15
    assert all(0.005 < length < 0.5 for length in lengths)


def test_couplings_without_urdf_form_are_noted(pair):
    robot, _ = pair
    text = robot.urdf()
    for joint in robot.description.movable:
        is_mentioned = f"<!-- {joint.coupling} -->" in text
        assert is_mentioned == isinstance(joint.coupling, robots.LeadScrew | robots.FourBar)
