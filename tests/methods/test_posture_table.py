"""What rounds begin from: tables of hand postures, mended finger by finger."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.posture_table import PostureTable, contact_shape
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.state import STAGES
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.symbolic.even_spread import evenly

HAND = tuple(range(7, 14))


def shape(points, normals):
    (values,) = FunctionKernel(contact_shape(points.shape[1]))(points, normals)
    return values.reshape(len(points), -1)


@pytest.fixture(scope="module")
def table(robot):
    return PostureTable(robot, HAND, 512)


def test_shape_does_not_see_rigid_motions(robot, rng):
    points, normals = robot.contacts(robot.random(rng, 30))
    turn = Rotation.random(rng=rng).as_matrix()
    values = shape(points, normals)
    moved = shape(points @ turn.T + [1.0, -2.0, 0.5], normals @ turn.T)
    np.testing.assert_allclose(moved, values, atol=1e-9)
    assert (np.ptp(values, axis=0) > 0.1).all()


def test_shape_sees_a_mirror(robot, rng):
    """Mirrored contacts are another shape: no hand turns into its mirror image."""
    points, normals = robot.contacts(robot.random(rng, 30))
    mirror = np.diag([1.0, 1.0, -1.0])
    difference = shape(points @ mirror, normals @ mirror) - shape(points, normals)
    assert np.median(np.abs(difference).max(axis=1)) > 0.1


def test_shape_of_free_contacts(robot, rng):
    points, normals = robot.contacts(robot.random(rng, 2))
    points[0, 1] = normals[0, 1] = normals[1, 2] = np.nan
    known = ~np.isnan(shape(points, normals))
    assert 0 < known[0].sum() < known[1].sum() < known.shape[1]


def test_shape_of_one_finger():
    values = shape(np.zeros((3, 1, 3)), np.ones((3, 1, 3)))
    assert values.shape == (3, 1)
    assert np.isnan(values).all()


def test_a_posture_of_the_table_finds_itself(robot, table):
    q = np.tile(robot.home, (512, 1))
    q[:, HAND] = table.postures
    found = table.nearest(*robot.contacts(q), 1)[:, 0]
    assert np.mean(np.all(found == table.postures, axis=1)) > 0.99


def test_nearest_are_the_nearest_in_order(robot, table, rng):
    points, normals = robot.contacts(robot.random(rng, 20))
    q = np.tile(robot.home, (512, 1))
    q[:, HAND] = table.postures
    values = shape(*robot.contacts(q))
    wanted = shape(points, normals)
    distance = np.linalg.norm(values[None] - wanted[:, None], axis=2)
    for count in (8, 40):
        found = table.nearest(points, normals, count)
        rows = [
            [np.flatnonzero((table.postures == posture).all(axis=1))[0] for posture in row]
            for row in found
        ]
        reached = np.take_along_axis(distance, np.array(rows), axis=1)
        # Values are compared in steps of 1/64.
        assert (np.diff(reached, axis=1) > -0.1).all()
        np.testing.assert_allclose(reached, np.sort(distance, axis=1)[:, :count], atol=0.1)
        assert all(len(set(row)) == count for row in rows)


def test_a_target_finds_the_same_alone_and_in_a_batch(robot, table, rng):
    points, normals = robot.contacts(robot.random(rng, 300))
    normals[::7, 1] = np.nan
    batch = table.nearest(points, normals, 8)
    for i in range(0, 300, 11):
        alone = table.nearest(points[i : i + 1], normals[i : i + 1], 8)[0]
        np.testing.assert_array_equal(alone, batch[i])


def test_the_known_part_decides(robot, table, rng):
    """With a free normal the others still rank: an exact posture comes first."""
    q = np.tile(robot.home, (20, 1))
    q[:, HAND] = table.postures[:20]
    points, normals = robot.contacts(q)
    normals[:, 2] = np.nan
    found = table.nearest(points, normals, 3)
    assert np.mean((found == table.postures[:20, None]).all(axis=2).any(axis=1)) > 0.9


def test_all_free_but_one_finger_takes_any(robot, table):
    points, normals = robot.contacts(robot.home)
    points[1:] = normals[1:] = np.nan
    assert table.nearest(points[None], normals[None], 4).shape == (1, 4, 7)


def test_postures_at_limits(robot):
    table = PostureTable(robot, HAND, 256, at_limits=0.5)
    at = (table.postures == robot.lower[7:]) | (table.postures == robot.upper[7:])
    assert at.mean() == pytest.approx(0.5, abs=0.05)
    assert (table.postures >= robot.lower[7:]).all()
    assert (table.postures <= robot.upper[7:]).all()


@pytest.mark.parametrize("dimensions", [1, 3, 10])
def test_evenly(dimensions):
    points = evenly(1000, dimensions)
    assert points.shape == (1000, dimensions)
    assert (points >= 0).all()
    assert (points < 1).all()
    counts = np.array([np.histogram(column, 10, (0, 1))[0] for column in points.T])
    assert np.abs(counts - 100).max() <= 25
    np.testing.assert_array_equal(points[:10], evenly(10, dimensions))


def target(robot, rng, count):
    return TargetBatch(*robot.contacts(robot.random(rng, count)), ik.Tolerance(), True)


def stages_made_alike(robot, asked, starts):
    """The stages of a first round, which the virtual machine makes as compiled code does."""
    method = HandFirstMethod(robot.description, HandFirstParameters())
    slow = HandFirstMethod(robot.description, method.options, compiled=False)
    rows = method.rows(asked, starts, method.postures(asked, 0))
    fast, slow = (each.run_rows(*rows, trace=True) for each in (method, slow))
    np.testing.assert_array_equal(fast.status, slow.status)
    np.testing.assert_array_equal(fast.iterations, slow.iterations)
    np.testing.assert_allclose(fast.states, slow.states, atol=1e-7)
    for name in ("phase", "status", "accepted", "restart"):
        np.testing.assert_array_equal(fast.rows[name], slow.rows[name])
    return {ik.answers.Phase(phase) for phase in fast.rows["phase"]}


def test_without_a_compiler_every_stage_is_the_same(robot, rng):
    q = robot.random(rng, 25)
    points, normals = robot.contacts(q)
    points += rng.normal(0, 0.005, points.shape)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    starts = np.where(np.arange(25)[:, None] % 2, robot.home, q + 0.02)
    seen = set()
    for prefer in ("limits", "q0"):
        asked = TargetBatch(points, normals, ik.Tolerance(), True, prefer=prefer)
        seen |= stages_made_alike(robot, asked, starts)
    assert seen == set(STAGES)


@pytest.mark.parametrize("tolerance", [ik.Tolerance(), ik.Tolerance(1e-6, 1e-6)])
def test_without_a_compiler_an_arm_without_a_closed_form(tmp_path_factory, rng, tolerance):
    other = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    q = other.random(rng, 24)
    asked = TargetBatch(*other.contacts(q[:12]), tolerance, True)
    stages_made_alike(other, asked, q[12:])


def test_later_rounds_begin_from_hands_that_differ(robot, rng):
    method = HandFirstMethod(robot.description, HandFirstParameters())
    asked = target(robot, rng, 60)
    first, second = (method.postures(asked, number) for number in (0, 1))
    ranges = (robot.upper - robot.lower)[list(HAND)]
    gaps = []
    for found in (first, second):
        places = found / ranges
        apart = np.sqrt(np.mean((places[:, :, None] - places[:, None]) ** 2, axis=3))
        gaps.append(np.median(apart[:, *np.triu_indices(8, 1)].min(axis=1)))
    assert gaps[1] >= method.options.similar > gaps[0]


def test_a_table_beyond_limits(robot):
    bounds = robot.lower - 0.5, robot.upper + 0.5
    table = PostureTable(robot, HAND, 256, bounds=bounds)
    assert (table.postures < robot.lower[7:]).any(axis=0).all()
    assert (table.postures > robot.upper[7:]).any(axis=0).all()


@pytest.fixture(scope="module")
def hand() -> ik.ArmHand:
    return ik.load_robot("ar10")


def test_hands_of_many_motors_are_mended_finger_by_finger(hand, rng):
    """Within limits, and much nearer to the target than what looks like it in a table."""
    method = HandFirstMethod(hand.description, HandFirstParameters())
    asked, columns = target(hand, rng, 60), list(hand.description.hand_actuators)
    misfits = []
    for number in (0, 1):
        found = method.postures(asked, number)[:, 0]
        assert (found >= hand.lower[columns]).all()
        assert (found <= hand.upper[columns]).all()
        moved = np.tile(hand.home, (60, 1))
        moved[:, columns] = found
        misfits.append(_misfit(*hand.contacts(moved), asked.points, asked.normals))
    assert np.median(misfits[1]) < 0.6 * np.median(misfits[0])


def _misfit(points, normals, wanted, directions):
    """Differences of what no rigid motion changes: distances of points, cosines of normals."""
    shapes = [
        np.concatenate(
            [
                np.linalg.norm(p[:, :, None] - p[:, None], axis=3) / 0.1,
                np.einsum("kfi,kgi->kfg", n, n),
            ],
            axis=1,
        )
        for p, n in ((points, normals), (wanted, directions))
    ]
    return np.linalg.norm(shapes[0] - shapes[1], axis=(1, 2))


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_what_is_out_of_reach_ends_the_same_alone_and_in_a_batch(hand, rng, prefer):
    """All rounds are made for it."""
    points, normals = hand.contacts(hand.random(rng, 6))
    points = points + rng.normal(0, 0.008, points.shape)
    solver = ik.Solver(hand)
    many = solver.solve_batch(points, normals, prefer=prefer)
    assert not many.success.all()
    assert many.restarts.max() > 100
    alone = solver.fast()
    for row in range(len(points)):
        start = hand.home if prefer == "q0" else None
        q, _ = alone(points[row], normals[row], start)
        np.testing.assert_array_equal(q, many.q[row])
        one = solver.solve_batch(points[row : row + 1], normals[row : row + 1], prefer=prefer)
        for name in ("q", "status", "restarts", "iterations"):
            assert np.array_equal(getattr(one, name)[0], getattr(many, name)[row])
        for name, spent in many.phases.items():
            assert one.phases[name][0] == spent[row]


def test_so_many_rounds_and_no_more(rng):
    """Whatever makes them."""
    hand = ik.load_robot("kuka_lwr_barrett")
    points, normals = hand.contacts(hand.random(rng, 4))
    points += 0.02 * rng.normal(size=points.shape)
    problems = TargetBatch(points, normals, ik.Tolerance(), True)
    tried = HandFirstMethod(hand.description, HandFirstParameters())
    start = np.tile(hand.home, (4, 1))
    every = [(trace, rounds) for trace in (False, True) for rounds in (1, 3)]
    outcomes = [tried.run(problems, start, 0, *asked) for asked in every]
    few, more = outcomes[:2], outcomes[2:]
    for one, other in zip(few, more, strict=True):
        np.testing.assert_array_equal(one.q, other.q)
        np.testing.assert_array_equal(one.restarts, other.restarts)
        np.testing.assert_array_equal(one.status, other.status)
    assert few[0].restarts.max() < few[1].restarts.max() < 24
