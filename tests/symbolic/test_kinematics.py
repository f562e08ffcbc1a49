"""Kinematics and their derivatives over the motors, by pinocchio, differences and CasADi."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import casadi_ik as ik
from casadi_ik.compile.layout import Layout
from casadi_ik.kinematics.contact_curvature import residual_curvature
from casadi_ik.kinematics.contact_fit import contact_residual
from casadi_ik.kinematics.contacts import ContactKind, ContactRows
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.kinematics.forward import actuated, forward
from casadi_ik.kinematics.se3 import euler_zyx


@pytest.fixture(params=["shipped", "coupled"])
def pair(request, robot, oracle, coupled_robot, coupled_oracle):
    return (robot, oracle) if request.param == "shipped" else (coupled_robot, coupled_oracle)


def inner(robot, rng, count):
    """Return configurations with a margin to the limits for central differences of sliders."""
    margin = 0.02 * (robot.upper - robot.lower)
    return rng.uniform(robot.lower + margin, robot.upper - margin, (count, len(robot.actuators)))


def over_q(robot, build) -> ca.Function:
    """Return a Function of q of the result of `build` on the actuated kinematics."""
    q = ca.SX.sym("q", len(robot.actuators))
    outputs = build(actuated(robot.description, q))
    outputs = outputs if isinstance(outputs, (tuple, list)) else [outputs]
    return ca.Function("f", [q], [ca.densify(output) for output in outputs])


def numbers(f: ca.Function, q) -> list[np.ndarray]:
    return [np.array(value) for value in f.call([ca.DM(q)])]


def difference(f, q, step=1e-6) -> np.ndarray:
    """Return central differences of an array-valued f, last axis over q."""
    columns = []
    for i in range(len(q)):
        h = np.zeros(len(q))
        h[i] = step
        columns.append((f(q + h) - f(q - h)) / (2 * step))
    return np.stack(columns, axis=-1)


def spin(pose_of, q, step=1e-6) -> np.ndarray:
    """Return the angular velocity (3, n) in the base frame of a rotation-valued function."""
    R = pose_of(q)
    rate = difference(pose_of, q, step)
    hat = np.einsum("ijn,kj->ikn", rate, R)
    return np.array([hat[2, 1] - hat[1, 2], hat[0, 2] - hat[2, 0], hat[1, 0] - hat[0, 1]]) / 2


def test_links_and_axes(pair, rng):
    robot, oracle = pair
    q = ca.SX.sym("q", len(robot.actuators))
    kinematics = forward(robot.description, joint_positions(robot.description, q))
    poses = [ca.horzcat(pose.rotation, pose.origin) for pose in kinematics.links.values()]
    f = ca.Function("f", [q], [ca.densify(pose) for pose in poses])
    axes = ca.Function("a", [q], [ca.densify(a) for a in kinematics.axes.values()])
    for row in robot.random(rng, 20):
        frames = oracle.frames(row)
        for name, pose in zip(kinematics.links, numbers(f, row), strict=True):
            np.testing.assert_allclose(pose, frames[name][:3], atol=1e-12)
        for name, axis in zip(kinematics.axes, numbers(axes, row), strict=True):
            joint = next(j for j in robot.description.joints if j.name == name)
            np.testing.assert_allclose(
                axis.ravel(), frames[joint.child][:3, :3] @ joint.axis, atol=1e-12
            )


def test_contact_jacobians(pair, rng):
    robot, oracle = pair
    everything = range(len(robot.actuators))
    for i, finger in enumerate(robot.fingers):
        f = over_q(robot, lambda body, finger=finger: body.contact_jacobian(finger, everything))
        coupling = over_q(robot, lambda body: body.coupling)
        for q in inner(robot, rng, 5):
            linear, angular = numbers(f, q)
            expected = oracle.jacobian(q, f"{finger}_contact", pin.LOCAL_WORLD_ALIGNED)
            expected = expected @ numbers(coupling, q)[0]
            np.testing.assert_allclose(np.vstack([linear, angular]), expected, atol=1e-11)
            slope = difference(lambda x, i=i: robot.contacts(x)[0][i], q)
            scale = max(1.0, np.abs(linear).max())
            np.testing.assert_allclose(linear, slope, atol=1e-8 * scale)
            normal_rates = difference(lambda x, i=i: robot.contacts(x)[1][i], q)
            normal = robot.contacts(q)[1][i]
            scale = max(1.0, np.abs(angular).max())
            np.testing.assert_allclose(
                np.cross(angular.T, normal).T, normal_rates, atol=1e-8 * scale
            )


def test_palm_jacobians(pair, rng):
    robot, oracle = pair
    everything = list(range(len(robot.actuators)))
    f = over_q(
        robot,
        lambda body: [
            *body.palm_jacobian(everything),
            body.palm_euler_jacobian(everything),
            euler_zyx(body.kinematics.palm.rotation),
            body.coupling,
        ],
    )
    link, placement = robot.description.palm_link, pin.SE3(robot.description.palm_placement)
    for q in inner(robot, rng, 5):
        linear, angular, euler, angles, coupling = numbers(f, q)
        local = placement.toActionMatrixInverse() @ oracle.jacobian(q, link, pin.LOCAL) @ coupling
        aligned = np.kron(np.eye(2), robot.palm(q)[:3, :3]) @ local
        np.testing.assert_allclose(np.vstack([linear, angular]), aligned, atol=1e-12)
        np.testing.assert_allclose(linear, difference(lambda x: robot.palm(x)[:3, 3], q), atol=1e-8)
        np.testing.assert_allclose(angular, spin(lambda x: robot.palm(x)[:3, :3], q), atol=1e-8)
        slope = difference(lambda x: numbers(f, x)[3].ravel(), q)
        assert abs(np.cos(angles[1])) > 1e-2
        np.testing.assert_allclose(euler, slope, atol=1e-6)


def test_coupling_jacobian(coupled_robot, rng):
    f = over_q(coupled_robot, lambda body: [body.coupling, body.kinematics.theta])
    names = coupled_robot.description.joint_names
    for q in inner(coupled_robot, rng, 20):
        coupling, theta = numbers(f, q)
        assert coupling.shape == (10, 6)
        np.testing.assert_allclose(
            theta.ravel(), list(coupled_robot.joints(q).values()), atol=1e-14
        )
        slope = difference(lambda x: np.array(list(coupled_robot.joints(x).values())), q, 1e-7)
        np.testing.assert_allclose(coupling, slope, atol=1e-4, rtol=1e-6)
    # A slider turns its joint by 72 to 138 rad/m.
    assert 60 < coupling[names.index("left_1"), 1] < 150
    assert coupling[names.index("right_1"), 2] == pytest.approx(
        -coupling[names.index("left_3"), 2], rel=1e-12
    )


KINDS = (
    ContactKind("point", "normal"),
    ContactKind("ball", "frame"),
    ContactKind("line", "normal"),
    ContactKind("plane", "frame"),
)


@pytest.mark.parametrize(
    "name", ["kuka_lwr_barrett_coupled", "ur5e+robotiq_3f", "mobile_kuka_lwr_barrett"]
)
def test_the_curvature_is_that_of_automatic_differentiation(name):
    robot = ik.load_robot(name)
    body, f = robot.description, len(robot.fingers)
    rows = ContactRows(tuple(KINDS[i % len(KINDS)] for i in range(f)))
    layout = Layout(rows.fields)
    parameters, q = layout.symbols("parameters"), ca.SX.sym("q", len(robot.actuators))
    p = layout.unpack(parameters)
    residual = contact_residual(body, rows, q, p)
    jacobian = ca.jacobian(residual, q)
    expected = ca.hessian(ca.sumsqr(residual) / 2, q)[0] - jacobian.T @ jacobian
    actual = residual_curvature(body, rows, q, p, residual)
    outputs = [ca.densify(actual), ca.densify(ca.triu(expected))]
    function = ca.Function("curvatures", [q, parameters], outputs)
    rng = np.random.default_rng(0)
    for q_sample in robot.random(rng, 3):
        results = function(q_sample, rng.uniform(-1, 1, layout.size))
        np.testing.assert_allclose(*map(np.array, results), rtol=1e-9, atol=1e-9)
