"""The other fingers' own inverse kinematics, eqs. (4) and (5): closed form, Ipopt, brute force."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.errors import UnsupportedError
from casadi_ik.papers.qiu.finger_step import finger_step_function
from casadi_ik.robots import load_description
from casadi_ik.symbolic.planar_finger import planar_finger

SPREAD = 7
FLEXIONS = {"finger_2": (10, 11), "finger_3": (12, 13)}


@pytest.fixture(scope="module")
def closed(robot):
    return finger_step_function(robot.description, "closed-form")


@pytest.fixture(scope="module")
def ipopt(robot):
    return finger_step_function(robot.description, "ipopt")


def seen_from_palm(robot, q) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of fingers 2 and 3 as the finger step takes them, (3, 2)."""
    points, normals = robot.contacts(q)
    palm = robot.palm(q)
    return (
        palm[:3, :3].T @ (points[1:] - palm[:3, 3]).T,
        palm[:3, :3].T @ normals[1:].T,
    )


def unit(x):
    return x / np.linalg.norm(x, axis=0)


def targets(robot, rng, count):
    """Reachable ones, perturbed ones, and wild ones far beyond the limits, in turn."""
    for i, q in enumerate(robot.random(rng, count)):
        points, normals = seen_from_palm(robot, q)
        if i % 3 == 1:
            points = points + rng.normal(scale=0.03, size=(3, 2))
            normals = unit(normals + rng.normal(scale=0.3, size=(3, 2)))
        elif i % 3 == 2:
            points = rng.uniform(-0.25, 0.25, (3, 2))
            normals = unit(rng.normal(size=(3, 2)))
        yield q, points, normals


def call(f, q, points, normals) -> np.ndarray:
    return np.array(f(q, points, normals)).ravel()


def test_own_contacts_are_found_again(robot, closed, rng):
    """For what a hand can do exactly, the step finds how, whatever the posture before."""
    hand = [SPREAD, *FLEXIONS["finger_2"], *FLEXIONS["finger_3"]]
    others = [i for i in range(14) if i not in hand]
    sums = np.array(list(FLEXIONS.values()))
    # Beyond a flexion sum of 140 deg the pad faces back, and its normal reads as another spread.
    fair = [q for q in robot.random(rng, 60) if q[sums].sum(axis=1).max() < np.radians(139)]
    assert len(fair) > 30
    for q in fair:
        before = robot.random(rng, 1)[0]
        after = call(closed, before, *seen_from_palm(robot, q))
        np.testing.assert_array_equal(after[others], before[others])
        np.testing.assert_allclose(after[hand], q[hand], atol=1e-6)


def test_closed_form_equals_ipopt(robot, closed, ipopt, rng):
    """To 1e-9 on targets of all sorts: eq. (5) has one answer."""
    for q, points, normals in targets(robot, rng, 60):
        np.testing.assert_allclose(
            call(ipopt, q, points, normals), call(closed, q, points, normals), atol=1e-9
        )


def test_ipopt_does_not_depend_on_the_present_flexions(robot, ipopt, rng):
    q, points, normals = list(targets(robot, rng, 3))[2]
    first = call(ipopt, q, points, normals)
    q[10:] = robot.random(rng, 1)[0][10:]
    np.testing.assert_array_equal(call(ipopt, q, points, normals)[10:], first[10:])


def test_far_side_of_the_circle_is_a_trap_that_ipopt_avoids(own_robot, rng):
    """With wide limits both minima lie inside; the nearer one has to win."""
    hand = own_robot.with_name("hand.yaml")
    text = hand.read_text().replace("[0 deg, 140 deg]", "[-170 deg, 170 deg]")
    hand.write_text(text.replace("[0 deg, 48 deg]", "[-300 deg, 300 deg]"))
    robot = ik.load_robot(own_robot)
    closed = finger_step_function(robot.description, "closed-form")
    ipopt = finger_step_function(robot.description, "ipopt")
    for q in robot.random(rng, 15):
        q[7] = rng.uniform(0, 1)
        points, normals = seen_from_palm(robot, q)
        a, b = call(closed, q, points, normals), call(ipopt, q, points, normals)
        for name in FLEXIONS:
            best = min(miss(robot, name, x, points, normals) for x in (a, b))
            assert miss(robot, name, b, points, normals) <= best + 1e-9


def miss(robot, name, q, points, normals) -> float:
    """What eq. (5) minimises: distance of a finger from its point [m]."""
    reached, _ = seen_from_palm(robot, q)
    column = list(FLEXIONS).index(name)
    return float(np.linalg.norm(reached[:, column] - points[:, column]))


def test_closed_form_is_the_best_on_a_grid(robot, closed, rng):
    """With spread and flexion sum held, no other flexion within limits comes closer."""
    for q, points, normals in targets(robot, rng, 30):
        after = call(closed, q, points, normals)
        assert np.all(after[10:] >= robot.lower[10:] - 1e-12)
        assert np.all(after[10:] <= robot.upper[10:] + 1e-12)
        for name, (first, second) in FLEXIONS.items():
            total = after[first] + after[second]
            low = max(robot.lower[first], total - robot.upper[second])
            high = min(robot.upper[first], total - robot.lower[second])
            grid = np.tile(after, (400, 1))
            grid[:, first] = np.linspace(low, high, 400)
            grid[:, second] = total - grid[:, first]
            column = list(FLEXIONS).index(name)
            palms = robot.palm(grid)
            contacts = robot.contacts(grid)[0][:, 1 + column] - palms[:, :3, 3]
            local = np.einsum("kij,ki->kj", palms[:, :3, :3], contacts)
            distances = np.linalg.norm(local - points[:, column], axis=1)
            assert miss(robot, name, after, points, normals) <= distances.min() + 1e-12


