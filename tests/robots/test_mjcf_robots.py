"""MJCF and xacro: the same robots in other formats, against the libraries that read them."""

from __future__ import annotations

import numpy as np
import pytest
from imported_files import FINGERS, arm, describe, hand

import casadi_ik as ik
from casadi_ik.importing.check import largest_difference
from casadi_ik.robots.robot_files.read import read_tree

MJCF = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="forearm" pos="0 0 0.1" quat="0.9 0.1 0.3 0.2">
      <body name="palm" pos="0 0.01 0.2">
        <joint name="wrist_a" axis="0 1 0" range="-0.5 0.4"/>
        <joint name="wrist_b" axis="1 0 0" pos="0 0.01 0.02" range="-0.7 0.6"/>
        <geom type="box" size="0.03 0.03 0.01"/>
        <body name="left_1" pos="0 0.03 0.05" euler="0.1 0.2 0.3">
          <joint name="left_a" axis="1 0 0.5" range="-0.2 1.5" ref="0.3"/>
          <geom type="capsule" size="0.01 0.02"/>
          <body name="left_tip" pos="0 0 0.05">
            <joint name="left_b" axis="1 0 0" range="-0.5 2.6"/>
            <geom type="sphere" size="0.01"/>
          </body>
        </body>
        <body name="right_1" pos="0 -0.03 0.05">
          <joint name="right_a" axis="-1 0 0" range="0 1.5"/>
          <geom type="capsule" size="0.01 0.02"/>
          <body name="right_2" pos="0 0 0.04">
            <joint name="right_b" axis="-1 0 0" range="0 1.6"/>
            <geom type="sphere" size="0.01"/>
            <body name="right_tip" pos="0 0 0.03">
              <joint name="right_c" type="slide" axis="0 0 1" range="0 0.02" ref="0.005"/>
              <geom type="sphere" size="0.01"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left_b" joint2="left_a" polycoef="0.1 0.5 0.3 0 0"/></equality>
  <tendon>
    <fixed name="pull"><joint joint="right_a" coef="1"/><joint joint="right_b" coef="1"/></fixed>
  </tendon>
  <actuator><position name="motor" tendon="pull"/></actuator>
</mujoco>
"""


@pytest.fixture
def mjcf(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "hand.xml").write_text(MJCF)
    return describe(tmp_path, "hand: {file: hand.xml, palm: palm}")


def test_mjcf_moves_as_mujoco_says(mjcf, rng):
    robot = ik.load_robot(mjcf)
    assert robot.actuators == ("wrist_a", "wrist_b", "left_a", "right_c", "pull")
    assert robot.description.arm_actuators == (0, 1)
    q = robot.random(rng, 20)
    assert largest_difference(robot, read_tree(mjcf.parent / "hand.xml"), q) < 1e-12
    assert (robot.beyond_limits(q) <= 1e-9).all()


def test_equality_is_a_polynomial_of_displacements(mjcf, rng):
    robot = ik.load_robot(mjcf)
    joints = robot.joints(robot.random(rng, 10))
    moved = joints["left_a"] - 0.3  # the initial position
    np.testing.assert_allclose(joints["left_b"], 0.1 + 0.5 * moved + 0.3 * moved**2, atol=1e-14)


def test_tendon_is_a_motor_that_its_joints_share_by_their_ranges(mjcf, rng):
    robot = ik.load_robot(mjcf)
    q = robot.random(rng, 10)
    joints = robot.joints(q)
    np.testing.assert_allclose(joints["right_a"] + joints["right_b"], q[:, 4], atol=1e-14)
    np.testing.assert_allclose(joints["right_a"] / 1.5, joints["right_b"] / 1.6, atol=1e-14)
    np.testing.assert_allclose([robot.lower[4], robot.upper[4]], [0, 3.1], atol=1e-9)


def test_mjcf_hand_on_an_arm_is_solved(mjcf, rng):
    arm(mjcf.parent, 4)
    path = describe(mjcf.parent, "arm: {file: arm.urdf}\nhand: {file: hand.xml, palm: palm}")
    robot = ik.load_robot(path)
    q = robot.random(rng, 10)
    solver = ik.Solver(robot, compiled=False)
    assert solver.solve_batch(*robot.contacts(q)).success.mean() >= 0.9


def test_xacro_is_expanded(tmp_path, rng):
    pytest.importorskip("xacro")
    text = hand(tmp_path).read_text()
    text = text.replace('<robot name="hand">', HEAD).replace('xyz="0 0.04 0.05"', 'xyz="0 ${y} 0"')
    (tmp_path / "hand.urdf.xacro").write_text(text)
    robot = ik.load_robot(describe(tmp_path, "hand: {file: hand.urdf.xacro}", FINGERS))
    np.testing.assert_allclose(robot.links(robot.home)["left_1"][:3, 3], [0, 0.06, 0], atol=1e-15)
    assert (
        largest_difference(robot, read_tree(tmp_path / "hand.urdf.xacro"), robot.random(rng, 3))
        < 1e-12
    )


HEAD = """<robot name="hand" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="y" value="${2 * 0.03}"/>"""
