"""Diagnosis of unsolved targets by solving relaxed problems."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Counts, Rows
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.closest import ClosestConfigurations, FloatingPalmFit, HandFits, find_closest
from casadi_ik.solve.diagnosis import (
    ArmReach,
    Diagnosis,
    HandFit,
    LazyRemedies,
    NearContact,
    Reason,
)
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.proofs.proof import Proof, ProofKind
from casadi_ik.solve.proofs.prove import PROVER_EFFORT, Prover
from casadi_ik.solve.remedies import RemedyFinder
from casadi_ik.solve.subproblems import LocalRefinement, SubproblemSolver
from casadi_ik.solve.verdict import (
    ContactVerdict,
    Verdict,
    deviations,
    judge,
    judge_palms,
)


@dataclass(frozen=True)
class DiagnosisEffort:
    """Limits of the effort of a diagnosis. Source: ``studies/diagnosis.py``.

    Attributes:
        batch_size: Maximum number of targets that are diagnosed in the same runs of the loop.
        max_arm_starts: Maximum number of hand fits per target for which the arm is placed, in
            addition to the result of hand-first.
        search_stages: Stages of the search for the closest configuration: (upper bound of the
            tolerance factor, number of starts, maximum number of refined minima).
        side_search: Number of starts and maximum number of refined minima for each side of a
            multi-arm robot.
        resembling_period: Starts whose index is a multiple of this have a hand seed that resembles
            the grasp; the others have the closest hands.
        hand_misfit_factor: Tolerance factor of hand and robot above which the search ends because
            the hand does not fit.
        relaxed_factor: Tolerance factor up to which every limit is relaxed in the search for
            remedies, not only those of motors at a limit.
        full_proof_factor: Tolerance factor from which a proof may use the maximum number of boxes.
            Proofs of smaller factors rarely succeed, because only small boxes are excluded.
        min_boxes: Maximum number of boxes of a proof at a tolerance factor of 1.
        limit_distance: Distance up to which a motor counts as being at its limit [rad or m].
        min_reach_excess: Excess over the range of the arm above which reach is the cause [m].
    """

    batch_size: int = 64
    max_arm_starts: int = 2
    search_stages: tuple[tuple[float, int, int], ...] = ((8.0, 24, 4), (4.0, 96, 8), (1.5, 256, 32))
    side_search: tuple[int, int] = (24, 4)
    resembling_period: int = 3
    hand_misfit_factor: float = 1.1
    relaxed_factor: float = 2.0
    full_proof_factor: float = 2.5
    min_boxes: int = 5000
    limit_distance: float = 1e-6
    min_reach_excess: float = 1e-3


DIAGNOSIS_EFFORT = DiagnosisEffort()


class Diagnostician:
    """Diagnosis of targets that a method did not solve, for one robot.

    Attributes:
        robot: The robot.
        method: Hand-first, built for this robot.
    """

    def __init__(self, robot: ArmHand, method: HandSearch, compiled: bool = True) -> None:
        """Store robot and method; graphs are built at the first diagnosis."""
        self.robot = robot
        self.method = method
        self._subproblems = SubproblemSolver(robot, method)
        self._floating_palm = FloatingPalmFit(self._subproblems)
        self._prover = Prover(robot.description, compiled)
        self._side_provers = [
            Prover(robot.description.side(side.name, with_trunk=True), compiled)
            for side in robot.description.sides
        ]

    def diagnose(self, targets: TargetBatch, nearest: Array | None) -> list[Diagnosis]:
        """Diagnose k targets independently of each other.

        Args:
            targets: The targets.
            nearest: (k, n) configurations that hand-first returned [rad or m]; None: run it.
        """
        self.method.prepare()
        if targets.fixed is not None and targets.fixed.ndim > 1:
            # Targets with different fixed positions are diagnosed one by one.
            diagnoses = [
                self.diagnose(_single_fixed(targets, row), nearest_of_row)[0]
                for row in range(len(targets))
                for nearest_of_row in [None if nearest is None else nearest[row : row + 1]]
            ]
            return _add_palm_errors(self.robot, targets, diagnoses)
        is_solved = np.zeros(len(targets), dtype=bool)
        clock = _Clock(np.zeros(len(targets)))
        if nearest is None:
            nearest = self.method.run(targets).q
            is_solved = judge(self.robot, targets, nearest).solved(targets.enforce_limits)
            clock.lap(np.arange(len(targets)))
        by_row: dict[int, Diagnosis] = {}
        for row in np.flatnonzero(is_solved).tolist():
            target = targets.rows(slice(row, row + 1))
            (contacts,) = self._nearest_contacts(target, nearest[row : row + 1])
            by_row[row] = _reachable(target, nearest[row], contacts, clock.seconds[row])
        unsolved = np.flatnonzero(~is_solved)
        for start in range(0, len(unsolved), DIAGNOSIS_EFFORT.batch_size):
            rows = unsolved[start : start + DIAGNOSIS_EFFORT.batch_size]
            clock_of_rows = _Clock(clock.seconds[rows])
            diagnoses = self._diagnose_unsolved(targets.rows(rows), nearest[rows], clock_of_rows)
            by_row |= zip(rows.tolist(), diagnoses, strict=True)
        return [by_row[row] for row in range(len(targets))]

    def _diagnose_unsolved(
        self, targets: TargetBatch, nearest: Array, clock: _Clock
    ) -> Iterator[Diagnosis]:
        """Yield the diagnoses of targets that hand-first did not solve."""
        all_rows = np.arange(len(targets))
        refinement = LocalRefinement(self._subproblems, targets)
        evidence, hand_fits = self._fit_hands(targets)
        owner, configurations = self._place_arms(hand_fits)
        owner, configurations = (
            np.concatenate([all_rows, owner]),
            np.concatenate([nearest, configurations]),
        )
        search_counts = np.bincount(owner, minlength=len(all_rows))
        if hand_fits is not None:
            search_counts += np.bincount(hand_fits.owner, minlength=len(all_rows))
        best = find_closest(refinement, owner, configurations, DIAGNOSIS_EFFORT.max_arm_starts + 1)
        clock.lap(all_rows)
        proofs: list[Proof | None] = [None] * len(all_rows)
        rows = np.flatnonzero(~self._solved(targets, best.minimax_q))
        if len(rows):
            new_proofs = self.prove(targets.rows(rows), _max_boxes(best.factor[rows]))
            for row, proof in zip(rows.tolist(), new_proofs, strict=True):
                proofs[row] = proof
            clock.lap(rows)
        causes = [_cause_of(*item, proof) for item, proof in zip(evidence, proofs, strict=True)]
        # Where neither hand nor reach excludes a solution, a longer search decides.
        is_open = np.array([reason is None for reason in causes])
        is_certain = self._is_certain(targets, hand_fits, best)
        is_certain |= np.array([proof is not None for proof in proofs])
        for max_factor, count, max_refined in DIAGNOSIS_EFFORT.search_stages:
            rows = np.flatnonzero(is_open | ((best.factor < max_factor) & ~is_certain))
            rows = rows[~self._solved(targets.rows(rows), best.minimax_q[rows])]
            if len(rows):
                subset, closest = targets.rows(rows), best.rows(rows)
                best.update(rows, self._search(subset, closest, count, max_refined))
                search_counts[rows] += count + 2
                clock.lap(rows)
            is_open[:] = False
        verdict = judge(self.robot, targets, best.minimax_q)
        solved, tolerances = (
            verdict.solved(targets.enforce_limits),
            _met_tolerances(targets, verdict),
        )
        contacts = self._nearest_contacts(
            targets, np.where(solved[:, None], best.minimax_q, best.q)
        )
        at_limit = self._at_limit(best.q)
        may_block = (
            at_limit
            | self._at_limit(best.minimax_q)
            | (best.factor <= DIAGNOSIS_EFFORT.relaxed_factor)[:, None]
        )
        sides = self._diagnose_sides(targets, best)
        clock.lap(all_rows)
        for i in all_rows.tolist():
            if solved[i]:
                yield _reachable(targets, best.minimax_q[i], contacts[i], clock.seconds[i])
                continue
            hand, reach = evidence[i]
            target, hand_only = targets.rows(slice(i, i + 1)), causes[i] is Reason.HAND
            remedies = RemedyFinder(self._subproblems, target, best.q[i], may_block[i], hand_only)
            reason = causes[i]
            if reason is None:
                reason = Reason.LIMITS if remedies.limits_help() else Reason.NOT_FOUND
            names = zip(self.robot.actuators, at_limit[i].tolist(), strict=True)
            clock.lap(all_rows[i : i + 1])
            yield Diagnosis(
                reason=reason,
                proof=proofs[i],
                searches=int(search_counts[i]),
                hand=hand,
                reach=reach,
                active=tuple(
                    name for name, is_at_limit in names if is_at_limit and targets.enforce_limits
                ),
                enough=tolerances[i],
                nearest=contacts[i],
                q=best.q[i],
                time=float(clock.seconds[i]),
                lazy=LazyRemedies(remedies.find),
                sides=sides[i],
            )

    def _diagnose_sides(
        self, targets: TargetBatch, best: ClosestConfigurations
    ) -> list[dict[str, ContactVerdict]]:
        """Return the worst contact of each side by target, with the other sides free."""
        by_target: list[dict[str, ContactVerdict]] = [{} for _ in range(len(targets))]
        robot = self.robot
        for name, fingers in robot.hands.items():
            has_contacts = ~np.isnan(targets.points[:, fingers, 0]).all(axis=1)
            rows = np.flatnonzero(has_contacts)
            if name is None or not len(rows):
                continue
            other_fingers = [i for i in range(len(robot.fingers)) if i not in fingers]
            side_targets = _with_free_fingers(targets.rows(rows), other_fingers)
            search = self._search(side_targets, best.rows(rows), *DIAGNOSIS_EFFORT.side_search)
            verdict = judge(robot, side_targets, search.minimax_q)
            for i, row in enumerate(rows.tolist()):
                contacts = verdict.contacts(i, robot.fingers, side_targets.tolerances)
                by_target[row][name] = max(
                    (contacts[robot.fingers[finger]] for finger in fingers),
                    key=lambda verdict: (not verdict.ok, verdict.position_error),
                )
        return by_target

    def prove(self, targets: TargetBatch, max_boxes: Counts) -> list[Proof | None]:
        """Return proofs of k targets; for a multi-arm robot, that one side is unsolvable.

        Args:
            targets: Targets to prove impossible.
            max_boxes: (k,) maximum number of boxes of hand postures.
        """
        if not self._side_provers:
            return self._prover.prove(_with_contact_bounds(targets), max_boxes=max_boxes)
        robot = self.robot.description
        proofs: list[Proof | None] = [None] * len(targets)
        for prover, side in zip(self._side_provers, robot.sides, strict=True):
            fingers = [robot.finger_names.index(name) for name in side.fingers]
            has_contacts = ~np.isnan(targets.points[:, fingers, 0]).all(axis=1)
            rows = np.flatnonzero(has_contacts & np.array([proof is None for proof in proofs]))
            if not len(rows) or targets.fixed is not None:
                continue
            side_targets = targets.rows(rows).for_part(fingers)
            for row, proof in zip(
                rows.tolist(), prover.prove(side_targets, max_boxes=max_boxes[rows]), strict=True
            ):
                proofs[row] = proof
        return proofs

    def _fit_hands(
        self, targets: TargetBatch
    ) -> tuple[Sequence[tuple[HandFit | None, ArmReach | None]], HandFits | None]:
        """Return hand fit and arm reach of each target, and all fits; None without an arm."""
        if not self.robot.description.arm_actuators:
            return [(None, None)] * len(targets), None
        hand_fits = self._floating_palm.fit(targets)
        return self._floating_palm.evidence(targets, hand_fits), hand_fits

    def _is_certain(
        self, targets: TargetBatch, hand_fits: HandFits | None, best: ClosestConfigurations
    ) -> NDArray[np.bool_]:
        """Return (k,) True where the hand alone clearly misses the contacts."""
        if hand_fits is None:
            return np.zeros(len(targets), dtype=bool)
        return (
            np.minimum(hand_fits.tolerance_factor(targets), best.factor)
            >= DIAGNOSIS_EFFORT.hand_misfit_factor
        )

    def _place_arms(self, hand_fits: HandFits | None) -> tuple[Rows, Array]:
        """Return target indices (m,) and configurations (m, n) of arms placed at the best fits."""
        if hand_fits is None:
            return np.zeros(0, np.intp), np.zeros((0, len(self.robot.actuators)))
        rows = hand_fits.best_rows(DIAGNOSIS_EFFORT.max_arm_starts)
        return hand_fits.owner[rows], self._subproblems.run(
            hand_fits.states[rows], hand_fits.parameters[rows]
        )

    def _search(
        self, targets: TargetBatch, best: ClosestConfigurations, count: int, max_refined: int
    ) -> ClosestConfigurations:
        """Return the configurations closest to each target, from random starts.

        The arms are random; the hands are the closest ones so far and seeds that resemble the
        grasp. A hand without an arm starts at random.
        """
        owner = np.repeat(np.arange(len(targets)), count + 2)
        random = self.robot.random(np.random.default_rng(count), count)
        starts = np.tile(random, (len(targets), 1, 1))
        if self.robot.description.arm_actuators:
            hand = list(self.robot.description.hand_actuators)
            starts[:, ::2, hand] = best.minimax_q[:, None, hand]
            starts[:, 1::2, hand] = best.q[:, None, hand]
            starts[:, :: DIAGNOSIS_EFFORT.resembling_period, hand] = self._resembling_seeds(
                targets, -(-count // DIAGNOSIS_EFFORT.resembling_period)
            )
        starts = np.concatenate([best.q[:, None], best.minimax_q[:, None], starts], axis=1)
        descent = LocalRefinement(self._subproblems, targets)
        configurations = descent.run(owner, starts.reshape(len(owner), -1))
        return find_closest(descent, owner, configurations, max_refined)

    def _resembling_seeds(self, targets: TargetBatch, count: int) -> Array:
        """Return (k, count, hand) hand seeds that resemble the grasps, repeated if necessary."""
        options = self.method.options
        rounds = range(min(options.rounds, -(-count // options.candidates)))
        seeds = [self.method.postures(targets, number) for number in rounds]
        postures = np.concatenate(seeds, axis=1)
        return postures[:, np.arange(count) % postures.shape[1]]

    def _solved(self, targets: TargetBatch, q: Array) -> NDArray[np.bool_]:
        if not len(q):
            return np.zeros(0, dtype=bool)
        return judge(self.robot, targets, q).solved(targets.enforce_limits)

    def _nearest_contacts(self, targets: TargetBatch, q: Array) -> list[dict[str, NearContact]]:
        """Return the contacts of configurations (k, n) with their errors."""
        points, normals = self.robot.contacts(q)
        position_error, angle_error, _ = deviations(self.robot, targets, q)
        columns = points, normals, position_error, angle_error
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [
            {
                name: NearContact(tuple(point), tuple(normal), position, angle)
                for name, point, normal, position, angle in zip(
                    self.robot.fingers, *row, strict=True
                )
            }
            for row in rows
        ]

    def _at_limit(self, q: Array) -> NDArray[np.bool_]:
        return (q - self.robot.lower <= DIAGNOSIS_EFFORT.limit_distance) | (
            self.robot.upper - q <= DIAGNOSIS_EFFORT.limit_distance
        )


class _Clock:
    """Stopwatch that divides time among targets, (k,) seconds."""

    def __init__(self, seconds: Array) -> None:
        self.seconds = seconds
        self._last_lap = time.perf_counter()

    def lap(self, owner: Rows) -> None:
        """Divide the time since the last lap among targets."""
        start, self._last_lap = self._last_lap, time.perf_counter()
        self.seconds[owner] += (self._last_lap - start) / len(owner)


def _cause_of(hand: HandFit | None, reach: ArmReach | None, proof: Proof | None) -> Reason | None:
    # A proof by reach excludes every posture of hand and arm; the arm need not be the cause.
    if (proof is not None and proof.kind is not ProofKind.REACH) or (hand and not hand.ok):
        return Reason.HAND
    if proof is not None:
        return Reason.REACH
    if reach is not None and abs(reach.excess) > DIAGNOSIS_EFFORT.min_reach_excess:
        return Reason.REACH
    return None


def _max_boxes(ratio: Array) -> Counts:
    """Return (k,) maximum numbers of boxes of proofs for tolerance factors (k,)."""
    share = np.clip((ratio - 1) / (DIAGNOSIS_EFFORT.full_proof_factor - 1), 0.0, 1.0)
    return np.maximum(PROVER_EFFORT.max_boxes * share, DIAGNOSIS_EFFORT.min_boxes).astype(np.int64)


def _met_tolerances(targets: TargetBatch, verdict: Verdict) -> list[Tolerance]:
    """Return the tolerances that each configuration meets; at least those of its target."""
    minimum = targets.largest_tolerance
    position = np.nanmax(verdict.position_error, axis=1, initial=minimum.position)
    angle = np.nanmax(verdict.angle_error, axis=1, initial=minimum.angle)
    return [Tolerance(*pair) for pair in zip(position.tolist(), angle.tolist(), strict=True)]


def _single_fixed(targets: TargetBatch, row: int) -> TargetBatch:
    """Return one of several targets that have different fixed positions."""
    target = targets.rows(slice(row, row + 1))
    assert target.fixed is not None
    return replace(target, fixed=target.fixed[0])


def _with_contact_bounds(targets: TargetBatch) -> TargetBatch:
    """Return palm targets with contact tolerances that every palm within its tolerance meets.

    A proof for them holds for the palm poses: a palm that is rotated about its origin moves a
    contact by the chord of the angle times their distance.
    """
    if targets.palms is None:
        return targets
    allowed = targets.largest_tolerance
    levers = np.linalg.norm(targets.points - targets.palms[:, None, :3, 3], axis=2)
    chord = 2 * np.sin(min(allowed.angle, np.pi) / 2)
    tolerance = tuple(
        Tolerance(allowed.position + chord * lever, allowed.angle)
        for lever in np.nanmax(levers, axis=0, initial=0.0).tolist()
    )
    return replace(targets, tolerance=tolerance)


def _add_palm_errors(
    robot: ArmHand, targets: TargetBatch, diagnoses: list[Diagnosis]
) -> list[Diagnosis]:
    """Return the diagnoses with the errors of the palms, if the targets have palm poses."""
    palms = judge_palms(robot, targets, np.stack([diagnosis.q for diagnosis in diagnoses]))
    if palms is None:
        return diagnoses
    return [replace(diagnosis, palm=palms.row(row)) for row, diagnosis in enumerate(diagnoses)]


def _with_free_fingers(targets: TargetBatch, fingers: list[int]) -> TargetBatch:
    """Return targets with some fingers free."""

    def free(array: Array) -> Array:
        array = array.copy()
        array[:, fingers] = np.nan
        return array

    extra_vectors = {name: free(array) for name, array in targets.extra_vectors.items()}
    return replace(
        targets,
        points=free(targets.points),
        normals=free(targets.normals),
        extra_vectors=extra_vectors,
    )


def _reachable(
    targets: TargetBatch, q: Array, nearest: dict[str, NearContact], seconds: float
) -> Diagnosis:
    return Diagnosis(
        reason=Reason.REACHABLE,
        enough=targets.largest_tolerance,
        nearest=nearest,
        q=q,
        time=float(seconds),
    )
