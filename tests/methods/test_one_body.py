"""Hand-first on multi-arm robots: all hands, arms and the trunk as one problem."""

from pathlib import Path

import numpy as np
import pytest
from toy_robots import MULTI_ARM_ROBOTS, grasp_at, grasp_of, moved_targets

import casadi_ik as ik

pytestmark = pytest.mark.slow

ONE_HAND = (
    r"is for one arm with one hand, found 'g1\+dex3', a multi-arm robot \(left, right\); "
    r"use robot\.side\('left'\)$"
)
FINE = ik.Tolerance(position=1e-6, angle=1e-6)


@pytest.fixture(scope="module", params=MULTI_ARM_ROBOTS)
def robot(request):
    return ik.load_robot(request.param)


def targets(robot, count, is_near_home=False, seed=0):
    rng = np.random.default_rng(seed)
    part = rng.random((count, len(robot.lower)))
    if is_near_home:
        at_end = rng.random(part.shape) < 0.5
        part = np.where(at_end, np.where(part < 0.5, 0.02 * part, 1 - 0.02 * (1 - part)), part)
    q = robot.lower + part * (robot.upper - robot.lower)
    return q, *robot.contacts(q)


def grasp(robot, q, fingers=None):
    contacts = grasp_at(robot, q).contacts
    return ik.Grasp({name: contacts[name] for name in fingers or robot.fingers}, name="body")


def misses(robot, q, points):
    return np.linalg.norm(robot.contacts(q)[0] - points, axis=-1)


@pytest.mark.parametrize("is_near_home", [False, True])
def test_reachable_targets_are_solved(robot, is_near_home):
    _, points, normals = targets(robot, 300, is_near_home)
    for tolerance in (ik.Tolerance(), FINE):
        batch = ik.Solver(robot, tolerance=tolerance).solve_batch(points, normals)
        assert np.all(batch.status == ik.Status.SOLVED)
        # Verified by the robot's kinematics.
        assert misses(robot, batch.q, points).max() <= tolerance.position * 1.001
        assert np.all((batch.q >= robot.lower - 1e-9) & (batch.q <= robot.upper + 1e-9))


def test_a_log_has_singular_values_by_side(tmp_path: Path):
    robot, file = ik.load_robot("g1+dex3"), tmp_path / "body.mcap"
    _, points, normals = targets(robot, 2)
    ik.Solver(robot).solve_batch(points, normals, log=file)
    rows = ik.logs.open(file).iterations().array()
    q, step = rows["q"][-1], 1e-6
    for side in robot.description.sides:
        columns = []
        for motor in map(robot.actuators.index, side.arm):
            ends = [
                robot.palm(q + sign * step * np.eye(len(q))[motor], side.name) for sign in (1, -1)
            ]
            linear = (ends[0][:3, 3] - ends[1][:3, 3]) / (2 * step) / 0.1
            turn = (ends[0][:3, :3] - ends[1][:3, :3]) / (2 * step) @ ends[0][:3, :3].T
            columns.append([*linear, turn[2, 1], turn[0, 2], turn[1, 0]])
        sigma = np.linalg.svd(np.transpose(columns), compute_uv=False).min()
        assert rows[f"sigma_{side.name}_arm"][-1] == pytest.approx(sigma, rel=1e-3, abs=1e-4)
        assert (rows[f"sigma_{side.name}_hand"] > 0).all()


def test_a_hand_without_contacts_stays(robot):
    body = robot.description
    side, other_sides = body.sides[0], body.sides[1:]
    q = targets(robot, 1)[0][0]
    solution = ik.Solver(robot).solve(grasp(robot, q, side.fingers))
    assert solution.status == ik.Status.SOLVED
    for other_side in other_sides:
        motors = [body.actuator_index(motor) for motor in (*other_side.arm, *other_side.hand)]
        np.testing.assert_array_equal(solution.q[motors], robot.home[motors])


def test_nearby_solutions_are_preferred(robot):
    rng = np.random.default_rng(5)
    span = robot.upper - robot.lower
    q = robot.lower + (0.3 + 0.4 * rng.random(len(span))) * span
    start = np.clip(q + 0.01 * span * rng.standard_normal(len(q)), robot.lower, robot.upper)
    solver = ik.Solver(robot, tolerance=FINE)
    near_solution = solver.solve(grasp(robot, q), q0=start, prefer="q0")
    assert near_solution.status == ik.Status.SOLVED
    assert (np.abs(near_solution.q - start) / span).max() < 0.2


