"""Closed-form arm families: recognition, completeness, and finite values at singular poses."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import toy_robots
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_variants import derived_robot
from samplers import near_limits
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import SIGNS, ArmFamily
from casadi_ik.kinematics.arms.offset_wrist import OffsetWristArm
from casadi_ik.kinematics.arms.recognise import arm_family, describe_arm, family_of, srs_arm
from casadi_ik.kinematics.arms.screws import Screws, arm_screws
from casadi_ik.kinematics.forward import Pose
from casadi_ik.solve.arm_branches import ArmBranches

KINDS = {
    "kuka_lwr4": "spherical shoulder and wrist",
    "iiwa7": "spherical shoulder and wrist",
    "panda": "spherical shoulder, joint 7 swept",
    "fr3": "spherical shoulder, joint 7 swept",
    "xarm7": "spherical shoulder, joint 7 swept",
    "kinova_gen3": "nearly spherical wrist, joint 1 swept",
    "baxter_left": "nearly spherical wrist, joint 1 swept",
    "baxter_right": "nearly spherical wrist, joint 1 swept",
    "puma560": "spherical wrist",
    "viperx_300s": "spherical wrist",
    "widowx_250s": "spherical wrist",
    "jaco2": "spherical wrist",
    "irb140": "spherical wrist",
    **{f"ur{name}": "three parallel axes" for name in ("3e", "5e", "10e", "16e", "5", "10")},
    "sawyer": "spherical wrist, joint 1 swept, joint 7 off it",
    "xarm6": "spherical wrist, joint 6 off it",
}
"""Kind of each arm of the catalogue, according to its maker's drawing."""

SOLVED = ("kuka_lwr4", "panda", "xarm7", "kinova_gen3", "puma560", "irb140", "ur5e")
OFFSET = {"sawyer": 0.1363, "xarm6": 0.076}
"""Offset of the last axis from the wrist centre [m]."""
ALL = (*SOLVED, *OFFSET)
"""One arm of each kind."""

MODEL_ERROR = {"kinova_gen3": 2e-3, "baxter_left": 3e-2, "baxter_right": 3e-2}
"""Position error [m] of arms that are solved as a similar nominal arm."""


@cache
def robot_of(name: str) -> ik.ArmHand:
    return ik.load_robot(f"{name}+barrett_bh8_280")


@cache
def family(name: str) -> ArmFamily:
    arm = arm_family(robot_of(name).description)
    assert arm is not None
    return arm


@cache
def function(arm: ArmFamily) -> ca.Function:
    return arm.arms()


def arms(family_of_arm: ArmFamily, palm: Array, arm: Array, edge: float = 0.0) -> Array:
    """Return all arms (k, n) in reach; `arm` gives the value of a swept joint."""
    values = [
        0.4 if redundancy.joint is None else arm[redundancy.joint]
        for redundancy in family_of_arm.redundancy
    ] or [0.0]
    rows, slack = (
        np.array(part) for part in function(family_of_arm)(palm[:3, :3], palm[:3, 3], values)
    )
    assert np.isfinite(rows).all()
    return rows[slack.ravel() >= -edge]


def moved_by(screws: Screws, angles: Array) -> Array:
    """Return the palm pose by the product of exponentials, without formulas of the package."""
    pose, zero = np.eye(4), np.eye(4)
    for axis, point, angle in zip(screws.axes, screws.points, angles, strict=True):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        step[:3, 3] = point - step[:3, :3] @ point
        pose = pose @ step
    zero[:3, :3], zero[:3, 3] = screws.rotation, screws.origin
    return pose @ zero


def differences(angles: Array, reference: Array) -> Array:
    """Return the largest difference of angles modulo whole turns."""
    return np.abs(np.angle(np.exp(1j * (angles - reference)))).max(axis=-1, initial=0.0)


@pytest.mark.parametrize("name", KINDS)
def test_arm_family_is_recognised_from_axes(name):
    assert describe_arm(robot_of(name).description) == KINDS[name]
    assert family(name).is_exact == (name not in MODEL_ERROR and name not in OFFSET)


