"""What a solver knows of its scene: how near things are, and what follows when they move."""

from __future__ import annotations

from copy import copy
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.pose import one_pose
from casadi_ik.problem.clearance import Clearances
from casadi_ik.problem.questions import Questions
from casadi_ik.solving.engine import Engine


class SurroundedSolver:
    """The part of `Solver` that looks about."""

    robot: ArmHand
    scene: Scene | None
    _engine: Engine
    _questions: Questions
    _asked: tuple[Any, ...]

    def moved(self, name: str, pose: ArrayLike) -> Self:
        """The same solver with something in its scene elsewhere, in less than a millisecond.

        Args:
            name: Of an item of the scene.
            pose: (4, 4) of it in the base frame.

        Raises:
            InputError: The solver has no scene, or this is no pose.
            UnknownNameError: The scene has no such item.
            DescriptionError: It would stand in the robot's base.

        Example:
            >>> lower = np.eye(4)
            >>> lower[2, 3] = -0.3
            >>> among = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> among.moved("table", lower).solve(grasp).status.name
            'SOLVED'
        """
        check = self._engine.check
        if check is None:
            raise InputError(f"{name!r} cannot be moved: the solver has no scene")
        other = copy(self)
        moved = check.moved(name, one_pose(pose))
        other.scene, other._engine = moved.scene, self._engine.about(moved)
        other._asked = (*self._asked[:-1], moved.scene)
        return other

    def check(self, q: ArrayLike, grasp: Grasp) -> Clearances | None:
        """How far configurations are from touching anything they must not touch.

        Args:
            q: (n,) or (k, n) actuator positions [rad or m].
            grasp: Its fingers may touch what is grasped.

        Returns:
            Clearances of the k configurations (one for a single q); None without a scene.

        Raises:
            InputError: Bad q, or a grasp that the robot cannot take.

        Example:
            >>> among = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> bool(among.check(solution.q, grasp).distance[0] > 0)
            True
        """
        problems = self._questions.of_grasps([grasp], None)
        around = self._engine.around(problems)
        return around and around.check(np.atleast_2d(self.robot.configuration(q)))
