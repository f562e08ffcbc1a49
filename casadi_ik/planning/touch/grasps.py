"""Search for grasps of a surface that an arm-hand can reach, see `Solver.grasps_of`.

Candidates from the generator pass through stages: the arm is solved, the contacts of the solved
hand are confirmed as force-closed, collisions are resolved, and the remaining grasps are ranked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.scene import Scene
from casadi_ik.errors import CasadiIKError, InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_integer, checked_number, single_pose
from casadi_ik.files.progress import progress
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.candidates import Generator, HandCheck, fingertip_pads, tip_contacts
from casadi_ik.planning.touch.found_grasps import FoundGrasp, FoundGrasps, checked_hold
from casadi_ik.planning.touch.hand_table import HandTable
from casadi_ik.planning.touch.hands import HandCandidates, TouchParameters
from casadi_ik.planning.touch.strength import (
    MIN_CLOSURE_LOAD,
    GraspStrengths,
    closure_load,
    friction_wrenches,
    grasp_strengths,
    narrowed_friction,
)
from casadi_ik.planning.touch.surface import Surface, SurfaceSource, load_surface
from casadi_ik.solve.solution import BatchSolution

Ranking = str | Callable[[ArmHand, Array], ArrayLike]
"""Ranking of grasps: a name of `RANKINGS`, or a function of robot and q (m, n) to scores (m,)."""

RANKINGS = ("load", "clearance", "limits", "q0")
"""Names of the rankings of grasps."""


@dataclass(frozen=True, eq=False)
class _Batch:
    """The k grasps of a batch that pass all stages.

    Attributes:
        solutions: Solutions of the batch.
        rows: (k,) rows of the grasps in `solutions`.
        hands: Hands at the solved configurations.
        loads: (k,) see `FoundGrasp.load`.
        closures: (k,) see `FoundGrasp.closure`.
        forces: (k, c, 3) forces on the object, in its frame.
        most_squeezes: (k,) see `FoundGrasp.most_squeeze`.
    """

    solutions: BatchSolution
    rows: NDArray[np.intp]
    hands: HandCandidates
    loads: Array
    closures: Array
    forces: Array
    most_squeezes: Array


@dataclass(frozen=True, eq=False)
class _Solvers:
    """Solvers of a search.

    Attributes:
        arm: Solver of palms without a scene.
        scene: Solver in the scene with the object.
        pose: (4, 4) pose of the object in the base frame.
        jobs: Number of threads.
        q0: (n,) configuration of the robot; None: home.
    """

    arm: Any
    scene: Any
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
    prefer: Ranking = "load",
    q0: ArrayLike | None = None,
    among: int = 200,
) -> FoundGrasps:
    """Find collision-free grasps of an object.

    Two opposing fingertips are matched with two opposing patches of the surface. Further fingertips
    are placed where they touch. Palm and hand are refined until all pads are within 1 mm and 15 deg
    (40 deg for ball pads), and the arm is solved. Collision-free grasps are checked again and
    ranked.

    Args:
        solver: A `Solver`.
        surface: A surface, or a source for `load_surface`: a name or path, vertices and triangles,
            or a trimesh object.
        pose: (4, 4) pose of the object in the base frame; None: the identity.
        fingers: Number of touching fingertips, including the thumb; a hand with fewer fingers
            uses all.
        mu: Friction coefficient between fingertips and object, from 0.01 to 10.
        hold: Mass [kg] that has to be held in each of six directions, and the squeeze [N]; the
            squeeze is limited by the efforts of the motors. None: the grasp has to be force-closed.
        limit: Maximum number of distinct grasps.
        jobs: Number of threads; the result does not depend on it.
        seed: Seed of all random numbers.
        prefer: Ranking: "load", "clearance", "limits", "q0", or a function of the robot and
            configurations (m, n) that returns scores (m,), higher is better.
        q0: (n,) current configuration of the robot [rad or m]; None is `robot.home`.
        among: Number of distinct grasps to find; the best `limit` of them are returned. A larger
            number gives better grasps and takes more time.

    Returns:
        The grasps, best first, with the number of candidates that passed each stage.

    Raises:
        InputError: An argument has the wrong type or value, or the surface cannot be grasped (see
            `load_surface`).
        UnsupportedError: The hand has one finger, robot or hand have no shapes, the robot has
            several arms, or the method cannot solve palms.

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
    query = _checked_query(fingers, mu, hold, limit, among, seed, prefer)
    goal = max(query.limit, query.among)
    if not isinstance(surface, Surface):
        surface = load_surface(surface)
    table = HandTable.for_robot(robot)
    arm_solver, scene_solver, hand_check = _solvers(solver, table, surface, object_pose, parameters)
    start = None if q0 is None else robot.configuration(q0)
    solvers = _Solvers(arm_solver, scene_solver, object_pose, jobs, start)
    rng = np.random.default_rng(query.seed)
    count = min(query.fingers, len(robot.fingers))
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
            batch = _solve_batch(generator, hands, batches, solvers, query)
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
            # The next batch is sized by the yield so far, with a reserve of 20 %.
            growth = 1.2 * (goal - n_found) / n_found if n_found else 1.0
            max_size = min(10 * n_drawn, parameters.max_batch)
            size = int(np.clip(growth * n_drawn, parameters.first_batch, max_size))
    ranked = _ranked(generator, batches, solvers, query, prefer)
    return replace(ranked, time=time.process_time() - begin)


