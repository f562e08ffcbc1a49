"""What a follower keeps to all the time, and what it is asked in a cycle."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
from casadi_ik.motion.cycle import Cycle, of_side
from casadi_ik.motion.motion import Rates
from casadi_ik.solve.request import Request
from casadi_ik.solve.verdict import deviations

FADING = 0.05
"""Seconds in which an error of the contacts fades."""


@dataclass(frozen=True, eq=False)
class FollowPlan:
    """What a follower keeps to all the time.

    Attributes:
        request: Robot and tolerances.
        check: The scene about the robot; None: collisions are not checked.
        compiled: Whether in compiled code.
        q0: (n,) where the robot is [rad or m].
        bounds: (n,) lower and upper, what is held included.
        period: Time from cycle to cycle [s].
        rates: Limits of the motors' motion.
        posture: (n,) where motions lead that the contacts leave free.
        settling: Time in which they come there [s]; infinite: they do not.
        pull: See `Cycle`.
    """

    request: Request
    check: SceneCheck | None
    compiled: bool
    q0: Array
    bounds: tuple[Array, Array]
    period: float
    rates: Rates
    posture: Array
    settling: float
    pull: float

    @property
    def robot(self) -> ArmHand:
        """The robot."""
        return self.request.robot

    @property
    def habits(self) -> dict[str, float]:
        """How free motions and errors fade from cycle to cycle, as parameters of a cycle.

        A free motion is that of a critically damped spring between the motors and their posture.
        """
        if math.isinf(self.settling):
            return {"pull": self.pull, "keep": 0.0, "drift": 0.0, "patience": 0.0}
        kept = math.exp(-self.period / self.settling)
        return {
            "pull": self.pull,
            "keep": kept**2,
            "drift": (1 - kept) ** 2,
            "patience": math.exp(-self.period / FADING),
        }


WHOLE, PLACES = "points and normals", "points"
"""What all fingers are asked for."""

ANY = (1.0, 0.0, 0.0)
"""A normal that does not count, as a unit vector all the same."""


class FollowerInputs:
    """One graph's memory, for contacts of some kinds.

    Attributes:
        run: The graph, step by step.
        views: Its parameters by name; write into them.
        record: What its last step tells, by name.
    """

    def __init__(self, plan: FollowPlan, kinds: Kinds, obstacles: int) -> None:
        """Compile what is not compiled yet."""
        self._robot = plan.robot
        self.cycle = cycle = Cycle(plan.robot.description, kinds, obstacles)
        self.run = Recurrence(FunctionKernel(cycle.graph, plan.compiled))
        self.views: dict[str, Array] = cycle.parameters.unpack(self.run.parameters)
        self.record: dict[str, Array] = cycle.record.unpack(self.run.record)
        fastest, change = plan.rates.steps(plan.period)
        self._fill(lower=plan.bounds[0], upper=plan.bounds[1], posture=plan.posture)
        self._fill(fastest=fastest, change=change)
        tolerances = tuple(plan.request.tolerances.values())
        self._usual, self._tolerances = contact_weights(tolerances), tolerance_rows(tolerances)
        self._fill(**plan.habits)
        self._told = self.run.record
        names = "error_ratio", "goal_error_ratio"
        self._ratios = tuple(cycle.record.slice(name).start for name in names)
        self._points, self._normals = self.views["points"], self.views["normals"]
        self._mode = ""

    def state_at(self, q: Array) -> Array:
        """The state of rest at a posture (n,)."""
        rest = {item.name: np.zeros(item.shape) for item in self.cycle.state}
        return self.cycle.state.pack(rest | {"q": q, "goal": q, "locked_on": 1.0})

    def _fill(self, **values: ArrayLike) -> None:
        for name, value in values.items():
            self.views[name][...] = value

    def rows(self, count: int, values: Mapping[str, ArrayLike]) -> Array:
        """(count, ...) parameters of cycles.

        Args:
            count: How many.
            values: (count, ...) by name, or one for all of them; what is left out stays as it is.
        """
        every = np.repeat(self.run.parameters[None], count, axis=0)
        for name, value in values.items():
            own = every[:, self.cycle.parameters.slice(name)]
            own[...] = np.reshape(value, (-1, own.shape[1]))
        return every

    def ask(self, points: Array, normals: Array | None) -> None:
        """Ask for points and normals that are all there; `sound` tells if they were not.

        Args:
            points: (f, 3) [m].
            normals: (f, 3) of any length; None: all are free.
        """
        self._points[...] = points
        if normals is not None:
            self._normals[...] = normals
        mode = WHOLE if normals is not None else PLACES
        if self._mode != mode:
            known = np.array([1.0, mode == WHOLE])
            self._fill(weights=known * self._usual, **self._tolerances)
            if normals is None:
                self._normals[...] = ANY
            self._mode = mode

    @property
    def sound(self) -> bool:
        """Whether what was asked in the last step were numbers and directions."""
        return math.isfinite(self._told[-1])

    def ask_partly(self, points: Array, normals: Array) -> str:
        """Ask for points and normals of which some may be free.

        Args:
            points: (f, 3) [m]; all NaN where a finger is free.
            normals: (f, 3) of any length; all NaN where free.

        Returns:
            What is wrong with them, "" if nothing is; then nothing is asked.
        """
        reason = fault(points, normals)
        if reason:
            return reason
        self._mode = ""
        known = ~np.isnan(np.stack([points[:, 0], normals[:, 0]], axis=1))
        facing = np.where(known[:, 1:], normals, ANY)
        self._fill(points=np.nan_to_num(points), normals=facing)
        self._fill(weights=known * self._usual, **self._tolerances)
        return ""

    def ask_problem(self, problem: TargetBatch) -> None:
        """Ask for one target of the graph's kinds, checked before."""
        self._mode = ""
        rows = contact_rows(self.cycle, problem)
        self._fill(**{name: values[0] for name, values in rows.items()})
        self._fill(**tolerance_rows(problem.tolerances))

    def ask_palms(self, poses: Mapping[str | None, Array], weight: tuple[float, float]) -> None:
        """Ask for poses of palms (4, 4) by side, as far as contacts leave them free."""
        for side, pose in poses.items():
            asked = {"point": pose[:3, 3], "axes": pose[:3, :3], "weight": weight}
            self._fill(**{of_side(f"palm_{name}", side): value for name, value in asked.items()})

    def free_palms(self) -> None:
        """Ask for no pose of a palm."""
        for side in self.cycle.palms:
            self._fill(**{of_side("palm_weight", side): 0.0})

    def exact_error_ratio(self, q: Array) -> float:
        """Return the largest error of the present target over its tolerance at a posture (n,)."""
        errors = np.stack(self.errors(q))
        tolerances = np.stack([self.views["position_tolerance"], self.views["angle_tolerance"]])
        return float(np.nanmax(errors / np.maximum(tolerances, 1e-12)))

    def errors(self, q: Array) -> tuple[Array, Array]:
        """How far a posture (n,) is off what was asked last: (f,) [m], (f,) [rad], NaN if free."""
        weights = self.views["weights"]

        def asked(name: str, known: Bools) -> Array:
            return np.where(known[:, None], self.views[name], np.nan)[None]

        more = {
            f"{name}s": asked(f"{name}s", np.any(self.views[f"{name}s"], axis=1))
            for name in self.cycle.contacts.data[2:]
        }
        points, normals = asked("points", weights[:, 0] > 0), asked("normals", weights[:, 1] > 0)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        problem = TargetBatch(points, normals, Tolerance(), enforce_limits=True, extra_vectors=more)
        position, angle, _ = deviations(self._robot, problem, q[None])
        return position[0], angle[0]

    @property
    def error_ratio(self) -> float:
        """Largest error of the motors over its tolerance in the last step."""
        return float(self._told[self._ratios[0]])

    @property
    def goal_error_ratio(self) -> float:
        """Largest error of the goal over its tolerance in the last step."""
        return float(self._told[self._ratios[1]])

    def error_ratio_at(self, q: Array) -> float:
        """Return the `error_ratio` of the present target at a posture (n,), but for one step."""
        state, record = self.run.state.copy(), self._told.copy()
        self.step_from_rest(q)
        ratio = self.error_ratio
        self.run.back()
        self.run.state[:], self._told[:] = state, record
        return ratio

    def step_from_rest(self, q: Array) -> Array:
        """Make a step from rest at a posture (n,) instead of the present state; the new state."""
        n, state = len(q), self.run.state
        state[:n], state[n : 2 * n], state[2 * n : 3 * n], state[3 * n :] = q, 0.0, q, 0.0
        return self.run.step()

    def step_by(self, step: Array) -> Array:
        """Make a given step (n,) of the motors instead of one to the contacts; the new state."""
        n, before = len(step), self.run.state.copy()
        q = before[:n] + step
        state = self.step_from_rest(q)
        state[:n], state[n : 2 * n], state[2 * n : 3 * n], state[3 * n] = q, step, q, 0.0
        self.run.before[:] = before
        return state

    def lead_to(self, posture: Array) -> None:
        """Where motions lead that the contacts leave free, (n,)."""
        self._fill(posture=posture)

    def ask_nothing(self) -> None:
        """Ask for nothing: the goal stays."""
        self._mode = ""
        self._fill(points=0.0, normals=ANY, weights=0.0)
        self.free_palms()


