"""The palm motion that the other fingers ask for, eqs. (9) to (14)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from casadi_ik.papers.qiu.tasks import palm_motion
from casadi_ik.problem.target import Target
from casadi_ik.symbolic.actuated import actuated


@pytest.fixture(scope="module")
def motion(robot):
    """(q, points (k, 3), normals (k, 3)) -> translation [mm], rotation [rad], palm frame."""
    q = ca.SX.sym("q", 14)
    points, normals = ca.SX.sym("p", 3, 2), ca.SX.sym("n", 3, 2)
    goals = {f: Target(points[:, i], normals[:, i]) for i, f in enumerate(robot.fingers[1:])}
    f = ca.Function(
        "f", [q, points, normals], [*palm_motion(actuated(robot.description, q), goals)]
    )
    return lambda q, p, n: tuple(np.array(x).ravel() for x in f.call([ca.DM(q), p.T, n.T]))


def displaced(robot, q, translation, rotation):
    """Where fingers 2 and 3 get if the palm moves by a motion given in the palm frame."""
    points, normals = robot.contacts(q)
    palm = pin.SE3(robot.palm(q))
    moved = palm * pin.SE3(pin.exp3(rotation), translation) * palm.inverse()
    return points[1:] @ moved.rotation.T + moved.translation, normals[1:] @ moved.rotation.T


def test_nothing_to_do_at_the_contacts(robot, motion, rng):
    for q in robot.random(rng, 10):
        translation, rotation = motion(q, *displaced(robot, q, np.zeros(3), np.zeros(3)))
        np.testing.assert_allclose(translation, 0, atol=1e-9)
        np.testing.assert_allclose(rotation, 0, atol=1e-12)


def test_translations_are_found_exactly(robot, motion, rng):
    for q in robot.random(rng, 10):
        shift = rng.normal(scale=0.05, size=3)
        translation, rotation = motion(q, *displaced(robot, q, shift, np.zeros(3)))
        np.testing.assert_allclose(translation, 1e3 * shift, atol=1e-9)
        np.testing.assert_allclose(rotation, 0, atol=1e-12)


def test_rotations_across_both_normals_are_found(robot, motion, rng):
    """A rotation about the one axis that both normals show completely, with a translation."""
    checked = 0
    for q in robot.random(rng, 20):
        palm = robot.palm(q)[:3, :3]
        local = robot.contacts(q)[1][1:] @ palm
        axis = np.cross(*local)
        if np.linalg.norm(axis) < 0.1:
            continue
        w = 1e-4 * axis / np.linalg.norm(axis)
        shift = rng.normal(scale=1e-5, size=3)
        translation, rotation = motion(q, *displaced(robot, q, shift, w))
        np.testing.assert_allclose(rotation, w, atol=1e-7)
        np.testing.assert_allclose(translation, 1e3 * shift, atol=1e-5)
        checked += 1
    assert checked > 10


def test_first_order_of_any_motion(robot, motion, rng):
    """A turn about a finger's normal is invisible to that finger: the paper's averages say so.

    Finger i asks for w_i = w - n_i (n_i . w) and for t + (w - w_i) x p_i, which eqs. (12) and (13)
    average.
    """
    for q in robot.random(rng, 10):
        palm = pin.SE3(robot.palm(q))
        points, normals = robot.contacts(q)
        levers = [palm.inverse().act(p) for p in points[1:]]
        normals = normals[1:] @ palm.rotation
        shift, w = rng.normal(scale=1e-5, size=3), rng.normal(scale=1e-4, size=3)
        seen = [w - n * (n @ w) for n in normals]
        expected = np.mean(
            [shift + np.cross(w - w_i, p) for w_i, p in zip(seen, levers, strict=True)], axis=0
        )
        translation, rotation = motion(q, *displaced(robot, q, shift, w))
        np.testing.assert_allclose(rotation, np.mean(seen, axis=0), atol=2e-7)
        np.testing.assert_allclose(translation, 1e3 * expected, atol=2e-5)


def test_large_rotation_is_the_chordal_mean_of_the_shortest(robot, motion, rng):
    """Eq. (12) with its projection to SO(3) by singular values."""
    q = robot.random(rng, 1)[0]
    palm = robot.palm(q)[:3, :3]
    points, normals = robot.contacts(q)
    goals = normals[1:] + rng.normal(scale=0.5, size=(2, 3))
    goals /= np.linalg.norm(goals, axis=1)[:, None]
    turns = []
    for a, b in zip(normals[1:] @ palm, goals @ palm, strict=True):
        axis = np.cross(a, b)
        axis *= np.arctan2(np.linalg.norm(axis), a @ b) / np.linalg.norm(axis)
        turns.append(pin.exp3(axis))
    U, _, Vt = np.linalg.svd(sum(turns) / 2)
    _, rotation = motion(q, points[1:], goals)
    np.testing.assert_allclose(pin.exp3(rotation), U @ Vt, atol=1e-12)


def test_three_fingers(robot, rng):
    """More than two demands go through the polar projection."""
    q = ca.SX.sym("q", 14)
    points, normals = ca.SX.sym("p", 3, 3), ca.SX.sym("n", 3, 3)
    goals = {f: Target(points[:, i], normals[:, i]) for i, f in enumerate(robot.fingers)}
    f = ca.Function(
        "f", [q, points, normals], [*palm_motion(actuated(robot.description, q), goals)]
    )
    row = robot.random(rng, 1)[0]
    p, n = robot.contacts(row)
    shift = rng.normal(scale=0.02, size=3)
    translation, rotation = f(row, (p + robot.palm(row)[:3, :3] @ shift).T, n.T)
    np.testing.assert_allclose(np.array(translation).ravel(), 1e3 * shift, atol=1e-9)
    np.testing.assert_allclose(np.array(rotation).ravel(), 0, atol=1e-12)
