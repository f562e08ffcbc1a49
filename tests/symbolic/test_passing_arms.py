"""Arms whose last axis passes by their sphere: recognised, and every arm found, all roots of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from samplers import near_limits
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.methods.common.arm_branches import form_at
from casadi_ik.symbolic.closed_arms.form import SIGNS
from casadi_ik.symbolic.closed_arms.passing import ROOTS, PassingArm
from casadi_ik.symbolic.closed_arms.recognise import closed_form, passing
from casadi_ik.symbolic.closed_arms.screws import Screws, arm_screws

KINDS = {
    "sawyer": ("spherical wrist, joint 1 swept, joint 7 off it", 0.1363),
    "xarm6": ("spherical wrist, joint 6 off it", 0.076),
}
"""By their makers' drawings; and how far [m] the last axis passes by."""

INNER = 0.05
"""Slack of arms that are not at the edge of reach."""


@cache
def robot_of(name: str) -> ik.ArmHand:
    return ik.load_robot(f"{name}+barrett_bh8_280")


@cache
def form_of(name: str) -> PassingArm:
    form = closed_form(robot_of(name).description)
    assert isinstance(form, PassingArm)
    return form


@cache
def function_of(name: str) -> ca.Function:
    return form_at(form_of(name))


def arms(name: str, palm: Array, arm: Array) -> Array:
    """All arms (k, n) with the swept joint, if there is one, as in an arm."""
    joint = form_of(name).swept_joint
    rows, slack = function_of(name)(palm[:3, :3], palm[:3, 3], 0.0 if joint is None else arm[joint])
    assert np.isfinite(np.array(rows)).all()
    return np.array(rows)[np.array(slack).ravel() >= -1e-9]


def moved_by(screws: Screws, angles: Array) -> Array:
    """The palm's pose by the product of exponentials: no formula of the package."""
    pose = np.eye(4)
    for axis, point, angle in zip(screws.axes, screws.points, angles, strict=True):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        step[:3, 3] = point - step[:3, :3] @ point
        pose = pose @ step
    zero = np.eye(4)
    zero[:3, :3], zero[:3, 3] = screws.rotation, screws.origin
    return pose @ zero


def apart(one: Array, other: Array) -> Array:
    """Largest difference of angles, whole turns aside."""
    return np.abs(np.angle(np.exp(1j * (one - other)))).max(axis=-1, initial=0.0)


@pytest.mark.parametrize("name", KINDS)
def test_it_is_recognised_by_its_axes(name):
    kind, off = KINDS[name]
    assert form_of(name).kind == kind
    assert np.linalg.norm(form_of(name).aside) == pytest.approx(off)


@pytest.mark.parametrize("name", KINDS)
def test_neither_base_nor_names_of_points_matter(name):
    screws = arm_screws(robot_of(name).description)
    rng = np.random.default_rng(1)
    turn, shift = Rotation.random(random_state=3).as_matrix(), rng.normal(size=3)
    along = rng.normal(size=(len(screws), 1))
    axes = screws.axes @ turn.T
    found = passing(
        replace(screws, axes=axes, points=screws.points @ turn.T + shift + along * axes)
    )
    assert found is not None
    assert found.kind == KINDS[name][0]


@pytest.mark.parametrize("name", KINDS)
def test_every_arm_brings_the_palm_there_and_one_is_that_it_was_made_with(name):
    """Random poses and poses near limits; at the edge of reach one arm of two may be missed.

    Of a swept arm the edge is that at a position of the swept joint: it is found at another.
    """
    robot, screws = robot_of(name), arm_screws(robot_of(name).description)
    rng, count, own = np.random.default_rng(5), len(screws), []
    for q in [*robot.random(rng, 30), *near_limits(robot, rng, 30)]:
        arm = q[:count]
        palm = moved_by(screws, arm)
        found = arms(name, palm, arm)
        for each in found:
            np.testing.assert_allclose(moved_by(screws, each), palm, atol=1e-9)
        own.append(len(found) > 0 and apart(found, arm).min() < 1e-5)
    assert np.mean(own) > (0.85 if form_of(name).swept else 0.99)


@pytest.mark.parametrize("name", KINDS)
def test_no_root_is_lost(name):
    """Against Brent's method between the signs of a scan of 720 turns, branch by branch."""
    robot, form = robot_of(name), form_of(name)
    count, turns = len(form.screws), np.linspace(-np.pi, np.pi, 721)
    condition = form.branch()
    lost = total = 0
    for q in robot.random(np.random.default_rng(8), 8):
        palm, arm = robot.palm(q), q[:count]
        found = arms(name, palm, arm)
        swept = 0.0 if form.swept_joint is None else arm[form.swept_joint]
        rotation, origin, *_ = form.begin()(palm[:3, :3], palm[:3, 3], swept)
        for signs in SIGNS:

            def left(t: float, given: tuple = (rotation, origin), signs: tuple = signs) -> float:
                return float(condition(*given, t, *signs)[2])

            values = condition.map(len(turns))(rotation, origin, turns, *signs)[2]
            values = np.array(values).ravel()
            crossed = (values[1:] * values[:-1] < 0) & (np.abs(np.diff(values)) < 1)
            for i in np.flatnonzero(crossed):
                t = brentq(left, turns[i], turns[i + 1], xtol=1e-14)
                six, slack, rest = condition(rotation, origin, t, *signs)
                if float(slack) < INNER or abs(float(rest)) > 1e-9:
                    continue
                whole = np.array(ca.evalf(form.whole(ca.DM(six), ca.DM(swept)))).ravel()
                total += 1
                lost += not len(found) or apart(found, whole).min() > 1e-6
    assert total > 15
    assert lost == 0


def test_a_search_from_many_starts_finds_no_other_arm():
    """Least squares of SciPy on the product of exponentials, from random arms of an xArm 6."""
    robot, screws = robot_of("xarm6"), arm_screws(robot_of("xarm6").description)
    rng, seen, total = np.random.default_rng(4), 0, 0
    for q in robot.random(rng, 2):
        palm = moved_by(screws, q[:6])
        found = arms("xarm6", palm, q[:6])
        for start in rng.uniform(-np.pi, np.pi, (25, 6)):
            ended = least_squares(
                lambda x, palm=palm: (moved_by(screws, x) - palm)[:3].ravel(), start, xtol=1e-15
            )
            if np.abs(ended.fun).max() < 1e-9:
                total += 1
                seen += apart(found, ended.x).min() < 1e-4
    assert total > 15
    assert seen == total


@pytest.mark.parametrize("name", KINDS)
def test_nothing_is_lost_at_singular_poses(name):
    """Finite, and the palm still there, with joints at zero and at right angles."""
    screws = arm_screws(robot_of(name).description)
    rng, count = np.random.default_rng(2), len(screws)
    poses = [np.zeros(count)]
    for joint in range(count):
        for value in (0.0, 1e-9, np.pi / 2):
            poses.append(rng.uniform(-1, 1, count))
            poses[-1][joint] = value
    for arm in poses:
        palm = moved_by(screws, arm)
        for each in arms(name, palm, arm):
            assert np.abs(moved_by(screws, each) - palm).max() < 1e-4


def test_there_are_as_many_rows_as_roots():
    assert function_of("xarm6").size1_out(0) == len(SIGNS) * ROOTS
