"""Strategies, graphs as functions, and derivatives for the tests of algebra."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

PROPERTY = settings(derandomize=True, max_examples=60)

coordinate = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
unit_vectors = vectors.filter(lambda v: np.linalg.norm(v) > 0.05).map(
    lambda v: v / np.linalg.norm(v)
)
angles = st.one_of(
    st.sampled_from([0.0, 1e-200, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 0.99e-2, 1.01e-2, 0.1]),
    st.floats(0.0, np.pi - 1e-3),
    st.sampled_from([np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]),
)
rotation_vectors = st.builds(lambda angle, axis: angle * axis, angles, unit_vectors)


def graph(f, *shapes) -> ca.Function:
    """Return a Function of SX symbols; a tuple of results becomes several outputs."""
    symbols = [ca.SX.sym(f"x{i}", *shape) for i, shape in enumerate(shapes)]
    results = f(*symbols)
    results = list(results) if isinstance(results, tuple) else [results]
    assert all(r.is_dense() for r in results)
    return ca.Function("f", symbols, results)


def gradient(f, *shapes) -> ca.Function:
    """Return the Jacobian of all results of f with respect to all its arguments, by CasADi."""
    symbols = [ca.SX.sym(f"x{i}", *shape) for i, shape in enumerate(shapes)]
    results = f(*symbols)
    results = list(results) if isinstance(results, tuple) else [results]
    stacked = ca.vertcat(*[ca.vec(r) for r in results])
    arguments = ca.vertcat(*[ca.vec(x) for x in symbols])
    return ca.Function("J", symbols, [ca.densify(ca.jacobian(stacked, arguments))])


def central_difference(f: ca.Function, *arguments, step: float = 1e-6) -> np.ndarray:
    """Return the Jacobian of all outputs of f by central differences."""
    flat = np.concatenate([np.ravel(np.array(x, float), order="F") for x in arguments])

    def value(x: np.ndarray) -> np.ndarray:
        split = np.split(x, np.cumsum([np.size(a) for a in arguments])[:-1])
        inputs = [s.reshape(np.shape(a), order="F") for s, a in zip(split, arguments, strict=True)]
        results = f.call([ca.DM(i) for i in inputs])
        return np.concatenate([r.full().ravel(order="F") for r in results])

    columns = []
    for k in range(flat.size):
        offset = np.zeros_like(flat)
        offset[k] = step
        columns.append((value(flat + offset) - value(flat - offset)) / (2 * step))
    return np.stack(columns, axis=1)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a uniformly distributed rotation matrix."""
    q = rng.standard_normal(4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