@pytest.mark.parametrize("name", ["two_pandas+allegro", "g1+dex3"])
def test_self_collision_free_solutions_are_found(name):
    """Fingers of a hand, the arms, and a hand and the torso may touch each other."""
    robot = ik.load_robot(name)
    solver, any_grasp, q_touching = ik.Solver(robot, scene=ik.Scene()), grasp(robot, robot.home), []
    for seed in range(30):
        samples = robot.random(np.random.default_rng(seed), 1000)
        q_touching += list(samples[solver.check(samples, any_grasp).distance > 1e-4])
        if len(q_touching) >= 20:
            break
    points, normals = robot.contacts(np.array(q_touching[:20]))
    batch = solver.solve_batch(points, normals)
    assert (batch.status == ik.Status.SOLVED).mean() >= 0.95
    solved = batch.success
    assert (solver.check(batch.q[solved], any_grasp).distance >= 0).all()
    assert misses(robot, batch.q, points)[solved].max() <= 5e-3 * 1.001
    # Few answers are free of collision without the search.
    first = ik.Solver(robot).solve_batch(points, normals).q
    assert (solver.check(first, any_grasp).distance < 0).mean() > 0.1


def test_self_touching_hands_move_within_tolerance():
    """Random postures mostly collide, but many of their contacts can be met without collision."""
    robot = ik.load_robot("g1+dex3")
    solver, any_grasp = ik.Solver(robot, scene=ik.Scene()), grasp(robot, robot.home)
    q = robot.random(np.random.default_rng(0), 40)
    points, normals = robot.contacts(q)
    batch = solver.solve_batch(points, normals)
    assert batch.success.sum() >= 8
    assert (solver.check(batch.q, any_grasp).distance >= 0)[batch.success].all()
    assert misses(robot, batch.q, points)[batch.success].max() <= 5e-3 * 1.001


def test_manipulability_is_the_minimum_over_arms(robot):
    q = targets(robot, 1)[0][0]
    solutions = ik.Solver(robot).solve_all(grasp(robot, q), limit=3, prefer="manipulability")
    scores = [solution.manipulability for solution in solutions]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] > 0
    for solution in solutions:
        arms = [robot.description.side_actuators[i][0] for i in range(len(robot.sides))]
        assert solution.manipulability == pytest.approx(
            min(
                measure(robot, solution.q, side, arm)
                for side, arm in zip(robot.sides, arms, strict=True)
            ),
            rel=1e-3,
        )


def measure(robot, q, side, arm):
    """Return Yoshikawa's manipulability of a side's arm, by differences of palms."""
    pose, step, columns = robot.palm(q, side), 1e-6, []
    for motor in arm:
        pose_after = robot.palm(np.where(np.arange(len(q)) == motor, q + step, q), side)
        rotation_rate = (pose_after[:3, :3] - pose[:3, :3]) @ pose[:3, :3].T / step
        turn = [rotation_rate[2, 1], rotation_rate[0, 2], rotation_rate[1, 0]]
        columns.append([*((pose_after[:3, 3] - pose[:3, 3]) / step), *turn])
    return np.prod(np.linalg.svd(np.array(columns), compute_uv=False)[:6])


def test_motors_can_be_fixed(robot):
    q = targets(robot, 1, seed=3)[0][0]
    names = [*robot.description.trunk, robot.description.sides[0].hand[0]]
    fixed = {name: float(q[robot.description.actuator_index(name)]) for name in names}
    solution = ik.Solver(robot).solve(grasp(robot, q), fixed=fixed)
    assert solution.status == ik.Status.SOLVED
    for name, value in fixed.items():
        assert solution.q[robot.description.actuator_index(name)] == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("name", ["g1+dex3", "h1_2+inspire"])
