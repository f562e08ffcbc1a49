"""The lines of docs/add_a_coupling.md add a kind of coupling to a copy of the package."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from package_copy import blocks, package_copy, run_with
from toy_robots import replace, write_coupled_robot

import casadi_ik as ik
from casadi_ik.kinematics.couplings import coupling_rate, follow, has_toggle
from casadi_ik.model.couplings import CouplingKind

SCRIPT = """
import sys
import casadi as ca
import numpy as np
import casadi_ik as ik
from casadi_ik.papers.chandra.calibration.model import (hand_parameters)
from casadi_ik.kinematics.couplings import (coupling_rate, follow, joint_positions)

robot = ik.load_robot(sys.argv[1])
rng = np.random.default_rng(3)
joint = next(joint for joint in robot.description.movable if joint.name == "left_4")
q = robot.random(rng, 1)[0]
moved = robot.joints(q)
assert np.isclose(moved["left_4"], -0.5 * moved["left_3"] + 0.2 * moved["left_3"] ** 2)

s = ca.SX.sym("s")
both = ca.Function("both", [s], [follow(joint, s), coupling_rate(joint, s)])
source, step = rng.uniform(-1, 1, 50), 1e-6
position, rate = (np.array(value).ravel() for value in both(source[None]))
np.testing.assert_allclose(joint.coupling.joint_position(source), position, atol=1e-14)
ahead, behind = (joint.coupling.joint_position(source + side) for side in (step, -step))
np.testing.assert_allclose(rate, (ahead - behind) / (2 * step), atol=1e-8)

motors = ca.SX.sym("q", len(q))
theta = joint_positions(robot.description, motors)
jacobian = ca.Function("jacobian", [motors], [ca.jacobian(theta, motors)])
slider = robot.actuators.index("screw_2")
shift = np.eye(len(q))[slider] * 1e-7
names = robot.description.joint_names
ends = [np.array([robot.joints(q + side)[name] for name in names]) for side in (shift, -shift)]
column = np.array(jacobian(q))[:, slider]
np.testing.assert_allclose((ends[0] - ends[1]) / 2e-7, column, rtol=1e-5, atol=1e-5)

assert "Quadratic(of='left_3', rise=-0.5, curve=0.2)" in robot.urdf()
names = [parameter.name for parameter in hand_parameters(robot.description, ["left"])]
assert {"left_4.rise", "left_4.curve"} <= set(names)

points, normals = robot.contacts(robot.home + 0.1 * (q - robot.home))
contacts = zip(robot.fingers, points, normals)
grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in contacts})
solver = ik.Solver(robot, compiled=False)
solution = solver.solve(grasp, diagnose=False)
assert solution.success, solution

far = {name: ik.Contact(c.point + [9.0, 0, 0], c.normal) for name, c in grasp.contacts.items()}
missed = solver.solve(ik.Grasp(far))
assert missed.status is ik.Status.UNREACHABLE, missed.status
assert missed.diagnosis.proof.check(robot)
"""


@pytest.mark.slow
def test_a_kind_is_added_in_two_files(tmp_path):
    (tmp_path / "robot").mkdir()
    path = write_coupled_robot(tmp_path / "robot")
    replace(
        tmp_path / "robot" / "parts" / "hand.yaml",
        "coupling: {kind: linear, of: left_3, ratio: -0.5, offset: 0.05}",
        "coupling: {kind: quadratic, of: left_3, rise: -0.5, curve: 0.2}",
    )
    package = package_copy(tmp_path)
    data, row = blocks("add_a_coupling.md")
    union = "Coupling = Linear | LeadScrew | FourBar"
    replace(package / "model" / "couplings.py", union, f"{data}\n\n{union} | Quadratic")
    graphs = package / "kinematics" / "couplings.py"
    replace(graphs, "Linear, Polynomial\n", "Linear, Polynomial, Quadratic\n")
    end = '}\n"""Formulas by kind of coupling."""'
    replace(graphs, end, row + end)
    run_with(package, SCRIPT, path)


class Wire(CouplingKind, frozen=True, tag="wire"):
    """Kind of coupling without any functions."""


def test_an_unknown_kind_is_an_error(coupled_robot):
    """An unknown kind is neither taken for a four-bar nor skipped."""
    (joint,) = (joint for joint in coupled_robot.description.movable if joint.name == "left_4")
    wired = dataclasses.replace(joint, coupling=Wire("left_3"))  # type: ignore[arg-type]
    for ask in (follow, coupling_rate):
        with pytest.raises(ik.errors.UnsupportedError, match="Wire"):
            ask(wired, ca.SX.sym("s"))
    with pytest.raises(ik.errors.UnsupportedError, match="Wire"):
        has_toggle(wired)
    with pytest.raises(NotImplementedError, match="Wire"):
        wired.coupling.joint_position(np.zeros(1))
    joints = coupled_robot.description.joints
    described = dataclasses.replace(
        coupled_robot.description,
        joints=tuple(wired if joint_entry is joint else joint_entry for joint_entry in joints),
    )
    with pytest.raises(ik.errors.UnsupportedError, match="Wire"):
        ik.ArmHand(described).contacts(coupled_robot.home)
