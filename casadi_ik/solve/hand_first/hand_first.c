/* Hand-first: the search for one target, from its inputs to the verdict.
 *
 * A search restarts until the target is solved or no further restart is worthwhile (restarts.c).
 * A restart tries up to N_CANDIDATES hand postures (seeds.c; for a multi-arm robot sides.c), one
 * after the other. For each posture it computes the best palm pose (candidate), fits palm and hand
 * to the contacts as if the hand were floating (hand fit), places the arm in closed form (arm
 * placement, or arm choice if the preference is q0), moves all motors where the arm cannot follow
 * exactly (refinement), and minimises the largest relative error where contacts contradict each
 * other (balance). One iteration is one step of the current stage and the choice of the next stage:
 * iteration.c.
 *
 * The loop (compile/runtime/loop.c) runs the iterations, of one target or of many in lanes, and
 * calls `follow` when the iterations of a target end. A batch, a single target, `fast`, a solve by
 * steps and an exported solver all use this file.
 *
 * BEGIN, SOLVE and JUDGE call compiled kernels, as in seeds.c; search_code.py defines the constants.
 */

#if !REPAIRS
/* Write low-discrepancy hand postures over the limits to the seeds. */
static void seed_low_discrepancy(search *job, int64_t number) {
  int i, k;
  for (i = 0; i < N_CANDIDATES; ++i) {
    const int64_t sample = number * N_CANDIDATES + i + 1;
    for (k = 0; k < N_HAND; ++k) {
      const int column = HAND[k];
      job->postures[i * N_HAND + k] =
          ANYWHERE_LOWER[column] + even(sample, ALL_STEPS[column]) * ANYWHERE_RANGE[column];
    }
  }
}
#endif

/* Write a low-discrepancy configuration over the limits. */
static void sample_configuration(int64_t number, double *q) {
  int k;
  for (k = 0; k < N_MOTORS; ++k) {
    q[k] = ANYWHERE_LOWER[k] + even(number * N_CANDIDATES + 1, ALL_STEPS[k]) * ANYWHERE_RANGE[k];
  }
}

/* Store the hand of the incumbent if it has changed; the previous one is kept. */
static void update_incumbent_hands(search *job) {
  double *best = job->incumbent_hands, *previous = job->incumbent_hands + N_HAND;
  int k, is_new = 0;
  for (k = 0; k < N_HAND; ++k) is_new |= job->previous_state[STATE_BEST_Q + HAND[k]] != best[k];
  if (!is_new) return;
  memcpy(previous, best, N_HAND * sizeof(double));
  for (k = 0; k < N_HAND; ++k) best[k] = job->previous_state[STATE_BEST_Q + HAND[k]];
  ++job->incumbent_count;
}

/* Write hand postures on the line through the last two incumbent hands to the seeds: contacts move
 * little along it, and the arm may reach another of its hands. Return 0 if the hands are equal. */
static int seed_along_line(search *job, int64_t number) {
  const double *best = job->incumbent_hands, *previous = job->incumbent_hands + N_HAND;
  double max_fraction = 0;
  int i, k;
  for (k = 0; k < N_HAND; ++k) {
    const double fraction = fabs(best[k] - previous[k]) / ANYWHERE_RANGE[HAND[k]];
    if (fraction > max_fraction) max_fraction = fraction;
  }
  if (!(max_fraction > 0)) return 0;
  for (i = 0; i < N_CANDIDATES; ++i) {
    const double offset = 2 * even(number * N_CANDIDATES + i + 1, ALL_STEPS[0]) - 1;
    for (k = 0; k < N_HAND; ++k) {
      const double step = ALONG_LINE * offset / max_fraction * (best[k] - previous[k]);
      job->postures[i * N_HAND + k] = best[k] + step;
    }
  }
  return 1;
}

/* Write the seeds of a restart. */
static int write_seeds(search *job, int64_t number) {
  if (tracks_incumbents(job, number)) update_incumbent_hands(job);
  if (seeds_along_line(job, number) && seed_along_line(job, number)) return DONE;
  if (!is_global_restart(number)) return seed_from_tables(job, number);
#if REPAIRS
  return seed_repaired(job, number);
#else
  seed_low_discrepancy(job, number - ROUNDS);
  return DONE;
#endif
}

/* Begin a global restart with the refinement of a configuration. */
static void start_refinement(search *job, int64_t number) {
  double q[N_MOTORS];
  int i, k;
  if (starts_at_incumbent(job, number)) {
    memcpy(q, job->previous_state + STATE_BEST_Q, sizeof q);
  } else {
    sample_configuration(number - ROUNDS, q);
  }
  for (k = 0; k < N_MOTORS; ++k) {
    job->state[STATE_Q + k] =
        clipped(q[k], job->parameters[PARAMETERS_LOWER + k], job->parameters[PARAMETERS_UPPER + k]);
  }
  job->state[STATE_PHASE] =
      starts_tolerant(job, number) ? TOLERANT_REFINEMENT_STAGE : REFINEMENT_STAGE;
  for (i = 0; i < N_FIT_FIELDS; ++i) job->state[FIT_FIELDS[i]] = FIT_VALUES[i];
}

