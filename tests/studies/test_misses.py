"""The study of misses: it counts, goes on where it stopped, lists what is lost, and climbs."""

from __future__ import annotations

import json

import missed_targets
import misses
import numpy as np
import pytest
from samplers import SAMPLERS, displaced, finger_sets, palm_slopes, singular_arms, suits

import casadi_ik as ik

ONE_CASE = ["--robots", "kuka_lwr_barrett", "--tolerance", "default"]


@pytest.mark.parametrize("name", [*missed_targets.ROBOTS[-2:], "kuka_lwr_barrett"])
def test_targets_are_within_limits(rng, name):
    robot = missed_targets.load(name)
    for sampler, (_, draw) in SAMPLERS.items():
        if suits(robot, sampler):
            q = draw(robot, rng, 40)
            assert q.shape == (40, len(robot.actuators))
            assert robot.beyond_limits(q).max() <= 1e-9


def test_singular_arms_are_nearer_to_singular(robot, rng):
    usual = palm_slopes(robot, robot.random(rng, 200))
    assert np.median(palm_slopes(robot, singular_arms(robot, rng, 200))) < np.median(usual) / 4


def test_count_resumes_and_lists_misses(tmp_path):
    arguments = [*ONE_CASE, "--sampler", "random", "--block", "40", "--out", str(tmp_path)]
    misses.main([*arguments, "--count", "40"])
    (first,) = (tmp_path / "kuka_lwr_barrett").rglob("*.json")
    stored = json.loads(first.read_text())
    stored["found"]["missed"] = [{"row": 3, "status": "STALLED", "q": [0.25] * 14}]
    first.write_text(json.dumps(stored))
    misses.main([*arguments, "--count", "80"])
    assert len(list((tmp_path / "kuka_lwr_barrett").rglob("*.json"))) == 2
    text = (tmp_path / "report" / "report.md").read_text()
    assert "Of 80 reachable targets, 1 are missed." in text
    assert "| 80 | 1 (1 STALLED) |" in text
    assert "random hands-00000, row 3" in text
    assert "| kuka_lwr_barrett | 5 mm, 3 deg | 1 | 1 |" in text, "it can be solved"


def test_search_resumes_and_climbs(tmp_path):
    states = []
    for minutes in ("0.02", "0.04"):
        arguments = [*ONE_CASE, "--sampler", "climb", "--minutes", minutes, "--out", str(tmp_path)]
        misses.main(arguments)
        (path,) = (tmp_path / "climb").glob("*.state.json")
        states.append(json.loads(path.read_text())["search"])
    first, then = states
    assert then["total"] > first["total"] > 0
    assert np.median(then["score"]) >= np.median(first["score"])
    assert "## Climbing" in (tmp_path / "report" / "report.md").read_text()


def test_pairs_and_fingers():
    toured = missed_targets.robots_of(["tour"])
    assert {name.split("+")[0] for name in toured} == set(ik.shipped_names("arms"))
    assert {name.split("+")[1] for name in toured} == set(ik.shipped_names("hands"))
    assert set(toured) < set(missed_targets.robots_of(["pairs"]))
    robot = ik.load_robot("panda+allegro_right")
    sets = finger_sets(robot, ["all", "3", "4", "thumb+ring"])
    assert set(sets) == {"all", "3", "thumb+ring"}
    assert robot.fingers.index(robot.thumb) in sets["3"]


def test_displaced_contacts_are_within_their_tolerance(robot, rng):
    q = robot.random(rng, 50)
    points, normals = displaced(*robot.contacts(q), rng, 0.004, 0.4)
    position, angle = robot.errors(q, points, normals)
    np.testing.assert_allclose(position, 0.004, rtol=1e-9)
    np.testing.assert_allclose(angle, 0.4, rtol=1e-9)
