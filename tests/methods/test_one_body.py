"""Hand first on bodies: all hands, arms and the trunk as one problem."""

from pathlib import Path

import numpy as np
import pytest
from toy_robots import grasp_at, grasp_of

import casadi_ik as ik

pytestmark = pytest.mark.slow

BODIES = ("g1+dex3", "two_pandas+allegro", "two_ur10e+leap", "mobile_kuka_lwr_barrett")
ONE_HAND = (
    r"is for one arm with one hand, found 'g1\+dex3', a multi-arm robot \(left, right\); "
    r"use robot\.side\('left'\)$"
)
FINE = ik.Tolerance(position=1e-6, angle=1e-6)


@pytest.fixture(scope="module", params=BODIES)
def robot(request):
    return ik.load_robot(request.param)


def targets(robot, count, near=False, seed=0):
    rng = np.random.default_rng(seed)
    part = rng.random((count, len(robot.lower)))
    if near:
        at_end = rng.random(part.shape) < 0.5
        part = np.where(at_end, np.where(part < 0.5, 0.02 * part, 1 - 0.02 * (1 - part)), part)
    q = robot.lower + part * (robot.upper - robot.lower)
    return q, *robot.contacts(q)


def grasp(robot, q, fingers=None):
    contacts = grasp_at(robot, q).contacts
    return ik.Grasp({name: contacts[name] for name in fingers or robot.fingers}, name="body")


def misses(robot, q, points):
    return np.linalg.norm(robot.contacts(q)[0] - points, axis=-1)


@pytest.mark.parametrize("near", [False, True])
def test_what_is_reachable_is_solved(robot, near):
    _, points, normals = targets(robot, 300, near)
    for tolerance in (ik.Tolerance(), FINE):
        found = ik.Solver(robot, tolerance=tolerance).solve_batch(points, normals)
        assert np.all(found.status == ik.Status.SOLVED)
        # By the robot itself, whatever the solver says.
        assert misses(robot, found.q, points).max() <= tolerance.position * 1.001
        assert np.all((found.q >= robot.lower - 1e-9) & (found.q <= robot.upper + 1e-9))


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
    side, others = body.sides[0], body.sides[1:]
    q = targets(robot, 1)[0][0]
    found = ik.Solver(robot).solve(grasp(robot, q, side.fingers))
    assert found.status == ik.Status.SOLVED
    for other in others:
        rest = [body.actuator_index(motor) for motor in (*other.arm, *other.hand)]
        np.testing.assert_array_equal(found.q[rest], robot.home[rest])


def test_what_is_near_is_preferred(robot):
    rng = np.random.default_rng(5)
    span = robot.upper - robot.lower
    q = robot.lower + (0.3 + 0.4 * rng.random(len(span))) * span
    start = np.clip(q + 0.01 * span * rng.standard_normal(len(q)), robot.lower, robot.upper)
    solver = ik.Solver(robot, tolerance=FINE)
    near = solver.solve(grasp(robot, q), q0=start, prefer="q0")
    assert near.status == ik.Status.SOLVED
    assert (np.abs(near.q - start) / span).max() < 0.2


@pytest.mark.parametrize("name", ["two_pandas+allegro", "g1+dex3"])
def test_what_touches_nothing_is_found(name):
    """Fingers of a hand touch each other, arms each other, and a hand the body."""
    robot = ik.load_robot(name)
    solver, about, kept = ik.Solver(robot, scene=ik.Scene()), grasp(robot, robot.home), []
    for seed in range(30):
        some = robot.random(np.random.default_rng(seed), 1000)
        kept += list(some[solver.check(some, about).distance > 1e-4])
        if len(kept) >= 20:
            break
    points, normals = robot.contacts(np.array(kept[:20]))
    found = solver.solve_batch(points, normals)
    assert (found.status == ik.Status.SOLVED).mean() >= 0.95
    solved = found.success
    assert (solver.check(found.q[solved], about).distance >= 0).all()
    assert misses(robot, found.q, points)[solved].max() <= 5e-3 * 1.001
    # Few of them come by themselves.
    first = ik.Solver(robot).solve_batch(points, normals).q
    assert (solver.check(first, about).distance < 0).mean() > 0.1


