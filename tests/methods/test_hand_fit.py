"""Residuals and Jacobians of the stages of hand-first, by central differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.arms.recognise import srs_arm
from casadi_ik.methods.common.contact_fit import whole_jacobian, whole_residual
from casadi_ik.methods.common.numeric_arm import (
    STARTS,
    TABLE,
    nearest_start,
    pose_jacobian,
    pose_step,
)
from casadi_ik.methods.common.palm_fit import best_palm, hand_contacts
from casadi_ik.methods.hand_first.hand_fit import PalmAndHand, fit_jacobian, fit_residual, reach_row
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.contacts import LENGTH, ContactRows, chord, usual, within_tolerance
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.se3 import compose, exp_se3

ARM, HAND = 7, 7
ROWS = ContactRows(usual(3))


def parameters(robot, points, normals, weights=None):
    values = {
        "points": points,
        "normals": normals,
        "weights": np.ones((3, 2)) if weights is None else weights,
        "lower": robot.lower,
        "upper": robot.upper,
        "reach": 1.0,
    }
    return {name: ca.DM(value) for name, value in values.items()}


@pytest.fixture(scope="module")
def layouts(robot):
    return HandFirstLayouts(robot.description, 1, ROWS.kinds)


def differences(function, x, step=1e-6):
    """Central differences (m, n)."""
    columns = []
    for i in range(len(x)):
        e = np.zeros(len(x))
        e[i] = step
        columns.append((function(x + e) - function(x - e)) / (2 * step))
    return np.column_stack(columns)


def number(value):
    return np.array(ca.evalf(ca.densify(ca.SX(value))))


@pytest.fixture(scope="module")
def problem(robot):
    """A configuration, and contacts that are not its own."""
    rng = np.random.default_rng(3)
    q, other = robot.random(rng, 2)
    weights = np.array([[1.0, 1.0], [1.0, 0.0], [0.5, 2.0]])
    return q, parameters(robot, *robot.contacts(other), weights)


def test_hand_jacobian(robot, layouts, problem):
    q, p = problem
    palm = robot.palm(q)

    def moved(x):
        rotation, origin = compose((palm[:3, :3], palm[:3, 3]), exp_se3(ca.DM(x[:6])))
        return PalmAndHand(rotation, origin, ca.DM(q[ARM:] + x[6:]))

    def residual(x):
        at = moved(x)
        contacts = hand_contacts(robot.description, ca.SX(at.hand), layouts.robot.hand_actuators)
        return number(fit_residual(contacts, ROWS, at, p)).ravel()

    at = moved(np.zeros(6 + HAND))
    contacts = hand_contacts(robot.description, ca.SX(at.hand), layouts.robot.hand_actuators)
    expected = differences(residual, np.zeros(6 + HAND))
    np.testing.assert_allclose(number(fit_jacobian(contacts, ROWS, at, p)), expected, atol=1e-7)
    assert np.linalg.matrix_rank(expected) > 8


def test_whole_jacobian(robot, problem):
    q, p = problem

    def residual(x):
        return number(whole_residual(robot.description, ROWS, ca.SX(x), p)).ravel()

    found = number(whole_jacobian(robot.description, ROWS, ca.SX(q), p))
    np.testing.assert_allclose(found, differences(residual, q), atol=1e-7)


def test_pose_jacobian(robot, problem):
    q, _ = problem

    def features(x):
        palm = robot.palm(np.concatenate([x, q[ARM:]]))
        return np.concatenate([palm[:3, 3] / LENGTH, palm[:3, :3].T.ravel()])

    found = number(pose_jacobian(robot.description, ca.SX(q[:ARM])))
    np.testing.assert_allclose(found, differences(features, q[:ARM]), atol=1e-7)


def test_residual_vanishes_at_the_generating_configuration(robot, layouts, problem):
    q, _ = problem
    p, palm = parameters(robot, *robot.contacts(q)), robot.palm(q)
    at = PalmAndHand(ca.DM(palm[:3, :3]), ca.DM(palm[:3, 3]), ca.DM(q[ARM:]))
    contacts = hand_contacts(robot.description, ca.SX(at.hand), layouts.robot.hand_actuators)
    assert np.abs(number(fit_residual(contacts, ROWS, at, p))).max() < 1e-13
    assert np.abs(number(whole_residual(robot.description, ROWS, ca.SX(q), p))).max() < 1e-13


def test_best_palm_finds_the_palm_of_the_right_posture(robot, layouts, rng):
    for q in robot.random(rng, 10):
        contacts = hand_contacts(robot.description, ca.SX(q[ARM:]), layouts.robot.hand_actuators)
        rotation, origin = best_palm(contacts, ROWS, parameters(robot, *robot.contacts(q)))
        palm = robot.palm(q)
        np.testing.assert_allclose(number(rotation), palm[:3, :3], atol=1e-3)
        np.testing.assert_allclose(number(origin).ravel(), palm[:3, 3], atol=1e-3)


@pytest.mark.parametrize(("shift", "sign"), [(0.0, 0), (1.0, 1), (-2.0, -1)])
def test_reach_row(robot, shift, sign):
    """Zero within reach, the distance beyond it, and its slope."""
    arm, p = srs_arm(robot.description), parameters(robot, np.ones((3, 3)), np.ones((3, 3)))
    rotation = robot.palm(robot.home)[:3, :3]
    wrist = np.array([0.3, 0.3, 0.6]) * (1 + shift) if sign >= 0 else np.array([0.1, 0, 0.2])
    origin = arm.shoulder + wrist - rotation @ arm.wrist_in_palm

    def moved(x):
        R, o = compose((ca.DM(rotation), ca.DM(origin)), exp_se3(ca.DM(x)))
        return PalmAndHand(R, o, ca.DM.zeros(HAND))

    def row(x):
        return number(reach_row(arm, range(ARM), moved(x), p)[0]).ravel()

    found = row(np.zeros(6))
    assert np.sign(found[0]) == sign
    slope = number(reach_row(arm, range(ARM), moved(np.zeros(6)), p)[1])
    np.testing.assert_allclose(slope, differences(row, np.zeros(6)), atol=1e-7)
    assert np.any(slope) == (sign != 0)


def test_starts_of_the_numeric_arm_come_in_the_order_of_their_distance(robot):
    start = nearest_start(robot.description)
    palm = robot.palm(robot.home)
    passed, distances, arms = -1.0, [], []
    for _ in range(TABLE):
        arm, passed = start(palm[:3, :3], palm[:3, 3], passed)
        distances.append(float(passed))
        arms.append(np.array(arm).ravel())
    assert np.all(np.diff(distances) > 0)
    assert len(np.unique(np.round(arms, 9), axis=0)) == TABLE
    # After the last one they begin anew.
    assert float(start(palm[:3, :3], palm[:3, 3], passed)[1]) == distances[0]
    q = np.tile(robot.home, (1, 1))
    q[0, :ARM] = arms[0]
    there = robot.palm(q[0])
    off = np.sum(((there - palm)[:3, 3] / LENGTH) ** 2) + np.sum((there - palm)[:3, :3] ** 2)
    assert distances[0] == pytest.approx(off, abs=1e-9)


def test_a_solve_tries_all_starts_of_the_numeric_arm():
    options = HandFirstParameters()
    assert options.rounds * options.candidates * STARTS >= TABLE


def test_a_step_of_the_numeric_arm_lowers_what_it_promises(robot, rng):
    q, other = robot.random(rng, 2)
    palm = robot.palm(np.clip(q + 0.01, robot.lower, robot.upper))
    p = parameters(robot, *robot.contacts(other))
    target = Pose(ca.SX(palm[:3, :3]), ca.SX(palm[:3, 3]))
    tried = pose_step(robot.description, ca.SX(q[:ARM]), target, ca.SX(1e-6), p)
    before, there = (np.sum(number(r) ** 2) for r in (tried.before, tried.there))
    assert there < 0.01 * before
    assert before - there == pytest.approx(float(number(tried.promised)[0, 0]), rel=0.05)


def test_within_tolerance_compares_the_angle():
    tolerances = ca.DM([5e-3] * 3), chord(ca.DM([0.1] * 3))
    for angle, expected in ((0.0999, 1), (0.1001, 0)):
        residual = np.zeros(18)
        residual[3] = 4.9e-3 / LENGTH
        residual[9:12] = [np.cos(angle) - 1, np.sin(angle), 0]
        positions, chords = ROWS.errors(ca.DM(residual))
        assert float(positions[1]) == pytest.approx(4.9e-3)
        assert int(within_tolerance(positions, chords, *tolerances)) == expected