def test_barely_unreachable_targets_end_early(name):
    robot = ik.load_robot(name)
    side = [robot.fingers.index(finger) for finger in robot.description.sides[0].fingers]
    _, points, normals = targets(robot, 4)
    solver, out = ik.Solver(robot), points[:, side].mean(axis=1)
    out /= np.linalg.norm(out, axis=1)[:, None]
    while (batch := solver.solve_batch(points, normals)).success.any():
        points[np.ix_(batch.success, side)] += 0.05 * out[batch.success, None]
    # Each trunk takes about 30 iterations; before, all together took 300,000.
    assert np.median(batch.iterations) < 150_000


def test_distant_targets_end_immediately(robot):
    """Distant targets end at once also with free palms, and for one arm on a trunk."""
    _, points, normals = targets(robot, 4)
    batch = ik.Solver(robot).solve_batch(points + np.array([3.0, 0.0, 0.0]), normals)
    # Before, all trunks and restarts of two Pandas took 158,000 iterations.
    assert batch.iterations.max() < 120_000


def test_unreachable_targets_are_diagnosed(robot):
    q = targets(robot, 1)[0][0]
    far_contacts = {
        finger: ik.Contact(np.asarray(contact.point) + 5.0, contact.normal)
        for finger, contact in grasp(robot, q).contacts.items()
    }
    solution = ik.Solver(robot).solve(ik.Grasp(name="far", contacts=far_contacts))
    assert solution.status != ik.Status.SOLVED
    assert solution.diagnosis is not None
    assert set(solution.diagnosis.sides) == set(robot.sides)
    assert not any(worst.ok for worst in solution.diagnosis.sides.values())


def test_unreachable_side_is_named():
    robot = ik.load_robot("g1+dex3")
    contacts = grasp(robot, robot.home).contacts
    far_contacts = {
        finger: ik.Contact(np.add(contact.point, [0, 2.0, 0]), contact.normal)
        for finger, contact in contacts.items()
        if finger.startswith("left")
    }
    solution = ik.Solver(robot).solve(ik.Grasp(name="far", contacts={**contacts, **far_contacts}))
    assert solution.status == ik.Status.UNREACHABLE
    sides = solution.diagnosis.sides
    assert sides["right"].ok
    assert sides["left"].position_error > 1.0
    assert any(line.startswith("left ") for line in solution.diagnosis.lines)


@pytest.mark.parametrize("name", ["g1+dex3", "mobile_kuka_lwr_barrett"])
def test_targets_are_solved_without_a_compiler(name, tmp_path):
    robot, tolerance = ik.load_robot(name), ik.Tolerance()
    rng = np.random.default_rng(1005)
    contacts = robot.contacts(robot.random(rng, 8))
    moved = moved_targets(contacts, rng, 0.8 * tolerance.position, 0.8 * tolerance.angle)
    solver, log = ik.Solver(robot, compiled=False), tmp_path / "log.mcap"
    batch = solver.solve_batch(*moved, log=log)
    assert np.all(batch.status == ik.Status.SOLVED)
    assert len(ik.logs.open(log).iterations().array()) == batch.iterations.sum()
    q = batch.q[0]
    fixed = {motor: float(q[robot.description.actuator_index(motor)]) for motor in robot.trunk}
    solution = solver.solve(grasp(robot, q), q0=q, prefer="q0", fixed=fixed)
    assert solution.success
    for motor, value in fixed.items():
        index = robot.description.actuator_index(motor)
        assert solution.q[index] == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("method", sorted({*ik.METHODS} - {"hand-first", "ipopt"}))
def test_paper_methods_name_their_requirements(method):
    with pytest.raises(ik.errors.UnsupportedError, match=f"^{method} {ONE_HAND}"):
        ik.Solver(ik.load_robot("g1+dex3"), method)


def palm_grasp(robot, q, sides):
    motors_of_side = {side.name: side.hand for side in robot.description.sides}
    return ik.Grasp(
        palm={side: robot.palm(q, side) for side in sides},
        posture={
            name: q[robot.actuators.index(name)] for side in sides for name in motors_of_side[side]
        },
    )


