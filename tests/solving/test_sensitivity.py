"""Derivatives of answers compared with answers of nearby targets in numpy; the layers."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import errors
from casadi_ik.integrations import differentiable

STEP = 1e-5


def jacobian(robot, q, known_rows):
    """Return constrained rows of points [0.1 m] and normals, by central differences."""
    columns = []
    for motor in range(len(q)):
        ends = [robot.contacts(q + side * 1e-6 * np.eye(len(q))[motor]) for side in (1, -1)]
        slopes = [(high - low)[known_rows] / 2e-6 for high, low in zip(*ends, strict=True)]
        columns.append(np.concatenate([slopes[0].ravel() / 0.1, slopes[1].ravel()]))
    return np.stack(columns, axis=1)


def answer(robot, q, free, known_rows, points, normals, scales):
    """Return the nearest answer by Newton's method over movable motors, in units of scales."""
    for _ in range(12):
        at = robot.contacts(q)
        left = np.concatenate(
            [((at[0] - points) / 0.1)[known_rows].ravel(), (at[1] - normals)[known_rows].ravel()]
        )
        step = (
            scales
            * free
            * (np.linalg.pinv(jacobian(robot, q, known_rows) * scales * free, rcond=1e-5) @ -left)
        )
        q = q + step
    return q


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "ar10"])
@pytest.mark.parametrize("case", ["inside", "at limits", "a finger left out"])
def test_sensitivity_matches_nearby_answers(name, case):
    robot = ik.load_robot(name)
    solver, rng = ik.Solver(robot), np.random.default_rng(3)
    k, n, f = 4, len(robot.actuators), len(robot.fingers)
    q = robot.lower + rng.uniform(0.15, 0.85, (k, n)) * (robot.upper - robot.lower)
    is_fixed = np.zeros((k, n), dtype=bool)
    if case == "at limits":
        is_fixed = rng.random((k, n)) < 0.15
        q = np.where(is_fixed, robot.upper, q)
        assert is_fixed.any()
    points, normals = robot.contacts(q)
    is_known = np.ones((f,), dtype=bool)
    if case == "a finger left out":
        is_known[-1] = False
    target_arrays = [np.where(is_known[:, None], array, np.nan) for array in (points, normals)]
    rates = solver.sensitivity(q, *target_arrays)
    assert rates.points.shape == rates.normals.shape == (k, n, f, 3)
    slider = np.array([actuator.unit != "rad" for actuator in robot.description.actuators])
    scales = np.where(slider, robot.upper - robot.lower, 1.0)
    for row in range(k):
        directions = 0.1 * rng.normal(size=(f, 3)), rng.normal(size=(f, 3))
        ends = []
        for side in (STEP, -STEP):
            facing = normals[row] + side * directions[1]
            facing /= np.linalg.norm(facing, axis=1, keepdims=True)
            shifted_target = points[row] + side * directions[0], facing
            ends.append(answer(robot, q[row], ~is_fixed[row], is_known, *shifted_target, scales))
        expected = (ends[0] - ends[1]) / (2 * STEP)
        contact_rates = (rates.points[row], rates.normals[row])
        rate = sum(
            np.einsum("nfi,fi->n", *pair) for pair in zip(contact_rates, directions, strict=True)
        )
        np.testing.assert_allclose(rate, expected, atol=2e-6 * np.abs(expected).max())
        assert (rate[is_fixed[row]] == 0).all()
        assert is_known.all() or not np.any(
            [rates_of_kind[:, -1] for rates_of_kind in contact_rates]
        )


def test_gradients_and_other_kinds(robot):
    """A gradient equals the product of all derivatives; a plane leaves motions along it free."""
    solver, rng = ik.Solver(robot), np.random.default_rng(5)
    q, gradient = robot.random(rng, 5), rng.normal(size=(5, 14))
    targets = robot.contacts(q)
    all_rates, gradient_rates = (
        solver.sensitivity(q, *targets),
        solver.sensitivity(q, *targets, gradient),
    )
    for full_rate, number in (
        (all_rates.points, gradient_rates.points),
        (all_rates.normals, gradient_rates.normals),
    ):
        np.testing.assert_allclose(np.einsum("kn,knfi->kfi", gradient, full_rate), number, 1e-6)
    planes = np.full_like(targets[0], np.nan)
    planes[:, 1] = targets[1][:, 1]
    free = solver.sensitivity(q, *targets, planes=planes)
    across = np.cross(planes[:, 1], rng.normal(size=3))
    size = np.abs(free.points[:, :, 1]).max()
    assert np.abs(np.einsum("kni,ki->kn", free.points[:, :, 1], across)).max() < 1e-9 * size


def test_bad_sensitivity_input_is_refused(robot):
    solver, q = ik.Solver(robot), robot.home[None]
    points, normals = robot.contacts(q)
    with pytest.raises(errors.InputError, match="q: found shape"):
        solver.sensitivity(robot.home, points, normals)
    with pytest.raises(errors.InputError, match=r"gradient: .*\(2,\).*\(1, 14\)"):
        solver.sensitivity(q, points, normals, [1.0, 2.0])
    with pytest.raises(errors.InputError, match="row 0, finger 0"):
        solver.sensitivity(q, np.where(np.eye(3)[:1], np.nan, points), normals)


@pytest.fixture(scope="module")
def targets(robot):
    points, normals = robot.contacts(robot.random(np.random.default_rng(2), 4))
    points[3] += 5.0  # out of reach
    return points, normals


@pytest.fixture(scope="module")
def expected(robot, targets):
    """Return answers and derivatives of the sum of their squares."""
    solver = ik.Solver(robot)
    batch = solver.solve_batch(*targets, q0=robot.home)
    rates = solver.sensitivity(batch.q, *targets, 2 * batch.q)
    solved = batch.success[:, None, None]
    return batch, rates.points * solved, rates.normals * solved


def test_torch(robot, targets, expected):
    torch = pytest.importorskip("torch")
    layer = differentiable.torch_layer(ik.Solver(robot), q0=robot.home)
    tensors = [torch.tensor(array, requires_grad=True) for array in targets]
    q, solved = layer(*tensors)
    (q**2).sum().backward()
    batch, *rates = expected
    np.testing.assert_array_equal(q.detach().numpy(), batch.q)
    assert solved.tolist() == [True] * 3 + [False]
    for tensor, rate in zip(tensors, rates, strict=True):
        np.testing.assert_allclose(tensor.grad.numpy(), rate, 1e-6)


@pytest.mark.parametrize("reverse_only", [False, True])
def test_jax(robot, targets, expected, reverse_only):
    jax = pytest.importorskip("jax")
    layer = differentiable.jax_layer(ik.Solver(robot), reverse_only, q0=robot.home)
    batch, *rates = expected

    def loss(points, normals):
        return (layer(points, normals)[0] ** 2).sum()

    with jax.enable_x64(True):
        arrays = [jax.numpy.asarray(array) for array in targets]
        np.testing.assert_array_equal(jax.jit(layer)(*arrays)[0], batch.q)
        mapped = jax.vmap(jax.grad(loss, (0, 1)))(*arrays)
        for gradients in (jax.jit(jax.grad(loss, (0, 1)))(*arrays), mapped):
            for result, rate in zip(gradients, rates, strict=True):
                np.testing.assert_allclose(result, rate, 1e-6, 1e-9)
        jacobians = [
            jacobian_mode(lambda points: layer(points, arrays[1][0])[0])(arrays[0][0])
            for jacobian_mode in (jax.jacrev if reverse_only else jax.jacfwd, jax.jacrev)
        ]
        np.testing.assert_allclose(*jacobians, 1e-6, 1e-9)
