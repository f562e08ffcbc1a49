"""Follower of moving contacts: one call per cycle, from target arrays to motor positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.clearance_kernel import OBSTACLES
from casadi_ik.errors import InputError, InvalidPoseError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import single_pose
from casadi_ik.files.keypoints import lost_contacts_reason
from casadi_ik.kinematics.contacts import Kinds, group_by_kinds, point_normal_kinds
from casadi_ik.model.grasp import Grasp, real_array
from casadi_ik.motion.clutch import Clutch, Poses
from casadi_ik.motion.cycle import CYCLE_TUNING, StateFields
from casadi_ik.motion.cycle_runner import CycleRunner, FollowerConfig
from casadi_ik.motion.free_path import motor_units
from casadi_ik.motion.guard import Guard, braked, stopping_distance
from casadi_ik.motion.recovery import Recovery, brake
from casadi_ik.solve.solution import Pair
from casadi_ik.solve.verdict import TOLERANCE_SLACK


class FollowStatus(Enum):
    """Result of a cycle.

    Example:
        >>> ik.motion.FollowStatus.LATE.name
        'LATE'
    """

    FOLLOWING = "following"
    """The contacts are within tolerance."""
    LATE = "late"
    """The goal meets the contacts; velocity and acceleration limits delay the motors."""
    MISSED = "missed"
    """Configurations on this branch do not meet the contacts: these are out of reach, or beyond a
    limit."""
    BLOCKED = "blocked"
    """The target leads to a collision: the motors stop before it."""
    HOLDING = "holding"
    """The frame is invalid, or the follower is paused: the motors decelerate to rest and wait."""


@dataclass(frozen=True, eq=False)
class Branch:
    """Configuration whose contact errors are smaller than those of a follower's goal.

    Attributes:
        q: (n,) configuration [rad or m].
        gain: Decrease of the error ratio, the largest error of a contact over its tolerance.
        travel: Largest distance of a motor from its present position [rad or m].

    Example:
        >>> from casadi_ik.motion import Branch
        >>> branch = Branch(robot.home, gain=0.5, travel=0.8)
        >>> branch.q.shape == robot.home.shape
        True
    """

    q: Array
    gain: float
    travel: float


@dataclass(frozen=True, eq=False)
class FollowState:
    """State after the last cycle.

    Attributes:
        status: Result of the cycle.
        reason: Reason why the frame was invalid, "" if it was valid.
        q: (n,) commanded positions of the motors at the end of the cycle [rad or m].
        velocity: (n,) velocities of the motors in the cycle [rad/s or m/s].
        position_error: (f,) position errors of the fingertips at q [m], NaN where free.
        angle_error: (f,) angle errors at q [rad], NaN where free.
        goal: (n,) configuration that the motors track [rad or m].
        goal_position_error: (f,) position errors at the goal [m], NaN where free.
        goal_angle_error: (f,) angle errors at the goal [rad], NaN where free.
        clearance: Distance of the pair with the minimum clearance beyond its margin [m]; None
            without a scene.
        closest: Names of this pair; None without a scene.
        cycles: Number of cycles so far.

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


NO_FRAME_REASON, PAUSED_REASON = "no frame yet", "paused"
"""Values of `FollowState.reason` before the first frame, and during a pause."""

RETURN_SHARE = 0.2
"""Share of the velocity limits at which motors return from beyond their limits."""

MIN_GAIN = 0.1
"""Minimum decrease of the error ratio on a better branch, relative to the present one."""

LOST_HAND_POSE = np.eye(4)
"""Pose that trackers send for a lost hand; a real palm does not coincide with the base frame."""

PALM_WEIGHT = 0.1
"""Default weight of a palm's position and axes relative to a contact."""