def test_hands_that_touch_themselves_are_moved_within_tolerances():
    """Of contacts of random postures, most of which touch something, many can be met freely."""
    robot = ik.load_robot("g1+dex3")
    solver, about = ik.Solver(robot, scene=ik.Scene()), grasp(robot, robot.home)
    q = robot.random(np.random.default_rng(0), 40)
    points, normals = robot.contacts(q)
    found = solver.solve_batch(points, normals)
    assert found.success.sum() >= 8
    assert (solver.check(found.q, about).distance >= 0)[found.success].all()
    assert misses(robot, found.q, points)[found.success].max() <= 5e-3 * 1.001


def test_manipulability_is_that_of_the_worst_arm(robot):
    q = targets(robot, 1)[0][0]
    found = ik.Solver(robot).solve_all(grasp(robot, q), limit=3, prefer="manipulability")
    scores = [one.manipulability for one in found]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] > 0
    for one in found:
        arms = [robot.description.side_actuators[i][0] for i in range(len(robot.sides))]
        assert one.manipulability == pytest.approx(
            min(
                measure(robot, one.q, side, arm)
                for side, arm in zip(robot.sides, arms, strict=True)
            ),
            rel=1e-3,
        )


def measure(robot, q, side, arm):
    """Yoshikawa's measure of a side's arm, its Jacobian by differences of palms."""
    here, step, columns = robot.palm(q, side), 1e-6, []
    for motor in arm:
        there = robot.palm(np.where(np.arange(len(q)) == motor, q + step, q), side)
        turned = (there[:3, :3] - here[:3, :3]) @ here[:3, :3].T / step
        turn = [turned[2, 1], turned[0, 2], turned[1, 0]]
        columns.append([*((there[:3, 3] - here[:3, 3]) / step), *turn])
    return np.prod(np.linalg.svd(np.array(columns), compute_uv=False)[:6])


def test_motors_are_held(robot):
    q = targets(robot, 1, seed=3)[0][0]
    names = [*robot.description.trunk, robot.description.sides[0].hand[0]]
    fixed = {name: float(q[robot.description.actuator_index(name)]) for name in names}
    found = ik.Solver(robot).solve(grasp(robot, q), fixed=fixed)
    assert found.status == ik.Status.SOLVED
    for name, value in fixed.items():
        assert found.q[robot.description.actuator_index(name)] == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("name", ["g1+dex3", "h1_2+inspire"])
def test_what_is_just_out_of_reach_is_given_up_soon(name):
    robot = ik.load_robot(name)
    side = [robot.fingers.index(finger) for finger in robot.description.sides[0].fingers]
    _, points, normals = targets(robot, 4)
    solver, out = ik.Solver(robot), points[:, side].mean(axis=1)
    out /= np.linalg.norm(out, axis=1)[:, None]
    while (found := solver.solve_batch(points, normals)).success.any():
        points[np.ix_(found.success, side)] += 0.05 * out[found.success, None]
    # Each trunk takes about 30; before 300,000 was the rule.
    assert np.median(found.iterations) < 150_000


def test_what_is_far_away_is_given_up_at_once(robot):
    """Also where contacts leave palms a freedom, and of one arm on a trunk."""
    _, points, normals = targets(robot, 4)
    found = ik.Solver(robot).solve_batch(points + np.array([3.0, 0.0, 0.0]), normals)
    # All trunks and rounds took two Pandas 158,000 before.
    assert found.iterations.max() < 120_000


def test_what_is_out_of_reach_is_told(robot):
    q = targets(robot, 1)[0][0]
    far = {
        finger: ik.Contact(np.asarray(contact.point) + 5.0, contact.normal)
        for finger, contact in grasp(robot, q).contacts.items()
    }
    found = ik.Solver(robot).solve(ik.Grasp(name="far", contacts=far))
    assert found.status != ik.Status.SOLVED
    assert found.diagnosis is not None
    assert set(found.diagnosis.sides) == set(robot.sides)
    assert not any(worst.ok for worst in found.diagnosis.sides.values())


def test_the_side_that_cannot_is_named():
    robot = ik.load_robot("g1+dex3")
    asked = grasp(robot, robot.home).contacts
    far = {
        finger: ik.Contact(np.add(contact.point, [0, 2.0, 0]), contact.normal)
        for finger, contact in asked.items()
        if finger.startswith("left")
    }
    found = ik.Solver(robot).solve(ik.Grasp(name="far", contacts={**asked, **far}))
    assert found.status == ik.Status.UNREACHABLE
    sides = found.diagnosis.sides
    assert sides["right"].ok
    assert sides["left"].position_error > 1.0
    assert any(line.startswith("left by itself: ") for line in found.diagnosis.lines)


