"""The study of bodies runs, goes on where it was, and counts all targets of its parts."""

from __future__ import annotations

import json

import numpy as np
import one_body

import casadi_ik as ik


def test_the_study_writes_its_report_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(one_body, "PART", 40)
    given = ["--robots", "mobile_kuka_lwr_barrett", "--count", "60", "--free", "5", "--peers", "0"]
    given += ["--searched", "5", "--beyond", "2"]
    given += ["--parts", str(tmp_path / "parts"), "--out", str(tmp_path)]
    one_body.main([*given, "--minutes", "0"])
    assert "0 are done so far" in (tmp_path / "report.md").read_text()
    one_body.main(given)
    found = {one["name"]: one for one in json.loads((tmp_path / "metrics.json").read_text())}
    for kind in ("random", "near limits"):
        solved = found[f"one_body/mobile_kuka_lwr_barrett/{kind}/5 mm, 3 deg/solved"]
        assert (solved["value"], solved["n"]) == (100, 60)
    report = (tmp_path / "report.md").read_text()
    assert "5 of 5" in report
    assert "| mobile_kuka_lwr_barrett | free | 5 | 0 | 0 | 100.00 % |" in report
    done = {path: path.read_text() for path in (tmp_path / "parts").rglob("*.json")}
    one_body.main(given)
    assert {path: path.read_text() for path in done} == done


def test_a_random_search_finds_what_is_there_and_nothing_else():
    robot = ik.load_robot("mobile_kuka_lwr_barrett")
    among, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)
    free = one_body.untouched(among, 1, 0)
    points, normals = robot.contacts(free)
    assert one_body.random_search(among, plain, points[0], normals[0], 0)
    assert not one_body.random_search(among, plain, points[0] + [0, 0, 9.0], normals[0], 0)


def test_targets_about_one_keep_its_tolerances():
    robot, tolerance = ik.load_robot("g1+dex3"), ik.Tolerance()
    points, normals = robot.contacts(robot.home)
    moved, turned = one_body.around(points, normals, 500, np.random.default_rng(0))
    off = np.linalg.norm(moved - points, axis=2)
    angle = np.arccos(np.clip((turned * normals).sum(axis=2), -1, 1))
    for each, most in ((off, tolerance.position), (angle, tolerance.angle)):
        assert 0.99 * most < each.max() <= most * (1 + 1e-9)
