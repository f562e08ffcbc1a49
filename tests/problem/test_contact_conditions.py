"""Every contact condition: residual, Jacobian and errors, by independent formulas."""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.contact_fit import contact_jacobian, contact_residual
from casadi_ik.kinematics.contacts import (
    CONDITIONS,
    LENGTH,
    ORIENTATION,
    POSITION,
    ContactKind,
    ContactRows,
    chord,
    kind_from_vectors,
    kinds_suffix,
    point_normal_kinds,
    within_tolerance,
)
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.palm import (
    NUMERIC_ARM_PARAMETERS,
    best_palm,
    hand_contacts,
    nearest_start,
    pose_jacobian,
    pose_step,
)
from casadi_ik.kinematics.se3 import compose, exp_se3
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.state import HandFirstLayouts
from casadi_ik.solve.hand_first.step import PalmAndHand, fit_jacobian, fit_residual, reach_row
from casadi_ik.solve.thumb_first.closed_chain_step import contact_errors, linearise_contacts

ARM = 7
RADIUS = 9.5e-3
"""Radius of the pads of the Barrett hand [m]."""

BY_ASPECT = [
    [name for name, condition in CONDITIONS.items() if condition.aspect == aspect]
    for aspect in (POSITION, ORIENTATION)
]
KINDS = [ContactKind(*names) for names in product(*BY_ASPECT)]
WEIGHTS = np.array([[1.0, 1.0], [1.0, 0.0], [0.5, 2.0]])


def number(value):
    return np.array(ca.evalf(ca.densify(ca.SX(value))))


def differences(function, x, step=1e-6):
    """Return central differences (m, n)."""
    ahead, behind = ([function(x + sign * step * e) for e in np.eye(len(x))] for sign in (1, -1))
    return np.column_stack([(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)])


def units(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def data_at(robot, q, rng):
    """Return every vector of a target, such that the contacts are met at q."""
    frames = robot.contact_frames(q)
    f = len(frames)
    return {
        "points": frames[:, :3, 3],
        "normals": frames[:, :3, 0],
        "tangents": frames[:, :3, 1],
        "lines": units(rng, f),
        "planes": units(rng, f),
        "balls": frames[:, :3, 0],
    }


def parameters(data, weights=WEIGHTS):
    return {name: ca.DM(value) for name, value in {**data, "weights": weights}.items()}


def every_kind(test):
    return pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "+".join(kind))(test)


@every_kind
def test_full_jacobian_matches_differences(robot, kind, rng):
    q, q_target = robot.random(rng, 2)
    p, rows = parameters(data_at(robot, q_target, rng)), ContactRows((kind,) * 3)

    def residual(x):
        return number(contact_residual(robot.description, rows, ca.SX(x), p)).ravel()

    jacobian = number(contact_jacobian(robot.description, rows, ca.SX(q), p))
    assert jacobian.shape == (rows.size, 14)
    np.testing.assert_allclose(jacobian, differences(residual, q), atol=2e-7)
    assert np.linalg.matrix_rank(jacobian) >= 5


@every_kind
def test_hand_jacobian_matches_differences(robot, kind, rng):
    """Over a palm that moves and turns, the targets move instead."""
    q, q_target = robot.random(rng, 2)
    p, rows = parameters(data_at(robot, q_target, rng)), ContactRows((kind,) * 3)
    palm = robot.palm(q)

    def at(x):
        rotation, origin = compose((palm[:3, :3], palm[:3, 3]), exp_se3(ca.DM(x[:6])))
        place = PalmAndHand(rotation, origin, ca.DM(q[ARM:] + x[6:]))
        return hand_contacts(robot.description, ca.SX(place.hand), tuple(range(ARM, 14))), place

    def residual(x):
        contacts, place = at(x)
        return number(fit_residual(contacts, rows, place, p)).ravel()

    contacts, place = at(np.zeros(13))
    jacobian = number(fit_jacobian(contacts, rows, place, p))
    np.testing.assert_allclose(jacobian, differences(residual, np.zeros(13)), atol=2e-7)
    assert np.linalg.matrix_rank(jacobian) > 5


