"""`casadi-ik log`: output for people and for scripts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_line import FAST, POSTURE, Command
from mcap.reader import make_reader

import casadi_ik as ik


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> Path:
    """Logs of two methods on four targets, the last one out of reach, and an incomplete log."""
    folder = tmp_path_factory.mktemp("logs")
    points, normals = robot.contacts(np.tile(POSTURE, (4, 1)))
    points[:, :, 2] += 0.01 * np.arange(4)[:, None]
    points[3, :, 0] += 5.0
    for method in ("enhanced-dls", "hand-first"):
        options = {"max_iterations": 300} if method == "enhanced-dls" else None
        step = FAST[-1] if method == "enhanced-dls" else None
        solver = ik.Solver(robot, method, finger_step=step, options=options)
        solver.solve_batch(points, normals, log=folder / f"{method}.mcap")
    torn = (folder / "enhanced-dls.mcap").read_bytes()[:-1000]
    (folder / "torn").mkdir()
    (folder / "torn" / "torn.mcap").write_bytes(torn)
    return folder


def test_solves_events_and_reasons(run_process: Command, run: Command, folder: Path) -> None:
    """Tables fit a terminal of 80 columns; filters choose solves, and reasons name the fingers."""
    dls, hand_first = folder / "enhanced-dls.mcap", folder / "hand-first.mcap"
    solves = run_process("log", "solves", dls, hand_first).fine().out
    events = run("log", "events", dls, "--event", "PHASE_CHANGE").fine().out
    for table in (solves, events):
        assert max(map(len, table.splitlines())) <= 80
    assert {"enhanced-dls", "hand-first"} < set(solves.split())
    assert solves.split().count("SOLVED") == 6
    for words, count in ((("--solve", "2"), 1), (("--most", "2"), 2), (("--status", "SOLVED"), 3)):
        assert run("log", "solves", hand_first, *words).out.split().count("SOLVED") == count
    assert "hand alignment" in events
    reason = run_process("log", "why", dls, "4").fine().out
    assert all(word in reason for word in ("enhanced-dls", "thumb reaching", "thumb misses"))
    assert "solved" in run("log", "why", dls, "--solve", "1").fine().out


def test_solves_list_fixed_actuators(run: Command, robot: ik.ArmHand, tmp_path: Path) -> None:
    log, fixed = tmp_path / "held.mcap", {"lwr_joint_3": 0.2}
    ik.Solver(robot).solve(ik.load_grasp("cup"), log=log, fixed=fixed)
    assert "lwr_joint_3" in run("log", "solves", log).out.split()


def test_compare(run: Command, folder: Path) -> None:
    files = [folder / "hand-first.mcap", folder / "enhanced-dls.mcap"]
    assert {"3,", "1"} < set(run("log", "compare", *files).fine().out.split()), (
        "by both, by neither"
    )
    assert "hand-first" in run("log", "compare", *files, "--solve", 4).out
    other_methods = run("log", "compare", *files, "--methods", "enhanced-dls", "hand-first").out
    rows = [line.split()[0] for line in other_methods.splitlines() if " of 4" in line]
    assert rows == ["enhanced-dls", "hand-first"]


def test_plot(run: Command, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for solve in (("--solve", 2), (2,)):
        done = run("log", "plot", folder / "enhanced-dls.mcap", *solve).fine()
        assert done.out.split() == ["plot", "enhanced-dls-enhanced-dls-2.png"]
        picture = tmp_path / "enhanced-dls-enhanced-dls-2.png"
        assert picture.read_bytes()[:4] == b"\x89PNG"
        picture.unlink()


def test_export_for_a_viewer(run_process: Command, folder: Path, tmp_path: Path) -> None:
    log = folder / "enhanced-dls.mcap"
    done = run_process("log", "export", log, "--solve", 1, "--out", "view.mcap").fine()
    assert done.out.split() == ["viewer", "view.mcap", "layout", "view.layout.json"]
    with (tmp_path / "view.mcap").open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert {"/tf", "/robot_description", "/joint_states", "/ik/targets"} <= topics
    layout = json.loads((tmp_path / "view.layout.json").read_text())
    assert set(layout) >= {"configById", "layout", "playbackConfig"}


def test_export_of_tables(run: Command, folder: Path, tmp_path: Path) -> None:
    log = folder / "enhanced-dls.mcap"
    for table_name in ("iterations", "solves", "events"):
        table = getattr(ik.logs.open(log), table_name)()
        for suffix, read in ((".parquet", pl.read_parquet), (".csv", pl.read_csv)):
            path = tmp_path / f"{table_name}{suffix}"
            run("log", "export", log, "--what", table_name, "--out", path).fine()
            assert read(path).height == len(table)
    path = tmp_path / "other"
    run("log", "export", log, "--to", "csv", "--phase", "hand-alignment", "--out", path)
    assert set(pl.read_csv(path)["phase"]) == {"hand-alignment"}


def test_torn_log_is_reported(run: Command, folder: Path) -> None:
    done = run("log", "info", folder / "torn" / "torn.mcap")
    assert done.exit == 0
    assert "(casadi-ik log finish)" in " ".join(done.out.split())
    assert "incomplete" not in run("log", "info", folder / "hand-first.mcap").out


def test_info_fits_a_terminal_and_lists_changed_options(run_process: Command, folder: Path) -> None:
    text = run_process("log", "info", folder / "hand-first.mcap").fine().out
    assert max(map(len, text.splitlines())) <= 80
    words = " ".join(text.split())
    assert "options default" in words
    assert re.search(r"events \d+ [A-Z_]+, \d+ [A-Z_]+", words)
    words = " ".join(run_process("log", "info", folder / "enhanced-dls.mcap").fine().out.split())
    options = re.search(r"options (.*?) (?:scene|event rules)", words)
    assert options
    assert "max_iterations 300" in options[1]
    assert len(options[1].split(", ")) <= 3


def test_finish_and_merge(run: Command, folder: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes((folder / "torn" / "torn.mcap").read_bytes())
    assert "removed" in run("log", "finish", torn).out
    assert "already complete" in run("log", "finish", torn).out
    done = run("log", "merge", torn, "--out", tmp_path / "all.mcap").fine()
    assert "of enhanced-dls" in done.out
    assert len(ik.logs.open(tmp_path / "all.mcap").solves()) == 4
