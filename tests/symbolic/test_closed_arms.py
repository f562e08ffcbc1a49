"""Arms in closed form: recognised from their screws, every arm found, finite at singular poses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.methods.common.arm_branches import form_at
from casadi_ik.symbolic.closed_arms.form import ClosedForm
from casadi_ik.symbolic.closed_arms.held import held_arm
from casadi_ik.symbolic.closed_arms.recognise import (
    arm_form,
    closed_form,
    form_of_screws,
    passing,
    recognised,
)
from casadi_ik.symbolic.closed_arms.screws import Screws, arm_screws
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import SrsArm

KINDS = {
    "panda": "spherical shoulder, joint 7 swept",
    "fr3": "spherical shoulder, joint 7 swept",
    "xarm7": "spherical shoulder, joint 7 swept",
    "kinova_gen3": "spherical wrist, joint 1 swept",
    "baxter_left": "spherical wrist, joint 1 swept",
    "baxter_right": "spherical wrist, joint 1 swept",
    "puma560": "spherical wrist",
    "viperx_300s": "spherical wrist",
    "jaco2": "spherical wrist",
    "irb140": "spherical wrist",
    **{f"ur{name}": "three parallel axes" for name in ("3e", "5e", "10e", "16e", "5", "10")},
}
"""What the arms of the catalogue are, by their makers' drawings."""

FAMILIES = ("panda", "xarm7", "kinova_gen3", "puma560", "irb140", "ur5e")
"""One of each kind."""

NEARLY = {"kinova_gen3": 2e-3, "baxter_left": 3e-2, "baxter_right": 3e-2}
"""Poses [m] of arms that are solved as the ideal arm beside them."""


@cache
def robot_of(name: str) -> ik.ArmHand:
    return ik.load_robot(f"{name}+barrett_bh8_280")


@cache
def form_of(name: str) -> ClosedForm:
    return closed_form(robot_of(name).description)


@cache
def arms_of(name: str) -> ca.Function:
    return form_at(form_of(name))


def arms(name: str, palm: Array, swept: float) -> tuple[Array, Array]:
    """The eight arms (8, n) and their slack (8,)."""
    rows, slack = arms_of(name)(palm[:3, :3], palm[:3, 3], swept)
    return np.array(rows), np.array(slack).ravel()


def columns(name: str) -> list[int]:
    return list(robot_of(name).description.arm_actuators)


def palms(name: str, rows: Array) -> Array:
    robot = robot_of(name)
    q = np.tile(robot.home, (len(rows), 1))
    q[:, columns(name)] = rows
    return robot.palm(q)


def swept_of(name: str, arm: Array) -> float:
    joint = form_of(name).swept_joint
    return 0.0 if joint is None else float(arm[joint])


def apart(one: Array, other: Array) -> Array:
    """Largest difference of angles, whole turns aside."""
    return np.abs(np.angle(np.exp(1j * (one - other)))).max(axis=-1)


@pytest.mark.parametrize("name", KINDS)
def test_an_arm_is_recognised_by_its_axes(name):
    assert form_of(name).kind == KINDS[name]
    assert form_of(name).exact == (name not in NEARLY)


def test_an_arm_without_a_closed_form_says_so():
    """A Puma whose wrist is pulled apart: none of its axes meet there any more."""
    screws = arm_screws(robot_of("puma560").description)
    points = screws.points.copy()
    points[3] += 0.05 * np.cross(screws.axes[3], screws.axes[4])
    points[5] += 0.07 * np.cross(screws.axes[5], screws.axes[4])
    pulled = replace(screws, points=points)
    assert recognised(pulled) is None
    assert passing(pulled) is None
    with pytest.raises(UnsupportedError, match="has no closed form: found no three axes"):
        form_of_screws("pulled", pulled)


def test_the_elbow_that_swings_comes_first(robot):
    assert isinstance(arm_form(robot.description), SrsArm)


