/* Recovery of a follower that is stuck. It stores a trail of postures of the motors. If the contacts were
 * met before and their error has not decreased for a while, it compares the postures of the trail with
 * the target, some of them per cycle; if one of them has a much smaller error, the motors brake and return
 * to it on a straight line. Collisions are not checked. The constants TRAIL_... are those of
 * casadi_ik/motion/recovery.py. */

/* Returns the distance of two postures: the largest difference of a motor, in UNITS of the motor. */
static double distance(const double *a, const double *b) {
  double largest = 0;
  int i;
  for (i = 0; i < N_MOTORS; ++i) largest = fmax(largest, fabs(a[i] - b[i]) / UNITS[i]);
  return largest;
}

/* Returns the longest step from which a motion can stop within a distance, if each later step is shorter
 * by a change. With N later steps the distance is (N + 1) step - change N (N + 1) / 2. */
static double brake(double distance, double change) {
  const double u = distance / change;
  const double steps = floor((sqrt(1 + 8 * u) - 1) / 2); /* largest N with N (N + 1) / 2 <= u */
  return change * (u + steps * (steps + 1) / 2) / (steps + 1);
}

/* Restarts the count of cycles in which the error does not decrease below an error ratio. */
static void restart_progress_clock(@PREFIX@_recovery *recovery, double error_ratio) {
  recovery->progress_ratio = error_ratio;
  recovery->cycles_stuck = 0;
  recovery->candidate = -1;
}

/* Ends a return, so that the motors follow the contacts. */
static void follow_contacts(@PREFIX@_recovery *recovery) {
  recovery->is_returning = recovery->has_line = 0;
  restart_progress_clock(recovery, INFINITY);
}

/* Computes the steps of braking motors. */
static void braking_steps(const @PREFIX@_follower *follower, double *steps) {
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    const double last_step = follower->state[STATE_LAST_STEP + i];
    const double speed = fmax(fabs(last_step) - follower->max_change[i], 0.0);
    steps[i] = last_step < 0 ? -speed : speed;
  }
}

/* Computes the steps of motors that return along the line. Fractions are relative to its length. */
static void line_steps(@PREFIX@_follower *follower, double *steps) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double remaining = fmax(1.0 - recovery->fraction, 0.0);
  const double limit = fmin(recovery->max_fraction_step, recovery->fraction_step + recovery->max_fraction_change);
  double next_fraction;
  int i;
  recovery->next_fraction_step = fmin(limit, brake(remaining, recovery->max_fraction_change));
  next_fraction = recovery->fraction + recovery->next_fraction_step;
  for (i = 0; i < N_MOTORS; ++i) {
    steps[i] = recovery->line_start[i] + next_fraction * recovery->line[i] - follower->state[STATE_Q + i];
  }
}

/* Returns the first posture of the trail that is within TRAIL_SPACING of a posture; the length of the
 * trail if there is none. */
static int64_t first_near(const @PREFIX@_recovery *recovery, const double *q) {
  int64_t i = 0;
  while (i < recovery->trail_length && distance(recovery->trail[i], q) > TRAIL_SPACING) ++i;
  return i;
}

/* Thins the trail to every second posture. */
static void thin_trail(@PREFIX@_recovery *recovery) {
  int64_t i;
  recovery->trail_length = TRAIL_CAPACITY / 2;
  for (i = 1; i < recovery->trail_length; ++i) copy(recovery->trail[i], recovery->trail[2 * i], N_MOTORS);
  recovery->destination /= 2;
  if (recovery->candidate > 0) recovery->candidate /= 2;
}

/* Adds a posture to the trail if it is far enough from the last one, and schedules the next check. If the
 * posture revisits the trail, the trail is cut at the revisited posture. */
static void extend_trail(@PREFIX@_recovery *recovery, const double *q) {
  double from_last = distance(recovery->trail[recovery->trail_length - 1], q);
  double cycles;
  if (from_last > TRAIL_SPACING) {
    const int64_t revisited = first_near(recovery, q);
    if (revisited < recovery->trail_length) {
      recovery->trail_length = revisited + 1;
      if (recovery->candidate > revisited) recovery->candidate = revisited;
      from_last = distance(recovery->trail[revisited], q);
    } else {
      if (recovery->trail_length == TRAIL_CAPACITY) thin_trail(recovery);
      copy(recovery->trail[recovery->trail_length++], q, N_MOTORS);
      from_last = 0;
    }
  }
  /* The motors cannot be farther than TRAIL_SPACING from the last posture before so many cycles. */
  cycles = fmin(floor((TRAIL_SPACING - from_last) / recovery->longest_step), 1e9);
  recovery->cycles_until_check = cycles < recovery->min_check_cycles ? recovery->min_check_cycles : (int64_t) cycles;
}

