"""Configuration of a follower, and its inputs in a cycle."""

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
from casadi_ik.motion.cycle import Cycle, side_name
from casadi_ik.motion.motion import Rates
from casadi_ik.solve.target_builder import TargetBuilder
from casadi_ik.solve.verdict import deviations

ERROR_TIME = 0.05
"""Time constant with which an error of the contacts decays [s]."""


@dataclass(frozen=True, eq=False)
class FollowPlan:
    """Configuration of a follower.

    Attributes:
        target_builder: Robot and tolerances.
        check: Scene of the robot; None: collisions are not checked.
        compiled: True to use compiled code.
        q0: (n,) initial positions of the motors [rad or m].
        bounds: (n,) lower and upper limits; they are equal for fixed motors.
        period: Time from cycle to cycle [s].
        rates: Limits of velocities and accelerations.
        posture: (n,) posture to which free motions lead [rad or m].
        settling: Time constant of free motions [s]; infinite: no free motion.
        pull: Weight of the anchor, see `Cycle`.
        nearest: Search for the configuration (n,) nearest to a target, given a start (n,).
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
        """Decay of free motions and of errors from cycle to cycle, as parameters of a cycle.

        Free motions are the response of a critically damped spring between motors and posture.
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


POINTS_AND_NORMALS, POINTS_ONLY = "points and normals", "points"
"""Inputs of all fingers for which the weights are set already."""

UNUSED_NORMAL = (1.0, 0.0, 0.0)
"""Placeholder of a free normal: graphs divide by its length."""


