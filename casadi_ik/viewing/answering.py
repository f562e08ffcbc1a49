"""Questions of a page answered: solved, and told why not where they cannot be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from casadi_ik.answers.solution import Solution
from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, UnsupportedError
from casadi_ik.grasps import Grasp
from casadi_ik.problem.clearance import Closest, closest_points
from casadi_ik.problem.questions import CLEARANCE, Questions, tolerances_by_finger
from casadi_ik.problem.status import Status
from casadi_ik.problem.verdict import ContactVerdict, judge
from casadi_ik.solving.alternatives.finder import Alternative
from casadi_ik.viewing.asked import Asked, Settings

MOST = 64
"""Solutions that are looked for."""

NEARER = 1.02
"""What is found at rest is shown where it misses by so much less than what is shown."""

NOT_MET = "NOT MET"
"""Said of a configuration that has not all it is asked for."""

TOUCHES = "contacts and limits are met, but something touches; looking for a way out"
MISSES = "the nearest that was found; why follows when the mouse rests"
"""Said until it is known why nothing answers."""


@dataclass(frozen=True, eq=False)
class Answered:
    """What is shown.

    Attributes:
        q: (n,) where the robot is: the solution, or what is nearest to one [rad or m].
        success: Whether that is one.
        headline: How it ended, in a word or two.
        contacts: Verdict by finger, on q.
        lines: Why not, and what would help; empty if it is solved.
        clearance: Of q [m]; None where nothing is checked.
        closest: The nearest pair's names and points; None where there is none.
        seconds: The solve took.
        how: Method, iterations and such in a line.
        unexplained: Whether why not has to be found out yet.
    """

    q: Array
    success: bool
    headline: str
    contacts: dict[str, ContactVerdict]
    lines: tuple[str, ...] = ()
    clearance: float | None = None
    closest: tuple[tuple[str, str], Closest] | None = None
    seconds: float = 0.0
    how: str = ""
    unexplained: bool = False


class Answerer:
    """Solves what is asked about one robot; keeps its solvers."""

    def __init__(self, robot: ArmHand) -> None:
        """Take the robot."""
        self.robot = robot
        self._solver = lru_cache(maxsize=16)(self._built)
        # An object's file is read once, wherever it is dragged to.
        self._alone = lru_cache(maxsize=16)(lambda name: Scene().holding(name, np.eye(4)))
        self._in_scene: tuple[Scene | None, Solver] | None = None

    def solver(self, asked: Asked) -> Solver:
        """The solver for a question; one in the scene of the last is that one with things moved.

        Raises:
            CasadiIKError: The scene or the method does not fit the robot.
        """
        settings, scene = asked.settings, asked.scene
        if scene is None:
            return self._solver(settings, None)
        known = self._in_scene
        if known is None or not _alike(known[1], settings, known[0], scene):
            solver = self._solver(settings, scene)
        else:
            solver = known[1]
            for name, item in scene.items.items():
                before = known[0]
                assert before is not None
                if item is not before.items[name]:
                    solver = solver.moved(name, item.pose)
        self._in_scene = scene, solver
        return solver

    def solve(self, asked: Asked, q: Array, solver: Solver | None = None) -> Answered:
        """The answer nearest to q, or the preferred one, or the nearest to one that was found.

        Why there is none takes up to a second to find out: `explain` tells.

        Raises:
            CasadiIKError: The question is malformed.
        """
        return self._answered(asked, q, solver or self.solver(asked), diagnose=False)

    def explain(self, asked: Asked, q: Array) -> Answered:
        """The same with why a grasp is not solved and what would help.

        What is shown stays if nothing nearer is found: of several that are equally near, the arm
        does not go to another when the mouse rests.

        Raises:
            CasadiIKError: The question is malformed.
        """
        solver = self.solver(asked)
        found = self._answered(asked, q, solver, diagnose=True)
        if found.success:
            return found
        shown = self.judged(asked, q, solver)
        if _missed(shown) > NEARER * _missed(found):
            return found
        return replace(
            found,
            q=q,
            contacts=shown.contacts,
            clearance=shown.clearance,
            closest=shown.closest,
        )

    def _answered(self, asked: Asked, q: Array, solver: Solver, diagnose: bool) -> Answered:
        solution = self._preferred(solver, asked.grasp, q, asked, diagnose)
        shown = solution.q
        if solution.diagnosis is not None and solution.status is not Status.COLLISION:
            shown = solution.diagnosis.q
        if not np.isfinite(shown).all():
            shown = q
        found = self.judged(asked, shown, solver)
        words = f"{solution.method} · {counted(solution.iterations, 'iteration')}"
        if solution.restarts:
            words += f" · {counted(solution.restarts, 'restart')}"
        missed = not (diagnose or solution.success or solution.status is Status.COLLISION)
        return replace(
            found,
            success=solution.success,
            headline=NOT_MET if missed else solution.status.name.replace("_", " "),
            lines=why_not(solution),
            seconds=solution.time,
            how=words,
            unexplained=not (diagnose or solution.success),
        )

    def judged(self, asked: Asked, q: Array, solver: Solver | None = None) -> Answered:
        """How a configuration meets what is asked."""
        tolerances = tolerances_by_finger(asked.settings.tolerance, self.robot.fingers)
        enforced = asked.settings.limits == "enforce"
        problems = Questions(self.robot, tolerances, enforced).of_grasps([asked.grasp], None)
        verdict = judge(self.robot, problems, q[None])
        contacts = {
            finger: ContactVerdict(
                float(verdict.position_error[0, i]),
                float(verdict.angle_error[0, i]),
                bool(verdict.ok[0, i]),
                problems.tolerances[i],
            )
            for i, finger in enumerate(self.robot.fingers)
        }
        clearance, closest, free = self._clear(asked, q, solver)
        met = bool(verdict.solved(enforced)[0]) and free
        word = "MET" if met else NOT_MET
        return Answered(q, met, word, contacts, clearance=clearance, closest=closest)

    def every(self, asked: Asked, q: Array) -> tuple[Alternative, ...]:
        """All solutions, by arm branch, swivel and hand posture; none from other methods."""
        settings = asked.settings
        try:
            return self.solver(asked).solve_all(asked.grasp, MOST, settings.prefer, q)
        except UnsupportedError:
            return ()

    def _clear(
        self, asked: Asked, q: Array, solver: Solver | None
    ) -> tuple[float | None, tuple[tuple[str, str], Closest] | None, bool]:
        if asked.scene is None:
            return None, None, True
        clear = (solver or self.solver(asked)).check(q, asked.grasp)
        pair = None if clear is None else clear.pair(0)
        if clear is None or pair is None:
            return None, None, True
        distance, free = float(clear.distance[0]), bool(clear.free[0])
        scene, other = asked.scene, pair[1]
        if other == asked.object and asked.object_pose is not None:
            known = scene if other in scene.items else self._alone(other)
            scene = known.moved(other, asked.object_pose)
        found = closest_points(self.robot, q, scene, pair)
        return distance, None if found is None else (pair, found), free

    def _preferred(
        self, solver: Solver, grasp: Grasp, q: Array, asked: Asked, diagnose: bool
    ) -> Solution:
        prefer = asked.settings.prefer
        if prefer == CLEARANCE and asked.scene is None:
            prefer = "q0"
        try:
            return solver.solve(grasp, q, prefer=prefer, diagnose=diagnose)
        except UnsupportedError:
            # A method that cannot choose takes the solution it comes to.
            return solver.solve(grasp, q, diagnose=diagnose)

    def _built(self, settings: Settings, scene: Scene | None) -> Solver:
        return Solver(self.robot, settings.method, settings.tolerance, settings.limits, scene=scene)


def counted(number: int, what: str) -> str:
    """A number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _missed(answer: Answered) -> float:
    """By how much the worst contact is missed, in tolerances."""
    parts = [0.0]
    for one in answer.contacts.values():
        parts += [
            one.position_error / one.tolerance.position,
            one.angle_error / one.tolerance.angle,
        ]
    return float(np.nanmax(parts))


def why_not(solution: Solution) -> tuple[str, ...]:
    """Why a grasp is not solved, in short lines."""
    if solution.success:
        return ()
    if solution.collision is not None:
        return solution.collision.lines
    if solution.diagnosis is not None:
        return solution.diagnosis.lines
    return (TOUCHES if solution.status is Status.COLLISION else MISSES,)


def _alike(solver: Solver, settings: Settings, before: Scene | None, scene: Scene) -> bool:
    """Whether a solver differs from the one wanted in nothing but where things stand."""
    return (
        before is not None
        and solver.method == settings.method
        and solver.limits == settings.limits
        and set(solver.tolerances.values()) == {settings.tolerance}
        and before.items.keys() == scene.items.keys()
        and before.margin == scene.margin
        and all(before.items[name].parts is one.parts for name, one in scene.items.items())
    )


def failed(error: CasadiIKError, q: Array) -> Answered:
    """What is shown of a question that cannot be asked."""
    return Answered(q, False, "NOT ASKED", {}, (str(error),))
