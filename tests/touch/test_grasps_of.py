"""Grasps of surfaces, confirmed by the public solver, exact distances and linear programs.

And what they squeeze with, and how they bear that the object is elsewhere.
"""

import io

import numpy as np
import pytest
import trimesh
from scipy.optimize import linprog

import casadi_ik as ik
from casadi_ik import errors
from casadi_ik.app.cli.grasp import grasps_npz
from casadi_ik.planning.touch.strength import (
    COMPLIANCE,
    DIRECTIONS,
    friction_wrenches,
    loads,
    stiffnesses,
)

PLACE = np.eye(4)
PLACE[:3, 3] = [0.5, 0.1, 0.055]


def solver_of(robot):
    return ik.Solver(ik.load_robot(robot), scene=ik.load_scene("table"))


def surface_of(folder, mesh):
    mesh.export(folder / "mesh.stl")
    return ik.load_surface(folder / "mesh.stl")


@pytest.fixture(scope="module")
def surface(tmp_path_factory):
    can = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    return surface_of(tmp_path_factory.mktemp("touch"), can)


@pytest.fixture(scope="module", params=["panda+panda_hand", "panda+allegro_right"])
def grasps_found(request, surface):
    solver = solver_of(request.param)
    return solver, solver.grasps_of(surface, PLACE, limit=12, among=12, seed=1)


def test_samples_lie_on_the_surface_and_face_outwards(surface):
    radius = np.linalg.norm(surface.points[:, :2], axis=1)
    rim = np.abs(surface.points[:, 2]) > 0.05 - 1e-9
    side = surface.fits_pad & ~rim
    assert np.abs(radius[~rim] - 0.033).max() < 5e-5  # flat facets
    outward = (surface.normals[side, :2] * surface.points[side, :2]).sum(axis=1) / radius[side]
    assert outward.min() > 0.995
    near_edge = ~rim & (np.abs(surface.points[:, 2]) > 0.048)
    assert not surface.fits_pad[near_edge].any()


def test_every_grasp_is_confirmed_in_the_scene(grasps_found):
    solver, grasps = grasps_found
    assert len(grasps) == 12
    for grasp in grasps:
        assert solver.solve(grasp.grasp, q0=grasp.q).success
        assert grasp.clearance >= 0
        assert list(grasps.counts.values()) == sorted(grasps.counts.values(), reverse=True)


def test_written_grasps_match(grasps_found):
    solver, grasps = grasps_found
    stored = np.load(io.BytesIO(grasps_npz(grasps, solver.robot.fingers)))
    arrays = {name: stored[name] for name in ("points", "normals", "balls") if name in stored}
    batch = solver.solve_batch(**arrays, q0=stored["q"])
    assert batch.success.all()
    np.testing.assert_allclose(batch.q, stored["q"], atol=1e-9)
    assert np.nanmax(batch.position_error) < 1e-9


def test_neighbouring_obstacles_are_avoided(surface):
    """A wall, a post and a cloud of points close by, told apart by their exact distances."""
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
    """By distances of the pads, balls or points, to the exact cylinder."""
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
    """By distances of balls to an exact box, lying so that its long edges are at hand."""
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


