"""Recovery of a follower that is stuck.

A follower descends to a local minimum: after contacts out of reach, or at an obstacle, it may be
stuck although it followed the same contacts before. `Recovery` therefore stores a *trail*: previous
postures of the motors, at distances of `SPACING`. If the contacts were met before and their error
has not decreased for `PATIENCE`, it computes the error at the postures of the trail, a few of them
per cycle. If the minimum error is less than `GAIN` times the present one, the motors stop and
return to that posture. They move on straight lines, each from rest to rest: to the first posture of
the trail, counted from the destination, to which the line is free, so they take short cuts. If no
line is free, as in contact with an obstacle, the motors first increase the clearances. The lines
are checked at a few postures per cycle, and the guard also checks every step. If it stops the
motors, they increase the clearances, too, and choose a line again.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.motion.guard import Guard, braked
from casadi_ik.motion.inputs import FollowerInputs
from casadi_ik.solve.verdict import TOLERANCE_SLACK

SPACING = 0.1
"""Maximum motor distance between postures of a trail [rad, or fraction of a slider's range]."""

CAPACITY = 128
"""Maximum number of postures of a trail; a full trail is thinned to every second posture."""

CHECK_PERIOD = 0.01
"""Minimum time between two checks whether a posture is added to the trail [s]."""

PATIENCE = 0.2
"""Time without progress after which a follower counts as stuck [s]."""

SEARCH_TIME = 1.28
"""Time in which all postures of a full trail are compared with the target [s].

At periods up to 10 ms, one posture is compared per cycle.
"""

GAIN = 0.5
"""Maximum error at the destination of a return, relative to the present error."""

PROGRESS = 0.99
"""Maximum ratio of an error to the previous minimum that counts as a decrease."""

LINE_RESOLUTION = 0.02
"""Distance between the checked postures of a line, in the units of `SPACING`."""

CHECKS = 8
"""Number of postures of a line that are checked per cycle."""

MAX_RETURN_LINES = 40
"""Maximum number of lines of one return."""

MAX_STOPS = 6
"""Maximum number of stops in one return, by the guard or because no line is free.

After another stop the follower compares postures again, because the target may have moved.
"""

MAX_MET_RATIO = 1 + TOLERANCE_SLACK
"""Maximum error ratio at which the contacts are met."""


def brake(distance: Any, change: Any) -> Any:
    """Return the longest step from which a motion can stop within a distance, see `cycle.brake`."""
    u = distance / change
    steps = np.floor((np.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + steps * (steps + 1) / 2) / (steps + 1)


class Recovery:
    """Trail of a follower, and its return along it."""

    def __init__(
        self, units: Array, max_step: Array, max_change: Array, period: float, guard: Guard | None
    ) -> None:
        """Allocate the trail.

        Args:
            units: (n,) unit of each motor [rad or m].
            max_step: (n,) longest step of a cycle [rad or m].
            max_change: (n,) largest change of a step from cycle to cycle [rad or m].
            period: Time from cycle to cycle [s].
            guard: Collision checks of lines; None: all lines are free.
        """
        self._units, self._max_step, self._max_change = units, max_step, max_change
        self._guard = guard
        self._longest_step = float((max_step / units).max())
        self._check_cycles = max(math.floor(CHECK_PERIOD / period), 1)
        self._patience = math.ceil(PATIENCE / period)
        self._comparisons = min(math.ceil(CAPACITY * period / SEARCH_TIME), CAPACITY)
        self._trail = np.zeros((CAPACITY, len(units)))
        self.reset(self._trail[0])

    def reset(self, q: Array) -> None:
        """Start the trail at a posture (n,)."""
        self._trail[0], self._count, self._cycles_to_check = q, 1, 1
        self._destination, self._has_met = 0, False
        self.follow()

    def follow(self) -> None:
        """Let the motors follow the contacts from now on."""
        self._is_returning = False
        self._has_line = False
        self._start_clock(math.inf)

    def _start_clock(self, least_ratio: float) -> None:
        self._least_since, self._cycles_stuck, self._candidate = least_ratio, 0, -1

    def step(self, state: Array) -> Array | None:
        """Return the next step (n,) of motors that return; None if they follow the contacts."""
        if not self._is_returning:
            return None
        if not self._has_line:
            last_step = state[len(self._units) : 2 * len(self._units)]
            return braked(last_step, self._max_change)
        remaining = max(1.0 - self._done, 0.0)
        limit = min(self._line_fastest, self._line_step + self._line_change)
        self._next_step = min(limit, brake(remaining, self._line_change))
        progress = self._done + self._next_step
        return self._start + progress * self._line - state[: len(self._units)]

    def update(self, inputs: FollowerInputs, q: Array, last_step: Array, is_stopped: bool) -> None:
        """Evaluate the result of a cycle.

        Args:
            inputs: Graph of the cycle after its step.
            q: (n,) positions of the motors.
            last_step: (n,) their last step.
            is_stopped: True if the guard has stopped motors.
        """
        if self._is_returning:
            self._continue_return(q, last_step, is_stopped)
            return
        self._cycles_to_check -= 1
        if self._cycles_to_check <= 0:
            self._extend_trail(q)
        ratio = inputs.error_ratio
        if is_stopped or (ratio > MAX_MET_RATIO and inputs.goal_error_ratio > MAX_MET_RATIO):
            if self._has_met:
                self._check_progress(inputs, ratio, q if is_stopped else None)
        else:
            self._has_met = True
            if self._least_since < math.inf:
                self._start_clock(math.inf)

    def _distances(self, q: Array) -> Array:
        """Return the distances of the trail's postures from a posture (n,)."""
        return (np.abs(self._trail[: self._count] - q) / self._units).max(axis=1)

    def _append(self, q: Array) -> None:
        if self._count == CAPACITY:
            self._count = CAPACITY // 2
            self._trail[: self._count] = self._trail[::2]
            self._destination //= 2
            self._candidate = self._candidate // 2 if self._candidate > 0 else self._candidate
        self._trail[self._count] = q
        self._count += 1

    def _extend_trail(self, q: Array) -> None:
        """Add a posture to the trail if it is far enough from the last one.

        If the posture revisits the trail, the trail is cut at the revisited posture.
        """
        distances = self._distances(q)
        distance = float(distances[-1])
        if distance > SPACING:
            revisited = np.flatnonzero(distances <= SPACING)
            if len(revisited):
                self._count = int(revisited[0]) + 1
                self._candidate = min(self._candidate, self._count - 1)
                distance = float(distances[revisited[0]])
            else:
                self._append(q)
                distance = 0.0
        cycles = math.floor((SPACING - distance) / self._longest_step)
        self._cycles_to_check = max(cycles, self._check_cycles)

    def _check_progress(
        self, inputs: FollowerInputs, ratio: float, stopped_q: Array | None
    ) -> None:
        """Compare postures of the trail once the error has not decreased for a while.

        Args:
            inputs: Graph of the cycle after its step.
            ratio: Error ratio after the step of the graph.
            stopped_q: (n,) positions of the motors if the guard has replaced that step; else None.
        """
        if ratio < PROGRESS * self._least_since:
            self._start_clock(ratio)
            return
        self._cycles_stuck += 1
        if self._cycles_stuck <= self._patience:
            return
        if self._candidate < 0:
            if stopped_q is not None and inputs.exact_error_ratio(stopped_q) <= MAX_MET_RATIO:
                self._start_clock(math.inf)
                return
            self._candidate, self._least_ratio = self._count - 1, math.inf
        for _ in range(self._comparisons):
            if self._candidate >= 0:
                candidate = inputs.error_ratio_at(self._trail[self._candidate])
                if candidate < GAIN * self._least_ratio:
                    self._least_ratio, self._destination = candidate, self._candidate
                self._candidate -= 1
        if self._candidate < 0:
            self._start_clock(ratio)
            self._is_returning = bool(self._least_ratio < GAIN * ratio)
            self._has_line, self._lines, self._stops = False, 0, 0
            self._is_blocked = False
            self._target = -1

    def _continue_return(self, q: Array, last_step: Array, is_stopped: bool) -> None:
        """Record a step of the return, and choose the next line at the end of a line."""
        if not self._has_line:
            if last_step.any():
                return
            if self._is_blocked:
                self._is_blocked = False
                self._move_away(q)
            else:
                self._choose_line(q)
            return
        self._done, self._line_step = self._done + self._next_step, self._next_step
        if is_stopped:
            self._append(q)
            self._has_line = False
            self._is_blocked = True
        elif self._done >= 1.0 - 1e-12:
            self._has_line = False
            self._count = self._target + 1
            self._cycles_to_check = 1
            has_arrived, self._target = self._target <= self._destination, -1
            if has_arrived:
                self.follow()

    def _try_shorter_line(self) -> None:
        """Choose the posture halfway between the present target and the end of the trail."""
        self._target = min((self._target + self._count) // 2, self._count - 1)
        self._checked = 0

    def _choose_line(self, q: Array) -> None:
        """Check a part of a line, and start the motion along it after all parts were free."""
        if self._target < 0:
            self._target, self._checked = self._destination, 0
            self._lines += 1
            if self._lines > MAX_RETURN_LINES:
                self.follow()
                return
        line = self._trail[self._target] - q
        count = math.ceil(float((np.abs(line) / self._units).max()) / LINE_RESOLUTION)
        last = min(self._checked + CHECKS, count)
        if self._guard is None or self._target == self._count - 1:
            self._checked = count
        elif last > self._checked:
            fractions = np.arange(self._checked + 1, last + 1)[:, None] / count
            if not self._guard.are_free(q + fractions * line):
                self._try_shorter_line()
                return
            self._checked = last
        if self._checked >= count:
            self._start, self._line, self._done, self._line_step = q, line, 0.0, 0.0
            with np.errstate(divide="ignore"):
                self._line_fastest = float((self._max_step / np.abs(line)).min())
                self._line_change = float((self._max_change / np.abs(line)).min())
            self._has_line = self._line_fastest < math.inf
            if not self._has_line:
                self._move_away(q)

    def _move_away(self, q: Array) -> None:
        """Increase the clearances of a posture from which no line is free."""
        if self._guard is None or self._stops > MAX_STOPS:
            self.follow()
            return
        self._append(self._guard.posture_with_clearance(q, self._units))
        self._target, self._checked = self._count - 1, 0
        self._stops += 1
