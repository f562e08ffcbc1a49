"""Arms and hands of the catalogue by themselves, and files that have to be imported first."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik


@pytest.mark.parametrize("name", ["allegro_right", "panda_hand"])
def test_a_hand_alone_is_a_robot(name: str, rng: np.random.Generator) -> None:
    robot = ik.load_robot(name)
    assert robot.name == name
    assert len(robot.description.arm_actuators) == 0
    paired = ik.load_robot(f"panda+{name}")
    assert robot.fingers == paired.fingers
    q = robot.random(rng, 20)
    points, normals = robot.contacts(q)
    assert robot.contacts(q[0])[0].shape == (len(robot.fingers), 3)
    assert (robot.beyond_limits(q) <= 1e-9).all()
    assert robot.palm(robot.home).shape == (4, 4)
    solved = ik.Solver(robot).solve_batch(points, normals)
    assert solved.success.all()
    there, _ = robot.contacts(solved.q)
    assert np.linalg.norm(there - points, axis=2).max() <= 5e-3


def test_a_hand_of_one_joint_says_where_it_is() -> None:
    robot = ik.load_robot("so100_jaw")
    assert robot.joints([0.2]) == {"so100_jaw": 0.2}
    np.testing.assert_array_equal(robot.joints([[0.2], [0.3]])["so100_jaw"], [0.2, 0.3])
    assert ik.load_robot("tool").joints(np.zeros((2, 0))) == {}


def test_an_arm_alone_is_a_robot_whose_fingertip_is_its_tip(rng: np.random.Generator) -> None:
    robot = ik.load_robot("ur5e")
    assert (robot.name, robot.fingers, len(robot.actuators)) == ("ur5e", ("flange",), 6)
    q = robot.random(rng, 5)
    points, normals = robot.contacts(q)
    palm = robot.palm(q)
    np.testing.assert_allclose(points[:, 0], palm[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(normals[:, 0], palm[:, :3, 2], atol=1e-12)
    assert ik.Solver(robot).solve_batch(points, normals).success.all()


@pytest.mark.parametrize("name", ["arm.urdf", "some/hand.xacro", "hand.xml"])
def test_a_robots_file_is_led_to_its_import(name: str) -> None:
    with pytest.raises(
        ik.errors.DescriptionError, match=f"casadi-ik import {name} --out .*yaml makes one"
    ):
        ik.load_robot(name)


def test_unknown_names_are_told_what_there_is() -> None:
    with pytest.raises(ik.errors.UnknownNameError, match="ARM\\+HAND"):
        ik.load_robot("no_such_robot")
