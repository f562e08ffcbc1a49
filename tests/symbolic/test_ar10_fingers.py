"""The AR10's fingers: the paper's Jacobians by name, round trips over the stroke, reduced NLP."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.robots import FourBar, LeadScrew
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic import mechanisms
from casadi_ik.symbolic.couplings import linkage
from casadi_ik.symbolic.screws import finger_chain, relative_chain


@pytest.fixture(scope="module")
def ar10() -> ik.ArmHand:
    return ik.load_robot("ar10")


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
    assert isinstance(bar, FourBar)
    f = mechanisms.theta3_rate(bar.phi_0 + motion.joints["index_middle"], linkage(bar, bar))
    s = motion.screws.jacobian
    printed = ca.horzcat(s[:, 0], s[:, 1] + f * s[:, 2])
    rates = []
    for name in tip.drivers:
        screw = joint(ar10, name).coupling
        assert isinstance(screw, LeadScrew)
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
        if isinstance(coupling, LeadScrew):
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
    assert isinstance(distal, FourBar)
    assert isinstance(middle, LeadScrew)
    assert isinstance(proximal, LeadScrew)
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
