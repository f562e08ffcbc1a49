"""The equations on the pages of concepts, as they are printed there, against what computes them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm, logm

import casadi_ik as ik
from casadi_ik.arms.recognise import srs_arm
from casadi_ik.methods.common.palm_fit import HandContacts, best_palm
from casadi_ik.papers.qiu import tasks
from casadi_ik.papers.qiu.tasks import MILLIMETRE, Task, combine, palm_motion
from casadi_ik.problem.contacts import USUAL, ContactRows, Target
from casadi_ik.symbolic import dual_quaternion, mechanisms, se3
from casadi_ik.symbolic.closed_chain import closed_chain, split
from casadi_ik.symbolic.kinematics import Pose, actuated
from casadi_ik.symbolic.linear_algebra import damped_pinv_times, weighted_damped_pinv_times
from casadi_ik.symbolic.planar_finger import planar_finger


def number(expression: Any) -> np.ndarray:
    return np.array(ca.evalf(ca.densify(expression))).squeeze()


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turn(current: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Qiu (11)."""
    w, zeta = np.cross(current, desired), np.arccos(current @ desired)
    hat = skew(w / np.linalg.norm(w))
    return np.eye(3) + hat * np.sin(zeta) + hat @ hat * (1 - np.cos(zeta))


def test_palm_estimate(rng: np.random.Generator) -> None:
    """Qiu (1), (2): right-handed, and every axis where the page has it."""
    p = rng.normal(size=(3, 3))
    x, y = p[1] - p[2], p[0] - (p[1] + p[2]) / 2
    z = np.cross(x, y)
    x = np.cross(y, z)
    expected = np.stack([v / np.linalg.norm(v) for v in (x, y, z)], axis=1)
    assert number(tasks.axes_through([ca.SX(v) for v in p])) == pytest.approx(expected)


def test_normal_error_and_angle(rng: np.random.Generator) -> None:
    """Qiu (3)."""
    current, desired = unit(rng, 2)
    phi = 2 * np.arctan2(np.linalg.norm(current - desired), np.linalg.norm(current + desired))
    across = np.cross(current, desired)
    expected = phi * across / np.linalg.norm(across)
    assert number(se3.normal_error(ca.SX(current), ca.SX(desired))) == pytest.approx(expected)
    assert phi == pytest.approx(np.arccos(current @ desired))


def test_least_squares_and_projection(rng: np.random.Generator) -> None:
    """Damped and weighted least squares, and the sum of three tasks in null spaces."""
    J, e, lam, w = rng.normal(size=(3, 7)), rng.normal(size=3), 0.3, rng.uniform(1, 10, 7)
    expected = J.T @ np.linalg.solve(J @ J.T + lam**2 * np.eye(3), e)
    assert number(damped_pinv_times(ca.SX(J), ca.SX(e), ca.SX(lam))) == pytest.approx(expected)
    Jw = J / w
    expected = Jw.T @ np.linalg.solve(Jw @ J.T + lam**2 * np.eye(3), e)
    found = number(weighted_damped_pinv_times(ca.SX(J), ca.SX(e), ca.SX(lam), ca.SX(w)))
    assert found == pytest.approx(expected)
    Js, steps = rng.normal(size=(3, 3, 12)), rng.normal(size=(3, 12))
    N = [np.eye(12) - np.linalg.pinv(one) @ one for one in Js]
    expected = steps[0] + N[0] @ steps[1] + N[0] @ N[1] @ steps[2]
    tasks = [Task(ca.SX(one), ca.SX.zeros(3, 1), is_position=True) for one in Js]
    assert number(combine(tasks, [ca.SX(s) for s in steps], "successive")) == pytest.approx(
        expected, abs=1e-9
    )


def test_normal_of_a_finger(robot: ik.ArmHand) -> None:
    """Qiu (4): the normal depends on the spread and on the sum of the flexions alone."""
    hand = robot.home.copy()
    normals = []
    for proximal, distal in ((1.0, 0.5), (1.3, 0.2)):
        q = hand.copy()
        q[list(planar_finger(robot.description, "finger_2").flexion)] = proximal, distal
        normals.append(robot.contacts(q)[1][1])
    assert normals[0] == pytest.approx(normals[1])


