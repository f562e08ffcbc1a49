"""Frames in which the tracker has lost the hand are held, in every loop and in recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import main
from made_up_hand import hand

import casadi_ik as ik

HOLDING = ik.motion.FollowStatus.HOLDING
KEYS = {"thumb": 4, "finger_2": 8, "finger_3": 12}


def keypoints(i: int = 0) -> np.ndarray:
    """Return keypoints (21, 3) of a hand at a distance of one metre that moves slowly."""
    return hand(0.4, np.array([0.6, -0.3 + 0.002 * i, 0.9]))


def with_key(key: int, place: np.ndarray) -> np.ndarray:
    """Return keypoints (21, 3) of the same hand with one keypoint elsewhere."""
    frame = keypoints()
    frame[key] = place
    return frame


LOST_FRAMES = {
    "NaN": np.full((21, 3), np.nan),
    "zeros": np.zeros((21, 3)),
    "minus one": -np.ones((21, 3)),
    "one place": np.tile([0.3, 0.2, 0.1], (21, 1)),
    "an identity": np.eye(21, 3),
    "infinity": np.full((21, 3), np.inf),
    "a coordinate of a tip is NaN": with_key(4, np.array([0.6, np.nan, 0.9])),
    "a tip at zero": with_key(8, np.zeros(3)),
    "a tip at minus one": with_key(4, -np.ones(3)),
    "a wrist at zero": with_key(0, np.zeros(3)),
    "two tips in one place": with_key(8, keypoints()[12]),
    "a line": np.outer(np.arange(21.0), [0.01, 0.02, 0.0]),
}
ODD = {
    "a tip half a metre away": with_key(12, keypoints()[12] + [0.3, 0.4, 0.0]),
    "a hand that jumps": keypoints() + np.array([1.0, 0.0, 0.0]),
}
"""Faults that only a comparison with other frames shows."""


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("retarget") / "hand.yaml"
    path.write_text(f"fingers: {KEYS}\n".replace("'", ""))
    return ik.motion.load_retarget(path)


@pytest.fixture(scope="module")
def solver(robot):
    return ik.Solver(robot)


@pytest.mark.parametrize("name", LOST_FRAMES)
@pytest.mark.parametrize("first", [True, False])
def test_lost_hand_is_held(robot, solver, config, name, first):
    """Valid frames give the same targets with and without the lost one."""
    retargeter, plain = (ik.motion.Retargeter(config, robot) for _ in range(2))
    follower = solver.follow(robot.home, period=1 / 30)
    if not first:
        retargeter(keypoints())
        plain(keypoints())
    target = retargeter(LOST_FRAMES[name])
    assert target.reason
    assert target.palm is None
    follower(target.points, palm=target.palm)
    assert follower.state.status is HOLDING
    for i in range(1, 4):
        good, expected = retargeter(keypoints(i)), plain(keypoints(i))
        assert not good.reason
        np.testing.assert_array_equal(good.points, expected.points)
        follower(good.points, palm=good.palm)
        assert follower.state.status is not HOLDING


@pytest.mark.parametrize("name", ODD)
def test_outlier_frames_are_held(robot, config, name):
    retargeter = ik.motion.Retargeter(config, robot)
    for i in range(3):
        assert not retargeter(keypoints(i)).reason
    for _ in range(3):
        assert retargeter(ODD[name], elapsed=0.005).reason
    assert not retargeter(keypoints(3)).reason


def test_hand_that_reappears_elsewhere_is_followed(robot, config):
    retargeter = ik.motion.Retargeter(config, robot)
    retargeter(keypoints())
    accepted = [not retargeter(keypoints(i) + np.array([1.0, 0.0, 0.0])).reason for i in range(8)]
    assert not accepted[0]
    assert accepted[-1]


def test_one_lost_hand_of_two(config):
    g1 = ik.load_robot("g1+dex3")
    models = Path(__file__).parents[2] / "models" / "keypoints"
    arrays = np.load(models / "two_hands_box.npz")
    frames = {side: arrays[f"keypoints_{side}"].astype(float) for side in ("left", "right")}
    retargeter = ik.motion.Retargeter(
        ik.motion.load_retarget(models / "two_hands_g1.yaml"), g1, g1.home
    )
    retargeter({side: rows[0] for side, rows in frames.items()})
    target = retargeter({"left": frames["left"][1], "right": np.zeros((26, 3))})
    assert list(target.palm) == ["left"]
    assert target.reason.startswith("right: ")


PALMS = {
    "NaN": np.full((4, 4), np.nan),
    "zeros": np.zeros((4, 4)),
    "minus one": -np.ones((4, 4)),
    "identity": np.eye(4),
    "stretched": np.diag([1.0, 1.0, 1.1, 1.0]),
}


@pytest.mark.parametrize("name", PALMS)
def test_a_lost_palm_is_held_by_a_follower(robot, solver, name):
    follower = solver.follow(robot.home, period=0.01)
    points, normals = robot.contacts(robot.home)
    for target in ((points, normals), (points, None), (ik.load_grasp("cup"), None)):
        follower(*target, palm=PALMS[name])
        assert follower.state.status is HOLDING
        assert "palm" in follower.state.reason
    follower(points, normals, palm=robot.palm(robot.home))
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING


@pytest.mark.parametrize("number", [0.0, -1.0])
def test_lost_contacts_are_held_by_a_follower(robot, solver, number):
    follower = solver.follow(robot.home, period=0.01)
    follower(np.full((3, 3), number), np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert follower.state.status is HOLDING
    np.testing.assert_allclose(follower.state.q, robot.home)


def test_a_recording_with_lost_frames_is_followed(robot, tmp_path, capsys):
    """Frames on both sides of a gap are not blended with it."""
    frames = np.array([keypoints(i) for i in range(30)])
    for i, lost_frame in enumerate((*LOST_FRAMES.values(), *ODD.values())):
        frames[2 * i + (i > 0)] = lost_frame
    path, out = tmp_path / "frames.npz", tmp_path / "motion.npz"
    np.savez(path, keypoints=frames)
    words = ["follow", path, "--robot", "kuka_lwr_barrett", "--period", "0.01", "--out", out]
    assert main([str(word) for word in words]) == 1
    assert f"{len(LOST_FRAMES) + len(ODD)} of 30" in " ".join(capsys.readouterr().out.split())
    motion = np.load(out)
    assert {"holding"} < set(motion["status"][1:])
    # The hand moves by 2 mm per frame, and no part of the robot moves farther than that requires.
    tips = robot.contacts(motion["q"])[0]
    assert np.linalg.norm(tips[-1] - tips[0], axis=1).max() < 0.3


def test_a_recording_of_contacts_with_lost_frames_is_followed(robot, tmp_path):
    points, normals = (np.repeat(rows[None], 20, axis=0) for rows in robot.contacts(robot.home))
    points[[0, 7]], points[12] = 0.0, -1.0
    path, out = tmp_path / "frames.npz", tmp_path / "motion.npz"
    np.savez(path, points=points, normals=normals)
    words = ["follow", path, "--robot", "kuka_lwr_barrett", "--period", "0.01", "--out", out]
    assert main([str(word) for word in words]) == 1
    motion = np.load(out)
    assert set(motion["status"][1:]) == {"following", "holding"}
    assert np.abs(np.diff(motion["q"], axis=0)).max() < 1e-3
