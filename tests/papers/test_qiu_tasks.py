"""The tasks of Qiu & Kermani 2021: palm estimate, hierarchy, palm motion, and recorded numbers."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import logm
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.kinematics.contacts import Target
from casadi_ik.kinematics.forward import actuated
from casadi_ik.papers.qiu.step import QiuParameters
from casadi_ik.papers.qiu.tasks import (
    Task,
    axes_through,
    base_axes,
    combine,
    contact_tasks,
    damped,
    palm_motion,
    palm_orientation,
    palm_orientation_task,
)


def estimate(robot: ik.ArmHand, points: np.ndarray) -> np.ndarray:
    """Return the estimated palm orientation for contacts (f, 3) in the robot's order."""
    symbols = ca.SX.sym("p", 3, len(points))
    goals = {name: Target(symbols[:, i], ca.SX.zeros(3, 1)) for i, name in enumerate(robot.fingers)}
    f = ca.Function("f", [symbols], [palm_orientation(robot.description, goals)])
    return np.array(f(points.T))


def test_symmetric_pinch_gives_the_palm_itself(robot, rng):
    """Without spread the fingertips form the same triangle as the bases."""
    q = robot.random(rng, 20)
    q[:, 7] = 0.0
    q[:, 12:] = q[:, 10:12]
    q[:, 8:10] = q[:, 10:12]
    for row in q:
        points, _ = robot.contacts(row)
        palm = robot.palm(row)
        side = (points[0] - points[1]) @ palm[:3, 1]
        expected = palm[:3, :3] if side > 0 else palm[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(estimate(robot, points), expected, atol=1e-9)


def test_eqs_1_and_2_literally(robot, rng):
    thumb, second, third = points = rng.normal(size=(3, 3))
    x, y = second - third, thumb - (second + third) / 2
    z = np.cross(x, y)
    x = np.cross(y, z)
    axes = [axis / np.linalg.norm(axis) for axis in (x, y, z)]
    np.testing.assert_allclose(estimate(robot, points), np.stack(axes, axis=1), atol=1e-12)


def test_estimate_rotates_with_the_palm_frame(own_robot, robot, rng):
    replace(
        own_robot.with_name("hand.yaml"),
        "palm: {link: bh_base,",
        "palm: {link: bh_base, rpy: [0.3, 0.2, 1.0],",
    )
    own_robot_model = ik.load_robot(own_robot)
    points = rng.normal(size=(3, 3))
    rotated = estimate(robot, points) @ own_robot_model.description.palm_placement[:3, :3]
    np.testing.assert_allclose(estimate(own_robot_model, points), rotated, atol=1e-12)


def test_points_on_a_line_give_finite_numbers():
    points = [ca.SX([0, 0, 0]), ca.SX([1, 0, 0]), ca.SX([2, 0, 0])]
    assert np.all(np.isfinite(np.array(ca.evalf(ca.densify(axes_through(points))))))


def test_two_fingers_are_too_few(own_robot):
    replace(own_robot, "[thumb, finger_2, finger_3]", "[thumb, finger_2]")
    with pytest.raises(ik.errors.UnsupportedError, match=r"has 2 fingers; .* at least three"):
        base_axes(ik.load_robot(own_robot).description)


COLUMNS = (0, 1, 2, 3, 4, 5, 6, 8, 9)


@pytest.fixture(scope="module")
def tasks(robot):
    """Function of q and a goal -> Jacobians and errors of palm (two kinds), point, normal."""
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
    """Return three random tasks and the damped solution of each by numpy."""
    J, e = rng.normal(size=(3, 3, 9)), rng.normal(size=(3, 3))
    solved = [
        A.T @ np.linalg.solve(A @ A.T + damping**2 * np.eye(3), b)
        for A, b in zip(J, e, strict=True)
    ]
    return J, e, solved


def test_hierarchy_is_the_successive_projection(rng):
    """The hierarchy is dq_1 + N_1 dq_2 + N_1 N_2 dq_3 with numpy's pseudoinverse."""
    J, e, steps = damped_steps(rng, 0.1)
    N = [np.eye(9) - np.linalg.pinv(A) @ A for A in J]
    expected = steps[0] + N[0] @ steps[1] + N[0] @ N[1] @ steps[2]
    step = np.array(step_function(3, 0.1).call([*map(ca.DM, J), *map(ca.DM, e)])[0]).ravel()
    np.testing.assert_allclose(step, expected, atol=1e-10)


def test_augmented_projection_keeps_every_higher_task(rng):
    """The hierarchy is dq_1 + N_1 dq_2 + N_12 dq_3 with stacked pseudoinverses of numpy."""
    J, e, steps = damped_steps(rng, 0.1)
    stacked = [np.concatenate(J[: i + 1]) for i in range(2)]
    N = [np.eye(9) - np.linalg.pinv(A) @ A for A in stacked]
    expected = steps[0] + N[0] @ steps[1] + N[1] @ steps[2]
    f = step_function(3, 0.1, "augmented")
    step = np.array(f.call([*map(ca.DM, J), *map(ca.DM, e)])[0]).ravel()
    # RANK_FLOOR damps the projector slightly.
    np.testing.assert_allclose(step, expected, atol=1e-5)


@pytest.fixture(scope="module")
def motion(robot):
    """Function of q and contacts (k, 3) -> translation [mm], rotation [rad], palm frame."""
    q = ca.SX.sym("q", 14)
    points, normals = ca.SX.sym("p", 3, 2), ca.SX.sym("n", 3, 2)
    goals = {f: Target(points[:, i], normals[:, i]) for i, f in enumerate(robot.fingers[1:])}
    f = ca.Function(
        "f", [q, points, normals], [*palm_motion(actuated(robot.description, q), goals)]
    )
    return lambda q, p, n: tuple(np.array(x).ravel() for x in f.call([ca.DM(q), p.T, n.T]))


def displaced(robot, q, translation, rotation):
    """Return positions of fingers 2 and 3 after a motion given in the palm frame."""
    points, normals = robot.contacts(q)
    palm = pin.SE3(robot.palm(q))
    moved_palm = palm * pin.SE3(pin.exp3(rotation), translation) * palm.inverse()
    return points[1:] @ moved_palm.rotation.T + moved_palm.translation, normals[
        1:
    ] @ moved_palm.rotation.T


def test_translations_are_found_exactly(robot, motion, rng):
    for q in robot.random(rng, 10):
        shift = rng.normal(scale=0.05, size=3) * rng.integers(2)  # nothing to do, now and then
        translation, rotation = motion(q, *displaced(robot, q, shift, np.zeros(3)))
        np.testing.assert_allclose(translation, 1e3 * shift, atol=1e-9)
        np.testing.assert_allclose(rotation, 0, atol=1e-12)


def twist_of(pose):
    """Return the linear and angular parts of a logarithm by scipy."""
    twist = np.real(logm(pose))
    return twist[:3, -1], np.array([twist[2, 1], twist[0, 2], twist[1, 0]])


def test_eqs_9_to_14_literally(robot, motion, rng):
    for q in robot.random(rng, 5):
        points, normals = (x[1:] for x in robot.contacts(q))
        goal_points = points + rng.normal(scale=0.02, size=(2, 3))
        goal_normals = normals + 0.3 * rng.normal(size=(2, 3))
        goal_normals /= np.linalg.norm(goal_normals, axis=1, keepdims=True)
        palm = robot.palm(q)
        R, shifts, turns = palm[:3, :3], [], []
        for i in range(2):
            current, desired = R.T @ normals[i], R.T @ goal_normals[i]
            axis = np.cross(current, desired)
            pose = np.eye(4)
            pose[:3, :3] = pin.exp3(np.arccos(current @ desired) * axis / np.linalg.norm(axis))
            pose[:3, 3] = 1e3 * R.T @ (goal_points[i] - points[i])
            linear, angular = twist_of(pose)
            shifts.append(linear - np.cross(angular, 1e3 * R.T @ (points[i] - palm[:3, 3])))
            turns.append(pose[:3, :3])
        U, _, V = np.linalg.svd(sum(turns) / 2)
        translation, rotation = motion(q, goal_points, goal_normals)
        np.testing.assert_allclose(translation, np.mean(shifts, axis=0), rtol=1e-6)
        np.testing.assert_allclose(rotation, twist_of(U @ V)[1], rtol=1e-6)


def test_three_fingers(robot, rng):
    """More than two demands use the polar projection."""
    q = ca.SX.sym("q", 14)
    points, normals = ca.SX.sym("p", 3, 3), ca.SX.sym("n", 3, 3)
    goals = {f: Target(points[:, i], normals[:, i]) for i, f in enumerate(robot.fingers)}
    f = ca.Function(
        "f", [q, points, normals], [*palm_motion(actuated(robot.description, q), goals)]
    )
    row = robot.random(rng, 1)[0]
    p, n = robot.contacts(row)
    shift = rng.normal(scale=0.02, size=3)
    translation, rotation = f(row, (p + robot.palm(row)[:3, :3] @ shift).T, n.T)
    np.testing.assert_allclose(np.array(translation).ravel(), 1e3 * shift, atol=1e-9)
    np.testing.assert_allclose(np.array(rotation).ravel(), 0, atol=1e-12)


def test_defaults_are_the_papers():
    options = QiuParameters()
    assert options.reaching_damping == 1.0
    assert options.chain_damping == 150.0
    assert (options.virtual_weight, options.joint_weight) == (10.0, 1.0)
    assert options.max_iterations == 10_000
    assert options.finger_step == "ipopt"
    assert options.borrowed == 1
