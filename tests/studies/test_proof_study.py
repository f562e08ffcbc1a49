"""The study of proofs: it counts, goes on where it stopped, lists false proofs and what is left."""

from __future__ import annotations

import json

import impossible_targets
import numpy as np
import proofs


def test_counts_resume_and_false_proofs_are_listed(tmp_path, monkeypatch):
    monkeypatch.setattr(proofs, "BLOCK", 6)
    out, report = tmp_path / "out", tmp_path / "report"
    arguments = ["--robot", "ar10", "--out", str(out), "--report", str(report), "--impossible", "4"]
    proofs.main([*arguments, "--count", "6"])
    cases = [case for case in proofs.CASES if case[0] != "blind hands"]
    files = sorted((out / "ar10").glob("*.json"))
    assert len(files) == len(cases) + len(impossible_targets.CLASSES) - 2
    text = (report / "report.md").read_text()
    assert f"Of {6 * len(cases)} reachable targets, 0 are called" in text
    path = next(path for path in files if path.name.startswith("corners"))
    stored = json.loads(path.read_text())
    stored["found"]["false"] = [[0.125] * 10]
    path.write_text(json.dumps(stored))
    proofs.main([*arguments, "--count", "12"])
    assert len(list((out / "ar10").glob("*.json"))) == len(files) + len(cases)
    text = (report / "report.md").read_text()
    assert f"Of {12 * len(cases)} reachable targets, 1 are called" in text
    assert "0.125 0.125" in text


def test_every_class_makes_different_contacts(robot):
    contact_sets = []
    for name in impossible_targets.CLASSES:
        points, normals = impossible_targets.impossible(robot, name, np.random.default_rng(1), 5)
        assert points.shape == normals.shape == (5, 3, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-12)
        contact_sets.append(np.concatenate([points, normals]))
    plain = robot.contacts(robot.random(np.random.default_rng(1), 5))
    assert all(not np.allclose(item, np.concatenate(plain)) for item in contact_sets)
