"""Arguments of another type are refused by name, without a traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import casadi_ik as ik


def failing(*_: Any) -> Any:
    raise RuntimeError("a fault of the caller's")


@pytest.fixture(scope="module")
def grasp() -> ik.Grasp:
    return ik.load_grasp("cup")


@pytest.mark.parametrize("of", [lambda g: None, lambda g: g, lambda g: "cup", lambda g: {"a": g}])
def test_non_grasp_candidates_are_refused(
    solver: ik.Solver, grasp: ik.Grasp, of: Callable[..., Any]
):
    with pytest.raises(ik.errors.InputError, match=r"^grasps:.*\w+"):
        solver.choose(of(grasp))


def test_generator_of_candidates_is_accepted(solver: ik.Solver, grasp: ik.Grasp) -> None:
    ranking = solver.choose(candidate for candidate in (grasp, ik.load_grasp("apple")))
    assert (ranking.candidates, ranking.answered) == (2, 2)


@pytest.mark.parametrize("prefer", [failing, lambda: 0.0, lambda robot, q: "high"])
def test_failing_preference_is_reported(solver: ik.Solver, grasp: ik.Grasp, prefer: Any) -> None:
    with pytest.raises(ik.errors.InputError, match=r"^prefer: ") as caught:
        solver.choose([grasp], prefer=prefer)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize("elapsed", [None, "soon", np.array([0.1, 0.2]), 0.0, np.nan])
def test_a_time_between_frames(robot: ik.ArmHand, tmp_path: Path, elapsed: Any) -> None:
    (tmp_path / "hand.yaml").write_text("fingers: {thumb: 4, finger_2: 8, finger_3: 12}")
    retargeter = ik.motion.Retargeter(ik.motion.load_retarget(tmp_path / "hand.yaml"), robot)
    with pytest.raises(ik.errors.InputError, match=r"^elapsed: "):
        retargeter(np.random.default_rng(0).uniform(0, 0.1, (21, 3)), elapsed=elapsed)


def test_sensitivity_of_empty_batch(solver: ik.Solver) -> None:
    q, contacts = np.zeros((0, 14)), np.zeros((0, 3, 3))
    assert solver.sensitivity(q, contacts, contacts).points.shape == (0, 14, 3, 3)
    weighted = solver.sensitivity(q, contacts, contacts, np.zeros((0, 14)))
    assert weighted.points.shape == weighted.normals.shape == (0, 3, 3)


@pytest.mark.parametrize("of", [lambda g: g, lambda g: None, lambda g: np.zeros(14)])
def test_placing_a_non_solution_is_refused(
    solver: ik.Solver, grasp: ik.Grasp, of: Callable[..., Any]
) -> None:
    with pytest.raises(ik.errors.InputError, match=r"^held: "):
        solver.place(of(grasp), np.eye(4), solver.robot.home)


@pytest.mark.parametrize("points", [[], np.zeros((0, 3)), np.zeros((3, 3))])
def test_a_convex_solid_of_too_few_points(points: Any) -> None:
    with pytest.raises(ik.errors.DescriptionError, match=rf"block\.points: .*{len(points)}"):
        ik.Scene({"block": {"kind": "convex", "points": points}})
