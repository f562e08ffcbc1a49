"""The calibration study writes its report, and the committed one says that the bars are true."""

from __future__ import annotations

import re

from processes import ROOT

STUDIES = ROOT / "studies"


def coverages(report: str) -> list[float]:
    """Return the coverage of the 95 % intervals by loss and share of outliers [%]."""
    rows = re.findall(r"^\| \d+ % \| \w+ \| ([\d.]+) % \|", report, re.MULTILINE)
    return [float(row) for row in rows]


def test_stored_report_covers_many_hands_with_true_bars():
    committed = (STUDIES / "results" / "calibration" / "report.md").read_text()
    assert "--hands 150" in committed
    coverage = coverages(committed)
    assert len(coverage) == 9
    assert all(93 < percent < 97 for percent in coverage)
