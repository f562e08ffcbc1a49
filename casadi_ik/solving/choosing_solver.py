"""What a solver offers where there is a choice: all solutions of a grasp, the best of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from numpy.typing import ArrayLike

from casadi_ik.answers.solution import BatchSolution, Ranking
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.pose import checked_pose
from casadi_ik.problem.questions import Questions, hand_postures
from casadi_ik.solving.alternatives.finder import APART, Alternative
from casadi_ik.solving.choose import Judgement, choose
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run


class ChoosingSolver:
    """The part of `Solver` that chooses."""

    _engine: Engine
    _questions: Questions

    def solve_all(
        self,
        grasp: Grasp,
        limit: int = 16,
        prefer: str = "limits",
        q0: ArrayLike | None = None,
        seed: int = 0,
        fixed: Mapping[str, float] | None = None,
        apart: float = APART,
    ) -> tuple[Alternative, ...]:
        """Find different solutions of one grasp, best first.

        For every hand posture that meets the contacts: of an arm in closed form every branch
        (signs of shoulder, elbow and wrist) with the intervals of its freedom, see `ArmBranch`,
        and the preferred arm of each; of another arm the different configurations that many
        starts lead to. Of two alike, one.

        Args:
            grasp: A contact per finger; its fingers must be the robot's.
            limit: How many at most.
            prefer: What comes first: "limits" (far from its limits), "manipulability" (of the
                arm), "clearance", or "q0" (close to it).
            q0: (n,) where the robot is [rad or m]; None is `robot.home`.
            seed: As for `solve`.
            fixed: As for `solve`.
            apart: How different they are: of any two, at least one actuator differs by this part
                of its range, 0 to 1. 0: all that are found.

        Returns:
            The solutions; none if the grasp cannot be solved (`solve` says why).

        Raises:
            InputError: Bad limit, preference, distance or q0, or a grasp the robot cannot take.

        Example:
            >>> several = solver.solve_all(grasp, limit=4, prefer="manipulability")
            >>> len(several), several[0].manipulability >= several[1].manipulability
            (4, True)
        """
        problems = self._questions.of_grasps([grasp], fixed)
        finder = self._engine.kinds_of(problems).finder
        start, around = self._questions.start(q0), self._engine.around(problems)
        return finder.find(problems, start, seed, limit, prefer, apart, around)

    def solve_palms(
        self,
        palms: ArrayLike,
        postures: Mapping[str, ArrayLike] | ArrayLike,
        q0: ArrayLike | None = None,
        seed: int = 0,
        jobs: int = 1,
        diagnose: bool = False,
        fixed: Mapping[str, float] | None = None,
        prefer: str | None = None,
    ) -> BatchSolution:
        """Solve k palms that are given, with hands as they are said: only arms are unknown.

        Args:
            palms: (k, 4, 4) poses of `robot.palm` in the base frame.
            postures: Positions (k,), or one for all, of every motor that moves a finger, by name
                [rad or m]; or configurations (k, n) or (n,) of which these motors are taken.
            q0: (n,) or (k, n) start; None is `robot.home`.
            seed: As for `solve`.
            jobs: Threads, at least 1.
            diagnose: As for `solve_batch`.
            fixed: As for `solve`, for other actuators.
            prefer: As for `solve`.

        Returns:
            As `solve_batch`, with `palm_position_error`, `palm_angle_error` and `palm_ok`.

        Raises:
            InputError: No rigid poses, or postures that are not all there or beyond limits.
            UnknownNameError: No such actuator.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> q = robot.random(np.random.default_rng(4), 50)
            >>> hands = dict(zip(robot.actuators[7:], q[:, 7:].T))  # or q itself
            >>> batch = solver.solve_palms(robot.palm(q), hands)
            >>> bool(batch.success.all()), bool(batch.palm_position_error.max() < 1e-3)
            (True, True)
        """
        poses = checked_pose(palms, "palms")
        if poses.ndim != 3:
            raise InputError(f"palms: found shape {poses.shape}, expected (k, 4, 4)")
        hands = hand_postures(self._questions.robot, postures, len(poses))
        preferred = self._engine.preference(prefer, q0 is not None)
        problems = self._questions.of_palms(poses, hands, fixed, preferred)
        return self._engine.solve(problems, Run(q0, seed, jobs, None, diagnose))

    def choose(
        self,
        grasps: Sequence[Grasp],
        object_pose: ArrayLike | None = None,
        q0: ArrayLike | None = None,
        limit: int = 10,
        prefer: Judgement | None = None,
        seed: int = 0,
        fixed: Mapping[str, float] | None = None,
        apart: float = APART,
        per_candidate: int | None = 1,
    ) -> Ranking:
        """Of many grasps find those that are best to take, and how.

        Of every candidate the different hands that meet its contacts are looked at, with every
        branch of the arm all around its swivel; free of collision where the solver has a scene.
        Which candidates have an answer depends neither on `q0` nor on `prefer`: they order.

        Args:
            grasps: The candidates.
            object_pose: (4, 4) where the object is in the base frame; candidates that do not say
                where theirs is are in its frame. None: they are in the base frame.
            q0: (n,) where the robot is [rad or m]; None is `robot.home`.
            limit: How many answers at most.
            prefer: What comes first: "q0", "limits", "manipulability", "clearance" as for `solve`,
                or a function of the robot and configurations (m, n) that gives their scores (m,),
                higher is better, -inf for never. None: "q0" if q0 is given, else "limits". What is
                given (a palm's hand, `fixed`) is no part of "limits".
            seed: As for `solve`.
            fixed: As for `solve`.
            apart: How different answers are, of one candidate or several: of any two at least one
                actuator differs by this part of its range, 0 to 1. 0: all that are not the same.
            per_candidate: How many answers of one candidate at most; None: any number.

        Returns:
            The answers, best first, and why candidates have none.

        Raises:
            InputError: No candidates, no rigid object_pose, bad q0, limit, preference or distance,
                or a grasp the robot cannot take.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> ranked = solver.choose([grasp, ik.load_grasp("apple")], prefer="limits")
            >>> len(ranked), ranked.answered, ranked[0].score >= ranked[1].score
            (2, 2, True)
        """
        return choose(
            self._engine,
            self._questions,
            grasps,
            object_pose,
            q0,
            limit,
            prefer,
            seed,
            fixed,
            apart,
            per_candidate,
        )
