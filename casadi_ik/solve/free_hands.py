"""Hands moved out of the way: those of a body's sides by themselves, fingers without a contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import ROUNDING, CollisionQuery
from casadi_ik.files.arrays import Array, Bools, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.status import Phase
from casadi_ik.solve.trials import (
    Deduplicator,
    Subproblems,
    carry_palms,
    improving_rows,
    palm_coordinates,
    side_palms,
)


class SideHands:
    """Hands of the sides of a body that touch nothing by themselves, and arms for them.

    Which hand a side has and where its palm is the others do not care: hands are kept by side.

    Attributes:
        hands: By side positions in q of the motors of its hand.
        nearest: (s, k, n) answers whose hand of a side is nearest to touching nothing.
        surplus: (s, k) their room.
    """

    def __init__(
        self,
        trials: Subproblems,
        links: Sequence[tuple[frozenset[str], frozenset[str]]],
        targets: TargetBatch,
        query: CollisionQuery,
        alike: float,
    ) -> None:
        """Find the pairs that each hand decides by itself, and those that each arm does.

        Args:
            trials: The loop.
            links: By side those of its arm, and those that stay with its palm.
            targets: k targets.
            query: What they are checked against.
            alike: Hands that differ by less [of their motors' ranges] are taken once.
        """
        self._trials, self._targets, self._query = trials, targets, query
        self._robot = body = trials.robot.description
        self._arms = [arm for arm, _ in links]
        every = body.links_moved(range(len(body.actuators)))
        # Neither trunk, arms nor other hands: a hand among itself, and with what stands still.
        self._own = [query.parted(every - hand)[1] for _, hand in links]
        self.hands = [list(hand) for _, hand in body.side_actuators]
        count = len(targets)
        self.nearest = np.full((len(links), count, len(body.actuators)), np.nan)
        self.surplus = np.full((len(links), count), -np.inf)
        none, n, s = np.zeros(0, np.intp), len(body.actuators), len(links)
        self._found = [(np.zeros((0, n)), np.zeros((0, s, 4, 4)), none) for _ in links]
        self._known = [Deduplicator(len(targets), len(h) + 12, alike) for h in self.hands]

    def add(self, q: Array, owner: NDArray[np.intp], side: int, best: bool = False) -> None:
        """Take the hands of a side in that touch nothing by themselves, of answers (m, n).

        Args:
            q: (m, n).
            owner: (m,) the target of each.
            side: Number of the side.
            best: Whether to take one of each target at most, that with most room.
        """
        surplus = self._own[side].rows(owner).check(q).surplus
        rows = improving_rows(owner, surplus, self.surplus[side])
        self.nearest[side, owner[rows]] = q[rows]
        self.surplus[side, owner[rows]] = surplus[rows]
        rows = rows if best else np.arange(len(q))
        kept = rows[surplus[rows] >= -ROUNDING]
        q, owner = q[kept], owner[kept]
        palms, ranges = side_palms(self._trials.robot, q), self._robot.upper - self._robot.lower
        parts = [(q / ranges)[:, self.hands[side]], palm_coordinates(palms[:, side])]
        fresh = self._known[side].add(np.concatenate(parts, axis=1), owner)
        qs, poses, owners = self._found[side]
        self._found[side] = (
            np.concatenate([qs, q[fresh]]),
            np.concatenate([poses, palms[fresh]]),
            np.concatenate([owners, owner[fresh]]),
        )

    def mixed(self, rows: NDArray[np.intp], most: int) -> tuple[Array, Array, NDArray[np.intp]]:
        """Hands of all sides for some targets, as many ways as hands were found, and at most.

        Returns:
            (m, n) configurations, (m, s, 4, 4) poses of the palms, (m,) the target of each.
        """
        every = []
        for qs, poses, owner in self._found:
            order = np.argsort(owner, kind="stable")
            first = np.searchsorted(owner[order], rows)
            count = np.searchsorted(owner[order], rows, side="right") - first
            every.append((qs[order], poses[order], first, count))
        counts = np.stack([each[3] for each in every])
        ways = np.where(counts.min(axis=0) > 0, np.minimum(counts.max(axis=0), most), 0)
        at = np.repeat(np.arange(len(rows)), ways)
        number = np.arange(len(at)) - np.repeat(np.cumsum(ways) - ways, ways)
        q, palms = None, []
        for side, (qs, poses, first, count) in enumerate(every):
            picked = first[at] + number % np.maximum(count[at], 1)
            q = qs[picked] if q is None else q
            motors = self.hands[side]
            q[:, motors] = qs[picked][:, motors]
            palms.append(poses[picked, side])
        assert q is not None
        return q, np.stack(palms, axis=1), rows[at]

    def arms(
        self,
        searches: Sequence[ArmSearch],
        q: Array,
        palms: Array,
        owner: NDArray[np.intp],
        starts: Array,
        prefer: Preference,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Other arms for configurations (m, n) whose palms are right, one arm after the other.

        Of every arm but the last the preferred one of each branch that touches nothing is kept.
        """
        asked = prefer if prefer in ("limits", "q0") else "limits"
        limits, query = self._trials.limits(self._targets).first, self._query
        arms = frozenset[str]().union(*self._arms)
        free = query.parted(arms)[1].rows(owner).free(q)
        of = np.flatnonzero(free)
        q = q[of]
        for side, search in enumerate(searches):
            later = frozenset[str]().union(*self._arms[side + 1 :])
            pairs = query.parted(later)[1].parted(self._arms[side])[0]
            last = side + 1 == len(searches)
            found = search.choose(
                q,
                starts[owner[of]],
                (limits.lower, limits.upper),
                asked,
                pairs.rows(owner[of]),
                np.full(len(q), np.inf),
                branches=not last,
                closer=False,
                of_one=owner[of] if last else None,
            )
            q, of = found.q, of[found.owner]
        if len(q) and not all(search.exact for search in searches):
            q = carry_palms(
                self._trials, self._targets, q, palms[of], owner[of], float(Phase.TRUNK)
            )
        return q, owner[of]


@dataclass(frozen=True)
class UnconstrainedFingerParameters:
    """Which postures of unconstrained fingers are looked at.

    Attributes:
        postures: Evenly spread over their limits.
        closer: As many about the best of them, where they have too little clearance, ever closer.
        parts: How far about [of the motors' ranges].
        near: Clearance [m] that can be gained about a posture.
    """

    postures: int = 48
    closer: int = 24
    parts: tuple[float, ...] = (0.5, 0.25, 0.12)
    near: float = 0.02


PARAMETERS = UnconstrainedFingerParameters()


class UnconstrainedFingers:
    """The motors of k targets' hands that move no finger with a contact."""

    def __init__(self, robot: ArmHand, targets: TargetBatch) -> None:
        self._description = description = robot.description
        free = np.isnan(targets.points[..., 0]) & np.isnan(targets.normals[..., 0])
        for more in targets.more.values():
            free &= np.isnan(more[..., 0])
        busy = np.zeros((len(description.finger_names), len(robot.lower)), dtype=bool)
        for finger, name in enumerate(description.finger_names):
            busy[finger, list(description.finger_actuators(name))] = True
        hand = np.zeros(len(robot.lower), dtype=bool)
        hand[list(description.hand_actuators)] = True
        self._motors: Bools = hand & ~(~free[:, :, None] & busy).any(axis=1)
        if targets.fixed is not None:
            self._motors &= np.isnan(targets.fixed)
        parts = (
            0.5 + np.arange(PARAMETERS.postures)[:, None] * spread_steps(len(robot.lower))
        ) % 1.0
        ranges = robot.upper - robot.lower
        self._limits = robot.lower, robot.upper
        self._places = robot.lower + parts * ranges
        about = (parts[: PARAMETERS.closer] - 0.5) * ranges
        self._spread = (None, *(part * about for part in PARAMETERS.parts))

    def aside(self, q: Array, owner: NDArray[np.intp], query: CollisionQuery) -> Array:
        """Hands, those that touch something by themselves with their idle fingers elsewhere.

        Args:
            q: (m, n) configurations.
            owner: (m,) their targets.
            query: What hands by themselves are checked against.

        Returns:
            (m, n) each as it is, or with the idle fingers where they have most room.
        """
        some = np.flatnonzero(self._motors[owner].any(axis=1))
        if not len(some):
            return q
        of_idle, others = query.parted(self._links)
        # What the idle fingers have no part in they do not help.
        some = some[others.rows(owner[some]).free(q[some])]
        before = of_idle.rows(owner[some]).check(q[some]).surplus
        touching = before < -ROUNDING
        some, before = some[touching], before[touching]
        if not len(some):
            return q
        moved = q.copy()
        for places in self._spread:
            motors = self._motors[owner[some]]
            about = moved[some][:, None]
            there = self._places if places is None else about + places
            tried = np.where(motors[:, None], np.clip(there, *self._limits), about)
            count = tried.shape[1]
            rows = np.repeat(owner[some], count)
            surplus = (
                of_idle.rows(rows).check(tried.reshape(-1, q.shape[1])).surplus.reshape(-1, count)
            )
            best = surplus.argmax(axis=1)
            each = np.arange(len(some))
            most = surplus[each, best]
            better = most > before
            moved[some[better]] = tried[each, best][better]
            before = np.maximum(before, most)
            near = (before < -ROUNDING) & (before > -PARAMETERS.near)
            some, before = some[near], before[near]
            if not len(some):
                break
        return moved

    @cached_property
    def _links(self) -> frozenset[str]:
        """Links that a motor moves which is idle in one of the targets."""
        idle = np.flatnonzero(self._motors.any(axis=0)).tolist()
        return self._description.links_moved(idle)
