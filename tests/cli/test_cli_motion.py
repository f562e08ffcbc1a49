"""`casadi-ik follow` and `reach`: motions, read back by others; what cannot be is said."""

from __future__ import annotations

import copy
import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import POSTURE, Command
from made_up_hand import hand
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

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


def test_the_motion_is_written(run: Command, tmp_path: Path) -> None:
    robot, out = ik.load_robot("kuka_lwr_barrett"), tmp_path / "way.mcap"
    gif = tmp_path / "way.gif"
    words = ("reach", "cup", "--scene", "table", "--out", out, "--period", "0.02")
    done = run(*words, "--animation", gif)
    assert (done.exit, done.err) == (0, "")
    with Image.open(gif) as picture:
        assert (picture.format, picture.n_frames > 2) == ("GIF", True)
        first, last = (
            (picture.seek(i), picture.convert("RGB"))[1] for i in (0, picture.n_frames - 1)
        )
        moved = np.asarray(last).astype(int) - np.asarray(first).astype(int)
    assert np.abs(moved).mean() > 1
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


def test_a_grasp_that_is_too_far(run: Command, tmp_path: Path) -> None:
    out = tmp_path / "way.npz"
    done = run("reach", "cup", "--object-pose", "5", "0", "0", "0", "0", "0", "--out", out)
    assert done.exit == 1
    assert done.out.startswith("NOT SOLVED")
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("cup", "--q0", "1", "2"), "--q0: found 2 numbers, expected 14"),
        (("teacup",), "no shipped grasp is called 'teacup'"),
        (("cup", "--scene", "nowhere"), "--scene: no shipped scene is called 'nowhere'"),
    ],
)
def test_bad_input_of_reach(
    run: Command, words: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    name, *more = words
    done = run("reach", name, "--out", tmp_path / "way.npz", *more)
    assert done.exit == 2
    assert says in done.error


@pytest.fixture(scope="module")
def ranked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Answers of `choose`, on a table."""
    folder = tmp_path_factory.mktemp("ranked")
    contacts = {
        name: {"point": contact.point.tolist(), "normal": contact.normal.tolist()}
        for name, contact in ik.load_grasp("cup").contacts.items()
    }
    data = {"candidates": [{"contacts": contacts}]}
    (folder / "candidates.yaml").write_text(yaml.safe_dump(data))
    words = ["choose", folder / "candidates.yaml", "--robot", "kuka_lwr_barrett", "--scene"]
    words += ["table", "--limit", "3", "--per-candidate", "3", "--out", folder / "ranked.json"]
    command = [sys.executable, "-m", "casadi_ik", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True)
    return folder / "ranked.json"


def test_what_was_chosen_is_reached(run: Command, ranked: Path, tmp_path: Path) -> None:
    """The first of several, or another, by the very posture; with the object in the hand."""
    out, entries = tmp_path / "way.npz", json.loads(ranked.read_text())["ranked"]
    words = ("reach", ranked, "--scene", "table", "--out", out)
    reached = []
    for rank, entry in enumerate(entries, 1):
        done = run(*words, *(("--rank", str(rank)) if rank > 1 else ()))
        assert (done.exit, done.err) in ((0, ""), (1, ""))
        if done.exit == 0:
            np.testing.assert_array_equal(np.load(out)["q"][-1], entry["solution"]["q"])
            reached.append((rank, entry))
    assert reached
    rank, entry = reached[0]
    more = ("--direction", "0", "0", "-1", "--lift", "0.05", "--retreat", "0.05")
    done = run(*words, "--rank", str(rank), *more)
    assert (done.exit, done.err) == (0, "")
    found = np.load(out)
    assert set(found["part"]) == {"going", "coming", "closing", "lifting", "retreating"}
    assert (found["q"] == entry["solution"]["q"]).all(axis=1).any()


def test_what_ranked_files_are_refused(run: Command, ranked: Path, tmp_path: Path) -> None:
    whole, out = json.loads(ranked.read_text()), tmp_path / "way.npz"
    path = tmp_path / "other.json"

    def says(change: Callable[[dict[str, Any]], object], *words: str) -> str:
        data = copy.deepcopy(whole)
        change(data)
        path.write_text(json.dumps(data))
        done = run("reach", path, "--out", out, *words)
        assert done.exit == 2
        assert not out.exists()
        return done.error

    def first(data: dict[str, Any]) -> dict[str, Any]:
        return data["ranked"][0]

    assert "ranked: found none" in says(lambda data: data["ranked"].clear())
    assert "ranked[0].grasp: missing" in says(lambda data: first(data).pop("grasp"))
    wrong = says(lambda data: first(data)["grasp"]["contacts"]["thumb"].pop("point"))
    assert "ranked[0].grasp.contacts.thumb.point: missing" in wrong
    assert "q: found shape (3,)" in says(lambda data: first(data)["solution"].update(q=[1, 2, 3]))
    assert "Expected `float`" in says(lambda data: first(data)["solution"].update(q=["a"] * 14))
    assert "has 3 answers" in says(lambda data: None, "--rank", "4")
    assert "--object-pose" in says(lambda data: None, "--object-pose", "0 0 0 0 0 0")
    assert "--direction: found 1 numbers, expected 3" in says(lambda data: None, "--direction", "1")
    done = run("reach", "cup", "--rank", "2", "--out", out)
    assert (done.exit, "--rank: expected it with" in done.error) == (2, True)
