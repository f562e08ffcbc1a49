"""The robot of docs/add_a_robot.md is what the page says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik

PAGE = Path(__file__).parents[2] / "docs" / "add_a_robot.md"


@pytest.fixture
def documented(tmp_path: Path) -> ik.ArmHand:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    path = tmp_path / "pincher.yaml"
    path.write_text(text, encoding="utf-8")
    return ik.load_robot(str(path))


def test_the_documented_robot_is_solved(documented: ik.ArmHand) -> None:
    assert documented.fingers == ("left", "right")
    assert len(documented.actuators) == 7 + 3
    joints = documented.joints(documented.home)
    assert joints["right_tip"] == pytest.approx(np.deg2rad(10))
    q = documented.random(np.random.default_rng(0), 20)
    batch = ik.Solver(documented).solve_batch(*documented.contacts(q))
    assert batch.success.all()