def test_loads_match_linear_programs(grasps_found):
    """With the same soft fingers, on the exact cylinder: close, since normals are sampled."""
    grasp = grasps_found[1][0]
    points = np.array([c.point for c in grasp.grasp.contacts.values()]) - PLACE[:3, 3]
    normals = -points * [1, 1, 0]
    if np.abs(points[:, 2]).max() > 0.0495:
        pytest.skip("a contact on the lid")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    columns = []
    for p, n in zip(points, normals, strict=True):
        x = np.cross(n, [0, 0, 1.0])
        for angle in np.arange(8) * np.pi / 4:
            force = n + 0.5 * (np.cos(angle) * x + np.sin(angle) * np.cross(n, x))
            columns.append(np.concatenate([force, np.cross(p, force)]))
        for sign in (1, -1):
            spin = sign * 2 / 3 * 0.5 * 0.005 * n
            columns.append(np.concatenate([n, np.cross(p, n) + spin]))
    wrenches = np.array(columns).T
    max_loads = []
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        program_columns = np.column_stack([wrenches, np.concatenate([direction, np.zeros(3)])])
        cost = np.zeros(program_columns.shape[1])
        cost[-1] = -1
        force_limits = [[1.0] * wrenches.shape[1] + [0.0]]
        max_loads.append(-linprog(cost, force_limits, [1.0], program_columns, np.zeros(6)).fun)
    # As the object gives way, some of it is lost.
    assert 0.25 * min(max_loads) < grasp.load < 1.25 * min(max_loads) + 0.02


LINE = np.array([[[-0.03, 0, 0], [0.03, 0, 0], [0.01, 0, 0]]])


@pytest.mark.parametrize(
    ("points", "normals", "off"),
    [
        pytest.param(None, None, 1e-9, id="anywhere"),
        pytest.param(None, "middle", 1e-9, id="towards their middle"),
        pytest.param(LINE, -LINE, 1e-9, id="on a line"),
        pytest.param(LINE, -LINE, 1e-6, id="nearly on a line"),
        pytest.param(np.full((1, 3, 3), 0.02), np.ones((1, 3, 3)), 1e-9, id="all the same"),
        pytest.param(LINE[:, [0, 1, 0]], -LINE[:, [0, 1, 0]], 1e-9, id="one of them twice"),
    ],
)
def test_loads_of_any_contacts_match_linear_programs(points, normals, off, rng):
    """What nothing holds is 0; HiGHS is not surer than `off` where contacts nearly depend."""
    for count in (2, 3, 5) if points is None else (3,):
        at = 0.03 * rng.normal(size=(6, count, 3)) if points is None else points
        if off > 1e-9:
            at = at + 1e-6 * rng.normal(size=at.shape)
        facing = rng.normal(size=at.shape) if normals is None else normals
        facing = -at + 0.01 * rng.normal(size=at.shape) if isinstance(facing, str) else facing
        facing = facing / np.linalg.norm(facing, axis=-1, keepdims=True)
        wrenches = friction_wrenches(at, facing, 0.5, np.zeros(3), 0.05)
        grasps_found = loads(wrenches)
        for contact_wrenches, row in zip(wrenches, grasps_found, strict=True):
            cost, force_limits = (
                np.append(np.zeros(contact_wrenches.shape[1]), -1.0),
                np.ones((1, contact_wrenches.shape[1] + 1)),
            )
            force_limits[0, -1] = 0.0
            for direction, load in zip(DIRECTIONS, row, strict=True):
                columns = np.column_stack([contact_wrenches, direction])
                solved = linprog(cost, force_limits, [1.0], columns, np.zeros(6), options=EXACTLY)
                assert abs(-solved.fun - load) < 2 * off


EXACTLY = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


@pytest.mark.parametrize("radius", [0.0, 0.012])
def test_rotational_stiffness_falls_with_squeeze_force(radius):
    """Two springs on a line: 2 k R^2 against turning, less 2 F (R - radius)."""
    k, half_width, force = 400.0, 0.04, 6.0
    normals = np.array([[[1.0, 0, 0], [-1.0, 0, 0]]])
    jacobians = np.eye(6).reshape(1, 2, 3, 6)
    rolled = radius or COMPLIANCE.plane_radius
    turning = 2 * k * half_width**2 - 2 * force * (half_width - rolled)
    grasps_found = stiffnesses(
        -half_width * normals, normals, force * normals, np.full((1, 2), radius), jacobians,
        np.full(6, k), mu=10.0,
    )  # fmt: skip
    assert grasps_found[0] == pytest.approx(
        turning * (COMPLIANCE.halving_rotation / COMPLIANCE.halving_displacement) ** 2, rel=0.03
    )
    assert stiffnesses(
        -half_width * normals, normals, 10 * force * normals, np.full((1, 2), radius), jacobians,
        np.full(6, k), mu=10.0,
    )[0] < 0  # fmt: skip


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