/* Set the first state and the parameters of a restart. The fields KEPT_FIELDS of the state are kept
 * across restarts. */
static int start_restart(search *job) {
  const int64_t number = job->round;
  const double *inputs[5 + N_EXTRA_VECTORS];
  double *outputs[2];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code, i;
  memcpy(job->previous_state, job->state, sizeof job->previous_state);
  code = write_seeds(job, number);
  if (code != DONE) return code;
  inputs[0] = job->points;
  inputs[1] = job->normals;
  for (i = 0; i < N_EXTRA_VECTORS; ++i) inputs[2 + i] = job->extra_vectors + 3 * N_FINGERS * i;
  inputs[2 + N_EXTRA_VECTORS] = job->q0;
  inputs[3 + N_EXTRA_VECTORS] = job->settings;
  inputs[4 + N_EXTRA_VECTORS] = job->postures;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  if (code != DONE) return code;
  if (!number) {
    for (i = 0; job->preference_dropped && i < N_COUNTS; ++i) {
      job->state[STATE_COUNTS + i] = job->previous_state[STATE_COUNTS + i];
    }
    return DONE;
  }
  job->state[STATE_PHASE] = CANDIDATE_STAGE;
  job->state[STATE_CANDIDATE] = 0.0;
  if (is_global_restart(number)) start_refinement(job, number);
  for (i = 0; i < N_KEPT_FIELDS; ++i) {
    job->state[KEPT_FIELDS[i]] = job->previous_state[KEPT_FIELDS[i]];
  }
  job->state[STATE_CANDIDATES_BEFORE] =
      job->previous_state[STATE_CANDIDATES_BEFORE] + N_CANDIDATES;
  return DONE;
}

/* Compute the verdict, which decides the status. */
static int judge(search *job) {
  const double slack = 1 + TOLERANCE_SLACK;
  const double *inputs[3];
  double *outputs[3];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code, i, is_met = 1;
  inputs[0] = job->q;
  inputs[1] = job->points;
  inputs[2] = job->normals;
  outputs[0] = job->position_error;
  outputs[1] = job->angle_error;
  outputs[2] = &job->limit_violation;
  code = JUDGE(&map);
  if (code != DONE) return code;
  for (i = 0; i < N_FINGERS; ++i) {
    is_met &= job->position_error[i] <= job->settings[i] * slack || !is_number(job->points[3 * i]);
    is_met &= job->angle_error[i] <= job->settings[N_FINGERS + i] * slack
        || !is_number(job->normals[3 * i]);
  }
  if (ENFORCE_LIMITS) is_met &= job->limit_violation <= LIMIT_SLACK;
  if (is_met) job->status = SOLVED_STATUS;
  else if (job->status == SOLVED_STATUS) job->status = STALLED_STATUS;
  return DONE;
}

#if N_TURNING
/* Shift motors without limits to within half a turn of zero, because their bounds are not stops. */
static void remove_full_turns(search *job) {
  int i;
  for (i = 0; i < N_TURNING; ++i) {
    const int k = TURNING[i];
    job->turns[i] = CONTINUOUS[i] ? TURN * floor(job->q0[k] / TURN + 0.5) : 0.0;
    job->q0[k] -= job->turns[i];
  }
}

/* Move motors of the answer by full turns towards `q0`: motors without limits, and, if the
 * preference is q0, the others within their bounds. Motors with equal bounds stay. */
static void move_to_nearest_turns(search *job) {
  int i;
  for (i = 0; i < N_TURNING; ++i) {
    const int k = TURNING[i];
    const double low = job->settings[SETTINGS_LOWER + k], high = job->settings[SETTINGS_UPPER + k];
    const double q = job->q[k], turns = floor((job->q0[k] - q) / TURN + 0.5);
    if (CONTINUOUS[i] && low < high) {
      job->q[k] = q + TURN * turns + job->turns[i];
    } else if (job->settings[SETTINGS_NEAREST] > 0) {
      const double first = ceil((low - q) / TURN), last = floor((high - q) / TURN);
      job->q[k] = q + TURN * clipped(turns, first < 0 ? first : 0.0, last > 0 ? last : 0.0);
    }
  }
}
#endif

/* Begin a new target with restart 0. */
static void begin_target(search *job) {
#if N_TURNING
  remove_full_turns(job);
#endif
  job->round = job->preference_dropped = job->incumbent_count = 0;
}

