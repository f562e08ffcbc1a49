"""The answer: configuration, status, a verdict on every contact; of many grasps which to take."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from os import PathLike
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.files.lazy_import import ReprMixin, import_lazily
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.solve.diagnosis import Diagnosis
from casadi_ik.solve.status import Status
from casadi_ik.solve.verdict import ContactVerdict, PalmVerdict, contact_verdicts

Pair = tuple[str, str]


@dataclass(frozen=True)
class SuggestedFix:
    """What else would do where all answers touch something, as far as it was tried.

    Attributes:
        moved: Translation of what is grasped, with its contacts, for which there is a free answer,
            base frame [m]: the shortest of those tried, at which the object itself stands free;
            None: none of them has one.
        farthest: How far it was moved at the most [m].
        fewer: Fingers without whose contact there is a free answer.
    """

    moved: tuple[float, float, float] | None
    farthest: float
    fewer: tuple[str, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        lines = [f"solvable without the contact of {name}" for name in self.fewer]
        if self.moved is None:
            far = f"{1e3 * self.farthest:.0f} mm"
            return (*lines, f"the object moved by up to {far} in 26 directions does not help")
        way = ", ".join(f"{1e3 * value + 0.0:.0f}" for value in self.moved)
        length = 1e3 * math.hypot(*self.moved)
        return (*lines, f"solvable with the object moved by {length:.0f} mm: ({way}) mm")


@dataclass(frozen=True)
class CollisionReport:
    """Why every answer of a grasp collides.

    Attributes:
        pair: The pair that is in the way in the best answer: two links, or a link and a solid.
        short: By how much they are nearer than they have to be [m].
        tried: Answers (hands, arms, elbows) that were looked at.
        without_scene: Whether one of them is free of the robot itself, the scene left out; None if
            that was not looked at: it is where a diagnosis is asked for.
        without_self: Whether one of them is free of the scene, the robot itself left out, or None.
        way_out: What else would do; None if that was not looked for: it is where one grasp is
            solved and a diagnosis asked for.

    Example:
        >>> wall = {"kind": "box", "size": [3, 3, 3], "xyz": [-1.8, 0, 1.0]}  # the cup is inside
        >>> blocked = ik.Solver(robot, scene=ik.Scene({"wall": wall})).solve(grasp)
        >>> blocked.status.name, "wall" in blocked.collision.pair
        ('COLLISION', True)
    """

    pair: Pair
    short: float
    tried: int
    without_scene: bool | None
    without_self: bool | None
    way_out: SuggestedFix | None = None

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        answers = "the answer touches" if self.tried == 1 else f"all {self.tried} answers touch"
        lines = [
            f"contacts and limits are met, but {answers} something",
            f"best answer: {self.pair[0]} and {self.pair[1]}, {1e3 * self.short:.3g} mm too near",
        ]
        if self.without_scene:
            lines.append("solvable without the scene")
        if self.without_self:
            lines.append("solvable if the robot could pass through itself")
        return tuple(lines) if self.way_out is None else (*lines, *self.way_out.lines)


@dataclass(frozen=True, eq=False, repr=False)
class Solution(ReprMixin):
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
        arm_hand: The robot; None: not known.
        object_pose: (4, 4) where the object is, if that was looked for.

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

    def draw(
        self,
        grasp: Grasp | None = None,
        path: str | PathLike[str] | None = None,
        **options: Any,
    ) -> Any:
        """Draw it; needs the extra `plots`.

        Args:
            grasp: What was asked for; None: the contacts that are reached are shown.
            path: PNG file to write, if any.
            options: As `casadi_ik.app.pictures.draw_solution` has them: scene, view, dpi, dark.

        Returns:
            The matplotlib figure, which notebooks show.

        Raises:
            MissingExtraError: matplotlib or PyVista is not installed.
            PictureError: The file cannot be written, or there is no OpenGL to draw with.
        """
        robot = self.arm_hand or load_robot(self.robot)
        if grasp is None:
            reached = zip(robot.fingers, *robot.contacts(self.q), strict=True)
            grasp = Grasp({name: Contact(point, normal) for name, point, normal in reached})
        return import_lazily("casadi_ik.app.pictures").draw_solution(
            robot, self, grasp, path, **options
        )

    def view(self, robot: ArmHand | None = None, **options: Any) -> Any:
        """Show it in the browser, and in a notebook; needs the extra `view`.

        Args:
            robot: The robot that was solved for; None: the one that the answer knows.
            options: As `casadi_ik.app.viewer.view_grasp` has them; `grasp` is what was asked for
                (without it the contacts that are reached are shown), `scene` what stands about.

        Returns:
            The running `casadi_ik.app.viewer.Viewer`.

        Raises:
            MissingExtraError: viser is not installed.
            UnknownNameError: No shipped robot has that name: give the robot.
        """
        robot = robot or self.arm_hand or load_robot(self.robot)
        return robot.view(self.q, **options)


@dataclass(frozen=True, eq=False, repr=False)
class BatchSolution(ReprMixin):
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
        arm_hand: The robot; None: not known.

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
            arm_hand=robot,
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
        errors = self.position_error[[row]], self.angle_error[[row]], self.ok[[row]]
        (contacts,) = contact_verdicts(self.fingers, self.tolerances, *errors)
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


class Chosen(Protocol):
    """A posture that takes a grasp."""

    @property
    def grasp(self) -> Grasp:
        """In the base frame."""
        ...

    @property
    def q(self) -> Array:
        """(n,) the posture [rad or m]."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Choice(ReprMixin):
    """One of the answers of a `Ranking`.

    Attributes:
        candidate: Number of the grasp among those that were given, from 0.
        solution: How to take it.
        score: What it was ranked by, higher is better: smallest distance of an actuator that is
            not given from its limits as a part of half its range ("limits"); minus the distance
            from q0, every actuator as a part of its range ("q0"); of the arm [m^3]
            ("manipulability"); room beyond the margins of the scene [m] ("clearance"); or what the
            given function says.
        grasp: The grasp, where the object is (base frame).

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
        """(n,) the posture: what `Solver.reach` goes to."""
        return self.solution.q


@dataclass(frozen=True, eq=False, repr=False)
class Ranking(ReprMixin, Sequence[Choice]):
    """Ranked answers to many candidate grasps, best first.

    Attributes:
        entries: The answers; itself a sequence of them.
        candidates: How many grasps there were.
        answered: How many of them have an answer, in `entries` or not.
        failures: How many have none, by reason: the name of a `Status`, and of a COLLISION the pair
            that is in the way. Most frequent first.
        prefer: What they were ranked by.

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
    def __getitem__(self, place: int) -> Choice: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Choice, ...]: ...

    def __getitem__(self, place: int | slice) -> Choice | tuple[Choice, ...]:
        return self.entries[place]

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        lines = [f"{self.answered} of {self.candidates} candidates have an answer"]
        lines += [f"  {count} have none: {reason}" for reason, count in self.failures.items()]
        if self.entries:
            lines.append(f"best {len(self)} by {self.prefer}:")
        for place, one in enumerate(self.entries, 1):
            clear = one.solution.clearance
            room = "" if clear is None else f", clearance {1e3 * clear:.1f} mm"
            lines.append(f"  {place}. candidate {one.candidate}: {one.score:.4g}{room}")
        return tuple(lines)