def test_pregrasp_opens_and_squeeze_closes(grasps_found):
    solver, grasps = grasps_found
    opened = [grasp for grasp in grasps if grasp.pregrasp is not None]
    assert opened
    for grasp in opened:
        assert grasp.grasp.squeeze is not None
        palm = solver.robot.palm(grasp.q)
        assert np.linalg.norm(grasp.pregrasp.palm[:3, 3] - palm[:3, 3]) == pytest.approx(0.06)


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
    # The object is held as it was, and stands where it was to be.
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


def test_forces_balance_within_friction(grasps_found):
    grasps = grasps_found[1]
    for grasp in grasps:
        contacts = grasp.grasp.contacts
        forces = np.array([grasp.forces[name] for name in contacts])
        points = np.array([contact.point for contact in contacts.values()])
        # The can's exact normals, on its side or on a lid.
        local = points - PLACE[:3, 3]
        lid = np.abs(local[:, 2]) > 0.0495
        inward = -np.where(lid[:, None], local * [0, 0, 1], local * [1, 1, 0])
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        pressed = (forces * inward).sum(axis=1)
        slid = np.linalg.norm(forces - pressed[:, None] * inward, axis=1)
        np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-6)
        # What is left is held by the pads' torsion: at most 2/3 mu 5 mm of 1 N.
        torque = np.cross(points - PLACE[:3, 3], forces).sum(axis=0)
        assert np.linalg.norm(torque) < 2 / 3 * grasps.mu * 5e-3 + 1e-3
        assert pressed.sum() == pytest.approx(1.0, abs=0.03)
        assert (slid <= grasps.mu * pressed + 0.03).all()  # normals of samples are of flat facets


def test_squeeze_matches_equal_springs(grasps_found):
    """A squeeze moves motors in proportion to the torques of the forces, by virtual work."""
    grasps = grasps_found[1]
    robot = grasps_found[0].robot
    for grasp in grasps[:3]:
        posture = grasp.grasp.squeeze.posture
        columns = [robot.actuators.index(name) for name in posture]
        motor_steps = np.array(list(posture.values())) - grasp.q[columns]
        torques, frames, pressed = [], robot.contact_frames(grasp.q), []
        for name, force in grasp.forces.items():
            i, point = robot.fingers.index(name), grasp.grasp.contacts[name].point
            pressed.append((i, np.linalg.inv(frames[i]) @ np.append(point, 1), force))
        for column in columns:
            step = np.zeros(len(grasp.q))
            step[column] = 1e-6
            slope = (
                robot.contact_frames(grasp.q + step) - robot.contact_frames(grasp.q - step)
            ) / 2e-6
            torques.append(sum((slope[i] @ at)[:3] @ f for i, at, f in pressed))
        is_within_limits = (np.array(list(posture.values())) > robot.lower[columns] + 1e-6) & (
            np.array(list(posture.values())) < robot.upper[columns] - 1e-6
        )
        ratio = (
            motor_steps[is_within_limits]
            @ np.array(torques)[is_within_limits]
            / (np.array(torques)[is_within_limits] ** 2).sum()
        )
        assert ratio > 0
        np.testing.assert_allclose(
            motor_steps[is_within_limits], ratio * np.array(torques)[is_within_limits], atol=1e-6
        )


def test_nominal_pose_is_closed_on(grasps_found):
    grasps = grasps_found[1]
    np.testing.assert_array_equal(grasps.robustness(position=0.0, angle=0.0, samples=1), 1.0)


