"""`casadi-ik choose`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import Command
from scipy.spatial.transform import Rotation

import casadi_ik as ik

ROBOT = "kuka_lwr_barrett"
PLACE = ("--object-pose", "-0.82", "0.127", "0.41", "0", "0", "0.3")


def entry(angle: float) -> dict[str, Any]:
    """Return the grasp of the cup, turned about the cup in its frame, in the form of a file."""
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    grasp = ik.load_grasp("cup").in_object_frame().at(turn)
    return {
        "contacts": {
            name: {"point": contact.point.tolist(), "normal": contact.normal.tolist()}
            for name, contact in grasp.contacts.items()
        }
    }


@pytest.fixture
def candidates(tmp_path: Path) -> Path:
    path = tmp_path / "candidates.yaml"
    entries = [entry(angle) for angle in (0.0, 1.5, 3.0, 4.5)]
    path.write_text(yaml.safe_dump({"object": {"name": "cup"}, "candidates": entries}))
    return path


def test_ranking_is_written(run: Command, candidates: Path, tmp_path: Path) -> None:
    out = tmp_path / "ranked.json"
    words = ("choose", candidates, "--robot", ROBOT, *PLACE, "--out", out)
    done = run(*words, "--limit", "3", "--per-candidate", "2").fine()
    assert done.out.startswith("FOUND")
    assert "collision not checked" in done.out
    report = json.loads(out.read_text())
    assert report["candidates"] == 4
    assert len(report["ranked"]) == 3
    scores = [item["score"] for item in report["ranked"]]
    assert scores == sorted(scores, reverse=True)
    best = report["ranked"][0]
    robot = ik.load_robot(ROBOT)
    grasps = [ik.Grasp({n: ik.Contact(**c) for n, c in entry(a)["contacts"].items()})
              for a in (0.0, 1.5, 3.0, 4.5)]  # fmt: skip
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    pose[:3, 3] = [-0.82, 0.127, 0.41]
    points_of_best = grasps[best["candidate"]].at(pose).arrays(robot.fingers)
    position, _ = robot.errors(best["solution"]["q"], *points_of_best)
    assert (position <= 5e-3).all()
    free = run(*words, "--scene", "table", "--prefer", "clearance")
    assert free.exit == 0
    assert all(item["solution"]["clearance"] >= 0 for item in json.loads(out.read_text())["ranked"])


def test_candidates_from_folder_and_arrays(run: Command, candidates: Path, tmp_path: Path) -> None:
    out, folder = tmp_path / "ranked.json", tmp_path / "grasps"
    words = ("--robot", ROBOT, *PLACE, "--limit", "5", "--out", out)
    assert run("choose", candidates, *words).exit == 0
    scores = [item["score"] for item in json.loads(out.read_text())["ranked"]]
    folder.mkdir()
    arrays = []
    for i, item in enumerate(yaml.safe_load(candidates.read_text())["candidates"]):
        path = folder / f"grasp_{i}.yaml"
        path.write_text(yaml.safe_dump(item | {"object": {"name": "cup"}}))
        arrays.append(ik.load_grasp(path).arrays(ik.load_robot(ROBOT).fingers))
    targets = tmp_path / "targets.npz"
    points, normals = (np.stack(both) for both in zip(*arrays, strict=True))
    np.savez(targets, points=points, normals=normals)
    for source in (folder, targets):
        assert run("choose", source, *words).exit == 0
        scores_again = [item["score"] for item in json.loads(out.read_text())["ranked"]]
        np.testing.assert_allclose(scores_again, scores, atol=1e-9)


def test_failed_choice_counts_reasons(run: Command, candidates: Path, tmp_path: Path) -> None:
    out = tmp_path / "ranked.json"
    far_pose = ("--object-pose", "5", "0", "0", "0", "0", "0")
    done = run("choose", candidates, "--robot", ROBOT, *far_pose, "--out", out)
    assert done.exit == 1
    assert done.out.startswith("NONE FOUND")
    assert "4 have none: STALLED" in done.out
    report = json.loads(out.read_text())
    assert report["ranked"] == []
    assert sum(report["failures"].values()) == 4


def test_palms_of_a_table(run: Command, tmp_path: Path) -> None:
    """Hand postures of a table stay as they are, and their palms are written."""
    robot, out = ik.load_robot(ROBOT), tmp_path / "ranked.json"
    q = robot.random(np.random.default_rng(5), 8)
    palms, motors = robot.palm(q), robot.actuators[7:]
    rows = ["x,y,z,roll,pitch,yaw," + ",".join(motors)]
    for palm, row in zip(palms, q, strict=True):
        angles = Rotation.from_matrix(palm[:3, :3]).as_euler("xyz")
        rows.append(",".join(repr(float(v)) for v in (*palm[:3, 3], *angles, *row[7:])))
    path = tmp_path / "grasps.csv"
    path.write_text("\n".join(rows))
    words = ("choose", path, "--robot", ROBOT, "--out", out)
    run(*words, "--limit", "3", "--per-candidate", "2").fine()
    report = json.loads(out.read_text())
    assert (report["candidates"], report["answered"]) == (8, 8)
    for item in report["ranked"]:
        assert item["solution"]["palm"]["ok"]
        assert item["solution"]["q"][7:] == pytest.approx(q[item["candidate"]][7:].tolist())
    assert "layout" in run(*words, "--layout", "mine").error
    assert "bodex" in run(*words, "--layout", "bodex").error
    path.write_text(rows[0].replace("bh_spread", "spread") + "\n" + rows[1])
    refused = run(*words)
    assert refused.exit == 2
    assert "grasps.csv: joint 'spread' is unknown" in refused.error.replace("\n", " ")


def test_nearest_of_infeasible_candidates(run: Command, candidates: Path, tmp_path: Path) -> None:
    out = tmp_path / "ranked.json"
    far = ("--object-pose", "-3.0", "0.127", "0.41", "0", "0", "0.3")
    done = run("choose", candidates, "--robot", ROBOT, *far, "--best-effort", "--out", out)
    assert done.exit == 1
    assert done.out.startswith("NEAREST")
    report = json.loads(out.read_text())
    assert report["answered"] == 0
    assert len(report["ranked"]) == 4
    assert all(item["score"] < -1 for item in report["ranked"])