@pytest.mark.parametrize("name", FAMILIES)
def test_every_arm_brings_the_palm_there_and_one_is_that_it_was_made_with(name):
    robot, near = robot_of(name), NEARLY.get(name, 0.0)
    for q in robot.random(np.random.default_rng(1), 40):
        palm, arm = robot.palm(q), q[columns(name)]
        rows, slack = arms(name, palm, swept_of(name, arm))
        assert np.isfinite(rows).all()
        reached = rows[slack >= 0]
        np.testing.assert_allclose(
            palms(name, reached), np.broadcast_to(palm, (len(reached), 4, 4)), atol=1e-9 + near
        )
        if not near:
            assert apart(rows, arm).min() < 1e-6
            # Within a turn around the middle of its range, as the limits are looked at.
            middle = (robot.lower + robot.upper)[columns(name)] / 2
            assert (np.abs(rows - middle) <= np.pi + 1e-9).all() or form_of(name).swept


@pytest.mark.parametrize(
    ("name", "straight"), [("ur5e", 0.0), ("ur10e", np.pi), ("puma560", 0.0), ("irb140", 0.0)]
)
def test_next_to_a_singular_wrist_every_arm_brings_the_palm_there(name, straight):
    """However near: what the directions of two short vectors say is not taken for nothing."""
    robot, rng = robot_of(name), np.random.default_rng(3)
    for power in range(3, 13):
        for q in robot.random(rng, 5):
            q[columns(name)[4]] = straight + 10.0**-power
            palm = robot.palm(q)
            rows, slack = arms(name, palm, 0.0)
            reached = palms(name, rows[slack >= 0])
            assert len(reached)
            np.testing.assert_allclose(
                reached, np.broadcast_to(palm, (len(reached), 4, 4)), atol=1e-7
            )


def moved_screws(screws: Screws, rng: np.random.Generator) -> Screws:
    """The same arm on another base, with another zero."""
    turn, shift = Rotation.random(random_state=rng.integers(1000)).as_matrix(), rng.normal(size=3)
    axes, points = screws.axes @ turn.T, screws.points @ turn.T + shift
    for i, angle in enumerate(rng.uniform(-3, 3, len(screws))):
        bent = Rotation.from_rotvec(angle * axes[i]).as_matrix()
        axes[i + 1 :] = axes[i + 1 :] @ bent.T
        points[i + 1 :] = (points[i + 1 :] - points[i]) @ bent.T + points[i]
    along = rng.normal(size=(len(screws), 1))
    return replace(screws, axes=axes, points=points + along * axes)


@pytest.mark.parametrize("name", FAMILIES)
def test_neither_base_nor_zero_nor_the_names_of_points_matter(name):
    screws = arm_screws(robot_of(name).description)
    for seed in range(5):
        moved = moved_screws(screws, np.random.default_rng(seed))
        found = recognised(moved)
        assert found is not None
        # Of two forms that both are exact, either may come first where a link is along an axis.
        assert found.swept == form_of(name).swept
        assert found.off == pytest.approx(form_of(name).off, abs=1e-9)
        if found.exact:
            _check_screws(found, moved, np.random.default_rng(seed).uniform(-2, 2, len(screws)))


def _check_screws(form: ClosedForm, screws: Screws, angles: Array) -> None:
    """The arm is found again by its product of exponentials."""
    pose = np.eye(4)
    for axis, point, angle in zip(screws.axes, screws.points, angles, strict=True):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        step[:3, 3] = point - step[:3, :3] @ point
        pose = pose @ step
    zero = np.eye(4)
    zero[:3, :3], zero[:3, 3] = screws.rotation, screws.origin
    palm = pose @ zero
    joint = form.swept_joint
    rows, _ = form_at(form)(palm[:3, :3], palm[:3, 3], 0.0 if joint is None else angles[joint])
    assert apart(np.array(rows), angles).min() < 1e-6