@pytest.mark.parametrize(
    "name", ["panda+shadow", "ur5e+shadow", "kuka_lwr4+shadow", "sawyer+shadow", "xarm6+shadow"]
)
def test_wrist_is_locked_for_families_without_it(name, rng):
    robot = ik.load_robot(name)
    family_arm = arm_family(robot.description)
    assert family_arm is not None
    count = len(family_arm.screws)
    assert family_arm.locked == (count - 2, count - 1)
    assert family_arm.kind == f"{KINDS[name.split('+')[0]]}, joints {count - 1}, {count} held"
    for q in robot.random(rng, 3):
        arm = q[:count]
        for row in arms(family_arm, robot.palm(q), arm):
            np.testing.assert_allclose(row[-2:], arm[-2:])
            np.testing.assert_allclose(moved_by(family_arm.screws, row), robot.palm(q), atol=1e-9)


@pytest.mark.parametrize("name", ALL)
def test_solutions_reach_the_palm_and_include_the_generating_arm(name):
    """Random poses and poses near limits.

    At the edge of reach one arm of two may be missed by an offset wrist; of a swept one the edge is
    that at a position of the swept joint: it is found at another.
    """
    robot, family_arm, rng = robot_of(name), family(name), np.random.default_rng(1)
    screws, error, own_columns = arm_screws(robot.description), MODEL_ERROR.get(name, 0.0), []
    for q in [*robot.random(rng, 30), *near_limits(robot, rng, 30)]:
        arm = q[: len(screws)]
        palm = moved_by(screws, arm)
        rows = arms(family_arm, palm, arm, edge=1e-9)
        for row in rows:
            np.testing.assert_allclose(moved_by(screws, row), palm, atol=1e-7 + error)
        own_columns.append(len(rows) > 0 and differences(rows, arm).min() < 1e-5)
    expected_shares = {"sawyer": 0.85, "xarm6": 0.99, "kinova_gen3": 0, "kuka_lwr4": 0}
    assert np.mean(own_columns) >= expected_shares.get(name, 1.0)


@pytest.mark.parametrize(
    ("name", "straight"), [("ur5e", 0.0), ("ur10e", np.pi), ("puma560", 0.0), ("irb140", 0.0)]
)
def test_solutions_reach_the_palm_near_wrist_singularities(name, straight):
    """Near a singular wrist, the directions of two short vectors still count."""
    robot, screws, rng = robot_of(name), family(name).screws, np.random.default_rng(3)
    for power in range(3, 13):
        for q in robot.random(rng, 5):
            q[4] = straight + 10.0**-power
            rows = arms(family(name), robot.palm(q), q)
            assert len(rows)
            for row in rows:
                full_q = np.concatenate([row, q[len(screws) :]])
                np.testing.assert_allclose(robot.palm(full_q), robot.palm(q), atol=1e-7)


@pytest.mark.parametrize("name", ALL)
def test_singular_poses_lose_no_solution(name):
    """Aligned wrists, straight elbows and wrists above the shoulder keep a finite solution."""
    screws, rng = arm_screws(robot_of(name).description), np.random.default_rng(2)
    count, error = len(screws), MODEL_ERROR.get(name, 0.0)
    poses = [np.zeros(count), np.full(count, 1e-13)]
    for joint in range(count):
        for value in (0.0, 1e-13, 1e-9, np.pi / 2, -np.pi / 2):
            poses.append(rng.uniform(-1, 1, count))
            poses[-1][joint] = value
    for arm in poses:
        palm = moved_by(screws, arm)
        rows = arms(family(name), palm, arm, edge=1e-9)
        # A nominal arm or an offset wrist may be slightly too short when it is stretched out.
        assert len(rows) or error or name in OFFSET, arm
        for row in rows:
            assert np.abs(moved_by(screws, row) - palm).max() < 1e-4 + error