@every_kind
def test_hand_and_full_residuals_agree(robot, kind, rng):
    """Lengths are the same in every frame."""
    q, q_target = robot.random(rng, 2)
    p, rows = parameters(data_at(robot, q_target, rng)), ContactRows((kind,) * 3)
    palm = robot.palm(q)
    contacts = hand_contacts(robot.description, ca.SX(q[ARM:]), tuple(range(ARM, 14)))
    place = PalmAndHand(ca.DM(palm[:3, :3]), ca.DM(palm[:3, 3]), ca.DM(q[ARM:]))
    hand = rows.errors(ca.DM(number(fit_residual(contacts, rows, place, p))))
    full_errors = rows.errors(ca.DM(number(contact_residual(robot.description, rows, ca.SX(q), p))))
    for hand_error, other_one in zip(hand, full_errors, strict=True):
        np.testing.assert_allclose(number(hand_error), number(other_one), atol=1e-12)


@every_kind
def test_newton_rows_match_differences_at_the_target(robot, kind, rng):
    (q,) = robot.random(rng, 1)
    p, rows = parameters(data_at(robot, q, rng), np.ones((3, 2))), ContactRows((kind,) * 3)

    def errors(x):
        both = contact_errors(robot.description, rows, ca.SX(x), p)
        return number(ca.vertcat(*map(ca.vertcat, *both))).ravel()

    assert np.abs(errors(q)).max() < 1e-7
    linear = linearise_contacts(robot.description, rows, ca.SX(q), p)
    jacobian = np.vstack([number(linear.thumb), number(linear.other_fingers)])
    slopes = -differences(errors, q)
    np.testing.assert_allclose(jacobian.T @ jacobian, slopes.T @ slopes, atol=1e-5, rtol=1e-5)


def own_errors(kind, data, frames):
    """Return distances and angles by NumPy and SciPy."""
    off = frames[:, :3, 3] - data["points"]
    distance = {
        "point": np.linalg.norm(off, axis=1),
        "line": np.linalg.norm(np.cross(data["lines"], off), axis=1),
        "plane": np.abs(np.sum(data["planes"] * off, axis=1)),
        "ball": np.linalg.norm(off + RADIUS * (data["balls"] - frames[:, :3, 0]), axis=1),
    }[kind.position]
    cosine = np.sum(frames[:, :3, 0] * data["normals"], axis=1)
    third = np.cross(data["normals"], data["tangents"])
    goal = np.stack([data["normals"], data["tangents"], third], axis=2)
    turn_angles = Rotation.from_matrix(goal @ frames[:, :3, :3].transpose(0, 2, 1)).magnitude()
    return distance, {"normal": np.arccos(cosine), "frame": turn_angles}[kind.orientation]


@every_kind
def test_errors_are_distances_and_angles(robot, kind, rng):
    """Errors from the residual, from rotation vectors and from measurements agree."""
    place, facing = kind.conditions
    for q, q_target in robot.random(rng, 10).reshape(5, 2, 14):
        data, rows = data_at(robot, q_target, rng), ContactRows((kind,) * 3)
        p, frames = parameters(data, np.ones((3, 2))), robot.contact_frames(q)
        distance, angle = own_errors(kind, data, frames)
        residual = ca.DM(number(contact_residual(robot.description, rows, ca.SX(q), p)))
        positions, chords = rows.errors(residual)
        np.testing.assert_allclose(number(positions).ravel(), distance, atol=1e-9)
        np.testing.assert_allclose(number(chords).ravel(), 2 * np.sin(angle / 2), atol=1e-9)
        places, facings = contact_errors(robot.description, rows, ca.SX(q), p)
        for i in range(3):
            assert np.linalg.norm(number(places[i])) * LENGTH == pytest.approx(distance[i])
            assert np.linalg.norm(number(facings[i])) == pytest.approx(angle[i])
        for i, frame in enumerate(frames):
            tip = {"point": frame[:3, 3], "normal": frame[:3, 0], "tangent": frame[:3, 1]}
            tip["pad"] = RADIUS * frame[:3, 0]
            tip = {name: ca.DM(value) for name, value in tip.items()}
            goal = {name: ca.DM(data[f"{name}s"][i]) for name in kind.data}
            assert float(place.measure(tip, goal)) == pytest.approx(distance[i], abs=1e-12)
            assert float(facing.measure(tip, goal)) == pytest.approx(angle[i], abs=1e-9)


