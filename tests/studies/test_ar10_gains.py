"""The gain study writes its report from a few goals, and the committed one is from many."""

from __future__ import annotations

import re
from pathlib import Path

from processes import python

STUDIES = Path(__file__).parents[2] / "studies"


def test_the_study_runs_and_says_what_the_committed_report_says(tmp_path):
    run = python(STUDIES / "ar10_gains.py", "--goals", "4", "--out", tmp_path)
    assert run.returncode == 0, run.stderr
    figures = {"index_pose.png", "relative_pose.png", "offsets.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"report.md", *figures}
    small = (tmp_path / "report.md").read_text()
    committed = (STUDIES / "results" / "ar10_gains" / "report.md").read_text()
    assert "--goals 200" in committed
    assert set(re.findall(r"\(([a-z_]+\.png)\)", committed)) == figures
    # What does not depend on the number of goals is the same.
    rates = re.findall(r"^\| [\d.]+ \| [\d.]+ \| (?:0[\d.]+|infinite) \|", committed, re.MULTILINE)
    assert len(rates) == 7
    assert all(rate in small for rate in rates)
