"""A person's hand moves a robot's: what is configured, what is wanted, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from made_up_hand import hand, like_robot

import casadi_ik as ik
from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.motion.retarget import Retarget, Retargeter, load_retarget, usual_retarget

TEN_LINES = """\
robot: kuka_lwr_barrett
fingers: {thumb: 4, finger_2: 8, finger_3: 12}
wrist: 0
scaling: 1.6
travel: 2.0
rpy: [0, 0, 90 deg]
xyz: [500 mm, 0, 600 mm]
low_pass: 0.3
wrist_weight: 0.02
"""


def test_ten_lines(tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_text(TEN_LINES)
    config = load_retarget(path)
    assert config.fingers == {"thumb": 4, "finger_2": 8, "finger_3": 12}
    assert (config.scaling, config.low_pass, config.robot) == (1.6, 0.3, "kuka_lwr_barrett")
    assert config.rpy == pytest.approx((0, 0, np.pi / 2))
    assert config.xyz == pytest.approx((0.5, 0, 0.6))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("thumb: 4", "thumb: 21", "fingers.thumb: found 21, expected a keypoint from 0 to 20"),
        ("low_pass: 0.3", "low_pass: 0", "low_pass: found 0, expected a number above 0 up to 1"),
        ("scaling: 1.6", "scaling: -1", "scaling: found -1, expected a number >= 0"),
        ("wrist: 0", "palm: 0", "palm"),
        ("fingers: {thumb: 4, finger_2: 8, finger_3: 12}", "fingers: {}", "fingers: found none"),
    ],
)
def test_a_bad_file_is_refused_by_key(tmp_path, old, new, message):
    path = tmp_path / "hand.yaml"
    path.write_text(TEN_LINES.replace(old, new))
    with pytest.raises(DescriptionError, match=message) as caught:
        load_retarget(path)
    assert str(caught.value).startswith(str(path))


def test_a_finger_that_the_robot_has_not(robot):
    with pytest.raises(InputError, match=r"fingers\.little: no such finger"):
        Retargeter(Retarget(fingers={"little": 20}), robot)


def test_motions_are_scaled_and_turned(robot):
    """The wrist's way by `travel`, the hand's size by `scaling`, both turned by `rpy`."""
    config = Retarget(
        fingers={"thumb": 4, "finger_2": 8}, scaling=1.5, travel=2.0, rpy=(0, 0, np.pi / 2)
    )
    retargeter = Retargeter(config, robot)
    first = retargeter(hand(0.4, np.zeros(3)))
    second = retargeter(hand(0.4, np.array([0.1, 0.0, 0.0])))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(first.palm[:3, 3], robot.palm(robot.home)[:3, 3])
    np.testing.assert_allclose(first.palm[:3, :3], robot.palm(robot.home)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(second.palm[:3, 3] - first.palm[:3, 3], [0.0, 0.2, 0.0], atol=1e-12)
    tips = hand(0.4, np.zeros(3))[[4, 8]]
    offsets = first.points[:2] - first.palm[:3, 3]
    np.testing.assert_allclose(offsets, 1.5 * tips @ turn.T, atol=1e-12)
    assert np.isnan(first.points[2]).all()
    turned = retargeter(hand(0.4, np.array([0.1, 0.0, 0.0]), turn=0.3))
    relative = turned.palm[:3, :3] @ second.palm[:3, :3].T
    assert np.arccos((np.trace(relative) - 1) / 2) == pytest.approx(0.3)


def test_without_a_frame_and_a_size_the_first_frame_tells_them(robot):
    """Fingertips of a person who holds the hand as the robot does are the robot's own."""
    points, _ = robot.contacts(robot.home)
    palm = robot.palm(robot.home)
    frame = np.random.default_rng(0).normal(size=(21, 3))
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    frame[[4, 8, 12]] = (points - palm[:3, 3]) @ turn / 1.7 + frame[0]
    wanted = Retargeter(usual_retarget(robot), robot)(frame)
    np.testing.assert_allclose(wanted.points, points, atol=1e-9)


def test_low_pass(robot):
    config = Retarget(fingers={"thumb": 4}, scaling=1.0, rpy=(0.0, 0.0, 0.0), low_pass=0.25)
    retargeter = Retargeter(config, robot)
    start = retargeter(hand(0.4, np.zeros(3))).points[0]
    moved = [retargeter(hand(0.4, np.array([0.1, 0, 0]))).points[0] - start for _ in range(3)]
    np.testing.assert_allclose([m[0] for m in moved], 0.1 * (1 - 0.75 ** np.arange(1, 4)))


def test_a_frame_with_nan_asks_for_nothing_and_is_forgotten(robot):
    retargeter = Retargeter(usual_retarget(robot), robot)
    before = retargeter(hand(0.4, np.zeros(3)))
    bad = hand(0.4, np.zeros(3))
    bad[4, 1] = np.nan
    wanted = retargeter(bad)
    assert wanted.palm is None
    assert np.isnan(wanted.points).all()
    after = retargeter(hand(0.4, np.zeros(3)))
    np.testing.assert_array_equal(after.points, before.points)
    with pytest.raises(InputError, match=r"keypoints: found shape \(20, 3\), expected \(21, 3\)"):
        retargeter(bad[:20])


def test_arm_and_hand_follow_a_person(robot):
    """Who moves as the robot can is followed by fingertips and wrist, whatever the scale."""
    way = 0.15 * np.sin(np.linspace(0, np.pi, 120))[:, None] * np.sin(np.arange(14))
    path = robot.home + way
    config = Retarget(fingers={"thumb": 4, "finger_2": 8, "finger_3": 12}, travel=1.7)
    retargeter = Retargeter(config, robot)
    follower = ik.Solver(robot).follow(robot.home, 1 / 30)
    points, _ = robot.contacts(path)
    for keypoints, expected, palm in zip(
        like_robot(robot, path, 1.7), points, robot.palm(path), strict=True
    ):
        wanted = retargeter(keypoints)
        np.testing.assert_allclose(wanted.points, expected, atol=1e-9)
        np.testing.assert_allclose(wanted.palm, palm, atol=1e-9)
        q = follower(wanted.points, palm=wanted.palm, palm_weight=(0.05, 0.05))
        assert follower.state.status is ik.FollowStatus.FOLLOWING
        np.testing.assert_allclose(robot.palm(q)[:3, 3], palm[:3, 3], atol=0.02)
