"""A robot that follows moving contacts: one call a cycle, arrays in, motor positions out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, InvalidPoseError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import lost_contacts_reason
from casadi_ik.files.input_checks.poses import single_pose
from casadi_ik.kinematics.contacts import Kinds, group_by_kinds, point_normal_kinds
from casadi_ik.model.grasp import Grasp, real_array
from casadi_ik.motion.clear import OBSTACLES, Guard, motor_units, stopping_way
from casadi_ik.motion.inputs import FollowerInputs, FollowPlan
from casadi_ik.motion.recovery import Recovery
from casadi_ik.solve.solution import Pair
from casadi_ik.solve.verdict import TOLERANCE_SLACK

Poses = Mapping[str | None, Array]
"""Of palms (4, 4), by side; None: of the only one."""


class FollowStatus(Enum):
    """Result of a cycle.

    Example:
        >>> ik.motion.FollowStatus.LATE.name
        'LATE'
    """

    FOLLOWING = "following"
    """Every contact is within tolerance."""
    LATE = "late"
    """The motors are under way: velocities and accelerations permit no more."""
    MISSED = "missed"
    """No posture was found on this branch that meets the contacts: out of reach, or behind a
    limit."""
    BLOCKED = "blocked"
    """Going on would touch something: the motors stop short."""
    HOLDING = "holding"
    """The frame was none: the motors come to rest and wait."""


@dataclass(frozen=True, eq=False)
class FollowState:
    """State after the last cycle.

    Attributes:
        status: In one word.
        reason: What was wrong with the frame, "" if nothing was.
        q: (n,) where the motors are told to be [rad or m].
        velocity: (n,) how fast they go there [rad/s or m/s].
        position_error: (f,) how far the fingertips are from their contacts then [m], NaN where
            free.
        angle_error: (f,) likewise [rad].
        goal: (n,) the posture they are on their way to.
        goal_position_error: (f,) how far off the contacts that is [m], NaN where free.
        goal_angle_error: (f,) likewise [rad].
        clearance: Distance of the pair nearest to being too near [m]; None without a scene.
        closest: That pair.
        cycles: How many there were.

    Example:
        >>> follower = solver.follow(q0=solution.q)
        >>> q = follower(grasp)
        >>> state = follower.state
        >>> bool(state.position_error.max() < 5e-3), state.cycles
        (True, 1)
    """

    status: FollowStatus
    reason: str
    q: Array
    velocity: Array
    position_error: Array
    angle_error: Array
    goal: Array
    goal_position_error: Array
    goal_angle_error: Array
    clearance: float | None
    closest: Pair | None
    cycles: int


NO_FRAME = "no frame yet"

IDENTITY = np.eye(4)
"""A palm's pose that trackers send for a lost hand: no palm is in the base with its axes."""

PALM_WEIGHT = 0.1
"""How much a palm's place and its axes count unless said, a contact counting 1."""