angles = st.floats(-3.1, 3.1)


@given(turn=st.tuples(angles, angles, angles), rotation_axis=st.sampled_from([0, 1, 2]))
def test_frame_error_is_isotropic(turn, rotation_axis):
    """The length of the residual is the chord of the angle, for any axis of rotation."""
    start = Rotation.from_euler("xyz", turn)
    axis, angle = np.eye(3)[rotation_axis], abs(turn[0])
    end = Rotation.from_rotvec(axis * angle) * start
    tip, goal = (
        {"normal": ca.DM(R.as_matrix()[:, 0]), "tangent": ca.DM(R.as_matrix()[:, 1])}
        for R in (start, end)
    )
    residual = CONDITIONS["frame"].residual(tip, goal)
    assert float(ca.norm_2(residual)) == pytest.approx(2 * np.sin(angle / 2), abs=1e-12)
    vector = np.array(CONDITIONS["frame"].error(tip, goal)).ravel()
    np.testing.assert_allclose(vector, axis * angle, atol=1e-7)


def test_frame_without_tangent_is_a_normal(robot, rng):
    """A tangent of zero is free, so one kernel serves fingers with and without one."""
    q, q_target = robot.random(rng, 2)
    data = data_at(robot, q_target, rng)
    data["tangents"] = np.zeros((3, 3))
    p = parameters(data, np.ones((3, 2)))
    frame, normal = (
        ContactRows((ContactKind("point", "frame"),) * 3),
        ContactRows(point_normal_kinds(3)),
    )
    errors, expected = (
        rows.errors(ca.DM(number(contact_residual(robot.description, rows, ca.SX(q), p))))
        for rows in (frame, normal)
    )
    for error, expected_error in zip(errors, expected, strict=True):
        np.testing.assert_allclose(number(error), number(expected_error), atol=1e-14)
    error, expected_error = (
        linearise_contacts(robot.description, rows, ca.SX(q), p) for rows in (frame, normal)
    )
    gram = [np.vstack([number(x.thumb), number(x.other_fingers)]) for x in (error, expected_error)]
    np.testing.assert_allclose(gram[0].T @ gram[0], gram[1].T @ gram[1], atol=1e-9)


def test_best_palm_uses_tangents(robot, rng):
    """A full frame of one finger determines the palm of a posture; point and normal do not."""
    (q,) = robot.random(rng, 1)
    weights = np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    p = parameters(data_at(robot, q, rng), weights)
    contacts = hand_contacts(robot.description, ca.SX(q[ARM:]), tuple(range(ARM, 14)))
    rows = ContactRows((ContactKind("point", "frame"),) * 3)
    rotation, origin = best_palm(contacts, rows, p)
    np.testing.assert_allclose(number(rotation), robot.palm(q)[:3, :3], atol=1e-3)
    np.testing.assert_allclose(number(origin).ravel(), robot.palm(q)[:3, 3], atol=1e-3)


def test_contact_kind_follows_from_the_data():
    assert (
        kind_from_vectors(["point"])
        == kind_from_vectors(["point", "normal"])
        == ContactKind("point", "normal")
    )
    assert kind_from_vectors(["point", "normal", "tangent"]) == ContactKind("point", "frame")
    assert kind_from_vectors(["point", "line"]) == ContactKind("line", "normal")
    assert kind_from_vectors(["point", "plane", "normal", "tangent"]) == ContactKind(
        "plane", "frame"
    )


