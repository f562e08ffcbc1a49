"""Find and rank grasps of a surface that an arm-hand can make: see `Solver.grasps_of`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.numbers import checked_integer, checked_number
from casadi_ik.files.input_checks.poses import single_pose
from casadi_ik.files.progress import progress
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.candidates import (
    Candidates,
    Generator,
    HandCheck,
    TouchParameters,
    pads_of,
    touching,
)
from casadi_ik.planning.touch.hand_table import HandTable
from casadi_ik.planning.touch.strength import (
    CLOSED,
    Strengths,
    closed,
    generators,
    narrowed,
    offsets,
    robustness,
    strengths,
)
from casadi_ik.planning.touch.surface import Surface, SurfaceSource, load_surface
from casadi_ik.solve.solution import BatchSolution, Solution

OPENINGS = (0.025, 0.015, 0.008)
"""Distances of fingertips from the object before they close; the first free one is used [m]."""

SQUEEZE_DEPTH = 5e-3
"""Mean depth of fingertips in the object at the posture `Grasp.squeeze` [m]."""

RETREAT = 0.06
"""Distance of the palm from the grasp at the pregrasp [m]."""

POSE_ANGLE_ERROR = float(np.deg2rad(3.0))
"""Default angle error of an object's pose from a camera [rad]."""

CLOSURE_FRICTION = float(np.cos(np.pi / 8))
"""Force closure is judged with friction reduced by this factor.

The friction cones so reduced lie within every pyramid of eight or more edges inscribed in the full
cones: another linear program with such pyramids agrees.
"""

Judgement = str | Callable[[ArmHand, Array], ArrayLike]
"""Ranking of grasps: a name of `RANKINGS`, or a function from configurations to scores (m,)."""

RANKINGS = ("load", "clearance", "limits", "q0")


@dataclass(frozen=True, eq=False)
class FoundGrasp:
    """A grasp that the arm-hand can make.

    Attributes:
        grasp: Contacts in the base frame, with the object's name and pose, the posture of the hand,
            and the hand before it closes (`pregrasp`) and as it squeezes (`squeeze`).
        solution: Solution in the scene.
        load: Weight held in the worst of six directions per newton of squeeze (sum of the normal
            forces), with friction. It is reduced by the object's displacement, as pads roll and
            motors yield like springs: halved at 20 mm or 30 deg [N/N].
        closure: The same over forces and torques (about the centre of the object, divided by half
            its size); above 0 the grasp is force-closed.
        score: Score by which it was ranked; higher is better.
        forces: Force (3,) of each fingertip on the object, base frame, with which to squeeze: the
            object stays at rest, and is best held against any pull. The normal components sum to
            1 N.
        most_squeeze: Largest sum of normal forces for which the torques of the motors suffice [N];
            inf if the robot's description has no `effort` of its joints.
    """

    grasp: Grasp
    solution: Solution
    load: float
    closure: float
    score: float
    forces: Mapping[str, Array]
    most_squeeze: float = np.inf

    @property
    def q(self) -> Array:
        """Configuration (n,) of the grasp, the goal of `Solver.reach`."""
        return self.solution.q

    @property
    def clearance(self) -> float | None:
        """Smallest distance between bodies that must not touch [m]."""
        return self.solution.clearance

    @property
    def pregrasp(self) -> Grasp | None:
        """Palm and posture before the hand closes; None if every opening of it collides."""
        return self.grasp.pregrasp


