"""A small slice of the study of fingertip positions as targets."""

from __future__ import annotations

from pathlib import Path

import teleoperation


def test_one_path(tmp_path: Path) -> None:
    words = ["--paths", "1", "--peer-paths", "1", "--count", "160", "--robots", "kuka_lwr_barrett"]
    teleoperation.main([*words, "--report", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    assert "## Beside dex-retargeting" in text
    assert "770 to 980 us" in text
    rows = [
        line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| kuka_lwr_barrett")
    ]
    assert [row[1].strip() for row in rows] == ["no", "yes"]
    for row in rows:
        assert float(row[4]) == 100
        assert 0 < float(row[6]) <= 1.001
