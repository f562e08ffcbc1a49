"""Fingers that have nothing to touch are put where they are not in the way."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.problem.clearance import SceneCheck
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.alternatives.idle_fingers import IdleFingers


def test_only_motors_of_idle_fingers_move_and_only_for_more_room() -> None:
    robot = ik.load_robot("panda+shadow")
    rng, idle = np.random.default_rng(2), [robot.fingers.index(name) for name in ("ring", "little")]
    q = robot.random(rng, 120)
    points, normals = robot.contacts(q)
    points[:90, idle] = normals[:90, idle] = np.nan  # of the last thirty no finger is idle
    problems = Problems(points, normals, ik.Tolerance(), True)
    around = SceneCheck(robot, ik.Scene({})).around(problems).held
    owner = np.arange(120)
    moved = IdleFingers(robot, problems).aside(q, owner, around)
    before, after = around.check(q).room, around.check(moved).room
    assert (after >= before).all()
    changed = (moved != q).any(axis=1)
    assert changed[:90].sum() > 5
    assert (before[changed] < 0).all()
    assert not changed[90:].any()
    assert (after[changed] > before[changed]).all()
    still, _ = robot.contacts(moved)
    np.testing.assert_array_equal(
        np.delete(still, idle, axis=1), np.delete(robot.contacts(q)[0], idle, axis=1)
    )


def test_fixed_motors_stay() -> None:
    robot = ik.load_robot("panda+shadow")
    q = robot.random(np.random.default_rng(2), 20)
    points, normals = robot.contacts(q)
    points[:, 1:] = normals[:, 1:] = np.nan
    motor = robot.actuators.index("shadow_ffj3")
    fixed = np.full(len(robot.actuators), np.nan)
    fixed[motor] = 0.0
    problems = Problems(points, normals, ik.Tolerance(), True, fixed=fixed)
    around = SceneCheck(robot, ik.Scene({})).around(problems).held
    moved = IdleFingers(robot, problems).aside(q, np.arange(20), around)
    assert (moved != q).any()
    np.testing.assert_array_equal(moved[:, motor], q[:, motor])