def test_robustness_falls_with_noise(grasps_found):
    grasps = grasps_found[1]
    small_noise, large_noise, huge_noise = (
        grasps.robustness(position=position, samples=24).mean() for position in (0.005, 0.02, 0.2)
    )
    assert small_noise >= large_noise
    assert large_noise > huge_noise
    assert huge_noise == 0.0
    repeated = grasps.robustness(position=0.005, samples=24)
    np.testing.assert_array_equal(repeated, grasps.robustness(position=0.005, samples=24))


def test_bad_noise_is_refused(grasps_found):
    grasps = grasps_found[1]
    with pytest.raises(errors.InputError, match="robustness: position: found -1"):
        grasps.robustness(position=-1)


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


@pytest.mark.slow
def test_required_load_is_held(surface):
    grasps_found = solver_of("panda+panda_hand").grasps_of(
        surface, PLACE, limit=5, among=5, hold=(0.1, 18.0)
    )
    assert len(grasps_found)
    assert all(grasp.load * 18.0 >= 0.1 * 9.8 for grasp in grasps_found)


@pytest.mark.slow
def test_motor_torques_limit_the_squeeze(surface):
    """The one that is used most has all that it can, by differences of its fingertips' places."""
    solver = solver_of("panda+leap")
    robot = solver.robot
    options = {"limit": 5, "among": 5, "hold": (0.15, 1000.0)}
    for grasp in solver.grasps_of(surface, PLACE, **options):
        frames, torques = robot.contact_frames(grasp.q), np.zeros(len(grasp.q))
        for name, force in grasp.forces.items():
            i = robot.fingers.index(name)
            on_link = np.linalg.inv(frames[i]) @ [*grasp.grasp.contacts[name].point, 1.0]
            for motor, step in enumerate(1e-6 * np.eye(len(grasp.q))):
                ends = [
                    (robot.contact_frames(q)[i] @ on_link)[:3] for q in (grasp.q + step, grasp.q)
                ]
                torques[motor] += (ends[0] - ends[1]) @ force / 1e-6
        hand = torques[list(robot.description.hand_actuators)]
        assert np.abs(hand).max() * grasp.most_squeeze == pytest.approx(0.95, rel=1e-3)
        assert grasp.load * grasp.most_squeeze >= 0.15 * 9.8
    unknown = solver_of("panda+panda_hand").grasps_of(surface, PLACE, limit=1, among=1)
    assert unknown[0].most_squeeze == np.inf


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


def test_inverted_mesh_is_flipped_and_reported(tmp_path, surface):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    mesh.invert()
    turned_surface = surface_of(tmp_path, mesh)
    assert ((turned_surface.faces * turned_surface.points).sum(axis=1) > 0).all()
    assert len(turned_surface.notes) == 1
    assert not surface.notes
    grasps_found = solver_of("panda+panda_hand").grasps_of(turned_surface, PLACE, limit=3, among=3)
    assert len(grasps_found) == 3
    assert turned_surface.notes[0] in str(grasps_found)


def test_open_mesh_is_accepted_and_reported(tmp_path):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.049)
    opened = surface_of(tmp_path, mesh)
    assert [note for note in opened.notes if "128" in note] == list(opened.notes) != []
    assert len(solver_of("panda+panda_hand").grasps_of(opened, PLACE, limit=3, among=3)) == 3


def test_inconsistent_triangles_are_refused(tmp_path):
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=128)
    faces = np.array(mesh.faces)
    faces[::2] = faces[::2, ::-1]
    mixed = trimesh.Trimesh(mesh.vertices, faces, process=False)
    with pytest.raises(errors.InputError, match=r"orientation at .* of .* edges"):
        surface_of(tmp_path, mixed)