def test_graphs_of_different_kinds_have_different_names():
    names = [kinds_suffix(kinds) for kinds in product(KINDS, repeat=2)]
    assert len(set(names)) == len(names)
    assert kinds_suffix(point_normal_kinds(3)) == ""


def test_contact_frames_contain_the_contacts(robot, coupled_robot, rng):
    for model in (robot, coupled_robot):
        q = model.random(rng, 20)
        frames, (points, normals) = model.contact_frames(q), model.contacts(q)
        assert frames.shape == (20, len(model.fingers), 4, 4)
        np.testing.assert_allclose(frames[..., :3, 3], points, atol=1e-12)
        np.testing.assert_allclose(frames[..., :3, 0], normals, atol=1e-12)
        gram = np.swapaxes(frames[..., :3, :3], -1, -2) @ frames[..., :3, :3]
        np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(frames[..., :3, :3]), 1.0, atol=1e-12)
        np.testing.assert_array_equal(model.contact_frames(q[0]), frames[0])


def test_the_tangent_is_the_x_axis_of_the_described_contact_frame(robot, rng):
    """The tangent of the Barrett hand runs along the distal phalanx."""
    (q,) = robot.random(rng, 1)
    links = robot.links(q)
    for finger, frame in zip(robot.description.fingers, robot.contact_frames(q), strict=True):
        np.testing.assert_allclose(frame[:3, 1], links[finger.link][:3, 0], atol=1e-12)


HAND = 7
ROWS = ContactRows(point_normal_kinds(3))


def fit_parameters(robot, points, normals):
    values = {
        "points": points,
        "normals": normals,
        "weights": np.ones((3, 2)),
        "lower": robot.lower,
        "upper": robot.upper,
        "reach_weight": 1.0,
    }
    return {name: ca.DM(value) for name, value in values.items()}


@pytest.fixture(scope="module")
def layouts(robot):
    return HandFirstLayouts(robot.description, 1, ROWS.kinds)


@pytest.fixture(scope="module")
def posture(robot):
    return robot.random(np.random.default_rng(3), 1)[0]


def test_pose_jacobian(robot, posture):
    q = posture

    def features(x):
        palm = robot.palm(np.concatenate([x, q[ARM:]]))
        return np.concatenate([palm[:3, 3] / LENGTH, palm[:3, :3].T.ravel()])

    jacobian = number(pose_jacobian(robot.description, ca.SX(q[:ARM])))
    np.testing.assert_allclose(jacobian, differences(features, q[:ARM]), atol=1e-7)


def test_residual_vanishes_at_the_generating_configuration(robot, layouts, posture):
    q = posture
    p, palm = fit_parameters(robot, *robot.contacts(q)), robot.palm(q)
    at = PalmAndHand(ca.DM(palm[:3, :3]), ca.DM(palm[:3, 3]), ca.DM(q[ARM:]))
    contacts = hand_contacts(robot.description, ca.SX(at.hand), layouts.robot.hand_actuators)
    assert np.abs(number(fit_residual(contacts, ROWS, at, p))).max() < 1e-13
    assert np.abs(number(contact_residual(robot.description, ROWS, ca.SX(q), p))).max() < 1e-13


def test_best_palm_recovers_the_palm(robot, layouts, rng):
    for q in robot.random(rng, 10):
        contacts = hand_contacts(robot.description, ca.SX(q[ARM:]), layouts.robot.hand_actuators)
        rotation, origin = best_palm(contacts, ROWS, fit_parameters(robot, *robot.contacts(q)))
        palm = robot.palm(q)
        np.testing.assert_allclose(number(rotation), palm[:3, :3], atol=1e-3)
        np.testing.assert_allclose(number(origin).ravel(), palm[:3, 3], atol=1e-3)


