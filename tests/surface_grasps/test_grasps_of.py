"""Grasps of surfaces, confirmed by the public solver and exact distances."""

import numpy as np
import pytest
import trimesh
from touch_cases import PLACE, solver_of, surface_of

import casadi_ik as ik
from casadi_ik import errors


def test_every_grasp_is_confirmed_in_the_scene(grasps_found):
    solver, grasps = grasps_found
    assert len(grasps) == 12
    for grasp in grasps:
        assert solver.solve(grasp.grasp, q0=grasp.q).success
        assert grasp.clearance >= 0
        assert list(grasps.counts.values()) == sorted(grasps.counts.values(), reverse=True)


def test_neighbouring_obstacles_are_avoided(surface):
    """Scene of a wall, a post and a cloud of points close by, with their exact distances."""
    cloud = np.stack(np.meshgrid([0.47, 0.5, 0.53], [0.02], [0.03, 0.06, 0.09]), -1).reshape(-1, 3)
    scene = ik.Scene(
        {
            "wall": {"kind": "box", "size": [0.02, 0.4, 0.3], "xyz": [0.59, 0.1, 0.15]},
            "post": {"kind": "cylinder", "radius": 0.01, "length": 0.2, "xyz": [0.44, 0.16, 0.1]},
            "floor": {"kind": "half-space"},
            "points": {"kind": "point-cloud", "points": cloud, "radius": 0.01},
        }
    )
    solver = ik.Solver(ik.load_robot("panda+allegro_right"), scene=scene)
    grasps_found = solver.grasps_of(surface, PLACE, limit=10, among=10)
    assert len(grasps_found) == 10
    for grasp in grasps_found:
        assert solver.solve(grasp.grasp, q0=grasp.q).success
        assert grasp.clearance is not None
        assert grasp.clearance >= 0


def test_fingertips_touch_the_mesh(grasps_found):
    """The distances of pads, balls or points to the exact cylinder are those claimed."""
    solver, grasps = grasps_found
    inverse = np.linalg.inv(PLACE)
    for grasp in grasps:
        frames = solver.robot.contact_frames(grasp.q)
        for name, contact in grasp.grasp.contacts.items():
            finger = solver.robot.description.finger(name)
            tip = frames[solver.robot.fingers.index(name)]
            middle = tip[:3, 3] - finger.radius * tip[:3, 0]
            local = inverse[:3, :3] @ middle + inverse[:3, 3]
            off = np.array([np.linalg.norm(local[:2]) - 0.033, abs(local[2]) - 0.05])
            distance = np.linalg.norm(np.maximum(off, 0)) + min(off.max(), 0)
            assert distance == pytest.approx(finger.radius, abs=1.1e-3)
            lid = off[1] > off[0]
            face = [0, 0, np.sign(local[2])] if lid else local * [1, 1, 0]
            face = inverse[:3, :3].T @ face / np.linalg.norm(face)
            lean = np.degrees(np.arccos(-tip[:3, 0] @ face))
            assert lean < (41 if finger.radius else 16)
            if finger.radius:
                assert np.degrees(np.arccos(-contact.ball @ face)) < 5  # of the nearest sample
                np.testing.assert_allclose(
                    contact.point, middle + finger.radius * contact.ball, atol=1e-12
                )
            else:
                np.testing.assert_array_equal(contact.point, tip[:3, 3])


@pytest.mark.slow
def test_no_pad_extends_beyond_an_edge():
    """The distances of balls to an exact box are those claimed; its long edges are at hand."""
    solver, pose = solver_of("panda+leap"), np.eye(4)
    pose[:3, :3] = [[0.5, 0, 0.5 * 3**0.5], [0.5 * 3**0.5, 0, -0.5], [0, 1, 0]]
    pose[:3, 3] = [0.5, 0.1, 0.047]
    surface = ik.load_surface("sugar_box")
    half_extents = np.abs(surface.points).max(axis=0)
    grasps_found = solver.grasps_of(surface, pose, limit=60, among=60)
    assert len(grasps_found) == 60
    for grasp in grasps_found:
        points, normals = solver.robot.contacts(grasp.q)
        for name in grasp.grasp.contacts:
            i, radius = (
                solver.robot.fingers.index(name),
                solver.robot.description.finger(name).radius,
            )
            local = np.linalg.inv(pose) @ np.append(points[i] - radius * normals[i], 1.0)
            excess = np.abs(local[:3]) - half_extents
            distance = np.linalg.norm(np.maximum(excess, 0)) + min(excess.max(), 0)
            assert distance == pytest.approx(radius, abs=1.1e-3)