_SOLVERS: WeakKeyDictionary[Any, dict[tuple[str, int, TouchParameters], tuple[Any, Any, Any]]] = (
    WeakKeyDictionary()
)
"""Cache of (solver of palms, solver in the scene, tables) by solver, then object and parameters."""


def _solvers(
    solver: Any, table: HandTable, surface: Surface, pose: Array, parameters: TouchParameters
) -> tuple[Any, Any, HandCheck]:
    """Return the solver of palms, the solver in the scene with the object, and the hand check.

    The solvers are cached by object. The key has the samples of the surface, because a file of the
    same name may change.
    """
    key = surface.name, hash(surface.points.tobytes()), parameters
    cache = _SOLVERS.setdefault(solver, {})
    if key not in cache:
        tolerance = Tolerance(parameters.max_height, parameters.min_rotation / 15)
        options: dict[str, Any] = {"tolerance": tolerance, "options": {"max_rounds": 1}}
        scene = (solver.scene or Scene()).holding(surface.name, pose)
        solver_type = type(solver)
        arm_solver = solver_type(solver.robot, **options)
        cache[key] = arm_solver, solver_type(solver.robot, scene=scene, **options), {}
    arm_solver, scene_solver, tables = cache[key]
    # The moved solver shares the tables that do not depend on the pose.
    scene_solver = scene_solver.moved(surface.name, pose)
    cache[key] = arm_solver, scene_solver, tables
    return arm_solver, scene_solver, HandCheck(table, scene_solver.scene_check, pose, tables)


MU_RANGE = (0.01, 10.0)
"""Range of friction coefficients; wider than the range from ice to soft rubber."""


@dataclass(frozen=True)
class _Query:
    """Validated arguments of `grasps_of`."""

    fingers: int
    mu: float
    hold: tuple[float, float] | None
    limit: int
    among: int
    seed: int


def _checked_query(
    fingers: Any, mu: Any, hold: Any, limit: Any, among: Any, seed: Any, prefer: Any
) -> _Query:
    """Return the validated arguments of `grasps_of`.

    Raises:
        InputError: An argument has the wrong type or value.
    """
    low, high = MU_RANGE
    if not callable(prefer) and not (isinstance(prefer, str) and prefer in RANKINGS):
        raise InputError(f"prefer: found {prefer!r}, expected {', '.join(RANKINGS)} or a function")
    return _Query(
        checked_integer(fingers, "fingers", 2),
        checked_number(mu, "mu", f"a friction coefficient from {low:g} to {high:g}", low, high),
        checked_hold(hold),
        checked_integer(limit, "limit", 1),
        checked_integer(among, "among", 1),
        checked_integer(seed, "seed", 0),
    )


def _scores(prefer: Callable[[ArmHand, Array], ArrayLike], robot: ArmHand, q: Array) -> Array:
    """Return the scores (m,) of configurations (m, n) by a user-defined function.

    Raises:
        InputError: The function fails, or does not return a number for each configuration.
    """
    try:
        scores = np.asarray(prefer(robot, q), dtype=float)
    except CasadiIKError:
        raise
    except Exception as error:  # a user-defined function may raise any exception
        raise InputError(f"prefer: the function failed: {type(error).__name__}: {error}") from error
    if scores.shape != (len(q),):
        raise InputError(f"prefer: found scores of shape {scores.shape}, expected ({len(q)},)")
    if np.isnan(scores).any():
        raise InputError("prefer: found a score that is NaN, expected numbers")
    return scores