@dataclass(frozen=True)
class ArmBranch:
    """One branch of an arm, and the range of its redundancy.

    Attributes:
        shoulder: +1 or -1. Of an arm with a spherical shoulder, elbow and spherical wrist (S-R-S):
            sign of joint 2 from where axes 1 and 3 are aligned.
        elbow: +1 or -1; S-R-S: sign of joint 4 from the stretched arm.
        wrist: +1 or -1; S-R-S: sign of joint 6 from where axes 5 and 7 are aligned.
        swivel: (start, end) [rad] of an interval of the arm's freedom within limits, start <= end;
            None for an arm without one. S-R-S: the angle of the elbow about the line from shoulder
            to wrist, a whole turn if none is out. Other arms of seven joints: the position of the
            joint that is swept, see `casadi_ik.kinematics.arms.six_joints`.
        root: Number of the arm among those of the same signs, at each position of a swept joint:
            a wrist whose last axis passes by it may have several. 0 of other arms.

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


@dataclass(frozen=True, eq=False)
class Alternative:
    """One of several solutions of a grasp.

    Attributes:
        q: (n,) actuator positions [rad or m], within limits unless they are ignored.
        contacts: Verdict by finger; all are met.
        posture: Number of the hand posture, the same for all solutions that share it.
        branch: How the arm is bent and how far it may be varied; None for an arm without a
            closed form, and for a hand without an arm.
        swivel: The swivel [rad] of q within `branch.swivel`, or None.
        margin: Smallest distance of any actuator from its limits as a part of half its range: 1
            in the middle of the range, 0 at a limit.
        manipulability: Yoshikawa's measure of the arm [m^3]; 0 for a hand without an arm.
        distance: Euclidean distance from q0, every actuator as a part of its range.

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
