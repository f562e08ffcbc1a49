"""A small slice of the study of moving targets."""

from __future__ import annotations

import json

import moving
import pytest


def test_two_paths_and_what_is_done_stays_done(tmp_path, monkeypatch: pytest.MonkeyPatch):
    folder, report = tmp_path / "done", tmp_path / "report"
    words = ["--robots", "kuka_lwr_barrett", "--tracks", "1", "--folder", str(folder)]
    words += ["--report", str(report)]
    monkeypatch.setattr("moving_study.one_path.STEPS", 200)
    monkeypatch.setattr("moving_study.one_path.WAIT", 50)
    monkeypatch.setattr("moving_study.lost.STEPS", 200)
    monkeypatch.setattr("moving_study.choosing.CANDIDATES", 2)
    monkeypatch.setattr("moving_study.choosing.RUNS", 1)
    monkeypatch.setattr(moving, "STEPS", 200)
    moving.main(["--count", "1", *words])
    (first,) = sorted((folder / "kuka_lwr_barrett").glob("0*.json"))
    row = json.loads(first.read_text())
    for what in ("smooth", "leaping"):
        assert row[f"{what}_velocity"] <= 1 + 1e-6
        assert row[f"{what}_acceleration"] <= 1 + 1e-6
    assert row["met"] == 1
    first.write_text(json.dumps(row | {"met": 0.5, "median": 77.0}))
    moving.main(["--count", "2", *words])
    assert json.loads(first.read_text())["median"] == 77
    text = (report / "report.md").read_text()
    assert "| kuka_lwr_barrett | 2 | 1 | 75.00 |" in text
    assert "| kuka_lwr_barrett | 0 | - | 100.0 | 0 | no | 100.0 | 100.0 |" in text
    goals = [line for line in text.split("## Goals")[1].splitlines() if "kuka_lwr" in line]
    assert len(goals) == 8
    assert "| within tolerance where reachable | kuka_lwr_barrett | 1 of 2 paths | no |" in text
    assert len(json.loads((report / "metrics.json").read_text())) == 5