def test_without_a_compiler_there_is_an_answer():
    robot = ik.load_robot("mobile_kuka_lwr_barrett")
    q = robot.lower + 0.4 * (robot.upper - robot.lower)
    found = ik.Solver(robot, compiled=False).solve(grasp(robot, q), q0=q + 0.02)
    assert found.status == ik.Status.SOLVED


@pytest.mark.parametrize("method", sorted({*ik.METHODS} - {"hand-first", "ipopt"}))
def test_the_papers_methods_say_what_they_need(method):
    with pytest.raises(ik.errors.UnsupportedError, match=f"^{method} {ONE_HAND}"):
        ik.Solver(ik.load_robot("g1+dex3"), method)


def palm_grasp(robot, q, sides):
    own = {side.name: side.hand for side in robot.description.sides}
    return ik.Grasp(
        palm={side: robot.palm(q, side) for side in sides},
        posture={name: q[robot.actuators.index(name)] for side in sides for name in own[side]},
    )


def test_palms_are_given_by_side(robot):
    q = robot.random(np.random.default_rng(5), 1)[0]
    sides = [side.name for side in robot.description.sides]
    found = ik.Solver(robot).solve(palm_grasp(robot, q, sides))
    assert found.success
    for side in sides:
        off = robot.palm(found.q, side)[:3] - robot.palm(q, side)[:3]
        assert np.abs(off[:, 3]).max() < 6e-3
        assert np.abs(off[:, :3]).max() < 0.3
    hands = [robot.actuators.index(m) for side in robot.description.sides for m in side.hand]
    assert np.allclose(found.q[hands], q[hands])
    if len(sides) == 1:
        alone = ik.Grasp(palm=robot.palm(q), posture=palm_grasp(robot, q, sides).posture)
        np.testing.assert_array_equal(ik.Solver(robot).solve(alone).q, found.q)


def test_one_palm_alone_leaves_the_other_arm():
    robot = ik.load_robot("g1+dex3")
    q = robot.home + 0.02
    found = ik.Solver(robot).solve(palm_grasp(robot, q, ["left"]), q0=robot.home)
    assert found.success
    right = [i for i, name in enumerate(robot.actuators) if "right" in name]
    assert np.allclose(found.q[right], robot.home[right])


def test_palms_that_cannot_be_are_refused():
    robot = ik.load_robot("g1+dex3")
    solver, one = ik.Solver(robot), palm_grasp(robot, robot.home, ["left"])
    with pytest.raises(ik.errors.InputError, match=r"palm\.middle:.*side.*left"):
        solver.solve(ik.Grasp(palm={"middle": np.eye(4)}, posture=one.posture))
    with pytest.raises(
        ik.errors.InputError,
        match=r"one pose, expected one by side \(palms in a file\): left, right",
    ):
        solver.solve(ik.Grasp(palm=np.eye(4), posture=one.posture))
    with pytest.raises(ik.errors.InputError, match=r"posture\..*: "):
        solver.solve(ik.Grasp(palm=one.palm, posture={**one.posture, "waist_yaw_joint": 0.0}))
    with pytest.raises(ik.errors.InputError, match=r"palm\.left: .*3.*8"):
        ik.Grasp(palm={"left": 2 * np.eye(4)}, posture=one.posture)
    with pytest.raises(ik.errors.InputError, match=r"side:.*None"):
        robot.palm(robot.home)


def held_box(robot):
    """What a body holds at home, in the frame of the contacts' middle."""
    points, normals = robot.contacts(robot.home)
    middle = points.mean(axis=0)
    return grasp_of(robot, points - middle, normals), middle


def test_an_object_is_found_where_both_hands_reach_it():
    robot = ik.load_robot("g1+dex3")
    box, middle = held_box(robot)
    low, high = middle - np.array([0.3, 0.3, 0.3]), middle + np.array([0.4, 0.2, 0.3])
    within = ik.Free([*low, 0.0, 0.0, -2.0], [*high, 0.0, 0.0, 2.0])
    free = ik.Grasp(box.contacts, object_pose=within)
    found = ik.Solver(robot).solve(free)
    assert found.success
    pose = found.object_pose
    assert np.all(pose[:3, 3] >= low)
    assert np.all(pose[:3, 3] <= high)
    points, _ = box.at(pose).arrays(robot.fingers)
    assert misses(robot, found.q, points).max() <= 5e-3


