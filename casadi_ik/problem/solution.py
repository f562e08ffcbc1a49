"""The answer: configuration, status, and a verdict on every contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.arrays import Array
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.collision_report import CollisionReport, Pair
from casadi_ik.problem.contact_verdict import ContactVerdict, PalmVerdict
from casadi_ik.problem.diagnosis import Diagnosis
from casadi_ik.problem.status import Status


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer to one grasp.

    Attributes:
        success: Every contact within tolerance, and every actuator and joint within its limits
            unless limits are ignored. Recomputed from q, whatever the method says.
        status: How the solve ended.
        q: (n,) actuator positions reached [rad or m].
        iterations: Iterations over all phases and restarts.
        restarts: How often the method began anew.
        time: Seconds the solve took; in a batch its share of the time.
        contacts: Verdict by finger.
        phases: Iterations by phase name, in the order of the phases.
        limits_ok: Whether every actuator and joint is within its limits.
        method: Name of the method.
        robot: Name of the robot.
        actuators: Names of the entries of q.
        diagnosis: Why it is not solved; None if it is, or if no diagnosis was asked for.
        clearance: Distance of the pair of shapes that is nearest to being too near [m], negative:
            penetration; None if no scene was given: collisions were not checked.
        closest: That pair: two links, or a link and a solid of the scene.
        collision: Why all answers touch something, if that is the status and a diagnosis was asked
            for.
        palm: How far the palm is from where it was asked; None where contacts were asked for.

    Example:
        >>> solution = solver.solve(grasp)
        >>> solution.success, solution.q.shape == (len(solution.actuators),)
        (True, True)
        >>> all(contact.ok for contact in solution.contacts.values())
        True
    """

    success: bool
    status: Status
    q: Array
    iterations: int
    restarts: int
    time: float
    contacts: Mapping[str, ContactVerdict]
    phases: Mapping[str, int]
    limits_ok: bool
    method: str
    robot: str
    actuators: tuple[str, ...]
    diagnosis: Diagnosis | None = None
    clearance: float | None = None
    closest: Pair | None = None
    collision: CollisionReport | None = None
    palm: PalmVerdict | None = None

    def view(self, robot: ArmHand | None = None, **options: Any) -> Any:
        """Show it in the browser, and in a notebook; needs the extra `view`.

        Args:
            robot: The robot that was solved for; None: the shipped one of that name.
            options: As `casadi_ik.viewing.view_grasp` has them; `grasp` is what was asked for
                (without it the contacts that are reached are shown), `scene` what stands about.

        Returns:
            The running `casadi_ik.viewing.Viewer`.

        Raises:
            MissingExtraError: viser is not installed.
            UnknownNameError: No shipped robot has that name: give the robot.
        """
        return (robot or load_robot(self.robot)).view(self.q, **options)


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """The answers to a batch of k targets; the fields of `Solution` as arrays.

    Attributes:
        success: (k,) bool.
        status: (k,) codes of `Status`.
        q: (k, n) actuator positions [rad or m].
        iterations: (k,).
        restarts: (k,).
        time: (k,) seconds per solve; solves made side by side share the time.
        position_error: (k, f) [m], NaN where free.
        angle_error: (k, f) [rad], NaN where free.
        ok: (k, f) bool.
        limits_ok: (k,) bool.
        phases: (k,) iterations by phase name.
        tolerances: When a contact counted as reached, by finger.
        fingers: Names of the fingers, the order of every (k, f) array.
        method: Name of the method.
        robot: Name of the robot.
        actuators: Names of the columns of q.
        diagnoses: Why each target is not solved (None if it is); empty if not asked for.
        clearance: (k,) as for `Solution` [m], NaN where there is no finite q; None if no scene was
            given: collisions were not checked.
        closest: The pair of each target; empty if no scene was given.
        collisions: Why all answers touch something, by target; empty if no scene was given.
        palm_position_error: (k,) [m]; None where contacts were asked for, not palms.
        palm_angle_error: (k,) [rad], likewise.
        palm_ok: (k,) bool, likewise.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(1), 200))
        >>> batch = solver.solve_batch(points, normals)
        >>> batch.position_error.shape, set(batch.status_names.tolist())
        ((200, 3), {'SOLVED'})
    """

    success: NDArray[np.bool_]
    status: NDArray[np.int64]
    q: Array
    iterations: NDArray[np.int64]
    restarts: NDArray[np.int64]
    time: Array
    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    limits_ok: NDArray[np.bool_]
    phases: Mapping[str, NDArray[np.int64]]
    tolerances: tuple[Tolerance, ...]
    fingers: tuple[str, ...]
    method: str
    robot: str
    actuators: tuple[str, ...]
    diagnoses: tuple[Diagnosis | None, ...] = ()
    clearance: Array | None = None
    closest: tuple[Pair | None, ...] = ()
    collisions: tuple[CollisionReport | None, ...] = ()
    palm_position_error: Array | None = None
    palm_angle_error: Array | None = None
    palm_ok: NDArray[np.bool_] | None = None

    @classmethod
    def invalid(
        cls,
        count: int,
        method: str,
        robot: ArmHand,
        tolerances: tuple[Tolerance, ...],
        diagnosed: bool,
        checked: bool = False,
    ) -> BatchSolution:
        """Rows for targets that are malformed: status INVALID, NaN for every number."""
        n, f = len(robot.actuators), len(robot.fingers)
        none = np.zeros(count, dtype=np.int64)
        return cls(
            success=np.zeros(count, dtype=bool),
            status=np.full(count, int(Status.INVALID), dtype=np.int64),
            q=np.full((count, n), np.nan),
            iterations=none,
            restarts=none,
            time=np.zeros(count),
            position_error=np.full((count, f), np.nan),
            angle_error=np.full((count, f), np.nan),
            ok=np.zeros((count, f), dtype=bool),
            limits_ok=np.zeros(count, dtype=bool),
            phases={},
            tolerances=tolerances,
            fingers=robot.fingers,
            method=method,
            robot=robot.name,
            actuators=robot.actuators,
            diagnoses=(None,) * count if diagnosed else (),
            clearance=np.full(count, np.nan) if checked else None,
            closest=(None,) * count if checked else (),
            collisions=(None,) * count if checked else (),
        )

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def joined(cls, parts: Sequence[BatchSolution]) -> BatchSolution:
        """One batch after the other, at least one.

        A phase that a part does not know counts 0 iterations there.
        """
        first = parts[0]
        if len(parts) == 1:
            return first
        arrays = {
            item.name: np.concatenate([getattr(part, item.name) for part in parts])
            for item in fields(cls)
            if isinstance(getattr(first, item.name), np.ndarray)
        }
        none = [np.zeros(len(part), dtype=np.int64) for part in parts]
        names = dict.fromkeys(chain.from_iterable(part.phases for part in parts))
        phases = {
            name: np.concatenate(
                [part.phases.get(name, no) for part, no in zip(parts, none, strict=True)]
            )
            for name in names
        }
        each = {
            name: tuple(chain.from_iterable(getattr(part, name) for part in parts))
            for name in ("diagnoses", "closest", "collisions")
        }
        return replace(first, **arrays, phases=phases, **each)

    @property
    def status_names(self) -> NDArray[np.str_]:
        """(k,) names of the statuses."""
        return np.array([status.name for status in sorted(Status)])[self.status - min(Status)]

    def solution(self, row: int) -> Solution:
        """One row as a `Solution`.

        Example:
            >>> points, normals = robot.contacts(robot.home[None])
            >>> solver.solve_batch(points, normals).solution(0).status.name
            'SOLVED'
        """
        verdicts = zip(
            self.position_error[row].tolist(),
            self.angle_error[row].tolist(),
            self.ok[row].tolist(),
            self.tolerances,
            strict=True,
        )
        contacts = {
            name: ContactVerdict(*verdict)
            for name, verdict in zip(self.fingers, verdicts, strict=True)
        }
        return Solution(
            success=bool(self.success[row]),
            status=Status(int(self.status[row])),
            q=self.q[row],
            iterations=int(self.iterations[row]),
            restarts=int(self.restarts[row]),
            time=float(self.time[row]),
            contacts=contacts,
            phases={name: int(counts[row]) for name, counts in self.phases.items()},
            limits_ok=bool(self.limits_ok[row]),
            method=self.method,
            robot=self.robot,
            actuators=self.actuators,
            diagnosis=self.diagnoses[row] if self.diagnoses else None,
            clearance=None if self.clearance is None else float(self.clearance[row]),
            closest=self.closest[row] if self.closest else None,
            collision=self.collisions[row] if self.collisions else None,
            palm=self._palm(row),
        )

    def _palm(self, row: int) -> PalmVerdict | None:
        position, angle, ok = self.palm_position_error, self.palm_angle_error, self.palm_ok
        if position is None or angle is None or ok is None:
            return None
        return PalmVerdict(float(position[row]), float(angle[row]), bool(ok[row]))
