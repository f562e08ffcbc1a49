"""Arm and reversed thumb as one closed chain: Jacobians, mobility and active joints."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from robot_variants import thumb_of

import casadi_ik as ik
from casadi_ik.kinematics.closed_chain import VIRTUAL, closed_chain, mobility, pivoted, split
from casadi_ik.kinematics.contacts import LENGTH, ContactRows, point_normal_kinds
from casadi_ik.kinematics.forward import actuated, motor_scales
from casadi_ik.solve.thumb_first.closed_chain_step import (
    THUMB_DAMPING,
    LinearisedContacts,
    StepLimits,
    linearise_contacts,
    solve_by_fixing,
    solve_by_proxqp,
)

SPREAD, THUMB_1, THUMB_2 = 7, 8, 9


@pytest.fixture(scope="module", params=[(1, "arm-leg"), (1, "palm"), (2, "palm"), (0, "arm-leg")])
def chain(request, robot):
    """Matrices of the chain and reference Jacobians, as a Function of q."""
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
        "J_cc": closed.J_cc,
        "H": closed.H,
        "platform": ca.vertcat(rotation.T @ linear, rotation.T @ angular),
        "thumb": ca.vertcat(*body.contact_jacobian("thumb", columns)),
        "normal": body.kinematics.contact("thumb")[1],
    }
    f = ca.Function(
        "f", [q, step], [ca.densify(x) for x in outputs.values()], ["q", "step"], list(outputs)
    )
    return parts, platform, lambda q, step: {k: np.array(v) for k, v in f(q=q, step=step).items()}


def samples(robot, rng, evaluate, count=25):
    """Return configurations away from singularities, with a random active step each."""
    chains = []
    for q in robot.random(rng, 20 * count):
        step = rng.normal(size=4)
        values = evaluate(q, step)
        if np.abs(values["H"]).max() < 50:
            chains.append((q, step, values))
        if len(chains) == count:
            return chains
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
    with pytest.raises(ik.errors.UnsupportedError, match=r"0 arm joints.*3 thumb joints"):
        split(coupled_robot.description)


@pytest.mark.parametrize("borrowed", [-1, 7, 8])
def test_borrowed_joints_belong_to_the_arm(robot, borrowed):
    with pytest.raises(ik.errors.UnsupportedError, match="borrowed: found"):
        split(robot.description, borrowed)


def test_thumb_keeps_its_contact(chain, robot, rng):
    """A step of the chain moves neither the thumb's contact point nor its normal."""
    _, _, evaluate = chain
    for _, _, values in samples(robot, rng, evaluate):
        motors, jacobian = values["motors"].ravel(), values["thumb"]
        translation_bound = np.abs(jacobian[:3]) @ np.abs(motors)
        np.testing.assert_array_less(np.abs(jacobian[:3] @ motors), 1e-9 * translation_bound)
        rotation_bound = np.abs(jacobian[3:]) @ np.abs(motors)
        normal = values["normal"].ravel()
        slip = np.cross(jacobian[3:] @ motors, normal)
        assert np.linalg.norm(slip) < 1e-9 * np.linalg.norm(rotation_bound)
        # It turns about its normal at the rate of the virtual joint.
        assert abs(normal @ jacobian[3:] @ motors) > 1e-6


def test_virtual_joint_rotates_about_the_normal(chain, robot, rng):
    parts, _, evaluate = chain
    at = parts.active.index(VIRTUAL)
    for _, step, values in samples(robot, rng, evaluate, 5):
        spin = values["normal"].ravel() @ values["thumb"][3:] @ values["motors"].ravel()
        # Reversed: the hand turns about the resting tip like the tip would turn in the hand.
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
    """J_cc times the active step is the arm's Jacobian times the steps of the motors."""
    _, _, evaluate = chain
    for _, step, values in samples(robot, rng, evaluate):
        expected = values["platform"] @ values["motors"].ravel()
        scale = np.abs(values["J_cc"]) @ np.abs(step)
        np.testing.assert_array_less(np.abs(values["J_cc"] @ step - expected), 1e-9 * scale)


def ranks(jacobian) -> int:
    s = np.linalg.svd(jacobian, compute_uv=False)
    return int(np.sum(s > 1e-9 * s[0]))


def test_palm_has_rank_three_and_link_6_rank_four(chain, robot, rng):
    """The fourth mobility leaves the palm at rest."""
    parts, platform, evaluate = chain
    # Without a borrowed joint the arm leg ends at the palm as well.
    expected = 3 if platform == "palm" or len(parts.arm_leg) == 7 else 4
    for _, _, values in samples(robot, rng, evaluate, 10):
        assert ranks(values["J_cc"]) == expected