def test_an_object_that_nobody_reaches_is_told():
    robot = ik.load_robot("g1+dex3")
    box, _ = held_box(robot)
    far = ik.Free([3, 0, 0, 0, 0, 0], [4, 1, 1, 0, 0, 1])
    found = ik.Solver(robot).solve(ik.Grasp(box.contacts, object_pose=far))
    assert found.status is ik.Status.UNREACHABLE
    assert np.allclose(found.object_pose[:3, 3], [3.5, 0.5, 0.5])


def test_bounds_of_an_object_that_cannot_be_are_refused():
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
def test_hands_come_close_and_lift_together(sides):
    pytest.importorskip("toppra")
    robot = ik.load_robot("g1+dex3")
    fingers = [name for name in robot.fingers if name.startswith(sides)]
    asked = grasp(robot, near_home(robot), fingers)
    found = ik.Solver(robot).reach(asked, opening=0.01, distance=0.05, lift=0.1)
    assert found.success
    q, parts = found.motion.q, found.motion.notes["part"]
    rows = [robot.fingers.index(name) for name in fingers]
    tips = robot.contacts(q)[0]
    there = np.array([asked.contacts[name].point for name in fingers])
    assert np.allclose(tips[-1][rows], there + np.array([0, 0, 0.1]), atol=2e-3)
    # What both hold keeps its place in both hands while it is lifted.
    held = tips[parts == "lifting"][:, rows]
    assert np.abs(held - held[:, :1] - (there - there[0])).max() < 2e-3
    came = tips[parts == "coming"][0][rows] - there
    assert np.linalg.norm(came, axis=1).min() > 0.04


def test_a_body_is_drawn(tmp_path):
    robot = ik.load_robot("g1+dex3")
    asked = grasp(robot, robot.home)
    answer = ik.Solver(robot).solve(asked)
    answer.draw(asked, tmp_path / "g1.png")
    assert (tmp_path / "g1.png").stat().st_size > 20_000


@pytest.mark.parametrize("what", ["solve_palms", "grasps_of", "place"])
def test_what_needs_one_hand_says_so(what):
    solver = ik.Solver(ik.load_robot("g1+dex3"))
    q, pose = solver.robot.home, np.eye(4)
    calls = {
        "solve_palms": lambda: solver.solve_palms(pose[None], q),
        "grasps_of": lambda: solver.grasps_of(ik.load_surface("tennis_ball"), pose),
    }
    if what == "place":
        contacts = grasp_at(solver.robot, q).contacts
        held = solver.choose([ik.Grasp(contacts, object_pose=pose)])[0]
        calls[what] = lambda: solver.place(held, pose, q)
    with pytest.raises(ik.errors.UnsupportedError, match=f"^{what} {ONE_HAND}"):
        calls[what]()


def test_a_side_by_itself_is_an_arm_hand():
    body = ik.load_robot("mobile_kuka_lwr_barrett")
    (name,) = body.sides
    side = body.side(name)
    assert side.sides == ()
    assert set(body.trunk) < set(side.actuators)
    q = body.random(np.random.default_rng(2), 20)
    own = q[:, [body.actuators.index(motor) for motor in side.actuators]]
    np.testing.assert_allclose(side.palm(own), body.palm(q, name), atol=1e-12)
    np.testing.assert_allclose(side.contacts(own)[0], body.contacts(q)[0], atol=1e-12)
    found = ik.Solver(side).solve_palms(side.palm(own), own)
    assert found.success.all()
    with pytest.raises(ik.errors.UnknownNameError, match=r"'middle'.*sides: "):
        body.side("middle")


def test_a_side_leaves_the_others_out():
    body = ik.load_robot("g1+dex3")
    assert body.sides == ("left", "right")
    left = body.side("left")
    assert left.fingers == body.fingers[:3]
    assert not [name for name in (*left.actuators, *left.description.links) if "right" in name]
    np.testing.assert_allclose(left.palm(left.home), body.palm(body.home, "left"), atol=1e-12)