@pytest.mark.parametrize("name", ALL)
def test_reachable_poses_have_zero_distance_and_distant_poses_do_not(name):
    robot, arm = robot_of(name), family(name)
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = (ca.DM(end[: len(arm.screws)]) for end in (robot.lower, robot.upper))
    excess = arm.distance_out_of_reach(Pose(rotation, origin), lower, upper)
    excess_of = ca.Function("beyond", [rotation, origin], [excess])
    q = robot.random(np.random.default_rng(3), 300)
    palm = robot.palm(q)
    slack = 1e-9 + MODEL_ERROR.get(name, 0.0)
    assert all(abs(float(excess_of(pose[:3, :3], pose[:3, 3]))) < slack for pose in palm)
    palm[:, :3, 3] += [4.0, 0.0, 0.0]
    assert all(float(excess_of(pose[:3, :3], pose[:3, 3])) > 0.1 for pose in palm)
    assert not len(arms(arm, palm[0], q[0]))


def moved_screws(screws: Screws, rng: np.random.Generator) -> Screws:
    """Return the same arm with another base, another zero and other points on its axes."""
    turn, shift = Rotation.random(random_state=rng.integers(1000)).as_matrix(), rng.normal(size=3)
    axes, points = screws.axes @ turn.T, screws.points @ turn.T + shift
    for i, angle in enumerate(rng.uniform(-3, 3, len(screws))):
        bent = Rotation.from_rotvec(angle * axes[i]).as_matrix()
        axes[i + 1 :] = axes[i + 1 :] @ bent.T
        points[i + 1 :] = (points[i + 1 :] - points[i]) @ bent.T + points[i]
    shifts = rng.normal(size=(len(screws), 1))
    return replace(screws, axes=axes, points=points + shifts * axes)


@pytest.mark.parametrize("name", ALL)
def test_solutions_are_invariant_to_base_zero_and_point_choice(name):
    screws = arm_screws(robot_of(name).description)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        moved_arm = moved_screws(screws, rng)
        arm = family_of(moved_arm)
        assert arm is not None
        # Either of two exact families may come first where a link lies along an axis.
        assert len(arm.redundancy) == len(family(name).redundancy)
        assert arm.model_error == pytest.approx(family(name).model_error, abs=1e-9)
        angles = rng.uniform(-2, 2, len(screws))
        palm = moved_by(moved_arm, angles)
        for row in arms(arm, palm, angles):
            np.testing.assert_allclose(
                moved_by(moved_arm, row), palm, atol=1e-6 + MODEL_ERROR.get(name, 0.0)
            )


def test_small_model_deviations_keep_the_family():
    screws = arm_screws(robot_of("puma560").description)
    for size, is_known in ((5e-4, True), (1e-2, True), (4e-2, False)):
        points = screws.points.copy()
        points[4] += size * np.cross(screws.axes[3], screws.axes[4])
        arm = family_of(replace(screws, points=points))
        assert (arm is not None and not arm.is_iterative) == is_known
        assert arm is None or 1e-9 < arm.model_error < 1e-2
    points = screws.points.copy()
    points[3] += 0.05 * np.cross(screws.axes[3], screws.axes[4])
    points[5] += 0.07 * np.cross(screws.axes[5], screws.axes[4])
    assert family_of(replace(screws, points=points)) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda", "puma560", "irb140", "ur5e", "xarm6"])
def test_numerical_search_finds_no_additional_solution(name):
    """SciPy's least squares with a fixed swept joint finds no other solution."""
    screws, rng, columns, total = (
        arm_screws(robot_of(name).description),
        np.random.default_rng(4),
        0,
        0,
    )
    swept = [redundancy.joint for redundancy in family(name).redundancy]
    free = [i for i in range(len(screws)) if i not in swept]
    for q in robot_of(name).random(rng, 2):
        arm = q[: len(screws)]
        palm = moved_by(screws, arm)
        rows = arms(family(name), palm, arm)

        def left(x: Array, arm: Array = arm, palm: Array = palm) -> Array:
            candidate = arm.copy()
            candidate[free] = x
            return (moved_by(screws, candidate) - palm)[:3].ravel()

        for start in rng.uniform(-np.pi, np.pi, (25, len(free))):
            ended = least_squares(left, start, xtol=1e-15)
            if np.abs(ended.fun).max() < 1e-9:
                total += 1
                joint_row = np.insert(ended.x, swept, arm[swept]) if swept else ended.x
                columns += differences(rows, joint_row).min() < 1e-4
    assert total > 15
    assert columns == total


