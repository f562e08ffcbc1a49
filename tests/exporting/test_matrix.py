"""Part of `studies/export_matrix.py`: grippers, tools and hands in every export mode."""

from __future__ import annotations

import re
import shutil

import pytest
from export_matrix import Cell, run_cell

pytestmark = pytest.mark.slow

COUNT = 50
"""Targets per robot and mode; compilation takes most of the time."""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize(
    ("robot", "mode"),
    [
        ("panda+panda_hand", "scene"),
        ("xarm7+tool", "scene"),
        ("two_ur10e+tool", "single scene"),
        ("robotiq_2f85", "follow"),
    ],
)
def test_exports_compile_without_warnings_and_answer_as_python(robot, mode):
    """Exports pass under sanitizers, with warnings as errors."""
    result = run_cell(Cell(robot, mode, COUNT))
    assert result["status"] == "pass", result["message"]
    solved = re.search(r"(\d+) solved", result["message"])
    assert solved is not None
    assert int(solved[1]) > COUNT / 4  # a scene makes some of the targets impossible