/* Write the result of a target whose iterations ended with a status. */
static int finish_target(search *job, int32_t status) {
  job->status = status == RUNNING ? ITERATION_LIMIT_STATUS
              : status == REPEATED ? STALLED_STATUS
              : status < 0 ? INVALID_STATUS : status;
  if (job->preference_dropped) job->settings[SETTINGS_NEAREST] = 1.0;
  memcpy(job->q, job->state + STATE_Q, sizeof job->q);
#if N_TURNING
  move_to_nearest_turns(job);
#endif
  job->restarts = (int64_t) job->state[STATE_CANDIDATES_BEFORE]
                + (int64_t) clipped((double) (int64_t) job->state[STATE_CANDIDATE], 0.0,
                                    N_CANDIDATES - 1);
  return !N_EXTRA_VECTORS && job->has_verdict ? judge(job) : DONE;
}

/* Decide what follows when the iterations of a target have ended, or before they begin (UNBEGUN).
 * Returns CONTINUES after starting a restart, DONE with the result, or SLICE_OVER if the restart
 * quota of this call is used up. */
static int follow(void *method, int64_t slot, int64_t solve, int32_t *status) {
  search *job = method;
  int code, needs_restart = 0;
  (void) slot, (void) solve;
  if (*status != SOLVED_STATUS) {
    if (!job->restart_quota) return SLICE_OVER;
    needs_restart = *status == UNBEGUN || next_restart(job);
    if (*status == UNBEGUN) begin_target(job);
  }
  if (needs_restart) {
    --job->restart_quota;
    code = start_restart(job);
    return code == DONE ? CONTINUES : code;
  }
  code = finish_target(job, *status);
  *status = (int32_t) job->status;
  return code;
}

/* Run at most `steps` iterations from `state`; `next` is called when they end. Returns SLICE_OVER
 * if the solve has not ended. */
static int iterate(search *job, int64_t steps,
                   int (*next)(void *, int64_t, int64_t, int32_t *)) {
  int32_t status = (int32_t) job->loop_status;
  double seconds = 0;
  loop_job loop = {0};
  int code;
  loop.states = job->state;
  loop.parameters = job->parameters;
  loop.iterations = &job->iterations;
  loop.status = &status;
  loop.seconds = &seconds;
  loop.slots = &job->slot;
  loop.iterations_before = &job->iterations_before;
  loop.mark = job->mark;
  loop.slot_count = 1;
  loop.count = 1;
  loop.solve = job->slot < 0 ? 0 : 1;
  loop.max_iterations = BUDGET;
  loop.remaining_steps = steps;
  loop.slice = SLICE;
  loop.follow = next;
  loop.method = job;
  code = SOLVE(&loop);
  job->loop_status = status;
  return code;
}

static double length_of(const double *vector) {
  return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
}

/* Normalise a direction as `unit_vectors` does; free vectors (NaN) stay. Returns 0 if the vector is
 * neither. */
static int normalise_if_direction(double *vector) {
  double length;
  int i;
  if (vector[0] != vector[0]) return vector[1] != vector[1] && vector[2] != vector[2];
  if (!(is_finite(vector[0]) && is_finite(vector[1]) && is_finite(vector[2]))) return 0;
  length = length_of(vector);
  if (!(length >= SMALL_LENGTH && length <= LARGE_LENGTH)) {
    /* Scale by powers of two, which is exact; in two steps, since one may be out of range. */
    double largest = 0;
    int power, half;
    for (i = 0; i < 3; ++i) largest = fabs(vector[i]) > largest ? fabs(vector[i]) : largest;
    (void) frexp(largest, &power);
    half = (-power - (power & 1)) / 2;
    for (i = 0; i < 3; ++i) vector[i] = ldexp(ldexp(vector[i], half), -power - half);
    length = length_of(vector);
  }
  if (length == 0) return 0;
  if (length - 1 < UNIT && 1 - length < UNIT) return 1;
  for (i = 0; i < 3; ++i) vector[i] /= length;
  return 1;
}

/* Check the target in the job and begin its search; return 0 if it is malformed. */
static int search_begin(search *job) {
  int i, has_point = 0, is_valid = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    double *point = job->points + 3 * i, *normal = job->normals + 3 * i;
    const int is_given = is_finite(point[0]) && is_finite(point[1]) && is_finite(point[2]);
    const int is_free = !is_number(point[0]) && !is_number(point[1]) && !is_number(point[2]);
    is_valid &= is_given || (is_free && !is_number(normal[0]));
    is_valid &= normalise_if_direction(normal);
    has_point |= is_given;
  }
  for (i = 0; i < N_MOTORS; ++i) is_valid &= is_finite(job->q0[i]);
  job->slot = -1;
  job->loop_status = UNBEGUN;
  job->iterations = 0;
  job->restarts = 0;
  job->has_verdict = 1;
  job->status = RUNNING;
  return is_valid && has_point;
}

/* Continue the search for at most `steps` iterations and `rounds` restarts; `status` remains
 * RUNNING until the search has ended. */
static int search_run(search *job, int64_t steps, int64_t rounds) {
  int code;
  if (job->status != RUNNING || steps <= 0) return DONE;
  job->restart_quota = rounds;
  code = iterate(job, steps, follow);
  return code == SLICE_OVER ? DONE : code;
}
