"""Times in other units than seconds are refused with their likely unit."""

from __future__ import annotations

import numpy as np
import pytest
from commands import main
from made_up_hand import hand

import casadi_ik as ik

UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def follow(folder, capsys, **arrays):
    """Return exit code and errors of following a recording."""
    path = folder / "frames.npz"
    np.savez(path, **arrays)
    words = ["follow", path, "--robot", "kuka_lwr_barrett", "--period", "0.05"]
    code = main([str(word) for word in (*words, "--out", folder / "m.npz")])
    return code, capsys.readouterr().err


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("rate", [20.0, 60.0, 200.0])
def test_times_in_other_units_are_refused(robot, tmp_path, capsys, unit, rate):
    times = 1e6 + UNITS[unit] * np.arange(30) / rate
    keypoints = np.tile(hand(0.3, np.array([0.5, 0.0, 0.5])), (30, 1, 1))
    points = np.tile(robot.contacts(robot.home)[0], (30, 1, 1))
    for arrays in ({"keypoints": keypoints}, {"points": points}):
        code, error = follow(tmp_path, capsys, times=times, **arrays)
        assert code == 2
        assert unit in error


def test_slow_waypoints_in_seconds_are_followed(robot, tmp_path, capsys):
    points = np.tile(robot.contacts(robot.home)[0], (3, 1, 1))
    code, error = follow(tmp_path, capsys, points=points, times=[0.0, 2.0, 4.0])
    assert (code, error) == (0, "")


def test_a_motion_of_too_many_cycles_is_refused_with_their_number(robot, tmp_path, capsys):
    pytest.importorskip("toppra")
    with pytest.raises(ik.errors.InputError, match=r"e\+\d+ cycles"):
        ik.Solver(robot).reach(ik.load_grasp("cup"), period=1e-9)
    points = np.tile(robot.contacts(robot.home)[0], (3, 1, 1))
    np.savez(tmp_path / "long.npz", points=points, times=[0.0, 4.0, 8.0])
    words = ["follow", tmp_path / "long.npz", "--robot", "kuka_lwr_barrett", "--period", "1e-9"]
    assert main([str(word) for word in (*words, "--out", tmp_path / "m.npz")]) == 2
    assert "8e+09 cycles" in capsys.readouterr().err