@pytest.mark.parametrize("name", SOLVED[1:])
def test_solutions_include_those_of_eaik(name):
    """EAIK (Ostermeier et al. 2024) solves the same poses by its own subproblems."""
    eaik = pytest.importorskip("eaik.IK_HP")
    robot, screws = robot_of(name), family(name).screws
    screws = screws.reversed() if screws.reverse else screws
    swept = [redundancy.joint for redundancy in family(name).redundancy]
    offsets = np.diff([np.zeros(3), *screws.points, screws.origin], axis=0)
    count = 0
    for q in robot.random(np.random.default_rng(5), 30):
        arm = q[: len(screws)]
        peer = eaik.HPRobot(screws.axes, offsets, [(j, float(arm[j])) for j in swept])
        target = robot.palm(q)
        target[:3, :3] = target[:3, :3] @ screws.rotation.T
        answer = peer.IK(target)
        theirs = np.asarray(answer.Q)[~np.asarray(answer.is_LS, dtype=bool)]
        if swept and theirs.size and theirs.shape[1] == len(arm) - 1:
            theirs = np.insert(theirs, swept, arm[swept], axis=1)
        rows = arms(family(name), robot.palm(q), arm, edge=1e-9)
        count += len(theirs)
        assert all(differences(rows, row).min() < 1e-5 for row in theirs)
    assert count > 60


@pytest.mark.parametrize("name", OFFSET)
def test_offset_wrist_search_loses_no_root(name):
    """Brent's method on a scan of 720 turns finds the same roots, branch by branch."""
    robot, family_arm = robot_of(name), family(name)
    assert isinstance(family_arm, OffsetWristArm)
    assert np.linalg.norm(family_arm.offset) == pytest.approx(OFFSET[name])
    turns, condition = np.linspace(-np.pi, np.pi, 721), family_arm._branch()
    lost_count = total = 0
    for q in robot.random(np.random.default_rng(8), 8):
        palm, arm = robot.palm(q), q[: len(family_arm.screws)]
        rows = arms(family_arm, palm, arm)
        swept = arm[0] if family_arm.redundancy else 0.0
        rotation, origin, *_ = family_arm._start()(swept, palm[:3, :3], palm[:3, 3])
        for signs in SIGNS:

            def left(t: float, pose: tuple = (rotation, origin), signs: tuple = signs) -> float:
                return float(condition(*pose, t, *signs)[2])

            values = condition.map(len(turns))(rotation, origin, turns, *signs)[2]
            values = np.array(values).ravel()
            crossed = (values[1:] * values[:-1] < 0) & (np.abs(np.diff(values)) < 1)
            for i in np.flatnonzero(crossed):
                t = brentq(left, turns[i], turns[i + 1], xtol=1e-14)
                six, slack, residual = condition(rotation, origin, t, *signs)
                # Two arms that are close together at the edge of reach may both be missed.
                if float(slack) < 0.05 or abs(float(residual)) > 1e-9:
                    continue
                full_arm = np.array(family_arm._all_joints_function()(six, swept)).ravel()
                total += 1
                lost_count += not len(rows) or differences(rows, full_arm).min() > 1e-6
    assert total > 15
    assert lost_count == 0


def srs_numbers(robot: ik.ArmHand):
    """Return a Function (palm, elbow sign, bounds (7,)) -> breakpoints (24,) of an S-R-S arm."""
    arm = srs_arm(robot.description)
    assert arm is not None
    rotation, origin, sign = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("sign")
    lower, upper = ca.SX.sym("lower", 7), ca.SX.sym("upper", 7)
    breakpoints = arm.breakpoints(Pose(rotation, origin), (sign,), lower, upper)
    breakpoints_of = ca.Function(
        "breakpoints", [rotation, origin, sign, lower, upper], [breakpoints]
    )
    return lambda palm, sign, *bounds: np.array(
        breakpoints_of(palm[:3, :3], palm[:3, 3], sign, *bounds)
    ).ravel()


def at_swivels(robot: ik.ArmHand, palm: Array, swivels: Array) -> Array:
    """Return all arms (8 k, 7) of an S-R-S arm at swivels (k,)."""
    arm = arm_family(robot.description)
    assert arm is not None
    rows = [function(arm)(palm[:3, :3], palm[:3, 3], psi)[0] for psi in swivels]
    return np.concatenate([np.array(row) for row in rows])


