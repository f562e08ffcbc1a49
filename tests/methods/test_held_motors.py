"""Motors that are held: wherever they stand within their limits, no reachable target is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from toy_robots import copy_shipped_robot, grasp_of

import casadi_ik as ik


def all_solved(
    robot: ik.ArmHand, fixed: dict[str, float], prefer: str = "limits", k: int = 12
) -> bool:
    """Whether k targets that the robot reaches with motors held are solved, and keep them there."""
    q = robot.random(np.random.default_rng(17), k)
    columns = [robot.actuators.index(name) for name in fixed]
    q[:, columns] = list(fixed.values())
    solver = ik.Solver(robot, compiled=False)
    batch = solver.solve_batch(*robot.contacts(q), q0=robot.home, prefer=prefer, fixed=fixed)
    np.testing.assert_array_equal(batch.q[:, columns], q[:, columns])
    return bool(batch.success.all())


@pytest.mark.parametrize("prefer", ["limits", "q0"])
@pytest.mark.parametrize(
    ("name", "fixed"),
    [
        ("ur10e+robotiq_3f", {"ur10e_joint_1": 4.2, "ur10e_joint_6": -5.1}),
        ("puma560+jaco_3f", {"puma560_joint_4": -4.2}),
        ("xarm6+barrett_bh8_280", {"xarm6_joint_1": -4.2, "xarm6_joint_6": 5.1}),
        ("xarm7+trifinger", {"xarm7_joint_1": 4.2, "xarm7_joint_3": 4.2, "xarm7_joint_5": -5.1}),
    ],
)
def test_a_joint_may_be_held_in_another_turn(name, fixed, prefer):
    """A form of the arm gives each joint in the middle turn of its range."""
    assert all_solved(ik.load_robot(name), fixed, prefer)


@pytest.mark.parametrize("value", [np.pi, -np.pi])
def test_a_joint_may_be_held_where_two_turns_meet(value):
    robot = ik.load_robot("ur10e+robotiq_3f")
    assert all_solved(robot, {"ur10e_joint_1": value, "ur10e_joint_5": value / 2})


@pytest.mark.parametrize("compiled", [True, False])
def test_the_turn_it_is_held_in_costs_neither_alternatives_nor_free_answers(compiled):
    robot = ik.load_robot("ur10e+robotiq_3f")
    solver = ik.Solver(robot, compiled=compiled)
    free = ik.Solver(robot, scene=ik.load_scene("table"), compiled=compiled)
    q = robot.random(np.random.default_rng(1), 8)
    counts = []
    for turn in (0.0, 2 * np.pi):
        fixed = {robot.actuators[0]: turn - 2.0}
        q[:, 0] = turn - 2.0
        points, normals = robot.contacts(q)
        solved = free.solve_batch(points, normals, fixed=fixed).success
        alternatives = solver.solve_all(
            grasp_of(robot, points[0], normals[0]), limit=9, fixed=fixed
        )
        counts.append((len(alternatives), solved.tolist()))
    assert counts[0] == counts[1]
    assert counts[0][0] > 1


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_a_joint_of_an_arm_with_two_spheres_may_be_held_in_another_turn(tmp_path, prefer):
    path = copy_shipped_robot(tmp_path)
    arm = yaml.safe_load((tmp_path / "arm.yaml").read_text())
    for joint in arm["joints"]:
        if joint["name"][-1] in "17":
            joint["limits"] = ["-360 deg", "360 deg"]
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(arm))
    assert all_solved(ik.load_robot(path), {"lwr_joint_1": 4.2, "lwr_joint_7": -5.1}, prefer)


FIXED = ("fr3_joint_3", "fr3_joint_4", "trifinger_finger_2_0")
OTHERS_FIXED = ("fr3_joint_1", "fr3_joint_4", "trifinger_finger_1_0")
OF_THE_ARM = ("fr3_joint_1", "fr3_joint_4")


@pytest.mark.parametrize(
    ("names", "q"),
    [
        (
            FIXED,
            [
                *(1.223134, -0.000228, -0.383794, -2.444648, 2.592195, 2.932624, -2.377022),
                *(0.83858, 0.882637, -1.144192, 0.043121, 0.387828, -1.526174),
                *(-0.254952, 1.144506, -1.033636),
            ],
        ),
        (
            OTHERS_FIXED,
            [
                *(-2.230327, -0.323357, 2.518197, -0.977686, 1.282477, 1.782027, 2.46734),
                *(0.658108, 1.06685, -1.471483, 0.719918, 0.597569, -1.089626),
                *(0.223291, 0.098716, -0.228548),
            ],
        ),
        (
            OF_THE_ARM,
            [
                *(-2.090603, -0.128606, 0.883355, -1.395061, 1.718212, 3.905984, 0.543886),
                *(0.416687, 0.965512, -0.019154, 0.334969, 1.051129, -0.369165),
                *(0.47602, 0.889617, -0.566708),
            ],
        ),
    ],
)
def test_several_motors_held(names, q):
    """No table holds the hand's postures, nor has the arm all motions of a palm: more rounds."""
    robot = ik.load_robot("fr3+trifinger")
    points, normals = robot.contacts(np.array([q]))
    fixed = {name: q[robot.actuators.index(name)] for name in names}
    batch = ik.Solver(robot).solve_batch(points, normals, fixed=fixed)
    assert batch.success.all()


@pytest.mark.parametrize("joints", [5, 3])
def test_short_arms_and_wrists_are_placed_at_once(tmp_path, joints):
    """They bring a palm where it is asked for by chance only: what is near is good enough."""
    robot = short_arm(tmp_path, joints)
    q = robot.random(np.random.default_rng(6), 25)
    for prefer in ("limits", "q0"):
        solver = ik.Solver(robot, compiled=False)
        batch = solver.solve_batch(*robot.contacts(q), q0=robot.home, prefer=prefer)
        assert batch.success.all()
        assert np.median(batch.phases["arm-placement"]) < 50


def short_arm(folder: Path, joints: int) -> ik.ArmHand:
    """The shipped arm-hand with the first joints of its arm."""
    path = copy_shipped_robot(folder)
    arm = yaml.safe_load((folder / "arm.yaml").read_text())
    arm["joints"] = arm["joints"][:joints]
    names = [joint["name"] for joint in arm["joints"]]
    arm["tip"] = {**arm["tip"], "link": arm["joints"][-1]["child"]}
    arm["home"] = {name: value for name, value in arm.get("home", {}).items() if name in names}
    del arm["collision"]
    (folder / "arm.yaml").write_text(yaml.safe_dump(arm))
    whole = yaml.safe_load(path.read_text())
    whole["home"] = {n: v for n, v in whole["home"].items() if n in names or n.startswith("bh")}
    path.write_text(yaml.safe_dump(whole))
    return ik.load_robot(path)
