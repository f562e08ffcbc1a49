"""The study of all pairs: it counts, goes on where it stopped, and lists what is lost."""

from __future__ import annotations

import json

import any_robot
import any_robot_peers
import catalogue_pair
import numpy as np
import pytest
from peer_steps import PinContacts

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


@pytest.mark.parametrize("name", ["xarm7+ability", "kinova_gen3+inspire_rh56", "ur5e+shadow"])
def test_peers_see_the_robot_that_we_solve(name):
    """Couplings with offsets and several followers of a motor are in their URDF."""
    robot = ik.load_robot(name)
    contacts = PinContacts(robot)
    q = robot.random(np.random.default_rng(0), 5)
    for one, points, normals in zip(q, *robot.contacts(q), strict=True):
        _, found, rotations = contacts.at(contacts.model.createData(), one)
        np.testing.assert_allclose(found, points, atol=1e-12)
        turned = np.einsum("fij,fj->fi", rotations, contacts.axes)
        np.testing.assert_allclose(turned, normals, atol=1e-12)
        theta = contacts.theta(one)
        assert (theta >= contacts.model.lowerPositionLimit).all()
        assert (theta <= contacts.model.upperPositionLimit).all()


def test_what_peers_found_is_shown_with_what_is_missing(tmp_path):
    assert any_robot_peers.parts(any_robot_peers.read(tmp_path))[1].startswith("Not run yet")
    assert any_robot_peers.goal_row({})[2] == "not run yet"
    cell = {"count": 4, "first": 0.5, "mean": 900.0, "median": 800.0, "p99": 950.0}
    cell |= {"ratio, single": 10.0}
    cells = {
        any_robot_peers.BATCH: {**cell, "solved": 1.0, "ratio": 1.0},
        "placo": {**cell, "solved": 1.0, "ratio": 45.0},
        "mink": {**cell, "solved": 0.75, "ratio": 39.0},
    }
    entry = {"code": "x", "packages": {"placo": "1"}, "machine": "m", "apart": 1e-15}
    entry["cells"] = {"5 mm, 3 deg": cells}
    found = {"count": 4, "seed": 0, "restarts": 2, "pairs": {"panda+leap": entry}}
    (tmp_path / any_robot_peers.FILE).write_text(json.dumps(found))
    text = "\n".join(any_robot_peers.parts(any_robot_peers.read(tmp_path)))
    assert "| panda+leap | 5 mm, 3 deg | mink | 4 | 75 |" in text
    assert "Pink" in text.partition("Not run yet: ")[2]
    assert "panda+leap" not in text.partition("Not run yet: ")[2]
    *_, value, reached, _ = any_robot_peers.goal_row(found)
    assert value == "0 of 1 pairs; least 39 (panda+leap, mink, 5 mm, 3 deg)"
    assert reached == "**no**"