def test_palms_are_given_by_side(robot):
    q = robot.random(np.random.default_rng(5), 1)[0]
    sides = [side.name for side in robot.description.sides]
    solution = ik.Solver(robot).solve(palm_grasp(robot, q, sides))
    assert solution.success
    for side in sides:
        off = robot.palm(solution.q, side)[:3] - robot.palm(q, side)[:3]
        assert np.abs(off[:, 3]).max() < 6e-3
        assert np.abs(off[:, :3]).max() < 0.3
    hands = [robot.actuators.index(m) for side in robot.description.sides for m in side.hand]
    assert np.allclose(solution.q[hands], q[hands])
    if len(sides) == 1:
        palm_only = ik.Grasp(palm=robot.palm(q), posture=palm_grasp(robot, q, sides).posture)
        np.testing.assert_array_equal(ik.Solver(robot).solve(palm_only).q, solution.q)


def test_single_palm_leaves_the_other_arm():
    robot = ik.load_robot("g1+dex3")
    q = robot.home + 0.02
    solution = ik.Solver(robot).solve(palm_grasp(robot, q, ["left"]), q0=robot.home)
    assert solution.success
    right = [i for i, name in enumerate(robot.actuators) if "right" in name]
    assert np.allclose(solution.q[right], robot.home[right])


def test_inconsistent_palms_are_refused():
    robot = ik.load_robot("g1+dex3")
    solver, palm_of_left = ik.Solver(robot), palm_grasp(robot, robot.home, ["left"])
    with pytest.raises(ik.errors.InputError, match=r"palm\.middle:.*side.*left"):
        solver.solve(ik.Grasp(palm={"middle": np.eye(4)}, posture=palm_of_left.posture))
    with pytest.raises(
        ik.errors.InputError,
        match=r"one pose, expected one by side \(palms in a file\): left, right",
    ):
        solver.solve(ik.Grasp(palm=np.eye(4), posture=palm_of_left.posture))
    with pytest.raises(ik.errors.InputError, match=r"posture\..*: "):
        solver.solve(
            ik.Grasp(
                palm=palm_of_left.palm, posture={**palm_of_left.posture, "waist_yaw_joint": 0.0}
            )
        )
    with pytest.raises(ik.errors.InputError, match=r"palm\.left: .*3.*8"):
        ik.Grasp(palm={"left": 2 * np.eye(4)}, posture=palm_of_left.posture)
    with pytest.raises(ik.errors.InputError, match=r"side:.*None"):
        robot.palm(robot.home)


def held_box(robot):
    """Return an object that a multi-arm robot holds at home, in the frame of its contacts."""
    points, normals = robot.contacts(robot.home)
    middle = points.mean(axis=0)
    return grasp_of(robot, points - middle, normals), middle


def test_free_object_is_placed_within_reach_of_both_hands():
    robot = ik.load_robot("g1+dex3")
    box, middle = held_box(robot)
    low, high = middle - np.array([0.3, 0.3, 0.3]), middle + np.array([0.4, 0.2, 0.3])
    within = ik.Free([*low, 0.0, 0.0, -2.0], [*high, 0.0, 0.0, 2.0])
    free = ik.Grasp(box.contacts, object_pose=within)
    solution = ik.Solver(robot).solve(free)
    assert solution.success
    pose = solution.object_pose
    assert np.all(pose[:3, 3] >= low)
    assert np.all(pose[:3, 3] <= high)
    points, _ = box.at(pose).arrays(robot.fingers)
    assert misses(robot, solution.q, points).max() <= 5e-3


def test_unreachable_object_is_diagnosed():
    robot = ik.load_robot("g1+dex3")
    box, _ = held_box(robot)
    far_pose = ik.Free([3, 0, 0, 0, 0, 0], [4, 1, 1, 0, 0, 1])
    solution = ik.Solver(robot).solve(ik.Grasp(box.contacts, object_pose=far_pose))
    assert solution.status is ik.Status.UNREACHABLE
    assert np.allclose(solution.object_pose[:3, 3], [3.5, 0.5, 0.5])


def test_impossible_object_bounds_are_refused():
    robot = ik.load_robot("g1+dex3")
    box, _ = held_box(robot)
    with pytest.raises(ik.errors.InputError, match=r"lower: .*\[0\.0, 0\.0, 0\.0\]"):
        ik.Free([0, 0, 0], [1, 1, 1])
    with pytest.raises(ik.errors.InputError, match="expected none above"):
        ik.Free([1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0])
    free = ik.Grasp(box.contacts, object_pose=ik.Free([0] * 6, [0] * 6))
    with pytest.raises(ik.errors.InputError, match=r"object_pose:.*Free"):
        ik.Solver(robot).choose([free])
    with pytest.raises(ik.errors.InputError, match=r"log: .* Free"):
        ik.Solver(robot).solve(free, log="nothing.mcap")