def test_sheets_and_specks_are_refused(tmp_path):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.1]], [[0, 1, 2]])
    with pytest.raises(errors.InputError, match="found a flat sheet"):
        surface_of(tmp_path, sheet)
    with pytest.raises(errors.InputError, match="1e-06"):
        surface_of(tmp_path, trimesh.creation.box((1e-6, 1e-6, 1e-6)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# nothing\n", "the mesh is empty; expected triangles"),
        ("v 0 0 0\nv nan 1 0\nv 0 1 1\nf 1 2 3\n", "a vertex is not finite"),
        ("v 0 0 0\nv inf 1 0\nv 0 1 1\nf 1 2 3\n", "a vertex is not finite"),
    ],
)
def test_non_meshes_are_refused(tmp_path, text, expected):
    (tmp_path / "mesh.obj").write_text(text)
    with pytest.raises(errors.DescriptionError, match=expected):
        ik.load_surface(tmp_path / "mesh.obj")


@pytest.mark.slow
def test_many_triangles_are_sampled(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.035)
    assert len(ball.faces) > 300_000
    surface = surface_of(tmp_path, ball)
    assert surface.fits_pad.all()
    assert np.abs(np.linalg.norm(surface.points, axis=1) - 0.035).max() < 1e-5


def test_millimetres_are_detected(tmp_path):
    with pytest.raises(errors.InputError, match=r"scale=0\.001"):
        surface_of(tmp_path, trimesh.creation.cylinder(33, 100))
    grasps_found = ik.load_surface(tmp_path / "mesh.stl", scale=0.001)
    assert grasps_found.size == pytest.approx(0.137, abs=2e-3)


@pytest.mark.parametrize(
    "corners",
    [
        pytest.param([[0, 0, 0.06], [1e-3, 0, 0.06], [0, 1e-3, 0.06]], id="speck of a scanner"),
        pytest.param([[-0.02, 0.034, -0.03], [0.02, 0.034, -0.03], [0, 0.034, 0.03]], id="label"),
    ],
)
def test_protruding_parts_cost_no_grasps(tmp_path, corners):
    """A speck is no part, a label a thin one."""
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


@pytest.mark.slow
def test_enveloping_fingers_support_the_object(surface, tmp_path):
    """Their links alone, and no deeper than the scene says; plain scenes refuse these hands."""
    robot, deep = ik.load_robot("panda+leap"), 0.006
    text = f"enveloping: {deep}\n{ik.load_scene('table').text()}"
    (tmp_path / "leaning.yaml").write_text(text)
    leaning = ik.load_scene(tmp_path / "leaning.yaml")
    assert "enveloping: 0.006" in leaning.text()
    plain = solver_of("panda+leap")
    solver = ik.Solver(robot, scene=leaning)
    grasps = solver.grasps_of(surface, PLACE, limit=40, among=40)
    assert len(grasps) == 40
    depths = []
    for grasp in grasps:
        assert grasp.clearance is not None
        assert grasp.clearance >= 0
        assert solver.solve(grasp.grasp, q0=grasp.q).success
        clear = plain.check(grasp.q, grasp.grasp)
        assert clear is not None
        nearest = clear.pair(0)
        if not clear.free[0]:
            assert nearest is not None
            link, solid = nearest
            assert solid == surface.name
            fingers = robot.description.fingers
            chain = {joint.name for joint in robot.description.chain(link)}
            assert any(chain.intersection(finger.joints) for finger in fingers)
            depths.append(-clear.distance[0])
    assert len(depths) > 5
    assert max(depths) <= deep
    assert max(depths) > 0.5 * deep


def test_changed_mesh_file_is_detected(tmp_path):
    solver, path = solver_of("panda+panda_hand"), tmp_path / "part.stl"
    for part in (trimesh.creation.icosphere(3, 0.03), trimesh.creation.box((0.05, 0.09, 0.11))):
        part.export(path)
        grasps_found = solver.grasps_of(ik.load_surface(path), PLACE, limit=5, among=5)
        assert len(grasps_found) == 5
        fresh = solver_of("panda+panda_hand")
        for grasp in grasps_found:
            assert fresh.solve(grasp.grasp, q0=grasp.q).success
