"""Every study runs on a few targets, writes its report, and keeps what an earlier run finished."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("usual_flags")

ROBOT = "kuka_lwr_barrett"
RESUMED = "--out {0}/parts --report {0}/report"
PARTS = "--parts {0}/parts --out {0}/report"

STUDIES = {
    "ar10_gains": ("--goals 4 --out {0}/report", {}),
    "calibration": ("--hands 2 --outliers 0.2 0.4 --poses 15 --out {0}/report", {}),
    "closed_chain_singularities": ("--count 30 --near 100 --out {0}", {}),
    "closed_chain_workspace": ("--count 30 --palms 12 --grasp mug --out {0}", {}),
    "virtual_joint_range": ("--count 30 --steps 8 --out {0}", {}),
    "misses": (
        f"--robots {ROBOT} --tolerance default --sampler random palms noise limits --fingers all 2 "
        f"--count 30 --noise 6 3 --looked 1 --ratio {RESUMED}",
        {},
    ),
    "one_body": (
        f"--robots mobile_{ROBOT} --count 20 --free 2 --peers 0 --searched 2 --beyond 1 {PARTS}",
        {
            f"one_body/mobile_{ROBOT}/{kind}/5 mm, 3 deg/solved": (100, 20)
            for kind in ("random", "near limits")
        },
    ),
    "teleoperation": (
        f"--paths 1 --peer-paths 1 --count 160 --robots {ROBOT} --report {{0}}/report",
        {},
    ),
    "touch": (
        f"--robots panda+panda_hand --objects golf_ball --limit 3 {PARTS}",
        {f"touch/panda+panda_hand/{name}": (100, None) for name in ("confirmed", "closed")},
    ),
    "touch_hold": (
        "--robots panda+panda_hand --objects tennis_ball sugar_box --limit 6 --best 3 --samples 1 "
        "--out {0}/report",
        {"touch_hold/panda+panda_hand/held": (None, 6)},
    ),
}
"""Command line of each study, and the values and counts of some of its metrics."""


@pytest.mark.parametrize("name", STUDIES)
def test_a_small_run_writes_the_report_and_is_resumed(name: str, tmp_path: Path) -> None:
    words, expected = STUDIES[name]
    study = importlib.import_module(name)
    study.main(words.format(tmp_path).split())
    (report,) = [path for path in tmp_path.rglob("*.md") if path.name in ("report.md", "README.md")]
    text = report.read_text()
    assert f"studies/{name}.py" in text, "the command that made it"
    assert all(line.count(" | ") < 8 for line in text.splitlines()), "at most eight columns"
    pictures = re.findall(r"\(([a-z_]+\.png)\)", text)
    assert all((report.parent / picture).stat().st_size > 1000 for picture in pictures)
    metrics = report.with_name("metrics.json")
    entries = (
        {entry["name"]: entry for entry in json.loads(metrics.read_text())} if expected else {}
    )
    for metric, (value, count) in expected.items():
        assert value is None or entries[metric]["value"] == value
        assert count is None or entries[metric]["n"] == count
    parts = {path: path.stat().st_mtime_ns for path in tmp_path.glob("parts/**/*.json")}
    if parts:
        study.main(words.format(tmp_path).split())
        assert {path: path.stat().st_mtime_ns for path in parts} == parts
