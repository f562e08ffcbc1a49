"""Results of solves: solutions, batches, rankings of grasps, and alternatives."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from itertools import chain
from os import PathLike
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.reprs import RecordReprMixin, ReprMixin
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.solve.diagnosis import Diagnosis
from casadi_ik.solve.status import Status
from casadi_ik.solve.verdict import ContactVerdict, PalmVerdict, contact_verdicts

Pair = tuple[str, str]

MIN_TOLERANCE = 1e-12
"""Lower bound of tolerances as divisors [m, rad]."""


@dataclass(frozen=True)
class SuggestedFix:
    """Changes of a target under which a grasp in collision becomes solvable, among those tried.

    Attributes:
        translation: Shortest translation of the object and its contacts that gives a collision-free
            solution with the object itself free, base frame [m]; None: no translation does.
        max_translation: Longest translation that was tried [m].
        dispensable: Fingers whose contact can be dropped to obtain a collision-free solution.
    """

    translation: tuple[float, float, float] | None
    max_translation: float
    dispensable: tuple[str, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """Summary in short lines."""
        lines = [f"solvable without the contact of {name}" for name in self.dispensable]
        if self.translation is None:
            limit = f"{1e3 * self.max_translation:.0f} mm"
            return (*lines, f"the object moved by up to {limit} in 26 directions does not help")
        vector = ", ".join(f"{1e3 * value + 0.0:.0f}" for value in self.translation)
        length = 1e3 * math.hypot(*self.translation)
        return (*lines, f"solvable with the object moved by {length:.0f} mm: ({vector}) mm")

    @property
    def moved(self) -> tuple[float, float, float] | None:
        """Deprecated name of `translation`."""
        warn_renamed("SuggestedFix.moved", "SuggestedFix.translation")
        return self.translation

    @property
    def farthest(self) -> float:
        """Deprecated name of `max_translation`."""
        warn_renamed("SuggestedFix.farthest", "SuggestedFix.max_translation")
        return self.max_translation

    @property
    def fewer(self) -> tuple[str, ...]:
        """Deprecated name of `dispensable`."""
        warn_renamed("SuggestedFix.fewer", "SuggestedFix.dispensable")
        return self.dispensable


@dataclass(frozen=True)
class CollisionReport:
    """Report of a grasp whose solutions are all in collision.

    Attributes:
        pair: Pair in collision in the best solution: two links, or a link and a solid.
        short: Clearance that the pair lacks [m].
        n_checked: Number of solutions (hands, arms, elbows) that were checked.
        without_scene: Whether a solution is free of self-collision, ignoring the scene; None
            without a diagnosis.
        without_self: Whether a solution is free of the scene, ignoring self-collision; None
            without a diagnosis.
        way_out: Changes that make the grasp solvable; None unless a single grasp is diagnosed.

    Example:
        >>> wall = {"kind": "box", "size": [3, 3, 3], "xyz": [-1.8, 0, 1.0]}  # the cup is inside
        >>> blocked = ik.Solver(robot, scene=ik.Scene({"wall": wall})).solve(grasp)
        >>> blocked.status.name, "wall" in blocked.collision.pair
        ('COLLISION', True)
    """

    pair: Pair
    short: float
    n_checked: int
    without_scene: bool | None
    without_self: bool | None
    way_out: SuggestedFix | None = None

    @property
    def lines(self) -> tuple[str, ...]:
        """Summary in short lines."""
        answers = (
            "the answer touches" if self.n_checked == 1 else f"all {self.n_checked} answers touch"
        )
        lines = [
            f"contacts and limits are met, but {answers} something",
            f"best answer: {self.pair[0]} and {self.pair[1]}, {1e3 * self.short:.3g} mm too near",
        ]
        if self.without_scene:
            lines.append("solvable without the scene")
        if self.without_self:
            lines.append("solvable if the robot could pass through itself")
        return tuple(lines) if self.way_out is None else (*lines, *self.way_out.lines)

    @property
    def tried(self) -> int:
        """Deprecated name of `n_checked`."""
        warn_renamed("CollisionReport.tried", "CollisionReport.n_checked")
        return self.n_checked


@dataclass(slots=True, eq=False, repr=False)
class Solution(ReprMixin):
    """The result of solving one grasp.

    Attributes:
        success: Whether every contact is within tolerance, and q within limits unless limits are
            ignored; computed from q, independently of the method.
        status: How the solve ended.
        q: (n,) actuator positions [rad or m].
        iterations: Number of iterations over all phases and restarts.
        restarts: Number of restarts.
        time: Duration of the solve [s]; in a batch its share of the time.
        contacts: Verdict by finger.
        phases: Iterations by phase name, in the order of the phases.
        limits_ok: Whether every actuator and joint is within its limits.
        method: Name of the method.
        robot: Name of the robot.
        actuators: Names of the entries of q.
        diagnosis: Diagnosis of an unsolved grasp; None if it is solved or not diagnosed.
        clearance: Signed distance of the critical pair of shapes [m], negative in penetration;
            None without a scene.
        closest: The critical pair: two links, or a link and a solid of the scene.
        collision: Report of a grasp with status COLLISION; None without a diagnosis.
        palm: Errors of the palm pose; None for targets without palm poses.
        arm_hand: The robot; None if it is unknown.
        object_pose: (4, 4) object pose found for a `Free` object pose.

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
    arm_hand: ArmHand | None = None
    object_pose: Array | None = None

    @property
    def error_ratio(self) -> float:
        """Largest contact error over its tolerance; at most 1 if all contacts are met.

        Example:
            >>> solver.solve(grasp).error_ratio <= 1
            True
        """
        return max(
            (
                error / max(tolerance, MIN_TOLERANCE)
                for contact in self.contacts.values()
                for error, tolerance in (
                    (contact.position_error, contact.tolerance.position),
                    (contact.angle_error, contact.tolerance.angle),
                )
                if not math.isnan(error)
            ),
            default=0.0,
        )

    def draw(
        self,
        grasp: Grasp | None = None,
        path: str | PathLike[str] | None = None,
        **options: Any,
    ) -> Any:
        """Draw the solution; requires the extra `plots`.

        Args:
            grasp: The target; None: the contacts that q reaches.
            path: PNG file to write, if any.
            options: Options of `casadi_ik.app.pictures.draw_solution`: scene, view, dpi, dark.

        Returns:
            The matplotlib figure, which notebooks show.

        Raises:
            MissingExtraError: matplotlib or PyVista is not installed.
            PictureError: The file cannot be written, or OpenGL is not available.
        """
        robot = self.arm_hand or load_robot(self.robot)
        if grasp is None:
            contacts = zip(robot.fingers, *robot.contacts(self.q), strict=True)
            grasp = Grasp({name: Contact(point, normal) for name, point, normal in contacts})
        return import_module("casadi_ik.app.pictures").draw_solution(
            robot, self, grasp, path, **options
        )

    def view(self, robot: ArmHand | None = None, **options: Any) -> Any:
        """Show the solution in the browser, and in a notebook; requires the extra `view`.

        Args:
            robot: The robot that was solved for; None: `arm_hand`.
            options: Options of `casadi_ik.app.viewer.view_grasp`: `grasp`, the target (default:
                the contacts that q reaches), `scene`, the obstacles.

        Returns:
            The running `casadi_ik.app.viewer.Viewer`.

        Raises:
            MissingExtraError: viser is not installed.
            UnknownNameError: No shipped robot has this name; pass the robot.
        """
        robot = robot or self.arm_hand or load_robot(self.robot)
        return robot.view(self.q, **options)


