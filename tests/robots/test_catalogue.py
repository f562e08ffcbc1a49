"""Shipped arms with shipped hands, and their numbers against what others published.

`published_poses.json` holds poses of links that pinocchio and MuJoCo found in published files,
whose names stand beside them (pinocchio in a URDF of their numbers where the file is a table or
a macro); the files themselves are no part of this project.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import casadi_ik as ik
from casadi_ik import robots
from casadi_ik.cli.inputs import the_robot
from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve
from casadi_ik.robots.parts import described_part
from casadi_ik.robots.poses import link_poses
from casadi_ik.robots.schema import ArmFile, HandFile

ARMS, HANDS = ik.shipped_names("arms"), ik.shipped_names("hands")
FEWER = {"panda_hand": 2, "robotiq_2f85": 2, "widowx_gripper": 2, "so100_jaw": 2, "tool": 1}
UNMOVED = {"tool": ("tip",), "so100_jaw": ("fixed",)}
"""By hand the fingers that no joint moves against the palm."""

PUBLISHED = json.loads(Path(__file__).with_name("published_poses.json").read_text())


@pytest.mark.parametrize("arm", ARMS)
def test_every_arm_takes_a_hand(arm):
    description = robots.load_description(f"{arm}+allegro_right")
    assert description.name == f"{arm}+allegro_right"
    assert len(description.arm_actuators) in (6, 7)
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
def test_arms_stand_where_published_files_have_them(arm):
    known = PUBLISHED["arms"][arm]
    path = resolve(arm, "arms")
    part = described_part(read(path, ArmFile)[0], path)
    names = [joint.name for joint in part.joints if joint.type != "fixed"]
    for q, pose in zip(known["q"], known["poses"], strict=True):
        links = link_poses(part.root, part.joints, dict(zip(names, q, strict=True)))
        last = np.array(known["base"]) @ links[part.tip_link]
        theirs = np.array(pose) @ np.linalg.inv(known["tip"])
        np.testing.assert_allclose(last, theirs, atol=known["tolerance"])
        if "flange" in known:  # the published link is the flange, perhaps with its axes turned
            turned = np.eye(4)
            turned[:3, :3] = known["flange"]
            np.testing.assert_allclose(
                last @ part.tip, np.array(pose) @ turned, atol=known["tolerance"]
            )


@pytest.mark.parametrize("hand", PUBLISHED["hands"])
def test_hands_stand_where_published_files_have_them(hand):
    known = PUBLISHED["hands"][hand]
    path = resolve(hand, "hands")
    part = described_part(read(path, HandFile)[0], path)
    for q, links in zip(known["q"], known["links"], strict=True):
        found = link_poses(part.root, part.joints, dict(zip(known["joints"], q, strict=True)))
        assert len(links) >= FEWER.get(hand, 3)
        for link, pose in links.items():
            np.testing.assert_allclose(found[link][:3], pose, atol=known["tolerance"])


def test_unknown_arms_and_hands_are_named():
    with pytest.raises(
        ik.errors.UnknownNameError, match=r"no shipped arm is called 'pander'; did you mean 'panda'"
    ):
        ik.load_robot("pander+allegro_right")
    with pytest.raises(
        ik.errors.UnknownNameError, match=r"no shipped hand is called 'allegra'; did you mean"
    ):
        ik.load_robot("panda+allegra")
    with pytest.raises(ik.errors.DescriptionError, match="no such file"):
        ik.load_robot("a+b/robot.yaml")


def test_a_grasp_file_may_name_a_pair(tmp_path):
    """The command line counts a path from the file, but a pair is no path."""
    contact = {"point": [0.4, 0.1, 0.5], "normal": [0, 0, 1]}
    path = tmp_path / "grasp.yaml"
    path.write_text(yaml.safe_dump({"robot": "panda+leap", "contacts": {"thumb": contact}}))
    assert the_robot(None, path, ik.load_grasp(path)).name == "panda+leap"
