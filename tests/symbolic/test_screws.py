"""Product of exponentials by dual quaternions (Chandra) against frames multiplied (SE(3))."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.errors import UnknownNameError
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic.kinematics import actuated, forward
from casadi_ik.symbolic.screws import screw_chain_to_contact, screw_chain_to_link


@pytest.fixture(params=["shipped", "coupled"])
def any_robot(request, robot, coupled_robot):
    return robot if request.param == "shipped" else coupled_robot


def symbols(robot):
    theta = ca.SX.sym("theta", len(robot.description.movable))
    index = {name: i for i, name in enumerate(robot.description.joint_names)}
    return theta, lambda chain: theta[[index[name] for name in chain.joints]]


def evaluated(f, theta):
    return [np.array(value) for value in f.call([ca.DM(theta)])]


def random_theta(robot, rng, count):
    d = robot.description
    return rng.uniform(d.joint_lower, d.joint_upper, (count, len(d.movable)))


def test_contact_frames(any_robot, rng):
    theta, of = symbols(any_robot)
    kinematics = forward(any_robot.description, theta)
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        pose = chain.at(of(chain)).pose
        expected = kinematics.contact_frame(finger)
        f = ca.Function(
            "f",
            [theta],
            [*dq.to_pose(pose), dq.norm(pose), ca.densify(expected.rotation), expected.origin],
        )
        for row in random_theta(any_robot, rng, 10):
            R, p, norm, R_se3, p_se3 = evaluated(f, row)
            np.testing.assert_allclose(R, R_se3, atol=1e-12)
            np.testing.assert_allclose(p, p_se3, atol=1e-12)
            np.testing.assert_allclose(norm.ravel(), [1, 0], atol=1e-13)


def test_links(any_robot, rng):
    theta, of = symbols(any_robot)
    kinematics = forward(any_robot.description, theta)
    row = random_theta(any_robot, rng, 1)[0]
    for link in any_robot.description.links:
        chain = screw_chain_to_link(any_robot.description, link)
        expected = kinematics.links[link]
        f = ca.Function(
            "f",
            [theta],
            [
                *dq.to_pose(chain.at(of(chain)).pose),
                ca.densify(expected.rotation),
                ca.densify(expected.origin),
            ],
        )
        R, p, R_se3, p_se3 = evaluated(f, row)
        np.testing.assert_allclose(R, R_se3, atol=1e-12)
        np.testing.assert_allclose(p, p_se3, atol=1e-12)


def test_axes_are_the_lines_the_joints_turn_about(any_robot, rng):
    """Eq. (6): the direction is the joint's axis and the line runs through its frame."""
    theta, of = symbols(any_robot)
    kinematics = forward(any_robot.description, theta)
    children = {joint.name: joint.child for joint in any_robot.description.movable}
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        axes = chain.at(of(chain)).axes
        outputs = []
        for name, (direction, moment) in zip(chain.joints, axes, strict=True):
            axis = kinematics.axes[name]
            outputs += [
                direction - axis,
                moment - ca.cross(kinematics.links[children[name]].origin, axis),
            ]
        f = ca.Function("f", [theta], [ca.densify(ca.horzcat(*outputs))])
        for row in random_theta(any_robot, rng, 5):
            assert np.abs(evaluated(f, row)[0]).max() < 1e-12


def test_screw_jacobian_over_the_motors(any_robot, rng):
    """Eqs. (5) and (12): couplings by the chain rule, then the reference point moved to the tip."""
    q = ca.SX.sym("q", len(any_robot.actuators))
    body = actuated(any_robot.description, q)
    everything = range(q.numel())
    index = {name: i for i, name in enumerate(any_robot.description.joint_names)}
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        rows = [index[name] for name in chain.joints]
        screws = chain.at(body.kinematics.theta[rows]).jacobian @ body.coupling[rows, :]
        point, _ = body.kinematics.contact(finger)
        moved = screws[:3, :] + ca.horzcat(*(ca.cross(screws[3:, i], point) for i in everything))
        linear, angular = body.contact_jacobian(finger, everything)
        f = ca.Function(
            "f", [q], [ca.densify(ca.vertcat(moved, screws[3:, :])), ca.vertcat(linear, angular)]
        )
        for row in any_robot.random(rng, 5):
            ours, geometric = (np.array(x) for x in f.call([ca.DM(row)]))
            scale = np.abs(geometric).max()
            assert scale > 0.1
            np.testing.assert_allclose(ours, geometric, atol=1e-12 * scale)


def test_reference_pose_is_that_of_all_joints_at_zero(robot):
    chain = screw_chain_to_contact(robot.description, "thumb")
    assert chain.joints[:2] == ("lwr_joint_1", "lwr_joint_2")
    assert chain.joints[-2:] == ("bh_thumb_proximal", "bh_thumb_distal")
    points, _ = robot.contacts(np.zeros(14))
    start = np.array(dq.translation(ca.DM(chain.reference))).ravel()
    np.testing.assert_allclose(start, points[0], atol=1e-15)
    np.testing.assert_allclose(chain.screws[0].moment, 0, atol=1e-15)
    # Joint 2 turns about -y at the shoulder's height.
    np.testing.assert_allclose(chain.screws[1].moment, [0.3105, 0, 0], atol=1e-15)


def test_unknown_names(robot):
    with pytest.raises(UnknownNameError, match="no finger 'x'"):
        screw_chain_to_contact(robot.description, "x")
    with pytest.raises(UnknownNameError, match="no link 'x'"):
        screw_chain_to_link(robot.description, "x")
