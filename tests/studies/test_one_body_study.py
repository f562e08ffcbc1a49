"""The study of bodies runs, goes on where it was, and counts all targets of its parts."""

from __future__ import annotations

import json

import one_body


def test_the_study_writes_its_report_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(one_body, "PART", 40)
    given = ["--robots", "mobile_kuka_lwr_barrett", "--count", "60", "--free", "5", "--peers", "0"]
    given += ["--parts", str(tmp_path / "parts"), "--out", str(tmp_path)]
    one_body.main([*given, "--minutes", "0"])
    assert "0 are done so far" in (tmp_path / "report.md").read_text()
    one_body.main(given)
    found = {one["name"]: one for one in json.loads((tmp_path / "metrics.json").read_text())}
    for kind in ("random", "near limits"):
        solved = found[f"one_body/mobile_kuka_lwr_barrett/{kind}/5 mm, 3 deg/solved"]
        assert (solved["value"], solved["n"]) == (100, 60)
    assert "5 of 5" in (tmp_path / "report.md").read_text()
    done = {path: path.read_text() for path in (tmp_path / "parts").rglob("*.json")}
    one_body.main(given)
    assert {path: path.read_text() for path in done} == done
