"""A rigid motion of a robot's base changes no answer: the targets are moved along."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import pytest
from moved_base import on_pedestal, random_pose
from toy_robots import grasp_at, grasps_of

import casadi_ik as ik

PAIR = """
name: pair
sides:
  left: {arm: ur5e, hand: panda_hand, at: {xyz: [0, 0.3, 0]}}
  right: {arm: ur5e, hand: panda_hand, at: {xyz: [0, -0.3, 0]}}
"""
MOBILE = """
name: mobile
trunk: planar
sides:
  arm: {arm: ur5e, hand: panda_hand, at: {xyz: [0, 0, 0.5]}}
"""
QUESTIONS = ("batch", "single", "fast", "choose", "palms", "clearance")
ROBOTS = {
    "arm": ("ur5e+tool", QUESTIONS),
    "hand": ("dclaw", QUESTIONS),
    "arm_and_hand": ("ur5e+panda_hand", ("batch", "single", "choose")),
    "two_arms": (PAIR, ("batch", "single", "choose", "palms")),
    "mobile_arm": (MOBILE, ("batch", "single")),
}
"""Robots and their calls: of a multi-arm robot, each other call takes about 10 s of compilation."""


class Questions:
    """Calls about ten configurations of a robot: their contacts and palms.

    Attributes:
        robot: The robot.
        q: (k, n) configurations.
        start: (k, n) q0 of each.
        points: (k, f, 3) contacts of q [m].
        normals: (k, f, 3) contacts of q.
    """

    def __init__(self, robot: ik.ArmHand) -> None:
        """Draw the configurations."""
        self.robot = robot
        self.q = robot.random(np.random.default_rng(1), 10)
        self.start = self.q[::-1]
        self.points, self.normals = robot.contacts(self.q)
        self.grasps = grasps_of(robot, self.points, self.normals)

    @cached_property
    def solver(self) -> ik.Solver:
        """The solver without a scene."""
        return ik.Solver(self.robot)

    def batch(self) -> np.ndarray:
        """Return the answers of a batch."""
        batch = self.solver.solve_batch(self.points, self.normals, q0=self.start)
        assert batch.success.all()
        return batch.q

    def single(self) -> np.ndarray:
        """Return the answers one by one."""
        return np.array(list(map(self._solved, self.grasps, self.start)))

    def fast(self) -> np.ndarray:
        """Return the answers of the fast solver."""
        fast = self.solver.fast()
        answers = [
            fast(*question) for question in zip(self.points, self.normals, self.start, strict=True)
        ]
        assert {status for _, status in answers} == {ik.Status.SOLVED}
        return np.array([q for q, _ in answers])

    def choose(self) -> np.ndarray:
        """Return the answers of a choice among all grasps, in the grasps' order."""
        ranked = self.solver.choose(self.grasps, q0=self.start[0], prefer="q0", apart=0)
        assert len(ranked) == len(self.grasps)
        return np.array([choice.q for choice in sorted(ranked, key=lambda item: item.candidate)])

    def palms(self) -> np.ndarray:
        """Return the answers to the palms of all sides."""
        robot = self.robot
        if not robot.sides:
            batch = self.solver.solve_palms(robot.palm(self.q), self.q, q0=self.start)
            assert batch.success.all()
            return batch.q
        hands = [name for side in robot.description.sides for name in side.hand]
        grasps = [
            ik.Grasp(
                palm={side: robot.palm(q, side) for side in robot.sides},
                posture={name: float(q[robot.actuators.index(name)]) for name in hands},
            )
            for q in self.q
        ]
        return np.array(list(map(self._solved, grasps, self.start)))

    def clearance(self) -> np.ndarray:
        """Return the clearances of all configurations from self-collision."""
        check = ik.Solver(self.robot, scene=ik.Scene()).check
        return check(self.q, grasp_at(self.robot, self.q[0])).distance[:, None]

    def _solved(self, grasp: ik.Grasp, start: np.ndarray) -> np.ndarray:
        solution = self.solver.solve(grasp, q0=start)
        assert solution.success
        return solution.q


@pytest.fixture(scope="module")
def questions(tmp_path_factory) -> Callable[[str], tuple[Questions, Questions]]:
    """Import a robot twice: upright, and with its base moved."""

    @cache
    def imported(name: str) -> tuple[Questions, Questions]:
        folder = tmp_path_factory.mktemp(name)
        path: str | Path = ROBOTS[name][0]
        if "sides" in str(path):
            path = folder / "body.yaml"
            path.write_text(ROBOTS[name][0])
        robot, base = ik.load_robot(path), random_pose(np.random.default_rng(3))
        upright = Questions(on_pedestal(robot, folder / "upright"))
        moved_robot = Questions(on_pedestal(robot, folder / "moved", base))
        points = upright.points @ base[:3, :3].T + base[:3, 3]
        np.testing.assert_allclose(moved_robot.points, points, atol=1e-9)
        return upright, moved_robot

    return imported


@pytest.mark.parametrize(
    ("name", "call"),
    [
        pytest.param(name, call, marks=() if name == "arm_and_hand" else pytest.mark.slow)
        for name, (_, calls) in ROBOTS.items()
        for call in calls
    ],
)
def test_answers_are_invariant_to_the_base_pose(questions, name, call):
    answers, moved_answers = (getattr(robot, call)() for robot in questions(name))
    assert answers.shape == moved_answers.shape
    # Rounding decides between arms that score alike.
    assert np.isclose(answers, moved_answers, atol=1e-5).all(axis=1).mean() >= 0.75


def test_two_arms_on_a_moved_base(tmp_path):
    """Sides that are placed by `at` are solved wherever their places are."""
    text = PAIR.replace("[0, 0.3, 0]", "[0.2, 0.3, 0.7], rpy: [0.3, 0.2, 1]")
    path = tmp_path / "pair.yaml"
    path.write_text(text)
    assert Questions(ik.load_robot(path)).batch().shape == (10, 14)