@pytest.mark.parametrize(("shift", "sign"), [(0.0, 0), (1.0, 1), (-2.0, -1)])
def test_reach_row_matches_differences(robot, shift, sign):
    """The residual is zero within reach, and the distance beyond it, with its slope."""
    arm, p = srs_arm(robot.description), fit_parameters(robot, np.ones((3, 3)), np.ones((3, 3)))
    rotation = robot.palm(robot.home)[:3, :3]
    wrist = np.array([0.3, 0.3, 0.6]) * (1 + shift) if sign >= 0 else np.array([0.1, 0, 0.2])
    origin = arm.shoulder + wrist - rotation @ arm.wrist_in_palm

    def rows_after(x):
        R, o = compose((ca.DM(rotation), ca.DM(origin)), exp_se3(ca.DM(x)))
        return PalmAndHand(R, o, ca.DM.zeros(HAND))

    def row(x):
        return number(reach_row(arm, range(ARM), rows_after(x), p)[0]).ravel()

    row_values = row(np.zeros(6))
    assert np.sign(row_values[0]) == sign
    slope = number(reach_row(arm, range(ARM), rows_after(np.zeros(6)), p)[1])
    np.testing.assert_allclose(slope, differences(row, np.zeros(6)), atol=1e-7)
    assert np.any(slope) == (sign != 0)


def test_numeric_arm_starts_are_sorted_by_distance(robot):
    start = nearest_start(robot.description)
    palm = robot.palm(robot.home)
    previous, distances, arms = -1.0, [], []
    for _ in range(NUMERIC_ARM_PARAMETERS.table_size):
        arm, previous = start(palm[:3, :3], palm[:3, 3], previous)
        distances.append(float(previous))
        arms.append(np.array(arm).ravel())
    assert np.all(np.diff(distances) > 0)
    assert len(np.unique(np.round(arms, 9), axis=0)) == NUMERIC_ARM_PARAMETERS.table_size
    # After the last one the starts repeat.
    assert float(start(palm[:3, :3], palm[:3, 3], previous)[1]) == distances[0]
    q = np.tile(robot.home, (1, 1))
    q[0, :ARM] = arms[0]
    target_pose = robot.palm(q[0])
    off = np.sum(((target_pose - palm)[:3, 3] / LENGTH) ** 2) + np.sum(
        (target_pose - palm)[:3, :3] ** 2
    )
    assert distances[0] == pytest.approx(off, abs=1e-9)


def test_solve_tries_all_numeric_arm_starts():
    options = HandFirstParameters()
    assert (
        options.rounds * options.candidates * NUMERIC_ARM_PARAMETERS.starts
        >= NUMERIC_ARM_PARAMETERS.table_size
    )


def test_numeric_arm_step_decreases_the_predicted_cost(robot, rng):
    q, q_target = robot.random(rng, 2)
    palm = robot.palm(np.clip(q + 0.01, robot.lower, robot.upper))
    p = fit_parameters(robot, *robot.contacts(q_target))
    target = Pose(ca.SX(palm[:3, :3]), ca.SX(palm[:3, 3]))
    trial = pose_step(robot.description, ca.SX(q[:ARM]), target, ca.SX(1e-6), p)
    cost_before, cost_after = (
        np.sum(number(r) ** 2) for r in (trial.residual_before, trial.residual)
    )
    assert cost_after < 0.01 * cost_before
    assert cost_before - cost_after == pytest.approx(
        float(number(trial.predicted_decrease)[0, 0]), rel=0.05
    )


def test_within_tolerance_compares_the_angle():
    tolerances = ca.DM([5e-3] * 3), chord(ca.DM([0.1] * 3))
    for angle, expected in ((0.0999, 1), (0.1001, 0)):
        residual = np.zeros(18)
        residual[3] = 4.9e-3 / LENGTH
        residual[9:12] = [np.cos(angle) - 1, np.sin(angle), 0]
        positions, chords = ROWS.errors(ca.DM(residual))
        assert float(positions[1]) == pytest.approx(4.9e-3)
        assert int(within_tolerance(positions, chords, *tolerances)) == expected
