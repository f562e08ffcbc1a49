"""`casadi-ik reach`: a grasp in, a timed motion out; what cannot be reached is said."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import Command
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

import casadi_ik as ik
from casadi_ik.cli.main import main
from casadi_ik.grasps.load import grasp_data
from casadi_ik.motion.motion import Motion
from casadi_ik.views import draw_motion


def test_the_motion_is_written(run: Command, tmp_path: Path) -> None:
    robot, out = ik.load_robot("kuka_lwr_barrett"), tmp_path / "way.mcap"
    done = run("reach", "cup", "--scene", "table", "--out", out, "--period", "0.02")
    assert (done.exit, done.err) == (0, "")
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
def test_bad_input(run: Command, words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    name, *more = words
    done = run("reach", name, "--out", tmp_path / "way.npz", *more)
    assert done.exit == 2
    assert says in done.error


def test_moving_pictures(tmp_path: Path) -> None:
    """As many pictures as the time asks for, the last one the grasp."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    end = ik.Solver(robot).solve(grasp).q
    q = np.stack([robot.home, end])
    motion = Motion(robot, np.array([0.0, 0.1]), q, 0 * q, 0 * q)
    assert draw_motion(motion, grasp, tmp_path / "way.gif") == 2
    with Image.open(tmp_path / "way.gif") as picture:
        assert (picture.format, picture.n_frames) == ("GIF", 2)
        shown = []
        for i in range(2):
            picture.seek(i)
            shown.append(np.asarray(picture.convert("RGB")).astype(int))
    assert np.abs(shown[1] - shown[0]).mean() > 5
    assert [path.name for path in tmp_path.iterdir()] == ["way.gif"]


@pytest.fixture(scope="module")
def ranked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Answers of `choose`, on a table."""
    folder = tmp_path_factory.mktemp("ranked")
    data = {"candidates": [grasp_data(ik.load_grasp("cup"))]}
    (folder / "candidates.yaml").write_text(yaml.safe_dump(data))
    words = ["choose", folder / "candidates.yaml", "--robot", "kuka_lwr_barrett", "--scene"]
    words += ["table", "--limit", "3", "--per-candidate", "3", "--out", folder / "ranked.json"]
    assert main([str(word) for word in words]) == 0
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
