"""What a log says of collisions: clearance of every iteration, events, the answer's pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs import EventKind, EventRules, detect_events, explain
from casadi_ik.logs.solve import one_solve
from casadi_ik.problem.trace import TraceFormat


@pytest.fixture(scope="module")
def robot() -> ik.ArmHand:
    return ik.load_robot("kuka_lwr_barrett")


def test_entries_and_leavings() -> None:
    """Two solves: one begins touching and is free twice, the other is always free."""
    form = TraceFormat(Layout.record(Field("clearance", (), "f4", "m")))
    rows = np.zeros(9, form.layout.dtype)
    rows["clearance"] = [-0.01, 0.001, 0.003, 0.001, 0.004, 0.002, 0.005, np.nan, 0.002]
    found = detect_events(form, rows, np.array([6, 3]), EventRules(clearance=0.002))
    told = [(e["solve_id"], e["iteration"], EventKind(e["kind"]).name) for e in found]
    assert told == [
        (0, 0, "COLLISION_ENTERED"),
        (0, 2, "COLLISION_LEFT"),
        (0, 3, "COLLISION_ENTERED"),
        (0, 4, "COLLISION_LEFT"),
    ]
    np.testing.assert_allclose(found["value"], [-0.01, 0.003, 0.001, 0.004], rtol=1e-6)
    assert (found["threshold"] == 0.002).all()


def test_a_log_with_a_scene(robot, tmp_path: Path) -> None:
    grasps = [ik.load_grasp(name) for name in ("cup", "mug", "banana")]
    arrays = [grasp.arrays(robot.fingers) for grasp in grasps]
    points, normals = (np.stack(parts) for parts in zip(*arrays, strict=True))
    poses = np.stack([grasp.object_pose for grasp in grasps])
    scene = ik.Scene(
        {
            "table": {"kind": "box", "size": [2, 2, 0.04], "xyz": [0, 0, -0.02]},
            "cup": {"kind": "object", "object": "cup"},
        },
        margin=0.001,
        grasped="cup",
    )
    solver = ik.Solver(robot, scene=scene)
    path = tmp_path / "scene.mcap"
    batch = solver.solve_batch(points, normals, log=path, object_pose=poses)
    log = ik.logs.open(path)
    solves, rows = log.solves(), log.iterations()
    np.testing.assert_allclose(solves.rows["clearance"], batch.clearance)
    named = [(record["closest_first"], record["closest_second"]) for record in solves.records()]
    assert named == list(batch.closest)
    # Every iteration's is that of its q with its own object's pose.
    around = solver._engine.around(
        solver._questions.of_arrays(points, normals, None).holding("cup", poses)
    )
    expected = around.rows(rows.solve_id).check(np.ascontiguousarray(rows.rows["q"]))
    np.testing.assert_allclose(
        rows.rows["clearance"], expected.room + scene.margin, atol=1e-6, equal_nan=True
    )
    kinds = {record["kind"] for record in log.events().records()}
    touching = np.flatnonzero(expected.room < -1e-6)
    assert ("COLLISION_ENTERED" in kinds) == bool(len(touching))
    first = one_solve(log, 0)
    assert first.clearance == pytest.approx(batch.clearance[0])
    assert any(" and ".join(batch.closest[0]) in line for line in explain(first).verdict)


def test_why_names_what_blocks_and_that_nothing_was_checked(robot, tmp_path: Path) -> None:
    cup = ik.load_grasp("cup")
    wall = {"kind": "sphere", "radius": 0.3, "xyz": cup.object_pose[:3, 3]}
    path = tmp_path / "blocked.mcap"
    solver = ik.Solver(robot, scene=ik.Scene({"balloon": wall}))
    blocked = solver.solve(cup, log=path, diagnose=False)
    assert blocked.status is ik.Status.COLLISION
    story = explain(one_solve(ik.logs.open(path)))
    assert any("something touched from iteration" in line for line in story.met)
    text = "\n".join(story.verdict)
    assert "limits are kept, but something touches" in text
    assert f"balloon overlap by {-1e3 * blocked.clearance:.2f} mm" in text
    plain = tmp_path / "plain.mcap"
    ik.Solver(robot).solve(cup, log=plain)
    log = ik.logs.open(plain)
    assert "collision not checked" in explain(one_solve(log)).verdict
    assert "clearance" not in log.iterations().names
