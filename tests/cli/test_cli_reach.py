"""`casadi-ik reach`: a grasp in, a timed motion out; what cannot be reached is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import Command
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

import casadi_ik as ik
from casadi_ik.motion.motion import Motion
from casadi_ik.views.animation import draw_motion


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