def matrices(robot, platform="palm"):
    """Return the Function of q: C, J_cc, motor steps, rows of the thumb, normal."""
    n = len(robot.actuators)
    q = ca.SX.sym("q", n)
    body, parts = actuated(robot.description, q), split(robot.description)
    chain = closed_chain(body, parts, LENGTH, platform)
    step = ca.SX.sym("step", len(parts.active))
    motors = ca.jacobian(chain.motor_steps(step, n), step)
    thumb = body.contact_jacobian(robot.thumb, range(n))
    normal = body.kinematics.contact(robot.thumb)[1]
    outputs = [chain.constraint, chain.J_cc, motors, *thumb, normal]
    function = ca.Function("matrices", [q], [ca.densify(x) for x in outputs])
    return parts, lambda row: [np.array(x) for x in function.call([ca.DM(row)])]


def test_pivoting_finds_rank_and_independent_columns(rng):
    for rank, k in ((6, 10), (4, 10), (3, 3), (1, 5)):
        C = rng.normal(size=(6, rank)) @ rng.normal(size=(rank, k))
        active, passive = pivoted(C)
        assert sorted(active + passive) == list(range(k))
        assert len(passive) == rank
        assert mobility(C) == k - rank
        assert np.linalg.matrix_rank(C[:, list(passive)]) == rank
    assert pivoted(np.zeros((6, 3))) == ((0, 1, 2), ())
    assert mobility(np.zeros((6, 0))) == 0


@pytest.fixture(scope="module", params=[1, 2, 3, 4])
def derived(request, tmp_path_factory):
    """Shipped arm with a thumb of one to four joints."""
    return request.param, thumb_of(tmp_path_factory.mktemp("thumb"), request.param)


def test_mobility_is_computed(derived, rng):
    joints, robot = derived
    parts, evaluate = matrices(robot)
    assert len(parts.columns) == 8 + joints
    assert len(parts.active) == joints + 2
    assert len(parts.passive) == 6
    assert parts.active[0] == VIRTUAL
    for q in robot.random(rng, 10):
        assert mobility(evaluate(q)[0]) == joints + 2


def test_palm_moves_as_the_thumb_permits(derived, rng):
    """The rank of the palm's J_cc is that of virtual joint and thumb, at most six."""
    joints, robot = derived
    _, evaluate = matrices(robot)
    checked = 0
    for q in robot.random(rng, 60):
        _, J_cc, motors, *_ = evaluate(q)
        if np.abs(motors).max() > 30:
            continue
        s = np.linalg.svd(J_cc, compute_uv=False)
        assert np.sum(s > 1e-8 * s[0]) == min(joints + 1, 6)
        checked += 1
    assert checked > 3


def test_the_chain_is_the_null_space_of_the_thumbs_rows(derived, rng):
    """The chain spans the null space of three rows of the point and two of the normal."""
    joints, robot = derived
    _, evaluate = matrices(robot)
    columns = [*robot.description.arm_actuators, *robot.description.finger_actuators(robot.thumb)]
    checked = 0
    for q in robot.random(rng, 60):
        _, _, motors, linear, angular, normal = evaluate(q)
        if np.abs(motors).max() > 30:
            continue
        task = np.vstack([linear / LENGTH, (np.eye(3) - normal @ normal.T) @ angular])[:, columns]
        null = np.linalg.svd(task)[2][5:].T
        assert null.shape[1] == joints + 2
        chain = np.linalg.qr(motors[columns])[0]
        np.testing.assert_allclose(null @ (null.T @ chain), chain, atol=1e-8)
        checked += 1
    assert checked > 3


def test_h_rows_two_to_six_belong_to_the_arm(robot, rng):
    """With q_p of eq. (7) the first row is the thumb's, unlike in eq. (8) as printed."""
    q = ca.SX.sym("q", 14)
    body, parts = actuated(robot.description, q), split(robot.description)
    chain = closed_chain(body, parts)
    thumb_1 = robot.actuators.index("bh_thumb_proximal")
    order = [thumb_1, 0, 1, 2, 3, 4]
    H = chain.H[[parts.passive.index(c) for c in order], :]
    palm_axes = body.kinematics.palm.rotation.T
    twist = ca.vertcat(*(palm_axes @ rows for rows in body.palm_jacobian(range(6))))
    last = ca.DM([[0, 0, 0, 1]])
    assert parts.active == (VIRTUAL, robot.actuators.index("bh_thumb_distal"), 6, 5)
    right, printed = (twist @ ca.vertcat(rows, last) for rows in (H[1:, :], H[:5, :]))
    f = ca.Function("f", [q], [chain.J_cc, right, printed, chain.H])
    checked = 0
    for row in robot.random(rng, 40):
        J_cc, right_, printed_, H_ = (np.array(x) for x in f.call([ca.DM(row)]))
        if np.abs(H_).max() > 50:
            continue
        scale = np.linalg.norm(J_cc)
        assert np.linalg.norm(right_ - J_cc) < 1e-9 * scale
        assert np.linalg.norm(printed_ - J_cc) > 1e-2 * scale
        checked += 1
    assert checked > 5