def test_closed_chain(robot: ik.ArmHand, rng: np.random.Generator) -> None:
    """Qiu (6) to (8)."""
    q = robot.random(rng, 1)[0]
    legs = split(robot.description)
    chain = closed_chain(actuated(robot.description, ca.SX(q)), legs)
    H_a, H_p, H = number(chain.H_a), number(chain.H_p), number(chain.H)
    assert pytest.approx(-np.linalg.solve(H_p, H_a), rel=1e-6) == H
    rates = dict(zip(legs.active, np.eye(4), strict=True))
    rates |= dict(zip(legs.passive, H, strict=True))
    stacked = np.stack([rates[column] for column in legs.columns])
    assert number(chain.constraint) @ stacked == pytest.approx(np.zeros((6, 4)), abs=1e-9)
    arm = -number(chain.constraint)[:, len(legs.reversed_leg) :]
    rows = stacked[len(legs.reversed_leg) :]
    assert number(chain.J_cc) == pytest.approx(arm @ rows, rel=1e-6, abs=1e-9)


def test_palm_motion(robot: ik.ArmHand, rng: np.random.Generator) -> None:
    """Qiu (9) to (14)."""
    q = robot.random(rng, 1)[0]
    points, normals = robot.contacts(q)
    goal_points = points + rng.normal(scale=0.02, size=(3, 3))
    goal_normals = normals + 0.3 * rng.normal(size=(3, 3))
    goal_normals /= np.linalg.norm(goal_normals, axis=1, keepdims=True)
    goals = {
        name: Target(ca.SX(goal_points[i]), ca.SX(goal_normals[i]))
        for i, name in enumerate(robot.fingers)
        if i
    }
    found = palm_motion(actuated(robot.description, ca.SX(q)), goals)
    palm = robot.palm(q)
    R = palm[:3, :3]
    shifts, rotations = [], []
    for i in (1, 2):
        turned = turn(R.T @ normals[i], R.T @ goal_normals[i])
        rigid = np.eye(4)
        rigid[:3, :3], rigid[:3, 3] = turned, R.T @ (goal_points[i] - points[i]) / MILLIMETRE
        twist = np.real(logm(rigid))
        angular = np.array([twist[2, 1], twist[0, 2], twist[1, 0]])
        lever = R.T @ (points[i] - palm[:3, 3]) / MILLIMETRE
        shifts.append(twist[:3, 3] - np.cross(angular, lever))
        rotations.append(turned)
    U, _, V = np.linalg.svd(sum(rotations) / 2)
    mean = np.real(logm(U @ V))
    assert number(found[0]) == pytest.approx(np.mean(shifts, axis=0), rel=1e-6)
    assert number(found[1]) == pytest.approx([mean[2, 1], mean[0, 2], mean[1, 0]], rel=1e-6)
    assert number(se3.mean_rotation(*map(ca.SX, rotations))) == pytest.approx(U @ V)


def test_best_palm(rng: np.random.Generator) -> None:
    """Hand first: the palm that brings a hand's contacts onto others that are moved by it."""
    points, normals = rng.normal(scale=0.1, size=(3, 3)), unit(rng, 3)
    R, t = expm(skew(rng.normal(size=3))), rng.normal(size=3)
    tips = [{"point": ca.SX(p), "normal": ca.SX(n)} for p, n in zip(points, normals, strict=True)]
    rows = ContactRows((USUAL,) * 3)
    p = {
        "points": ca.SX(points @ R.T + t),
        "normals": ca.SX(normals @ R.T),
        "weights": ca.SX.ones(3, 2),
    }
    rotation, origin = best_palm(HandContacts(tips, []), rows, p)
    assert number(rotation) == pytest.approx(R)
    assert number(origin) == pytest.approx(t)


