"""Values of options that no study can be made of."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import casadi_ik as ik


@pytest.mark.parametrize(
    ("study", "option", "values"),
    [
        ("virtual_joint_range", "--steps", ["7"]),
        *(("calibration", "--outliers", v) for v in (["0.3", "0.2"], ["0", "0.2"], ["0.1", "1"])),
    ],
)
def test_impossible_options(study: str, option: str, values: list[str], tmp_path: Path) -> None:
    with pytest.raises(ik.errors.InputError, match=f"{option}: .*{values[0]}"):
        importlib.import_module(study).main([option, *values, "--out", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []
