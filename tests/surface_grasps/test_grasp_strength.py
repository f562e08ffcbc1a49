"""Loads, forces, squeezes and robustness of grasps, compared with linear programs."""

import numpy as np
import pytest
from scipy.optimize import linprog
from touch_cases import PLACE, solver_of

import casadi_ik as ik
from casadi_ik import errors
from casadi_ik.planning.touch.strength import (
    COMPLIANCE,
    DIRECTIONS,
    friction_wrenches,
    loads,
    stiffnesses,
)


def test_loads_match_linear_programs(grasps_found):
    """Loads of the same soft fingers on the exact cylinder are close, since normals are sampled."""
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
    # A compliant object reduces the load.
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
    """Unsupported directions have load 0; HiGHS has an error of `off` for dependent contacts."""
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
    """Two springs on a line have the stiffness 2 k R^2 against rotation, less 2 F (R - radius)."""
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


def test_pregrasp_opens_and_squeeze_closes(grasps_found):
    solver, grasps = grasps_found
    opened = [grasp for grasp in grasps if grasp.pregrasp is not None]
    assert opened
    for grasp in opened:
        assert grasp.grasp.squeeze is not None
        palm = solver.robot.palm(grasp.q)
        assert np.linalg.norm(grasp.pregrasp.palm[:3, 3] - palm[:3, 3]) == pytest.approx(0.06)


def test_forces_balance_within_friction(grasps_found):
    grasps = grasps_found[1]
    for grasp in grasps:
        contacts = grasp.grasp.contacts
        forces = np.array([grasp.forces[name] for name in contacts])
        points = np.array([contact.point for contact in contacts.values()])
        # The exact normals of the can, on its side or a lid.
        local = points - PLACE[:3, 3]
        lid = np.abs(local[:, 2]) > 0.0495
        inward = -np.where(lid[:, None], local * [0, 0, 1], local * [1, 1, 0])
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        pressed = (forces * inward).sum(axis=1)
        slid = np.linalg.norm(forces - pressed[:, None] * inward, axis=1)
        np.testing.assert_allclose(forces.sum(axis=0), 0, atol=1e-6)
        # The rest is held by the torsion of the pads: at most 2/3 mu 5 mm of 1 N.
        torque = np.cross(points - PLACE[:3, 3], forces).sum(axis=0)
        assert np.linalg.norm(torque) < 2 / 3 * grasps.mu * 5e-3 + 1e-3
        assert pressed.sum() == pytest.approx(1.0, abs=0.03)
        assert (slid <= grasps.mu * pressed + 0.03).all()  # normals of samples are of flat facets


def test_squeeze_matches_equal_springs(grasps_found):
    """By virtual work, a squeeze moves motors in proportion to the torques of the forces."""
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


@pytest.mark.slow
def test_required_load_is_held(surface):
    grasps_found = solver_of("panda+panda_hand").grasps_of(
        surface, PLACE, limit=5, among=5, hold=(0.1, 18.0)
    )
    assert len(grasps_found)
    assert all(grasp.load * 18.0 >= 0.1 * 9.8 for grasp in grasps_found)


@pytest.mark.slow
def test_motor_torques_limit_the_squeeze(surface):
    """The most loaded motor has its maximum torque, by differences of the fingertips."""
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


@pytest.mark.slow
def test_enveloping_fingers_support_the_object(surface, tmp_path):
    """Only finger links lean on the object, no deeper than permitted."""
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
