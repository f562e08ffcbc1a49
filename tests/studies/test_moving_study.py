"""A small slice of the study of moving targets."""

from __future__ import annotations

import json

import moving
import pytest


def test_stored_path_is_not_recomputed(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(moving, "STEPS", 200)
    monkeypatch.setattr(moving, "WAIT", 50)
    folder, report = tmp_path / "done", tmp_path / "report"
    words = ["--robots", "kuka_lwr_barrett", "--tracks", "1", "--folder", str(folder)]
    words += ["--report", str(report)]
    moving.main(["--count", "1", *words])
    (first,) = (folder / "kuka_lwr_barrett").glob("path_*.json")
    stored = json.loads(first.read_text())
    for path in ("smooth", "leaping"):
        assert stored["found"][f"{path}_velocity"] <= 1 + 1e-6
        assert stored["found"][f"{path}_acceleration"] <= 1 + 1e-6
    assert stored["found"]["met"] == 1
    stored["found"] |= {"met": 0.5, "median": 77.0}
    first.write_text(json.dumps(stored))
    moving.main(["--count", "2", *words])
    assert json.loads(first.read_text())["found"]["median"] == 77
    text = (report / "report.md").read_text()
    assert "| kuka_lwr_barrett | 2 | 1 | 75.00 |" in text
    assert "| kuka_lwr_barrett | 0 | - | 100.0 | 0 | no | 100.0 | 100.0 |" in text
    assert len(json.loads((report / "metrics.json").read_text())) == 5
