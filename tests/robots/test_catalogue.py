"""Shipped arms with shipped hands, and their numbers against what others published.

`published_poses.json` holds poses of links that pinocchio and MuJoCo found in published files,
whose names stand beside them (pinocchio in a URDF of their numbers where the file is a table or
a macro); the files themselves are no part of this project.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import numpy_oracle
import pytest
import yaml
from commands import main
from processes import MODELS
from toy_robots import grasp_at

import casadi_ik as ik
from casadi_ik import model as robots

ARMS, HANDS = ik.shipped_names("arms"), ik.shipped_names("hands")
FEWER = {"panda_hand": 2, "robotiq_2f85": 2, "widowx_gripper": 2, "so100_jaw": 2, "tool": 1}
UNMOVED = {"tool": ("tip",), "so100_jaw": ("fixed",)}
"""Fingers of each hand that no joint moves relative to the palm."""

PUBLISHED = json.loads(Path(__file__).with_name("published_poses.json").read_text())


@pytest.mark.parametrize("arm", ARMS)
def test_every_arm_takes_a_hand(arm):
    description = robots.load_description(f"{arm}+allegro_right")
    assert description.name == f"{arm}+allegro_right"
    assert len(description.arm_actuators) in (5, 6, 7)
    assert description.thumb == "thumb"
    home, lower, upper = description.home, description.lower, description.upper
    arm_part = list(description.arm_actuators)
    assert (home[arm_part] != 0).any()
    assert (np.minimum(home - lower, upper - home)[arm_part] > np.deg2rad(4)).all()


@pytest.mark.parametrize("hand", HANDS)
def test_every_hand_goes_on_an_arm(hand):
    description = robots.load_description(f"ur5e+{hand}")
    assert len(description.fingers) >= FEWER.get(hand, 3)
    assert description.actuator_names[:6] == tuple(f"ur5e_joint_{i}" for i in range(1, 7))
    assert description.sources
    for finger in description.fingers:
        assert bool(finger.joints) == (finger.name not in UNMOVED.get(hand, ()))
        np.testing.assert_allclose(np.linalg.norm(finger.normal), 1, atol=1e-12)


@pytest.mark.parametrize("arm", PUBLISHED["arms"])
def test_arms_match_published_files(arm):
    published = PUBLISHED["arms"][arm]
    robot = ik.load_robot(arm)
    tip = robot.description.joints[-1]  # fixed to the arm's last link
    for q, pose in zip(published["q"], published["poses"], strict=True):
        last = np.array(published["base"]) @ robot.links(q)[tip.parent]
        theirs = np.array(pose) @ np.linalg.inv(published["tip"])
        np.testing.assert_allclose(last, theirs, atol=published["tolerance"])
        if "flange" in published:  # the published link is the flange, perhaps with its axes turned
            palm_pose = np.eye(4)
            palm_pose[:3, :3] = published["flange"]
            np.testing.assert_allclose(
                last @ tip.placement, np.array(pose) @ palm_pose, atol=published["tolerance"]
            )


@pytest.mark.parametrize("hand", PUBLISHED["hands"])
def test_hands_match_published_files(hand):
    published = PUBLISHED["hands"][hand]
    robot, q = ik.load_robot(hand), np.array(published["q"])
    poses = numpy_oracle.links(robot, dict(zip(published["joints"], q.T, strict=True)))
    for i, links in enumerate(published["links"]):
        assert len(links) >= FEWER.get(hand, 3)
        for link, pose in links.items():
            np.testing.assert_allclose(poses[link][i, :3], pose, atol=published["tolerance"])


@pytest.mark.parametrize(
    ("name", "expected_words"),
    [
        ("pander+allegro_right", "arm or body is called 'pander'; did you mean 'panda'?"),
        ("panda+allegra", "hand is called 'allegra'; did you mean 'allegro_"),
        ("g1+dex4", "arm or body is called 'g1'; did you mean 'g1+dex3'?"),
        ("h1+inspire", "arm or body is called 'h1'; did you mean 'h1_2+inspire'?"),
        ("foo+leap", "arm or body is called 'foo'; arms: "),
        ("foo+leap", "; bodies: baxter+ar10, "),
        ("foo", "arm-hand is called 'foo'; shipped: "),
        ("foo", "; bodies: baxter+ar10, "),
        ("foo", "ARM+HAND"),
        ("pr2", "kuka_lwr_barrett"),
    ],
)
def test_unknown_robots_are_named(name, expected_words):
    with pytest.raises(
        ik.errors.UnknownNameError, match=f"^no shipped .*{re.escape(expected_words)}"
    ):
        ik.load_robot(name)


@pytest.mark.parametrize("path", ["a+b/robot.yaml", "my/robot.yaml"])
def test_missing_file_is_named(path):
    with pytest.raises(ik.errors.DescriptionError, match=f"{re.escape(path)}: .*no such file"):
        ik.load_robot(path)


def test_a_grasp_file_may_name_a_pair(tmp_path, capsys):
    """The command line resolves paths relative to the file, but a pair is not a path."""
    contact = {"point": [0.4, 0.1, 0.5], "normal": [0, 0, 1]}
    path = tmp_path / "grasp.yaml"
    path.write_text(yaml.safe_dump({"robot": "panda+leap", "contacts": {"thumb": contact}}))
    assert main(["solve", str(path), "--q0", "1"]) == 2
    assert "--q0: found 1 numbers, expected 23: panda_joint_1, " in capsys.readouterr().err


# Arms and hands alone.


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
    points_reached, _ = robot.contacts(solved.q)
    assert np.linalg.norm(points_reached - points, axis=2).max() <= 5e-3


def test_single_joint_hand_knows_its_pose() -> None:
    robot = ik.load_robot("so100_jaw")
    assert robot.joints([0.2]) == {"so100_jaw": 0.2}
    np.testing.assert_array_equal(robot.joints([[0.2], [0.3]])["so100_jaw"], [0.2, 0.3])
    tool = ik.load_robot("tool")
    assert tool.joints(np.zeros((2, 0))) == {}
    with pytest.raises(ik.errors.UnsupportedError, match="tool has no motors"):
        ik.Solver(tool)


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
def test_robot_file_suggests_import(name: str) -> None:
    with pytest.raises(ik.errors.DescriptionError, match=f"casadi-ik import {name} --out .*yaml"):
        ik.load_robot(name)


# Grippers: opposed pads, and a jaw that is fixed to the palm.

OPENED = {
    "widowx_gripper": ((0.015, 0.012), (0.037, 0.056)),
    "so100_jaw": ((0.0, 0.0158),),
}
"""Motor position and distance [m] between the parallel pads of each gripper."""


@pytest.mark.parametrize("gripper", OPENED)
def test_pads_face_each_other(gripper: str) -> None:
    robot = ik.load_robot(gripper)
    for motor, opening in OPENED[gripper]:
        points, normals = robot.contacts(np.array([motor]))
        np.testing.assert_allclose(points[0] + opening * normals[0], points[1], atol=1e-6)
        np.testing.assert_allclose(points[1] + opening * normals[1], points[0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["ur5e+so100_jaw", "widowx_250s+widowx_gripper"])
def test_random_contacts_are_solved(pair: str, rng: np.random.Generator) -> None:
    robot = ik.load_robot(pair)
    batch = ik.Solver(robot).solve_batch(*robot.contacts(robot.random(rng, 100)))
    assert batch.success.all()


def test_held_object_may_touch_the_fixed_jaw_only() -> None:
    """A ball between the tips is free; a ball at the motor collides."""
    robot = ik.load_robot("ur5e+so100_jaw")
    q = robot.home.copy()
    q[robot.actuators.index("so100_jaw")] = 0.2
    grasp, palm = grasp_at(robot, q), robot.palm(q)
    ball = {"kind": "sphere", "radius": 0.015}
    free = []
    for out in (0.077, 0.0):
        pose = palm.copy()
        pose[:3, 3] = palm[:3, 3] + out * palm[:3, 2]
        scene = ik.Scene({"ball": {**ball, "pose": pose}}, grasped="ball")
        free.append(ik.Solver(robot, scene=scene).check(q, grasp).distance > 0)
    assert free == [True, False]


def test_fixed_pad_is_on_the_palm_link(tmp_path: Path) -> None:
    text = (MODELS / "hands" / "so100_jaw.yaml").read_text()
    (tmp_path / "hand.yaml").write_text(
        text.replace("palm: {link: so100_fixed_jaw", "palm: {link: so100_gripper")
    )
    (tmp_path / "robot.yaml").write_text(
        "name: changed\narm: ur5e\nhand: hand.yaml\nmount: {xyz: [0, 0, 0]}\n"
        "fingers: [moving, fixed]\nthumb: moving\n"
    )
    with pytest.raises(ik.errors.DescriptionError, match="'so100_fixed_jaw'"):
        ik.load_robot(tmp_path / "robot.yaml")
