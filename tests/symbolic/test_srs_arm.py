"""Arms with spherical shoulder and wrist: recognised, solved exactly, their limits found."""

from __future__ import annotations

import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_variants import derived_robot
from toy_robots import copy_shipped_robot, replace

import casadi_ik as ik
from casadi_ik.errors import UnsupportedError
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import (
    at_angle,
    euler_angles,
    limit_roots,
    reach,
    srs_arm,
    swivel,
)

BRANCHES = [
    (elbow, shoulder, wrist) for elbow in (1, -1) for shoulder in (0, 1) for wrist in (0, 1)
]


class Closed:
    """The closed form in numbers."""

    def __init__(self, robot: ik.ArmHand):
        self.arm = arm = srs_arm(robot.description)
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        sign, psi, values = ca.SX.sym("sign"), ca.SX.sym("psi"), ca.SX.sym("values", 7)
        chain = swivel(arm, Pose(rotation, origin), sign)
        shoulder = euler_angles(arm.shoulder_joints, at_angle(chain.shoulder, psi))
        wrist = euler_angles(arm.wrist_joints, at_angle(chain.wrist, psi))
        inputs = [rotation, origin, sign, psi]
        self._branches = ca.Function(
            "branches", inputs, [ca.horzcat(*shoulder), chain.elbow, ca.horzcat(*wrist)]
        )
        self._reachable = ca.Function("reachable", [rotation, origin], [chain.reachable])
        roots = ca.vertcat(
            limit_roots(arm.shoulder_joints, chain.shoulder, values[:3], values[:3]),
            limit_roots(arm.wrist_joints, chain.wrist, values[4:], values[4:]),
        )
        self._roots = ca.Function("roots", [rotation, origin, sign, values], [roots])

    def branch(self, palm, psi, branch):
        elbow, s, w = branch
        shoulder, bend, wrist = self._branches(palm[:3, :3], palm[:3, 3], elbow, psi)
        return np.concatenate(
            [np.array(shoulder)[:, s], np.array(bend).ravel(), np.array(wrist)[:, w]]
        )

    def roots(self, palm, sign, values):
        """Swivels (6, 4) at which joints 1-3, 5-7 may stand at a value."""
        found = np.array(self._roots(palm[:3, :3], palm[:3, 3], sign, values)).ravel()
        return found.reshape(6, 4)

    def reachable(self, palm):
        return float(self._reachable(palm[:3, :3], palm[:3, 3]))


@pytest.fixture(scope="module")
def closed(robot):
    return Closed(robot)


def with_arm(robot, arm):
    q = robot.home.copy()
    q[:7] = arm
    return q


def test_all_branches_reach_the_palm_exactly(robot, closed, rng):
    for q in robot.random(rng, 20):
        palm = robot.palm(q)
        found = [closed.branch(palm, psi, b) for b in BRANCHES for psi in rng.uniform(-3, 3, 2)]
        poses = robot.palm(np.array([with_arm(robot, arm) for arm in found]))
        np.testing.assert_allclose(poses, np.broadcast_to(palm, poses.shape), atol=1e-12)
        assert len(np.unique(np.round(found, 6), axis=0)) == len(found)


def test_the_arm_is_found_again_at_the_swivel_where_a_joint_has_its_value(robot, closed, rng):
    """The roots of a joint's value hold the swivel of the arm they were made with."""
    for q in robot.random(rng, 20):
        palm = robot.palm(q)
        sign = 1 if q[3] > 0 else -1
        branches = [b for b in BRANCHES if b[0] == sign]
        for swivels in closed.roots(palm, sign, q[:7]):
            found = [closed.branch(palm, psi, b) for b in branches for psi in swivels]
            assert min(np.abs(arm - q[:7]).max() for arm in found) < 1e-7


