"""The study of grasps of surfaces runs, goes on where it was, and its own checks can fail."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("trimesh")

import touch

import casadi_ik as ik

ACROSS = np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
"""Two opposite points of a ball of 30 mm [m]."""


def test_every_pose_rests_on_the_table():
    surface = ik.load_surface("sugar_box")
    ups = []
    for number in range(len(touch.POSES)):
        pose = touch.placed(surface, number)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert (surface.points @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() == pytest.approx(0.002)
        ups.append(np.abs(pose[2, :3]).argmax())
    assert sorted(ups) == [0, 1, 2]


def test_non_opposing_contacts_do_not_close():
    assert touch.closes(ACROSS, -ACROSS / 0.03, 0.03)
    side_normals = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert not touch.closes(ACROSS, side_normals, 0.03)
    assert not touch.closes(ACROSS[:1], -ACROSS[:1] / 0.03, 0.03)
