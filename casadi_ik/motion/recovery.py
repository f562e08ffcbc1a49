"""The way back of a follower that is stuck.

A follower descends to a local minimum: after contacts that were out of reach, or where something is
in the way, it may be stuck although it followed the same contacts before. `Recovery` therefore
keeps a *trail*, the postures that the motors have passed at distances of `SPACING`. If the error of
the contacts has not decreased for `PATIENCE`, it computes the error at the postures of the trail, a
few of them in a cycle. If the least is less than `GAIN` times the present error, the motors stop
and go back to that posture. They go on straight lines, each from rest to rest: to the first posture
of the trail, counted from that one, to which the line is free, so that they take short cuts. The
lines are checked at a few postures in a cycle, and the guard checks every step as always.
"""

from __future__ import annotations

import math

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.motion.clear import Guard
from casadi_ik.motion.inputs import FollowerInputs
from casadi_ik.solve.verdict import TOLERANCE_SLACK

SPACING = 0.1
"""Distance of the postures of a trail [rad, or part of a slider's range], in the largest motor."""

CAPACITY = 128
"""Maximum number of postures of a trail; beyond it every second one is dropped, not the first."""

CHECK_PERIOD = 0.01
"""Minimum time between two checks whether a posture is added to the trail [s]."""

PATIENCE = 0.2
"""Time without progress after which a follower is stuck [s]."""

SEARCH_TIME = 0.5
"""Time in which all postures of a full trail are compared [s]."""

GAIN = 0.5
"""A posture is worth going to if its error is less than this part of the present one."""

PROGRESS = 0.99
"""An error has decreased if it is below this part of the least one before."""

RESOLUTION = 0.02
"""Distance of the postures at which a line is checked, in units as `SPACING`."""

CHECKS = 8
"""Postures of a line that are checked in a cycle."""

ATTEMPTS = 40
"""Maximum number of lines on one way back."""

MET = 1 + TOLERANCE_SLACK
"""Largest error ratio at which the contacts are met."""


