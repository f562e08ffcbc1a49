"""Grasps of a surface that an arm-hand can make, ranked: see `Solver.grasps_of`."""

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
from casadi_ik.files.input_checks.poses import one_pose
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
"""How far fingertips are from the object before they close, the first that is clear [m]."""

INWARD = 5e-3
"""How far fingertips would go into the object to squeeze it, in the mean [m]."""

RETREAT = 0.06
"""How far the palm is back before it comes to the grasp [m]."""

ROUGHLY = float(np.deg2rad(3.0))
"""How far an object may be turned that was seen by a camera [rad]."""

SURE = float(np.cos(np.pi / 8))
"""Force closure is judged with friction reduced by this factor.

The friction cones so reduced lie within every pyramid of eight or more edges inscribed in the full
cones: another linear program with such pyramids agrees.
"""

Judgement = str | Callable[[ArmHand, Array], ArrayLike]
"""What grasps are ranked by: a name of `RANKINGS`, or scores (m,) of configurations (m, n)."""

RANKINGS = ("load", "clearance", "limits", "q0")


@dataclass(frozen=True, eq=False)
class FoundGrasp:
    """A grasp that the arm-hand can make.

    Attributes:
        grasp: Contacts in the base frame: where fingertips are and their pads face; with the
            object's name and pose, the hand's posture, and the same hand before (`pregrasp`) and as
            it squeezes (`squeeze`), as palms and postures.
        solution: How it is made, judged in the scene.
        load: Weight that the worst of six directions holds per newton of squeeze (the sum of the
            normal forces) with friction, the less the more the object gives way: half where it
            moves 20 mm, or turns 30 deg, as pads roll and motors yield like springs [N/N].
        closure: The same over forces and torques (about the middle of the object, divided by half
            its size); above 0 the grasp is force-closed.
        score: What it was ranked by, higher is better.
        forces: (3,) by finger, with which to squeeze, of the fingertip on the object, base frame:
            the object stays at rest, and is best held against any pull. Their normal parts sum to
            1 N.
        most_squeeze: Largest sum of normal forces for which the torques of the motors suffice [N];
            inf where the robot's description tells none (`effort` of a joint).
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
        """(n,) the posture: what `Solver.reach` goes to."""
        return self.solution.q

    @property
    def clearance(self) -> float | None:
        """Smallest distance of a pair that must not touch [m]."""
        return self.solution.clearance

    @property
    def pregrasp(self) -> Grasp | None:
        """Palm and posture before it; None: no opening of the hand was clear."""
        return self.grasp.pregrasp


@dataclass(frozen=True, eq=False)
class FoundGrasps(Sequence[FoundGrasp]):
    """Distinct grasps of an object, best first.

    Attributes:
        entries: The grasps; itself a sequence of them.
        counts: How many candidates passed each stage, in order.
        prefer: What they are ranked by.
        time: Processor time [s].
        reason: Why there is none; "" if there are some.
        robot: The robot.
        surface: The object's.
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
    def __getitem__(self, place: int) -> FoundGrasp: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[FoundGrasp, ...]: ...

    def __getitem__(self, place: int | slice) -> FoundGrasp | tuple[FoundGrasp, ...]:
        return self.entries[place]

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """The grasps, for `Solver.choose`."""
        return tuple(one.grasp for one in self.entries)

    def robustness(
        self,
        position: float = 5e-3,
        angle: float = ROUGHLY,
        hold: tuple[float, float] | None = None,
        samples: int = 64,
        seed: int = 0,
    ) -> Array:
        """How the grasps bear that the object is not quite where it was thought to be.

        The share of displacements at which the fingers, each moving until it touches, still close
        on the object.

        Args:
            position: How far the object is off, in random directions [m].
            angle: How far it is turned, about random axes [rad].
            hold: Mass [kg], and the squeeze [N] with which it has to be held then, as for
                `Solver.grasps_of`; None: it is enough that the hand closes.
            samples: Displacements of each grasp.
            seed: Of their directions.

        Returns:
            (k,) shares, one for each grasp.

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
        off = offsets(position, angle, samples, seed, self.surface.middle)
        shares = [robustness(self.robot, self.surface, one, self.mu, off, hold) for one in self]
        return np.array(shares)

    @property
    def lines(self) -> tuple[str, ...]:
        """The same in short lines."""
        lines = [f"{len(self)} distinct grasps in {self.time:.2f} s of processor time"]
        lines += [f"  {number:>9,} {stage}" for stage, number in self.counts.items()]
        lines += [f"{self.surface.name}: {note}" for note in self.surface.notes]
        if self.reason:
            return (*lines, f"none: {self.reason}")
        lines.append(f"best by {self.prefer}:")
        for place, one in enumerate(self.entries[:10], 1):
            room = "" if one.clearance is None else f", clearance {1e3 * one.clearance:.1f} mm"
            score = "" if self.prefer == "load" else f"{self.prefer} {one.score:.4g}, "
            lines.append(f"  {place:>2}. {score}load {one.load:.3f} N/N{room}")
        return tuple(lines)

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __repr__(self) -> str:
        return f"<FoundGrasps: {len(self)} by {self.prefer}>"


@dataclass(frozen=True, eq=False)
class _Made:
    """Grasps of a round that pass all: k of them."""

    batch: BatchSolution
    rows: NDArray[np.intp]
    some: Candidates
    loads: Array
    closures: Array
    forces: Array
    most: Array


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
    """Find grasps of an object that the arm and the hand can make, free of collision.

    Two opposing fingertips are matched with two opposing patches of the surface, the others
    look for something to touch, palm and hand are moved until all touch within 1 mm and 15 deg
    (pads that are balls 40), the arm follows, and what remains is judged in the scene and ranked.

    Args:
        solver: A `Solver`.
        surface: A surface, or what `load_surface` takes: a name or path, vertices and triangles,
            or a trimesh object.
        pose: (4, 4) of the object in the base frame; None: the identity.
        fingers: How many fingertips touch, the thumb among them; of a hand with fewer, all.
        mu: Friction coefficient between fingertips and object, from 0.01 to 10.
        hold: Mass [kg], and the squeeze [N] with which it has to be held in each of six
            directions, or with what the motors' torques suffice for, if that is less; None: it is
            enough that the grasp is force-closed.
        limit: How many distinct grasps at most.
        jobs: Threads; the answer does not depend on them.
        seed: Of all random numbers.
        prefer: What comes first: "load", "clearance", "limits", "q0", or a function of the
            robot and configurations (m, n) that gives scores (m,), higher is better.
        q0: (n,) where the robot is [rad or m]; None is `robot.home`.
        among: Of so many distinct grasps, if there are, the best are given: with a small `limit`
            this decides how good they are, and how long it takes.

    Returns:
        The grasps, best first, with how many candidates passed each stage.

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
    solver.robot.description.one_hand("grasps_of")
    begin, chosen = time.process_time(), TouchParameters()
    robot = solver.robot
    place = np.eye(4) if pose is None else one_pose(pose)
    question = _checked(fingers, mu, hold, limit, among, seed, prefer)
    mu, hold, limit, seed = question.mu, question.hold, question.limit, question.seed
    goal = max(limit, question.among)
    fingers = min(question.fingers, len(robot.fingers))
    if not isinstance(surface, Surface):
        surface = load_surface(surface)
    table = HandTable.of(robot)
    arms, judge, hands = _solvers(solver, table, surface, place, chosen)
    generator = Generator(table, surface, fingers, chosen, np.random.default_rng(seed), hands)
    start = None if q0 is None else robot.configuration(q0)
    parts: list[_Made] = []
    known, drawn, tried, alike, wanted = 0, 0, 0, 0, chosen.first
    with progress(goal) as show:
        while generator.fits and known < goal and tried < chosen.most:
            if tried:
                generator.look()
            some = generator.candidates(wanted)
            drawn, tried = drawn + wanted, generator.counts["attempts"]
            before = [part.some for part in parts]
            made = _made(generator, some, before, arms, judge, place, mu, hold, jobs, start)
            new = 0 if made is None else len(made.rows)
            if made is not None:
                parts.append(made)
                show(min(new, goal - known))
                known += new
            alike = generator.alike if new else alike + generator.alike
            if alike > max(goal, chosen.seldom * max(new, 1)):
                break  # nearly each is like one found before
            if generator.asked >= chosen.lost and not known:
                break  # the arm reaches none
            share = 1.2 * (goal - known) / known if known else 1.0
            wanted = int(np.clip(share * drawn, chosen.first, min(10 * drawn, chosen.round)))
    found = _ranked(robot, generator, hands, parts, place, limit, prefer, start, mu)
    return replace(found, time=time.process_time() - begin)


