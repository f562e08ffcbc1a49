"""Configuration of a follower, and evaluation of its cycles."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.function_kernel import Recurrence
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH, Kinds
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.motion.cycle import Cycle, StateFields, side_name
from casadi_ik.motion.motion import Rates
from casadi_ik.solve.target_builder import TargetBuilder
from casadi_ik.solve.verdict import deviations

ERROR_TIME = 0.05
"""Time constant with which an error of the contacts decays [s]."""


@dataclass(frozen=True, eq=False)
class FollowerConfig:
    """Configuration of a follower.

    Attributes:
        target_builder: Robot and tolerances.
        check: Scene of the robot; None: collisions are not checked.
        compiled: True to use compiled code.
        q0: (n,) initial positions of the motors [rad or m].
        bounds: (n,) lower and upper limits; they are equal for fixed motors.
        period: Time from cycle to cycle [s].
        rates: Limits of velocities and accelerations of the motors.
        posture: (n,) posture to which free motions lead [rad or m].
        settling: Time constant of free motions [s]; infinite: no free motion.
        pull: Weight of the anchor, see `Cycle`.
        nearest: Function (target, start (n,)) that searches for the configuration (n,) with the
            smallest error, and of several such configurations for the one nearest to the start.
    """

    target_builder: TargetBuilder
    check: SceneCheck | None
    compiled: bool
    q0: Array
    bounds: tuple[Array, Array]
    period: float
    rates: Rates
    posture: Array
    settling: float
    pull: float
    nearest: Callable[[TargetBatch, Array], Array]

    @property
    def robot(self) -> ArmHand:
        """The robot."""
        return self.target_builder.robot

    @property
    def cycle_parameters(self) -> dict[str, float]:
        """Parameters of a cycle that govern free motions and errors (`Cycle.parameters`).

        Free motions are the response of a critically damped spring between motors and posture:
        with the decay d per cycle, momentum d^2 and spring (1 - d)^2 give a double pole at d.
        """
        if math.isinf(self.settling):
            return {"pull": self.pull, "momentum": 0.0, "spring": 0.0, "error_decay": 0.0}
        decay = math.exp(-self.period / self.settling)
        return {
            "pull": self.pull,
            "momentum": decay**2,
            "spring": (1 - decay) ** 2,
            "error_decay": math.exp(-self.period / ERROR_TIME),
        }


UNUSED_NORMAL = (1.0, 0.0, 0.0)
"""Placeholder of a free normal: graphs divide by its length."""


class CycleRunner:
    """Evaluator of the graph of a cycle for contacts of given kinds.

    Attributes:
        cycle: Cycle that defines the graph and its layouts.
        recurrence: Graph with its memory, evaluated cycle by cycle.
        parameters: Parameters of the next cycle by name; callers write into these views.
        record: Results of the last cycle by name.
        fields: Positions of the fields of the state.
    """

    def __init__(self, config: FollowerConfig, kinds: Kinds, obstacles: int) -> None:
        """Compile the graph unless it is cached.

        Args:
            config: Configuration of the follower.
            kinds: Kind of contact by finger.
            obstacles: Number of clearances in the least squares.
        """
        self._robot = config.robot
        self.fields = StateFields.of(len(config.robot.actuators))
        self.cycle = cycle = Cycle(config.robot.description, kinds, obstacles)
        self.recurrence = Recurrence(FunctionKernel(cycle.graph, config.compiled))
        self.parameters: dict[str, Array] = cycle.parameters.unpack(self.recurrence.parameters)
        self.record: dict[str, Array] = cycle.record.unpack(self.recurrence.record)
        max_step, max_change = config.rates.steps(config.period)
        self._bounds = config.bounds
        self._fill(lower=config.bounds[0], upper=config.bounds[1], posture=config.posture)
        self._fill(max_step=max_step, max_change=max_change)
        tolerances = tuple(config.target_builder.tolerances.values())
        self._weights, self._tolerances = contact_weights(tolerances), tolerance_rows(tolerances)
        self._fill(**config.cycle_parameters)
        self._error_ratio_index = cycle.record.slice("error_ratio").start
        self._goal_error_ratio_index = cycle.record.slice("goal_error_ratio").start
        self._checksum_index = cycle.record.slice("checksum").start
        self._points, self._normals = self.parameters["points"], self.parameters["normals"]
        # Contacts of all fingers for which the weights are set already, with or without normals;
        # None: other weights.
        self._weights_have_normals: bool | None = None

    def state_at(self, q: Array) -> Array:
        """Return the state of rest at a posture (n,)."""
        zeros = {item.name: np.zeros(item.shape) for item in self.cycle.state}
        return self.cycle.state.pack(zeros | {"q": q, "goal": q, "locked_on": 1.0})

    def _fill(self, **values: ArrayLike) -> None:
        for name, value in values.items():
            self.parameters[name][...] = value

    def rows(self, count: int, values: Mapping[str, ArrayLike]) -> Array:
        """Return the parameters (count, p) of several cycles for `Recurrence.run`.

        Args:
            count: Number of cycles.
            values: (count, ...) by name, or one value for all cycles; other parameters keep their
                present values.
        """
        rows = np.repeat(self.recurrence.parameters[None], count, axis=0)
        for name, value in values.items():
            columns = rows[:, self.cycle.parameters.slice(name)]
            columns[...] = np.reshape(value, (-1, columns.shape[1]))
        return rows

    def set_contacts(self, points: Array, normals: Array | None) -> None:
        """Set contacts of all fingers without checks; `is_finite` tells later if they were valid.

        Args:
            points: (f, 3) [m].
            normals: (f, 3) of any length; None: all are free.
        """
        self._points[...] = points
        if normals is not None:
            self._normals[...] = normals
        has_normals = normals is not None
        # Weights and tolerances are written only when they change, because each write takes time.
        if self._weights_have_normals is not has_normals:
            is_set = np.array([1.0, has_normals])
            self._fill(weights=is_set * self._weights, **self._tolerances)
            if not has_normals:
                self._normals[...] = UNUSED_NORMAL
            self._weights_have_normals = has_normals

    @property
    def is_finite(self) -> bool:
        """True if the target of the last step was finite and no normal was zero."""
        return math.isfinite(self.recurrence.record[self._checksum_index])

    def set_partial_contacts(self, points: Array, normals: Array) -> str:
        """Set contacts that may be partly free.

        Args:
            points: (f, 3) [m]; all NaN where a finger is free.
            normals: (f, 3) of any length; all NaN where free.

        Returns:
            Reason why the contacts are invalid, "" if they are valid. Invalid contacts are not set.
        """
        reason = invalid_frame_reason(points, normals)
        if reason:
            return reason
        self._weights_have_normals = None
        is_set = ~np.isnan(np.stack([points[:, 0], normals[:, 0]], axis=1))
        normals = np.where(is_set[:, 1:], normals, UNUSED_NORMAL)
        self._fill(points=np.nan_to_num(points), normals=normals)
        self._fill(weights=is_set * self._weights, **self._tolerances)
        return ""

    def set_target(self, problem: TargetBatch) -> None:
        """Set a batch of one valid target of the graph's kinds of contacts."""
        self._weights_have_normals = None
        rows = contact_rows(self.cycle, problem)
        self._fill(**{name: values[0] for name, values in rows.items()})
        self._fill(**tolerance_rows(problem.tolerances))

    def set_palms(self, poses: Mapping[str | None, Array], weight: tuple[float, float]) -> None:
        """Set target poses of palms, which have a lower priority than contacts.

        Args:
            poses: (4, 4) pose by side, base frame; the side is None for a single arm-hand.
            weight: Weights of position and axes relative to a contact.
        """
        for side, pose in poses.items():
            values = {"point": pose[:3, 3], "axes": pose[:3, :3], "weight": weight}
            self._fill(**{side_name(f"palm_{name}", side): value for name, value in values.items()})

    def clear_palms(self) -> None:
        """Remove the target poses of palms."""
        for side in self.cycle.palms:
            self._fill(**{side_name("palm_weight", side): 0.0})

    def exact_error_ratio(self, q: Array) -> float:
        """Return the `error_ratio` of the present target at a posture (n,) itself."""
        # Without a step the graph measures the posture at which it starts.
        max_step = self.parameters["max_step"]
        previous_max_step = max_step.copy()
        max_step[...] = 0.0
        ratio = self.error_ratio_at(q)
        max_step[...] = previous_max_step
        return ratio

    def errors(self, q: Array) -> tuple[Array, Array]:
        """Return the errors of a posture (n,) to the target: (f,) [m], (f,) [rad], NaN if free."""
        position, angle, _ = deviations(self._robot, self.target(), q[None])
        return position[0], angle[0]

    def target(self) -> TargetBatch:
        """Return the contacts of the present target, NaN where free, as a batch of one."""
        weights = self.parameters["weights"]

        def vectors(name: str, is_set: Bools) -> Array:
            return np.where(is_set[:, None], self.parameters[name], np.nan)[None]

        # Points and normals are the first two vectors of a contact; unused extra vectors are zero.
        extra_names = [f"{name}s" for name in self.cycle.contacts.data[2:]]
        extra_vectors = {
            name: vectors(name, np.any(self.parameters[name], axis=1)) for name in extra_names
        }
        points = vectors("points", weights[:, 0] > 0)
        normals = vectors("normals", weights[:, 1] > 0)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        limits = (
            self.parameters["position_tolerance"].tolist(),
            self.parameters["angle_tolerance"].tolist(),
        )
        tolerances = tuple(map(Tolerance, *limits))
        return TargetBatch(
            points, normals, tolerances, enforce_limits=True, extra_vectors=extra_vectors
        )

    @property
    def error_ratio(self) -> float:
        """Largest error of the motors over its tolerance in the last step."""
        return float(self.recurrence.record[self._error_ratio_index])

    @property
    def goal_error_ratio(self) -> float:
        """Largest error of the goal over its tolerance in the last step."""
        return float(self.recurrence.record[self._goal_error_ratio_index])

    def error_ratio_at(self, q: Array) -> float:
        """Return the `error_ratio` of the present target after one step from a posture (n,).

        State and record do not change.
        """
        state, record = self.recurrence.state.copy(), self.recurrence.record.copy()
        self.step_from_rest(q)
        ratio = self.error_ratio
        self.recurrence.back()
        self.recurrence.state[:], self.recurrence.record[:] = state, record
        return ratio

    def step_from_rest(self, q: Array) -> Array:
        """Make a step from rest at a posture (n,) instead of the present state.

        Returns:
            New state.
        """
        state, fields = self.recurrence.state, self.fields
        state[fields.q], state[fields.last_step], state[fields.goal] = q, 0.0, q
        state[fields.locked_on :] = 0.0
        return self.recurrence.step()

    def step_by(self, step: Array) -> Array:
        """Make a given step (n,) of the motors instead of one towards the contacts.

        Returns:
            New state; the record describes the step that the graph makes from there.
        """
        fields, previous = self.fields, self.recurrence.state.copy()
        q = clip_step(previous[fields.q], step, self._bounds)
        state = self.step_from_rest(q)
        state[fields.q], state[fields.last_step], state[fields.goal] = q, step, q
        state[fields.locked_on] = 0.0
        self.recurrence.previous_state[:] = previous
        return state

    def set_bounds(self, lower: Array, upper: Array) -> None:
        """Set the bounds (n,) of the motors in the next cycle."""
        self._fill(lower=lower, upper=upper)

    def set_posture(self, posture: Array) -> None:
        """Set the posture (n,) to which free motions lead."""
        self._fill(posture=posture)

    def clear_target(self) -> None:
        """Remove contacts and palm poses, so that the goal does not move."""
        self._weights_have_normals = None
        self._fill(points=0.0, normals=UNUSED_NORMAL, weights=0.0)
        self.clear_palms()


