"""The study of grasps in MuJoCo runs, and its committed report says what it says elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import touch_hold
from runner.study import standing

import casadi_ik as ik

RESULTS = Path(touch_hold.__file__).parent / "results"


def test_weak_squeeze_drops_the_object(monkeypatch):
    solver, surface = ik.Solver(ik.load_robot("panda+panda_hand")), ik.load_surface("tennis_ball")
    (grasp,) = solver.grasps_of(surface, standing(surface, 0.7), limit=1, among=1)
    down = -np.eye(3)[2:]
    hold = touch_hold.Hold(solver.robot, grasp, surface)
    assert hold.is_held(hold.settled(), down).all()
    monkeypatch.setattr(touch_hold, "SQUEEZE", 0.02)
    hold = touch_hold.Hold(solver.robot, grasp, surface)
    assert not hold.is_held(hold.settled(), down).any()


def test_the_area_under_the_curve():
    is_held = np.array([True, False, True, False])
    assert touch_hold.concordance(np.array([4.0, 1.0, 3.0, 2.0]), is_held) == 1.0
    assert touch_hold.concordance(np.array([1.0, 4.0, 2.0, 3.0]), is_held) == 0.0
    assert touch_hold.concordance(np.ones(4), is_held) == 0.5


@pytest.mark.parametrize(("folder", "min_value"), [("touch_hold", 0.88), ("touch_hold_ycb", 0.88)])
def test_stored_reports_predict_the_load(folder, min_value):
    text = (RESULTS / folder / "metrics.json").read_text()
    values = {entry["name"]: entry["value"] for entry in json.loads(text)}
    areas = [value for name, value in values.items() if name.endswith("/auc")]
    assert len(areas) >= 5
    assert min(areas) >= min_value
    best = [value for name, value in values.items() if name.endswith("/best_third")]
    assert min(best) >= 90
