"""`--scene` of `solve` and `batch`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from command_line import Command

import casadi_ik as ik


def test_solve_on_a_table(run: Command, tmp_path: Path) -> None:
    out = tmp_path / "cup.json"
    done = run("solve", "cup", "--scene", "table", "--out", out)
    assert (done.exit, done.err) == (0, "")
    assert "  clearance " in done.out
    answer = json.loads(out.read_text())
    assert answer["clearance"] >= 0
    assert len(answer["closest"]) == 2
    assert answer["collision"] is None


def test_what_blocks_is_said(run: Command, tmp_path: Path) -> None:
    scene = tmp_path / "balloon.yaml"
    scene.write_text(
        "solids:\n  balloon: {kind: sphere, radius: 300 mm, xyz: [-820 mm, 127 mm, 410 mm]}\n"
    )
    done = run("solve", "cup", "--scene", scene)
    assert done.exit == 1
    assert done.out.startswith("COLLISION  cup")
    assert "contacts and limits are met, but something touches" in done.out
    assert "balloon" in done.out
    assert "solvable without the scene" in done.out


def test_without_a_scene_nothing_is_checked_and_said_so(run: Command) -> None:
    assert "collision not checked" in run("solve", "apple").out


def test_bad_scenes_are_one_line(run: Command, tmp_path: Path) -> None:
    assert run("solve", "cup", "--scene", "moon").error.startswith(
        "--scene: no shipped scene is called 'moon'"
    )
    scene = tmp_path / "scene.yaml"
    scene.write_text("solids:\n  a: {kind: box, size: [1 m, 1 m]}\n")
    assert "scene.yaml: solids.a.size" in run("solve", "cup", "--scene", scene).error


def test_batches_have_clearances(run: Command, tmp_path: Path) -> None:
    robot = ik.load_robot("kuka_lwr_barrett")
    arrays = [ik.load_grasp(name).arrays(robot.fingers) for name in ("cup", "mug")]
    points, normals = (np.stack(parts) for parts in zip(*arrays, strict=True))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    words = ("batch", targets, "--robot", "kuka_lwr_barrett", "--out", out)
    assert run(*words, "--scene", "table").exit == 0
    with np.load(out) as found:
        assert found["clearance"].shape == (2,)
        assert (found["clearance"] >= 0).all()
    assert "not checked" in run(*words).out
    with np.load(out) as found:
        assert "clearance" not in found