@dataclass(frozen=True, eq=False, repr=False)
class BatchSolution(ReprMixin):
    """The results of solving a batch of k targets: the fields of `Solution` as arrays.

    Attributes:
        success: (k,) bool.
        status: (k,) codes of `Status`.
        q: (k, n) actuator positions [rad or m].
        iterations: (k,) numbers of iterations.
        restarts: (k,) numbers of restarts.
        time: (k,) seconds per solve; concurrent solves share the time.
        position_error: (k, f) distances [m], NaN where free.
        angle_error: (k, f) angles [rad], NaN where free.
        ok: (k, f) bool.
        limits_ok: (k,) bool.
        phases: (k,) iterations by phase name.
        tolerances: Tolerance by finger.
        fingers: Names of the fingers, in the order of (k, f) arrays.
        method: Name of the method.
        robot: Name of the robot.
        actuators: Names of the columns of q.
        diagnoses: Diagnosis of each target (None if it is solved); empty without diagnoses.
        clearance: (k,) clearances [m], NaN where q is not finite; None without a scene.
        closest: Critical pair of each target; empty without a scene.
        collisions: Collision report of each target; empty without a scene.
        palm_position_error: (k,) distances of palms [m]; None for targets without palm poses.
        palm_angle_error: (k,) rotation angles of palms [rad]; None likewise.
        palm_ok: (k,) bool; None likewise.
        arm_hand: The robot; None if it is unknown.

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
    arm_hand: ArmHand | None = None

    @property
    def error_ratio(self) -> Array:
        """(k,) largest contact error of each target over its tolerance."""
        limits = np.array([(item.position, item.angle) for item in self.tolerances])
        errors = np.stack([self.position_error, self.angle_error], axis=2)
        ratios = np.nan_to_num(errors / np.maximum(limits, MIN_TOLERANCE))
        return ratios.max(axis=(1, 2), initial=0.0)

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
        """Return rows of malformed targets: status INVALID, NaN for all numbers."""
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
            arm_hand=robot,
        )

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def concatenate(cls, parts: Sequence[BatchSolution]) -> BatchSolution:
        """Concatenate batches, at least one.

        A phase that is missing in a batch has 0 iterations there.
        """
        first = parts[0]
        if len(parts) == 1:
            return first
        arrays = {
            item.name: np.concatenate([getattr(part, item.name) for part in parts])
            for item in fields(cls)
            if isinstance(getattr(first, item.name), np.ndarray)
        }
        zeros = [np.zeros(len(part), dtype=np.int64) for part in parts]
        names = dict.fromkeys(chain.from_iterable(part.phases for part in parts))
        phases = {
            name: np.concatenate(
                [part.phases.get(name, zero) for part, zero in zip(parts, zeros, strict=True)]
            )
            for name in names
        }
        tuples = {
            name: tuple(chain.from_iterable(getattr(part, name) for part in parts))
            for name in ("diagnoses", "closest", "collisions")
        }
        return replace(first, **arrays, phases=phases, **tuples)

    @classmethod
    def joined(cls, parts: Sequence[BatchSolution]) -> BatchSolution:
        """Concatenate batches; deprecated name of `concatenate`."""
        warn_renamed("BatchSolution.joined", "BatchSolution.concatenate")
        return cls.concatenate(parts)

    @property
    def status_names(self) -> NDArray[np.str_]:
        """(k,) names of the statuses."""
        return np.array([status.name for status in sorted(Status)])[self.status - min(Status)]

    def solution(self, row: int) -> Solution:
        """Return a row as a `Solution`.

        Example:
            >>> points, normals = robot.contacts(robot.home[None])
            >>> solver.solve_batch(points, normals).solution(0).status.name
            'SOLVED'
        """
        errors = (array[row].tolist() for array in (self.position_error, self.angle_error, self.ok))
        contacts = contact_verdicts(self.fingers, self.tolerances, *errors)
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
            arm_hand=self.arm_hand,
        )

    def _palm(self, row: int) -> PalmVerdict | None:
        position, angle, ok = self.palm_position_error, self.palm_angle_error, self.palm_ok
        if position is None or angle is None or ok is None:
            return None
        return PalmVerdict(float(position[row]), float(angle[row]), bool(ok[row]))


class SolvedGrasp(Protocol):
    """A configuration that solves a grasp."""

    @property
    def grasp(self) -> Grasp:
        """Grasp in the base frame."""
        ...

    @property
    def q(self) -> Array:
        """(n,) configuration [rad or m]."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Choice(ReprMixin):
    """An entry of a `Ranking`.

    Attributes:
        candidate: Index of the grasp among the candidates.
        solution: Solution of the grasp.
        score: Score of the ranking, higher is better: smallest limit margin of the actuators that
            are not fixed, relative to half their range ("limits"); negative distance from q0,
            actuators relative to their ranges ("q0"); manipulability of the arm [m^3]
            ("manipulability"); clearance beyond the margins of the scene [m] ("clearance");
            negative error ratio of a nearest configuration ("nearest"); or the value of a score
            function.
        grasp: The grasp in the base frame.

    Example:
        >>> best = solver.choose([grasp], prefer="limits")[0]
        >>> best.candidate, best.solution.success
        (0, True)
    """

    candidate: int
    solution: Solution
    score: float
    grasp: Grasp

    @property
    def q(self) -> Array:
        """(n,) configuration [rad or m], the goal of `Solver.reach`."""
        return self.solution.q


