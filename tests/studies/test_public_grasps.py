"""The study of published grasps runs on a file in their layout."""

from __future__ import annotations

import json

import pytest

trimesh = pytest.importorskip("trimesh")

import public_grasps  # noqa: E402
from make_grasp_sets import made  # noqa: E402


def test_published_grasps_on_an_arm_and_a_table(tmp_path, monkeypatch):
    written = made("dexgraspnet_shadow", tmp_path)
    trimesh.creation.box((0.8, 0.8, 1.2)).export(written.path.with_suffix(".obj"))
    monkeypatch.setattr(public_grasps, "SIZES", (0.06,))
    monkeypatch.setattr(public_grasps, "POSES", public_grasps.POSES[:1])
    arguments = [str(tmp_path), "--limit", "2", "--parts", str(tmp_path / "parts")]
    public_grasps.main([*arguments, "--out", str(tmp_path / "report")])
    (part,) = (tmp_path / "parts").rglob("*.json")
    report = json.loads(part.read_text())["found"]
    assert report["grasps"] == len(written.q)
    assert report["grasps"] >= report["reached"] >= report["table"] >= report["free"]
    assert report["free"] + sum(report["why"].values()) == report["grasps"]
    assert report["found"] == 2
    (metric,) = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert metric["value"] == 100