@pytest.mark.slow
def test_srs_breakpoints_are_where_joints_take_their_value(robot, rng):
    """At a breakpoint, a joint is at a bound that some swivel meets."""
    numbers_of, tested = srs_numbers(robot), 0
    for q in robot.random(rng, 10):
        palm, sign, arm = robot.palm(q), np.sign(q[3]), q[:7]
        for swivels in numbers_of(palm, sign, arm, arm).reshape(6, 4):
            assert differences(at_swivels(robot, palm, swivels), arm).min() < 1e-7
        ends = robot.lower[:7], robot.upper[:7]
        swivels = numbers_of(palm, sign, *ends).reshape(6, 2, 2)
        for joint, of_joint in zip((0, 1, 2, 4, 5, 6), swivels, strict=True):
            for end, at in zip(ends, of_joint, strict=True):
                angles = at_swivels(robot, palm, at)[:, joint]
                off = np.abs(np.sin((angles - end[joint]) / 2)).min()
                # For a bound that no swivel meets, the breakpoint is the closest approach.
                assert off < 1e-9 or off > 1e-6
                tested += off < 1e-9
    assert tested > 20


def test_srs_reach_follows_elbow_bounds(robot):
    arm = srs_arm(robot.description)
    assert arm is not None
    for lower, upper in ((-2.0, 2.0), (0.3, 2.0), (-2.0, -0.4), (0.7, 0.7), (-1e3, 1e3)):
        lowest, highest = (float(value) for value in arm.reach(ca.SX(lower), ca.SX(upper)))
        bends = np.linspace(max(lower, -np.pi), min(upper, np.pi), 2001)
        distance = np.linalg.norm([0.4 + 0.39 * np.cos(bends), 0.39 * np.sin(bends)], axis=0)
        np.testing.assert_allclose([lowest, highest], [distance.min(), distance.max()], atol=1e-6)


@settings(max_examples=12)
@given(
    heights=st.fixed_dictionaries({number: st.floats(0.05, 0.4) for number in "1234567"}),
    shift=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
    turn=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
    seed=st.integers(0, 2**16),
)
def test_srs_solutions_with_other_links_and_mounts(heights, shift, turn, seed):
    with tempfile.TemporaryDirectory() as folder:
        robot = derived_robot(Path(folder), heights, (shift, turn))
    rng = np.random.default_rng(seed)
    q = robot.random(rng, 1)[0]
    # Any method loses half of the digits at a straight elbow.
    q[3] = np.copysign(max(abs(q[3]), 0.05), q[3])
    rows = at_swivels(robot, robot.palm(q), rng.uniform(-3, 3, 2))
    full_q = np.hstack([rows, np.tile(q[7:], (len(rows), 1))])
    assert len(np.unique(np.round(rows, 6), axis=0)) == len(rows)
    expected = np.broadcast_to(robot.palm(q), (len(rows), 4, 4))
    np.testing.assert_allclose(robot.palm(full_q), expected, atol=1e-10)


def test_non_srs_arms_are_not_recognised_as_srs(tmp_path, own_robot, coupled_robot):
    """An offset elbow, a split shoulder, a skew axis and a missing arm are not S-R-S."""
    (tmp_path / "elbow").mkdir()
    assert srs_arm(derived_robot(tmp_path / "elbow", elbow_offset=0.045).description) is None
    assert srs_arm(coupled_robot.description) is None
    arm = own_robot.parent / "arm.yaml"
    text = arm.read_text()
    assert srs_arm(ik.load_robot(own_robot).description) is not None
    for old, new in (
        ("[0, 0, 200.5 mm]", "[30 mm, 0, 200.5 mm]"),
        ("lwr_link_6, axis: [0, -1, 0]", "lwr_link_6, axis: [0, -1, 0.2]"),
    ):
        arm.write_text(text)
        toy_robots.replace(arm, old, new)
        assert srs_arm(ik.load_robot(own_robot).description) is None


