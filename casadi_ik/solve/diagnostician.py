"""Finds out why grasps cannot be solved: by solving them again with less asked."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Counts
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
from casadi_ik.solve.trials import LocalRefinement, Rows, Subproblems
from casadi_ik.solve.verdict import (
    ContactVerdict,
    Verdict,
    contact_verdicts,
    deviations,
    judge,
    judge_palms,
)


@dataclass(frozen=True)
class DiagnosisEffort:
    """How long a diagnosis goes on; chosen with ``studies/diagnosis.py``.

    Attributes:
        together: Targets that are diagnosed in the same runs of the compiled loop.
        placed: Fitted hands that the arm follows, in addition to the one of hand-first.
        searches: If the contacts are missed by less than a factor, so many further starts are
            tried, whatever hand and reach say, and so many of the minima they lead to are followed.
        alike: Every third of these starts has a hand that looks like the grasp, the others the
            nearest.
        certain: If hand and arm-hand both miss the contacts by this factor where they come
            closest, no arm is looked for that would help a hand that does not fit.
        barely: If they are missed by less than this, limits are lifted that nothing presses
            against, too.
        alone: Random arms for every side of a body by itself, and how many of them are followed.
        clearly: A proof may take all its boxes where the tolerances would have to be so many times
            as large. What is missed by little is hardly ever proved: no box is excluded before it
            is small.
        least: Boxes it may take in any case.
        at_limit: How near to a limit counts as at it [rad or m].
        missed_reach: How far an arm's reach has to be missed to be the reason [m].
    """

    together: int = 64
    placed: int = 2
    searches: tuple[tuple[float, int, int], ...] = ((8.0, 24, 4), (4.0, 96, 8), (1.5, 256, 32))
    alone: tuple[int, int] = (24, 4)
    alike: int = 3
    certain: float = 1.1
    barely: float = 2.0
    clearly: float = 2.5
    least: int = 5000
    at_limit: float = 1e-6
    missed_reach: float = 1e-3


DIAGNOSIS_EFFORT = DiagnosisEffort()


class Diagnostician:
    """Diagnoses grasps on one robot, whichever method failed.

    Attributes:
        robot: The robot.
        method: Hand-first on that robot.
    """

    def __init__(self, robot: ArmHand, method: HandSearch, compiled: bool = True) -> None:
        """Keep robot and method; nothing is built before the first diagnosis."""
        self.robot = robot
        self.method = method
        self._trials = Subproblems(robot, method)
        self._palm_free = FloatingPalmFit(self._trials)
        self._prover = Prover(robot.description, compiled)
        self._sides = [
            Prover(robot.description.side(side.name, carried=True), compiled)
            for side in robot.description.sides
        ]

    def diagnose(self, targets: TargetBatch, q0: Array, nearest: Array | None) -> list[Diagnosis]:
        """Diagnose k targets; each as if it were alone.

        Args:
            targets: The targets.
            q0: (k, n) starts.
            nearest: (k, n) what hand-first came to; None if another method was asked.
        """
        self.method.prepare()
        if targets.fixed is not None and targets.fixed.ndim > 1:
            # Hands that are held differently have nothing in common.
            found_alone = [
                self.diagnose(_held_alone(targets, row), q0[row : row + 1], near)[0]
                for row in range(len(targets))
                for near in [None if nearest is None else nearest[row : row + 1]]
            ]
            return _of_palms(self.robot, targets, found_alone)
        known = np.zeros(len(targets), dtype=bool)
        clock = _Clock(np.zeros(len(targets)))
        if nearest is None:
            nearest = self.method.run(targets, q0, 0, trace=False).q
            known = judge(self.robot, targets, nearest).solved(targets.enforce_limits)
            clock.lap(np.arange(len(targets)))
        found: dict[int, Diagnosis] = {}
        for row in np.flatnonzero(known).tolist():
            one = targets.rows(slice(row, row + 1))
            (near,) = self._nearest(one, nearest[row : row + 1])
            found[row] = _reachable(one, nearest[row], near, clock.seconds[row])
        rest = np.flatnonzero(~known)
        for start in range(0, len(rest), DIAGNOSIS_EFFORT.together):
            rows = rest[start : start + DIAGNOSIS_EFFORT.together]
            some, spent = targets.rows(rows), clock.seconds[rows]
            whys = self._together(some, q0[rows], nearest[rows], _Clock(spent))
            found |= zip(rows.tolist(), whys, strict=True)
        return [found[row] for row in range(len(targets))]

    def _together(
        self, targets: TargetBatch, q0: Array, nearest: Array, clock: _Clock
    ) -> Iterator[Diagnosis]:
        """Diagnose targets that hand-first did not solve."""
        every = np.arange(len(targets))
        descent = LocalRefinement(self._trials, targets)
        evidence, fits = self._hands(targets, q0)
        owner, ends = self._placed(fits)
        owner, ends = np.concatenate([every, owner]), np.concatenate([nearest, ends])
        searches = np.bincount(owner, minlength=len(every))
        if fits is not None:
            searches += np.bincount(fits.owner, minlength=len(every))
        best = find_closest(descent, owner, ends, DIAGNOSIS_EFFORT.placed + 1)
        clock.lap(every)
        proofs: list[Proof | None] = [None] * len(every)
        rows = np.flatnonzero(~self._solved(targets, best.fair))
        if len(rows):
            found = self._proofs(targets.rows(rows), _worth(best.ratio[rows]))
            for row, proof in zip(rows.tolist(), found, strict=True):
                proofs[row] = proof
            clock.lap(rows)
        refused = [_refused(*item, proof) for item, proof in zip(evidence, proofs, strict=True)]
        # Where neither the hand nor the reach says no, only searching can.
        unsure = np.array([reason is None for reason in refused])
        certain = self._certain(targets, fits, best)
        certain |= np.array([proof is not None for proof in proofs])
        for below, count, followed in DIAGNOSIS_EFFORT.searches:
            rows = np.flatnonzero(unsure | ((best.ratio < below) & ~certain))
            rows = rows[~self._solved(targets.rows(rows), best.fair[rows])]
            if len(rows):
                some, found = targets.rows(rows), best.rows(rows)
                best.put(rows, self._search(some, found, count, followed))
                searches[rows] += count + 2
                clock.lap(rows)
            unsure[:] = False
        fair = judge(self.robot, targets, best.fair)
        solved, enough = fair.solved(targets.enforce_limits), _enough(targets, fair)
        near = self._nearest(targets, np.where(solved[:, None], best.fair, best.q))
        held = self._at_limit(best.q)
        pressed = (
            held | self._at_limit(best.fair) | (best.ratio <= DIAGNOSIS_EFFORT.barely)[:, None]
        )
        sides = self._one_at_a_time(targets, best)
        clock.lap(every)
        for i in every.tolist():
            if solved[i]:
                yield _reachable(targets, best.fair[i], near[i], clock.seconds[i])
                continue
            hand, reach = evidence[i]
            one, hand_only = targets.rows(slice(i, i + 1)), refused[i] is Reason.HAND
            remedies = RemedyFinder(self._trials, one, q0[i], best.q[i], pressed[i], hand_only)
            reason = refused[i]
            if reason is None:
                reason = Reason.LIMITS if remedies.limits_help() else Reason.NOT_FOUND
            names = zip(self.robot.actuators, held[i].tolist(), strict=True)
            clock.lap(every[i : i + 1])
            yield Diagnosis(
                reason=reason,
                proof=proofs[i],
                searches=int(searches[i]),
                hand=hand,
                reach=reach,
                active=tuple(name for name, at in names if at and targets.enforce_limits),
                enough=enough[i],
                nearest=near[i],
                q=best.q[i],
                time=float(clock.seconds[i]),
                lazy=LazyRemedies(remedies.find),
                sides=sides[i],
            )

    def _one_at_a_time(
        self, targets: TargetBatch, best: ClosestConfigurations
    ) -> list[dict[str, ContactVerdict]]:
        """By target the worst contact of every side of a body that it asks for, the others free."""
        found: list[dict[str, ContactVerdict]] = [{} for _ in range(len(targets))]
        robot = self.robot
        for name, fingers in robot.hands.items():
            asked = ~np.isnan(targets.points[:, fingers, 0]).all(axis=1)
            rows = np.flatnonzero(asked)
            if name is None or not len(rows):
                continue
            others = [i for i in range(len(robot.fingers)) if i not in fingers]
            alone = _free_of(targets.rows(rows), others)
            search = self._search(alone, best.rows(rows), *DIAGNOSIS_EFFORT.alone)
            position, angle, met = (
                getattr(judge(robot, alone, search.fair), one)
                for one in ("position_error", "angle_error", "ok")
            )
            verdicts = contact_verdicts(robot.fingers, alone.tolerances, position, angle, met)
            for row, of_fingers in zip(rows.tolist(), verdicts, strict=True):
                own = [of_fingers[robot.fingers[i]] for i in fingers]
                found[row][name] = max(own, key=lambda one: (not one.ok, one.position_error))
        return found

    def _proofs(self, targets: TargetBatch, most: Counts) -> list[Proof | None]:
        """Proofs of targets; of a body that one side cannot, wherever the trunk takes it."""
        if not self._sides:
            return self._prover.prove(_with_contact_bounds(targets), max_boxes=most)
        robot = self.robot.description
        proofs: list[Proof | None] = [None] * len(targets)
        for prover, side in zip(self._sides, robot.sides, strict=True):
            fingers = [robot.finger_names.index(name) for name in side.fingers]
            asked = ~np.isnan(targets.points[:, fingers, 0]).all(axis=1)
            rows = np.flatnonzero(asked & np.array([proof is None for proof in proofs]))
            if not len(rows) or targets.fixed is not None:
                continue
            part = targets.rows(rows).of_fingers(fingers)
            for row, proof in zip(
                rows.tolist(), prover.prove(part, max_boxes=most[rows]), strict=True
            ):
                proofs[row] = proof
        return proofs

    def _hands(
        self, targets: TargetBatch, q0: Array
    ) -> tuple[Sequence[tuple[HandFit | None, ArmReach | None]], HandFits | None]:
        """What the hand alone says of each target; nothing if there is no arm."""
        if not self.robot.description.arm_actuators:
            return [(None, None)] * len(targets), None
        fits = self._palm_free.fits(targets, q0)
        return self._palm_free.evidence(targets, fits), fits

    def _certain(
        self, targets: TargetBatch, fits: HandFits | None, best: ClosestConfigurations
    ) -> NDArray[np.bool_]:
        """(k,) whether the hand alone already says no, however the arm holds it."""
        if fits is None:
            return np.zeros(len(targets), dtype=bool)
        return np.minimum(fits.ratio(targets), best.ratio) >= DIAGNOSIS_EFFORT.certain

    def _placed(self, fits: HandFits | None) -> tuple[Rows, Array]:
        """Configurations (m, n) that the best fits of each target lead to, and their targets."""
        if fits is None:
            return np.zeros(0, np.intp), np.zeros((0, len(self.robot.actuators)))
        rows = fits.best(DIAGNOSIS_EFFORT.placed)
        return fits.owner[rows], self._trials.run(fits.states[rows], fits.parameters[rows])

    def _search(
        self, targets: TargetBatch, best: ClosestConfigurations, count: int, followed: int
    ) -> ClosestConfigurations:
        """The closest to each target from random arms, with hands of all kinds.

        The hands are those that came closest so far, and some that look like the grasp. A hand
        without an arm is started at random itself.
        """
        owner = np.repeat(np.arange(len(targets)), count + 2)
        random = self.robot.random(np.random.default_rng(count), count)
        starts = np.tile(random, (len(targets), 1, 1))
        if self.robot.description.arm_actuators:
            hand = list(self.robot.description.hand_actuators)
            starts[:, ::2, hand] = best.fair[:, None, hand]
            starts[:, 1::2, hand] = best.q[:, None, hand]
            starts[:, :: DIAGNOSIS_EFFORT.alike, hand] = self._alike(
                targets, -(-count // DIAGNOSIS_EFFORT.alike)
            )
        starts = np.concatenate([best.q[:, None], best.fair[:, None], starts], axis=1)
        descent = LocalRefinement(self._trials, targets)
        ends = descent.run(owner, starts.reshape(len(owner), -1))
        return find_closest(descent, owner, ends, followed)

    def _alike(self, targets: TargetBatch, count: int) -> Array:
        """(k, count, hand) postures that look like the grasps, in turns."""
        options = self.method.options
        rounds = range(min(options.rounds, -(-count // options.candidates)))
        found = [self.method.postures(targets, number) for number in rounds]
        postures = np.concatenate(found, axis=1)
        return postures[:, np.arange(count) % postures.shape[1]]

    def _solved(self, targets: TargetBatch, q: Array) -> NDArray[np.bool_]:
        if not len(q):
            return np.zeros(0, dtype=bool)
        return judge(self.robot, targets, q).solved(targets.enforce_limits)

    def _nearest(self, targets: TargetBatch, q: Array) -> list[dict[str, NearContact]]:
        """The contacts of configurations (k, n), beside those asked for."""
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
        return (q - self.robot.lower <= DIAGNOSIS_EFFORT.at_limit) | (
            self.robot.upper - q <= DIAGNOSIS_EFFORT.at_limit
        )


class _Clock:
    """Seconds (k,) spent on each of the targets that are worked on together."""

    def __init__(self, seconds: Array) -> None:
        self.seconds = seconds
        self._now = time.perf_counter()

    def lap(self, owner: Rows) -> None:
        """Share the time since the last lap among some targets."""
        before, self._now = self._now, time.perf_counter()
        self.seconds[owner] += (self._now - before) / len(owner)


def _refused(hand: HandFit | None, reach: ArmReach | None, proof: Proof | None) -> Reason | None:
    # A proof by the reach may owe much to the hand: it shows only that no posture does both.
    if (proof is not None and proof.kind is not ProofKind.REACH) or (hand and not hand.fits):
        return Reason.HAND
    if proof is not None:
        return Reason.REACH
    if reach is not None and abs(reach.excess) > DIAGNOSIS_EFFORT.missed_reach:
        return Reason.REACH
    return None


def _worth(ratio: Array) -> Counts:
    """(k,) boxes a proof may take of targets that are missed by a factor (k,)."""
    share = np.clip((ratio - 1) / (DIAGNOSIS_EFFORT.clearly - 1), 0.0, 1.0)
    return np.maximum(PROVER_EFFORT.max_boxes * share, DIAGNOSIS_EFFORT.least).astype(np.int64)


def _enough(targets: TargetBatch, fair: Verdict) -> list[Tolerance]:
    """Tolerances that were kept to, no smaller than those asked for."""
    least = targets.largest_tolerance
    position = np.nanmax(fair.position_error, axis=1, initial=least.position)
    angle = np.nanmax(fair.angle_error, axis=1, initial=least.angle)
    return [Tolerance(*pair) for pair in zip(position.tolist(), angle.tolist(), strict=True)]


def _held_alone(targets: TargetBatch, row: int) -> TargetBatch:
    """Return one of several targets whose hands are held differently."""
    one = targets.rows(slice(row, row + 1))
    assert one.fixed is not None
    return replace(one, fixed=one.fixed[0])


def _with_contact_bounds(targets: TargetBatch) -> TargetBatch:
    """Return palm targets with contact tolerances that every palm within its tolerance keeps.

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


def _of_palms(robot: ArmHand, targets: TargetBatch, found: list[Diagnosis]) -> list[Diagnosis]:
    """Return the diagnoses with the errors of the palms, if the targets have palm poses."""
    palms = judge_palms(robot, targets, np.stack([one.q for one in found]))
    if palms is None:
        return found
    return [replace(one, palm=palms.of(row)) for row, one in enumerate(found)]


def _free_of(targets: TargetBatch, fingers: list[int]) -> TargetBatch:
    """Targets that some fingers have no part in."""

    def free(array: Array) -> Array:
        array = array.copy()
        array[:, fingers] = np.nan
        return array

    more = {name: free(array) for name, array in targets.more.items()}
    return replace(targets, points=free(targets.points), normals=free(targets.normals), more=more)


def _reachable(
    targets: TargetBatch, q: Array, near: dict[str, NearContact], seconds: float
) -> Diagnosis:
    return Diagnosis(
        reason=Reason.REACHABLE,
        enough=targets.largest_tolerance,
        nearest=near,
        q=q,
        time=float(seconds),
    )