WIDE = 1e3
ROWS = ContactRows(point_normal_kinds(3))


@pytest.fixture(scope="module")
def problem(robot):
    """Function (q, points, normals, weights) -> linear problem."""
    q, points = ca.SX.sym("q", 14), ca.SX.sym("points", 3, 3)
    normals, weights = ca.SX.sym("normals", 3, 3), ca.SX.sym("weights", 3, 2)
    p = {"points": points, "normals": normals, "weights": weights}
    linear = linearise_contacts(robot.description, ROWS, q, p)
    outputs = [linear.thumb, linear.thumb_error, linear.other_fingers, linear.other_fingers_error]
    return ca.Function("problem", [q, points, normals, weights], outputs)


@pytest.fixture(scope="module")
def steps(problem):
    """Both solvers as Functions (linear, lower, upper, damping) -> step, multipliers."""
    shapes = [problem.size_out(i) for i in range(4)] + [(14, 1), (14, 1), (1, 1)]
    symbols = [ca.MX.sym("x", *shape) for shape in shapes]
    return [
        ca.Function(
            "step", symbols, list(solve(LinearisedContacts(*symbols[:4]), StepLimits(*symbols[4:])))
        )
        for solve in (solve_by_fixing, solve_by_proxqp)
    ]


def cases(robot, rng, problem, count):
    """Yield linear problems near their targets, with the hand near its limits."""
    for q in robot.random(rng, count):
        q[7:] = np.where(rng.random(7) < 0.3, robot.lower[7:] + 0.02, q[7:])
        goal = np.clip(q + rng.uniform(-0.2, 0.2, 14), robot.lower, robot.upper)
        points, normals = robot.contacts(goal)
        linear = problem(q, points, normals, np.ones((3, 2)))
        yield q, [np.array(x) for x in linear]


def test_unlimited_variants_take_the_same_step(robot, problem, steps, rng):
    """The formula of the projector is the minimiser under the equations of the thumb."""
    unlimited = np.full(14, WIDE)
    for damping in (0.03, 1.0):
        for _, linear in cases(robot, rng, problem, 15):
            (step_a, multipliers), (step_b, _) = (
                f(*linear, -unlimited, unlimited, damping) for f in steps
            )
            step_a, step_b = np.array(step_a).ravel(), np.array(step_b).ravel()
            assert not np.array(multipliers).any()
            np.testing.assert_allclose(step_a, step_b, atol=1e-5 * max(1.0, np.abs(step_a).max()))
            thumb, error, rows, other_rows = linear
            # The thumb moves as its own damped step would move it.
            damped = thumb @ thumb.T + max(THUMB_DAMPING, damping) ** 2 * np.eye(5)
            expected_step = thumb @ thumb.T @ np.linalg.solve(damped, error)
            np.testing.assert_allclose(thumb @ step_a, expected_step.ravel(), atol=1e-6)
            # No motion of the closed chain would reduce the other errors further.
            null = np.linalg.svd(thumb)[2][5:].T
            slope = null.T @ (rows.T @ (rows @ step_a - other_rows.ravel()) + damping**2 * step_a)
            assert np.abs(slope).max() < 1e-4 * np.abs(null.T @ rows.T @ other_rows).max() + 1e-9


def test_both_variants_keep_limits(robot, problem, steps, rng):
    """Bound joints are at their limits, and the thumb keeps its contact as well as possible."""
    fixed, agree, total = 0, 0, 0
    for q, linear in cases(robot, rng, problem, 40):
        lower, upper = robot.lower - q, robot.upper - q
        (step_a, multipliers), (step_b, _) = (f(*linear, lower, upper, 0.03) for f in steps)
        step_a, step_b, multipliers = (np.array(x).ravel() for x in (step_a, step_b, multipliers))
        for step in (step_a, step_b):
            assert (step >= lower).all()
            assert (step <= upper).all()
        at = multipliers > 0
        np.testing.assert_allclose(
            np.minimum(step_a - lower, upper - step_a)[at],
            0.0,
            atol=1e-9,
            err_msg="held off its limit",
        )
        fixed += at.any()
        agree += np.abs(step_a - step_b).max() < 1e-3
        total += 1
    assert fixed > 10
    # Fixed joints are not released, unlike in the program: the answers rarely differ.
    assert agree > 0.7 * total


def test_units_of_sliders(robot, coupled_robot):
    assert np.array_equal(np.array(motor_scales(robot.description)).ravel(), np.ones(14))
    scales = np.array(motor_scales(coupled_robot.description)).ravel()
    screw = coupled_robot.actuators.index("screw_1")
    assert scales[screw] == pytest.approx(0.018)
    assert LENGTH == 0.1