def test_what_is_nearly_of_a_form_is_solved_as_that_and_what_is_not_is_not():
    screws = arm_screws(robot_of("puma560").description)
    for size, known in ((5e-4, True), (1e-2, True), (4e-2, False)):
        points = screws.points.copy()
        points[4] += size * np.cross(screws.axes[3], screws.axes[4])
        form = recognised(replace(screws, points=points))
        assert (form is not None) == known
        if form is not None:
            assert not form.exact
            assert form.off < 1e-2


@pytest.mark.parametrize("name", FAMILIES)
def test_nothing_is_lost_at_singular_poses(name):
    """Wrist aligned, elbow straight, wrist over the shoulder: finite, and the palm still there."""
    robot = robot_of(name)
    rng = np.random.default_rng(2)
    for joint in range(len(columns(name))):
        for value in (0.0, 1e-13, 1e-9, np.pi / 2, -np.pi / 2):
            arm = rng.uniform(-1, 1, len(columns(name)))
            arm[joint] = value
            _check_singular(robot, name, arm)
    zero = np.zeros(len(columns(name)))
    for arm in (zero, zero + 1e-13):
        _check_singular(robot, name, arm)


def _check_singular(robot: ik.ArmHand, name: str, arm: Array) -> None:
    palm = palms(name, arm[None])[0]
    rows, slack = arms(name, palm, swept_of(name, arm))
    assert np.isfinite(rows).all()
    near = NEARLY.get(name, 0.0)
    reached = rows[slack >= -1e-9]
    # Stretched out, an arm that is only nearly of its form may be a little short.
    assert len(reached) or near, arm
    if not len(reached):
        return
    assert np.abs(palms(name, reached) - palm).max() < 1e-4 + near, robot.name


def test_far_away_nothing_is_in_reach():
    for name in FAMILIES:
        palm = robot_of(name).palm(robot_of(name).home).copy()
        palm[:3, 3] += [0.0, 5.0, 0.0]
        rows, slack = arms(name, palm, 0.1)
        assert np.isfinite(rows).all()
        assert (slack < 0).all()


@pytest.mark.parametrize("name", FAMILIES)
def test_what_is_in_reach_is_never_said_to_be_beyond(name):
    robot, form = robot_of(name), form_of(name)
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = (ca.DM(end[columns(name)]) for end in (robot.lower, robot.upper))
    beyond = form.beyond(Pose(rotation, origin), lower, upper)
    asked = ca.Function("beyond", [rotation, origin], [beyond])
    palm = robot.palm(robot.random(np.random.default_rng(3), 300))
    slack = 1e-9 + NEARLY.get(name, 0.0)
    assert all(abs(float(asked(each[:3, :3], each[:3, 3]))) < slack for each in palm)
    palm[:, :3, 3] += [3.0, 0.0, 0.0]
    assert all(float(asked(each[:3, :3], each[:3, 3])) > 0.1 for each in palm)


def _descents(name: str, palm: Array, swept: float, starts: Array) -> Array:
    """Arms that Newton's method comes to from many starts, the swept joint held."""
    joint = form_of(name).swept_joint
    free = [i for i in range(starts.shape[1]) if i != joint]
    found = starts.copy()
    if joint is not None:
        found[:, joint] = swept

    def errors(rows: Array) -> Array:
        poses = palms(name, rows)
        return np.concatenate(
            [poses[:, :3, 3] - palm[:3, 3], (poses[:, :3, :3] - palm[:3, :3]).reshape(-1, 9)],
            axis=1,
        )

    for _ in range(60):
        now = errors(found)
        slopes = np.empty((len(found), 12, len(free)))
        for k, i in enumerate(free):
            moved = found.copy()
            moved[:, i] += 1e-6
            slopes[:, :, k] = (errors(moved) - now) / 1e-6
        squares = slopes.transpose(0, 2, 1) @ slopes + 1e-9 * np.eye(len(free))
        right = slopes.transpose(0, 2, 1) @ now[:, :, None]
        step = np.linalg.solve(squares, right)[:, :, 0]
        size = np.abs(step).max(axis=1, keepdims=True)
        found[:, free] -= step * np.minimum(1.0, 0.5 / np.maximum(size, 1e-12))
    return found[np.abs(errors(found)).max(axis=1) < 1e-9]


