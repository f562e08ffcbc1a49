"""Contacts that leave the palm free: two opposed fingers, or one finger."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik

GRIPPERS = ["panda+panda_hand", "ur5e+robotiq_2f85", "widowx_250s+widowx_gripper"]


@cache
def robot_of(name: str) -> ik.ArmHand:
    return ik.load_robot(name)


@cache
def solver_of(name: str) -> ik.Solver:
    return ik.Solver(robot_of(name))


@pytest.mark.parametrize("name", GRIPPERS)
def test_palm_is_kept_where_contacts_leave_it_free(name):
    robot, solver = robot_of(name), solver_of(name)
    q = robot.random(np.random.default_rng(3), 60)
    hand = {robot.actuators[i]: q[:, i] for i in robot.description.hand_actuators}
    batch = solver.solve_palms(robot.palm(q), hand)
    assert batch.success.all()
    np.testing.assert_allclose(robot.palm(batch.q), robot.palm(q), atol=1e-6)
    posture = {motor: float(values[0]) for motor, values in hand.items()}
    palm_grasp = ik.Grasp(palm=robot.palm(q[0]), posture=posture)
    assert solver.solve(palm_grasp).palm.ok
    assert solver.choose([palm_grasp], limit=2).answered == 1


def test_unreachable_palm_is_diagnosed():
    robot, solver = robot_of("panda+panda_hand"), solver_of("panda+panda_hand")
    far_palm = robot.palm(robot.home)
    far_palm[0, 3] += 2.0
    solution = solver.solve(ik.Grasp(palm=far_palm, posture={"panda_finger_1": 0.02}))
    assert solution.status is ik.Status.UNREACHABLE
    assert solution.diagnosis.palm is not None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fingers", "count"),
    [("ur5e+robotiq_2f85", 2, 160), ("jaco2+panda_hand", 2, 480), ("puma560+jaco_3f", 1, 220)],
)
def test_free_palm_components_are_searched(name, fingers, count):
    """Targets 1, 5 and 6 of these reachable ones were once missed."""
    robot, solver = robot_of(name), solver_of(name)
    points, normals = robot.contacts(robot.random(np.random.default_rng(11), count))
    if fingers == 1:
        other_fingers = np.arange(len(robot.fingers)) != np.arange(count)[:, None] % len(
            robot.fingers
        )
        points[other_fingers] = normals[other_fingers] = np.nan
    assert solver.solve_batch(points, normals).success.all()
    plain_solver = ik.Solver(robot, compiled=False)
    assert plain_solver.solve_batch(points[-10:], normals[-10:]).success.all()


@pytest.mark.parametrize("name", GRIPPERS)
def test_missed_target_of_single_motor_hand_is_diagnosed(name):
    robot, solver = robot_of(name), solver_of(name)
    rng = np.random.default_rng(0)
    points, normals = robot.contacts(robot.random(rng, 20))
    points = points + 0.1 * rng.normal(size=(20, 1, 3))
    askew = normals + 0.05 * rng.normal(size=normals.shape)
    batch = solver.solve_batch(points, askew, diagnose=True)
    assert batch.success.any()
    assert not batch.success.all()
    for solved, diagnosis in zip(batch.success, batch.diagnoses, strict=True):
        assert solved == (diagnosis is None)


@pytest.mark.slow
def test_arm_with_a_tool():
    robot, solver = robot_of("panda+tool"), solver_of("panda+tool")
    q = robot.random(np.random.default_rng(0), 100)
    points, normals = robot.contacts(q)
    assert solver.solve_batch(points, normals).success.all()
    assert solver.solve_batch(points, np.full_like(normals, np.nan), q0=robot.home).success.all()
    frame = robot.contact_frames(q[0])[0]
    tip = ik.Contact.from_pose(frame)
    solution = solver.solve(ik.Grasp({"tip": tip}))
    np.testing.assert_allclose(robot.contact_frames(solution.q)[0], frame, atol=1e-2)
    assert len(solver.solve_all(ik.Grasp({"tip": tip}))) > 1
    far_solution = solver.solve(ik.Grasp({"tip": ik.Contact(tip.point + 3.0, tip.normal)}))
    assert far_solution.status is ik.Status.UNREACHABLE
    batch = solver.solve_batch(1.25 * points[:20], normals[:20], diagnose=True)
    assert [diagnosis is None for diagnosis in batch.diagnoses] == batch.success.tolist()


def test_chain_as_one_finger(tmp_path: Path) -> None:
    """A file of a single chain becomes a hand of one finger on a base."""
    file = tmp_path / "chain.urdf"
    file.write_text(ik.load_robot("puma560").urdf())
    description = tmp_path / "chain.yaml"
    description.write_text(
        f"name: chain\nhand:\n  file: {file.name}\n  palm: {{link: puma560_base}}\n"
        "thumb: thumb\nfingers:\n  thumb: {link: flange_contact, normal: [0, 1, 0]}\n"
    )
    robot = ik.load_robot(description)
    points, normals = robot.contacts(robot.random(np.random.default_rng(3), 1000))
    assert ik.Solver(robot).solve_batch(points, normals).success.all()
