"""The enhanced and original methods of Qiu & Kermani 2021, by step and as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import replace
from trace_checks import TraceRecorder

import casadi_ik as ik
from casadi_ik import model as robots
from casadi_ik.papers.qiu.fingers import finger_step_function, planar_finger

REACHING, ALIGNMENT = ik.solve.Phase.THUMB_REACHING, ik.solve.Phase.HAND_ALIGNMENT
SPREAD = 7
FLEXIONS = {"finger_2": (10, 11), "finger_3": (12, 13)}


@pytest.fixture(scope="module")
def closed(robot):
    return finger_step_function(robot.description, "closed-form")


@pytest.fixture(scope="module")
def ipopt(robot):
    return finger_step_function(robot.description, "ipopt")


def seen_from_palm(robot, q) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals of fingers 2 and 3 in the form of the finger step, (3, 2)."""
    points, normals = robot.contacts(q)
    palm = robot.palm(q)
    return (
        palm[:3, :3].T @ (points[1:] - palm[:3, 3]).T,
        palm[:3, :3].T @ normals[1:].T,
    )


def unit(x):
    return x / np.linalg.norm(x, axis=0)


def targets(robot, rng, count):
    """Return reachable, perturbed, and far unreachable demands alternately."""
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


def test_generating_contacts_are_recovered(robot, closed, rng):
    """The step finds the joints of a demand that a hand can meet exactly, from any posture."""
    hand = [SPREAD, *FLEXIONS["finger_2"], *FLEXIONS["finger_3"]]
    fixed_joints = [i for i in range(14) if i not in hand]
    sums = np.array(list(FLEXIONS.values()))
    # Beyond a flexion sum of 140 deg the pad faces back, and the normal implies another spread.
    fair = [q for q in robot.random(rng, 60) if q[sums].sum(axis=1).max() < np.radians(139)]
    assert len(fair) > 30
    for q in fair:
        q_before = robot.random(rng, 1)[0]
        after = call(closed, q_before, *seen_from_palm(robot, q))
        np.testing.assert_array_equal(after[fixed_joints], q_before[fixed_joints])
        np.testing.assert_allclose(after[hand], q[hand], atol=1e-6)


def test_closed_form_equals_ipopt(robot, closed, ipopt, rng):
    """On all sorts of targets eq. (5) has one answer to 1e-9."""
    for q, points, normals in targets(robot, rng, 60):
        np.testing.assert_allclose(
            call(ipopt, q, points, normals), call(closed, q, points, normals), atol=1e-9
        )


def test_far_side_of_the_circle_is_avoided_by_ipopt(own_robot, rng):
    """With wide limits both minima are inside, and the nearer one is returned."""
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
    """Return the distance of a finger from its point, which eq. (5) minimises [m]."""
    tips, _ = seen_from_palm(robot, q)
    column = list(FLEXIONS).index(name)
    return float(np.linalg.norm(tips[:, column] - points[:, column]))


def test_closed_form_is_the_best_on_a_grid(robot, closed, rng):
    """With fixed spread and flexion sum, no other flexion within limits comes closer."""
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
    """By eq. (4), attainable normals are met for any points."""
    for q in robot.random(rng, 20):
        q[[10, 12]] = rng.uniform(0.2, 1.5, 2)
        points, normals = seen_from_palm(robot, q)
        after = call(closed, q, points + rng.normal(scale=0.05, size=(3, 2)), normals)
        np.testing.assert_allclose(seen_from_palm(robot, after)[1], normals, atol=1e-9)


def test_nearest_attainable_normal(robot, closed):
    """A demand beyond the flexion limits is moved to the nearest limit."""
    q = robot.home
    for excess in (-0.1, -0.3, -0.6):
        normals = np.empty((3, 2))
        for column, name in enumerate(FLEXIONS):
            finger = planar_finger(robot.description, name)
            angle, spread = finger.normal_angle + excess, finger.ratio * q[SPREAD]
            across = np.sin(angle)
            local = [np.cos(spread) * across, np.sin(spread) * across, np.cos(angle)]
            normals[:, column] = finger.frame[:3, :3] @ local
        after = call(closed, q, seen_from_palm(robot, q)[0], normals)
        np.testing.assert_allclose(after[SPREAD], q[SPREAD], atol=1e-12)
        np.testing.assert_allclose(after[10:], 0.0, atol=1e-12)