def _solve_batch(
    generator: Generator,
    hands: HandCandidates,
    batches: Sequence[_Batch],
    solvers: _Solvers,
    query: _Query,
) -> _Batch | None:
    """Return the new, force-closed, reachable and collision-free grasps; None if there is none.

    Args:
        generator: Generator of the candidates; its counts are updated.
        hands: The candidates.
        batches: Grasps of earlier batches.
        solvers: Solvers of the search.
        query: Arguments of the search.
    """
    pose, robot = solvers.pose, solvers.arm.robot
    table, parameters = generator.table, generator.parameters
    mu, hold, n_candidates = query.mu, query.hold, len(hands)
    for batch in batches if n_candidates else ():
        hands = hands.rows(hands.new_rows(batch.hands, parameters))
    generator.duplicates = n_candidates - len(hands)
    generator.count("new", len(hands))
    if not len(hands):
        return None
    closure = closure_load(contact_wrenches(generator, hands, CLOSURE_FRICTION * mu))
    rows = np.argsort(-closure, kind="stable")[: np.count_nonzero(closure > MIN_CLOSURE_LOAD)]
    generator.count("force-closed", len(rows))
    distinct = rows[hands.rows(rows).distinct_rows(parameters)]
    generator.count("distinct", len(distinct))
    generator.duplicates += len(rows) - len(distinct)
    generator.arm_queries += len(distinct)
    if not len(distinct):
        return None
    hands = hands.rows(distinct)
    palms, postures = pose @ hands.palm, table.configuration(hands.hand)
    arm_solutions = solvers.arm.solve_palms(palms, postures, solvers.q0, jobs=solvers.jobs)
    q, is_free = arm_solutions.q, arm_solutions.success.copy()
    colliding = np.flatnonzero(is_free)
    colliding = colliding[~generator.hand_check.arm_is_free(q[colliding])]
    is_free[colliding] = False
    # Other arm configurations for these hands cost more than other hands, unless most arms collide.
    if len(colliding) > is_free.sum():
        retries = solvers.scene.solve_palms(
            palms[colliding], postures[colliding], solvers.q0, jobs=solvers.jobs
        )
        q[colliding], is_free[colliding] = retries.q, retries.success
    generator.count("arm reaches", int(arm_solutions.success.sum()))
    rows = np.flatnonzero(is_free)
    if not len(rows):
        return None
    hands, q = hands.rows(rows), q[rows]
    points, normals = (
        np.where(hands.touches[..., None], values, np.nan) for values in robot.contacts(q)
    )
    solutions = solvers.scene.solve_batch(points, normals, q0=q, jobs=solvers.jobs)
    rows = np.flatnonzero(solutions.success)
    generator.count("collision-free in the scene", len(rows))
    if not len(rows):
        return None
    hands = at_configurations(generator, hands.rows(rows), solutions.q[rows], pose)
    confirmed = confirmed_rows(generator, hands, mu)
    generator.count("contacts confirmed", len(confirmed))
    hands, rows = hands.rows(confirmed), rows[confirmed]
    if not len(rows):
        return None
    strength = hand_strengths(generator, hands, mu, hold)
    is_held = strength.holds(hold)
    if hold is not None:
        generator.count(f"hold {hold[0]:g} kg at {hold[1]:g} N", int(is_held.sum()))
    values = strength.load, strength.closure, strength.forces, strength.max_squeeze
    return _Batch(
        solutions, rows[is_held], hands.rows(is_held), *(value[is_held] for value in values)
    )


def _ranked(
    generator: Generator,
    batches: list[_Batch],
    solvers: _Solvers,
    query: _Query,
    prefer: Ranking,
) -> FoundGrasps:
    """Return the best grasps of all batches, in the order of the ranking."""
    robot, pose = solvers.arm.robot, solvers.pose
    entries = [(batch, i) for batch in batches for i in range(len(batch.rows))]
    name = prefer if isinstance(prefer, str) else "own"
    context = robot, generator.surface, query.mu
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
    best = np.argsort(-score, kind="stable")[: query.limit]
    best_entries = [entries[row] for row in best]
    touches = np.stack([batch.hands.touches[i] for batch, i in best_entries])
    unplaced = HandCandidates(np.zeros((len(best), 4, 4)), np.zeros((len(best), 0)), touches)
    hands = at_configurations(generator, unplaced, q[best], pose)
    forces = np.zeros((*touches.shape, 3))
    contact_forces = np.stack([batch.forces[i] for batch, i in best_entries])
    forces[touches] = (contact_forces @ pose[:3, :3].T).reshape(-1, 3)
    grasps = grasp_records(generator, hands, q[best], pose, forces)
    ranked = []
    for i, (row, (batch, k), grasp) in enumerate(zip(best, best_entries, grasps, strict=True)):
        by_finger = {name: forces[i, robot.fingers.index(name)] for name in grasp.contacts}
        solution = batch.solutions.solution(int(batch.rows[k]))
        values = float(load[row]), float(closure[row]), float(score[row])
        ranked.append(FoundGrasp(grasp, solution, *values, by_finger, float(most_squeeze[row])))
    return FoundGrasps(tuple(ranked), generator.counts, name, 0.0, "", *context)


