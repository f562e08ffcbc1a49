"""`casadi-ik follow`: keypoints or contacts in, a motion out; read back by others."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import POSTURE, Command
from made_up_hand import hand
from mcap_ros2.reader import read_ros2_messages

import casadi_ik as ik

RETARGET = "fingers: {thumb: 4, finger_2: 8, finger_3: 12}\nlow_pass: 0.5\n"


@pytest.fixture
def path(robot: ik.ArmHand) -> Any:
    """(30, n) a slow motion."""
    return POSTURE + 0.1 * np.sin(np.linspace(0, np.pi, 30))[:, None] * np.sin(np.arange(14))


def write(folder: Path, **arrays: Any) -> Path:
    file = folder / "frames.npz"
    np.savez(file, **arrays)
    return file


def test_contacts_are_followed_and_others_read_the_motion(
    run: Command, tmp_path: Path, robot: ik.ArmHand, path: Any
) -> None:
    points, normals = robot.contacts(path)
    frames = write(tmp_path, points=points, normals=normals, times=0.1 * np.arange(30))
    words = ("follow", frames, "--robot", "kuka_lwr_barrett", "--period", 0.01)
    found = {}
    for suffix in ("mcap", "npz", "csv"):
        out = tmp_path / f"motion.{suffix}"
        done = run(*words, "--out", out)
        assert (done.exit, done.err) == (0, "")
        assert "following" in done.out
        found[suffix] = out
    arrays = np.load(found["npz"])
    assert set(arrays["status"][1:]) == {"following"}
    assert arrays["actuators"].tolist() == list(robot.actuators)
    assert arrays["q"].shape == (len(arrays["times"]), 14)
    velocity = np.diff(arrays["q"], axis=0) / 0.01
    np.testing.assert_allclose(arrays["velocity"][1:], velocity, atol=1e-12)
    with found["csv"].open() as stream:
        rows = list(csv.reader(stream))
    assert rows[0][:3] == ["time", "lwr_joint_1", "lwr_joint_2"]
    np.testing.assert_array_equal(np.array(rows[1:], dtype=float)[:, 1:15], arrays["q"])
    topics: dict[str, list[Any]] = {}
    for message in read_ros2_messages(str(found["mcap"])):
        topics.setdefault(message.channel.topic, []).append(message.ros_msg)
    (trajectory,) = topics["/joint_trajectory"]
    assert trajectory.joint_names == list(robot.actuators)
    assert len(trajectory.points) == len(topics["/joint_states"]) == len(arrays["q"])
    for i in (0, 7, -1):
        point, state = trajectory.points[i], topics["/joint_states"][i]
        np.testing.assert_array_equal(point.positions, arrays["q"][i])
        np.testing.assert_array_equal(point.velocities, arrays["velocity"][i])
        np.testing.assert_array_equal(point.accelerations, arrays["acceleration"][i])
        seconds = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        assert seconds == pytest.approx(arrays["times"][i])
        expected = robot.joints(arrays["q"][i])
        assert dict(zip(state.name, state.position, strict=True)) == pytest.approx(expected)
    assert "<robot" in topics["/robot_description"][0].data


def test_keypoints_and_a_bad_frame(run: Command, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    keypoints = np.tile(rng.normal(size=(21, 3)), (40, 1, 1))
    keypoints[20] = np.nan
    keypoints[24, 0] = np.inf
    frames = write(tmp_path, keypoints=keypoints)
    (tmp_path / "hand.yaml").write_text("robot: kuka_lwr_barrett\n" + RETARGET)
    out = tmp_path / "motion.npz"
    done = run("follow", frames, "--retarget", tmp_path / "hand.yaml", "--out", out)
    assert done.exit == 1
    assert done.err == ""
    assert "holding" in done.out
    q = np.load(out)["q"]
    assert np.isfinite(q).all()


def test_world_landmarks_are_said_and_the_period_is_not_smoothed(
    run: Command, tmp_path: Path, robot: ik.ArmHand
) -> None:
    frame = hand(0.5, np.zeros(3))
    way = np.linspace(0.5, 0.9, 31)
    seen = np.stack([hand(bend, np.zeros(3)) - frame.mean(axis=0) for bend in way])
    slow = RETARGET.replace("0.5", "0.05")
    (tmp_path / "hand.yaml").write_text("robot: kuka_lwr_barrett\n" + slow)
    ends = []
    for period in (0.002, 0.02):
        frames, out = write(tmp_path, keypoints=seen), tmp_path / "motion.npz"
        words = ("--retarget", tmp_path / "hand.yaml", "--period", period, "--out", out)
        done = run("follow", frames, *words)
        assert done.err == ""
        assert "MediaPipe's world landmarks" in " ".join(done.out.split())
        found = np.load(out)
        ends.append(robot.contacts(found["q"][np.searchsorted(found["times"], 0.9)])[0])
    # As smooth at a fast cycle as at a slow one.
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 2e-3


def test_image_landmarks_are_one_line(run: Command, tmp_path: Path) -> None:
    seen = np.tile(3.0 * hand(0.5, np.zeros(3)) + [0.3, 0.5, 1e-7], (3, 1, 1))
    frames, out = write(tmp_path, keypoints=seen), tmp_path / "motion.mcap"
    done = run("follow", frames, "--robot", "kuka_lwr_barrett", "--out", out)
    assert "frames.npz: keypoints: found places in a picture" in done.error
    assert "take its world landmarks" in done.error
    assert sorted(tmp_path.iterdir()) == [frames]


@pytest.mark.parametrize(
    ("arrays", "words", "message"),
    [
        ({"keypoints": np.zeros((4, 20, 3))}, (), "keypoints: found shape (4, 20, 3), expected"),
        ({"other": np.zeros(3)}, (), "expected keypoints (k, 21, 3) or points (k, 3, 3); found"),
        ({"points": np.zeros((0, 3, 3))}, (), "points: found shape (0, 3, 3), expected"),
        ({"points": np.full((2, 3, 3), "a")}, (), "points: found values of type"),
        ({"points": np.full((2, 3, 3), 300.0)}, (), "expected at most 5 m (numbers in mm?)"),
        ({"keypoints": 80.0 * np.eye(21)[None, :, :3]}, (), "m from the middle of the hand"),
        (
            {"points": np.zeros((2, 3, 3)), "times": [1.0, 0.0]},
            (),
            "times: expected 2 growing numbers",
        ),
        ({"points": np.zeros((2, 3, 3)), "extra": [1.0]}, (), "extra: unknown, expected"),
        ({"keypoints": np.zeros((2, 21, 3))}, ("--period", "0"), "--period: found '0'"),
        ({"keypoints": np.zeros((2, 21, 3))}, ("--retarget", "no.yaml"), "no.yaml: cannot be read"),
        ({"keypoints": np.zeros((2, 21, 3))}, ("--robot", "nobody"), "--robot: "),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    run: Command, tmp_path: Path, arrays: Any, words: Any, message: str
) -> None:
    frames = write(tmp_path, **arrays)
    out = tmp_path / "motion.mcap"
    error = run("follow", frames, "--robot", "kuka_lwr_barrett", "--out", out, *words).error
    assert message in error
    assert sorted(tmp_path.iterdir()) == [frames]


def test_files_that_are_none(run: Command, tmp_path: Path) -> None:
    torn = tmp_path / "torn.npz"
    torn.write_bytes(b"PK")
    words = ("--robot", "kuka_lwr_barrett", "--out", tmp_path / "motion.mcap")
    assert "torn.npz: not an npz file" in run("follow", torn, *words).error
    assert "cannot be read" in run("follow", tmp_path / "nothing.npz", *words).error
    error = run("follow", torn, *words[:2], "--out", tmp_path / "motion.txt").error
    assert "expected a name ending in .mcap, .npz, .csv" in error
    assert "--robot" in run("follow", torn, *words[2:]).error