def test_fingers_on_one_spread_motor_agree(robot, closed):
    """Mirrored demands of 20 and 50 deg give 35 deg; a polar normal has no weight."""
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
    axes_along = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    after = call(closed, q, points, axes_along)
    assert after[SPREAD] == pytest.approx(q[SPREAD], abs=1e-12), "nobody asks for a spread"
    mixed = demand(20, 20)
    mixed[:, 1] = [0, 0, 1]
    after = call(closed, q, points, mixed)
    assert np.degrees(after[SPREAD]) == pytest.approx(20, abs=1e-6)


def test_spread_keeps_motor_and_joints_within_limits(own_robot, rng):
    """The limits of the joint apply where they are narrower than those of the motor."""
    hand = own_robot.with_name("hand.yaml")
    text = hand.read_text()
    at = text.index("name: bh_finger_3_spread")
    narrow = text[at:].replace("[0 deg, 180 deg]", "[10 deg, 60 deg]", 1)
    hand.write_text(text[:at] + narrow)
    robot = ik.load_robot(own_robot)
    closed = finger_step_function(robot.description, "closed-form")
    spreads = []
    for q, points, normals in targets(robot, rng, 60):
        spreads.append(call(closed, q, points, normals)[SPREAD])
    assert min(spreads) == pytest.approx(np.radians(10))
    assert max(spreads) == pytest.approx(np.radians(60))


def test_unsupported_hands(own_robot, coupled_robot):
    with pytest.raises(ik.errors.UnsupportedError, match="'right'"):
        finger_step_function(coupled_robot.description, "closed-form")
    replace(
        own_robot.with_name("hand.yaml"),
        "  finger_2: {link: bh_finger_2_link_3, xyz: [50 mm, 9.5 mm, 0], normal: [0, 1, 0]",
        "  finger_2: {link: bh_finger_2_link_3, xyz: [50 mm, 9.5 mm, 0], normal: [0, 1, 1]",
    )
    with pytest.raises(ik.errors.UnsupportedError, match="'finger_2'"):
        finger_step_function(robots.load_description(own_robot), "ipopt")


PINCHES = np.array(
    [
        [0, 80, 8], [0, 75, 12], [0, 85, 10], [0, 70, 15], [10, 75, 15], [20, 80, 10],
        [5, 65, 20], [0, 60, 18], [15, 70, 10], [0, 90, 8], [25, 75, 12], [10, 85, 15],
    ]
)  # fmt: skip
"""Spread, proximal and distal flexion [deg] of pinches of the thumb against two fingers."""


def pinch_targets(robot, count, seed=0):
    """Return contacts of every pinch on `count` arm configurations, uniform within the limits."""
    q = robot.random(np.random.default_rng(seed), len(PINCHES) * count)
    hands = np.radians(np.repeat(PINCHES, count, axis=0))
    q[:, 7] = hands[:, 0]
    q[:, [8, 10, 12]] = hands[:, [1]]
    q[:, [9, 11, 13]] = hands[:, [2]]
    return robot.contacts(q)


def run(robot, points, normals, limits="ignore", q0=None, step="closed-form", **options):
    """Return batch and traces of a run from home."""
    recorder, options = TraceRecorder(), {"max_iterations": 600, **options}
    solver = ik.Solver(robot, "enhanced-dls", limits=limits, finger_step=step, options=options)
    batch = solver.solve_batch(points, normals, q0=q0, log=recorder)
    rows = np.concatenate([block.rows for block in recorder.blocks])
    return batch, np.split(rows, np.cumsum(batch.iterations)[:-1])


