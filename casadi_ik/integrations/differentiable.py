"""Solvers as layers of PyTorch and JAX: solutions forward, `Solver.sensitivity` backward.

    layer = torch_layer(solver)
    q, solved = layer(points, normals)
    loss(q[solved]).backward()

Points and normals have the shape (..., f, 3), fingers in the order of `robot.fingers`, NaN where
free; q has the shape (..., n), solved (...). Derivatives of unsolved targets are zero.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.errors import optional_import
from casadi_ik.files.arrays import Array


def torch_layer(solver: Solver, **options: Any) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Return ``layer(points, normals) -> (q, solved)`` on tensors, a `torch.autograd.Function`.

    Args:
        solver: The solver; it works in double precision on the CPU for all tensors.
        options: Options of `Solver.solve_batch`: `q0`, `seed`, `jobs`, `prefer`.

    Raises:
        MissingExtraError: PyTorch is not installed.
    """
    torch = _import_extra("torch")

    class Solve(torch.autograd.Function):
        @staticmethod
        def forward(points: Any, normals: Any) -> tuple[Any, Any]:
            q, solved = _solve(solver, options, points.numpy(force=True), normals.numpy(force=True))
            return torch.from_numpy(q).to(points), torch.from_numpy(solved).to(points.device)

        @staticmethod
        def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
            ctx.mark_non_differentiable(output[1])
            ctx.save_for_backward(*inputs, *output)

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> tuple[Any, ...]:
            arrays = (tensor.numpy(force=True) for tensor in (*ctx.saved_tensors, gradients[0]))
            return tuple(
                torch.from_numpy(rates).to(gradients[0]) for rates in _rates(solver, *arrays)
            )

    return Solve.apply


def jax_layer(
    solver: Solver, reverse_only: bool = False, **options: Any
) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Return ``layer(points, normals) -> (q, solved)`` on JAX arrays, a `jax.custom_jvp`.

    The layer can be compiled, mapped (`jax.vmap`) and differentiated in both modes; each computes
    the full Jacobian of q, which costs one call of `Solver.sensitivity` with a gradient per motor.
    JAX computes in single precision unless `jax_enable_x64` is set.

    Args:
        solver: See `torch_layer`.
        reverse_only: Return a `jax.custom_vjp`: `jax.grad` computes only the gradient, which costs
            a few per cent of the solve; forward mode is not available.
        options: See `torch_layer`.

    Raises:
        MissingExtraError: JAX is not installed.
    """
    jax = _import_extra("jax")
    n = len(solver.robot.actuators)

    def host_call(compute: Callable[..., Any], shapes: Any, *arrays: Any) -> Any:
        def compute_arrays(*arrays: Any) -> Any:
            results = compute(*map(np.asarray, arrays))
            return tuple(result.astype(s.dtype) for result, s in zip(results, shapes, strict=True))

        return jax.pure_callback(compute_arrays, shapes, *arrays, vmap_method="broadcast_all")

    def shape(reference: Any, *size: int, dtype: Any = None) -> Any:
        return jax.ShapeDtypeStruct((*reference.shape[:-2], *size), dtype or reference.dtype)

    def solve(points: Any, normals: Any) -> Any:
        shapes = shape(points, n), shape(points, dtype=bool)
        return host_call(lambda *arrays: _solve(solver, options, *arrays), shapes, points, normals)

    def forward(points: Any, normals: Any) -> Any:
        results = solve(points, normals)
        return results, (points, normals, *results)

    def backward(residuals: Any, gradients: Any) -> Any:
        shapes = (shape(residuals[0], *residuals[0].shape[-2:]),) * 2
        return host_call(lambda *arrays: _rates(solver, *arrays), shapes, *residuals, gradients[0])

    if reverse_only:
        reverse = jax.custom_vjp(solve)
        reverse.defvjp(forward, backward)
        return reverse
    layer = jax.custom_jvp(solve)

    @layer.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        q, solved = layer(*primals)
        shapes = (shape(primals[0], n, *primals[0].shape[-2:]),) * 2
        rates = host_call(lambda *arrays: _rates(solver, *arrays), shapes, *primals, q, solved)
        tangent_parts = (
            jax.numpy.einsum("...nfi,...fi->...n", *pair)
            for pair in zip(rates, tangents, strict=True)
        )
        return (q, solved), (sum(tangent_parts), np.zeros(solved.shape, jax.dtypes.float0))

    return layer


def _import_extra(name: str) -> Any:
    with optional_import("integrations.differentiable"):
        return import_module(name)


def _solve(solver: Solver, options: Any, points: Array, normals: Array) -> tuple[Any, Any]:
    """Return solutions (..., n), and whether each target is solved (...)."""
    batch_shape, size = points.shape[:-2], (-1, *points.shape[-2:])
    flat_targets = points.reshape(size).astype(float), normals.reshape(size).astype(float)
    solution = solver.solve_batch(*flat_targets, **options)
    return solution.q.reshape(*batch_shape, -1), solution.success.reshape(batch_shape)


def _rates(
    solver: Solver,
    points: Array,
    normals: Array,
    q: Array,
    solved: Array,
    gradient: Array | None = None,
) -> list[Array]:
    """Return derivatives by points and normals; 0 for unsolved targets."""
    arguments = (q, points, normals) if gradient is None else (q, points, normals, gradient)
    rows, batch_ndim = np.flatnonzero(solved), solved.ndim
    solved_arguments = (
        array.reshape(-1, *array.shape[batch_ndim:])[rows].astype(float) for array in arguments
    )
    sensitivity = solver.sensitivity(*solved_arguments)
    size = (
        (*q.shape[batch_ndim:], *points.shape[batch_ndim:])
        if gradient is None
        else points.shape[batch_ndim:]
    )
    rates = [np.zeros((solved.size, *size)) for _ in range(2)]
    rates[0][rows], rates[1][rows] = sensitivity.points, sensitivity.normals
    return [array.reshape(*solved.shape, *size) for array in rates]
