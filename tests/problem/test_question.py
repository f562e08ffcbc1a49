"""Tolerances by contact and fixed actuators in targets."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik

COARSE = ik.Tolerance(0.08, 0.5)


def grasp(robot, q, tolerances=None, shift=0.0) -> ik.Grasp:
    """Return the contacts of a configuration, the thumb's moved along its normal."""
    points, normals = robot.contacts(q)
    points = points.copy()
    points[robot.fingers.index(robot.thumb)] += shift * normals[robot.fingers.index(robot.thumb)]
    tolerances = tolerances or {}
    return ik.Grasp(
        {
            name: ik.Contact(points[i], normals[i], tolerances.get(name))
            for i, name in enumerate(robot.fingers)
        }
    )


@pytest.mark.parametrize("method", ["hand-first", "ipopt", "enhanced-dls"])
def test_each_contact_has_its_tolerance(robot, method):
    """Fingers with tight tolerances are exact, at the expense of a thumb with a coarse one."""
    options = {"finger_step": "closed-form"} if method.startswith("enhanced") else {}
    solver = ik.Solver(robot, method, tolerance=ik.Tolerance(1e-3, 1e-2), **options)
    grasp_with_coarse = grasp(robot, robot.home + 0.02, {robot.thumb: COARSE})
    solution = solver.solve(grasp_with_coarse)
    assert solution.success
    for name, contact in solution.contacts.items():
        expected = COARSE if name == robot.thumb else ik.Tolerance(1e-3, 1e-2)
        assert contact.tolerance == expected
        assert contact.position_error <= expected.position
        assert contact.angle_error <= expected.angle


def test_coarse_contact_makes_a_grasp_possible(robot):
    """Moved by 70 mm the thumb cannot be met exactly, but within a coarse tolerance."""
    q = robot.home + 0.01
    assert not ik.Solver(robot).solve(grasp(robot, q, shift=0.07), diagnose=False).success
    coarse = {robot.thumb: COARSE}
    solution = ik.Solver(robot).solve(grasp(robot, q, coarse, shift=0.07))
    assert solution.success
    fine_contacts = [solution.contacts[name] for name in robot.fingers if name != robot.thumb]
    assert max(contact.position_error for contact in fine_contacts) <= 5e-3


def test_tolerances_by_finger_of_a_batch(robot):
    solver = ik.Solver(robot, tolerance={"thumb": COARSE})
    points, normals = robot.contacts(robot.home[None] + 0.02)
    batch = solver.solve_batch(points, normals)
    assert batch.tolerances == (COARSE, ik.Tolerance(), ik.Tolerance())
    assert batch.success.all()


def test_grasp_file_with_tolerances(tmp_path):
    path = tmp_path / "grasp.yaml"
    text = (
        "contacts:\n"
        "  thumb: {point: [0, 0, 1], tolerance: {position: 2 mm}}\n"
        "  finger_2: {point: [0, 0, 1], tolerance: {angle: 1 deg}}\n"
        "  finger_3: {point: [0, 0, 1]}\n"
    )
    path.write_text(text)
    contacts = ik.load_grasp(path).contacts
    assert contacts["thumb"].tolerance == ik.Tolerance(position=2e-3)
    assert contacts["finger_2"].tolerance == ik.Tolerance(angle=np.deg2rad(1))
    assert contacts["finger_3"].tolerance is None
    path.write_text(text.replace("2 mm", "-2 mm"))
    says = (
        r"grasp\.yaml: contacts\.thumb\.tolerance\.position: found -0\.002, expected a number > 0"
    )
    with pytest.raises(ik.errors.DescriptionError, match=says):
        ik.load_grasp(path)


@pytest.mark.parametrize("method", ["hand-first", "ipopt"])
def test_fixed_actuators_stay(robot, method):
    """The swivel of the elbow is the only redundancy of the arm, so that joint 3 can be fixed."""
    solver = ik.Solver(robot, method)
    points, normals = robot.contacts(robot.random(np.random.default_rng(3), 20))
    free = solver.solve_batch(points, normals)
    assert free.success.all()
    for row in range(3):
        value = float(free.q[row, 2])
        batch = solver.solve_batch(
            points[row][None], normals[row][None], fixed={"lwr_joint_3": value}
        )
        assert batch.success.all()
        assert batch.q[0, 2] == value


def test_unsuitable_spread_is_detected(robot):
    """With an unsuitable fixed spread the contacts cannot be met, and the verdict reports it."""
    solution = ik.Solver(robot).solve(grasp(robot, robot.home), fixed={"bh_spread": 2.5})
    assert not solution.success
    assert solution.status in (ik.Status.UNREACHABLE, ik.Status.NOT_FOUND)
    assert solution.q[robot.actuators.index("bh_spread")] == 2.5
    assert solution.diagnosis is not None
    assert solution.diagnosis.q[robot.actuators.index("bh_spread")] == 2.5


def test_bad_queries_are_refused(robot):
    solver = ik.Solver(robot)
    grasp_at_home = grasp(robot, robot.home)
    with pytest.raises(ik.errors.UnknownNameError, match=r"fixed:.*'elbow'.*lwr_"):
        solver.solve(grasp_at_home, fixed={"elbow": 0.0})
    with pytest.raises(ik.errors.InputError, match=r"fixed\.lwr_joint_1:.*7"):
        solver.solve(grasp_at_home, fixed={"lwr_joint_1": 7})
    paper = ik.Solver(robot, "enhanced-dls", finger_step="closed-form")
    with pytest.raises(ik.errors.UnsupportedError, match="'enhanced-dls'"):
        paper.solve(grasp_at_home, fixed={"lwr_joint_1": 0.0})
    with pytest.raises(ik.errors.InputError, match=r"tolerance\.pinky: .*thumb, finger_2"):
        ik.Solver(robot, tolerance={"pinky": COARSE})
    with pytest.raises(ik.errors.InputError, match=r"tolerance\.thumb:.*3.*Tolerance"):
        ik.Solver(robot, tolerance={"thumb": 3})
    with pytest.raises(ik.errors.InputError, match=r"tolerance:.*0\.1.*Tolerance"):
        ik.Contact([0, 0, 1], tolerance=0.1)
