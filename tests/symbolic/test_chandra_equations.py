"""The printed equations of Chandra et al. 2019, also on the AR10."""

from __future__ import annotations

import inspect
import re

import casadi as ca
import numpy as np
import pytest
from algebra_samples import PROPERTY, rotation_vectors, unit_vectors, vectors
from hypothesis import given
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.kinematics import couplings, mechanisms, screws, se3
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.screws import (
    TipChain,
    finger_chain,
    relative_chain,
    screw_chain_to_contact,
)

EQUATIONS = {
    1: dq.exp_screw,
    2: dq.directed_line,
    3: screws.ChainScrews.pose,
    4: dq.twist,
    5: screws.ChainScrews.jacobian,
    6: dq.act_on_line,
    7: screws.ChainScrews.displacements,
    8: mechanisms.angle_from_slider,
    9: mechanisms.theta3,
    10: couplings.coupling_rate,
    11: mechanisms.theta3_rate,
    12: screws.TipMotion.joint_jacobian,
    13: dq.error,
    14: dq.control_twist,
    15: screws.TipMotion.joint_jacobian,
    16: screws.TipMotion.displacement,
    17: dq.screw_error_norm,
}


@pytest.fixture(scope="module")
def toy(coupled_robot) -> ik.ArmHand:
    """Robot with sliders, a four-bar, linear couplings, a shared motor, and a prismatic joint."""
    return coupled_robot


def evaluated(*expressions, q, at):
    f = ca.Function("f", [q], [ca.densify(x) for x in expressions])
    return [np.array(x) for x in f.call([ca.DM(at)])]


