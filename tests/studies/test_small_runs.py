"""Every study runs on a few targets, writes its report, and keeps what an earlier run finished."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable
from pathlib import Path

import calibration
import collision
import event_thresholds
import misses
import moving
import numpy as np
import proofs
import public_grasps
import pytest
import touch_claims
import trimesh
import virtual_joint_range
from collision_study import search
from impossible_targets import CLASSES
from make_grasp_sets import made
from processes import ROOT, python

import casadi_ik as ik

pytestmark = pytest.mark.usefixtures("usual_flags")

ROBOT = "kuka_lwr_barrett"
RESUMED = "--out {0}/parts --report {0}/report"
PARTS = "--parts {0}/parts --out {0}/report"

STUDIES = {
    "ar10_gains": ("--goals 4 --out {0}/report", {}),
    "calibration": ("--hands 2 --outliers 0.2 0.4 --poses 15 --out {0}/report", {}),
    "closed_chain_singularities": ("--count 30 --near 100 --out {0}", {}),
    "closed_chain_workspace": ("--count 30 --palms 12 --grasp mug --out {0}", {}),
    "virtual_joint_range": ("--count 30 --steps 8 --out {0}", {}),
    "misses": (
        f"--robots {ROBOT} --tolerance default --sampler random palms noise limits --fingers all 2 "
        f"--count 30 --noise 6 3 --looked 1 --ratio {RESUMED}",
        {},
    ),
    "one_body": (
        f"--robots mobile_{ROBOT} --count 20 --free 2 --peers 0 --searched 2 --beyond 1 {PARTS}",
        {
            f"one_body/mobile_{ROBOT}/{kind}/5 mm, 3 deg/solved": (100, 20)
            for kind in ("random", "near limits")
        },
    ),
    "teleoperation": (
        f"--paths 1 --peer-paths 1 --count 160 --robots {ROBOT} --report {{0}}/report",
        {},
    ),
    "touch": (
        f"--robots panda+panda_hand --objects golf_ball --limit 3 {PARTS}",
        {f"touch/panda+panda_hand/{name}": (100, None) for name in ("confirmed", "closed")},
    ),
    "touch_claims": (
        f"--robots panda+allegro_right panda+leap --meshes coarse_can --limit 25 {PARTS}",
        {
            f"touch_claims/{robot}/{claim.replace(' ', '_')}": (100, 25)
            for robot in ("panda+allegro_right", "panda+leap")
            for claim in touch_claims.CLAIMS
        },
    ),
    "touch_hold": (
        "--robots panda+panda_hand --objects tennis_ball sugar_box --limit 6 --best 3 --samples 1 "
        "--out {0}/report",
        {"touch_hold/panda+panda_hand/held": (None, 6)},
    ),
}
"""Command line of each study, and the values and counts of some of its metrics."""


@pytest.mark.parametrize("name", STUDIES)
def test_a_small_run_writes_the_report_and_is_resumed(name: str, tmp_path: Path) -> None:
    words, expected = STUDIES[name]
    study = importlib.import_module(name)
    study.main(words.format(tmp_path).split())
    (report,) = [path for path in tmp_path.rglob("*.md") if path.name in ("report.md", "README.md")]
    text = report.read_text()
    assert f"studies/{name}.py" in text, "the command that made it"
    assert all(line.count(" | ") < 8 for line in text.splitlines()), "at most eight columns"
    pictures = re.findall(r"\(([a-z_]+\.png)\)", text)
    assert all((report.parent / picture).stat().st_size > 1000 for picture in pictures)
    metrics = report.with_name("metrics.json")
    entries = (
        {entry["name"]: entry for entry in json.loads(metrics.read_text())} if expected else {}
    )
    for metric, (value, count) in expected.items():
        assert value is None or entries[metric]["value"] == value
        assert count is None or entries[metric]["n"] == count
    parts = {path: path.stat().st_mtime_ns for path in tmp_path.glob("parts/**/*.json")}
    if parts:
        study.main(words.format(tmp_path).split())
        assert {path: path.stat().st_mtime_ns for path in parts} == parts


def stored(path: Path) -> dict:
    """Return the results that a study has stored for one of its parts."""
    return json.loads(path.read_text())["found"]


def change(path: Path, **values: object) -> None:
    """Replace results that a study has stored for one of its parts."""
    content = json.loads(path.read_text())
    content["found"] |= values
    path.write_text(json.dumps(content))


def metric_names(folder: Path) -> set[str]:
    """Return the names of the metrics of a report."""
    return {entry["name"] for entry in json.loads((folder / "metrics.json").read_text())}


def test_stored_misses_are_counted_and_listed(tmp_path: Path) -> None:
    words = ["--robots", ROBOT, "--tolerance", "default", "--sampler", "random", "--block", "40"]
    misses.main([*words, "--out", str(tmp_path), "--count", "40"])
    (first,) = (tmp_path / ROBOT).rglob("*.json")
    change(first, missed=[{"row": 3, "status": "STALLED", "q": [0.25] * 14}])
    misses.main([*words, "--out", str(tmp_path), "--count", "80"])
    assert len(list((tmp_path / ROBOT).rglob("*.json"))) == 2
    text = (tmp_path / "report" / "report.md").read_text()
    for line in (
        "Of 80 reachable targets, 1 are missed.",
        "| 80 | 1 (1 STALLED) |",
        "random hands-00000, row 3",
        f"| {ROBOT} | 5 mm, 3 deg | 1 | 1 |",  # it can be solved
    ):
        assert line in text


def test_search_of_misses_resumes_and_climbs(tmp_path: Path) -> None:
    states = []
    for minutes in ("0.05", "0.1"):
        words = ["--robots", ROBOT, "--tolerance", "default", "--sampler", "climb"]
        misses.main([*words, "--minutes", minutes, "--out", str(tmp_path)])
        (path,) = (tmp_path / "climb").glob("*.state.json")
        states.append(json.loads(path.read_text())["search"])
    first, then = states
    assert then["total"] > first["total"] > 0
    assert np.median(then["score"]) >= np.median(first["score"])
    assert "## Climbing" in (tmp_path / "report" / "report.md").read_text()


def test_stored_false_proofs_are_counted_and_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proofs, "BLOCK", 6)
    out, report = tmp_path / "out", tmp_path / "report" / "report.md"
    words = ["--robot", "ar10", "--out", str(out), "--report", str(report.parent)]
    cases = [case for case in proofs.CASES if case[0] != "blind hands"]
    proofs.main([*words, "--impossible", "4", "--count", "6"])
    files = sorted((out / "ar10").glob("*.json"))
    assert len(files) == len(cases) + len(CLASSES) - 2
    assert f"Of {6 * len(cases)} reachable targets, 0 are called" in report.read_text()
    change(next(path for path in files if path.name.startswith("corners")), false=[[0.125] * 10])
    proofs.main([*words, "--impossible", "4", "--count", "12"])
    assert len(list((out / "ar10").glob("*.json"))) == len(files) + len(cases)
    assert f"Of {12 * len(cases)} reachable targets, 1 are called" in report.read_text()
    assert "0.125 0.125" in report.read_text()


def test_diagnoses_are_compared_with_an_earlier_run(tmp_path: Path) -> None:
    earlier, small = tmp_path / "earlier.npz", [ROOT / "studies" / "diagnosis.py"]
    for options in (
        ["--count", "0", "--keep", earlier],
        ["--count", "20", "--bad-starts", "20", "--against", earlier],
    ):
        run = python(*small, "--impossible", "3", *options, "--report", tmp_path)
        assert run.returncode == 0, run.stderr
    table = (tmp_path / "report.md").read_text().partition("## Against")[2]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    compared = [row for row in rows if row[0] not in ("targets", "---")]
    assert len(compared) >= 6
    assert all(row[1] == row[2] and row[5] == "1.000" and row[6] == "100" for row in compared)


def test_the_report_of_events_marks_the_rules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_thresholds.ik, "Solver", lambda robot, *_, **__: ik.api.Solver(robot))
    event_thresholds.main(["--count", "24", "--factors", "1", "10", "--report", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    sections = len(re.findall(r"^## \S+ on \S+$", text, re.MULTILINE))
    assert sections == 5
    assert text.count("| STALL") == text.count("**0.0001**") == 2 * sections
    assert "## hand-first on baxter_ar10" in text


def test_choice_in_clutter_is_never_in_collision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collision, "CLUTTER", (3,))
    monkeypatch.setattr(search, "TURNS", 2)
    monkeypatch.setattr(search, "BATCH", 4)
    words = ["--robot", ROBOT, "--checked", "60", "--timed", "32", "--count", "1"]
    words += ["--searched", "64", *RESUMED.replace("parts", "out").format(tmp_path).split()]
    collision.main(words)
    (path,) = (tmp_path / "out" / "choice").glob("kuka*.json")
    assert {target["false"] for target in stored(path)["targets"]} == {False}
    assert f"collision/{ROBOT}/3/found" in metric_names(tmp_path / "report")
    written = path.stat().st_mtime_ns
    collision.main(words)
    assert path.stat().st_mtime_ns == written


def test_moving_targets_are_followed_within_rates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(moving, "STEPS", 200)
    monkeypatch.setattr(moving, "WAIT", 50)
    words = ["--robots", ROBOT, "--tracks", "1", "--folder", str(tmp_path / "done")]
    words += ["--report", str(tmp_path / "report")]
    moving.main(["--count", "1", *words])
    (first,) = (tmp_path / "done" / ROBOT).glob("path_*.json")
    assert stored(first)["met"] == 1
    for path in ("smooth", "leaping"):
        assert stored(first)[f"{path}_velocity"] <= 1 + 1e-6
        assert stored(first)[f"{path}_acceleration"] <= 1 + 1e-6
    change(first, met=0.5, median=77.0)
    moving.main(["--count", "2", *words])
    assert stored(first)["median"] == 77
    assert f"| {ROBOT} | 2 | 1 | 75.00 |" in (tmp_path / "report" / "report.md").read_text()
    assert len(metric_names(tmp_path / "report")) == 5


def test_published_grasps_are_held_on_an_arm_over_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = made("dexgraspnet_shadow", tmp_path)
    trimesh.creation.box((0.8, 0.8, 1.2)).export(written.path.with_suffix(".obj"))
    monkeypatch.setattr(public_grasps, "SIZES", (0.06,))
    monkeypatch.setattr(public_grasps, "POSES", public_grasps.POSES[:1])
    words = [str(tmp_path), "--limit", "2", *PARTS.format(tmp_path).split()]
    public_grasps.main(words)
    (part,) = (tmp_path / "parts").rglob("*.json")
    counts = stored(part)
    assert counts["grasps"] == len(written.q)
    assert counts["grasps"] >= counts["reached"] >= counts["table"] >= counts["free"]
    assert counts["free"] + sum(counts["why"].values()) == counts["grasps"]
    assert counts["found"] == 2


@pytest.mark.parametrize(
    ("main", "option", "values"),
    [
        (virtual_joint_range.main, "--steps", ["7"]),
        (calibration.main, "--outliers", ["0.3", "0.2"]),
        (calibration.main, "--outliers", ["0", "0.2"]),
        (calibration.main, "--outliers", ["0.1", "1"]),
    ],
)
def test_impossible_options_are_refused(
    main: Callable[[list[str]], None], option: str, values: list[str], tmp_path: Path
) -> None:
    with pytest.raises(ik.errors.InputError, match=f"{option}: .*{values[0]}"):
        main([option, *values, "--out", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []
