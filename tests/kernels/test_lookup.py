"""Nearest rows: against plain sorting, with ties, unknown entries and odd table sizes."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import LookupKernel
from casadi_ik.kernels.lookup import LARGEST, STEPS

from .graphs import needs_compiler

BOTH = pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])


def identity(size: int) -> ca.Function:
    x = ca.SX.sym("x", size)
    return ca.Function(f"identity_{size}", [x], [x])


def sorted_rows(table, keys, count):
    """Exact integers and a stable sort."""
    rounded = [np.rint(x * STEPS).clip(-LARGEST, LARGEST) for x in (table, np.nan_to_num(keys))]
    steps, wanted = (x.astype(np.int64) for x in rounded)
    apart = np.where(np.isnan(keys)[:, None], 0, steps[None] - wanted[:, None])
    return (apart**2).sum(axis=2).argsort(axis=1, kind="stable")[:, :count]


@BOTH
@pytest.mark.parametrize(("rows", "size"), [(1, 2), (16, 3), (37, 2), (300, 7)])
def test_nearest_in_order(compiled, rows, size, rng):
    """Coarse entries, so that many rows are equally near."""
    table, keys = rng.integers(-9, 10, (rows, size)) / 4, rng.normal(size=(40, size)) * 3
    keys[::3, 0] = np.nan
    keys[5] = 100.0
    lookup = LookupKernel(identity(size), [table], compiled)
    assert lookup.compiled == compiled
    count = min(rows, 20)
    np.testing.assert_array_equal(lookup(count, keys), sorted_rows(table, keys, count))
    np.testing.assert_array_equal(lookup(1, keys)[:, 0], sorted_rows(table, keys, 1)[:, 0])


@BOTH
def test_nothing_known_takes_the_first(compiled, rng):
    lookup = LookupKernel(identity(3), [rng.normal(size=(30, 3))], compiled)
    np.testing.assert_array_equal(lookup(4, np.full((2, 3), np.nan)), [[0, 1, 2, 3]] * 2)


@BOTH
def test_no_samples_and_wrong_inputs(compiled, rng):
    lookup = LookupKernel(identity(3), [rng.normal(size=(30, 3))], compiled)
    assert lookup(4, np.zeros((0, 3))).shape == (0, 4)
    with pytest.raises(ik.errors.InputError, match="expected"):
        lookup(4, np.zeros((2, 2)))