@pytest.fixture(scope="module")
def pinches(robot):
    """Targets, batch and traces of two arms for each pinch."""
    points, normals = pinch_targets(robot, 2)
    return points, normals, *run(robot, points, normals)


def of_phase(traces, phase):
    """Return the rows (k,) of all solves in a phase, and the numbers (k,) of their solves."""
    rows = [trace[trace["phase"] == phase] for trace in traces]
    numbers = np.repeat(np.arange(len(rows)), [len(trace_rows) for trace_rows in rows])
    assert len(numbers) > 100
    return np.concatenate(rows), numbers


def test_most_pinches_are_solved(robot):
    """12 pinches x 10 arms, limits ignored as in the paper: 95.9 % there, 90 to 96 % here."""
    solver = ik.Solver(robot, "enhanced-dls", limits="ignore", finger_step="closed-form")
    batch = solver.solve_batch(*pinch_targets(robot, 10))
    assert batch.success.mean() >= 0.85
    assert 40 < batch.iterations[batch.success].mean() < 300


@pytest.mark.slow
def test_influential_and_neutral_choices(robot):
    """Each variant changes one choice and has its effect."""
    points, normals = pinch_targets(robot, 4)

    def rate(**options):
        solver = ik.Solver(
            robot,
            "enhanced-dls",
            limits="ignore",
            finger_step="closed-form",
            options={"max_iterations": 2000, **options},
        )
        return solver.solve_batch(points, normals).success.mean()

    assert rate() > 0.85
    # lambda^2 = 150 instead of 150^2 costs about 20 points.
    assert rate(chain_damping=150**0.5) < rate()
    assert rate(palm_error="rotation-vector") > 0.8


def test_reaching_moves_arm_and_thumb_alone(robot, pinches):
    rows, _ = of_phase(pinches[3], REACHING)
    other_joints = [SPREAD, *FLEXIONS["finger_2"], *FLEXIONS["finger_3"]]
    assert (rows["q"][:, other_joints] == robot.home[other_joints]).all()
    assert (np.ptp(rows["q"][:, :7], axis=0) > 0.1).all()
    assert np.isnan(rows["sigma_closed_chain"]).all()
    assert np.isnan(rows["palm_motion"]).all()
    assert (rows["sigma_thumb"] > 0).all()
    assert (rows["sigma_palm"] > 0).all()


def test_reaching_ends_within_tolerance_without_another_step(robot):
    """With the arm in place only the finger step remains."""
    goal = robot.home.copy()
    goal[7:] = np.radians([0, 75, 15, 75, 15, 75, 15])  # no spread: the palm estimate is the palm
    q0 = goal.copy()
    q0[[10, 11, 12, 13]] = robot.home[[10, 11, 12, 13]]
    points, normals = robot.contacts(goal[None])
    batch, (trace,) = run(robot, points, normals, q0=q0)
    assert batch.success.all()
    assert trace["phase"].tolist() == [REACHING, ALIGNMENT]
    assert trace["palm_error"][0] < 1e-9
    np.testing.assert_array_equal(trace["q"][0], q0)
    np.testing.assert_allclose(trace["q"][1], goal, atol=1e-6)


def test_reaching_gives_up_after_a_while(robot):
    """A phase ends after 100 rows, or after ten without improvement."""
    points, normals = pinch_targets(robot, 1)
    _, traces = run(robot, points + 5.0, normals, max_iterations=150)
    counts = [np.sum(trace["phase"] == REACHING) for trace in traces]
    assert min(counts) >= 10
    assert max(counts) <= 100
    assert all(trace["phase"][-1] == ALIGNMENT for trace in traces)


def test_alignment_records_the_configuration_after_the_fingers(robot, closed, pinches):
    """The row has the result of the finger step."""
    points, normals, _, traces = pinches
    rows, numbers = of_phase(traces, ALIGNMENT)
    assert np.isnan(rows["palm_error"]).all()
    assert (rows["condition_closed_chain"] >= 1).all()
    assert (rows["palm_motion"] > 0).all()
    for q, number in list(zip(rows["q"], numbers, strict=True))[::50]:
        palm = robot.palm(q)
        local = palm[:3, :3].T @ (points[number, 1:] - palm[:3, 3]).T
        q_aligned = call(closed, q, local, palm[:3, :3].T @ normals[number, 1:].T)
        np.testing.assert_allclose(q, q_aligned, atol=1e-6)


