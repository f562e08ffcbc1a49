"""A solve of a log as what is shown of each of its iterations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import LogError
from casadi_ik.grasps import Contact, Grasp
from casadi_ik.logs.events import plain_name, told
from casadi_ik.logs.solve import OneSolve, Stretch
from casadi_ik.problem.verdict import ContactVerdict
from casadi_ik.viewing.asked import Asked, asked_of

SIGMA = "sigma_"
"""Singular values are recorded under names that begin so."""


@dataclass(frozen=True, eq=False)
class Track:
    """A solve.

    Attributes:
        solve: As the log has it.
        robot: What was solved for.
        label: What it is called: method and number.
        q: (k, n) by iteration [rad or m].
        asked: Its contacts.
    """

    solve: OneSolve
    robot: ArmHand
    label: str
    q: Array
    asked: Asked

    def __len__(self) -> int:
        return len(self.q)

    def verdicts(self, iteration: int) -> dict[str, ContactVerdict]:
        """By finger how far its contact is off in an iteration."""
        position, angle = self.errors
        found: dict[str, ContactVerdict] = {}
        for i, (finger, bound) in enumerate(
            zip(self.solve.fingers, self.solve.tolerances, strict=True)
        ):
            p, a = float(position[iteration, i]), float(angle[iteration, i])
            off = p > bound.position or a > bound.angle
            found[finger] = ContactVerdict(p, a, not off, bound)
        return found

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """(k, f) distances [m] and angles [rad]; where a step has none of its own, those of q."""
        solve = self.solve
        targets = np.broadcast_arrays(
            solve.target_points, solve.target_normals, np.zeros((len(self), 1, 1))
        )[:2]
        reached = self.robot.errors(self.q, *targets)
        recorded = solve.columns("position_error"), solve.columns("angle_error")
        position, angle = (
            np.where(np.isfinite(ours), ours, theirs)
            for ours, theirs in zip(recorded, reached, strict=True)
        )
        return position, angle

    @property
    def singular_values(self) -> dict[str, Array]:
        """(k,) by Jacobian; NaN where not computed."""
        found: dict[str, Array] = {}
        for name in self.solve.layout.names:
            if name.startswith(SIGMA):
                columns = self.solve.columns(name)
                short = plain_name(name.removeprefix(SIGMA))
                for i in range(columns.shape[1]):
                    of = f" {self.solve.name_of(name, i)}" if columns.shape[1] > 1 else ""
                    found[f"{short}{of}"] = columns[:, i]
        return found

    def stretch(self, iteration: int) -> Stretch:
        """The phase of an iteration."""
        return next(one for one in self.solve.stretches if one.first <= iteration <= one.last)

    def happened(self, iteration: int) -> list[str]:
        """What happened in an iteration, in words."""
        return [told(one) for one in self.solve.events if one.iteration == iteration]

    @property
    def eventful(self) -> list[int]:
        """Iterations in which something happened."""
        return sorted({one.iteration for one in self.solve.events})


def track_of(solve: OneSolve, robot: ArmHand) -> Track:
    """A solve, ready to be played.

    Raises:
        LogError: The log has kept no iterations of it.
    """
    if len(solve.rows) == 0:
        raise LogError(
            f"solve {solve.solve_id} of {solve.method}: the log kept no iterations of it"
        )
    q = solve.columns("q")
    finite = np.asarray(np.isfinite(q).all(axis=1))
    q = np.where(finite[:, None], q, robot.home)
    contacts: dict[str, Contact] = {}
    for i, finger in enumerate(solve.fingers):
        point, normal = solve.target_points[i], solve.target_normals[i]
        faced = np.isfinite(normal).all()
        more = {
            name.removesuffix("s"): rows[i]
            for name, rows in solve.target_more.items()
            if np.isfinite(rows[i]).all()
        }
        if np.isfinite(point).all():
            contacts[finger] = Contact(point, normal if faced else None, **more)
        elif faced:
            contacts[finger] = Contact(direction=normal)
    grasp = Grasp(contacts) if contacts else None
    label = f"{solve.method} · solve {solve.solve_id}"
    return Track(solve, robot, label, q, asked_of(robot, grasp, q[0]))
