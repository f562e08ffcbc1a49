"""Collision queries of a solver with a scene, as its engine makes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import casadi_ik as ik


def query_of_grasps(solver: ik.Solver, grasps: Sequence[ik.Grasp]) -> Any:
    """Return the collision query about the targets of grasps."""
    return _query(solver, solver._target_builder.from_grasps(grasps))


def query_of_contacts(
    solver: ik.Solver,
    points: np.ndarray,
    normals: np.ndarray,
    grasped: tuple[str, np.ndarray] | None = None,
) -> Any:
    """Return the collision query about contacts (k, f, 3), with an object at poses (k, 4, 4)."""
    targets = solver._target_builder.from_arrays(points, normals)
    return _query(solver, targets if grasped is None else targets.holding(*grasped))


def query_at(solver: ik.Solver, q: np.ndarray) -> Any:
    """Return the collision query about the contacts of configurations (k, n)."""
    return query_of_contacts(solver, *solver.robot.contacts(np.atleast_2d(q)))


def _query(solver: ik.Solver, targets: object) -> Any:
    query = solver._engine.collision_query(targets)  # type: ignore[arg-type]
    assert query is not None
    return query