@dataclass(frozen=True, eq=False, repr=False)
class Ranking(ReprMixin, Sequence[Choice]):
    """Candidate grasps with solutions, best first.

    Attributes:
        entries: The entries; the ranking is a sequence of them.
        candidates: Number of candidates.
        answered: Number of candidates with a solution, in `entries` or not.
        failures: Number of candidates without a solution by reason, most frequent first: the name
            of a `Status`, for COLLISION with the pair.
        prefer: Preference or score of the ranking.

    Example:
        >>> ranked = solver.choose([grasp, ik.load_grasp("apple")], limit=2, prefer="limits")
        >>> len(ranked), ranked.candidates, dict(ranked.failures)
        (2, 2, {})
        >>> print(ranked.lines[0])
        2 of 2 candidates have an answer
    """

    entries: tuple[Choice, ...]
    candidates: int
    answered: int
    failures: Mapping[str, int]
    prefer: str

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Choice]:
        return iter(self.entries)

    @overload
    def __getitem__(self, index: int) -> Choice: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Choice, ...]: ...

    def __getitem__(self, index: int | slice) -> Choice | tuple[Choice, ...]:
        return self.entries[index]

    @property
    def lines(self) -> tuple[str, ...]:
        """Summary in short lines."""
        lines = [f"{self.answered} of {self.candidates} candidates have an answer"]
        lines += [f"  {count} have none: {reason}" for reason, count in self.failures.items()]
        if self.entries:
            lines.append(f"best {len(self)} by {self.prefer}:")
        for rank, entry in enumerate(self.entries, 1):
            clearance = entry.solution.clearance
            text = "" if clearance is None else f", clearance {1e3 * clearance:.1f} mm"
            lines.append(f"  {rank}. candidate {entry.candidate}: {entry.score:.4g}{text}")
        return tuple(lines)


