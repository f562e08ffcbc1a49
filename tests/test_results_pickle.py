"""Every public result can be pickled, copied and deep-copied without loss."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from toy_robots import grasp_of

import casadi_ik as ik

COPIES = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}


def is_same(a: Any, b: Any, depth: int = 0) -> bool:
    """Return whether two results hold the same public data."""
    if type(a) is not type(b) or depth > 8:
        return type(a) is type(b)
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, Mapping):
        return a.keys() == b.keys() and all(is_same(a[key], b[key], depth + 1) for key in a)
    if isinstance(a, str | Enum | bytes):
        return a == b
    if dataclasses.is_dataclass(a):
        names = [item.name for item in dataclasses.fields(a)]
        return all(is_same(getattr(a, name), getattr(b, name), depth + 1) for name in names)
    if isinstance(a, Sequence):
        return len(a) == len(b) and all(is_same(x, y, depth + 1) for x, y in zip(a, b, strict=True))
    if isinstance(a, float):
        return a == b or (np.isnan(a) and np.isnan(b))
    return not isinstance(a, int) or a == b


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder: Path = tmp_path_factory.mktemp("results")
    robot, cup = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    wall = {"kind": "box", "size": [0.02, 0.6, 0.6], "xyz": [-0.8, 0.1, 0.4]}
    scene = ik.Scene({"wall": wall})
    solver = ik.Solver(robot)
    q = robot.random(np.random.default_rng(0), 8)
    points, normals = robot.contacts(q)
    points[7] += 9.0
    batch = solver.solve_batch(points, normals, diagnose=True)
    ranking = solver.choose([grasp_of(robot, points[0], normals[0]), cup])
    blocked = ik.Solver(robot, scene=scene).solve(cup)
    solution = solver.solve(cup, log=folder / "cup.mcap")
    log = ik.logs.open(folder / "cup.mcap")
    follower = solver.follow(robot.home, period=0.01)
    follower(cup)
    track = solver.track([grasp_of(robot, points[i], normals[i]) for i in (0, 1)])
    reach = solver.reach(cup)
    trimesh.creation.cylinder(0.033, 0.1, sections=32).export(folder / "can.stl")
    surface = ik.load_surface(folder / "can.stl")
    place = np.eye(4)
    place[:3, 3] = [0.5, 0.1, 0.055]
    gripper = ik.Solver(ik.load_robot("panda+panda_hand"), scene=ik.load_scene("table"))
    grasps = gripper.grasps_of(surface, place, limit=1, among=1)
    np.savez(folder / "grasps.npz", points=points[:3], normals=normals[:3])
    one_solve = ik.logs.one_solve(log)
    return {
        "ArmHand": robot,
        "Solver": solver,
        "Grasp": cup,
        "Contact": cup.contacts["thumb"],
        "Tolerance": ik.Tolerance(),
        "Free": ik.Free((0.3, -0.2, 0.1, 0, 0, -1.0), (0.5, 0.2, 0.4, 0, 0, 1.0)),
        "Scene": scene,
        "Surface": surface,
        "Candidates": ik.load_candidates(folder / "grasps.npz", robot),
        "Solution": solution,
        "blocked Solution": blocked,
        "CollisionReport": blocked.collision,
        "ContactVerdict": next(iter(solution.contacts.values())),
        "BatchSolution": batch,
        "Diagnosis": batch.diagnoses[7],
        "Ranking": ranking,
        "Choice": ranking[0],
        "Alternatives": solver.solve_all(cup, limit=2),
        "Sensitivity": solver.sensitivity(q[:2], points[:2], normals[:2]),
        "Clearances": ik.Solver(robot, scene=scene).check(robot.home, cup),
        "FoundGrasps": grasps,
        "FoundGrasp": grasps[0],
        "FollowState": follower.state,
        "Track": track,
        "Reach": reach,
        "Motion": reach.motion,
        "Approach": solver.approach(cup),
        "Log": log,
        "LogInfo": log.info(),
        "Table": log.iterations(),
        "SolveRecord": one_solve,
        "Explanation": ik.logs.explain(one_solve),
    }


KINDS = (
    *("ArmHand", "Solver", "Grasp", "Contact", "Tolerance", "Free", "Scene", "Surface"),
    *("Candidates", "Solution", "blocked Solution", "CollisionReport", "ContactVerdict"),
    *("BatchSolution", "Diagnosis", "Ranking", "Choice", "Alternatives", "Sensitivity"),
    *("Clearances", "FoundGrasps", "FoundGrasp", "FollowState", "Track", "Reach", "Motion"),
    *("Approach", "Log", "LogInfo", "Table", "SolveRecord", "Explanation"),
)


@pytest.mark.parametrize("copy_kind", COPIES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_result_survives_copying(results: dict[str, Any], kind: str, copy_kind: str) -> None:
    value = results[kind]
    assert value is not None
    copied = COPIES[copy_kind](value)
    assert is_same(copied, value)
    assert str(copied).split(" at 0x")[0] == str(value).split(" at 0x")[0]


@pytest.mark.parametrize("kind", KINDS)
def test_representations_are_short(results: dict[str, Any], kind: str) -> None:
    text = repr(results[kind])
    assert text.count("\n") < 25
    assert len(text) < 2000


@pytest.mark.parametrize("method", ["hand-first", "ipopt", "enhanced-dls"])
@pytest.mark.parametrize("copied", ["pickle", "deepcopy"])
def test_copies_of_solvers_give_the_same_solution(
    robot: ik.ArmHand, method: str, copied: str
) -> None:
    grasp, solver = (
        ik.load_grasp("cup"),
        ik.Solver(robot, method, {"thumb": ik.Tolerance(1e-3, 0.01)}),
    )
    solver_copy, grasp_copy = COPIES[copied](solver), COPIES[copied](grasp)
    assert solver_copy.tolerances == solver.tolerances
    np.testing.assert_array_equal(solver_copy.solve(grasp_copy).q, solver.solve(grasp).q)


def test_solvers_in_other_processes_give_the_same_solution(robot: ik.ArmHand) -> None:
    joblib = pytest.importorskip("joblib")
    grasp, solver = ik.load_grasp("cup"), ik.Solver(robot)
    with joblib.parallel_config(backend="loky"):
        solutions = joblib.Parallel(n_jobs=2)(joblib.delayed(solver.solve)(grasp) for _ in range(2))
    for solution in solutions:
        np.testing.assert_array_equal(solution.q, solver.solve(grasp).q)