_SOLVERS: WeakKeyDictionary[Any, dict[tuple[str, int, TouchParameters], tuple[Any, Any, Any]]] = (
    WeakKeyDictionary()
)


def _solvers(
    solver: Any, table: HandTable, surface: Surface, place: Array, chosen: TouchParameters
) -> tuple[Any, Any, HandCheck]:
    """What solves palms, what judges grasps and hands with the object in the scene; made once."""
    # A file may be another mesh by now.
    key = surface.name, hash(surface.points.tobytes()), chosen
    made = _SOLVERS.setdefault(solver, {})
    if key not in made:
        kinds = {"tolerance": Tolerance(chosen.touch, chosen.turned / 15)}
        kinds |= {"options": {"max_rounds": 1}}
        scene = (solver.scene or Scene()).holding(surface.name, place)
        one = type(solver)
        made[key] = one(solver.robot, **kinds), one(solver.robot, scene=scene, **kinds), {}
    arms, judge, tables = made[key]
    # What is worked out for the object at one place serves at the next.
    judge = judge.moved(surface.name, place)
    made[key] = arms, judge, tables
    return arms, judge, HandCheck(table, judge.scene_check, place, tables)


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
    prefer: Judgement


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
        prefer,
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


def _made(
    generator: Generator,
    some: Candidates,
    before: Sequence[Candidates],
    arms: Any,
    judge: Any,
    place: Array,
    mu: float,
    hold: tuple[float, float] | None,
    jobs: int,
    start: Array | None,
) -> _Made | None:
    """Those that are unlike those before, hold, are reached by the arm and free in the scene."""
    robot, table = arms.robot, generator.table
    clear, chosen = len(some), generator.parameters
    for part in before if clear else ():
        some = some.rows(some.unlike(part, chosen))
    generator.alike = clear - len(some)
    generator.counted("unlike those before", len(some))
    if not len(some):
        return None
    firm = closed(_wrenches(generator, some, SURE * mu))
    rows = np.argsort(-firm, kind="stable")[: np.count_nonzero(firm > CLOSED)]
    generator.counted("force-closed", len(rows))
    new = rows[some.rows(rows).distinct(chosen)]
    generator.counted("unlike each other", len(new))
    generator.alike += len(rows) - len(new)
    generator.asked += len(new)
    if not len(new):
        return None
    some = some.rows(new)
    palms, hands = place @ some.palm, table.configuration(some.hand)
    reached = arms.solve_palms(palms, hands, start, jobs=jobs)
    q, met = reached.q, reached.success.copy()
    hits = np.flatnonzero(met)
    hits = hits[~generator.clear.arm_clear(q[hits])]
    met[hits] = False
    if len(hits) > met.sum():  # other arms for these hands; else other hands come cheaper
        other = judge.solve_palms(palms[hits], hands[hits], start, jobs=jobs)
        q[hits], met[hits] = other.q, other.success
    generator.counted("arm reaches", int(reached.success.sum()))
    rows = np.flatnonzero(met)
    if not len(rows):
        return None
    some, q = some.rows(rows), q[rows]
    points, normals = (np.where(some.used[..., None], part, np.nan) for part in robot.contacts(q))
    batch = judge.solve_batch(points, normals, q0=q, jobs=jobs)
    rows = np.flatnonzero(batch.success)
    generator.counted("free in the scene", len(rows))
    if not len(rows):
        return None
    final = _as_solved(generator, some.rows(rows), batch.q[rows], place)
    kept = _confirmed(generator, final, mu)
    generator.counted("contacts as claimed", len(kept))
    final, rows = final.rows(kept), rows[kept]
    if not len(rows):
        return None
    strength = _strengths(generator, final, mu, hold)
    held = strength.hold(hold)
    if hold is not None:
        generator.counted(f"hold {hold[0]:g} kg at {hold[1]:g} N", int(held.sum()))
    parts = strength.load, strength.closure, strength.forces, strength.most
    return _Made(batch, rows[held], final.rows(held), *(part[held] for part in parts))