/* Compares the next postures of the trail with the target, from its end to its start. */
static void compare_postures(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  double record[sizeof follower->record / sizeof(double)];
  int64_t i;
  memcpy(record, follower->record, sizeof record);
  for (i = 0; i < recovery->comparisons_per_cycle && recovery->candidate >= 0; ++i, --recovery->candidate) {
    (void) evaluate_cycle_from_rest(follower, recovery->trail[recovery->candidate]);
    if (follower->record[RECORD_ERROR_RATIO] < TRAIL_GAIN * recovery->best_ratio) {
      recovery->best_ratio = follower->record[RECORD_ERROR_RATIO];
      recovery->destination = recovery->candidate;
    }
  }
  memcpy(follower->record, record, sizeof record);
}

/* Once the error has not decreased for a while, compares the postures of the trail with the target, and
 * starts the return to the best one if its error is much smaller. */
static void check_progress(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double error_ratio = follower->record[RECORD_ERROR_RATIO];
  if (error_ratio < TRAIL_PROGRESS * recovery->progress_ratio) {
    restart_progress_clock(recovery, error_ratio);
    return;
  }
  if (++recovery->cycles_stuck <= recovery->patience_cycles) return;
  if (recovery->candidate < 0) {
    recovery->candidate = recovery->trail_length - 1;
    recovery->best_ratio = INFINITY;
  }
  compare_postures(follower);
  if (recovery->candidate >= 0) return;
  restart_progress_clock(recovery, error_ratio);
  recovery->is_returning = recovery->best_ratio < TRAIL_GAIN * error_ratio;
  recovery->has_line = 0;
}

/* Starts the line to the destination if the motors are at rest. */
static void start_line(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    if (follower->state[STATE_LAST_STEP + i] != 0) return;
  }
  recovery->max_fraction_step = recovery->max_fraction_change = INFINITY;
  recovery->fraction = recovery->fraction_step = 0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double q = follower->state[STATE_Q + i], max_step = follower->parameters[PARAMETER_MAX_STEP + i];
    const double line = recovery->trail[recovery->destination][i] - q, length = fabs(line);
    recovery->line_start[i] = q;
    recovery->line[i] = line;
    if (length > 0) {
      recovery->max_fraction_step = fmin(recovery->max_fraction_step, max_step / length);
      recovery->max_fraction_change = fmin(recovery->max_fraction_change, follower->max_change[i] / length);
    }
  }
  if (recovery->max_fraction_step < INFINITY) recovery->has_line = 1;
  else follow_contacts(recovery); /* The motors are at the destination. */
}

/* Records a step of the return; ends the return at the destination. */
static void continue_return(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  if (!recovery->has_line) {
    start_line(follower);
    return;
  }
  recovery->fraction += recovery->next_fraction_step;
  recovery->fraction_step = recovery->next_fraction_step;
  if (recovery->fraction < 1.0 - 1e-12) return; /* The last step may end before 1 by rounding errors. */
  recovery->trail_length = recovery->destination + 1;
  recovery->cycles_until_check = 1;
  follow_contacts(recovery);
}

/* Advances a return after a cycle, or extends the trail and checks the progress. */
static void update_recovery(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double max_met_ratio = 1 + TOLERANCE_SLACK;
  if (recovery->is_returning) {
    continue_return(follower);
    return;
  }
  if (--recovery->cycles_until_check <= 0) extend_trail(recovery, follower->state + STATE_Q);
  if (follower->record[RECORD_ERROR_RATIO] > max_met_ratio
      && follower->record[RECORD_GOAL_ERROR_RATIO] > max_met_ratio) {
    if (recovery->has_met_contacts) check_progress(follower);
  } else {
    recovery->has_met_contacts = 1;
    restart_progress_clock(recovery, INFINITY);
  }
}

/* Returns a number of cycles, limited so that it fits into an integer. */
static double cycle_count(double cycles) { return fmin(cycles, 1e9); }

/* Sets the parameters of the recovery that depend on the period of valid settings. */
static void set_recovery_cycles(@PREFIX@_follower *follower, double period) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  recovery->patience_cycles = (int64_t) cycle_count(ceil(TRAIL_PATIENCE / period));
  recovery->min_check_cycles = (int64_t) fmax(cycle_count(floor(TRAIL_CHECK_PERIOD / period)), 1.0);
  recovery->comparisons_per_cycle =
      (int64_t) fmin(ceil(TRAIL_CAPACITY * period / TRAIL_SEARCH_TIME), TRAIL_CAPACITY);
}