@dataclass(frozen=True)
class ArmBranch:
    """A branch of an arm, and the interval of its redundancy parameter.

    Attributes:
        shoulder: +1 or -1. For an arm with spherical shoulder, elbow and spherical wrist (S-R-S):
            sign of joint 2 relative to the alignment of axes 1 and 3.
        elbow: +1 or -1. S-R-S: sign of joint 4 relative to the stretched arm.
        wrist: +1 or -1. S-R-S: sign of joint 6 relative to the alignment of axes 5 and 7.
        swivel: (start, end) [rad] of an interval of the redundancy parameter within limits,
            start <= end; None for an arm without redundancy. S-R-S: the swivel angle of the elbow
            about the line from shoulder to wrist, a full revolution if all values are within
            limits. Other arms of seven joints: the position of the swept joint, see
            `casadi_ik.kinematics.arms.six_joints`.
        root: Index among the solutions with the same signs at a position of a swept joint; a
            wrist with an offset last axis may have several. 0 for other arms.

    Example:
        >>> branch = solver.solve_all(grasp, limit=1)[0].branch
        >>> branch.elbow in (-1, 1), branch.swivel[0] <= branch.swivel[1]
        (True, True)
    """

    shoulder: int
    elbow: int
    wrist: int
    swivel: tuple[float, float] | None
    root: int = 0


@dataclass(frozen=True, eq=False, repr=False)
class Alternative(RecordReprMixin):
    """A solution of a grasp that has several.

    Attributes:
        q: (n,) actuator positions [rad or m], within limits unless they are ignored.
        contacts: Verdict by finger; all are within tolerance.
        posture: Index of the hand posture; solutions may share it.
        branch: Branch of the arm with its redundancy interval; None for an arm without a closed
            form, and for a hand without an arm.
        swivel: Redundancy parameter of q [rad] within `branch.swivel`, or None.
        margin: Smallest limit margin of the actuators relative to half their range: 1 in the
            middle of the range, 0 at a limit.
        manipulability: Manipulability of the arm (Yoshikawa) [m^3]; 0 for a hand without an arm.
        distance: Euclidean distance from q0, actuators relative to their ranges.

    Example:
        >>> first, second = solver.solve_all(grasp, limit=2)
        >>> first.margin >= second.margin, first.q.shape
        (True, (14,))
    """

    q: Array
    contacts: Mapping[str, ContactVerdict]
    posture: int
    branch: ArmBranch | None
    swivel: float | None
    margin: float
    manipulability: float
    distance: float