class Follower:
    """Follows moving contacts cycle by cycle, within the limits of the motors.

    Whatever the targets do: positions, velocities and accelerations stay within limits, the
    posture stays on its branch, and where the solver has a scene the robot can always come to rest
    before it touches anything that stands still. A frame that is none (partly NaN, infinite, a
    zero normal, no contact at all) is no error of a stream: the motors come to rest, and go on
    with the next. An instance follows one robot; threads need one each.

    Attributes:
        period: Time from cycle to cycle [s].
        velocity: (n,) limits that are kept [rad/s or m/s].
        acceleration: (n,) limits that are kept [rad/s^2 or m/s^2].

    Example:
        >>> follower = solver.follow(q0=robot.home, period=0.001)
        >>> points, normals = robot.contacts(robot.home)
        >>> for _ in range(50):
        ...     points = points + [0.0, 0.0, 1e-4]
        ...     q = follower(points, normals)
        >>> follower.state.status.name
        'FOLLOWING'
    """

    def __init__(self, plan: FollowPlan) -> None:
        """Compile what is not compiled yet, and lay the memory out; `Solver.follow` makes it."""
        self._plan = plan
        self.period = plan.period
        self.velocity, self.acceleration = plan.rates.velocity, plan.rates.acceleration
        self._change = plan.rates.steps(plan.period)[1]
        robot = plan.robot
        self._n, self._shape = len(robot.actuators), (len(robot.fingers), 3)
        self._usual = point_normal_kinds(self._shape[0])
        self._tolerances = self._own = tuple(plan.request.tolerances.values())
        self._all_asked: dict[Kinds, FollowerInputs] = {}
        self._posture = plan.posture
        self._guard = None if plan.check is None else Guard(plan)
        self._asked = self._of(self._usual)
        fastest, change = plan.rates.steps(plan.period)
        units = motor_units(robot)
        self._recovery = Recovery(units, fastest, change, plan.period, self._guard)
        self.reset(plan.q0)

    def _of(self, kinds: Kinds) -> FollowerInputs:
        """The memory for some kinds of contacts."""
        found = self._all_asked.get(kinds)
        if found is None:
            obstacles = 0 if self._guard is None else OBSTACLES
            found = self._all_asked[kinds] = FollowerInputs(self._plan, kinds, obstacles)
            found.lead_to(self._posture)
        return found

    def _take_up(self, kinds: Kinds) -> None:
        """Go on with contacts of some kinds."""
        n, old = 3 * self._n + 1, self._asked.run.state
        self._asked = self._of(kinds)
        state = self._asked.run.state
        # The errors that are left belong to other rows; none is the honest guess.
        state[:n], state[n:] = old[:n], 0.0

    def reset(self, q: ArrayLike) -> None:
        """Go on from a posture, at rest: for a robot that something else has moved.

        Args:
            q: (n,) [rad or m]; moved into the limits.

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> follower = solver.follow(q0=robot.home)
            >>> follower.reset(solution.q)
            >>> bool(np.allclose(follower.state.q, solution.q))
            True
        """
        inside = self._inside(q)
        self._asked.run.state[:] = self._asked.state_at(inside)
        self._reason, self._cycles, self._stopped = NO_FRAME, 0, False
        self._recovery.reset(inside)

    def branch(self, q: ArrayLike) -> None:
        """Change the branch: the motors go to a posture, every one on its own, and follow there.

        Motions that the contacts leave free lead to this posture from now on.

        A solution of the contacts of now (`Solver.solve`, `Solver.solve_all`) is what to ask for:
        from another posture the goal moves on to them at once.

        Args:
            q: (n,) [rad or m]; moved into the limits.

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> follower = solver.follow(q0=solution.q)
            >>> follower.branch(solver.solve_all(grasp, limit=2)[1].q)
            >>> follower(grasp).shape
            (14,)
        """
        n, state, goal = self._n, self._asked.run.state, self._inside(q)
        state[2 * n : 3 * n], state[3 * n] = goal, 0.0
        self._recovery.follow()
        self._posture = goal
        for asked in self._all_asked.values():
            asked.lead_to(goal)

    def _inside(self, q: ArrayLike) -> Array:
        return np.clip(self._plan.request.start(q), *self._plan.bounds)

    def __call__(
        self,
        target: Grasp | ArrayLike,
        normals: ArrayLike | None = None,
        palm: ArrayLike | Mapping[str, ArrayLike] | None = None,
        palm_weight: tuple[float, float] = (PALM_WEIGHT, PALM_WEIGHT),
    ) -> Array:
        """One cycle.

        Args:
            target: A grasp, whose contacts may be of any kind; or (f, 3) contact points [m], base
                frame, in `robot.fingers` order, NaN marks a free finger.
            normals: (f, 3) outward pad normals of any length, NaN marks a free one; None: all are
                free.
            palm: (4, 4) where the palm is wanted, base frame, as far as the contacts leave it
                free; of a body by side; None: anywhere.
            palm_weight: How much its place and its axes count, a contact counting 1.

        Returns:
            (n,) where the motors are to be at the end of the cycle [rad or m].

        Raises:
            InputError: Wrong shapes or no numbers, or a grasp the robot cannot take. Points,
                normals and poses of a tracker that has lost the hand are not an error: the motors
                come to rest, and `FollowState.reason` says why.
        """
        self._cycles += 1
        poses, self._reason = self._poses(palm)
        if isinstance(target, Grasp):
            self._ask_grasp(target, normals)
            return self._finish(self._hold() if self._reason else self._step(poses, palm_weight))
        points = self._vectors("points", target)
        facing = None if normals is None else self._vectors("normals", normals)
        # All coordinates of a lost hand are alike: seldom the case, and cheap to see.
        if points[0, 0] == points[-1, 0]:
            self._reason = self._reason or lost_contacts_reason(points)
        if self._reason:
            return self._finish(self._hold())
        if self._asked.cycle.kinds != self._usual:
            self._take_up(self._usual)
        self._tolerances = self._own
        self._asked.ask(points, facing)
        after = self._step(poses, palm_weight)
        if not self._asked.sound:
            after = self._step_partly(points, facing, poses, palm_weight)
        return self._finish(after)

    def _finish(self, state: Array) -> Array:
        """Return where the motors are after a cycle, (n,), and update the recovery."""
        n = self._n
        q = state[:n].copy()
        if self._reason:
            self._recovery.follow()
        else:
            self._recovery.update(self._asked, q, state[n : 2 * n], self._stopped)
        return q

    def _step(self, palms: Poses, palm_weight: tuple[float, float]) -> Array:
        """The state after a step towards what was asked."""
        asked = self._asked
        if palms:
            asked.ask_palms(palms, palm_weight)
        step = self._recovery.step(asked.run.state)
        if self._guard is not None:
            after, self._stopped = self._guard.step(asked, step)
        else:
            after = asked.run.step() if step is None else asked.step_by(step)
        if palms:
            asked.free_palms()
        return after

    def _step_partly(
        self,
        points: Array,
        normals: Array | None,
        palms: Poses,
        palm_weight: tuple[float, float],
    ) -> Array:
        """The same instead of the last step, with contacts of which some are free or none."""
        asked = self._asked
        asked.run.back()
        free = np.full(self._shape, np.nan)
        self._reason = asked.ask_partly(points, free if normals is None else normals)
        if not self._reason:
            after = self._step(palms, palm_weight)
            if asked.sound:
                return after
            asked.run.back()
            self._reason = "a number is out of range"
        return self._hold()

    def _hold(self) -> Array:
        """Return the state after a step in which the motors come to rest."""
        self._recovery.follow()
        self._asked.ask_nothing()
        self._go_to_rest(self._asked)
        return self._step({}, (PALM_WEIGHT, PALM_WEIGHT))

    def _ask_grasp(self, grasp: Grasp, normals: ArrayLike | None) -> None:
        if normals is not None:
            raise InputError("normals: found beside a grasp, expected them in it")
        problem = self._plan.request.of_grasps([grasp], None)
        ((kinds, _, _),) = group_by_kinds(problem)
        if kinds != self._asked.cycle.kinds:
            self._take_up(kinds)
        self._tolerances = problem.tolerances
        self._asked.ask_problem(problem)
        if self._guard is not None:
            self._guard.surround(problem)

    def _go_to_rest(self, asked: FollowerInputs) -> None:
        """Make the place where the motors can stop their goal."""
        n, state = self._n, asked.run.state
        state[2 * n : 3 * n] = state[:n] + stopping_way(state[n : 2 * n], self._change)
        state[3 * n] = 0.0

    def _vectors(self, name: str, value: ArrayLike) -> Array:
        """(f, 3) numbers, NaN and infinity among them."""
        if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == self._shape:
            return value
        try:
            array = real_array(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers: {error}") from error
        if array.shape != self._shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {self._shape}")
        return array

    @property
    def moves_palm(self) -> bool:
        """Whether there is an arm, so that the palm may be asked for."""
        return bool(self._asked.cycle.palms)

    def _poses(self, palm: ArrayLike | Mapping[str, ArrayLike] | None) -> tuple[Poses, str]:
        """Return the poses by side (of an arm with a hand by None), and what is wrong with them."""
        if palm is None:
            return {}, ""
        known = self._asked.cycle.palms
        if not known:
            raise InputError("palm: found a pose for a hand that stands still, expected None")
        poses = palm if isinstance(palm, Mapping) else {None: palm}
        for side in poses:
            if side not in known:
                names = ", ".join(name for name in known if name)
                expected = f"poses by side: {names}" if names else "one pose"
                found = "one pose" if side is None else f"side {side!r}"
                raise InputError(f"palm: found {found}, expected {expected}")
        exact = dict[str | None, Array]()
        for side, pose in poses.items():
            name = "palm" if side is None else f"palm.{side}"
            try:
                exact[side] = single_pose(pose, name)
            except InvalidPoseError as error:
                return {}, str(error)
            if (exact[side] == IDENTITY).all():
                return {}, f"{name}: the identity, which trackers send for a lost hand"
        return exact, ""

    @property
    def state(self) -> FollowState:
        """State after the last cycle."""
        n, asked = self._n, self._asked
        q, moved, goal = (part.copy() for part in asked.run.state[: 3 * n].reshape(3, n))
        free = asked.views["weights"].T == 0
        names = "position_error", "angle_error", "goal_position_error", "goal_angle_error"
        errors = {
            name: np.where(free[i % 2], np.nan, asked.record[name]) for i, name in enumerate(names)
        }
        if self._stopped:
            # What was recorded is of the step that was not made.
            errors["position_error"], errors["angle_error"] = asked.errors(q)
        clear = None if self._guard is None else self._guard.clearance(q)
        return FollowState(
            status=self._status(errors),
            reason=self._reason,
            q=q,
            velocity=moved / self.period,
            goal=goal,
            **errors,
            clearance=None if clear is None else float(clear.distance[0]),
            closest=None if clear is None else clear.pair(0),
            cycles=self._cycles,
        )

    def _status(self, errors: dict[str, Array]) -> FollowStatus:
        if self._reason:
            return FollowStatus.HOLDING
        if self._met(errors["position_error"], errors["angle_error"]):
            return FollowStatus.FOLLOWING
        if self._stopped:
            return FollowStatus.BLOCKED
        if self._met(errors["goal_position_error"], errors["goal_angle_error"]):
            return FollowStatus.LATE
        return FollowStatus.MISSED

    def _met(self, position: Array, angle: Array) -> bool:
        most = np.array([(one.position, one.angle) for one in self._tolerances]).T
        slack = most * (1 + TOLERANCE_SLACK)
        # What is free is NaN, and no miss.
        return not ((position > slack[0]) | (angle > slack[1])).any()
