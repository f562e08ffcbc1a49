"""Second derivatives of the contact residual, compared with automatic differentiation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.compile.layout import Layout
from casadi_ik.kinematics.contact_curvature import residual_curvature
from casadi_ik.kinematics.contact_fit import contact_residual
from casadi_ik.kinematics.contacts import ContactKind, ContactRows

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
