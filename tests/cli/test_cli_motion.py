"""`casadi-ik follow` and `reach`: motions that other readers understand, and refused input."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import POSTURE, Command
from made_up_hand import hand
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

import casadi_ik as ik

RETARGET = "fingers: {thumb: 4, finger_2: 8, finger_3: 12}\nlow_pass: 0.5\n"


@pytest.fixture
def path(robot: ik.ArmHand) -> Any:
    """Slow motion (30, n)."""
    return POSTURE + 0.1 * np.sin(np.linspace(0, np.pi, 30))[:, None] * np.sin(np.arange(14))


def write(folder: Path, **arrays: Any) -> Path:
    file = folder / "frames.npz"
    np.savez(file, **arrays)
    return file


def test_contacts_are_followed_and_the_motion_is_readable(
    run: Command, tmp_path: Path, robot: ik.ArmHand, path: Any
) -> None:
    points, normals = robot.contacts(path)
    frames = write(tmp_path, points=points, normals=normals, times=0.1 * np.arange(30))
    words = ("follow", frames, "--robot", "kuka_lwr_barrett", "--period", 0.01)
    motions = {}
    for suffix in ("mcap", "npz", "csv"):
        out = tmp_path / f"motion.{suffix}"
        done = run(*words, "--out", out).fine()
        assert "following" in done.out
        motions[suffix] = out
    arrays = np.load(motions["npz"])
    assert set(arrays["status"][1:]) == {"following"}
    assert arrays["actuators"].tolist() == list(robot.actuators)
    assert arrays["q"].shape == (len(arrays["times"]), 14)
    velocity = np.diff(arrays["q"], axis=0) / 0.01
    np.testing.assert_allclose(arrays["velocity"][1:], velocity, atol=1e-12)
    with motions["csv"].open() as stream:
        rows = list(csv.reader(stream))
    assert rows[0][:3] == ["time", "lwr_joint_1", "lwr_joint_2"]
    np.testing.assert_array_equal(np.array(rows[1:], dtype=float)[:, 1:15], arrays["q"])
    topics: dict[str, list[Any]] = {}
    for message in read_ros2_messages(str(motions["mcap"])):
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


def test_world_landmarks_are_reported_and_period_is_not_smoothed(
    run: Command, tmp_path: Path, robot: ik.ArmHand
) -> None:
    frame = hand(0.5, np.zeros(3))
    bends = np.linspace(0.5, 0.9, 31)
    seen_frames = np.stack([hand(bend, np.zeros(3)) - frame.mean(axis=0) for bend in bends])
    slow = RETARGET.replace("0.5", "0.05")
    (tmp_path / "hand.yaml").write_text("robot: kuka_lwr_barrett\n" + slow)
    ends = []
    for period in (0.002, 0.02):
        frames, out = write(tmp_path, keypoints=seen_frames), tmp_path / "motion.npz"
        words = ("--retarget", tmp_path / "hand.yaml", "--period", period, "--out", out)
        done = run("follow", frames, *words)
        assert done.err == ""
        assert "MediaPipe's world landmarks" in " ".join(done.out.split())
        motion = np.load(out)
        ends.append(robot.contacts(motion["q"][np.searchsorted(motion["times"], 0.9)])[0])
    # The smoothing does not depend on the cycle time.
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 2e-3


def test_image_landmarks_are_refused(run: Command, tmp_path: Path) -> None:
    image_frames = np.tile(3.0 * hand(0.5, np.zeros(3)) + [0.3, 0.5, 1e-7], (3, 1, 1))
    frames, out = write(tmp_path, keypoints=image_frames), tmp_path / "motion.mcap"
    done = run("follow", frames, "--robot", "kuka_lwr_barrett", "--out", out)
    assert "frames.npz: keypoints: " in done.error
    assert "world landmarks" in done.error
    assert sorted(tmp_path.iterdir()) == [frames]


@pytest.mark.slow
def test_the_motion_is_written(run: Command, tmp_path: Path) -> None:
    robot, out = ik.load_robot("kuka_lwr_barrett"), tmp_path / "way.mcap"
    gif = tmp_path / "way.gif"
    words = ("reach", "cup", "--scene", "table", "--out", out, "--period", "0.02")
    done = run(*words, "--animation", gif).fine()
    with Image.open(gif) as picture:
        assert (picture.format, picture.n_frames > 2) == ("GIF", True)
        first, last = (
            (picture.seek(i), picture.convert("RGB"))[1] for i in (0, picture.n_frames - 1)
        )
        steps = np.asarray(last).astype(int) - np.asarray(first).astype(int)
    assert np.abs(steps).mean() > 1
    assert done.out.startswith("REACHED")
    assert "going" in done.out
    (trajectory,) = [
        message.ros_msg for message in read_ros2_messages(out, topics=["/joint_trajectory"])
    ]
    assert trajectory.joint_names == list(robot.actuators)
    first, last = (np.array(trajectory.points[i].positions) for i in (0, -1))
    assert first == pytest.approx(robot.home)
    grasp = ik.load_grasp("cup")
    position, angle = robot.errors(last, *grasp.arrays(robot.fingers))
    assert position.max() <= 5e-3
    assert angle.max() <= np.radians(3)


def test_distant_grasp_has_no_motion(run: Command, tmp_path: Path) -> None:
    out = tmp_path / "way.npz"
    done = run("reach", "cup", "--object-pose", "5", "0", "0", "0", "0", "0", "--out", out)
    assert done.exit == 1
    assert done.out.startswith("NOT SOLVED")
    assert not out.exists()


def test_chosen_grasp_is_reached(run: Command, ranked: Path, tmp_path: Path) -> None:
    """Each of several grasps is reached in its own configuration, with the object in hand."""
    out, entries = tmp_path / "way.npz", json.loads(ranked.read_text())["ranked"]
    words = ("reach", ranked, "--scene", "table", "--out", out)
    distances = []
    for rank, entry in enumerate(entries, 1):
        done = run(*words, *(("--rank", str(rank)) if rank > 1 else ()))
        assert (done.exit, done.err) in ((0, ""), (1, ""))
        if done.exit == 0:
            np.testing.assert_array_equal(np.load(out)["q"][-1], entry["solution"]["q"])
            distances.append((rank, entry))
    assert distances
    rank, entry = distances[0]
    path_options = ("--direction", "0", "0", "-1", "--lift", "0.05", "--retreat", "0.05")
    done = run(*words, "--rank", str(rank), *path_options).fine()
    motion = np.load(out)
    assert set(motion["part"]) == {"going", "coming", "closing", "lifting", "retreating"}
    assert (motion["q"] == entry["solution"]["q"]).all(axis=1).any()
