"""Recovery of a follower that is stuck.

A follower descends to a local minimum. After contacts out of reach, or at an obstacle, it may
therefore be stuck although it followed the same contacts before. `Recovery` stores a *trail*:
previous postures of the motors, at distances of `SPACING`. The recovery has four steps:

1. If the contacts were met before and their error has not decreased for `PATIENCE`, the postures of
   the trail are compared with the target, a few of them per cycle.
2. If the minimum error is less than `GAIN` times the present one, that posture is the
   *destination*, and the motors brake to rest.
3. The motors move to the destination on straight *lines*, each from rest to rest. A line ends at
   the posture of the trail nearest to the destination to which the line is free, so the motors take
   short cuts. Lines are checked at a few postures per cycle.
4. If no line is free, as in contact with an obstacle, or if the guard stops the motors on a line,
   they first move to a posture with more clearance.

Indices of the trail count from the oldest posture.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.motion.cycle import StateFields
from casadi_ik.motion.cycle_runner import CycleRunner
from casadi_ik.motion.guard import Guard, braked
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
    """Return the longest step from which a motion can stop within a distance, see `cycle.brake`.

    Args:
        distance: Distance >= 0, a number or an array.
        change: Maximum change of the step from cycle to cycle, > 0.
    """
    u = distance / change
    steps = np.floor((np.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + steps * (steps + 1) / 2) / (steps + 1)


class Recovery:
    """Trail of a follower, and its return along it.

    An error ratio is the largest error of the contacts over its tolerance. A line begins at
    `_line_start`; the vector `_line` leads to its end, and steps are fractions of this vector.
    """

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
        self._guard, self._fields = guard, StateFields.of(len(units))
        self._longest_step = float((max_step / units).max())
        self._min_check_cycles = max(math.floor(CHECK_PERIOD / period), 1)
        self._patience_cycles = math.ceil(PATIENCE / period)
        self._comparisons_per_cycle = min(math.ceil(CAPACITY * period / SEARCH_TIME), CAPACITY)
        self._trail = np.zeros((CAPACITY, len(units)))
        self.reset(self._trail[0])

    def reset(self, q: Array) -> None:
        """Start the trail at a posture (n,)."""
        self._trail[0], self._trail_length, self._cycles_until_check = q, 1, 1
        self._destination, self._has_met_contacts = 0, False
        self.follow_contacts()

    def follow_contacts(self) -> None:
        """End a return, so that the motors follow the contacts."""
        self._is_returning = False
        self._has_line = False
        self._restart_progress_clock(math.inf)

    def _restart_progress_clock(self, error_ratio: float) -> None:
        """Restart the count of cycles in which the error does not decrease below an error ratio."""
        self._progress_ratio, self._cycles_stuck, self._candidate = error_ratio, 0, -1

    def step(self, state: Array) -> Array | None:
        """Return the next step (n,) of motors that return; None if they follow the contacts.

        Args:
            state: State of the cycle (`Cycle.state`).
        """
        if not self._is_returning:
            return None
        if not self._has_line:
            return braked(state[self._fields.last_step], self._max_change)
        remaining = max(1.0 - self._fraction, 0.0)
        limit = min(self._max_fraction_step, self._fraction_step + self._max_fraction_change)
        self._next_fraction_step = min(limit, brake(remaining, self._max_fraction_change))
        next_fraction = self._fraction + self._next_fraction_step
        return self._line_start + next_fraction * self._line - state[self._fields.q]

    def update(self, runner: CycleRunner, q: Array, last_step: Array, is_stopped: bool) -> None:
        """Evaluate the result of a cycle.

        Args:
            runner: Graph of the cycle after its step.
            q: (n,) positions of the motors.
            last_step: (n,) their last step.
            is_stopped: True if the guard has stopped motors.
        """
        if self._is_returning:
            self._continue_return(q, last_step, is_stopped)
            return
        self._cycles_until_check -= 1
        if self._cycles_until_check <= 0:
            self._extend_trail(q)
        error_ratio = runner.error_ratio
        is_missed = error_ratio > MAX_MET_RATIO and runner.goal_error_ratio > MAX_MET_RATIO
        if is_stopped or is_missed:
            if self._has_met_contacts:
                self._check_progress(runner, error_ratio, q if is_stopped else None)
        else:
            self._has_met_contacts = True
            if self._progress_ratio < math.inf:
                self._restart_progress_clock(math.inf)

    def _distances(self, q: Array) -> Array:
        """Return the distances of the trail's postures from a posture (n,), see `SPACING`."""
        return (np.abs(self._trail[: self._trail_length] - q) / self._units).max(axis=1)

    def _append(self, q: Array) -> None:
        """Append a posture (n,) to the trail, which is thinned to every second posture if full."""
        if self._trail_length == CAPACITY:
            self._trail_length = CAPACITY // 2
            self._trail[: self._trail_length] = self._trail[::2]
            self._destination //= 2
            if self._candidate > 0:
                self._candidate //= 2
        self._trail[self._trail_length] = q
        self._trail_length += 1

    def _extend_trail(self, q: Array) -> None:
        """Add a posture to the trail if it is far enough from the last one.

        If the posture revisits the trail, the trail is cut at the revisited posture.
        """
        distances = self._distances(q)
        distance = float(distances[-1])
        if distance > SPACING:
            revisited = np.flatnonzero(distances <= SPACING)
            if len(revisited):
                self._trail_length = int(revisited[0]) + 1
                self._candidate = min(self._candidate, self._trail_length - 1)
                distance = float(distances[revisited[0]])
            else:
                self._append(q)
                distance = 0.0
        # The motors cannot be farther than `SPACING` from the last posture before so many cycles.
        cycles = math.floor((SPACING - distance) / self._longest_step)
        self._cycles_until_check = max(cycles, self._min_check_cycles)

    def _check_progress(
        self, runner: CycleRunner, error_ratio: float, stopped_q: Array | None
    ) -> None:
        """Compare postures of the trail once the error has not decreased for a while.

        Args:
            runner: Graph of the cycle after its step.
            error_ratio: Error ratio after the step of the graph.
            stopped_q: (n,) positions of the motors if the guard has replaced that step; else None.
        """
        if error_ratio < PROGRESS * self._progress_ratio:
            self._restart_progress_clock(error_ratio)
            return
        self._cycles_stuck += 1
        if self._cycles_stuck <= self._patience_cycles:
            return
        if self._candidate < 0:
            if stopped_q is not None and runner.exact_error_ratio(stopped_q) <= MAX_MET_RATIO:
                self._restart_progress_clock(math.inf)
                return
            self._candidate, self._best_ratio = self._trail_length - 1, math.inf
        self._compare_postures(runner)
        if self._candidate < 0:
            self._restart_progress_clock(error_ratio)
            self._is_returning = bool(self._best_ratio < GAIN * error_ratio)
            self._has_line, self._n_lines, self._n_stops = False, 0, 0
            self._needs_clearance = False
            self._line_end = -1

    def _compare_postures(self, runner: CycleRunner) -> None:
        """Compare the next postures of the trail with the target, from its end to its start."""
        for _ in range(min(self._comparisons_per_cycle, self._candidate + 1)):
            error_ratio = runner.error_ratio_at(self._trail[self._candidate])
            if error_ratio < GAIN * self._best_ratio:
                self._best_ratio, self._destination = error_ratio, self._candidate
            self._candidate -= 1

    def _continue_return(self, q: Array, last_step: Array, is_stopped: bool) -> None:
        """Record a step of the return, and choose the next line at the end of a line.

        Args:
            q: (n,) positions of the motors.
            last_step: (n,) their last step.
            is_stopped: True if the guard has stopped motors.
        """
        if not self._has_line:
            if last_step.any():
                return  # the motors still brake
            if self._needs_clearance:
                self._needs_clearance = False
                self._increase_clearance(q)
            else:
                self._choose_line(q)
            return
        self._fraction += self._next_fraction_step
        self._fraction_step = self._next_fraction_step
        if is_stopped:
            self._append(q)
            self._has_line = False
            self._needs_clearance = True
        elif self._fraction >= 1.0 - 1e-12:  # rounding errors
            self._has_line = False
            self._trail_length = self._line_end + 1
            self._cycles_until_check = 1
            has_arrived, self._line_end = self._line_end <= self._destination, -1
            if has_arrived:
                self.follow_contacts()

    def _choose_line(self, q: Array) -> None:
        """Check a part of a line from a posture (n,), and start the line if all parts are free."""
        if self._line_end < 0:
            self._line_end, self._n_checked = self._destination, 0
            self._n_lines += 1
            if self._n_lines > MAX_RETURN_LINES:
                self.follow_contacts()
                return
        line = self._trail[self._line_end] - q
        count = math.ceil(float((np.abs(line) / self._units).max()) / LINE_RESOLUTION)
        if self._guard is None or self._line_end == self._trail_length - 1:
            # The motors came from the last posture, or it was chosen for its clearance.
            self._n_checked = count
        else:
            last = min(self._n_checked + CHECKS, count)
            if last > self._n_checked:
                fractions = np.arange(self._n_checked + 1, last + 1)[:, None] / count
                if not self._guard.are_free(q + fractions * line):
                    self._choose_nearer_end()
                    return
                self._n_checked = last
        if self._n_checked >= count:
            self._start_line(q, line)

    def _choose_nearer_end(self) -> None:
        """End the line halfway along the trail between its present end and the motors."""
        self._line_end = min((self._line_end + self._trail_length) // 2, self._trail_length - 1)
        self._n_checked = 0

    def _start_line(self, q: Array, line: Array) -> None:
        """Start the motion from a posture (n,) along a vector (n,)."""
        self._line_start, self._line, self._fraction, self._fraction_step = q, line, 0.0, 0.0
        with np.errstate(divide="ignore"):
            self._max_fraction_step = float((self._max_step / np.abs(line)).min())
            self._max_fraction_change = float((self._max_change / np.abs(line)).min())
        self._has_line = self._max_fraction_step < math.inf
        if not self._has_line:
            # The motors are at the end of the line already.
            self._increase_clearance(q)

    def _increase_clearance(self, q: Array) -> None:
        """Choose a line from a posture (n,) to one with more clearance."""
        if self._guard is None or self._n_stops > MAX_STOPS:
            self.follow_contacts()
            return
        self._append(self._guard.posture_with_clearance(q, self._units))
        self._line_end, self._n_checked = self._trail_length - 1, 0
        self._n_stops += 1