@dataclass(frozen=True, eq=False)
class FoundGrasps(Sequence[FoundGrasp]):
    """Distinct grasps of an object, best first.

    Attributes:
        entries: The grasps; `FoundGrasps` is a sequence of them.
        counts: Number of candidates that passed each stage, in order.
        prefer: Name of the ranking.
        time: Processor time [s].
        reason: Why there is no grasp; "" if there are some.
        robot: The robot.
        surface: Surface of the object.
        mu: Friction coefficient.
    """

    entries: tuple[FoundGrasp, ...]
    counts: Mapping[str, int]
    prefer: str
    time: float
    reason: str
    robot: ArmHand
    surface: Surface
    mu: float

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[FoundGrasp]:
        return iter(self.entries)

    @overload
    def __getitem__(self, index: int) -> FoundGrasp: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[FoundGrasp, ...]: ...

    def __getitem__(self, index: int | slice) -> FoundGrasp | tuple[FoundGrasp, ...]:
        return self.entries[index]

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """The grasps, for `Solver.choose`."""
        return tuple(entry.grasp for entry in self.entries)

    def robustness(
        self,
        position: float = 5e-3,
        angle: float = POSE_ANGLE_ERROR,
        hold: tuple[float, float] | None = None,
        samples: int = 64,
        seed: int = 0,
    ) -> Array:
        """Return how often each grasp still closes on an object that is displaced.

        The palm goes where it was planned, and each finger moves until it touches the object.

        Args:
            position: Displacement of the object, in random directions [m].
            angle: Rotation of the object, about random axes [rad].
            hold: Mass [kg] that the contacts have to hold, and the squeeze [N], as for
                `Solver.grasps_of`; None: the contacts have to be force-closed.
            samples: Number of displacements of each grasp.
            seed: Seed of their directions.

        Returns:
            (k,) shares of the displacements, one for each grasp.

        Raises:
            InputError: A negative or infinite number, no sample, or a bad `hold`.

        Example:
            >>> pose = np.eye(4)
            >>> pose[:3, 3] = [0.55, 0.1, 0.2]
            >>> gripper = ik.Solver(ik.load_robot("panda+panda_hand"))
            >>> found = gripper.grasps_of(ik.load_surface("tomato_soup_can"), pose, limit=3)
            >>> found.robustness(position=0.0, angle=0.0, samples=1)
            array([1., 1., 1.])
        """
        position = checked_number(position, "robustness: position", "a length [m] >= 0", 0.0)
        angle = checked_number(angle, "robustness: angle", "an angle [rad] >= 0", 0.0)
        samples = checked_integer(samples, "robustness: samples", 1)
        seed, hold = checked_integer(seed, "robustness: seed", 0), _checked_hold(hold)
        displacements = offsets(position, angle, samples, seed, self.surface.middle)
        shares = [
            robustness(self.robot, self.surface, entry, self.mu, displacements, hold)
            for entry in self
        ]
        return np.array(shares)

    @property
    def lines(self) -> tuple[str, ...]:
        """Summary in short lines."""
        lines = [f"{len(self)} distinct grasps in {self.time:.2f} s of processor time"]
        lines += [f"  {number:>9,} {stage}" for stage, number in self.counts.items()]
        lines += [f"{self.surface.name}: {note}" for note in self.surface.notes]
        if self.reason:
            return (*lines, f"none: {self.reason}")
        lines.append(f"best by {self.prefer}:")
        for rank, entry in enumerate(self.entries[:10], 1):
            clearance = entry.clearance
            room = "" if clearance is None else f", clearance {1e3 * clearance:.1f} mm"
            score = "" if self.prefer == "load" else f"{self.prefer} {entry.score:.4g}, "
            lines.append(f"  {rank:>2}. {score}load {entry.load:.3f} N/N{room}")
        return tuple(lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __repr__(self) -> str:
        return f"<FoundGrasps: {len(self)} by {self.prefer}>"


@dataclass(frozen=True, eq=False)
class _Batch:
    """Grasps of a batch that pass all stages, k of them.

    Attributes:
        solutions: Solutions of the batch.
        rows: (k,) rows of the grasps among these.
        hands: Hands at the solved configurations.
        loads: (k,) see `FoundGrasp.load`.
        closures: (k,) see `FoundGrasp.closure`.
        forces: (k, c, 3) forces on the object, in its frame.
        most_squeezes: (k,) see `FoundGrasp.most_squeeze`.
    """

    solutions: BatchSolution
    rows: NDArray[np.intp]
    hands: Candidates
    loads: Array
    closures: Array
    forces: Array
    most_squeezes: Array


@dataclass(frozen=True, eq=False)
class _Solvers:
    """Solvers of a search.

    Attributes:
        arms: Solver of palms without a scene.
        judge: Solver in the scene with the object.
        pose: (4, 4) pose of the object in the base frame.
        jobs: Number of threads.
        q0: (n,) configuration of the robot; None: home.
    """

    arms: Any
    judge: Any
    pose: Array
    jobs: int
    q0: Array | None


def grasps_of(
    solver: Any,
    surface: Surface | SurfaceSource,
    pose: ArrayLike | None = None,
    fingers: int = 3,
    mu: float = 0.5,
    hold: tuple[float, float] | None = None,
    limit: int = 200,
    jobs: int = 1,
    seed: int = 0,
    prefer: Judgement = "load",
    q0: ArrayLike | None = None,
    among: int = 200,
) -> FoundGrasps:
    """Find grasps of an object that arm and hand can make without collision.

    Two opposing fingertips are matched with two opposing patches of the surface, further fingertips
    are placed where they touch, palm and hand are refined until all are within 1 mm and 15 deg (40
    deg for balls), and the arm is solved. Grasps that are free of collision are checked once more
    and ranked.

    Args:
        solver: A `Solver`.
        surface: A surface, or what `load_surface` takes: a name or path, vertices and triangles,
            or a trimesh object.
        pose: (4, 4) of the object in the base frame; None: the identity.
        fingers: Number of fingertips that touch, the thumb among them; a hand with fewer uses all.
        mu: Friction coefficient between fingertips and object, from 0.01 to 10.
        hold: Mass [kg], and the squeeze [N] with which it has to be held in each of six
            directions, or the largest squeeze of the motors, if that is less; None: the grasp has
            to be force-closed.
        limit: Maximum number of distinct grasps.
        jobs: Number of threads; the result does not depend on it.
        seed: Seed of all random numbers.
        prefer: Ranking: "load", "clearance", "limits", "q0", or a function of the robot and
            configurations (m, n) that returns scores (m,), higher is better.
        q0: (n,) current configuration of the robot [rad or m]; None is `robot.home`.
        among: Number of distinct grasps to find, of which the best are returned: with a small
            `limit` it decides how good they are, and how long the search takes.

    Returns:
        The grasps, best first, with the number of candidates that passed each stage.

    Raises:
        InputError: An argument has the wrong type or value, or the surface cannot be grasped (see
            `load_surface`).
        UnsupportedError: The hand has one finger, robot or hand have no shapes, the robot is a
            body, or the method cannot solve palms.

    Example:
        >>> pose = np.eye(4)
        >>> pose[:3, 3] = [0.55, 0.1, 0.2]
        >>> gripper = ik.Solver(ik.load_robot("panda+panda_hand"))
        >>> found = gripper.grasps_of(ik.load_surface("tomato_soup_can"), pose, limit=5)
        >>> len(found), bool(found[0].load >= found[4].load)
        (5, True)
    """
    solver.robot.description.require_single_hand("grasps_of")
    begin, parameters = time.process_time(), TouchParameters()
    robot = solver.robot
    object_pose = np.eye(4) if pose is None else single_pose(pose)
    question = _checked(fingers, mu, hold, limit, among, seed, prefer)
    goal = max(question.limit, question.among)
    if not isinstance(surface, Surface):
        surface = load_surface(surface)
    table = HandTable.of(robot)
    arms, judge, hand_check = _solvers(solver, table, surface, object_pose, parameters)
    start = None if q0 is None else robot.configuration(q0)
    solvers = _Solvers(arms, judge, object_pose, jobs, start)
    rng = np.random.default_rng(question.seed)
    count = min(question.fingers, len(robot.fingers))
    generator = Generator(table, surface, count, parameters, rng, hand_check)
    batches: list[_Batch] = []
    n_found, n_drawn, n_attempts, n_duplicates = 0, 0, 0, 0
    size = parameters.first_batch
    with progress(goal) as show:
        while generator.has_pairs and n_found < goal and n_attempts < parameters.max_attempts:
            if n_attempts:
                generator.draw_pairs()
            hands = generator.candidates(size)
            n_drawn, n_attempts = n_drawn + size, generator.counts["attempts"]
            batch = _solved_batch(generator, hands, batches, solvers, question)
            n_new = 0 if batch is None else len(batch.rows)
            if batch is not None:
                batches.append(batch)
                show(min(n_new, goal - n_found))
                n_found += n_new
            n_duplicates = generator.duplicates + (0 if n_new else n_duplicates)
            if n_duplicates > max(goal, parameters.max_consecutive_duplicates * max(n_new, 1)):
                break
            if generator.arm_queries >= parameters.max_unreachable_hands and not n_found:
                break
            share = 1.2 * (goal - n_found) / n_found if n_found else 1.0
            largest = min(10 * n_drawn, parameters.max_batch)
            size = int(np.clip(share * n_drawn, parameters.first_batch, largest))
    ranked = _ranked(generator, batches, solvers, question, prefer)
    return replace(ranked, time=time.process_time() - begin)


_SOLVERS: WeakKeyDictionary[Any, dict[tuple[str, int, TouchParameters], tuple[Any, Any, Any]]] = (
    WeakKeyDictionary()
)
"""Cache by solver, then object and parameters: solver of palms, solver in the scene, tables."""


def _solvers(
    solver: Any, table: HandTable, surface: Surface, pose: Array, parameters: TouchParameters
) -> tuple[Any, Any, HandCheck]:
    """Return the solver of palms, the solver in the scene with the object, and the hand check.

    They are made once for an object; its contents are part of the key, since files may change.
    """
    key = surface.name, hash(surface.points.tobytes()), parameters
    cache = _SOLVERS.setdefault(solver, {})
    if key not in cache:
        tolerance = Tolerance(parameters.max_height, parameters.min_rotation / 15)
        options: dict[str, Any] = {"tolerance": tolerance, "options": {"max_rounds": 1}}
        scene = (solver.scene or Scene()).holding(surface.name, pose)
        make = type(solver)
        cache[key] = make(solver.robot, **options), make(solver.robot, scene=scene, **options), {}
    arms, judge, tables = cache[key]
    # Tables that do not depend on the pose are used again at the next one.
    judge = judge.moved(surface.name, pose)
    cache[key] = arms, judge, tables
    return arms, judge, HandCheck(table, judge.scene_check, pose, tables)


MU_RANGE = (0.01, 10.0)
"""Range of plausible friction coefficients: wider than from ice to soft rubber."""


@dataclass(frozen=True)
class _Question:
    """The arguments of `grasps_of`, checked."""

    fingers: int
    mu: float
    hold: tuple[float, float] | None
    limit: int
    among: int
    seed: int


def _checked(
    fingers: Any, mu: Any, hold: Any, limit: Any, among: Any, seed: Any, prefer: Any
) -> _Question:
    """Return the arguments of `grasps_of` as the types that they are documented to have.

    Raises:
        InputError: A type or value is not allowed.
    """
    low, high = MU_RANGE
    if not callable(prefer) and not (isinstance(prefer, str) and prefer in RANKINGS):
        raise InputError(f"prefer: found {prefer!r}, expected {', '.join(RANKINGS)} or a function")
    return _Question(
        checked_integer(fingers, "fingers", 2),
        checked_number(mu, "mu", f"a friction coefficient from {low:g} to {high:g}", low, high),
        _checked_hold(hold),
        checked_integer(limit, "limit", 1),
        checked_integer(among, "among", 1),
        checked_integer(seed, "seed", 0),
    )


def _checked_hold(hold: Any) -> tuple[float, float] | None:
    """Return mass [kg] and squeeze [N], or None.

    Raises:
        InputError: `hold` is not two numbers above 0.
    """
    if hold is None:
        return None
    expected = "a mass [kg] and a squeeze [N], both > 0"
    try:
        mass, squeeze = hold
    except (TypeError, ValueError) as error:
        raise InputError(f"hold: found {hold!r}, expected {expected}") from error
    least = float(np.finfo(float).tiny)
    return (
        checked_number(mass, "hold", expected, least),
        checked_number(squeeze, "hold", expected, least),
    )


def _scores(prefer: Callable[[ArmHand, Array], ArrayLike], robot: ArmHand, q: Array) -> Array:
    """Return the scores (m,) that a function gives configurations (m, n).

    Raises:
        InputError: The function fails, or does not return a number for each configuration.
    """
    try:
        scores = np.asarray(prefer(robot, q), dtype=float)
    except CasadiIKError:
        raise
    except Exception as error:  # anything that a caller's function does wrong
        raise InputError(f"prefer: the function failed: {type(error).__name__}: {error}") from error
    if scores.shape != (len(q),):
        raise InputError(f"prefer: found scores of shape {scores.shape}, expected ({len(q)},)")
    if np.isnan(scores).any():
        raise InputError("prefer: found a score that is NaN, expected numbers")
    return scores


def _solved_batch(
    generator: Generator,
    hands: Candidates,
    batches: Sequence[_Batch],
    solvers: _Solvers,
    question: _Question,
) -> _Batch | None:
    """Return the candidates that are new, force-closed, reached by the arm and free; None if none.

    Args:
        generator: Generator of the candidates; its counts are updated.
        hands: The candidates.
        batches: Grasps of earlier batches.
        solvers: Solvers of the search.
        question: Friction coefficient and load.
    """
    arms, judge, pose = solvers.arms, solvers.judge, solvers.pose
    robot, table, parameters = arms.robot, generator.table, generator.parameters
    mu, hold, n_candidates = question.mu, question.hold, len(hands)
    for batch in batches if n_candidates else ():
        hands = hands.rows(hands.new_rows(batch.hands, parameters))
    generator.duplicates = n_candidates - len(hands)
    generator.count("unlike those before", len(hands))
    if not len(hands):
        return None
    closure = closed(_wrenches(generator, hands, CLOSURE_FRICTION * mu))
    rows = np.argsort(-closure, kind="stable")[: np.count_nonzero(closure > CLOSED)]
    generator.count("force-closed", len(rows))
    distinct = rows[hands.rows(rows).distinct_rows(parameters)]
    generator.count("unlike each other", len(distinct))
    generator.duplicates += len(rows) - len(distinct)
    generator.arm_queries += len(distinct)
    if not len(distinct):
        return None
    hands = hands.rows(distinct)
    palms, postures = pose @ hands.palm, table.configuration(hands.hand)
    reached = arms.solve_palms(palms, postures, solvers.q0, jobs=solvers.jobs)
    q, is_free = reached.q, reached.success.copy()
    colliding = np.flatnonzero(is_free)
    colliding = colliding[~generator.hand_check.arm_is_free(q[colliding])]
    is_free[colliding] = False
    # Other arms for these hands cost more than other hands, unless most arms collide.
    if len(colliding) > is_free.sum():
        again = judge.solve_palms(
            palms[colliding], postures[colliding], solvers.q0, jobs=solvers.jobs
        )
        q[colliding], is_free[colliding] = again.q, again.success
    generator.count("arm reaches", int(reached.success.sum()))
    rows = np.flatnonzero(is_free)
    if not len(rows):
        return None
    hands, q = hands.rows(rows), q[rows]
    points, normals = (
        np.where(hands.used[..., None], values, np.nan) for values in robot.contacts(q)
    )
    solutions = judge.solve_batch(points, normals, q0=q, jobs=solvers.jobs)
    rows = np.flatnonzero(solutions.success)
    generator.count("free in the scene", len(rows))
    if not len(rows):
        return None
    hands = _as_solved(generator, hands.rows(rows), solutions.q[rows], pose)
    confirmed = _confirmed(generator, hands, mu)
    generator.count("contacts as claimed", len(confirmed))
    hands, rows = hands.rows(confirmed), rows[confirmed]
    if not len(rows):
        return None
    strength = _strengths(generator, hands, mu, hold)
    is_held = strength.hold(hold)
    if hold is not None:
        generator.count(f"hold {hold[0]:g} kg at {hold[1]:g} N", int(is_held.sum()))
    values = strength.load, strength.closure, strength.forces, strength.most
    return _Batch(
        solutions, rows[is_held], hands.rows(is_held), *(value[is_held] for value in values)
    )


def _as_solved(generator: Generator, hands: Candidates, q: Array, pose: Array) -> Candidates:
    """Return hands as configurations q (k, n) place them, with their contacts.

    Args:
        generator: Generator of the candidates.
        hands: The hands before the arm was solved; they say which fingers touch.
        q: (k, n) solved configurations.
        pose: (4, 4) pose of the object in the base frame.
    """
    table = generator.table
    palm = inverse(pose) @ table.robot.palm(q)
    solved = replace(hands, palm=palm, hand=np.take(q, table.motors, axis=1), contacts=None)
    return replace(
        solved,
        tips=pads_of(table, solved).points,
        contacts=touching(table, generator.surface, solved),
    )


def _confirmed(generator: Generator, hands: Candidates, mu: float) -> NDArray[np.intp]:
    """Return which hands meet every claim of a grasp: distance, lean, and force closure."""
    assert hands.contacts is not None
    ok = hands.contacts.accepted(generator.parameters, generator.table.roll)
    rows = np.flatnonzero((ok | ~hands.used).all(axis=1))
    firm = closed(_wrenches(generator, hands.rows(rows), CLOSURE_FRICTION * mu))
    return rows[firm > CLOSED]


def _of_touching(hands: Candidates, values: Array) -> Array:
    """Return the values (k, f, ...) of the fingers that touch, (k, c, ...)."""
    return values[hands.used].reshape(len(hands), -1, *values.shape[2:])


def _wrenches(generator: Generator, hands: Candidates, mu: float) -> Array:
    """Return the wrenches (k, 6, g) of the cones' edges at the contacts of hands."""
    assert hands.contacts is not None
    surface, contacts = generator.surface, hands.contacts
    foot, inward, spread = (
        _of_touching(hands, part) for part in (contacts.foot, contacts.inward, contacts.spread)
    )
    return generators(foot, inward, narrowed(mu, spread), surface.middle, surface.size / 2)


def _strengths(
    generator: Generator, hands: Candidates, mu: float, hold: tuple[float, float] | None
) -> Strengths:
    """Return how well hands hold the object."""
    assert hands.contacts is not None
    table, surface, robot = generator.table, generator.surface, generator.table.robot
    _, _, linear, angular = table.at(hands.hand)
    foot, inward, toward = (
        _of_touching(hands, part)
        for part in (hands.contacts.foot, hands.contacts.inward, hands.contacts.toward)
    )
    radii = table.radii[np.nonzero(hands.used)[1]].reshape(len(hands), -1)
    rotation = hands.palm[:, None, :3, :3]
    turned, jacobians = (rotation @ _of_touching(hands, part) for part in (angular, linear))
    jacobians = jacobians + np.cross(turned, (radii[..., None] * toward)[..., None], axis=2)
    return strengths(
        _wrenches(generator, hands, mu),
        foot - surface.middle,
        inward,
        radii,
        jacobians,
        [robot.description.actuators[i] for i in table.motors],
        mu,
        hold,
    )


def _ranked(
    generator: Generator,
    batches: list[_Batch],
    solvers: _Solvers,
    question: _Question,
    prefer: Judgement,
) -> FoundGrasps:
    """Return the best grasps of all batches."""
    robot, pose = solvers.arms.robot, solvers.pose
    entries = [(batch, i) for batch in batches for i in range(len(batch.rows))]
    name = prefer if isinstance(prefer, str) else "own"
    context = robot, generator.surface, question.mu
    if not entries:
        reason = generator.failure_reason()
        return FoundGrasps((), generator.counts, name, 0.0, reason, *context)
    q = np.concatenate([batch.solutions.q[batch.rows] for batch in batches])
    load = np.concatenate([batch.loads for batch in batches])
    closure = np.concatenate([batch.closures for batch in batches])
    most_squeeze = np.concatenate([batch.most_squeezes for batch in batches])
    clearance = np.concatenate(
        [np.asarray(batch.solutions.clearance)[batch.rows] for batch in batches]
    )
    span, q0 = robot.upper - robot.lower, robot.home if solvers.q0 is None else solvers.q0
    scores = {
        "load": lambda: load,
        "clearance": lambda: clearance,
        "limits": lambda: (np.minimum(q - robot.lower, robot.upper - q) / span).min(axis=1),
        "q0": lambda: -np.abs((q - q0) / span).max(axis=1),
    }
    score = scores[prefer]() if isinstance(prefer, str) else _scores(prefer, robot, q)
    best = np.argsort(-score, kind="stable")[: question.limit]
    chosen = [entries[row] for row in best]
    used = np.stack([batch.hands.used[i] for batch, i in chosen])
    which_touch = Candidates(np.zeros((len(best), 4, 4)), np.zeros((len(best), 0)), used)
    hands = _as_solved(generator, which_touch, q[best], pose)
    forces = np.zeros((*used.shape, 3))
    touching_forces = np.stack([batch.forces[i] for batch, i in chosen])
    forces[used] = (touching_forces @ pose[:3, :3].T).reshape(-1, 3)
    grasps = _grasps(generator, hands, q[best], pose, forces)
    ranked = []
    for i, (row, (batch, k), grasp) in enumerate(zip(best, chosen, grasps, strict=True)):
        by_finger = {name: forces[i, robot.fingers.index(name)] for name in grasp.contacts}
        solution = batch.solutions.solution(int(batch.rows[k]))
        values = float(load[row]), float(closure[row]), float(score[row])
        ranked.append(FoundGrasp(grasp, solution, *values, by_finger, float(most_squeeze[row])))
    return FoundGrasps(tuple(ranked), generator.counts, name, 0.0, "", *context)


def _grasps(
    generator: Generator, hands: Candidates, q: Array, pose: Array, forces: Array
) -> list[Grasp]:
    """Return the grasps of configurations, with the hand before it closes and as it squeezes.

    Args:
        generator: Generator of the candidates.
        hands: Hands at the configurations, with their contacts.
        q: (k, n) configurations.
        pose: (4, 4) pose of the object in the base frame.
        forces: (k, f, 3) forces on the object, base frame.
    """
    table, robot = generator.table, generator.table.robot
    assert hands.contacts is not None
    is_ball = table.radii > 0
    points, normals = robot.contacts(q)
    centers = points - table.radii[:, None] * normals
    toward = np.nan_to_num(hands.contacts.toward) @ pose[:3, :3].T
    contact_points = np.where(is_ball[:, None], centers + table.radii[:, None] * toward, points)
    palms = robot.palm(q)
    palm_forces, palm_offsets = (
        np.einsum("kfi,kij->kfj", vectors, palms[:, :3, :3])
        for vectors in (forces, contact_points - centers)
    )
    squeezed = table.squeezed(hands, palm_offsets, palm_forces, SQUEEZE_DEPTH)
    opened, is_open = hands.hand.copy(), np.zeros(len(hands), dtype=bool)
    for opening in OPENINGS:
        rows = np.flatnonzero(~is_open)
        if len(rows):
            trial = table.opened(hands.rows(rows), opening)
            is_free = generator.hand_check(trial)
            opened[rows[is_free]], is_open[rows[is_free]] = trial.hand[is_free], True
    motors = [robot.actuators[i] for i in table.motors]
    stem = Path(generator.surface.object.name).stem
    grasps = []
    for i in range(len(hands)):
        contacts = {}
        for j in np.flatnonzero(hands.used[i]):
            ball = toward[i, j] if is_ball[j] else None
            contacts[robot.fingers[j]] = Contact(contact_points[i, j], normals[i, j], ball=ball)
        retreated = palms[i].copy()
        way = retreated[:3, 3] - np.mean([contact.point for contact in contacts.values()], axis=0)
        retreated[:3, 3] += RETREAT * way / max(float(np.linalg.norm(way)), 1e-9)
        posture, open_posture, squeezing_posture = (
            dict(zip(motors, positions[i].tolist(), strict=True))
            for positions in (hands.hand, opened, squeezed)
        )
        pregrasp = Grasp(robot=robot.name, palm=retreated, posture=open_posture)
        grasps.append(
            Grasp(
                contacts,
                robot=robot.name,
                name=f"{stem} {'+'.join(contacts)}",
                object=generator.surface.name,
                object_pose=pose,
                posture=posture,
                pregrasp=pregrasp if is_open[i] else None,
                squeeze=Grasp(robot=robot.name, palm=palms[i], posture=squeezing_posture),
            )
        )
    return grasps