def brake(distance: float, change: float) -> float:
    """Return the longest step from which a motion can stop within a distance, see `cycle.brake`."""
    u = distance / change
    steps = math.floor((math.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + steps * (steps + 1) / 2) / (steps + 1)


class Recovery:
    """The trail of a follower, and its way back along it."""

    def __init__(
        self, units: Array, fastest: Array, change: Array, period: float, guard: Guard | None
    ) -> None:
        """Lay out the memory.

        Args:
            units: (n,) unit of each motor [rad or m].
            fastest: (n,) longest step of a cycle [rad or m].
            change: (n,) by how much a step may differ from the last [rad or m].
            period: Time from cycle to cycle [s].
            guard: What checks that lines are free; None: all are.
        """
        self._units, self._fastest, self._change = units, fastest, change
        self._guard = guard
        self._longest_step = float((fastest / units).max())
        self._check_cycles = max(math.floor(CHECK_PERIOD / period), 1)
        self._patience = math.ceil(PATIENCE / period)
        self._comparisons = min(math.ceil(CAPACITY * period / SEARCH_TIME), CAPACITY)
        self._trail = np.zeros((CAPACITY, len(units)))
        self.reset(self._trail[0])

    def reset(self, q: Array) -> None:
        """Start the trail at a posture (n,)."""
        self._trail[0], self._count, self._cycles_to_check = q, 1, 1
        self._destination = 0
        self.follow()

    def follow(self) -> None:
        """Let the motors follow the contacts."""
        self._is_returning = False
        self._has_line = False
        self._start_clock(math.inf)

    def _start_clock(self, least: float) -> None:
        self._least, self._cycles_stuck, self._candidate = least, 0, -1

    def step(self, state: Array) -> Array | None:
        """Return the next step (n,) of the motors on their way back; None: they follow."""
        if not self._is_returning:
            return None
        if not self._has_line:
            last = state[len(self._units) : 2 * len(self._units)]
            return np.sign(last) * np.maximum(np.abs(last) - self._change, 0.0)
        remaining = max(1.0 - self._done, 0.0)
        limit = min(self._line_fastest, self._line_step + self._line_change)
        self._next_step = min(limit, brake(remaining, self._line_change))
        share = self._done + self._next_step
        return self._start + share * self._line - state[: len(self._units)]

    def update(self, asked: FollowerInputs, q: Array, moved: Array, stopped: bool) -> None:
        """Take the result of a cycle.

        Args:
            asked: The graph after the cycle.
            q: (n,) where the motors are.
            moved: (n,) their last step.
            stopped: Whether the guard stopped motors.
        """
        if self._is_returning:
            self._go_on(q, moved, stopped)
            return
        self._cycles_to_check -= 1
        if self._cycles_to_check <= 0:
            self._extend(q)
        ratio = asked.error_ratio
        if stopped or (ratio > MET and asked.goal_error_ratio > MET):
            self._look_for_progress(asked, ratio, q if stopped else None)
        elif self._least < math.inf:
            self._start_clock(math.inf)

    def _distances(self, q: Array) -> Array:
        """Return the distances of the trail from a posture."""
        return (np.abs(self._trail[: self._count] - q) / self._units).max(axis=1)

    def _append(self, q: Array) -> None:
        if self._count == CAPACITY:
            self._count = CAPACITY // 2
            self._trail[: self._count] = self._trail[::2]
            self._destination //= 2
            self._candidate = self._candidate // 2 if self._candidate > 0 else self._candidate
        self._trail[self._count] = q
        self._count += 1

    def _extend(self, q: Array) -> None:
        """Add a posture to the trail if it is far enough from the last one.

        A trail that comes back to itself is cut off there.
        """
        distances = self._distances(q)
        distance = float(distances[-1])
        if distance > SPACING:
            near = np.flatnonzero(distances <= SPACING)
            if len(near):
                self._count = int(near[0]) + 1
                self._candidate = min(self._candidate, self._count - 1)
                distance = float(distances[near[0]])
            else:
                self._append(q)
                distance = 0.0
        cycles = math.floor((SPACING - distance) / self._longest_step)
        self._cycles_to_check = max(cycles, self._check_cycles)

    def _look_for_progress(
        self, asked: FollowerInputs, ratio: float, stopped_at: Array | None
    ) -> None:
        """Compare postures of the trail once the error has not decreased for a while.

        Args:
            asked: The graph after the cycle.
            ratio: Error ratio of the step that the graph wanted.
            stopped_at: (n,) posture if the guard has stopped motors, so that they are not where
                the graph wanted them; else None.
        """
        if ratio < PROGRESS * self._least:
            self._start_clock(ratio)
            return
        self._cycles_stuck += 1
        if self._cycles_stuck <= self._patience:
            return
        if self._candidate < 0:
            if stopped_at is not None and asked.exact_error_ratio(stopped_at) <= MET:
                self._start_clock(math.inf)
                return
            self._candidate, self._least_ratio = self._count - 1, math.inf
        for _ in range(self._comparisons):
            if self._candidate >= 0:
                candidate = asked.error_ratio_at(self._trail[self._candidate])
                if candidate < GAIN * self._least_ratio:
                    self._least_ratio, self._destination = candidate, self._candidate
                self._candidate -= 1
        if self._candidate < 0:
            self._start_clock(ratio)
            self._is_returning = bool(self._least_ratio < GAIN * ratio)
            self._has_line, self._attempts = False, 0
            self._target = -1

    def _go_on(self, q: Array, moved: Array, stopped: bool) -> None:
        """Take a step on the way back, and choose the next line where one ends."""
        if not self._has_line:
            if not moved.any():
                self._choose_line(q)
            return
        self._done, self._line_step = self._done + self._next_step, self._next_step
        if stopped:
            self._has_line, self._target = False, -1
            self._append(q)
        elif self._done >= 1.0 - 1e-12:
            self._has_line = False
            self._count = self._target + 1
            self._cycles_to_check = 1
            arrived, self._target = self._target <= self._destination, -1
            if arrived:
                self.follow()

    def _choose_line(self, q: Array) -> None:
        """Check a part of a line; go along it once it is known to be free."""
        if self._target < 0:
            self._target, self._checked = self._destination, 0
            self._attempts += 1
            if self._attempts > ATTEMPTS:
                self.follow()
                return
        line = self._trail[self._target] - q
        count = math.ceil(float((np.abs(line) / self._units).max()) / RESOLUTION)
        last = min(self._checked + CHECKS, count)
        if self._guard is None or self._target == self._count - 1:
            self._checked = count
        elif last > self._checked:
            shares = np.arange(self._checked + 1, last + 1)[:, None] / count
            if not self._guard.are_free(q + shares * line):
                # Halfway from there to the end of the trail.
                self._target, self._checked = (self._target + self._count) // 2, 0
                return
            self._checked = last
        if self._checked >= count:
            self._start, self._line, self._done, self._line_step = q, line, 0.0, 0.0
            with np.errstate(divide="ignore"):
                self._line_fastest = float((self._fastest / np.abs(line)).min())
                self._line_change = float((self._change / np.abs(line)).min())
            self._has_line = self._line_fastest < math.inf
            if not self._has_line:
                self.follow()