def _as_solved(generator: Generator, hands: Candidates, q: Array, place: Array) -> Candidates:
    """Return hands as configurations q (k, n) place them, with their contacts.

    Args:
        generator: Generator of the candidates.
        hands: The hands before the arm was solved; they say which fingers touch.
        q: (k, n) solved configurations.
        place: (4, 4) pose of the object in the base frame.
    """
    table = generator.table
    palm = inverse(place) @ table.robot.palm(q)
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
    firm = closed(_wrenches(generator, hands.rows(rows), SURE * mu))
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
    robot: ArmHand,
    generator: Generator,
    hands: HandCheck,
    parts: list[_Made],
    place: Array,
    limit: int,
    prefer: Judgement,
    start: Array | None,
    mu: float,
) -> FoundGrasps:
    """The distinct ones, best first."""
    where = [(part, i) for part in parts for i in range(len(part.rows))]
    name, about = prefer if isinstance(prefer, str) else "own", (robot, generator.surface, mu)
    if not where:
        return FoundGrasps((), generator.counts, name, 0.0, generator.why_none(), *about)
    q = np.concatenate([part.batch.q[part.rows] for part in parts])
    load = np.concatenate([part.loads for part in parts])
    closure = np.concatenate([part.closures for part in parts])
    most = np.concatenate([part.most for part in parts])
    clearance = np.concatenate([np.asarray(part.batch.clearance)[part.rows] for part in parts])
    span = robot.upper - robot.lower
    scores = {
        "load": lambda: load,
        "clearance": lambda: clearance,
        "limits": lambda: (np.minimum(q - robot.lower, robot.upper - q) / span).min(axis=1),
        "q0": lambda: -np.abs((q - (robot.home if start is None else start)) / span).max(axis=1),
    }
    score = scores[prefer]() if isinstance(prefer, str) else _scores(prefer, robot, q)
    kept = np.argsort(-score, kind="stable")[:limit]
    chosen = [where[row] for row in kept]
    used = np.stack([part.some.used[i] for part, i in chosen])
    hands_kept = Candidates(np.zeros((len(kept), 4, 4)), np.zeros((len(kept), 0)), used)
    some = _as_solved(generator, hands_kept, q[kept], place)
    # Of the fingertips that touch, in the order of the fingers.
    forces = np.zeros((*some.used.shape, 3))
    squeezes = np.stack([part.forces[i] for part, i in chosen])
    forces[some.used] = (squeezes @ place[:3, :3].T).reshape(-1, 3)
    solutions = [part.batch.solution(int(part.rows[i])) for part, i in chosen]
    grasps = _grasps(robot, generator, hands, some, q[kept], place, forces)
    entries = []
    for i, (row, solution, grasp) in enumerate(zip(kept, solutions, grasps, strict=True)):
        by_finger = {name: forces[i, robot.fingers.index(name)] for name in grasp.contacts}
        values = float(load[row]), float(closure[row]), float(score[row])
        entries.append(FoundGrasp(grasp, solution, *values, by_finger, float(most[row])))
    return FoundGrasps(tuple(entries), generator.counts, name, 0.0, "", *about)


