"""Calibration: graphs, estimates, error bars, and directions that the data do not determine."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.papers.chandra.calibration import (
    LOSSES,
    Calibration,
    HandModel,
    Measurements,
    Priors,
    calibrate,
    hand_parameters,
    read_measurements,
    simulate,
    true_values,
    write_description,
    write_measurements,
)

EXACT = (1e-9, 1e-9)


@pytest.fixture(scope="module")
def index(ar10) -> HandModel:
    return HandModel(ar10.description, hand_parameters(ar10.description, ["index"]))


@pytest.fixture(scope="module")
def estimate(index) -> Calibration:
    """Return an estimate from 60 poses with outliers of a hand unlike its description."""
    rng = np.random.default_rng(3)
    data = simulate(index, true_values(index, rng), "index", 60, rng, outliers=0.1)
    return calibrate(index, data)


def point(poses):
    return np.array([np.array(dq.translation(ca.DM(pose))).ravel() for pose in poses])


def test_nominal_parameters_give_the_described_robot(ar10, index, rng):
    q = ar10.random(rng, 20)
    points, normals = ar10.contacts(q)
    poses = index.poses("index", q, index.nominal)
    finger = ar10.fingers.index("index")
    np.testing.assert_allclose(point(poses), points[:, finger], atol=1e-14)
    normal = ca.DM(ar10.description.finger("index").normal.tolist())
    rotated = [np.array(dq.rotate(ca.DM(pose), normal)).ravel() for pose in poses]
    np.testing.assert_allclose(rotated, normals[:, finger], atol=1e-14)


def test_jacobian_by_central_differences(index, ar10, rng):
    q = ar10.random(rng, 3)
    values = true_values(index, rng)
    measured = index.poses("index", q, true_values(index, rng))
    error, jacobian = index.misfit("index", q, values, measured)
    assert np.abs(error[:, :3]).max() > 1e-4
    for i, prior in enumerate(index.prior):
        offset = np.zeros_like(values)
        offset[i] = 1e-4 * prior
        ends = [index.misfit("index", q, values + s * offset, measured)[0] for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * offset[i])
        np.testing.assert_allclose(jacobian[:, :, i], difference, atol=2e-6)


def test_exact_data_are_explained_exactly(index, rng):
    """Observable parameters are recovered; unobservable ones keep their prior."""
    truth = true_values(index, rng)
    data = simulate(index, truth, "index", 50, rng, noise=EXACT)
    result = calibrate(index, data, sigma_position=1e-6, sigma_angle=1e-6)
    assert result.converged
    assert result.before[:, 0].max() > 1e-3
    assert result.after[:, 0].max() < 1e-7
    fresh = simulate(index, truth, "index", 50, rng, noise=EXACT)
    error, _ = index.misfit("index", fresh.q, result.values, fresh.poses)
    assert np.abs(error[:, :3]).max() < 1e-6
    # In observable directions, the standard deviation is that of the truth.
    strong = result.singular_values > 1e3
    x, x_true = ((v - index.nominal) / index.prior for v in (result.values, truth))
    assert strong.sum() > 15
    np.testing.assert_allclose(
        result.directions[strong] @ x, result.directions[strong] @ x_true, atol=2e-2
    )


@pytest.mark.parametrize("loss", LOSSES)
def test_error_bars_are_true(loss, index):
    """Error bars of 95 % contain the true value about that often, also with outliers."""
    within_bars, noise = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = true_values(index, rng)
        outliers = 0.1 if loss != "squares" else 0.0
        result = calibrate(
            index, simulate(index, truth, "index", 40, rng, outliers=outliers), loss=loss
        )
        assert result.converged
        within_bars.append(np.abs(result.values - truth) <= result.interval)
        noise.append(result.noise)
    assert 0.88 < np.mean(within_bars) < 0.99
    assert np.median(noise, axis=0) == pytest.approx([2e-4, np.deg2rad(0.5)], rel=0.25)


def test_outliers_are_found_and_cost_little(index):
    rng = np.random.default_rng(5)
    truth = true_values(index, rng)
    data = simulate(index, truth, "index", 60, rng)
    clean = calibrate(index, data)
    assert len(clean.outliers) == 0
    poses = data.poses.copy()
    spoilt = [4, 17, 40]
    for row in spoilt:
        shift = dq.from_translation(ca.DM([0.02, -0.03, 0.01]))
        poses[row] = np.array(dq.multiply(shift, ca.DM(poses[row]))).ravel()
    bad = Measurements(data.fingers, data.q, poses, data.has_orientation)
    robust, squares = calibrate(index, bad), calibrate(index, bad, loss="squares")
    assert robust.outliers.tolist() == spoilt
    fresh = simulate(index, truth, "index", 60, rng, noise=EXACT)

    def miss(result):
        error, _ = index.misfit("index", fresh.q, result.values, fresh.poses)
        return np.sqrt((error[:, :3] ** 2).sum(axis=1).mean())

    assert miss(robust) < 1.5 * miss(clean) < 0.3 * miss(squares)


def test_data_cannot_tell_the_size_of_a_four_bar(ar10, rng):
    """Angles determine ratios only: scaling (p, q, g, h) together changes nothing."""
    parameters = hand_parameters(ar10.description, ["index"], ["linkage"])
    model = HandModel(ar10.description, parameters)
    result = calibrate(model, simulate(model, model.nominal, "index", 40, rng))
    names = [parameter.name for parameter in parameters]
    growth = np.zeros(len(names))
    for key in "pqgh":
        i = names.index(f"index_distal.{key}")
        growth[i] = result.values[i] / model.prior[i]
    for joint in ("index_proximal", "index_middle"):
        # A triangle has an observable size, because the slider is measured in metres.
        assert result.learned[names.index(f"{joint}.c")] > 0.5
    growth /= np.linalg.norm(growth)
    unobservable = result.directions[result.singular_values < 1e-6 * result.singular_values[0]]
    assert len(unobservable) >= 1
    assert np.linalg.norm(unobservable @ growth) == pytest.approx(1, abs=1e-6)
    assert result.unknown_directions >= 1
    worst = result.unidentified()[0][1]
    assert any(name.startswith("index_distal") for name in worst)


def test_points_alone_are_enough_for_a_smaller_estimate(index, rng):
    truth = true_values(index, rng)
    data = simulate(index, truth, "index", 60, rng)
    points = Measurements(data.fingers, data.q, data.poses, np.zeros(60, dtype=bool))
    result = calibrate(index, points)
    assert result.converged
    assert np.isnan(result.noise[1])
    assert np.isnan(result.after[:, 1]).all()
    assert np.median(result.after[:, 0]) < 0.5 * np.median(result.before[:, 0])
    with_frames = calibrate(index, data)
    assert result.deviation.sum() > with_frames.deviation.sum()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_poses_keep_priors_and_assumed_noise(count, index):
    """With too few data to estimate the noise, the assumed noise is used."""
    within_bars = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = true_values(index, rng)
        data = simulate(index, truth, "index", count, rng)
        result = calibrate(index, data, sigma_position=2e-4, sigma_angle=np.deg2rad(0.5))
        assert result.converged
        assert not result.noise_estimated or count == 5
        within_bars.append(np.abs(result.values - truth) <= result.interval)
    assert 0.9 < np.mean(within_bars) < 0.99


def test_bounds_hold(index, rng):
    """With data of a very different hand, no parameter leaves three prior deviations."""
    edge_values = index.nominal + 2.9 * index.prior * np.sign(rng.standard_normal(len(index.prior)))
    result = calibrate(index, simulate(index, edge_values, "index", 60, rng))
    x = (result.values - index.nominal) / index.prior
    assert np.abs(x).max() <= 3 + 1e-9
    tight = HandModel(
        index.robot, hand_parameters(index.robot, ["index"], priors=Priors(1e-5, 1e-5, 1e-5, 1e-5))
    )
    estimate = calibrate(tight, simulate(index, edge_values, "index", 60, rng))
    assert np.abs((estimate.values - tight.nominal) / tight.prior).max() <= 3 + 1e-9


@pytest.mark.parametrize("name", ["ar10", "baxter_ar10"])
def test_the_written_description_is_the_estimated_hand(name, index, estimate, tmp_path, rng):
    path = tmp_path / "calibrated.yaml"
    write_description(estimate, name, path, "poses.csv")
    robot, described = ik.load_robot(path), ik.load_robot(name)
    assert robot.actuators == described.actuators
    assert robot.fingers == described.fingers
    model = HandModel(described.description, estimate.parameters, compiled=False)
    q = robot.random(rng, 10)
    points, _ = robot.contacts(q)
    expected = point(model.poses("index", q, estimate.values))
    np.testing.assert_allclose(points[:, robot.fingers.index("index")], expected, atol=1e-12)
    other_fingers = [i for i, finger in enumerate(robot.fingers) if finger != "index"]
    np.testing.assert_array_equal(
        points[:, other_fingers], described.contacts(q)[0][:, other_fingers]
    )
    # The strokes limit the calibrated joints, too.
    joints = robot.joints(np.linspace(robot.lower, robot.upper, 50))
    for joint in robot.description.movable:
        if joint.name.startswith("index"):
            assert joint.lower <= joints[joint.name].min()
            assert joints[joint.name].max() <= joint.upper
    assert "poses.csv" in robot.description.sources["calibration"]


def test_a_file_of_measurements_round_trip(index, ar10, tmp_path, rng):
    data = simulate(index, index.nominal, "index", 5, rng)
    measurements = Measurements(
        data.fingers, data.q, data.poses, np.array([1, 1, 0, 1, 0], dtype=bool)
    )
    write_measurements(measurements, ar10.description, tmp_path / "poses.csv")
    read = read_measurements(tmp_path / "poses.csv", ar10.description)
    assert read.fingers == measurements.fingers
    np.testing.assert_array_equal(read.has_orientation, measurements.has_orientation)
    np.testing.assert_allclose(point(read.poses), point(measurements.poses), atol=1e-15)
    np.testing.assert_allclose(read.poses[0], measurements.poses[0], atol=1e-14)
    # Actuators that do not move the finger are at home, whatever the file states.
    columns = [ar10.actuators.index(f"index_{part}_slider") for part in ("proximal", "middle")]
    np.testing.assert_array_equal(read.q[:, columns], measurements.q[:, columns])


def test_bad_arguments(ar10, index, rng):
    description = ar10.description
    with pytest.raises(ik.errors.InputError, match=r"groups:.*'screws'"):
        hand_parameters(description, ["index"], ["screws"])
    with pytest.raises(ik.errors.InputError, match="fingers: found none"):
        hand_parameters(description, [])
    with pytest.raises(ik.errors.UnknownNameError, match="no finger 'toe'"):
        hand_parameters(description, ["toe"])
    with pytest.raises(ik.errors.InputError, match=r"priors\.length: found -1"):
        Priors(length=-1)
    data = simulate(index, index.nominal, "index", 5, rng)
    with pytest.raises(ik.errors.UnknownNameError, match="loss: found 'median'"):
        calibrate(index, data, loss="median")
    with pytest.raises(ik.errors.InputError, match="sigma_position: found 0"):
        calibrate(index, data, sigma_position=0)