def test_grasps_differ_and_are_ranked(grasps_found):
    solver, grasps = grasps_found
    assert [grasp.score for grasp in grasps] == sorted(
        (grasp.score for grasp in grasps), reverse=True
    )
    poses = [solver.robot.palm(grasp.q) for grasp in grasps]
    tips = [solver.robot.contacts(grasp.q)[0] for grasp in grasps]
    for i in range(len(grasps)):
        for j in range(i):
            angle = np.arccos(
                np.clip((np.trace(poses[i][:3, :3].T @ poses[j][:3, :3]) - 1) / 2, -1, 1)
            )
            separations = (
                np.abs(poses[i][:3, 3] - poses[j][:3, 3]).max(),
                np.abs(tips[i] - tips[j]).max(),
            )
            assert angle > 0.25 or max(separations) > 0.005


@pytest.mark.slow
def test_gripper_approaches_from_any_side(surface):
    solver = solver_of("panda+panda_hand")
    sectors = set()
    for grasp in solver.grasps_of(surface, PLACE, limit=60, among=60):
        points = [contact.point for contact in grasp.grasp.contacts.values()]
        x = np.cross(points[1] - points[0], [0.0, 0.0, 1.0])  # level, across the line
        if np.linalg.norm(x) > 0.5 * np.linalg.norm(points[1] - points[0]):
            approach_axis = solver.robot.palm(grasp.q)[:3, 2]
            sectors.add(
                int(
                    np.degrees(np.arctan2(-approach_axis[2], approach_axis @ x / np.linalg.norm(x)))
                )
                // 15
            )
    assert len(sectors) >= 8


@pytest.mark.slow
def test_most_grasps_have_an_approach_and_a_lift(grasps_found):
    solver, grasps = grasps_found
    motions = [solver.approach(grasp) for grasp in grasps]
    assert sum(reach_motion.success for reach_motion in motions) >= 0.75 * len(motions)
    grasp, reach_motion = next(
        (grasp, reach_motion)
        for grasp in grasps
        if (reach_motion := solver.reach(grasp, lift=0.08)).success
    )
    part = reach_motion.motion.notes["part"]
    assert set(part) == {"going", "coming", "closing", "lifting"}
    np.testing.assert_allclose(reach_motion.motion.q[part == "closing"][-1], grasp.q, atol=1e-6)
    up = solver.robot.palm(reach_motion.motion.q[-1]) - solver.robot.palm(grasp.q)
    np.testing.assert_allclose(up[:3, 3], [0, 0, 0.08], atol=3e-3)


@pytest.mark.slow
def test_lifted_object_is_placed_elsewhere(grasps_found):
    solver, grasps = grasps_found
    robot, to = solver.robot, PLACE.copy()
    to[:3, 3] = [0.45, -0.15, 0.055]
    reached_grasps = ((grasp, solver.reach(grasp, lift=0.1)) for grasp in grasps)
    grasp, up = next(
        (grasp, reach_motion) for grasp, reach_motion in reached_grasps if reach_motion.success
    )
    down = solver.place(grasp, to, up.motion.q[-1])
    assert down.success, down.reason
    motion, part = down.motion, down.motion.notes["part"]
    assert list(dict.fromkeys(part.tolist())) == ["carrying", "lowering", "opening", "leaving"]
    np.testing.assert_array_equal(motion.q[0], up.motion.q[-1])
    # The object keeps its pose in the hand, and ends where it was placed.
    in_palm = np.linalg.inv(robot.palm(grasp.q)) @ PLACE
    carried_poses = robot.palm(motion.q[(part == "carrying") | (part == "lowering")]) @ in_palm
    np.testing.assert_allclose(carried_poses[-1], to, atol=3e-3)
    assert carried_poses[:, 2, 3].min() > PLACE[2, 3] - 3e-3
    motors = [robot.actuators.index(name) for name in grasp.grasp.posture]
    np.testing.assert_allclose(
        motion.q[part == "carrying"][:, motors],
        np.tile(grasp.q[motors], ((part == "carrying").sum(), 1)),
        atol=2e-3,
    )
    tips = robot.contacts(motion.q[-1])[0] - robot.contacts(down.q)[0]
    assert np.linalg.norm(tips, axis=1).min() > 0.05


