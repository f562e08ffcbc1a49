"""Fixture that writes made-up solves to a log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_up_solves import T0, SolveBlock

from casadi_ik import logs


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Function that writes solves to a log and returns its path."""

    def run(*blocks: SolveBlock, name: str = "cup.mcap", **options: Any) -> Path:
        path = tmp_path / name
        settings = {"robot_name": "made_up", "clock": logs.LogClock(T0)} | options
        with logs.McapRecorder(path, **settings) as recorder:
            for block in blocks:
                recorder.record(block)
        return path

    return run
