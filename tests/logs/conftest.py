"""Writing made-up solves to a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from made_up_solves import T0

from casadi_ik.logs import LogClock, McapRecorder
from casadi_ik.solve.recorder import SolveBlock


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes solves to a log and gives its path."""

    def run(*blocks: SolveBlock, name: str = "cup.mcap", **options: Any) -> Path:
        path = tmp_path / name
        settings: Mapping[str, Any] = {"robot_name": "made_up", "clock": LogClock(T0), **options}
        with McapRecorder(path, **settings) as recorder:
            for block in blocks:
                recorder.record(block)
        return path

    return run
