"""A small slice of the study of collisions."""

from __future__ import annotations

import json
from pathlib import Path

import collision
import pytest
from collision_study import search


def test_check_is_never_free_where_others_penetrate():
    rows, sentence = collision.check(60, 32, 0)
    assert [row[0] for row in rows] == ["random", "free"]
    assert "1 um: **0**" in sentence
    part = collision.Part("coal", search.Piece(collision.ROBOT, 0, 0, 0, 0), 60)
    result = collision.solve(part)
    assert result["checked"] == 60
    assert 0 < result["free"] < 60
    assert result["others"] == 1
    assert result["falsely_free"] == 0


def test_the_choice_is_measured_and_resumed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(collision, "CLUTTER", (3,))
    monkeypatch.setattr(search, "TURNS", 2)
    monkeypatch.setattr(search, "BATCH", 4)
    words = ["--robot", "kuka_lwr_barrett", "--checked", "60", "--timed", "32", "--count", "1"]
    words += ["--searched", "64", "--out", str(tmp_path / "out")]
    words += ["--report", str(tmp_path / "report")]
    collision.main(words)
    (path,) = (tmp_path / "out" / "choice").glob("kuka*.json")
    targets = json.loads(path.read_text())["found"]["targets"]
    assert targets
    assert not any(target["false"] for target in targets)
    written = path.stat().st_mtime_ns
    collision.main(words)
    assert path.stat().st_mtime_ns == written
    names = [
        entry["name"] for entry in json.loads((tmp_path / "report" / "metrics.json").read_text())
    ]
    assert "collision/kuka_lwr_barrett/3/found" in names