CLOSURE_FRICTION = float(np.cos(np.pi / 8))
"""Factor of the friction coefficient in tests of force closure.

Friction cones reduced by this factor lie within every pyramid of eight or more edges that is
inscribed in the full cones, so that tests with any such pyramid agree.
"""


def at_configurations(
    generator: Generator, hands: HandCandidates, q: Array, pose: Array
) -> HandCandidates:
    """Return the hands at solved configurations, with their contacts.

    Args:
        generator: Generator of the candidates.
        hands: Hands before the arm was solved; only `touches` is used.
        q: (k, n) solved configurations.
        pose: (4, 4) pose of the object in the base frame.
    """
    table = generator.table
    palm = inverse(pose) @ table.robot.palm(q)
    solved = replace(hands, palm=palm, hand=np.take(q, table.motors, axis=1), contacts=None)
    return replace(
        solved,
        tips=fingertip_pads(table, solved).points,
        contacts=tip_contacts(table, generator.surface, solved),
    )


def confirmed_rows(generator: Generator, hands: HandCandidates, mu: float) -> NDArray[np.intp]:
    """Return the rows of hands whose contacts meet the limits and are force-closed."""
    assert hands.contacts is not None
    is_accepted = hands.contacts.accepted(generator.parameters, generator.table.roll)
    rows = np.flatnonzero((is_accepted | ~hands.touches).all(axis=1))
    load = closure_load(contact_wrenches(generator, hands.rows(rows), CLOSURE_FRICTION * mu))
    return rows[load > MIN_CLOSURE_LOAD]


def values_of_contacts(hands: HandCandidates, values: Array) -> Array:
    """Return the values (k, c, ...) at contacts, from values (k, f, ...) by finger."""
    return values[hands.touches].reshape(len(hands), -1, *values.shape[2:])


def contact_wrenches(generator: Generator, hands: HandCandidates, mu: float) -> Array:
    """Return the wrenches (k, 6, g) of the edges of the friction cones of hands."""
    assert hands.contacts is not None
    surface, contacts = generator.surface, hands.contacts
    foot, inward, normal_spread = (
        values_of_contacts(hands, values)
        for values in (contacts.foot, contacts.inward, contacts.normal_spread)
    )
    return friction_wrenches(
        foot, inward, narrowed_friction(mu, normal_spread), surface.middle, surface.size / 2
    )


def hand_strengths(
    generator: Generator, hands: HandCandidates, mu: float, hold: tuple[float, float] | None
) -> GraspStrengths:
    """Return the strength of the grasps of hands."""
    assert hands.contacts is not None
    table, surface, robot = generator.table, generator.surface, generator.table.robot
    _, _, linear, angular = table.pads(hands.hand)
    foot, inward, direction = (
        values_of_contacts(hands, values)
        for values in (hands.contacts.foot, hands.contacts.inward, hands.contacts.direction)
    )
    radii = table.radii[np.nonzero(hands.touches)[1]].reshape(len(hands), -1)
    rotation = hands.palm[:, None, :3, :3]
    angular, linear = (rotation @ values_of_contacts(hands, values) for values in (angular, linear))
    # The contact of a ball pad is a radius away from its centre.
    jacobians = linear + np.cross(angular, (radii[..., None] * direction)[..., None], axis=2)
    return grasp_strengths(
        contact_wrenches(generator, hands, mu),
        foot - surface.middle,
        inward,
        radii,
        jacobians,
        [robot.description.actuators[i] for i in table.motors],
        mu,
        hold,
    )


OPENINGS = (0.025, 0.015, 0.008)
"""Openings of the pregrasp: distances of the fingertips from the object [m].

The first collision-free one is used.
"""

SQUEEZE_DEPTH = 5e-3
"""Mean penetration of the fingertips at the posture `Grasp.squeeze` [m]."""

RETREAT = 0.06
"""Distance between the palms of grasp and pregrasp [m]."""


def grasp_records(
    generator: Generator, hands: HandCandidates, q: Array, pose: Array, forces: Array
) -> list[Grasp]:
    """Return the grasps of solved hands, with the open hand before and the squeezing hand after.

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
    directions = np.nan_to_num(hands.contacts.direction) @ pose[:3, :3].T
    contact_points = np.where(is_ball[:, None], centers + table.radii[:, None] * directions, points)
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
        for j in np.flatnonzero(hands.touches[i]):
            ball = directions[i, j] if is_ball[j] else None
            contacts[robot.fingers[j]] = Contact(contact_points[i, j], normals[i, j], ball=ball)
        retreated = palms[i].copy()
        center = np.mean([contact.point for contact in contacts.values()], axis=0)
        offset = retreated[:3, 3] - center
        retreated[:3, 3] += RETREAT * offset / max(float(np.linalg.norm(offset)), 1e-9)
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