def test_alignment_keeps_the_thumb(pinches):
    """A thumb off its contact is brought back at once, except in failed solves."""
    errors = [trace["position_error"][trace["phase"] == ALIGNMENT, 0] for trace in pinches[3]]
    improved = [
        row_errors[1] < 0.05 * row_errors[0] for row_errors in errors if len(row_errors) > 2
    ]
    assert len(improved) > 10
    assert np.mean(improved) > 0.9


def test_step_cap(robot):
    _, traces = run(robot, *pinch_targets(robot, 1), step_cap=0.01, max_iterations=50)
    rows, _ = of_phase(traces, REACHING)
    assert rows["step_size"].max() == pytest.approx(0.01, rel=1e-6)
    steps = np.abs(np.diff(traces[0]["q"][:5], axis=0))
    assert steps.max() == pytest.approx(0.01, rel=1e-6)


def test_ipopt_iterates_as_the_closed_form(robot):
    """The finger step of the paper takes the same path in one solve."""
    points, normals = (array[:1] for array in pinch_targets(robot, 1))
    (exact, (ours,)), (paper, (theirs,)) = (
        run(robot, points, normals, step=step) for step in ("closed-form", "ipopt")
    )
    assert exact.status[0] == paper.status[0] == ik.Status.SOLVED
    np.testing.assert_array_equal(exact.iterations, paper.iterations)
    np.testing.assert_allclose(ours["q"], theirs["q"], atol=1e-6)


def test_enforced_limits_hold_in_every_iteration(robot, pinches):
    batch, traces = run(robot, *pinches[:2], limits="enforce")
    q = np.concatenate([*(trace["q"] for trace in traces), batch.q])
    assert np.all(q >= robot.lower - 1e-12)
    assert np.all(q <= robot.upper + 1e-12)
    assert np.any(q == robot.upper) or np.any(q == robot.lower), "limits were never met"


def test_ignored_limits_are_overstepped_by_arm_and_thumb_only(robot, pinches):
    q = np.concatenate([trace["q"] for trace in pinches[3]])
    outside = np.any((q < robot.lower - 1e-3) | (q > robot.upper + 1e-3), axis=0)
    assert outside[:7].any()
    assert not outside[[7, 10, 11, 12, 13]].any(), "eq. (5) has the fingers' limits in it"


def test_a_start_beyond_enforced_limits_is_moved_to_them(robot):
    points, normals = (array[:1] for array in pinch_targets(robot, 1))
    q0 = robot.home.copy()
    q0[[1, 8]] = [robot.upper[1] + 1.0, -3.0]
    for limits, first in (("enforce", np.clip(q0, robot.lower, robot.upper)), ("ignore", q0)):
        _, (trace,) = run(robot, points, normals, limits=limits, q0=q0)
        np.testing.assert_array_equal(trace["q"][0], first)


def test_phases_end_at_the_first_solution(pinches):
    *_, batch, traces = pinches
    for solved, trace in zip(batch.success, traces, strict=True):
        assert set(trace["phase"]) <= {REACHING, ALIGNMENT}
        assert np.all(np.diff(trace["phase"].astype(int)) >= 0), "reaching is not returned to"
        if solved:
            rows_before = trace[:-1][trace["phase"][:-1] == ALIGNMENT]
            off = rows_before["position_error"].max(axis=1) > 5e-3
            assert (off | (rows_before["angle_error"].max(axis=1) > np.radians(3))).all()


def test_unsupported_robots_are_refused(coupled_robot):
    with pytest.raises(ik.errors.UnsupportedError, match=coupled_robot.name):
        ik.Solver(coupled_robot, "enhanced-dls")
