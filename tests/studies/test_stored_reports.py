"""The stored reports state what the documentation says of them."""

from __future__ import annotations

import json
import re

import pytest
from processes import ROOT

RESULTS = ROOT / "studies" / "results"


def report(name: str) -> str:
    """Return the stored report of a study."""
    return (RESULTS / name / "report.md").read_text(encoding="utf-8")


def test_error_bars_of_the_calibration_are_true_for_many_hands():
    """The intervals of 95 % contain the true value about that often."""
    rows = re.findall(r"^\| \d+ % \| \w+ \| ([\d.]+) % \|", report("calibration"), re.MULTILINE)
    assert "--hands 150" in report("calibration")
    assert len(rows) == 9
    assert all(93 < float(percent) < 97 for percent in rows)


def test_diagnosis_of_many_targets_has_no_false_alarm():
    rows = re.findall(
        r"\| ([\d,]+) \| [\d,]+ \| \d+ \| (\d+) \| (\d+) \|$", report("diagnosis"), re.M
    )
    assert sum(int(count.replace(",", "")) for count, _, _ in rows) >= 11_200
    assert {false_alarms for _, _, false_alarms in rows} == {"0"}


@pytest.mark.parametrize("folder", ["touch_hold", "touch_hold_ycb"])
def test_strength_of_grasps_predicts_the_load(folder):
    """Area under the curve, and the share of held grasps among the best third."""
    entries = json.loads((RESULTS / folder / "metrics.json").read_text(encoding="utf-8"))
    values = {entry["name"]: entry["value"] for entry in entries}
    areas = [value for name, value in values.items() if name.endswith("/auc")]
    assert len(areas) >= 5
    assert min(areas) >= 0.88
    assert min(value for name, value in values.items() if name.endswith("/best_third")) >= 90