def twist_by_differences(tip: TipChain, at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Return columns [v; w] = 2 x' x* over all actuators, x' by central differences."""
    q = ca.SX.sym("q", len(at))
    pose = ca.Function("pose", [q], [tip.evaluate(q).pose])
    columns = []
    for offset in step * np.eye(len(at)):
        rate = (pose(at + offset) - pose(at - offset)) / (2 * step)
        w, v = dq.twist(pose(at), rate)
        columns.append(np.concatenate([np.array(v).ravel(), np.array(w).ravel()]))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("number", EQUATIONS)
def test_the_docstring_names_the_equation(number):
    text = inspect.getdoc(EQUATIONS[number])
    assert text is not None
    assert re.search(rf"eqs?\. [^:]*\({number}\)|\({number}\)", text), text


@PROPERTY
@given(rotation_vectors, vectors, unit_vectors, vectors, st.floats(-1, 1))
def test_eqs_1_2_screw_leaves_its_line_invariant(w, distance_along, axis, point, distance):
    angle = float(np.linalg.norm(w))
    line = dq.directed_line(ca.DM(axis), ca.DM(point))
    x = dq.exp_screw(angle, distance, *line)
    assert float(ca.dot(*line)) == pytest.approx(0, abs=1e-14)
    np.testing.assert_allclose(np.array(dq.norm(x)).ravel(), [1, 0], atol=1e-14)
    for result, expected in zip(dq.act_on_line(x, *line), line, strict=True):
        np.testing.assert_allclose(np.array(result), np.array(expected), atol=1e-13)
    shift = dq.act_on_point(x, ca.DM(point)) - ca.DM(point)
    np.testing.assert_allclose(np.array(shift).ravel(), distance * axis, atol=1e-13)
    # The same motion in SE(3): the twist theta (l, m) + d (0, l).
    R, p = se3.exp_se3(ca.vertcat(angle * line[1] + distance * line[0], angle * line[0]))
    np.testing.assert_allclose(np.array(dq.to_pose(x)[0]), np.array(R), atol=1e-12)
    np.testing.assert_allclose(np.array(dq.to_pose(x)[1]), np.array(p), atol=1e-12)


@pytest.mark.parametrize("kind", ["toy", "barrett"])
def test_eqs_3_to_7_12_finger_jacobians_are_the_tips_twist(kind, toy, robot, rng):
    """Jacobians equal differences over actuators, and the geometric Jacobians over joints."""
    body = toy if kind == "toy" else robot
    q = ca.SX.sym("q", len(body.actuators))
    for finger in body.fingers:
        tip = finger_chain(body.description, finger)
        motion = tip.evaluate(q)
        kinematics = actuated(body.description, q)
        frame = kinematics.kinematics.contact_frame(finger)
        point = dq.translation(motion.pose)
        geometric = kinematics.contact_jacobian(finger, tip.actuators)
        columns = motion.jacobian[:3, :] + ca.horzcat(
            *(ca.cross(column, point) for column in ca.horzsplit(motion.jacobian[3:, :]))
        )
        outputs = (*dq.to_pose(motion.pose), frame.rotation, frame.origin, motion.jacobian, columns)
        for row in 0.1 * body.home + 0.9 * body.random(rng, 5):
            values = evaluated(*outputs, *geometric, q=q, at=row)
            R, p, R_se3, p_se3, jacobian, linear, linear_se3, angular_se3 = values
            np.testing.assert_allclose(R, R_se3, atol=1e-12)
            np.testing.assert_allclose(p, p_se3, atol=1e-12)
            scale = np.abs(jacobian).max()
            np.testing.assert_allclose(linear, linear_se3, atol=1e-12 * scale)
            np.testing.assert_allclose(jacobian[3:], angular_se3, atol=1e-12 * scale)
            differences = twist_by_differences(tip, row)
            other_columns = [i for i in range(len(row)) if i not in tip.actuators]
            assert np.abs(differences[:, other_columns]).max(initial=0) == 0
            np.testing.assert_allclose(
                jacobian, differences[:, tip.actuators], atol=1e-6 * max(scale, 1)
            )


def test_eq_12_is_the_display_of_the_paper(toy, rng):
    """Two lead screws and a four-bar have the columns [s_1, s_2 + f s_3] and followers."""
    q = ca.SX.sym("q", len(toy.actuators))
    tip = finger_chain(toy.description, "left")
    assert tip.drivers == ("left_spread", "left_1", "left_2")
    motion = tip.evaluate(q)
    bar = mechanisms.Linkage(0.0297, 0.0347, 0.0084, 0.0072, -1)
    f = mechanisms.theta3_rate(3.32939008 + motion.joints["left_2"], bar)
    s = motion.screws.jacobian  # left_spread, left_1, left_2, left_3, left_4
    printed = ca.horzcat(s[:, 0], s[:, 1], s[:, 2] + f * (s[:, 3] - 0.5 * s[:, 4]))
    for row in toy.random(rng, 5):
        value, expected = evaluated(motion.joint_jacobian, printed, q=q, at=row)
        np.testing.assert_allclose(value, expected, atol=1e-13)


def test_eqs_8_10_rates_are_those_of_the_couplings(toy, rng):
    """The closed forms of every coupling equal the derivative of the joint positions."""
    q = ca.SX.sym("q", len(toy.actuators))
    body = actuated(toy.description, q)
    for finger in toy.fingers:
        motion = finger_chain(toy.description, finger).evaluate(q)
        tip = motion.tip
        rates = ca.vertcat(*(motion._rate(name) for name in tip.drivers))
        assert np.array(ca.evalf(ca.densify(rates))).ravel() == pytest.approx(1)
        rows = [toy.description.joint_names.index(name) for name in tip.chain.joints]
        automatic = motion.screws.jacobian @ body.coupling[rows, list(tip.actuators)]
        for row in toy.random(rng, 5):
            ours, expected = evaluated(motion.jacobian, automatic, q=q, at=row)
            np.testing.assert_allclose(ours, expected, atol=1e-11 * np.abs(expected).max())


def test_eqs_15_16_relative_jacobian(toy, robot, rng):
    """The Jacobian equals the difference of both tips' twists, and central differences."""
    for body, reference, finger in (
        (toy, "left", "thumb"),
        (toy, "left", "right"),
        (robot, "finger_2", "thumb"),
        (robot, "finger_2", "finger_3"),
    ):
        q = ca.SX.sym("q", len(body.actuators))
        tip = relative_chain(body.description, reference, finger)
        motion = tip.evaluate(q)
        a, b = (finger_chain(body.description, name).evaluate(q) for name in (reference, finger))
        pose = dq.multiply(dq.conjugate(a.pose), b.pose)
        columns = []
        for index in tip.actuators:
            xi = sum(
                (
                    sign * m.jacobian[:, m.tip.actuators.index(index)]
                    for m, sign in ((b, 1), (a, -1))
                    if index in m.tip.actuators
                ),
                ca.SX.zeros(6, 1),
            )
            w, v = dq.act_on_line(dq.conjugate(a.pose), xi[3:], xi[:3])
            columns.append(ca.vertcat(v, w))
        outputs = (motion.pose, pose, motion.jacobian, ca.horzcat(*columns))
        for row in 0.1 * body.home + 0.9 * body.random(rng, 4):
            x, expected, jacobian, two_twists = evaluated(*outputs, q=q, at=row)
            sign = np.sign((x * expected)[:4].sum())
            np.testing.assert_allclose(x, sign * expected, atol=1e-12)
            scale = max(np.abs(two_twists).max(), 1)
            np.testing.assert_allclose(jacobian, two_twists, atol=1e-12 * scale)
            differences = twist_by_differences(tip, row)
            np.testing.assert_allclose(jacobian, differences[:, tip.actuators], atol=1e-6 * scale)


def test_eqs_15_16_signs_and_columns(toy):
    """Four joints move the thumb relative to the finger that eq. (15) prints with three columns."""
    tip = relative_chain(toy.description, "left", "thumb")
    assert tip.chain.joints == (
        *("left_4", "left_3", "left_2", "left_1", "left_spread"),
        *("thumb_turn", "thumb_slide", "thumb_bend"),
    )
    assert tip.drivers == ("left_2", "left_1", "left_spread", *tip.chain.joints[5:])
    motion = tip.evaluate(ca.SX.sym("q", len(toy.actuators)))
    assert motion.joint_jacobian.shape == (6, 6)
    signed = np.array(motion.displacement(ca.DM.ones(6, 1))).ravel()
    np.testing.assert_array_equal(signed, [-1, -1, -1, 1, 1, 1])


def test_relative_chain_leaves_the_arm_out(robot):
    tip = relative_chain(robot.description, "finger_2", "thumb")
    assert not any(name.startswith("lwr") for name in tip.chain.joints)
    with pytest.raises(ik.errors.InputError, match="'thumb'"):
        relative_chain(robot.description, "thumb", "thumb")


def test_reference_pose_is_that_of_all_joints_at_zero(robot):
    chain = screw_chain_to_contact(robot.description, "thumb")
    assert chain.joints[:2] == ("lwr_joint_1", "lwr_joint_2")
    assert chain.joints[-2:] == ("bh_thumb_proximal", "bh_thumb_distal")
    points, _ = robot.contacts(np.zeros(14))
    start = np.array(dq.translation(ca.DM(chain.reference))).ravel()
    np.testing.assert_allclose(start, points[0], atol=1e-15)
    np.testing.assert_allclose(chain.screws[0].moment, 0, atol=1e-15)
    # Joint 2 turns about -y at the height of the shoulder.
    np.testing.assert_allclose(chain.screws[1].moment, [0.3105, 0, 0], atol=1e-15)
    with pytest.raises(ik.errors.UnknownNameError, match="no finger 'x'"):
        screw_chain_to_contact(robot.description, "x")


@PROPERTY
@given(rotation_vectors, vectors, rotation_vectors, vectors, st.floats(0.05, 1))
def test_eqs_13_14_17_the_control_twist_removes_its_part_of_the_error(w1, p1, w2, p2, gain):
    """Following -gain log(e) for unit time leaves the error e^(1 - gain): both are one screw."""
    current, desired = (dq.exp(ca.DM(w), ca.DM(p)) for w, p in ((w1, p1), (w2, p2)))
    e = dq.error(current, desired)
    if abs(float(e[0])) < 1e-2:  # half a turn: two ways round
        return
    w, v = dq.control_twist(e, gain)
    after = dq.error(dq.multiply(dq.exp(w, v), current), desired)
    norm_before = float(dq.screw_error_norm(e))
    assert float(dq.screw_error_norm(after)) == pytest.approx((1 - gain) * norm_before, abs=1e-10)
    whole_twist = dq.log(e)
    assert norm_before == pytest.approx(
        np.linalg.norm(np.array(ca.vertcat(*whole_twist))), abs=1e-12
    )
    # The same error in SE(3): T_c T_d^-1.
    R, p = se3.compose(dq.to_pose(current), se3.inverse(dq.to_pose(desired)))
    twist = np.array(se3.log_se3((R, p))).ravel()
    np.testing.assert_allclose(np.array(ca.vertcat(*whole_twist[::-1])).ravel(), twist, atol=1e-9)
