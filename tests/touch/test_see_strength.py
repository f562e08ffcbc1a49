"""What grasps that are found squeeze with, and how they bear that the object is elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import casadi_ik as ik
from casadi_ik.errors import InputError

PLACE = np.eye(4)
PLACE[:3, 3] = [0.5, 0.1, 0.055]


@pytest.fixture(scope="module")
def can(tmp_path_factory):
    path = tmp_path_factory.mktemp("strength") / "can.stl"
    trimesh.creation.cylinder(0.033, 0.1, sections=128).export(path)
    return ik.load_surface(path)


@pytest.fixture(scope="module", params=["panda+panda_hand", "panda+allegro_right"])
def found(request, can):
    solver = ik.Solver(ik.load_robot(request.param), scene=ik.load_scene("table"))
    return solver.grasps_of(can, PLACE, limit=10, seed=1)


def test_forces_leave_the_object_at_rest_within_friction(found):
    for one in found:
        contacts = one.grasp.contacts
        forces = np.array([one.forces[name] for name in contacts])
        points = np.array([contact.point for contact in contacts.values()])
        # The can's exact normals, on its side or on a lid.
        local = points - PLACE[:3, 3]
        lid = np.abs(local[:, 2]) > 0.0495
        inward = -np.where(lid[:, None], local * [0, 0, 1], local * [1, 1, 0])
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        pressed = (forces * inward).sum(axis=1)
        slid = np.linalg.norm(forces - pressed[:, None] * inward, axis=1)
        np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-6)
        # What is left is held by the pads' torsion: at most 2/3 mu 5 mm of 1 N.
        torque = np.cross(points - PLACE[:3, 3], forces).sum(axis=0)
        assert np.linalg.norm(torque) < 2 / 3 * found.mu * 5e-3 + 1e-3
        assert pressed.sum() == pytest.approx(1.0, abs=0.02)
        assert (slid <= found.mu * pressed + 0.03).all()  # normals of samples are of flat facets


def test_motors_squeeze_as_equal_springs_do(found):
    """A squeeze moves motors in proportion to the torques of the forces, by virtual work."""
    robot = found.robot
    for one in found[:3]:
        posture = one.grasp.squeeze.posture
        columns = [robot.actuators.index(name) for name in posture]
        moved = np.array(list(posture.values())) - one.q[columns]
        torques = []
        for column in columns:
            step = np.zeros(len(one.q))
            step[column] = 1e-6
            slope = (robot.contacts(one.q + step)[0] - robot.contacts(one.q - step)[0]) / 2e-6
            pairs = one.forces.items()
            torques.append(sum(slope[robot.fingers.index(name)] @ f for name, f in pairs))
        inside = (np.array(list(posture.values())) > robot.lower[columns] + 1e-6) & (
            np.array(list(posture.values())) < robot.upper[columns] - 1e-6
        )
        ratio = moved[inside] @ np.array(torques)[inside] / (np.array(torques)[inside] ** 2).sum()
        assert ratio > 0
        np.testing.assert_allclose(moved[inside], ratio * np.array(torques)[inside], atol=1e-6)


def test_what_is_where_it_should_be_is_closed_on(found):
    np.testing.assert_array_equal(found.robustness(position=0.0, angle=0.0, samples=1), 1.0)


def test_the_farther_off_the_fewer(found):
    near, far, beyond = (
        found.robustness(position=position, samples=24).mean() for position in (0.005, 0.02, 0.2)
    )
    assert near >= far
    assert far > beyond
    assert beyond == 0.0
    again = found.robustness(position=0.005, samples=24)
    np.testing.assert_array_equal(again, found.robustness(position=0.005, samples=24))


def test_bad_noise_is_refused(found):
    with pytest.raises(InputError, match="robustness: found -1 m"):
        found.robustness(position=-1)
