"""Reports on Qiu & Kermani 2021: a small seeded part of each study through its command."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import polars as pl
import pytest
import qiu_report
import table_one
from qiu_report import readings
from qiu_settings import (
    PRINTED,
    TABLE_I,
    ablation_study,
    printed_mean,
    readings_study,
    table_study,
)
from runner.study import read_results, run

import casadi_ik as ik


def metrics(folder) -> dict[str, dict]:
    return {entry["name"]: entry for entry in json.loads((folder / "metrics.json").read_text())}


def test_printed_table():
    """The abstract states an average success of 96 %, against 12 % by the original methods."""
    assert round(printed_mean("enhanced-dls").success) == 96
    assert 11 < printed_mean("original-dls").success < 12
    assert set(TABLE_I) < set(ik.shipped_grasps("kuka_lwr_barrett"))
    assert all(set(cells) == set(PRINTED) for cells in TABLE_I.values())
    assert printed_mean("enhanced-sdls").iterations == pytest.approx(236.6, abs=0.1)


def test_table_one(tmp_path, monkeypatch):
    monkeypatch.setattr(qiu_report, "RUNS", 1)
    monkeypatch.setattr(qiu_report, "LONGEST", 20)
    out, report = tmp_path / "results", tmp_path / "report"
    common = ["--out", str(out), "--report", str(report), "--block", "2"]
    table_one.main(["--count", "2", "--methods", "hand-first", "enhanced-dls", *common])
    text = (report / "report.md").read_text()
    values = metrics(report)
    assert values["table-one/hand-first/enforce/success"]["value"] == 100
    enhanced = values["table-one/enhanced-dls/ignore/success"]
    assert enhanced["n"] == 24
    assert enhanced["low"] < enhanced["value"] <= enhanced["high"] <= 100
    assert values["table-one/original-dls/ignore/success"]["n"] == 0
    assert "| `enhanced-dls` | 95.9 | 181 | 343 |" in text
    assert text.count("*Not run yet.*") == 2
    for name in ("success", "iterations", "convergence"):
        assert f"({name}.png)" in text
        assert (report / f"{name}.png").stat().st_size > 10_000
    table_one.main(["--count", "0", *common])
    report_again = (report / "report.md").read_text()
    assert report_again.partition("## Provenance")[0] == text.partition("## Provenance")[0], (
        "only the command differs"
    )
    assert "--count 0" in report_again.partition("## Provenance")[2]


def test_every_choice_can_be_built(tmp_path):
    """Each changed setting gives another solver, and each reading another method."""
    studies = (ablation_study(tmp_path, 1, 0, 1), readings_study(1, 0, 1))
    for study in studies:
        keys = [setting.key for setting in study.settings]
        assert len(set(keys)) == len(keys)
        solvers = [
            (study.solver(setting).parameters, study.start(setting).tolist(), setting.robot)
            for setting in study.settings
        ]
        for i, solver in enumerate(solvers):
            assert solver not in solvers[:i], keys[i]


def test_mounting_face_is_another_palm_frame(robot, tmp_path):
    study = ablation_study(tmp_path, 1, 0, 1)
    setting = next(item for item in study.settings if "mounting face" in item.key)
    robot_moved = study.solver(setting).robot
    offset = np.linalg.inv(robot_moved.palm(robot.home)) @ robot.palm(robot.home)
    np.testing.assert_allclose(offset[:3, 3], [0, 0, 0.08], atol=1e-12)


def test_one_ablation_changes_the_outcome(tmp_path):
    """Without the closed chain fewer of the same targets are solved."""
    study = ablation_study(tmp_path / "robots", 4, 2021, 4)
    settings_compared = ("enhanced-dls, as in the table", "enhanced-dls, no closed chain")
    budget = {"max_iterations": 400}
    settings = tuple(
        dataclasses.replace(setting, options={**setting.options, **budget})
        for setting in study.settings
        if setting.key in settings_compared
    )
    study = dataclasses.replace(study, settings=settings, sets=study.sets[:4])
    run(study, tmp_path / "results")
    table = read_results(study, tmp_path / "results")
    solved = dict(table.group_by("setting").agg(pl.col("success").sum()).rows())
    assert solved[settings_compared[0]] > solved[settings_compared[1]]


def test_distance_of_a_reading():
    """Twice the printed rate at half the printed iterations has the distance 2 ln 2."""
    study = readings_study(1, 0, 1)
    printed = printed_mean("original-dls")
    count = round(100 / printed.success * 500)  # 1000 solved of so many are twice the rate
    rows = {
        "setting": [study.settings[0].key] * count,
        "success": [i < 1000 for i in range(count)],
        "iterations": [printed.iterations / 2] * count,
        "time": [1.0] * count,
    }
    text, metrics = readings(pl.DataFrame(rows), study)
    assert f"| {2 * math.log(2):.2f} | {count:,} |" in text
    assert len(metrics) == 3


def test_table_has_every_method_both_ways():
    study = table_study("table", ("enhanced-dls", "hand-first"), 3, 0, 1)
    assert [setting.limits for setting in study.settings] == ["ignore", "enforce"] * 2
    assert study.settings[0].options == {"finger_step": "closed-form"}
    assert len(list(study.blocks())) == 3 * 4 * 12