def contact_weights(tolerances: tuple[Tolerance, ...]) -> Array:
    """(f, 2) how much places and facings count: as 1 / tolerance, the tightest counts 1."""
    loose = np.array([(one.position / LENGTH, one.angle) for one in tolerances])
    return loose.min() / loose


def tolerance_rows(tolerances: tuple[Tolerance, ...]) -> dict[str, Array]:
    """Tolerances (f,) as the parameters of a cycle."""
    return {
        "position_tolerance": np.array([one.position for one in tolerances]),
        "angle_tolerance": np.array([one.angle for one in tolerances]),
    }


def contact_rows(cycle: Cycle, targets: TargetBatch) -> dict[str, Array]:
    """Targets as the parameters of a cycle's contacts.

    Args:
        cycle: The graph.
        targets: k targets of its kinds.

    Returns:
        By field (k, ...): vectors, with zeros where free, and weights.
    """
    known = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
    values: dict[str, Array] = {
        f"{name}s": np.nan_to_num(targets.vectors(f"{name}s")) for name in cycle.contacts.data
    }
    values["normals"] = np.where(known[1][..., None], values["normals"], ANY)
    return values | {"weights": np.stack(known, axis=2) * contact_weights(targets.tolerances)}


def fault(points: Array, normals: Array) -> str:
    """What is wrong with a frame of a stream; "": nothing.

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
    free, faces = np.isnan(points[:, 0]), ~np.isnan(normals[:, 0])
    if free.all():
        return "there is no contact"
    if (free & faces).any():
        return "a normal has no point"
    if not normals[faces].any(axis=1).all():
        return "a normal is zero"
    return ""