class FollowerInputs:
    """Graph of a cycle for contacts of given kinds, and its memory.

    Attributes:
        run: Graph that is evaluated step by step.
        views: Its parameters by name; callers write into them.
        record: Results of its last step by name.
    """

    def __init__(self, plan: FollowPlan, kinds: Kinds, obstacles: int) -> None:
        """Compile the graph unless it is cached."""
        self._robot = plan.robot
        self.cycle = cycle = Cycle(plan.robot.description, kinds, obstacles)
        self.run = Recurrence(FunctionKernel(cycle.graph, plan.compiled))
        self.views: dict[str, Array] = cycle.parameters.unpack(self.run.parameters)
        self.record: dict[str, Array] = cycle.record.unpack(self.run.record)
        max_step, max_change = plan.rates.steps(plan.period)
        self._bounds = plan.bounds
        self._fill(lower=plan.bounds[0], upper=plan.bounds[1], posture=plan.posture)
        self._fill(max_step=max_step, max_change=max_change)
        tolerances = tuple(plan.target_builder.tolerances.values())
        self._weights, self._tolerances = contact_weights(tolerances), tolerance_rows(tolerances)
        self._fill(**plan.cycle_parameters)
        names = "error_ratio", "goal_error_ratio"
        self._ratios = tuple(cycle.record.slice(name).start for name in names)
        self._points, self._normals = self.views["points"], self.views["normals"]
        self._mode = ""

    def state_at(self, q: Array) -> Array:
        """Return the state of rest at a posture (n,)."""
        zeros = {item.name: np.zeros(item.shape) for item in self.cycle.state}
        return self.cycle.state.pack(zeros | {"q": q, "goal": q, "locked_on": 1.0})

    def _fill(self, **values: ArrayLike) -> None:
        for name, value in values.items():
            self.views[name][...] = value

    def rows(self, count: int, values: Mapping[str, ArrayLike]) -> Array:
        """Return the parameters (count, ...) of several cycles.

        Args:
            count: Number of cycles.
            values: (count, ...) by name, or one value for all cycles; other parameters keep their
                present values.
        """
        rows = np.repeat(self.run.parameters[None], count, axis=0)
        for name, value in values.items():
            columns = rows[:, self.cycle.parameters.slice(name)]
            columns[...] = np.reshape(value, (-1, columns.shape[1]))
        return rows

    def set_contacts(self, points: Array, normals: Array | None) -> None:
        """Set contacts of all fingers; `is_finite` is their validity after the step.

        Args:
            points: (f, 3) [m].
            normals: (f, 3) of any length; None: all are free.
        """
        self._points[...] = points
        if normals is not None:
            self._normals[...] = normals
        mode = POINTS_AND_NORMALS if normals is not None else POINTS_ONLY
        if self._mode != mode:
            is_set = np.array([1.0, normals is not None])
            self._fill(weights=is_set * self._weights, **self._tolerances)
            if normals is None:
                self._normals[...] = UNUSED_NORMAL
            self._mode = mode

    @property
    def is_finite(self) -> bool:
        """True if the target of the last step was finite and no normal was zero."""
        return math.isfinite(self.run.record[-1])

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
        self._mode = ""
        is_set = ~np.isnan(np.stack([points[:, 0], normals[:, 0]], axis=1))
        normals = np.where(is_set[:, 1:], normals, UNUSED_NORMAL)
        self._fill(points=np.nan_to_num(points), normals=normals)
        self._fill(weights=is_set * self._weights, **self._tolerances)
        return ""

    def set_target(self, problem: TargetBatch) -> None:
        """Set one target of the graph's kinds of contacts, checked before."""
        self._mode = ""
        rows = contact_rows(self.cycle, problem)
        self._fill(**{name: values[0] for name, values in rows.items()})
        self._fill(**tolerance_rows(problem.tolerances))

    def set_palms(self, poses: Mapping[str | None, Array], weight: tuple[float, float]) -> None:
        """Set target poses (4, 4) of palms by side, which have a lower priority than contacts."""
        for side, pose in poses.items():
            values = {"point": pose[:3, 3], "axes": pose[:3, :3], "weight": weight}
            self._fill(**{side_name(f"palm_{name}", side): value for name, value in values.items()})

    def clear_palms(self) -> None:
        """Remove the target poses of palms."""
        for side in self.cycle.palms:
            self._fill(**{side_name("palm_weight", side): 0.0})

    def exact_error_ratio(self, q: Array) -> float:
        """Return the maximum error relative to the tolerance of the target at a posture (n,)."""
        max_step = self.views["max_step"]
        values = max_step.copy()
        max_step[...] = 0.0
        ratio = self.error_ratio_at(q)
        max_step[...] = values
        return ratio

    def errors(self, q: Array) -> tuple[Array, Array]:
        """Return the errors of a posture (n,) to the target: (f,) [m], (f,) [rad], NaN if free."""
        position, angle, _ = deviations(self._robot, self.target(), q[None])
        return position[0], angle[0]

    def target(self) -> TargetBatch:
        """Return the contacts of the present target, NaN where free."""
        weights = self.views["weights"]

        def target(name: str, is_set: Bools) -> Array:
            return np.where(is_set[:, None], self.views[name], np.nan)[None]

        extra_vectors = {
            f"{name}s": target(f"{name}s", np.any(self.views[f"{name}s"], axis=1))
            for name in self.cycle.contacts.data[2:]
        }
        points, normals = target("points", weights[:, 0] > 0), target("normals", weights[:, 1] > 0)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        limits = self.views["position_tolerance"].tolist(), self.views["angle_tolerance"].tolist()
        tolerances = tuple(map(Tolerance, *limits))
        return TargetBatch(
            points, normals, tolerances, enforce_limits=True, extra_vectors=extra_vectors
        )

    @property
    def error_ratio(self) -> float:
        """Largest error of the motors over its tolerance in the last step."""
        return float(self.run.record[self._ratios[0]])

    @property
    def goal_error_ratio(self) -> float:
        """Largest error of the goal over its tolerance in the last step."""
        return float(self.run.record[self._ratios[1]])

    def error_ratio_at(self, q: Array) -> float:
        """Return the `error_ratio` of the present target after one step from a posture (n,)."""
        state, record = self.run.state.copy(), self.run.record.copy()
        self.step_from_rest(q)
        ratio = self.error_ratio
        self.run.back()
        self.run.state[:], self.run.record[:] = state, record
        return ratio

    def step_from_rest(self, q: Array) -> Array:
        """Make a step from rest at a posture (n,) instead of the present state.

        Returns:
            New state.
        """
        n, state = len(q), self.run.state
        state[:n], state[n : 2 * n], state[2 * n : 3 * n], state[3 * n :] = q, 0.0, q, 0.0
        return self.run.step()

    def step_by(self, step: Array) -> Array:
        """Make a given step (n,) of the motors instead of one to the contacts.

        Returns:
            New state.
        """
        n, previous = len(step), self.run.state.copy()
        q = clip_step(previous[:n], step, self._bounds)
        state = self.step_from_rest(q)
        state[:n], state[n : 2 * n], state[2 * n : 3 * n], state[3 * n] = q, step, q, 0.0
        self.run.previous_state[:] = previous
        return state

    def set_bounds(self, lower: Array, upper: Array) -> None:
        """Set the bounds (n,) of the motors in the next cycle."""
        self._fill(lower=lower, upper=upper)

    def set_posture(self, posture: Array) -> None:
        """Set the posture (n,) to which free motions lead."""
        self._fill(posture=posture)

    def clear_target(self) -> None:
        """Remove contacts and palm poses, so that the goal does not move."""
        self._mode = ""
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
    """Return the weights (f, 2) of points and normals: inverse tolerances, the largest is 1."""
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