def near_home(robot):
    q = robot.home.copy()
    for name, by in (("waist_yaw_joint", 0.4), ("left_elbow_joint", -0.3)):
        q[robot.actuators.index(name)] += by
    return q


@pytest.mark.parametrize("sides", [("left", "right"), ("left",)])
def test_hands_approach_and_lift_together(sides):
    pytest.importorskip("toppra")
    robot = ik.load_robot("g1+dex3")
    fingers = [name for name in robot.fingers if name.startswith(sides)]
    grasp_near_home = grasp(robot, near_home(robot), fingers)
    motion = ik.Solver(robot).reach(grasp_near_home, opening=0.01, distance=0.05, lift=0.1)
    assert motion.success
    q, parts = motion.motion.q, motion.motion.notes["part"]
    rows = [robot.fingers.index(name) for name in fingers]
    tips = robot.contacts(q)[0]
    points = np.array([grasp_near_home.contacts[name].point for name in fingers])
    assert np.allclose(tips[-1][rows], points + np.array([0, 0, 0.1]), atol=2e-3)
    # While it is lifted, the object keeps its place in both hands.
    lifted_tips = tips[parts == "lifting"][:, rows]
    assert np.abs(lifted_tips - lifted_tips[:, :1] - (points - points[0])).max() < 2e-3
    came = tips[parts == "coming"][0][rows] - points
    assert np.linalg.norm(came, axis=1).min() > 0.04


def test_a_body_is_drawn(tmp_path):
    robot = ik.load_robot("g1+dex3")
    grasp_at_home = grasp(robot, robot.home)
    answer = ik.Solver(robot).solve(grasp_at_home)
    answer.draw(grasp_at_home, tmp_path / "g1.png")
    assert (tmp_path / "g1.png").stat().st_size > 20_000


@pytest.mark.parametrize("call", ["solve_palms", "grasps_of", "place"])
def test_single_hand_calls_refuse_bodies(call):
    solver = ik.Solver(ik.load_robot("g1+dex3"))
    q, pose = solver.robot.home, np.eye(4)
    calls = {
        "solve_palms": lambda: solver.solve_palms(pose[None], q),
        "grasps_of": lambda: solver.grasps_of(ik.load_surface("tennis_ball"), pose),
    }
    if call == "place":
        contacts = grasp_at(solver.robot, q).contacts
        choice = solver.choose([ik.Grasp(contacts, object_pose=pose)])[0]
        calls[call] = lambda: solver.place(choice, pose, q)
    with pytest.raises(ik.errors.UnsupportedError, match=f"^{call} {ONE_HAND}"):
        calls[call]()


def test_side_alone_is_an_arm_hand():
    body = ik.load_robot("mobile_kuka_lwr_barrett")
    (name,) = body.sides
    side = body.side(name)
    assert side.sides == ()
    assert set(body.trunk) < set(side.actuators)
    q = body.random(np.random.default_rng(2), 20)
    q_side = q[:, [body.actuators.index(motor) for motor in side.actuators]]
    np.testing.assert_allclose(side.palm(q_side), body.palm(q, name), atol=1e-12)
    np.testing.assert_allclose(side.contacts(q_side)[0], body.contacts(q)[0], atol=1e-12)
    batch = ik.Solver(side).solve_palms(side.palm(q_side), q_side)
    assert batch.success.all()
    with pytest.raises(ik.errors.UnknownNameError, match=r"'middle'.*sides: "):
        body.side("middle")


def test_solving_a_side_leaves_the_others():
    body = ik.load_robot("g1+dex3")
    assert body.sides == ("left", "right")
    left = body.side("left")
    assert left.fingers == body.fingers[:3]
    assert not [name for name in (*left.actuators, *left.description.links) if "right" in name]
    np.testing.assert_allclose(left.palm(left.home), body.palm(body.home, "left"), atol=1e-12)
