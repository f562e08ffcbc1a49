"""Grasps of surfaces are what they claim, by an independent check, and that check can fail."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("trimesh")

import touch_claims
from runner.study import standing


def test_every_claim_holds_on_a_coarse_mesh(tmp_path):
    robots = ["panda+allegro_right", "panda+leap"]
    arguments = ["--robots", *robots, "--meshes", "coarse_can", "--limit", "25"]
    touch_claims.main([*arguments, "--parts", str(tmp_path / "parts"), "--out", str(tmp_path)])
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert len(metrics) == len(robots) * len(touch_claims.CLAIMS)
    assert all(metric["n"] == 25 for metric in metrics)
    assert {metric["name"]: metric["value"] for metric in metrics} == {
        metric["name"]: 100.0 for metric in metrics
    }


def test_check_detects_another_mesh():
    surface, mesh = touch_claims.surface_of("coarse_can")
    solver, pose = touch_claims.solver_of("panda+allegro_right"), standing(surface, 0.7)
    grasp = solver.grasps_of(surface, pose, limit=1, among=1)[0]
    smaller, larger = mesh.copy(), mesh.copy()
    smaller.apply_scale(0.9)
    larger.apply_scale(1.6)
    assert touch_claims.check(solver.robot, smaller, pose, grasp)["off"]
    assert touch_claims.check(solver.robot, larger, pose, grasp)["deep"]
    turned_pose = pose.copy()
    turned_pose[:3, :3] = turned_pose[:3, :3] @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    violations = touch_claims.check(solver.robot, mesh, turned_pose, grasp)
    assert violations["leaning"]
    assert violations["outside the cone"]


def test_closure_needs_opposing_contacts():
    across = np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
    assert touch_claims.closure_margin(across, -across / 0.03, 0.03) > 1e-3
    side_normals = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert touch_claims.closure_margin(across, side_normals, 0.03) <= 1e-9