def _grasps(
    robot: ArmHand,
    generator: Generator,
    hands: HandCheck,
    some: Candidates,
    q: Array,
    place: Array,
    forces: Array,
) -> list[Grasp]:
    """The grasps of postures q (k, n), with the hand before each and as it squeezes.

    Args:
        robot: The robot.
        generator: Of the candidates.
        hands: Tells which hands are clear.
        some: The hands as they touch.
        q: (k, n) the postures.
        place: (4, 4) of the object.
        forces: (k, f, 3) on the object, base frame.
    """
    table, surface = generator.table, generator.surface
    assert some.contacts is not None
    points, normals = robot.contacts(q)
    middles = points - table.radii[:, None] * normals
    toward = np.nan_to_num(some.contacts.toward) @ place[:3, :3].T
    touched = np.where(table.radii[:, None] > 0, middles + table.radii[:, None] * toward, points)
    palms = robot.palm(q)
    seen_forces, seen_pads = (
        np.einsum("kfi,kij->kfj", one, palms[:, :3, :3]) for one in (forces, touched - middles)
    )
    squeezed = table.squeezed(some, seen_pads, seen_forces, INWARD)
    opened, known = some.hand.copy(), np.zeros(len(some), dtype=bool)
    seen = some
    for opening in OPENINGS:
        left = np.flatnonzero(~known)
        if len(left):
            tried = table.opened(seen.rows(left), opening)
            clear = hands(tried)
            opened[left[clear]], known[left[clear]] = tried.hand[clear], True
    motors = [robot.actuators[i] for i in table.motors]
    stem = Path(surface.object.name).stem
    found = []
    for i in range(len(some)):
        contacts = {}
        for j in np.flatnonzero(some.used[i]):
            ball = toward[i, j] if table.radii[j] else None
            contacts[robot.fingers[j]] = Contact(touched[i, j], normals[i, j], ball=ball)
        back = palms[i].copy()
        away = back[:3, 3] - np.mean([one.point for one in contacts.values()], axis=0)
        back[:3, 3] += RETREAT * away / max(float(np.linalg.norm(away)), 1e-9)
        hand, before, after = (
            dict(zip(motors, one[i].tolist(), strict=True)) for one in (some.hand, opened, squeezed)
        )
        pregrasp = Grasp(robot=robot.name, palm=back, posture=before) if known[i] else None
        found.append(
            Grasp(
                contacts,
                robot=robot.name,
                name=f"{stem} {'+'.join(contacts)}",
                object=surface.name,
                object_pose=place,
                posture=hand,
                pregrasp=pregrasp,
                squeeze=Grasp(robot=robot.name, palm=palms[i], posture=after),
            )
        )
    return found