class Follower:
    """Follower of moving contacts, cycle by cycle, within the limits of the motors.

    For all targets positions, velocities and accelerations stay within limits, the configuration
    stays on its branch, and with a scene the robot can always stop before it touches a static
    obstacle. An invalid frame (partly NaN, infinite, a zero normal, no contact) is not an error:
    the motors stop, and continue with the next valid frame. An instance is not thread-safe.

    Attributes:
        period: Time from cycle to cycle [s].
        velocity: (n,) velocity limits [rad/s or m/s].
        acceleration: (n,) acceleration limits [rad/s^2 or m/s^2].

    Example:
        >>> follower = solver.follow(q0=robot.home, period=0.001)
        >>> points, normals = robot.contacts(robot.home)
        >>> for _ in range(50):
        ...     points = points + [0.0, 0.0, 1e-4]
        ...     q = follower(points, normals)
        >>> follower.state.status.name
        'FOLLOWING'
    """

    def __init__(self, config: FollowerConfig) -> None:
        """Compile the graphs and allocate the memory; `Solver.follow` calls this."""
        self._config = config
        self.period = config.period
        self.velocity, self.acceleration = config.rates.velocity, config.rates.acceleration
        robot = config.robot
        self._fields = StateFields.of(len(robot.actuators))
        self._contacts_shape = (len(robot.fingers), 3)
        self._point_normal_kinds = point_normal_kinds(len(robot.fingers))
        self._default_tolerances = tuple(config.target_builder.tolerances.values())
        self._tolerances = self._default_tolerances
        self._runner_by_kinds: dict[Kinds, CycleRunner] = {}
        self._posture = config.posture
        self._guard = None if config.check is None else Guard(config)
        self._runner = self._runner_for(self._point_normal_kinds)
        max_step, self._max_change = config.rates.steps(config.period)
        self._recovery = Recovery(
            motor_units(robot), max_step, self._max_change, config.period, self._guard
        )
        self.reset(config.q0)

    def _runner_for(self, kinds: Kinds) -> CycleRunner:
        """Return the evaluator of cycles for given kinds of contacts."""
        runner = self._runner_by_kinds.get(kinds)
        if runner is None:
            obstacles = 0 if self._guard is None else OBSTACLES
            runner = self._runner_by_kinds[kinds] = CycleRunner(self._config, kinds, obstacles)
            runner.set_posture(self._posture)
        return runner

    def _switch_kinds(self, kinds: Kinds) -> None:
        """Continue with contacts of other kinds."""
        previous = self._runner.recurrence.state
        self._runner = self._runner_for(kinds)
        state = self._runner.recurrence.state
        # The residual behind `locked_on` is reset, because its rows depend on the kinds.
        residual_start = self._fields.locked_on + 1
        state[:residual_start], state[residual_start:] = previous[:residual_start], 0.0

    def reset(self, q: ArrayLike) -> None:
        """Restart at rest at a configuration, for a robot that something else has moved.

        Args:
            q: (n,) positions of the motors [rad or m]. Motors beyond their limits return to them at
                a fifth of their velocity limits.

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> follower = solver.follow(q0=robot.home)
            >>> follower.reset(solution.q)
            >>> bool(np.allclose(follower.state.q, solution.q))
            True
        """
        start = self._config.target_builder.start(q)
        self._runner.recurrence.state[:] = self._runner.state_at(start)
        self._reason, self._cycles, self._is_stopped = NO_FRAME_REASON, 0, False
        self._is_paused, self._brakes_in_pause, self._clutch = False, False, None
        self._is_beyond_limits = True
        self._recovery.reset(self._clipped(start))

    def pause(self) -> None:
        """Open the clutch: the motors decelerate to rest, and targets are ignored.

        `branch` moves the motors also during a pause.

        Example:
            >>> follower = solver.follow(q0=solution.q)
            >>> follower.pause()
            >>> bool((follower(grasp) == solution.q).all()), follower.state.reason
            (True, 'paused')
        """
        self._is_paused, self._brakes_in_pause, self._reason = True, True, PAUSED_REASON

    def resume(self, q: ArrayLike | None = None) -> None:
        """Close the clutch: the robot moves as the targets move from now on.

        The next points, normals and palm poses are anchored to the contacts and palms of the robot,
        so that it does not move before the target does. Grasps are absolute targets. The posture of
        free motions is the present one.

        Args:
            q: (n,) measured positions of the motors at rest [rad or m], see `reset`; None: the
                commanded ones.

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> follower = solver.follow(q0=robot.home)
            >>> follower.pause()
            >>> follower.resume(solution.q)
            >>> q = follower(*robot.contacts(robot.home))
            >>> bool(np.allclose(q, solution.q))
            True
        """
        if q is not None:
            self.reset(q)
        self._is_paused, self._clutch = False, Clutch(self._config.robot)
        self.posture = self._posture_at_rest()

    @property
    def posture(self) -> Array:
        """Posture (n,) to which free motions lead, such as one with a preferred elbow [rad or m].

        It is a soft preference: motors move there as far as contacts permit, in the time
        ``settling``.

        Example:
            >>> follower = solver.follow(q0=solution.q)
            >>> follower.posture = robot.home
        """
        return self._posture.copy()

    @posture.setter
    def posture(self, q: ArrayLike) -> None:
        self._posture = self._clipped(q)
        for runner in self._runner_by_kinds.values():
            runner.set_posture(self._posture)

    def better_branch(self) -> Branch | None:
        """Search for a configuration with a smaller error than the goal for the present target.

        The search takes milliseconds, so it is not part of a cycle, and the follower never changes
        its branch by itself: `branch` moves to the result.

        Returns:
            The branch; None if the goal meets the target, or if no configuration was found whose
            error ratio is smaller by at least a tenth.

        Example:
            >>> follower = solver.follow(q0=solution.q)
            >>> q = follower(grasp)
            >>> follower.better_branch() is None
            True
        """
        error_ratio, q = self._runner.goal_error_ratio, self._posture_at_rest()
        if self._reason or error_ratio <= 1.0:
            return None
        nearest = self._config.nearest(self._runner.target(), q)
        gain = error_ratio - self._runner.exact_error_ratio(nearest)
        if not gain > MIN_GAIN * error_ratio:
            return None
        return Branch(q=nearest, gain=gain, travel=float(np.abs(nearest - q).max()))

    def branch(self, q: ArrayLike) -> None:
        """Move to a configuration, usually on another branch, and continue to follow from there.

        The configuration also becomes the posture of free motions. It should be a solution of the
        present contacts (`Solver.solve`, `Solver.solve_all`): otherwise the goal departs from it.

        Args:
            q: (n,) positions of the motors [rad or m]; clipped to the limits.

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> follower = solver.follow(q0=solution.q)
            >>> follower.branch(solver.solve_all(grasp, limit=2)[1].q)
            >>> follower(grasp).shape
            (14,)
        """
        fields, state, goal = self._fields, self._runner.recurrence.state, self._clipped(q)
        state[fields.goal], state[fields.locked_on] = goal, 0.0
        self._recovery.follow_contacts()
        self._brakes_in_pause, self.posture = False, goal

    def _clipped(self, q: ArrayLike) -> Array:
        """Return checked positions (n,), clipped to the limits."""
        return np.clip(self._config.target_builder.start(q), *self._config.bounds)

    def __call__(
        self,
        target: Grasp | ArrayLike,
        normals: ArrayLike | None = None,
        palm: ArrayLike | Mapping[str, ArrayLike] | None = None,
        palm_weight: tuple[float, float] = (PALM_WEIGHT, PALM_WEIGHT),
    ) -> Array:
        """Compute one cycle.

        Args:
            target: Grasp with contacts of any kind; or (f, 3) contact points [m], base frame, in
                the order of `robot.fingers`, NaN for a free finger.
            normals: (f, 3) outward pad normals of any length, NaN for a free normal; None: all are
                free.
            palm: (4, 4) target pose of the palm, base frame, or poses by side of a multi-arm robot;
                it has a lower priority than the contacts. None: the palm is free.
            palm_weight: Weights of the palm's position and axes relative to a contact.

        Returns:
            (n,) positions of the motors at the end of the cycle [rad or m].

        Raises:
            InputError: Wrong shapes, values that are not numeric, or a grasp of another robot.
                Invalid points, normals and poses of a tracker that has lost the hand are not an
                error: the motors stop, and `FollowState.reason` has the reason.
        """
        self._cycles += 1
        if self._is_paused:
            return self._finish(self._hold())
        poses, self._reason = self._checked_poses(palm)
        if isinstance(target, Grasp):
            self._set_grasp(target, normals)
            return self._finish(self._hold() if self._reason else self._step(poses, palm_weight))
        points = self._vectors("points", target)
        directions = None if normals is None else self._vectors("normals", normals)
        # All points of a lost hand coincide; comparing two numbers first is cheap.
        if points[0, 0] == points[-1, 0]:
            self._reason = self._reason or lost_contacts_reason(points)
        if self._reason:
            return self._finish(self._hold())
        if self._runner.cycle.kinds != self._point_normal_kinds:
            self._switch_kinds(self._point_normal_kinds)
        self._tolerances = self._default_tolerances
        if self._clutch is not None:
            q = self._posture_at_rest()
            points, directions, poses = self._clutch.displaced(q, points, directions, poses)
        self._runner.set_contacts(points, directions)
        state = self._step(poses, palm_weight)
        # Contacts that are not finite are rare, so they are checked only after the step.
        if not self._runner.is_finite:
            state = self._repeat_with_free_contacts(points, directions, poses, palm_weight)
        return self._finish(state)

    def _finish(self, state: Array) -> Array:
        """Update the recovery after a cycle; return the positions (n,) of the motors."""
        q = state[self._fields.q].copy()
        if self._reason:
            self._recovery.follow_contacts()
        else:
            last_step = state[self._fields.last_step]
            self._recovery.update(self._runner, q, last_step, self._is_stopped)
        return q

    def _step(self, palms: Poses, palm_weight: tuple[float, float]) -> Array:
        """Make a step towards the target; return the new state."""
        runner = self._runner
        if self._is_beyond_limits:
            self._return_to_limits()
        if palms:
            runner.set_palms(palms, palm_weight)
        state = runner.recurrence.state
        step = self._recovery.step(state)
        if self._is_paused and self._brakes_in_pause:
            step = braked(state[self._fields.last_step], self._max_change)
        if self._guard is not None:
            state, self._is_stopped = self._guard.step(runner, step)
        else:
            state = runner.recurrence.step() if step is None else runner.step_by(step)
        if palms:
            runner.clear_palms()
        return state

    def _repeat_with_free_contacts(
        self,
        points: Array,
        normals: Array | None,
        palms: Poses,
        palm_weight: tuple[float, float],
    ) -> Array:
        """Repeat the last step with contacts that are partly free or invalid."""
        runner = self._runner
        runner.recurrence.back()
        free = np.full(self._contacts_shape, np.nan)
        self._reason = runner.set_partial_contacts(points, free if normals is None else normals)
        if not self._reason:
            state = self._step(palms, palm_weight)
            if runner.is_finite:
                return state
            runner.recurrence.back()
            self._reason = "a number is out of range"
        return self._hold()

    def _hold(self) -> Array:
        """Make a step in which the motors decelerate to rest; return the new state."""
        self._recovery.follow_contacts()
        self._runner.clear_target()
        if self._is_paused:
            # The motors brake, or track the goal that `branch` has set, without free motions.
            self._runner.recurrence.state[self._fields.locked_on] = 0.0
        else:
            self._set_goal_at_rest()
        return self._step({}, (PALM_WEIGHT, PALM_WEIGHT))

    def _set_grasp(self, grasp: Grasp, normals: ArrayLike | None) -> None:
        """Set the contacts of a grasp as the target of the cycle."""
        if normals is not None:
            raise InputError("normals: found in addition to a grasp, expected None")
        problem = self._config.target_builder.from_grasps([grasp])
        ((kinds, _, _),) = group_by_kinds(problem)
        if kinds != self._runner.cycle.kinds:
            self._switch_kinds(kinds)
        self._tolerances = problem.tolerances
        self._runner.set_target(problem)
        if self._guard is not None:
            self._guard.set_target(problem)

    def _return_to_limits(self) -> None:
        """Set bounds that lead motors beyond their limits back to them."""
        fields, state = self._fields, self._runner.recurrence.state
        q, (lower, upper) = state[fields.q], self._config.bounds
        excess = np.clip(q, lower, upper) - q
        direction, distance = np.sign(excess), np.abs(excess)
        change = CYCLE_TUNING.braking_share * self._max_change
        step = np.maximum(direction * state[fields.last_step], 0.0) + change
        step = np.minimum(step, RETURN_SHARE * self.velocity * self.period)
        q_next = q + direction * np.minimum(step, brake(distance, change))
        for runner in self._runner_by_kinds.values():
            runner.set_bounds(np.minimum(lower, q_next), np.maximum(upper, q_next))
        self._is_beyond_limits = bool(distance.any())

    def _posture_at_rest(self) -> Array:
        """Return the positions (n,) at which the motors can stop."""
        fields, state = self._fields, self._runner.recurrence.state
        return state[fields.q] + stopping_distance(state[fields.last_step], self._max_change)

    def _set_goal_at_rest(self) -> None:
        """Set the goal to the positions at which the motors can stop."""
        fields, state = self._fields, self._runner.recurrence.state
        state[fields.goal], state[fields.locked_on] = self._posture_at_rest(), 0.0

    def _vectors(self, name: str, value: ArrayLike) -> Array:
        """Return vectors (f, 3); their numbers may be NaN or infinite."""
        if (
            type(value) is np.ndarray
            and value.dtype == np.float64
            and value.shape == self._contacts_shape
        ):
            return value
        try:
            array = real_array(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: array is not numeric: {error}") from error
        if array.shape != self._contacts_shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {self._contacts_shape}")
        return array

    @property
    def moves_palm(self) -> bool:
        """True if an arm moves the palm, so that it may have a target pose."""
        return bool(self._runner.cycle.palms)

    def _checked_poses(self, palm: ArrayLike | Mapping[str, ArrayLike] | None) -> tuple[Poses, str]:
        """Return the poses (4, 4) of palms by side, and the reason why they are invalid, or "".

        The side is None for a single arm-hand.
        """
        if palm is None:
            return {}, ""
        palms = self._runner.cycle.palms
        if not palms:
            raise InputError("palm: found a pose for a palm that does not move, expected None")
        poses = palm if isinstance(palm, Mapping) else {None: palm}
        for side in poses:
            if side not in palms:
                names = ", ".join(name for name in palms if name)
                expected = f"poses by side: {names}" if names else "one pose"
                actual = "one pose" if side is None else f"side {side!r}"
                raise InputError(f"palm: found {actual}, expected {expected}")
        checked = dict[str | None, Array]()
        for side, pose in poses.items():
            name = "palm" if side is None else f"palm.{side}"
            try:
                checked[side] = single_pose(pose, name)
            except InvalidPoseError as error:
                return {}, str(error)
            if (checked[side] == LOST_HAND_POSE).all():
                return {}, f"{name}: the identity, which trackers send for a lost hand"
        return checked, ""

    @property
    def state(self) -> FollowState:
        """State after the last cycle."""
        runner, fields = self._runner, self._fields
        state = runner.recurrence.state
        q, last_step = state[fields.q].copy(), state[fields.last_step].copy()
        is_point_free, is_normal_free = runner.parameters["weights"].T == 0
        is_free = {
            "position_error": is_point_free,
            "angle_error": is_normal_free,
            "goal_position_error": is_point_free,
            "goal_angle_error": is_normal_free,
        }
        errors = {
            name: np.where(free, np.nan, runner.record[name]) for name, free in is_free.items()
        }
        if self._is_stopped:
            # The record describes the step of the graph, which the guard has replaced.
            errors["position_error"], errors["angle_error"] = runner.errors(q)
        clearances = None if self._guard is None else self._guard.clearance(q)
        return FollowState(
            status=self._status(errors),
            reason=self._reason,
            q=q,
            velocity=last_step / self.period,
            goal=state[fields.goal].copy(),
            **errors,
            clearance=None if clearances is None else float(clearances.distance[0]),
            closest=None if clearances is None else clearances.pair(0),
            cycles=self._cycles,
        )

    def _status(self, errors: dict[str, Array]) -> FollowStatus:
        if self._reason:
            return FollowStatus.HOLDING
        if self._is_met(errors["position_error"], errors["angle_error"]):
            return FollowStatus.FOLLOWING
        if self._is_stopped:
            return FollowStatus.BLOCKED
        if self._is_met(errors["goal_position_error"], errors["goal_angle_error"]):
            return FollowStatus.LATE
        return FollowStatus.MISSED

    def _is_met(self, position: Array, angle: Array) -> bool:
        tolerances = np.array([(item.position, item.angle) for item in self._tolerances]).T
        limits = tolerances * (1 + TOLERANCE_SLACK)
        # Errors of free contacts are NaN, and exceed nothing.
        return not ((position > limits[0]) | (angle > limits[1])).any()