@pytest.mark.parametrize("name", ["panda", "puma560", "irb140", "ur5e"])
def test_a_search_from_many_starts_finds_no_other_arm(name):
    robot, rng = robot_of(name), np.random.default_rng(4)
    for q in robot.random(rng, 3):
        arm = q[columns(name)]
        rows, slack = arms(name, robot.palm(q), swept_of(name, arm))
        starts = rng.uniform(-np.pi, np.pi, (150, len(arm)))
        found = _descents(name, robot.palm(q), swept_of(name, arm), starts)
        assert len(found) > 20
        assert all(apart(rows[slack >= 0], each).min() < 1e-5 for each in found)
        # And most arms are found by the search: the oracle is no empty one.
        seen = [apart(found, row).min() < 1e-5 for row in rows[slack >= 0]]
        assert np.mean(seen) > 0.6


@pytest.mark.parametrize("name", FAMILIES)
def test_every_arm_of_another_library_is_among_ours(name):
    """EAIK (Ostermeier et al. 2024), by subproblems of its own."""
    eaik = pytest.importorskip("eaik.IK_HP")
    robot, screws = robot_of(name), form_of(name).screws
    screws = screws.reversed() if screws.reverse else screws
    joint = form_of(name).swept_joint
    offsets = np.diff([np.zeros(3), *screws.points, screws.origin], axis=0)
    count = 0
    for q in robot.random(np.random.default_rng(5), 30):
        arm = q[columns(name)]
        fixed = [] if joint is None else [(joint, float(arm[joint]))]
        other = eaik.HPRobot(screws.axes, offsets, fixed)
        palm = robot.palm(q)
        target = palm.copy()
        target[:3, :3] = palm[:3, :3] @ screws.rotation.T
        answer = other.IK(target)
        theirs = np.asarray(answer.Q)[~np.asarray(answer.is_LS, dtype=bool)]
        if joint is not None and theirs.size and theirs.shape[1] == len(arm) - 1:
            theirs = np.insert(theirs, joint, arm[joint], axis=1)
        rows, slack = arms(name, palm, swept_of(name, arm))
        count += len(theirs)
        for each in theirs:
            assert apart(rows[slack >= -1e-9], each).min() < 1e-5
    assert count > 60


@pytest.mark.parametrize(
    "name", ["panda+shadow", "ur5e+shadow", "kuka_lwr4+shadow", "sawyer+shadow", "xarm6+shadow"]
)
def test_a_wrist_is_held_where_there_is_a_form_without_it(name, rng):
    """What is left to the other joints is the palm's pose with the wrist at zero."""
    robot = ik.load_robot(name)
    found = held_arm(robot.description)
    assert found is not None
    count = len(robot.description.arm_actuators)
    assert found.held == (count - 2, count - 1)
    assert found.passes == name.startswith(("sawyer", "xarm6"))
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    angles = ca.SX.sym("angles", 2)
    pose = found.seen(Pose(rotation, origin), angles)
    seen = ca.Function("seen", [rotation, origin, angles], [pose.rotation, pose.origin])
    for q in robot.random(rng, 5):
        palm, held = robot.palm(q), list(found.held)
        expected_q = q.copy()
        expected_q[held] = 0.0
        expected = robot.palm(expected_q)
        left = [np.array(part) for part in seen(palm[:3, :3], palm[:3, 3], q[held])]
        np.testing.assert_allclose(left[0], expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(left[1].ravel(), expected[:3, 3], atol=1e-12)
