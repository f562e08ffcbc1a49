"""The studies that look for misses: they count, go on where they stopped, and list what is lost."""

from __future__ import annotations

import json

import adversary
import hard_targets
import missed
import numpy as np
import other_robots
import pytest

import casadi_ik as ik

ONE = ["--robot", "kuka_lwr_barrett"]


@pytest.mark.parametrize("name", other_robots.MADE)
def test_targets_of_made_robots_are_within_limits(tmp_path, rng, name):
    robot = ik.load_robot(other_robots.made_robot(name, tmp_path))
    for make in hard_targets.SETS.values():
        q = make(robot, rng, 40)
        assert q.shape == (40, len(robot.actuators))
        assert robot.beyond_limits(q).max() <= 1e-9


def test_singular_arms_are_nearer_to_singular(robot, rng):
    usual = hard_targets.palm_slopes(robot, robot.random(rng, 200))
    near = hard_targets.palm_slopes(robot, hard_targets.singular_arms(robot, rng, 200))
    assert np.median(near) < np.median(usual) / 4


def test_a_count_goes_on_and_lists_what_is_lost(tmp_path):
    out, report = tmp_path / "out", tmp_path / "report"
    asked = [*ONE, "--set", "random hands", "--block", "40", "--out", str(out)]
    asked += ["--report", str(report)]
    missed.main([*asked, "--count", "40"])
    (first,) = (out / "kuka_lwr_barrett").glob("*.json")
    kept = json.loads(first.read_text())
    kept["found"]["5 mm, 3 deg"]["missed"] = [{"row": 3, "q": [0.25] * 14}]
    first.write_text(json.dumps(kept))
    missed.main([*asked, "--count", "80"])
    assert len(list((out / "kuka_lwr_barrett").glob("*.json"))) == 2
    text = (report / "report.md").read_text()
    assert "160 solves, 1 missed." in text
    assert "row 3" in text
    assert "| kuka lwr barrett | 5 mm, 3 deg | 1 | 1 |" in text, "it can be solved"


def test_a_search_goes_on_and_climbs(tmp_path):
    out, report = tmp_path / "out", tmp_path / "report"
    asked = [*ONE, "--minutes", "0.02", "--out", str(out), "--report", str(report)]
    adversary.main(asked)
    first = json.loads((out / "kuka_lwr_barrett" / "state.json").read_text())["search"]
    adversary.main(asked)
    then = json.loads((out / "kuka_lwr_barrett" / "state.json").read_text())["search"]
    assert then["tried"] > first["tried"] >= adversary.CLIMBERS
    assert np.median(then["score"]) >= np.median(first["score"])
    assert (report / "report.md").exists()