def test_elbow_and_swivel(robot: ik.ArmHand, rng: np.random.Generator) -> None:
    """Hand first: the elbow from the law of cosines, the swivel affine in cosine and sine."""
    q = robot.random(rng, 1)[0]
    arm, pose = srs_arm(robot.description), robot.palm(q)
    assert arm is not None
    palm = Pose(ca.SX(pose[:3, :3]), ca.SX(pose[:3, 3]))
    (found,) = arm.bends(palm, ca.SX(0.0), (ca.SX(np.sign(q[3])),))
    line = pose[:3, 3] + pose[:3, :3] @ arm.wrist_in_palm - arm.shoulder
    a, b = np.linalg.norm(arm.upper_arm), np.linalg.norm(arm.forearm)
    cosine = (line @ line - a**2 - b**2) / (2 * a * b)
    expected = np.sign(q[3]) * np.arctan2(np.sqrt(1 - cosine**2), cosine) - arm.bent
    assert number(found.joints[3]) == pytest.approx(expected)
    assert expected == pytest.approx(q[3])
    u, psi = line / np.linalg.norm(line), 0.7
    rotated = np.outer(u, u) + np.cos(psi) * (np.eye(3) - np.outer(u, u)) + np.sin(psi) * skew(u)
    assert rotated == pytest.approx(expm(psi * skew(u)))


def test_lead_screw() -> None:
    """Chandra (8)."""
    b, c, s = 0.05, 0.014, 0.051
    theta = np.arccos((b**2 + c**2 - s**2) / (2 * b * c))
    assert number(mechanisms.angle_from_slider(*map(ca.SX, (s, b, c)))) == pytest.approx(theta)
    rate = s / (b * c * np.sin(theta))
    assert number(mechanisms.angle_rate(*map(ca.SX, (s, b, c)))) == pytest.approx(rate)


@pytest.mark.parametrize("sigma", [-1, 1])
def test_four_bar(sigma: int) -> None:
    """Chandra (9) and (11), and that they close the loop."""
    p, q, g, h, phi = 0.0297, 0.0347, 0.0084, 0.0072, 3.4
    A = 2 * p * q * np.cos(phi) - 2 * g * q
    B = 2 * p * q * np.sin(phi)
    C = g**2 + p**2 + q**2 - h**2 - 2 * p * g * np.cos(phi)
    psi = np.arctan2(B, A) + sigma * np.arccos(C / np.hypot(A, B))
    theta = (
        np.arctan2(q * np.sin(psi) - p * np.sin(phi), g + q * np.cos(psi) - p * np.cos(phi)) - phi
    )
    loop = g + q * np.exp(1j * psi) - p * np.exp(1j * phi) - h * np.exp(1j * (phi + theta))
    assert abs(loop) < 1e-15
    bar = mechanisms.Linkage(*map(ca.SX, (p, q, g, h)), branch=sigma)
    assert number(mechanisms.theta3(ca.SX(phi), bar, theta)) == pytest.approx(theta)
    across = h * np.sin(phi + theta - psi)
    rate = (p * np.sin(psi - phi) - across) / across
    assert number(mechanisms.theta3_rate(ca.SX(phi), bar)) == pytest.approx(rate)


def test_screws(rng: np.random.Generator) -> None:
    """Chandra (1), (2), (6), (13), (14), (17)."""
    (line,), point, theta, d = unit(rng, 1), rng.normal(size=3), 0.8, 0.3
    moment = np.cross(point, line)
    dual = dual_quaternion.directed_line(ca.SX(line), ca.SX(point))
    assert number(dual[1]) == pytest.approx(moment)
    x = dual_quaternion.exp_screw(ca.SX(theta), ca.SX(d), *dual)
    rotation, shift = map(number, dual_quaternion.to_pose(x))
    turned = expm(theta * skew(line))
    assert rotation == pytest.approx(turned)
    assert shift == pytest.approx(point - turned @ point + d * line)
    w, v = map(number, dual_quaternion.log(x))
    assert w == pytest.approx(theta * line)
    assert v == pytest.approx(theta * moment + d * line)
    e = dual_quaternion.error(x, dual_quaternion.identity())
    assert number(ca.vertcat(*dual_quaternion.control_twist(e, ca.SX(0.5)))) == pytest.approx(
        -0.5 * np.r_[w, v]
    )
    assert number(dual_quaternion.screw_error_norm(e)) == pytest.approx(
        np.hypot(*map(np.linalg.norm, (w, v)))
    )
    (other,), through = unit(rng, 1), rng.normal(size=3)
    moved = dual_quaternion.act_on_line(x, ca.SX(other), ca.SX(np.cross(through, other)))
    carried = np.cross(rotation @ through + shift, rotation @ other)
    assert number(moved[1]) == pytest.approx(carried)
