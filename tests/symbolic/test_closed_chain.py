"""The arm-thumb closed chain of Qiu & Kermani, eqs. (6) to (8)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.errors import UnsupportedError
from casadi_ik.symbolic.closed_chain import VIRTUAL, closed_chain, split
from casadi_ik.symbolic.kinematics import actuated

SPREAD, THUMB_1, THUMB_2 = 7, 8, 9


@pytest.fixture(scope="module", params=[(1, "arm-leg"), (1, "palm"), (2, "palm"), (0, "arm-leg")])
def chain(request, robot):
    """The chain's matrices and the Jacobians they are checked with, as one Function of q."""
    borrowed, platform = request.param
    q, step = ca.SX.sym("q", 14), ca.SX.sym("step", 4)
    body = actuated(robot.description, q)
    parts = split(robot.description, borrowed)
    closed = closed_chain(body, parts, platform=platform)
    columns = range(14)
    ends_at_palm = platform == "palm" or borrowed == 0
    last = "lwr_flange" if ends_at_palm else f"lwr_link_{7 - borrowed}"
    linear, angular = body.twist(last, body.kinematics.palm.origin, columns)
    rotation = body.kinematics.palm.rotation
    outputs = {
        "motors": closed.motor_steps(step, 14),
        "constraint": closed.constraint,
        "J_cc": closed.J_cc,
        "H": closed.H,
        "platform": ca.vertcat(rotation.T @ linear, rotation.T @ angular),
        "thumb": ca.vertcat(*body.contact_jacobian("thumb", columns)),
        "normal": body.kinematics.contact("thumb")[1],
        "palm": body.palm_body_jacobian(columns),
    }
    f = ca.Function(
        "f", [q, step], [ca.densify(x) for x in outputs.values()], ["q", "step"], list(outputs)
    )
    return parts, platform, lambda q, step: {k: np.array(v) for k, v in f(q=q, step=step).items()}


def samples(robot, rng, evaluate, count=25):
    """Configurations away from the chain's singularities, with a random active step each."""
    found = []
    for q in robot.random(rng, 20 * count):
        step = rng.normal(size=4)
        values = evaluate(q, step)
        if np.abs(values["H"]).max() < 50:
            found.append((q, step, values))
        if len(found) == count:
            return found
    raise AssertionError("hardly any regular configuration")


def test_the_papers_choice(robot):
    parts = split(robot.description)
    assert len(parts.active) == 4, "Gruebler: 1 + 2 + 7 - 6"
    assert parts.active == (VIRTUAL, THUMB_2, 6, 5)
    assert parts.reversed_leg == (VIRTUAL, THUMB_2, THUMB_1, 6)
    assert parts.arm_leg == (0, 1, 2, 3, 4, 5)
    assert sorted(parts.passive) == [0, 1, 2, 3, 4, THUMB_1]
    assert sorted(parts.columns) == sorted(parts.active + parts.passive)


def test_no_closed_chain_without_an_arm(coupled_robot):
    with pytest.raises(UnsupportedError, match=r"arm \(0\), thumb \(3\).*at least six joints"):
        split(coupled_robot.description)


@pytest.mark.parametrize("borrowed", [-1, 7, 8])
def test_borrowed_joints_are_the_arms(robot, borrowed):
    with pytest.raises(UnsupportedError, match="cannot borrow"):
        split(robot.description, borrowed)


def test_thumb_keeps_its_contact(chain, robot, rng):
    """A step of the chain moves neither the thumb's contact point nor its normal."""
    _, _, evaluate = chain
    for _, _, values in samples(robot, rng, evaluate):
        motors, jacobian = values["motors"].ravel(), values["thumb"]
        moved = np.abs(jacobian[:3]) @ np.abs(motors)
        np.testing.assert_array_less(np.abs(jacobian[:3] @ motors), 1e-9 * moved)
        turned = np.abs(jacobian[3:]) @ np.abs(motors)
        normal = values["normal"].ravel()
        slip = np.cross(jacobian[3:] @ motors, normal)
        assert np.linalg.norm(slip) < 1e-9 * np.linalg.norm(turned)
        # It turns about its normal though, at the virtual joint's rate.
        assert abs(normal @ jacobian[3:] @ motors) > 1e-6


def test_virtual_joint_is_the_turn_about_the_normal(chain, robot, rng):
    parts, _, evaluate = chain
    at = parts.active.index(VIRTUAL)
    for _, step, values in samples(robot, rng, evaluate, 5):
        spin = values["normal"].ravel() @ values["thumb"][3:] @ values["motors"].ravel()
        # Reversed: the hand turns about the resting tip as the tip would turn in the hand.
        assert spin == pytest.approx(step[at], rel=1e-7, abs=1e-9)


def test_active_motors_take_their_step(chain, robot, rng):
    parts, _, evaluate = chain
    _, step, values = samples(robot, rng, evaluate, 1)[0]
    motors = values["motors"].ravel()
    for value, column in zip(step, parts.active, strict=True):
        if column != VIRTUAL:
            sign = -1 if column in parts.reversed_leg else 1
            assert motors[column] == pytest.approx(sign * value, rel=1e-12)
    assert not motors[[SPREAD, 10, 11, 12, 13]].any()