def test_normals_decide_spread_and_flexion_sum(robot, closed, rng):
    """Eq. (4): whatever the points, attainable normals are met."""
    for q in robot.random(rng, 20):
        q[[10, 12]] = rng.uniform(0.2, 1.5, 2)
        points, normals = seen_from_palm(robot, q)
        after = call(closed, q, points + rng.normal(scale=0.05, size=(3, 2)), normals)
        np.testing.assert_allclose(seen_from_palm(robot, after)[1], normals, atol=1e-9)


def test_attainable_normal_nearest_to_the_demand(robot, closed):
    """A demand beyond the flexion limits is moved to the nearest end."""
    q = robot.home
    for beyond in (-0.1, -0.3, -0.6):
        normals = np.empty((3, 2))
        for column, name in enumerate(FLEXIONS):
            finger = planar_finger(robot.description, name)
            angle, spread = finger.normal_angle + beyond, finger.ratio * q[SPREAD]
            across = np.sin(angle)
            local = [np.cos(spread) * across, np.sin(spread) * across, np.cos(angle)]
            normals[:, column] = finger.frame[:3, :3] @ local
        after = call(closed, q, seen_from_palm(robot, q)[0], normals)
        np.testing.assert_allclose(after[SPREAD], q[SPREAD], atol=1e-12)
        np.testing.assert_allclose(after[10:], 0.0, atol=1e-12)


def test_fingers_on_one_spread_motor_agree(robot, closed):
    """Mirrored demands of 20 and 50 deg with equal weight give 35 deg; a polar normal abstains."""
    q = robot.home.copy()

    def demand(spread_2, spread_3, bend_2=0.7, bend_3=0.7):
        normals = []
        for spread, bend, column in ((spread_2, bend_2, 0), (spread_3, bend_3, 1)):
            posture = q.copy()
            posture[SPREAD] = np.radians(spread)
            posture[[10, 12]] = bend
            posture[[11, 13]] = 0.0
            normals.append(seen_from_palm(robot, posture)[1][:, column])
        return np.array(normals).T

    points = seen_from_palm(robot, q)[0]
    after = call(closed, q, points, demand(20, 50))
    assert np.degrees(after[SPREAD]) == pytest.approx(35, abs=1e-8)
    after = call(closed, q, points, demand(40, 40))
    assert np.degrees(after[SPREAD]) == pytest.approx(40, abs=1e-9)
    along = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    after = call(closed, q, points, along)
    assert after[SPREAD] == pytest.approx(q[SPREAD], abs=1e-12), "nobody asks for a spread"
    mixed = demand(20, 20)
    mixed[:, 1] = [0, 0, 1]
    after = call(closed, q, points, mixed)
    assert np.degrees(after[SPREAD]) == pytest.approx(20, abs=1e-6)


def test_spread_keeps_motor_and_joints_within_limits(own_robot, rng):
    """The joint's own limits bind where they are narrower than the motor's."""
    hand = own_robot.with_name("hand.yaml")
    text = hand.read_text()
    at = text.index("name: bh_finger_3_spread")
    narrow = text[at:].replace("[0 deg, 180 deg]", "[10 deg, 60 deg]", 1)
    hand.write_text(text[:at] + narrow)
    robot = ik.load_robot(own_robot)
    closed = finger_step_function(robot.description, "closed-form")
    seen = []
    for q, points, normals in targets(robot, rng, 60):
        seen.append(call(closed, q, points, normals)[SPREAD])
    assert min(seen) == pytest.approx(np.radians(10))
    assert max(seen) == pytest.approx(np.radians(60))


def test_thumb_and_arm_are_left_alone(robot, closed, rng):
    q, points, normals = next(targets(robot, rng, 1))
    after = call(closed, q, points, normals)
    np.testing.assert_array_equal(after[[*range(7), 8, 9]], q[[*range(7), 8, 9]])


def test_unsupported_hands(own_robot, coupled_robot):
    with pytest.raises(UnsupportedError, match="finger 'right' is not a planar finger"):
        finger_step_function(coupled_robot.description, "closed-form")
    replace(
        own_robot.with_name("hand.yaml"),
        "normal: [0, 1, 0], source: pad cad}\n  finger_3",
        "normal: [0, 1, 1], source: pad cad}\n  finger_3",
    )
    with pytest.raises(UnsupportedError, match="finger 'finger_2' is not a planar finger"):
        finger_step_function(load_description(own_robot), "ipopt")


def test_signature(closed):
    assert closed.name_in() == ["q", "points", "normals"]
    assert closed.name_out() == ["q_next"]
    assert isinstance(closed, ca.Function)
