"""A tiny slice of the study of ten million targets, killed and gone on with."""

from __future__ import annotations

import json

import numpy as np
import ten_million


def test_a_killed_run_is_gone_on_with(tmp_path):
    words = ["--count", "300", "--file", "200", "--jobs", "1", "--folder", str(tmp_path)]
    # As a study leaves it that was killed itself: one part is there, its answers are kept.
    ten_million.main(words)
    runs = json.loads((tmp_path / "runs.json").read_text())
    assert [run["killed"] for run in runs] == [False]
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| targets answered | 300 |" in text
    assert "| solved | 300 (100.0000 %) |" in text
    (tmp_path / "solved" / "part-000001.npz").unlink()
    first = tmp_path / "solved" / "part-000000.npz"
    before = first.stat().st_mtime_ns
    runs[0]["killed"] = True
    (tmp_path / "runs.json").write_text(json.dumps(runs))
    ten_million.main(words)
    assert first.stat().st_mtime_ns == before
    with np.load(tmp_path / "solved" / "part-000001.npz") as part:
        assert part["success"].all()
    assert (
        "The command ran 2 time(s), killed once" in (tmp_path / "report" / "report.md").read_text()
    )
