"""Solvers as layers of PyTorch and of JAX: answers forward, `Solver.sensitivity` backward.

    layer = torch_layer(solver)
    q, solved = layer(points, normals)
    loss(q[solved]).backward()

Points and normals have the shape (..., f, 3), fingers in `robot.fingers` order, NaN where free;
q (..., n) and whether it is solved (...). Of what is not solved the derivative is zero.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.errors import MissingExtraError
from casadi_ik.files.arrays import Array


def torch_layer(solver: Solver, **options: Any) -> Callable[[Any, Any], tuple[Any, Any]]:
    """``layer(points, normals) -> (q, solved)`` on tensors, by a `torch.autograd.Function`.

    Args:
        solver: Solves in double precision on the CPU, whatever the tensors are.
        options: Of `Solver.solve_batch`: `q0`, `seed`, `jobs`, `prefer`.

    Raises:
        MissingExtraError: PyTorch is not installed.
    """
    torch = _extra("torch")

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
            given = (each.numpy(force=True) for each in (*ctx.saved_tensors, gradients[0]))
            return tuple(torch.from_numpy(one).to(gradients[0]) for one in _rates(solver, *given))

    return Solve.apply


def jax_layer(
    solver: Solver, reverse_only: bool = False, **options: Any
) -> Callable[[Any, Any], tuple[Any, Any]]:
    """``layer(points, normals) -> (q, solved)`` on arrays of JAX, by a `jax.custom_jvp`.

    It can be compiled, mapped (`jax.vmap`) and differentiated in both directions; either takes all
    derivatives of q, as many calls of `Solver.sensitivity` with a gradient as there are motors.
    JAX computes in single precision unless `jax_enable_x64` is set.

    Args:
        solver: As for `torch_layer`.
        reverse_only: Whether to make a `jax.custom_vjp`: `jax.grad` then asks for the gradient
            alone, a few per cent of the solve, and there is no forward mode.
        options: As for `torch_layer`.

    Raises:
        MissingExtraError: JAX is not installed.
    """
    jax = _extra("jax")
    n = len(solver.robot.actuators)

    def outside(compute: Callable[..., Any], shapes: Any, *arrays: Any) -> Any:
        def called(*given: Any) -> Any:
            found = compute(*map(np.asarray, given))
            return tuple(each.astype(s.dtype) for each, s in zip(found, shapes, strict=True))

        return jax.pure_callback(called, shapes, *arrays, vmap_method="broadcast_all")

    def shape(like: Any, *size: int, dtype: Any = None) -> Any:
        return jax.ShapeDtypeStruct((*like.shape[:-2], *size), dtype or like.dtype)

    def solve(points: Any, normals: Any) -> Any:
        shapes = shape(points, n), shape(points, dtype=bool)
        return outside(lambda *given: _solve(solver, options, *given), shapes, points, normals)

    def forward(points: Any, normals: Any) -> Any:
        found = solve(points, normals)
        return found, (points, normals, *found)

    def backward(saved: Any, gradients: Any) -> Any:
        shapes = (shape(saved[0], *saved[0].shape[-2:]),) * 2
        return outside(lambda *given: _rates(solver, *given), shapes, *saved, gradients[0])

    if reverse_only:
        reverse = jax.custom_vjp(solve)
        reverse.defvjp(forward, backward)
        return reverse
    layer = jax.custom_jvp(solve)

    @layer.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        q, solved = layer(*primals)
        shapes = (shape(primals[0], n, *primals[0].shape[-2:]),) * 2
        rates = outside(lambda *given: _rates(solver, *given), shapes, *primals, q, solved)
        moved = (
            jax.numpy.einsum("...nfi,...fi->...n", *pair)
            for pair in zip(rates, tangents, strict=True)
        )
        return (q, solved), (sum(moved), np.zeros(solved.shape, jax.dtypes.float0))

    return layer


def _extra(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(f"{name} is missing: pip install 'casadi-ik[{name}]'") from error


def _solve(solver: Solver, options: Any, points: Array, normals: Array) -> tuple[Any, Any]:
    """Answers (..., n) and whether they are solved (...)."""
    lead, size = points.shape[:-2], (-1, *points.shape[-2:])
    flat = points.reshape(size).astype(float), normals.reshape(size).astype(float)
    found = solver.solve_batch(*flat, **options)
    return found.q.reshape(*lead, -1), found.success.reshape(lead)


def _rates(
    solver: Solver,
    points: Array,
    normals: Array,
    q: Array,
    solved: Array,
    gradient: Array | None = None,
) -> list[Array]:
    """Derivatives by points and by normals, see `Solver.sensitivity`; 0 where it is not solved."""
    given = (q, points, normals) if gradient is None else (q, points, normals, gradient)
    rows, lead = np.flatnonzero(solved), solved.ndim
    some = (each.reshape(-1, *each.shape[lead:])[rows].astype(float) for each in given)
    found = solver.sensitivity(*some)
    size = (*q.shape[lead:], *points.shape[lead:]) if gradient is None else points.shape[lead:]
    every = [np.zeros((solved.size, *size)) for _ in range(2)]
    every[0][rows], every[1][rows] = found.points, found.normals
    return [each.reshape(*solved.shape, *size) for each in every]
