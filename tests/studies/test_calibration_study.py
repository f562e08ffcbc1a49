"""The calibration study writes its report, and the committed one says that the bars are true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from processes import python

pytestmark = pytest.mark.usefixtures("usual_flags")

STUDIES = Path(__file__).parents[2] / "studies"
MORE = ("--outliers", "0.2", "0.4", "--poses", "15")


def coverages(report: str) -> list[float]:
    """What the 95 % intervals held, of every loss and part of outliers [%]."""
    rows = re.findall(r"^\| \d+ % \| \w+ \| ([\d.]+) % \|", report, re.MULTILINE)
    return [float(row) for row in rows]


def test_the_study_runs(tmp_path):
    run = python(STUDIES / "calibration.py", "--hands", "2", *MORE, "--out", tmp_path)
    assert run.returncode == 0, run.stderr
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"report.md", "error_bars.png", "singular_values.png"}
    report = (tmp_path / "report.md").read_text()
    assert len(coverages(report)) == 9
    assert [line[:6] for line in report.splitlines() if line.startswith("| 4")] == ["| 40 %"] * 3
    assert "With 20 % outliers and the Cauchy loss" in report
    assert "which 40 % of outliers" in report


def test_the_committed_report_is_of_many_hands_and_its_bars_are_true():
    committed = (STUDIES / "results" / "calibration" / "report.md").read_text()
    assert "--hands 150" in committed
    held = coverages(committed)
    assert len(held) == 9
    assert all(93 < percent < 97 for percent in held)
