"""The benchmark measures another checkout by turns, and every part runs."""

from __future__ import annotations

import re
from pathlib import Path

import bench
import bench_parts
import pytest

import casadi_ik as ik

ROOT = Path(ik.__file__).parents[1]
CASES = (
    ("batch", "kuka_lwr_barrett", "limits", "5mm", 16),
    ("fast", "kuka_lwr_barrett", 16),
    ("single", "kuka_lwr_barrett", 4),
    ("follow", "kuka_lwr_barrett"),
    ("diagnosis", "kuka_lwr_barrett", "far", 4),
    ("methods", "kuka_lwr_barrett", "thumb-first", ""),
    ("threads", "kuka_lwr_barrett", 16),
    ("memory", "kuka_lwr_barrett", 100),
    ("many", "kuka_lwr_barrett", 60),
    ("logs", "kuka_lwr_barrett", "hand-first", "lz4", 24),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0])
def test_every_part_is_measured(case):
    assert case[0] in bench_parts.CASES
    found = bench_parts.MEASUREMENTS[case[0]](*case[1:])()
    assert all(value >= 0 for value in found.values())
    assert found.get("missed", 0) == 0


def test_two_checkouts_by_turns(tmp_path):
    asked = ["--part", "batch", "--robots", "ar10", "--count", "16", "--turns", "2"]
    bench.main([*asked, "--against", str(ROOT), "--report", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    rows = re.findall(r"^\| batch \| ar10 \| \w+ \S+ 16 \| us \| (.*) \|$", text, re.MULTILINE)
    assert len(rows) == 4
    assert all(float(cell) > 0 for row in rows for cell in row.split(" | "))
    assert "--against" in text