BENDS = [(s, e, w) for s in (1, -1) for e in (1, -1) for w in (1, -1)]


class Arm:
    """Robot, branches of its arm, and bounds of the arm."""

    def __init__(self, name: str) -> None:
        self.robot = ik.load_robot(f"{name}+barrett_bh8_280")
        family = arm_family(self.robot.description)
        assert family is not None
        self.branches, count = ArmBranches(family, compiled=False), len(family.screws)
        self.around = bool(family.redundancy) and family.redundancy[0].joint is None
        self.columns = slice(0, count)
        self.bounds = self.robot.lower[self.columns], self.robot.upper[self.columns]
        if family.redundancy:
            self.range = tuple(float(end) for end in family.redundancy[0].bounds(*self.bounds))

    def palms(self, seed, count):
        q = self.robot.random(np.random.default_rng(seed), count)
        return [(self.robot.palm(row), row[self.columns]) for row in q]

    def margin(self, arms):
        return np.minimum(arms - self.bounds[0], self.bounds[1] - arms).min(axis=-1)

    def contains(self, stretch, values):
        start, end = stretch
        if self.around:
            return np.mod(values - start, 2 * np.pi) <= end - start
        return (values >= start) & (values <= end)


@cache
def arm_of(name: str) -> Arm:
    return Arm(name)


@pytest.mark.parametrize("name", ["kuka_lwr4", "panda", "kinova_gen3", "xarm7"])
def test_branch_intervals_equal_the_allowed_swivels(name):
    """A scan of the whole redundancy, one branch at a time, finds the same intervals."""
    arm, inside_anywhere = arm_of(name), 0
    scan = np.linspace(*arm.range, 700)[1:-1] + 1e-4
    for palm, own_angles in arm.palms(1, 3):
        branches = arm.branches.find(palm, *arm.bounds)
        assert branches
        margins = arm.branches._limit_margins(palm, scan, *arm.bounds)
        for kind in BENDS:
            of_kind = [b.swivel for b in branches if (b.shoulder, b.elbow, b.wrist) == kind]
            arms = arm.branches.arms(palm, ik.solve.ArmBranch(*kind, arm.range), scan)
            row = np.abs(
                arm.branches._closed_form(palm[:3, :3], palm[:3, 3], scan)[0] - arms[:, None]
            )
            (row,) = np.flatnonzero(row.max(axis=(0, 2)) == 0)
            in_branch = np.any([arm.contains(b, scan) for b in of_kind] or [scan > 1e9], axis=0)
            np.testing.assert_array_equal(in_branch, margins[:, row] >= 0)
            inside_anywhere += int(in_branch.sum())
        # An interval ends where a joint is at a limit or the arm is stretched out.
        for branch in branches:
            ends = arm.branches.arms(palm, branch, np.array(branch.swivel))
            assert (arm.margin(ends) > -1e-6).all()
            if arm.around and branch.swivel[1] - branch.swivel[0] < 2 * np.pi - 1e-9:
                np.testing.assert_allclose(arm.margin(ends), 0, atol=1e-7)
        # The configuration itself is among them, up to whole turns.
        arms_of_branches = [
            arm.branches.arms(palm, b, np.linspace(*b.swivel, 2000)) for b in branches
        ]
        off = min(
            np.abs(np.angle(np.exp(1j * (arms - own_angles)))).max(axis=1).min()
            for arms in arms_of_branches
        )
        assert off < 0.02 or not arm.branches.family.is_exact
    assert inside_anywhere > 0


@pytest.mark.parametrize("name", ["ur5e", "puma560", "irb140", "xarm6"])
def test_six_joint_arms_have_single_branches(name):
    """The arm that generated a palm pose is among the solutions, up to whole turns."""
    arm = arm_of(name)
    for palm, own_angles in arm.palms(2, 8):
        branches = arm.branches.find(palm, *arm.bounds)
        assert len(set(branches)) == len(branches)
        assert all(branch.swivel is None for branch in branches)
        arms = [arm.branches.arms(palm, branch, np.zeros(1))[0] for branch in branches]
        assert min(np.abs(np.angle(np.exp(1j * (a - own_angles)))).max() for a in arms) < 1e-6
