"""The study of the verdict runs and agrees with itself; the committed report is of many targets."""

from __future__ import annotations

import re

import pytest
from processes import ROOT, python

pytestmark = pytest.mark.usefixtures("usual_flags")

STUDIES = ROOT / "studies"


def test_study_is_consistent_and_stored_report_has_no_false_alarm(tmp_path):
    stored_part = tmp_path / "kept.npz"
    small = [STUDIES / "diagnosis.py", "--impossible", "3"]
    for options in (
        ["--count", "0", "--keep", stored_part, "--report", tmp_path],
        ["--count", "20", "--bad-starts", "20", "--against", stored_part, "--report", tmp_path],
    ):
        run = python(*small, *options)
        assert run.returncode == 0, run.stderr
    report = (tmp_path / "report.md").read_text()
    table = report.partition("## Against")[2]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    compared = [row for row in rows if row[0] not in ("targets", "---")]
    assert len(compared) >= 6
    assert all(row[1] == row[2] and row[5] == "1.000" and row[6] == "100" for row in compared)

    committed = (STUDIES / "results" / "diagnosis" / "report.md").read_text()
    alarms = re.findall(r"\| ([\d,]+) \| [\d,]+ \| \d+ \| (\d+) \| (\d+) \|$", committed, re.M)
    counts = [int(count.replace(",", "")) for count, _, _ in alarms]
    assert sum(counts) >= 11_200
    assert all(false_alarms == "0" for _, _, false_alarms in alarms)