def clip_step(q: Array, step: Array, bounds: tuple[Array, Array]) -> Array:
    """Return positions (n,) after a step that rounding errors must not lead beyond the bounds.

    Args:
        q: (n,) positions before the step; they may be beyond the bounds.
        step: (n,) step.
        bounds: Lower and upper bounds, (n,) each.
    """
    return np.clip(q + step, np.minimum(bounds[0], q), np.maximum(bounds[1], q))


def contact_weights(tolerances: tuple[Tolerance, ...]) -> Array:
    """Return the weights (f, 2) of points and normals: inverse tolerances.

    The largest weight is 1. Position tolerances are divided by `LENGTH`, as residuals are.
    """
    limits = np.array([(item.position / LENGTH, item.angle) for item in tolerances])
    return limits.min() / limits


def tolerance_rows(tolerances: tuple[Tolerance, ...]) -> dict[str, Array]:
    """Return tolerances (f,) as parameters of a cycle."""
    return {
        "position_tolerance": np.array([item.position for item in tolerances]),
        "angle_tolerance": np.array([item.angle for item in tolerances]),
    }


def contact_rows(cycle: Cycle, targets: TargetBatch) -> dict[str, Array]:
    """Return the contacts of targets as parameters of a cycle.

    Args:
        cycle: Graph of the cycle.
        targets: k targets of its kinds of contacts.

    Returns:
        (k, ...) by field: vectors, which are 0 where free, and weights.
    """
    is_set = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
    values: dict[str, Array] = {
        f"{name}s": np.nan_to_num(targets.vectors(f"{name}s")) for name in cycle.contacts.data
    }
    values["normals"] = np.where(is_set[1][..., None], values["normals"], UNUSED_NORMAL)
    return values | {"weights": np.stack(is_set, axis=2) * contact_weights(targets.tolerances)}


def invalid_frame_reason(points: Array, normals: Array) -> str:
    """Return the reason why a frame of a stream is invalid, "" if it is valid.

    Args:
        points: (f, 3), all NaN where a finger is free.
        normals: (f, 3), all NaN where free.
    """
    for name, array in (("points", points), ("normals", normals)):
        missing = np.isnan(array)
        if (missing.any(axis=1) & ~missing.all(axis=1)).any():
            return f"{name} are partly NaN"
        if np.isinf(array).any():
            return f"{name} are infinite"
    is_free, has_normal = np.isnan(points[:, 0]), ~np.isnan(normals[:, 0])
    if is_free.all():
        return "there is no contact"
    if (is_free & has_normal).any():
        return "a normal has no point"
    if not normals[has_normal].any(axis=1).all():
        return "a normal is zero"
    return ""
