"""`casadi-ik view`: opened pages and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import main

import casadi_ik as ik

CANDIDATES = """robot: kuka_lwr_barrett
candidates:
  - contacts: {thumb: {point: [-0.83, 0.15, 0.41], normal: [0.48, -0.88, 0]}}
  - contacts: {thumb: {point: [-0.80, 0.15, 0.41], normal: [0.48, -0.88, 0]}}
"""


def test_a_grasp_and_a_robot(view) -> None:
    cup = view()
    assert cup.page.request.name == "cup"
    assert cup.page.result.success
    robot = view("kuka_lwr_barrett", "--tolerance-position", "0.001")
    assert robot.page.result.success
    assert robot.page.request.settings.tolerance.position == 1e-3
    assert np.allclose(robot.page.result.q, robot.page.robot.home, atol=1e-6)
    assert cup.url != robot.url


def test_body_is_moved_part_by_part(view) -> None:
    page = view("mobile_kuka_lwr_barrett").page
    robot = page.robot
    q = robot.home + 0.3 * (np.arange(len(robot.home)) == robot.actuators.index("base_yaw"))
    page.drag_motors(q)
    assert page.work.settle(300)
    assert np.array_equal(page.result.q, q)
    named = [motor.label for motor in page._panel._motors]
    assert len(named) == len(robot.actuators)
    assert named[:2] == ["base_x [mm]", "base_y [mm]"]
    assert "lwr_joint_1 [°]" in named  # its side is said once, above
    # The camera of the hand follows the base.
    assert np.linalg.norm(page.cameras()["Hand"].target - robot.palm(q, "arm")[:3, 3]) < 0.15


def test_candidates_and_ranked_answers(view, tmp_path: Path) -> None:
    path = tmp_path / "candidates.yaml"
    path.write_text(CANDIDATES)
    page = view(str(path), "--robot", "kuka_lwr_barrett").page
    assert len(page.candidates) == 2
    page.choose(list(page.candidates)[1])
    assert page.work.settle(300)
    assert page.result.success
    assert page.request.grasp.contacts["thumb"].point[0] == pytest.approx(-0.80)
    assert main(["solve", "cup", "--out", str(tmp_path / "cup.json")]) == 0
    solution = json.loads((tmp_path / "cup.json").read_text())
    entry = {"candidate": 3, "name": "", "score": 0.5, "solution": solution}
    ranked = tmp_path / "ranked.json"
    ranked.write_text(json.dumps({"ranked": [entry]}))
    page_shown = view(str(ranked)).page
    assert page_shown.result.success
    assert np.allclose(page_shown.result.q, solution["q"])


RANKED = (
    '{"ranked": [{"candidate": 0, "score": 1, "solution": {"robot": "kuka_lwr_barrett", "q": %s}}]}'
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"ranked": ' + 100_000 * "[" + 100_000 * "]" + "}", "casadi-ik choose"),
        (RANKED % '["a", 0]', "ranked[0].solution.q[0]`"),
        (RANKED % "[1e999]", "casadi-ik choose"),
        ('{"ranked": [{"candidate": "x"}]}', "ranked[0].candidate`"),
        ("\xff", "casadi-ik choose"),
    ],
)
def test_bad_ranked_files_are_refused(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ranked.json"
    path.write_text(text, encoding="latin1")
    assert main(["view", str(path)]) == 2
    error_text = capsys.readouterr().err
    assert message.lower() in error_text.lower()
    assert error_text.count("\n") == 1


def test_logs_play_concurrently(view, robot: ik.ArmHand, tmp_path: Path) -> None:
    paths = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for path, grasp in zip(paths, ("cup", "mug"), strict=True):
        ik.Solver(robot).solve(ik.load_grasp(grasp), log=path)
    page = view(*map(str, paths)).page
    page.show(10_000)
    assert page.work.settle(300)
    assert page.time_shown == page.end_time == max(map(len, page.playbacks))
    for track, (drawn_view, _) in zip(page.playbacks, page._views, strict=True):
        assert np.array_equal(drawn_view.q, track.q[-1])
        assert all(verdict.ok for verdict in track.verdicts(len(track) - 1).values())
    assert "smallest singular values" in page._charts.content
    page.jump(forward=False)
    assert page.work.settle(300)
    assert page.time_shown in {verdict for track in page.playbacks for verdict in track.event_times}


def test_a_single_log_of_solves_opens(view, robot: ik.ArmHand, tmp_path: Path) -> None:
    path = tmp_path / "cup.mcap"
    ik.Solver(robot).solve(ik.load_grasp("cup"), log=path)
    with pytest.raises(ik.errors.LogError):
        ik.logs.read_motion(path)
    (playback,) = view(str(path)).page.playbacks
    assert playback.unit == "iteration"


def test_motions_play(view, robot: ik.ArmHand, tmp_path: Path) -> None:
    times = np.linspace(0.0, 2.0, 41)
    q = robot.home + 0.1 * np.sin(times)[:, None] * (np.arange(len(robot.home)) == 2)
    ik.motion.Motion(robot, times, q, 0 * q, 0 * q).write(tmp_path / "way.mcap")
    page = view(str(tmp_path / "way.mcap")).page
    page.show(1.23)
    assert page.work.settle(300)
    ((drawn_view, _),) = page._views
    assert np.allclose(drawn_view.q, q[24])
    assert "1.20</b> of 2.00 s" in page._summary.content
    assert "lwr_joint_3" in page._charts.content


def test_robot_and_solution_open_viewers(robot: ik.ArmHand) -> None:
    opened_viewer = robot.view()
    assert opened_viewer.page.result.success
    opened_viewer.stop()
    solution = ik.Solver(robot).solve(ik.load_grasp("cup"))
    viewer = solution.view(grasp=ik.load_grasp("cup"))
    assert np.array_equal(viewer.page.result.q, solution.q)
    assert viewer.page.result.success
    viewer.stop()


def test_missing_viser_names_the_extra(robot: ik.ArmHand, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name in [name for name in sys.modules if name.startswith("casadi_ik.app.viewer")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ik.CasadiIKError, match=r"'casadi-ik\[view\]'"):
        robot.view()
