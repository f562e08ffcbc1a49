"""The z-buffer against a plain loop over pixels and triangles."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_ik.views import rasterizer
from casadi_ik.views.rasterizer import corner_weights, rasterize


def by_hand(corners, width, height):
    """Nearest triangle and depth at every pixel centre, one at a time."""
    face = np.full((height, width), -1)
    depth = np.full((height, width), np.inf)
    for index, triangle in enumerate(corners):
        matrix = np.vstack([triangle[:, :2].T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        for row in range(height):
            for column in range(width):
                weights = np.linalg.solve(matrix, [column + 0.5, row + 0.5, 1.0])
                z = weights @ triangle[:, 2]
                if weights.min() >= 0 and z < depth[row, column]:
                    face[row, column], depth[row, column] = index, z
    return face, depth


@pytest.mark.parametrize("seed", range(4))
def test_equals_a_loop_over_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform([-6, -6, 0], [26, 21, 5], (12, 3, 3))
    face, depth = rasterize(corners, (20, 15))
    expected_face, expected_depth = by_hand(corners, 20, 15)
    assert (expected_face >= 0).mean() > 0.3
    assert np.array_equal(face, expected_face)
    np.testing.assert_allclose(depth, expected_depth, atol=1e-9)


def test_works_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = np.random.default_rng(5).uniform([-5, -5, 0], [45, 45, 5], (30, 3, 3))
    whole = rasterize(corners, (40, 40))
    monkeypatch.setattr(rasterizer, "FRAGMENTS", 97)
    pieces = rasterize(corners, (40, 40))
    assert np.array_equal(whole[0], pieces[0])
    assert np.array_equal(whole[1], pieces[1])


def test_neighbours_leave_no_gap() -> None:
    a, b, c, d = [2.3, 1.1, 0], [17.8, 3.2, 0], [15.1, 18.4, 0], [1.2, 16.6, 0]
    face, _ = rasterize(np.array([[a, b, c], [a, c, d]], dtype=float), (20, 20))
    for row in face:
        columns = np.flatnonzero(row >= 0)
        if len(columns):
            assert np.array_equal(columns, np.arange(columns[0], columns[-1] + 1))


def test_seen_edge_on_or_out_of_the_image_is_not_seen() -> None:
    flat = [[1, 1, 0], [5, 5, 0], [9, 9, 3]]
    beyond = [[30, 1, 0], [35, 1, 0], [30, 9, 0]]
    face, depth = rasterize(np.array([flat, beyond], dtype=float), (10, 10))
    assert (face == -1).all()
    assert np.isinf(depth).all()


def test_nothing_to_draw() -> None:
    face, _ = rasterize(np.zeros((0, 3, 3)), (4, 3))
    assert face.shape == (3, 4)
    assert (face == -1).all()


def test_weights_give_back_the_place() -> None:
    corners = np.array([[[0, 0, 1], [10, 1, 2], [3, 12, 5]]], dtype=float)
    face, depth = rasterize(corners, (12, 12))
    rows, columns = np.nonzero(face >= 0)
    weights = corner_weights(corners, face[rows, columns], rows, columns)
    place = weights @ corners[0]
    np.testing.assert_allclose(place[:, 0], columns + 0.5)
    np.testing.assert_allclose(place[:, 1], rows + 0.5)
    np.testing.assert_allclose(place[:, 2], depth[rows, columns])
