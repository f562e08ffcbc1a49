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


CALLS: dict[str, tuple[str, Callable[[ik.Solver, ik.Grasp], Any]]] = {
    "contacts as a list": ("contacts", lambda s, g: ik.Grasp(list(g.contacts.values()))),  # type: ignore[arg-type]
    "posture as a list": ("posture", lambda s, g: ik.Grasp(palm=np.eye(4), posture=[0.0])),  # type: ignore[arg-type]
    "fixed as a list": ("fixed", lambda s, g: s.solve(g, fixed=["lwr_joint_1"])),  # type: ignore[arg-type]
    "options as a number": ("options", lambda s, g: ik.Solver(s.robot, options=3)),  # type: ignore[arg-type]
    "log as a number": ("log", lambda s, g: s.solve(g, log=3)),  # type: ignore[arg-type]
    "solids as a list": ("solids", lambda s, g: ik.Scene([{"kind": "box"}])),  # type: ignore[arg-type]
    "solids as a name": ("solids", lambda s, g: ik.Scene("table")),  # type: ignore[arg-type]
    "name as a number": ("name", lambda s, g: ik.Scene(name=3)),  # type: ignore[arg-type]
    "a grasp to track": ("grasps", lambda s, g: s.track(g)),  # type: ignore[arg-type]
    "a name to track": ("grasps", lambda s, g: s.track("cup")),  # type: ignore[arg-type]
    "a seed to move": ("seed", lambda s, g: s.move(s.robot.home, s.robot.home, seed=-1)),
    "poses to move to": (
        "pose of",
        lambda s, g: ik.load_scene("table").moved("table", [np.eye(4)]),
    ),
    "poses to hold at": ("pose of", lambda s, g: ik.Scene().holding("cup", [np.eye(4)])),
}
"""Call with an argument of another type or form, and how its message begins."""


@pytest.mark.parametrize("call", CALLS)
def test_an_argument_of_another_form(solver: ik.Solver, grasp: ik.Grasp, call: str) -> None:
    location, function = CALLS[call]
    with pytest.raises(ik.errors.InputError, match=f"^{location}"):
        function(solver, grasp)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", [1e-300, 1e-16])
def test_a_tolerance_below_rounding(number: float) -> None:
    with pytest.raises(ik.errors.InputError, match=r"^tolerance\.position: "):
        ik.Tolerance(number)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("coordinate", [1e10, 1e200])
def test_a_coordinate_that_overflows(solver: ik.Solver, coordinate: float) -> None:
    with pytest.raises(ik.errors.InputError, match=r"^contacts: .*1e\+"):
        solver.solve(ik.Grasp({"thumb": ik.Contact([coordinate, 0, 0])}))


def test_a_rate_that_overflows(solver: ik.Solver) -> None:
    home = solver.robot.home
    with pytest.raises(ik.errors.InputError, match=r"^acceleration: .*1e\+300"):
        solver.move(home, home, acceleration=1e300)


def test_no_palms(solver: ik.Solver) -> None:
    for postures in (solver.robot.home, np.zeros((0, 14))):
        assert len(solver.solve_palms(np.zeros((0, 4, 4)), postures)) == 0
