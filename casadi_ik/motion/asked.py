"""What a follower is asked in a cycle, written where its graph reads it."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.grasps.pose import one_pose
from casadi_ik.kernels import FunctionKernel
from casadi_ik.kernels.recurrence import Recurrence
from casadi_ik.motion.cycle import Cycle
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.problem.contacts.kinds import Kinds
from casadi_ik.problem.problems import Problems, Tolerance

TINY = 1e-12
"""Squared length of a normal below which it is none."""


class Asked:
    """One graph's memory, for contacts of some kinds.

    Attributes:
        run: The graph, step by step.
        views: Its parameters by name; write into them.
        record: What its last step tells, by name.
    """

    def __init__(self, plan: FollowPlan, kinds: Kinds, obstacles: int) -> None:
        """Compile what is not compiled yet."""
        self.cycle = cycle = Cycle(plan.robot.description, kinds, obstacles)
        self.run = Recurrence(FunctionKernel(cycle.graph, plan.compiled))
        self.views: dict[str, Array] = cycle.parameters.unpack(self.run.parameters)
        self.record: dict[str, Array] = cycle.record.unpack(self.run.record)
        fastest, change = plan.rates.steps(plan.period)
        self._fill(lower=plan.bounds[0], upper=plan.bounds[1], posture=plan.posture)
        self._fill(fastest=fastest, change=change)
        tolerances = tuple(plan.questions.tolerances.values())
        self._usual, self._tolerances = contact_weights(tolerances), tolerance_rows(tolerances)
        self._fill(**plan.habits)
        self._points, self._normals = self.views["points"], self.views["normals"]
        self._whole = False

    def state_at(self, q: Array) -> Array:
        """The state of rest at a posture (n,)."""
        rest = {item.name: np.zeros(item.shape) for item in self.cycle.state}
        return self.cycle.state.pack(rest | {"q": q, "goal": q, "there": 1.0})

    def _fill(self, **values: Array | float) -> None:
        for name, value in values.items():
            self.views[name][...] = value

    def ask(self, points: Array, normals: Array) -> str:
        """Ask for points and normals.

        Args:
            points: (f, 3) [m]; all NaN where a finger is free.
            normals: (f, 3) of any length; all NaN where free.

        Returns:
            What is wrong with them, "" if nothing is; then nothing is asked.
        """
        lengths = np.einsum("ij,ij->i", normals, normals)
        total = float(points.sum() + lengths.sum())
        if total - total == 0.0 and float(lengths.min()) > TINY:
            self._points[...] = points
            np.divide(normals, np.sqrt(lengths)[:, None], out=self._normals)
            if not self._whole:
                self._fill(weights=self._usual, **self._tolerances)
                self._whole = True
            return ""
        reason = fault(points, normals)
        if reason:
            return reason
        self._whole = False
        unit = normals / np.sqrt(lengths)[:, None]
        known = np.stack([~np.isnan(points[:, 0]), ~np.isnan(unit[:, 0])], axis=1)
        self._fill(points=np.nan_to_num(points), normals=np.nan_to_num(unit))
        self._fill(weights=known * self._usual, **self._tolerances)
        return ""

    def ask_problem(self, problem: Problems) -> None:
        """Ask for one target of the graph's kinds, checked before."""
        self._whole = False
        rows = contact_rows(self.cycle, problem)
        self._fill(**{name: values[0] for name, values in rows.items()})
        self._fill(**tolerance_rows(problem.tolerances))

    def ask_palm(self, pose: Array, weight: tuple[float, float]) -> None:
        """Ask for a pose of the palm (4, 4), as far as contacts leave it free."""
        checked = one_pose(pose)
        self._fill(palm_point=checked[:3, 3], palm_axes=checked[:3, :3], palm_weight=weight)

    def free_palm(self) -> None:
        """Ask for no pose of the palm."""
        if "palm_weight" in self.views:
            self._fill(palm_weight=0.0)

    def ask_nothing(self) -> None:
        """Ask for nothing: the goal stays."""
        self._whole = False
        self._fill(weights=0.0)
        self.free_palm()


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


def contact_rows(cycle: Cycle, problems: Problems) -> dict[str, Array]:
    """Targets as the parameters of a cycle's contacts.

    Args:
        cycle: The graph.
        problems: k targets of its kinds.

    Returns:
        By field (k, ...): vectors, with zeros where free, and weights.
    """
    known = [~np.isnan(array[..., 0]) for array in (problems.points, problems.normals)]
    values: dict[str, Array] = {
        f"{name}s": np.nan_to_num(problems.vectors(f"{name}s")) for name in cycle.contacts.data
    }
    return values | {"weights": np.stack(known, axis=2) * contact_weights(problems.tolerances)}


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
    if (np.einsum("ij,ij->i", normals[faces], normals[faces]) <= TINY).any():
        return "a normal is zero"
    return ""