def test_a_joint_stands_at_its_limit_at_a_root(robot, closed, rng):
    tested = 0
    for q in robot.random(rng, 20):
        palm, sign = robot.palm(q), 1 if q[3] > 0 else -1
        for limits in (robot.lower[:7], robot.upper[:7]):
            for i, swivels in zip(
                (0, 1, 2, 4, 5, 6), closed.roots(palm, sign, limits), strict=True
            ):
                arms = [closed.branch(palm, psi, b) for psi in swivels for b in BRANCHES]
                off = np.array([abs(np.sin((arm[i] - limits[i]) / 2)) for arm in arms])
                # A limit that no swivel meets gives the closest approach instead of a root.
                if off.min() < 1e-6:
                    tested += 1
                    assert off.min() < 1e-9
    assert tested > 40


def test_reach_follows_the_elbows_bounds(robot, closed):
    for lower, upper in ((-2.0, 2.0), (0.3, 2.0), (-2.0, -0.4), (0.7, 0.7), (-1e3, 1e3)):
        near, far = (float(value) for value in reach(closed.arm, ca.SX(lower), ca.SX(upper)))
        bends = np.linspace(max(lower, -np.pi), min(upper, np.pi), 2001)
        distance = np.linalg.norm([0.4 + 0.39 * np.cos(bends), 0.39 * np.sin(bends)], axis=0)
        np.testing.assert_allclose([near, far], [distance.min(), distance.max()], atol=1e-6)


def test_out_of_reach_is_told(robot, closed):
    palm = robot.palm(robot.home)
    assert closed.reachable(palm) > 0
    palm[:3, 3] += [2.0, 0, 0]
    assert closed.reachable(palm) < 0


def test_the_straight_arm_is_exact_and_finite(robot, closed):
    arm = np.array([0.3, 0.4, -0.5, 0.0, 0.2, 0.0, 0.7])
    palm = robot.palm(with_arm(robot, arm))
    found = closed.branch(palm, 0.4, BRANCHES[0])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(robot.palm(with_arm(robot, found)), palm, atol=2e-6)


@settings(max_examples=12)
@given(
    heights=st.fixed_dictionaries(
        {number: st.floats(0.05, 0.4) for number in ("1", "2", "3", "4", "5", "6", "7")}
    ),
    shift=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
    turn=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
    seed=st.integers(0, 2**16),
)
def test_other_links_and_mounts(heights, shift, turn, seed):
    with tempfile.TemporaryDirectory() as folder:
        robot = derived_robot(Path(folder), heights, (shift, turn))
    closed = Closed(robot)
    rng = np.random.default_rng(seed)
    q = robot.random(rng, 1)[0]
    # At a straight elbow half the digits are lost, in any method.
    q[3] = np.copysign(max(abs(q[3]), 0.05), q[3])
    palm = robot.palm(q)
    for branch in BRANCHES:
        arm = closed.branch(palm, rng.uniform(-3, 3), branch)
        np.testing.assert_allclose(robot.palm(with_arm(robot, arm)), palm, atol=1e-10)


def test_an_elbow_off_the_links_is_refused(tmp_path):
    with pytest.raises(UnsupportedError, match=r"not of the S-R-S kind.*do not meet in one point"):
        srs_arm(derived_robot(tmp_path, elbow_offset=0.045).description)


def test_a_shoulder_apart_is_refused(own_robot):
    replace(own_robot.parent / "arm.yaml", "[0, 0, 200.5 mm]", "[30 mm, 0, 200.5 mm]")
    with pytest.raises(UnsupportedError, match="axes 1 to 3 do not meet"):
        srs_arm(ik.load_robot(own_robot).description)


def test_a_skew_axis_is_refused(own_robot):
    replace(
        own_robot.parent / "arm.yaml",
        "lwr_link_6, axis: [0, -1, 0]",
        "lwr_link_6, axis: [0, -1, 0.2]",
    )
    with pytest.raises(UnsupportedError, match="wrist: neighbouring axes are not perpendicular"):
        srs_arm(ik.load_robot(own_robot).description)


def test_a_hand_without_an_arm_is_refused(coupled_robot):
    with pytest.raises(UnsupportedError, match="it has 0 joints, expected 7 motors"):
        srs_arm(coupled_robot.description)


def test_copies_are_recognised(tmp_path):
    assert srs_arm(ik.load_robot(copy_shipped_robot(tmp_path)).description)
