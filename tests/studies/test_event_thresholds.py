"""The study of the log's events: what they catch."""

from __future__ import annotations

import re
from pathlib import Path

import event_thresholds
import numpy as np
import pytest
from event_thresholds import StoredBlocks

import casadi_ik as ik
from casadi_ik import logs


@pytest.fixture(scope="module")
def stored_blocks() -> StoredBlocks:
    robot = ik.load_robot("kuka_lwr_barrett")
    options = {"max_iterations": 300}
    solver = ik.Solver(robot, "enhanced-dls", finger_step="closed-form", options=options)
    blocks = StoredBlocks()
    solver.solve_batch(*event_thresholds.targets_of(robot, 24, 0), log=blocks)
    return blocks


def test_what_a_threshold_catches(stored_blocks: StoredBlocks) -> None:
    """The share of solves whose smallest singular value is below it, by the traces themselves."""
    rows = np.concatenate([block.rows for block in stored_blocks.blocks])
    counts = np.concatenate([block.batch.iterations for block in stored_blocks.blocks])
    solved = np.concatenate([block.batch.success for block in stored_blocks.blocks])
    assert 0 < solved.sum() < len(solved)
    starts = np.cumsum(counts) - counts
    shares = []
    for trial in event_thresholds.trials(stored_blocks.blocks[0]):
        if (trial.kind, trial.subject) != (logs.EventKind.NEAR_SINGULAR, "closed_chain"):
            continue
        lowest = np.fmin.reduceat(rows["sigma_closed_chain"], starts)
        caught = event_thresholds.caught(stored_blocks.blocks, trial)
        below = lowest < np.float32(trial.threshold)
        assert caught.failed == pytest.approx(100 * below[~solved].mean())
        assert caught.solved == pytest.approx(100 * below[solved].mean())
        shares.append(caught.failed)
    assert len(shares) == len(event_thresholds.FACTORS)
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]


def test_the_report_marks_the_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_thresholds.ik, "Solver", lambda robot, *_, **__: ik.api.Solver(robot))
    event_thresholds.main(["--count", "24", "--factors", "1", "10", "--report", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    sections = len(re.findall(r"^## \S+ on \S+$", text, re.MULTILINE))
    assert sections == 5
    assert text.count("| STALL") == 2 * sections
    assert text.count("**0.0001**") == 2 * sections
    assert "## hand-first on baxter_ar10" in text
