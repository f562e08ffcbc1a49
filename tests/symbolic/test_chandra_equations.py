"""The equations of Chandra et al. 2019, as they are printed and on the AR10."""

from __future__ import annotations

import inspect
import re

import casadi as ca
import numpy as np
import pytest
from algebra_samples import PROPERTY, rotation_vectors, unit_vectors, vectors
from hypothesis import given
from hypothesis import strategies as st
from toy_robots import write_coupled_robot

import casadi_ik as ik
from casadi_ik import robots
from casadi_ik.symbolic import couplings, mechanisms, screws, se3
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic.couplings import linkage
from casadi_ik.symbolic.kinematics import actuated
from casadi_ik.symbolic.screws import TipChain, finger_chain, relative_chain

EQUATIONS = {
    1: dq.exp_screw,
    2: dq.directed_line,
    3: screws.Screws.pose,
    4: dq.twist,
    5: screws.Screws.jacobian,
    6: dq.act_on_line,
    7: screws.Screws.displacements,
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


@pytest.fixture
def toy(tmp_path) -> ik.ArmHand:
    """Sliders, a four-bar, linear couplings, a shared motor, a prismatic joint."""
    return ik.load_robot(write_coupled_robot(tmp_path))


def evaluated(*expressions, q, at):
    f = ca.Function("f", [q], [ca.densify(x) for x in expressions])
    return [np.array(x) for x in f.call([ca.DM(at)])]


def twist_by_differences(tip: TipChain, at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Columns [v; w] = 2 x' x* over all actuators, x' by central differences."""
    q = ca.SX.sym("q", len(at))
    pose = ca.Function("pose", [q], [tip.at(q).pose])
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
def test_eqs_1_2_a_line_is_left_in_place_by_a_screw_about_it(w, moved, axis, point, distance):
    angle = float(np.linalg.norm(w))
    line = dq.directed_line(ca.DM(axis), ca.DM(point))
    x = dq.exp_screw(angle, distance, *line)
    assert float(ca.dot(*line)) == pytest.approx(0, abs=1e-14)
    np.testing.assert_allclose(np.array(dq.norm(x)).ravel(), [1, 0], atol=1e-14)
    for found, expected in zip(dq.act_on_line(x, *line), line, strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-13)
    along = dq.act_on_point(x, ca.DM(point)) - ca.DM(point)
    np.testing.assert_allclose(np.array(along).ravel(), distance * axis, atol=1e-13)
    # The same motion in SE(3): the twist theta (l, m) + d (0, l).
    R, p = se3.exp_se3(ca.vertcat(angle * line[1] + distance * line[0], angle * line[0]))
    np.testing.assert_allclose(np.array(dq.to_pose(x)[0]), np.array(R), atol=1e-12)
    np.testing.assert_allclose(np.array(dq.to_pose(x)[1]), np.array(p), atol=1e-12)


@pytest.mark.parametrize("kind", ["toy", "barrett"])
def test_eqs_3_to_7_12_finger_jacobians_are_the_tips_twist(kind, toy, robot, rng):
    """In slider space against differences; in joint space against the joints' own rates."""
    body = toy if kind == "toy" else robot
    q = ca.SX.sym("q", len(body.actuators))
    for finger in body.fingers:
        tip = finger_chain(body.description, finger)
        motion = tip.at(q)
        kinematics = actuated(body.description, q)
        frame = kinematics.kinematics.contact_frame(finger)
        point = dq.translation(motion.pose)
        geometric = kinematics.contact_jacobian(finger, tip.actuators)
        moved = motion.jacobian[:3, :] + ca.horzcat(
            *(ca.cross(column, point) for column in ca.horzsplit(motion.jacobian[3:, :]))
        )
        outputs = (*dq.to_pose(motion.pose), frame.rotation, frame.origin, motion.jacobian, moved)
        for row in 0.1 * body.home + 0.9 * body.random(rng, 5):
            values = evaluated(*outputs, *geometric, q=q, at=row)
            R, p, R_se3, p_se3, jacobian, linear, linear_se3, angular_se3 = values
            np.testing.assert_allclose(R, R_se3, atol=1e-12)
            np.testing.assert_allclose(p, p_se3, atol=1e-12)
            scale = np.abs(jacobian).max()
            np.testing.assert_allclose(linear, linear_se3, atol=1e-12 * scale)
            np.testing.assert_allclose(jacobian[3:], angular_se3, atol=1e-12 * scale)
            differences = twist_by_differences(tip, row)
            others = [i for i in range(len(row)) if i not in tip.actuators]
            assert np.abs(differences[:, others]).max(initial=0) == 0
            np.testing.assert_allclose(
                jacobian, differences[:, tip.actuators], atol=1e-6 * max(scale, 1)
            )


def test_eq_12_is_the_display_of_the_paper(toy, rng):
    """A finger of lead screw, lead screw and four-bar: [s_1, s_2 + f s_3], plus what follows."""
    q = ca.SX.sym("q", len(toy.actuators))
    tip = finger_chain(toy.description, "left")
    assert tip.drivers == ("left_spread", "left_1", "left_2")
    motion = tip.at(q)
    bar = mechanisms.Linkage(0.0297, 0.0347, 0.0084, 0.0072, -1)
    f = mechanisms.theta3_rate(3.32939008 + motion.joints["left_2"], bar)
    s = motion.screws.jacobian  # left_spread, left_1, left_2, left_3, left_4
    printed = ca.horzcat(s[:, 0], s[:, 1], s[:, 2] + f * (s[:, 3] - 0.5 * s[:, 4]))
    for row in toy.random(rng, 5):
        found, expected = evaluated(motion.joint_jacobian, printed, q=q, at=row)
        np.testing.assert_allclose(found, expected, atol=1e-13)


def test_eqs_8_10_rates_are_those_of_the_couplings(toy, rng):
    """The closed forms of every coupling against the derivative of the joint positions."""
    q = ca.SX.sym("q", len(toy.actuators))
    body = actuated(toy.description, q)
    for finger in toy.fingers:
        motion = finger_chain(toy.description, finger).at(q)
        tip = motion.tip
        rates = ca.vertcat(*(motion._rate(name) for name in tip.drivers))
        assert np.array(ca.evalf(ca.densify(rates))).ravel() == pytest.approx(1)
        rows = [toy.description.joint_names.index(name) for name in tip.chain.joints]
        automatic = motion.screws.jacobian @ body.coupling[rows, list(tip.actuators)]
        for row in toy.random(rng, 5):
            ours, expected = evaluated(motion.jacobian, automatic, q=q, at=row)
            np.testing.assert_allclose(ours, expected, atol=1e-11 * np.abs(expected).max())


def test_eqs_15_16_relative_jacobian(toy, robot, rng):
    """Against the difference of both tips' twists, and against central differences."""
    for body, reference, finger in (
        (toy, "left", "thumb"),
        (toy, "left", "right"),
        (robot, "finger_2", "thumb"),
        (robot, "finger_2", "finger_3"),
    ):
        q = ca.SX.sym("q", len(body.actuators))
        tip = relative_chain(body.description, reference, finger)
        motion = tip.at(q)
        a, b = (finger_chain(body.description, name).at(q) for name in (reference, finger))
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
    """Four joints move the thumb against the finger that eq. (15) prints with three columns."""
    tip = relative_chain(toy.description, "left", "thumb")
    assert tip.chain.joints == (
        *("left_4", "left_3", "left_2", "left_1", "left_spread"),
        *("thumb_turn", "thumb_slide", "thumb_bend"),
    )
    assert tip.drivers == ("left_2", "left_1", "left_spread", *tip.chain.joints[5:])
    motion = tip.at(ca.SX.sym("q", len(toy.actuators)))
    assert motion.joint_jacobian.shape == (6, 6)
    signed = np.array(motion.displacement(ca.DM.ones(6, 1))).ravel()
    np.testing.assert_array_equal(signed, [-1, -1, -1, 1, 1, 1])


def test_relative_chain_leaves_the_arm_out(robot):
    tip = relative_chain(robot.description, "finger_2", "thumb")
    assert not any(name.startswith("lwr") for name in tip.chain.joints)
    with pytest.raises(ik.errors.InputError, match="found 'thumb' twice"):
        relative_chain(robot.description, "thumb", "thumb")


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
    before = float(dq.screw_error_norm(e))
    assert float(dq.screw_error_norm(after)) == pytest.approx((1 - gain) * before, abs=1e-10)
    whole = dq.log(e)
    assert before == pytest.approx(np.linalg.norm(np.array(ca.vertcat(*whole))), abs=1e-12)
    # The same error in SE(3): T_c T_d^-1.
    R, p = se3.compose(dq.to_pose(current), se3.inverse(dq.to_pose(desired)))
    twist = np.array(se3.log_se3((R, p))).ravel()
    np.testing.assert_allclose(np.array(ca.vertcat(*whole[::-1])).ravel(), twist, atol=1e-9)


def joint(robot: ik.ArmHand, name: str):
    return next(each for each in robot.description.movable if each.name == name)


def test_eq_12_index(ar10, rng):
    """[s_1, s_2 + f s_3] with f of eq. (11), and every slider's column by eq. (8)'s derivative."""
    tip = finger_chain(ar10.description, "index")
    assert tip.chain.joints == ("index_proximal", "index_middle", "index_distal")
    assert tip.drivers == tip.chain.joints[:2]
    q = ca.SX.sym("q", 10)
    motion = tip.at(q)
    bar = joint(ar10, "index_distal").coupling
    assert isinstance(bar, robots.FourBar)
    f = mechanisms.theta3_rate(bar.phi_0 + motion.joints["index_middle"], linkage(bar, bar))
    s = motion.screws.jacobian
    printed = ca.horzcat(s[:, 0], s[:, 1] + f * s[:, 2])
    rates = []
    for name in tip.drivers:
        screw = joint(ar10, name).coupling
        assert isinstance(screw, robots.LeadScrew)
        slider = q[ar10.actuators.index(screw.of)]
        rates.append(mechanisms.angle_rate(slider, screw.b, screw.c))
    sliders = printed @ ca.diag(ca.vertcat(*rates))
    g = ca.Function("g", [q], [motion.joint_jacobian, printed, motion.jacobian, sliders])
    for row in ar10.random(rng, 10):
        joints, expected, over_sliders, expected_sliders = (np.array(x) for x in g.call([row]))
        np.testing.assert_allclose(joints, expected, atol=1e-13)
        np.testing.assert_allclose(over_sliders, expected_sliders, atol=1e-10)
        assert np.linalg.matrix_rank(joints) == 2


def test_eqs_15_16_index_to_thumb(ar10, rng):
    """[s_i2 + f s_i3, s_i1, s_t1, s_t2]: the display's three columns and the one it leaves out."""
    tip = relative_chain(ar10.description, "index", "thumb")
    assert tip.drivers == ("index_middle", "index_proximal", "thumb_1", "thumb_2")
    q = ca.SX.sym("q", 10)
    motion = tip.at(q)
    signs = np.array(motion.displacement(ca.DM.ones(4, 1))).ravel()
    np.testing.assert_array_equal(signs, [-1, -1, 1, 1])
    g = ca.Function("g", [q], [motion.joint_jacobian])
    for row in ar10.random(rng, 5):
        assert np.linalg.matrix_rank(np.array(g(row))) == 4


def test_round_trips_over_the_full_strokes(ar10):
    """Slider to joint to slider, and the middle joint back from the distal one's angle."""
    strokes = np.linspace(ar10.lower, ar10.upper, 401)
    joints = ar10.joints(strokes)
    turned = 0
    for each in ar10.description.movable:
        coupling = each.coupling
        if isinstance(coupling, robots.LeadScrew):
            slider = strokes[:, ar10.actuators.index(coupling.of)]
            theta = ca.DM(coupling.theta_0 + joints[each.name]).T
            back = mechanisms.slider_from_angle(theta, coupling.b, coupling.c)
            np.testing.assert_allclose(np.array(back).ravel(), slider, atol=1e-15)
            assert (np.diff(joints[each.name]) > 0).all()
        else:
            bar = linkage(coupling, coupling)
            for middle, distal in zip(joints[coupling.of], joints[each.name], strict=True):
                phi = coupling.phi_0 + middle
                branch = mechanisms.inverse_branch_from_pose(bar, phi)
                theta_3 = ca.DM(coupling.theta_3_0 + distal)
                back = mechanisms.phi_from_theta3(theta_3, bar, branch, phi)
                # Where the rate f passes through zero the inverse loses half the digits.
                assert float(back) == pytest.approx(phi, abs=1e-7)
                turned += 1
    assert turned == 4 * 401


@pytest.mark.parametrize("finger", ["index", "middle", "ring", "little"])
def test_ipopt_with_the_linkage_as_a_constraint_finds_the_reduced_answer(finger, ar10, rng):
    """The last joint as an unknown tied by the loop's closure, against the joint substituted."""
    names = [f"{finger}_{part}" for part in ("proximal", "middle", "distal")]
    proximal, middle, distal = (joint(ar10, name).coupling for name in names)
    assert isinstance(distal, robots.FourBar)
    assert isinstance(middle, robots.LeadScrew)
    assert isinstance(proximal, robots.LeadScrew)
    tip = finger_chain(ar10.description, finger)
    columns = list(tip.actuators)
    lower, upper = ar10.lower[columns], ar10.upper[columns]
    target = ca.SX.sym("target", 3)
    options = {
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "acceptable_iter": 0},
        "print_time": False,
    }
    options["ipopt"] |= {"bound_relax_factor": 0.0, "dual_inf_tol": 1e-10, "constr_viol_tol": 1e-12}

    # Reduced: two sliders, everything else substituted. Sliders in units of 10 mm.
    x = ca.SX.sym("x", 2)
    q = ca.SX(ar10.home.reshape(-1, 1))
    q[columns] = 0.01 * x
    miss = 100 * (dq.translation(tip.at(q).pose) - target)
    reduced = ca.nlpsol("reduced", "ipopt", {"x": x, "p": target, "f": ca.dot(miss, miss)}, options)

    # With constraints: three joints and two sliders, triangles (8) and the four-bar's closure.
    y = ca.SX.sym("y", 5)
    theta, sliders = y[:3], 0.01 * y[3:]
    miss = 100 * (dq.translation(tip.chain.at(theta).pose) - target)
    phi = distal.phi_0 + theta[1]
    beta = phi + distal.theta_3_0 + theta[2]
    x_end = distal.p * ca.cos(phi) + distal.h * ca.cos(beta) - distal.g
    y_end = distal.p * ca.sin(phi) + distal.h * ca.sin(beta)
    closure = (x_end**2 + y_end**2) / distal.q**2 - 1
    triangles = [
        (c.b**2 + c.c**2 - 2 * c.b * c.c * ca.cos(c.theta_0 + theta[i]) - sliders[i] ** 2) * 1e4
        for i, c in enumerate((proximal, middle))
    ]
    full = ca.nlpsol(
        "full",
        "ipopt",
        {
            "x": y,
            "p": target,
            "f": ca.dot(miss, miss),
            "g": ca.vertcat(closure, *triangles),
        },
        options,
    )

    home = ar10.joints(ar10.home)
    begin = [*(home[name] for name in names), *(100 * ar10.home[columns])]
    limits = {"lbx": 100 * lower, "ubx": 100 * upper}
    free = np.full(3, np.inf)
    full_limits = {"lbx": [*-free, *limits["lbx"]], "ubx": [*free, *limits["ubx"]]}
    index = ar10.fingers.index(finger)
    for _ in range(4):
        # Beside a reachable point, off the finger's plane: the optimum is no exact hit.
        goal = ar10.home.copy()
        goal[columns] = rng.uniform(0.8 * lower + 0.2 * upper, 0.2 * lower + 0.8 * upper)
        point = ar10.contacts(goal)[0][index] + [0.004, 0, 0]
        a = reduced(x0=100 * ar10.home[columns], p=point, **limits)
        b = full(x0=begin, p=point, lbg=0, ubg=0, **full_limits)
        assert reduced.stats()["success"]
        assert full.stats()["success"], full.stats()["return_status"]
        found, tied = np.array(a["x"]).ravel(), np.array(b["x"]).ravel()
        np.testing.assert_allclose(0.01 * tied[3:], 0.01 * found, atol=1e-9)
        q_found = ar10.home.copy()
        q_found[columns] = 0.01 * found
        joints = ar10.joints(q_found)
        np.testing.assert_allclose(tied[:3], [joints[name] for name in names], atol=1e-9)
        np.testing.assert_allclose(0.01 * found, goal[columns], atol=1e-6)
