"""The pinches shipped for hands of the catalogue, verified from the files alone, and solved.

And of every shipped grasp: on a table there is an answer that touches nothing.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import grasps

HANDS = ("allegro_right", "leap", "shadow", "robotiq_3f", "panda_hand", "robotiq_2f85")
NAMES = [name for hand in HANDS for name in ik.shipped_grasps(f"panda+{hand}")]


@cache
def robot_of(name: str) -> ik.ArmHand:
    return ik.load_robot(name)


@cache
def solver_of(name: str) -> ik.Solver:
    """In the virtual machine: a dozen solves are not worth a compiler."""
    return ik.Solver(robot_of(name), tolerance=ik.Tolerance(1e-6, 1e-6), compiled=False)


def placed(grasp: ik.Grasp) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The fingers that touch, and their points and normals in the object's frame."""
    assert grasp.object_pose is not None
    fingers = tuple(grasp.contacts)
    points, normals = grasp.arrays(fingers)
    rotation, origin = grasp.object_pose[:3, :3], grasp.object_pose[:3, 3]
    return fingers, (points - origin) @ rotation, normals @ rotation


@pytest.mark.parametrize("hand", HANDS)
def test_every_hand_has_grasps(hand: str) -> None:
    names = ik.shipped_grasps(f"panda+{hand}")
    assert len(names) >= 3
    assert len({ik.load_grasp(name).object for name in names}) == len(names)


@pytest.mark.parametrize("name", NAMES)
def test_contacts_are_on_the_surface_and_face_into_it(name: str) -> None:
    grasp = ik.load_grasp(name)
    item = grasps.load_object(grasp.object)
    fingers, points, normals = placed(grasp)
    assert fingers[0] == robot_of(grasp.robot).thumb
    assert np.abs(item.signed_distance(points)).max() < 1e-9
    np.testing.assert_allclose(normals, -item.normal(points), atol=1e-9)
    # The thumb presses against the others; three fingers around a ball are 120 degrees apart.
    assert (normals[1:] @ normals[0] < -0.35).all()


@pytest.mark.parametrize("name", NAMES)
def test_posture_and_object_keep_clear_of_limits_and_table(name: str) -> None:
    grasp = ik.load_grasp(name)
    robot, q = robot_of(grasp.robot), robot_of(grasp.robot).home.copy()
    for actuator, value in grasp.posture.items():
        q[robot.actuators.index(actuator)] = value
    assert ((q >= robot.lower) & (q <= robot.upper)).all()
    assert grasp.object_pose is not None
    vertices = grasps.load_object(grasp.object).mesh(32)[0] @ grasp.object_pose[:3, :3].T
    assert (vertices[:, 2] + grasp.object_pose[2, 3]).min() > 0.05


@pytest.mark.parametrize("name", NAMES)
def test_solved_exactly(name: str) -> None:
    grasp = ik.load_grasp(name)
    solution = solver_of(grasp.robot).solve(grasp)
    assert solution.success, solution.status


@cache
def solver_on_a_table(name: str) -> ik.Solver:
    return ik.Solver(robot_of(name), scene=ik.load_scene("table"), compiled=False)


@pytest.mark.parametrize("name", sorted(ik.shipped_names("grasps")))
def test_nothing_touches_but_the_pads(name: str) -> None:
    """On a table there is an answer that is free: the hand holds the object and hits nothing."""
    grasp = ik.load_grasp(name)
    solution = solver_on_a_table(grasp.robot).solve(grasp, diagnose=False)
    assert solution.success, solution.collision


def test_the_script_makes_the_shipped_file(tmp_path: Path) -> None:
    """To six digits: the optimiser may differ in the last ones from machine to machine."""
    script = Path(__file__).resolve().parents[2] / "tools" / "make_hand_grasps.py"
    command = [
        sys.executable,
        str(script),
        "--only",
        "robotiq_3f_mustard_bottle",
        "--starts",
        "20",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    made, shipped = (
        placed(ik.load_grasp(path))
        for path in (tmp_path / "robotiq_3f_mustard_bottle.yaml", "robotiq_3f_mustard_bottle")
    )
    np.testing.assert_allclose(made[2], shipped[2], atol=1e-5)