def test_seeds_matter_and_jobs_do_not(grasps_found, surface):
    solver, grasps = grasps_found
    parallel_grasps = solver.grasps_of(surface, PLACE, limit=12, among=12, seed=1, jobs=2)
    assert all(np.array_equal(a.q, b.q) for a, b in zip(grasps, parallel_grasps, strict=True))
    other_seed = solver.grasps_of(surface, PLACE, limit=12, among=12, seed=2)
    assert not all(np.array_equal(a.q, b.q) for a, b in zip(grasps, other_seed, strict=True))


@pytest.mark.filterwarnings("ignore")
def test_missing_compiler_is_refused(grasps_found, surface, monkeypatch):
    monkeypatch.setenv("CC", "none")
    with pytest.raises(errors.UnsupportedError, match=r"grasps_of: .*compiler"):
        grasps_found[0].grasps_of(surface, PLACE, limit=12, among=12)


def test_best_of_many_are_returned(grasps_found, surface):
    solver, few = grasps_found
    all_grasps = solver.grasps_of(surface, PLACE, limit=100, seed=1, among=1)
    best = solver.grasps_of(surface, PLACE, limit=12, seed=1, among=100)
    assert [grasp.load for grasp in best] == [grasp.load for grasp in all_grasps[:12]]
    assert np.mean([grasp.load for grasp in best]) > np.mean([grasp.load for grasp in few])


def test_custom_ranking_function(surface):
    grasps_found = solver_of("panda+panda_hand").grasps_of(
        surface, PLACE, limit=5, among=20, prefer=lambda robot, q: robot.palm(q)[:, 2, 3]
    )
    assert [grasp.score for grasp in grasps_found] == sorted(
        (grasp.score for grasp in grasps_found), reverse=True
    )


def test_oversized_object_is_reported(tmp_path):
    box = surface_of(tmp_path, trimesh.creation.box((0.5, 0.5, 0.5)))
    grasps_found = ik.Solver(ik.load_robot("panda+panda_hand")).grasps_of(box, PLACE)
    assert not len(grasps_found)
    assert "no two patches" in grasps_found.reason


@pytest.mark.slow
def test_search_ends_without_new_grasps(tmp_path):
    cube = surface_of(tmp_path, trimesh.creation.box((0.012, 0.012, 0.012)))
    grasps_found = ik.Solver(ik.load_robot("panda+panda_hand")).grasps_of(cube, PLACE)
    assert 0 < len(grasps_found) < 200
    assert grasps_found.counts["attempts"] < 500_000  # of a million


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"fingers": 1}, "fingers: found 1, expected an integer >= 2"),
        ({"mu": 0.0}, "mu: found 0.0, expected a friction coefficient from 0.01 to 10"),
        ({"hold": (0.2, -1.0)}, "hold: found"),
        ({"limit": 0}, "limit: found 0"),
        ({"among": 0}, "among: found 0"),
        ({"prefer": "best"}, "prefer: found 'best'"),
        ({"pose": np.zeros((4, 4))}, "pose: the matrix is not a rotation"),
    ],
)
def test_bad_queries_are_refused(surface, options, expected):
    with pytest.raises(errors.InputError, match=expected.replace("(", r"\(")):
        solver_of("panda+panda_hand").grasps_of(surface, **{"pose": PLACE, **options})


@pytest.mark.parametrize(
    "corners",
    [
        pytest.param([[0, 0, 0.06], [1e-3, 0, 0.06], [0, 1e-3, 0.06]], id="speck of a scanner"),
        pytest.param([[-0.02, 0.034, -0.03], [0.02, 0.034, -0.03], [0, 0.034, 0.03]], id="label"),
    ],
)
def test_protruding_parts_cost_no_grasps(tmp_path, corners):
    """A speck is not a part; a label is a thin one."""
    body = trimesh.creation.cylinder(0.033, 0.1, sections=64)
    both = trimesh.util.concatenate([body, trimesh.Trimesh(corners, [[0, 1, 2]])])
    grasps_found = solver_of("panda+panda_hand").grasps_of(
        surface_of(tmp_path, both), PLACE, limit=3, among=3
    )
    assert len(grasps_found) == 3


def test_unreachable_object_ends_early(surface):
    far_pose = PLACE.copy()
    far_pose[0, 3] = 5.0
    grasps_found = ik.Solver(ik.load_robot("panda+panda_hand")).grasps_of(surface, far_pose)
    assert not len(grasps_found)
    assert next(stage for stage, count in grasps_found.counts.items() if not count) == "arm reaches"
    assert "arm reaches" in grasps_found.reason
    assert grasps_found.counts["attempts"] < 100_000
