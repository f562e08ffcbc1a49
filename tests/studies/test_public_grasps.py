"""The study of published grasps runs on a file in their layout."""

from __future__ import annotations

import json

import pytest

trimesh = pytest.importorskip("trimesh")

import public_grasps  # noqa: E402
from make_grasp_sets import made  # noqa: E402


def test_what_an_arm_and_a_table_leave_of_published_grasps(tmp_path, monkeypatch):
    written = made("dexgraspnet_shadow", tmp_path)
    trimesh.creation.box((0.8, 0.8, 1.2)).export(written.path.with_suffix(".obj"))
    monkeypatch.setattr(public_grasps, "SIZES", (0.06,))
    monkeypatch.setattr(public_grasps, "POSES", public_grasps.POSES[:1])
    given = [str(tmp_path), "--limit", "2", "--parts", str(tmp_path / "parts")]
    public_grasps.main([*given, "--out", str(tmp_path / "report")])
    (part,) = (tmp_path / "parts").rglob("*.json")
    found = json.loads(part.read_text())["found"]
    assert found["grasps"] == len(written.q)
    assert found["grasps"] >= found["reached"] >= found["table"] >= found["free"]
    assert found["free"] + sum(found["why"].values()) == found["grasps"]
    assert found["found"] == 2
    (metric,) = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert metric["value"] == 100
