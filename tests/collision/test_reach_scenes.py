"""Maps with a scene or with contacts: compared with coal, and with the solver."""

import coal
import numpy as np
import pytest
from coal_oracle import described, distance
from collision_queries import query_at

import casadi_ik as ik

SIZE, CENTER = [0.2, 0.2, 0.6], [0.45, 0.1, 0.3]
POST = ik.Scene({"post": {"kind": "box", "size": SIZE, "xyz": CENTER}})
BOX = ([0.1, -0.4, 0.1], [0.7, 0.4, 0.7])


@pytest.fixture(scope="module")
def solver():
    return ik.Solver(ik.load_robot("ur5e"))


def test_witnesses_are_free_of_collision_and_no_free_pose_is_colliding(solver):
    robot = solver.robot
    plain = solver.reach_map(BOX, orientations=4, resolution=0.3)
    reach = solver.reach_map(BOX, orientations=4, resolution=0.3, scene=POST)
    is_reached = np.isin(reach.status, ["REACHABLE", "COLLIDING"])
    assert np.array_equal(plain.status == "REACHABLE", is_reached)
    assert np.array_equal(plain.status == "UNREACHABLE", reach.status == "UNREACHABLE")
    assert min(reach.counts["REACHABLE"], reach.counts["COLLIDING"]) > 10
    palms = np.array([reach.palms(i) for i in range(len(reach.positions))])
    is_free = reach.status == "REACHABLE"
    assert np.allclose(robot.palm(reach.q[is_free]), palms[is_free], rtol=0, atol=1e-10)
    pose = np.eye(4)
    pose[:3, 3] = CENTER
    links = robot.links(reach.q[is_free])
    for link, shape, at_link in described(robot):
        for place in links[link]:
            assert distance(shape, place @ at_link, coal.Box(*SIZE), pose) > -1e-6
    # Brute force: other starts do not lead to a collision-free configuration.
    starts = robot.random(np.random.default_rng(0), 10)
    colliding = palms[reach.status == "COLLIDING"][:20]
    batch = solver.solve_palms(
        np.repeat(colliding, len(starts), axis=0), robot.home, q0=np.tile(starts, (20, 1))
    )
    q = batch.q[batch.palm_position_error < 1e-6]
    assert len(q) > 100
    assert not query_at(ik.Solver(robot, scene=POST), q[0]).free(q).any()


def test_the_scene_of_the_solver_counts(solver):
    reach = solver.reach_map(BOX, orientations=2, resolution=0.6, scene=POST)
    at_post = ik.Solver(solver.robot, scene=POST)
    repeated = at_post.reach_map(BOX, orientations=2, resolution=0.6)
    assert np.array_equal(repeated.code, reach.code)


def test_object_poses_are_decided_like_targets_of_the_solver():
    solver = ik.Solver(ik.load_robot("kuka_lwr_barrett"))
    robot, cup = solver.robot, ik.load_grasp("cup")
    contacts = ik.Grasp(cup.contacts).at(np.linalg.inv(cup.object_pose))
    reach = solver.reach_map(
        ([-0.8, -0.8, 0], [0.8, 0.8, 0.8]), orientations=4, resolution=0.8, contacts=cup
    )
    assert reach.meaning == "contacts within tolerance"
    assert min(reach.counts["REACHABLE"], reach.counts["UNREACHABLE"]) > 5
    poses = np.concatenate([reach.palms(i) for i in range(len(reach.positions))])
    targets = [contacts.at(pose).arrays(robot.fingers) for pose in poses]
    points, normals = (np.array(arrays) for arrays in zip(*targets, strict=True))
    batch = solver.solve_batch(points, normals)
    status = reach.status.ravel()
    assert (status[batch.success] == "REACHABLE").all()
    for row in np.flatnonzero(status == "REACHABLE"):
        q = reach.q.reshape(len(poses), -1)[row]
        position, angle = robot.errors(q, points[row], normals[row])
        assert position.max() <= 5e-3
        assert angle.max() <= np.radians(3)
    with pytest.raises(ik.errors.UnsupportedError, match="check"):
        reach.check(solver)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"contacts": 3}, "contacts"),
        ({"contacts": ik.load_grasp("cup"), "meaning": "exact"}, "meaning"),
        ({"scene": "table"}, "scene"),
    ],
)
def test_bad_contacts_and_scenes_are_refused(arguments, name):
    solver = ik.Solver(ik.load_robot("kuka_lwr_barrett"))
    with pytest.raises(ik.errors.InputError, match=rf"^{name}: .*expected"):
        solver.reach_map(BOX, **arguments)
