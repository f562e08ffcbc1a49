"""The tasks, and the hierarchy they are solved in."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from casadi_ik.papers.qiu.tasks import Task, combine, contact_tasks, damped, palm_orientation_task
from casadi_ik.problem.target import Target
from casadi_ik.symbolic.actuated import actuated

COLUMNS = (0, 1, 2, 3, 4, 5, 6, 8, 9)


@pytest.fixture(scope="module")
def tasks(robot):
    """(q, R desired, point, normal) -> Jacobian and error of palm (both ways), point, normal."""
    q, R = ca.SX.sym("q", 14), ca.SX.sym("R", 3, 3)
    point, normal = ca.SX.sym("point", 3), ca.SX.sym("normal", 3)
    body = actuated(robot.description, q)
    parts = [palm_orientation_task(body, R, COLUMNS, euler) for euler in (True, False)]
    parts += contact_tasks(body, "thumb", Target(point, normal), COLUMNS)
    outputs = [ca.densify(x) for part in parts for x in (part.jacobian, part.error)]
    f = ca.Function("f", [q, R, point, normal], outputs)

    def evaluate(*values):
        numbers = [np.array(x) for x in f.call([ca.DM(v) for v in values])]
        return [(J, e.ravel()) for J, e in zip(numbers[::2], numbers[1::2], strict=True)]

    return evaluate


def own_pose(robot, q):
    points, normals = robot.contacts(q)
    return robot.palm(q)[:3, :3], points[0], normals[0]


def test_errors_vanish_where_the_thumb_is(robot, tasks, rng):
    for q in robot.random(rng, 5):
        for _, error in tasks(q, *own_pose(robot, q)):
            np.testing.assert_allclose(error, 0, atol=1e-11)


def test_jacobians_predict_how_the_errors_fall(robot, tasks, rng):
    """A small step dq changes each error by -J dq near the goal."""
    for q in robot.random(rng, 10):
        R = robot.palm(q)[:3, :3]
        if abs(R[2, 0]) > 0.95:
            continue
        step = np.zeros(14)
        step[list(COLUMNS)] = rng.normal(scale=1e-5, size=9)
        goal = own_pose(robot, q + step)
        for i, (J, error) in enumerate(tasks(q, *goal)):
            predicted = J @ step[list(COLUMNS)]
            if i == 3:  # of the turn, the one about the normal is free
                predicted -= goal[2] * (goal[2] @ predicted)
            scale = 1e3 if i == 2 else 1.0
            np.testing.assert_allclose(error, predicted, atol=2e-8 * scale)
            assert np.linalg.norm(error) > 1e-7


def test_position_is_in_millimetres(robot, tasks):
    R, point, normal = own_pose(robot, robot.home)
    _, error = tasks(robot.home, R, point + np.array([0.003, 0, 0]), normal)[2]
    np.testing.assert_allclose(error, [3, 0, 0], atol=1e-9)


def test_euler_differences_are_wrapped(robot, tasks):
    """Rotations on both sides of the half turn are close."""
    q = np.zeros(14)
    q[0] = np.radians(169)
    R = pin.utils.rotate("z", np.radians(-175))
    _, error = tasks(q, R, np.zeros(3), np.array([0.0, 0.0, 1.0]))[0]
    np.testing.assert_allclose(np.degrees(error), [16, 0, 0], atol=1e-9)
    _, error = tasks(q, R, np.zeros(3), np.array([0.0, 0.0, 1.0]))[1]
    np.testing.assert_allclose(np.degrees(error), [0, 0, 16], atol=1e-9)


def step_function(count, damping, projection="successive"):
    J = [ca.SX.sym(f"J{i}", 3, 9) for i in range(count)]
    e = [ca.SX.sym(f"e{i}", 3) for i in range(count)]

    tasks = [Task(a, b, is_position=False) for a, b in zip(J, e, strict=True)]
    solve = damped(damping)
    total = combine(tasks, [solve(task) for task in tasks], projection)
    return ca.Function("f", [*J, *e], [total])


def damped_steps(rng, damping):
    """Three random tasks and numpy's damped solution of each."""
    J, e = rng.normal(size=(3, 3, 9)), rng.normal(size=(3, 3))
    solved = [
        A.T @ np.linalg.solve(A @ A.T + damping**2 * np.eye(3), b)
        for A, b in zip(J, e, strict=True)
    ]
    return J, e, solved


def test_hierarchy_is_the_successive_projection(rng):
    """dq_1 + N_1 dq_2 + N_1 N_2 dq_3 with numpy's own pseudoinverse."""
    J, e, steps = damped_steps(rng, 0.1)
    N = [np.eye(9) - np.linalg.pinv(A) @ A for A in J]
    expected = steps[0] + N[0] @ steps[1] + N[0] @ N[1] @ steps[2]
    found = np.array(step_function(3, 0.1).call([*map(ca.DM, J), *map(ca.DM, e)])[0]).ravel()
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_augmented_projection_keeps_every_higher_task(rng):
    """dq_1 + N_1 dq_2 + N_12 dq_3 with numpy's own pseudoinverse of the stacked tasks."""
    J, e, steps = damped_steps(rng, 0.1)
    stacked = [np.concatenate(J[: i + 1]) for i in range(2)]
    N = [np.eye(9) - np.linalg.pinv(A) @ A for A in stacked]
    expected = steps[0] + N[0] @ steps[1] + N[1] @ steps[2]
    f = step_function(3, 0.1, "augmented")
    found = np.array(f.call([*map(ca.DM, J), *map(ca.DM, e)])[0]).ravel()
    # RANK_FLOOR damps the projector a little.
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_lower_tasks_leave_the_first_alone(robot, tasks, rng):
    """To first order the palm turns as if the thumb had no task, on the real Jacobians."""
    f = step_function(3, 1e-3)
    alone = step_function(1, 1e-3)
    for q in robot.random(rng, 10):
        goal = own_pose(robot, robot.random(rng, 1)[0])
        palm, point, normal = (tasks(q, *goal)[i] for i in (1, 2, 3))
        J = [palm[0], point[0], normal[0]]
        e = [palm[1], point[1], normal[1]]
        step = np.array(f.call([*map(ca.DM, J), *map(ca.DM, e)])[0]).ravel()
        first = np.array(alone.call([ca.DM(J[0]), ca.DM(e[0])])[0]).ravel()
        np.testing.assert_allclose(J[0] @ step, J[0] @ first, atol=1e-7 * np.abs(step).max())
        # Unlike an augmented projection the successive one lets the third disturb the second.
        assert np.abs(step - first).max() > 1e-3


def test_thumb_keeping_puts_the_point_before_the_normal(robot, tasks, rng):
    """With two tasks the hierarchy is strict: the point moves as if it were alone."""
    both, alone = step_function(2, 1.0), step_function(1, 1.0)
    for q in robot.random(rng, 10):
        _, _, point, normal = tasks(q, *own_pose(robot, robot.random(rng, 1)[0]))
        step = np.array(both(point[0], normal[0], point[1], normal[1])).ravel()
        first = np.array(alone(point[0], point[1])).ravel()
        np.testing.assert_allclose(point[0] @ step, point[0] @ first, atol=1e-6)
