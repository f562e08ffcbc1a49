"""The method of docs/add_a_method.md solves, steps, runs in batches and logs."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from package_copy import blocks
from toy_robots import grasp_of, near_home

import casadi_ik as ik
from casadi_ik import errors


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Module with the lines of the page; the method is registered during these tests."""
    path = tmp_path_factory.mktemp("page") / "example_method.py"
    path.write_text("\n".join(blocks("add_a_method.md")), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("example_method", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    entries_before = dict(ik.solve.registry._ENTRIES)
    spec.loader.exec_module(module)
    yield module
    ik.solve.registry._ENTRIES.clear()
    ik.solve.registry._ENTRIES.update(entries_before)


@pytest.fixture(scope="module")
def targets(page):
    """Points and normals (8, f, 3)."""
    return page.robot.contacts(near_home(page.robot, np.random.default_rng(7), 8))


def test_added_method_solves_in_lanes(page, targets):
    kernel = page.solver._engine.method.kernel
    assert not kernel.compiled or kernel.lanes > 1
    batch = page.solver.solve_batch(*targets)
    assert batch.success.all(), batch.status_names
    assert (batch.iterations > 1).all()
    assert page.solver.parameters["options"] == {"damping": 0.2, "max_iterations": 300}


def test_added_method_is_logged_and_stepped(page, targets, tmp_path):
    points, normals = (array[0] for array in targets)
    grasp = grasp_of(page.robot, points, normals)
    solution = page.solver.solve(grasp, log=tmp_path / "x.mcap")
    assert solution.success
    rows = ik.logs.open(tmp_path / "x.mcap").iterations().rows
    assert solution.iterations == len(rows)
    assert (np.diff(rows["cost"]) < 0).all(), "every step gains"
    records = list(page.solver.stepper(grasp))
    np.testing.assert_allclose([record["q"] for record in records], rows["q"], atol=1e-9)


def test_exhausted_budget_is_a_status(page, targets):
    solver = ik.Solver(page.robot, page.DampedLeastSquares.name, options={"max_iterations": 1})
    batch = solver.solve_batch(*targets)
    late = ~batch.success  # the verdict is on where the last step led
    assert late.any()
    assert set(batch.status_names[late]) == {"ITERATION_LIMIT"}


def test_a_free_finger_is_refused_by_name(page, targets):
    points, normals = (array.copy() for array in targets)
    points[3, 1] = normals[3, 1] = np.nan
    with pytest.raises(errors.InputError, match=r"row 3 .*'damped-least-squares'"):
        page.solver.solve_batch(points, normals)


def test_method_names_are_unique(page):
    method, parameter_class = page.DampedLeastSquares, page.DampedParameters
    with pytest.raises(errors.InputError, match="name: method 'damped-least-squares'"):
        ik.register_method(method.name, "again", parameter_class, method)
    ik.register_method(method.name, "again", parameter_class, method, replace=True)
    assert ik.solve.registry.method_summary(method.name) == "again"
    assert ik.solve.registry.method_names() == (*ik.METHODS, method.name)
    with pytest.raises(errors.InputError, match="name: method 'ipopt'"):
        ik.register_method("ipopt", "mine", parameter_class, method, replace=True)
    with pytest.raises(errors.InputError, match="expected a dataclass"):
        ik.register_method("other", "mine", dict, method)
    ik.register_method("misnamed", "calls itself otherwise", parameter_class, method)
    with pytest.raises(errors.InputError, match=r"method: .*'damped-least-squares'"):
        ik.Solver(page.robot, "misnamed")