def test_jacobian_is_the_platforms_twist(chain, robot, rng):
    """J_cc times the active step is what the arm's Jacobian makes of the motors' steps."""
    _, _, evaluate = chain
    for _, step, values in samples(robot, rng, evaluate):
        expected = values["platform"] @ values["motors"].ravel()
        scale = np.abs(values["J_cc"]) @ np.abs(step)
        np.testing.assert_array_less(np.abs(values["J_cc"] @ step - expected), 1e-9 * scale)


def test_constraint_vanishes_on_motor_steps(chain, robot, rng):
    """Eq. (6) over the coordinates of both legs."""
    parts, _, evaluate = chain
    for _, step, values in samples(robot, rng, evaluate, 5):
        motors = values["motors"].ravel()
        coordinates = [
            step[parts.active.index(VIRTUAL)]
            if column == VIRTUAL
            else (-1 if column in parts.reversed_leg else 1) * motors[column]
            for column in parts.columns
        ]
        scale = np.abs(values["constraint"]) @ np.abs(coordinates)
        residual = np.abs(values["constraint"] @ coordinates)
        np.testing.assert_array_less(residual, 1e-9 * scale)


def ranks(jacobian) -> int:
    s = np.linalg.svd(jacobian, compute_uv=False)
    return int(np.sum(s > 1e-9 * s[0]))


def test_palm_has_rank_three_and_link_6_rank_four(chain, robot, rng):
    """Facts on methods, section 2: the fourth mobility leaves the palm at rest."""
    parts, platform, evaluate = chain
    # Nothing borrowed, the arm leg ends at the palm as well.
    expected = 3 if platform == "palm" or len(parts.arm_leg) == 7 else 4
    for _, _, values in samples(robot, rng, evaluate, 10):
        assert ranks(values["J_cc"]) == expected


def test_orientation_has_nothing_left_of_the_palms_position(robot, rng):
    """With the palm as platform |J_o N_p| vanishes; with link 6 it does not."""
    for platform, vanishes in (("palm", True), ("arm-leg", False)):
        q = ca.SX.sym("q", 14)
        closed = closed_chain(
            actuated(robot.description, q), split(robot.description), 1.0, platform
        )
        f = ca.Function("f", [q], [closed.J_cc, closed.H])
        remainders = []
        for row in robot.random(rng, 40):
            J, H = (np.array(x) for x in f.call([ca.DM(row)]))
            if np.abs(H).max() < 50:
                null = np.eye(4) - np.linalg.pinv(J[:3], rcond=1e-9) @ J[:3]
                remainders.append(np.linalg.norm(J[3:] @ null) / np.linalg.norm(J[3:]))
        assert len(remainders) > 5
        assert (max(remainders) < 1e-8) if vanishes else (np.median(remainders) > 1e-2)


def test_palm_twists_are_the_thumb_tasks_null_space(robot, rng):
    """Facts on methods, section 2: the chain is one parametrisation of that null space."""
    q, step = ca.SX.sym("q", 14), ca.SX.sym("step", 4)
    body = actuated(robot.description, q)
    closed = closed_chain(body, split(robot.description))
    arm_thumb = [*range(7), THUMB_1, THUMB_2]
    linear, angular = body.contact_jacobian("thumb", arm_thumb)
    f = ca.Function(
        "f",
        [q, step],
        [
            closed.motor_steps(step, 14),
            linear,
            angular,
            body.kinematics.contact("thumb")[1],
            closed.H,
        ],
    )
    checked = 0
    for row in robot.random(rng, 40):
        steps = []
        for unit in np.eye(4):
            motors, linear_, angular_, normal, H = (
                np.array(x) for x in f.call([ca.DM(row), ca.DM(unit)])
            )
            steps.append(motors.ravel()[arm_thumb])
        if np.abs(H).max() > 50:
            continue
        n = normal.ravel()
        task = np.vstack([linear_, (np.eye(3) - np.outer(n, n)) @ angular_])
        assert ranks(np.array(steps)) == 4
        assert ranks(task) == 5
        assert np.abs(task @ np.array(steps).T).max() < 1e-9 * np.abs(steps).max()
        checked += 1
    assert checked > 5


def test_length_scales_the_linear_rows_only(robot, rng):
    q = ca.SX.sym("q", 14)
    body = actuated(robot.description, q)
    metres, millimetres = (
        closed_chain(body, split(robot.description), length).J_cc for length in (1.0, 1e-3)
    )
    f = ca.Function("f", [q], [metres, millimetres])
    m, mm = (np.array(x) for x in f.call([ca.DM(robot.home)]))
    np.testing.assert_allclose(mm[:3], 1e3 * m[:3], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(mm[3:], m[3:], rtol=1e-8, atol=1e-12)
