"""Search for collision-free solutions of targets whose first solution is in collision."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from casadi_ik.collision.clearance import Clearances, CollisionQuery
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.targets import CLEARANCE, MANIPULABILITY, TargetBatch
from casadi_ik.solve.alternatives import AlternativeFinder
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.collision_free_search import CollisionFreeResult, CollisionFreeSearch
from casadi_ik.solve.collision_free_steps import COLLISION_FREE_PARAMETERS
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.status import Status
from casadi_ik.solve.verdict import Verdict, judge

DEFAULT_PREFERENCE = "limits"
"""Preference of targets that specify none."""

RANKING_PREFERENCES = (MANIPULABILITY, CLEARANCE)
"""Preferences that rank even collision-free solutions against all other candidates."""


def find_collision_free(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    rank_all: bool = False,
    diagnose: bool = True,
) -> CollisionFreeResult:
    """Search for collision-free solutions of k targets.

    Args:
        finder: Source of arms and hands of the robot.
        targets: k targets.
        query: Pairs that must not collide.
        q: (k, n) solutions, which may collide.
        rank_all: Rank solutions without a collision against all other candidates by the
            preference, instead of returning them.
        diagnose: Check for targets without a result whether they are solvable without the scene,
            or without self-collision.
    """
    home = finder.robot.home
    starts_at_home = (targets.starts(finder.robot.description) == home).all()
    is_biased = targets.prefer != DEFAULT_PREFERENCE or not starts_at_home
    result = _search_in_chunks(finder, targets, query, q, rank_all, diagnose, escape=not is_biased)
    blocked = np.flatnonzero(~result.free)
    if not is_biased or not len(blocked):
        return result
    # A preference ranks solutions and must not decide whether one exists. Escape steps lead to
    # arbitrary solutions, so a second search takes them, without a preference and from home.
    retry = replace(targets.rows(blocked), prefer=DEFAULT_PREFERENCE, q0=home)
    subproblems = finder.subproblems
    retry_q = subproblems.method.run(retry).q
    solved = subproblems.solved(retry, retry_q, retry.enforce_limits)
    blocked, retry, retry_q = blocked[solved], retry.rows(np.flatnonzero(solved)), retry_q[solved]
    second = _search_in_chunks(
        finder, retry, query.rows(blocked), retry_q, rank_all=False, diagnose=False, escape=True
    )
    freed_rows = blocked[second.free]
    result.q[freed_rows], result.free[freed_rows], result.reports[freed_rows] = (
        second.q[second.free],
        True,
        None,
    )
    return result


def _search_in_chunks(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    rank_all: bool,
    diagnose: bool,
    escape: bool,
) -> CollisionFreeResult:
    """Search in chunks of targets, see `find_collision_free`; take escape steps if `escape`."""
    if not len(q):
        return CollisionFreeResult(q, np.zeros(0, dtype=bool), np.zeros(0, dtype=object))
    results = []
    for first_row in range(0, len(q), COLLISION_FREE_PARAMETERS.chunk_size):
        rows = np.arange(first_row, min(first_row + COLLISION_FREE_PARAMETERS.chunk_size, len(q)))
        search = CollisionFreeSearch(finder, targets.rows(rows), query.rows(rows))
        if rank_all:
            search.record_candidates(q[rows], np.arange(len(rows)))
        search.run(q[rows], rank_all, escape)
        result = search.result(diagnose)
        results.append((result.q, result.free, result.reports))
    return CollisionFreeResult(*(np.concatenate(arrays) for arrays in zip(*results, strict=True)))


def resolve_collisions(
    finder_of: Callable[[TargetBatch], AlternativeFinder],
    targets: TargetBatch,
    query: CollisionQuery,
    outcome: Outcome,
    batch: BatchSolution,
    diagnose: bool = True,
) -> BatchSolution:
    """Replace solutions in collision by collision-free ones where possible.

    Args:
        finder_of: Function that returns the finder for a combination of contact kinds.
        targets: k targets.
        query: Pairs that must not collide.
        outcome: Outcome of the method.
        batch: Verdicts on the outcome.
        diagnose: Determine the reasons of collisions, see `find_collision_free`.

    Returns:
        The verdicts after the search.
    """
    rank_all = targets.prefer in RANKING_PREFERENCES
    collides = batch.status == Status.COLLISION
    rows = np.flatnonzero(collides | batch.success if rank_all else collides)
    if not len(rows):
        return batch
    start_time, q = time.perf_counter(), batch.q.copy()
    reports = np.array(batch.collisions, dtype=object)
    numbers = np.array([targets.row_number(row) for row in rows.tolist()], dtype=np.intp)
    # The row number seeds the random numbers, so that a result does not depend on the batch.
    selected = replace(targets.rows(rows), row_numbers=numbers)
    robot = finder_of(selected.rows(slice(0, 1))).robot
    for _, kind_rows, kind_targets in group_by_kinds(selected):
        target_rows = rows[kind_rows]
        result = find_collision_free(
            finder_of(kind_targets),
            kind_targets,
            query.rows(target_rows),
            q[target_rows],
            rank_all,
            diagnose,
        )
        q[target_rows] = result.q
        reports[target_rows] = result.reports
    seconds = batch.time.copy()
    seconds[rows] += (time.perf_counter() - start_time) / len(rows)
    status = np.where(collides, int(Status.SOLVED), outcome.status)
    updated = replace(outcome, q=q, time=seconds, status=status)
    return replace(
        judge_outcome(robot, batch.method, targets, updated, query),
        collisions=tuple(reports.tolist()),
    )


def resolve_single(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    try_other_hands: bool = False,
) -> tuple[Array, Verdict, Clearances] | None:
    """Return a collision-free configuration with the hand of a single solution.

    The result equals that of `resolve_collisions`, which tries this hand first.

    Args:
        finder: Finder for the target's contact kinds.
        targets: One target.
        query: Pairs that must not collide.
        q: (n,) solution in collision.
        try_other_hands: Try the hands of restarts too, like an exported solver.

    Returns:
        The configuration, its verdict and its clearance; None if a full search is needed.
    """
    search = CollisionFreeSearch(finder, targets, query)
    search.try_hands(q[None], np.zeros(1, dtype=np.intp))
    if try_other_hands:
        for hands, target_index in search.restart_hands():
            search.try_hands(hands, target_index)
    if not search.free[0]:
        return None
    q = search.best[:1]
    verdict, clearances = judge(finder.robot, targets, q), query.check(q)
    is_solved = verdict.solved(targets.enforce_limits)[0] and clearances.free[0]
    return (q[0], verdict, clearances) if is_solved else None
