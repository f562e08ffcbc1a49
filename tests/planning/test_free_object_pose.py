"""Object poses with free components: the verdict is about all poses within the bounds."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_ik as ik


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("kuka_lwr_barrett"))


@pytest.fixture(scope="module")
def cup():
    """The grasp `cup` about the mean of its contacts."""
    grasp = ik.load_grasp("cup")
    to_middle = np.eye(4)
    to_middle[:3, 3] = -np.mean([contact.point for contact in grasp.contacts.values()], axis=0)
    return grasp.at(to_middle)


def within(grasp, min_x, max_x):
    bounds = ik.Free([min_x, -0.3, 0.3, 0, 0, -3], [max_x, 0.3, 0.6, 0, 0, 3])
    return replace(grasp, object_pose=bounds)


def test_an_unreachable_center_is_no_verdict_about_all_poses(solver, cup):
    solution = solver.solve(within(cup, 1.0, 2.5))
    assert solution.status is ik.Status.NOT_FOUND
    assert solution.diagnosis.proof is None
    assert solver.solve(within(cup, 1.0, 1.1)).status is ik.Status.SOLVED


def test_a_box_that_is_out_of_reach_throughout_is_proved_unreachable(solver, cup):
    solution = solver.solve(within(cup, 1.3, 2.5))
    assert solution.status is ik.Status.UNREACHABLE
    assert solution.diagnosis.established


def test_contacts_that_no_hand_fits_are_unreachable_at_every_pose(solver, cup):
    contacts = dict(cup.contacts)
    finger, contact = next(iter(contacts.items()))
    contacts[finger] = replace(contact, point=contact.point + np.array([1.0, 0.0, 0.0]))
    stretched = replace(cup, contacts=contacts)
    solution = solver.solve(within(stretched, 0.5, 2.5))
    assert solution.status is ik.Status.UNREACHABLE
    assert solution.diagnosis.reason is ik.solve.Reason.HAND


def test_palm_poses_move_with_the_object(solver):
    robot = solver.robot
    (q,) = robot.random(np.random.default_rng(4), 1)
    palm = robot.palm(q)
    hand = dict(zip(robot.actuators, q.tolist(), strict=True))
    posture = {name: hand[name] for name in robot.description.finger_motors}
    offset = np.eye(4)
    offset[:3, 3] = [0.02, -0.01, 0.0]
    at_origin = ik.Grasp(palm=np.linalg.inv(offset) @ palm, posture=posture)
    bounds = ik.Free([0, -0.02, 0, 0, 0, 0], [0.04, 0, 0, 0, 0, 0])
    solution = solver.solve(replace(at_origin, object_pose=bounds))
    assert solution.success
    palm_at_object = solution.object_pose @ at_origin.palm
    assert np.allclose(robot.palm(solution.q)[:3, 3], palm_at_object[:3, 3], atol=5e-3)
