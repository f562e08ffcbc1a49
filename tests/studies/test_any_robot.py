"""The study of all pairs: it counts, goes on where it stopped, and lists what is lost."""

from __future__ import annotations

import json

import any_robot
import catalogue_pair
import numpy as np
import pytest

import casadi_ik as ik


def test_a_tour_visits_every_arm_and_every_hand():
    parser_defaults = {"seed": 3, "tour": True, "arm": None, "hand": None, "count": 10}
    toured = list(any_robot.pairs(type("Options", (), parser_defaults)))
    assert {pair.arm for pair in toured} == set(any_robot.ARMS)
    assert {pair.hand for pair in toured} == set(any_robot.HANDS)
    assert {pair.count for pair in toured} == {10, 100}


def test_three_fingers_hold_the_thumb_and_leave_the_others_free():
    robot = ik.load_robot("panda+allegro_right")
    sets = catalogue_pair.finger_sets(robot)
    assert robot.fingers.index(robot.thumb) in sets["3 fingers"]
    pair = catalogue_pair.Pair("panda", "allegro_right", 5, 0)
    q, points, normals = catalogue_pair.targets(robot, pair, "near limits", sets["3 fingers"])
    free = np.isnan(points).all(axis=(0, 2))
    assert free.sum() == len(robot.fingers) - 3
    reached = robot.contacts(q)[0]
    np.testing.assert_array_equal(points[:, ~free], reached[:, ~free])
    assert np.isnan(normals[:, free]).all()


@pytest.mark.filterwarnings("ignore::casadi_ik.kernels.compiler.NoCompilerWarning")
def test_a_pair_is_tried_once_and_its_misses_are_listed(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "none")  # the virtual machine is at hand at once
    monkeypatch.setattr(catalogue_pair, "SCALE", 2)
    monkeypatch.setattr(catalogue_pair, "WARM", 2)
    out, report = tmp_path / "out", tmp_path / "report"
    asked = ["--arm", "irb140", "--hand", "jaco_3f", "--count", "2", "--seed", "4"]
    asked += ["--out", str(out), "--report", str(report)]
    any_robot.main(asked)
    (path,) = out.glob("*.json")
    found = json.loads(path.read_text())
    assert set(found["cells"]) == {
        f"all fingers/{kind}/{name}"
        for kind in catalogue_pair.KINDS
        for name in catalogue_pair.TOLERANCES
    }
    assert found["first use"] > 0
    cell = next(iter(found["cells"].values()))
    cell["missed"] = [{"row": 3, "status": "NOT_FOUND", "q": [0.25] * 9}]
    path.write_text(json.dumps(found))
    any_robot.main(asked)
    assert json.loads(path.read_text()) == found
    text = (report / "report.md").read_text()
    assert f"{6 * cell['count']:,} solves, 1 missed." in text
    assert "NOT_FOUND" in text
    assert (report / "any_robot.png").stat().st_size > 10_000
