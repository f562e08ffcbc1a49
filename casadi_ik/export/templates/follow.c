/* One cycle of a robot that follows moving contacts. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "@PREFIX@.h"

@CYCLE@
@FOLLOW_CONSTANTS@
static int is_finite(double x) { return x * 0.0 == 0.0; }

static int are_finite(const double *x, int count) {
  while (count-- > 0) {
    if (!is_finite(x[count])) return 0;
  }
  return 1;
}

/* Whether a vector is free: 1, there: 0, or none: -1. */
static int is_free(const double *vector) {
  const int missing = (vector[0] != vector[0]) + (vector[1] != vector[1]) + (vector[2] != vector[2]);
  if (missing) return missing == 3 ? 1 : -1;
  return are_finite(vector, 3) ? 0 : -1;
}

static void copied(double *to, const double *from, int count) {
  memcpy(to, from, (size_t) count * sizeof *to);
}

/* Sets the contacts of the next cycle; returns 0 if they are invalid. */
static int ask(@PREFIX@_follower *follower, const double *points, const double *normals) {
  static const double any[] = {1.0, 0.0, 0.0}, none[] = {0.0, 0.0, 0.0};
  double *asked = follower->asked;
  const double *first = 0;
  int i, k, touched = 0, coincide = 1, is_zero = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = points + 3 * i, *normal = normals + 3 * i;
    const int placeless = is_free(point), faceless = is_free(normal);
    if (placeless < 0 || faceless < 0 || (placeless && !faceless)) return 0;
    if (!faceless && normal[0] == 0 && normal[1] == 0 && normal[2] == 0) return 0;
    copied(asked + ASKED_POINTS + 3 * i, placeless ? none : point, 3);
    copied(asked + ASKED_NORMALS + 3 * i, faceless ? any : normal, 3);
    asked[ASKED_WEIGHTS + 2 * i] = placeless ? 0.0 : WEIGHTS[i][0];
    asked[ASKED_WEIGHTS + 2 * i + 1] = faceless ? 0.0 : WEIGHTS[i][1];
    touched += !placeless;
    if (placeless) continue;
    if (!first) first = point;
    for (k = 0; k < 3; ++k) {
      coincide &= point[k] == first[k];
      is_zero &= point[k] == 0;
    }
  }
  /* Contact points of a hand that a tracker has lost. */
  if (is_zero || (touched > 1 && coincide)) return 0;
  return touched;
}

#if MOVES_PALM
/* Whether a pose is a rigid motion. */
static int is_rigid(const double *r) {
  const double turned = r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6])
                      + r[2] * (r[3] * r[7] - r[4] * r[6]);
  int i, k;
  if (!are_finite(r, 12) || !(turned > 0)) return 0;
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      const double product = r[3 * i] * r[3 * k] + r[3 * i + 1] * r[3 * k + 1] + r[3 * i + 2] * r[3 * k + 2];
      if (!(fabs(product - (i == k)) < 1e-6)) return 0;
    }
  }
  return 1;
}
#endif

/* Asks for a pose of the palm, a null pointer: for none; 0: it is none. */
static int ask_palm(@PREFIX@_follower *follower, const double *palm) {
#if MOVES_PALM
  double *asked = follower->asked;
  asked[ASKED_PALM_WEIGHT] = asked[ASKED_PALM_WEIGHT + 1] = 0.0;
  if (!palm) return 1;
  if (!is_rigid(palm)) return 0;
  copied(asked + ASKED_PALM_AXES, palm, 9);
  copied(asked + ASKED_PALM_POINT, palm + 9, 3);
  asked[ASKED_PALM_WEIGHT] = asked[ASKED_PALM_WEIGHT + 1] = PALM_WEIGHT;
  return 1;
#else
  (void) follower;
  return !palm;
#endif
}

/* Asks for nothing: the motors come to rest as fast as they may. */
static void ask_rest(@PREFIX@_follower *follower) {
  double *state = follower->state;
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    memset(follower->asked + ASKED_POINTS + 3 * i, 0, 3 * sizeof(double));
    copied(follower->asked + ASKED_NORMALS + 3 * i, (const double[]){1.0, 0.0, 0.0}, 3);
  }
  memset(follower->asked + ASKED_WEIGHTS, 0, 2 * N_FINGERS * sizeof(double));
  (void) ask_palm(follower, 0);
  for (i = 0; i < N_MOTORS; ++i) {
    const double moved = state[STATE_MOVED + i], change = follower->change[i];
    const double speed = fabs(moved), steps = floor(speed / change);
    const double way = speed * steps - change * steps * (steps + 1) / 2;
    state[STATE_GOAL + i] = state[STATE_Q + i] + (moved < 0 ? -way : way);
  }
  state[STATE_LOCKED_ON] = 0.0;
}

/* Computes a step; returns 0 if a number was out of range. */
static int compute_step(@PREFIX@_follower *follower, const double *state) {
  const double *arg[] = {state, follower->asked};
  double *res[] = {follower->after, follower->record};
  STEP(arg, res, 0);
  return is_finite(follower->record[RECORD_SOUND]);
}

/* Computes a step from rest at a posture; returns 0 if a number was out of range. */
static int compute_step_from_rest(@PREFIX@_follower *follower, const double *q) {
  double state[sizeof follower->state / sizeof(double)];
  memset(state, 0, sizeof state);
  copied(state + STATE_Q, q, N_MOTORS);
  copied(state + STATE_GOAL, q, N_MOTORS);
  return compute_step(follower, state);
}

/* The way back of a follower that is stuck, as in motion/recovery.py; all lines are free. */
static double distance(const double *a, const double *b) {
  double largest = 0;
  int i;
  for (i = 0; i < N_MOTORS; ++i) largest = fmax(largest, fabs(a[i] - b[i]) / UNITS[i]);
  return largest;
}

static double brake(double distance, double change) {
  const double u = distance / change, steps = floor((sqrt(1 + 8 * u) - 1) / 2);
  return change * (u + steps * (steps + 1) / 2) / (steps + 1);
}

static void start_clock(@PREFIX@_recovery *recovery, double least) {
  recovery->least = least;
  recovery->cycles_stuck = 0;
  recovery->candidate = -1;
}

static void follow_contacts(@PREFIX@_recovery *recovery) {
  recovery->is_returning = recovery->has_line = 0;
  start_clock(recovery, INFINITY);
}

/* Computes the next step of the motors on their way back. */
static void next_step(@PREFIX@_follower *follower, double *step) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double *state = follower->state;
  double limit, share;
  int i;
  if (!recovery->has_line) {
    for (i = 0; i < N_MOTORS; ++i) {
      const double last = state[STATE_MOVED + i];
      const double speed = fmax(fabs(last) - follower->change[i], 0.0);
      step[i] = last < 0 ? -speed : speed;
    }
    return;
  }
  limit = fmin(recovery->line_fastest, recovery->line_step + recovery->line_change);
  recovery->next_step = fmin(limit, brake(fmax(1.0 - recovery->done, 0.0), recovery->line_change));
  share = recovery->done + recovery->next_step;
  for (i = 0; i < N_MOTORS; ++i) {
    step[i] = recovery->start[i] + share * recovery->line[i] - state[STATE_Q + i];
  }
}

/* Adds a posture to the trail if it is far enough from the last one; a trail that comes back to
 * itself is cut off there. */
static void extend_trail(@PREFIX@_recovery *recovery, const double *q) {
  double last = distance(recovery->trail[recovery->count - 1], q);
  int64_t i;
  if (last > TRAIL_SPACING) {
    for (i = 0; i < recovery->count && distance(recovery->trail[i], q) > TRAIL_SPACING; ++i) {
    }
    if (i < recovery->count) {
      recovery->count = i + 1;
      if (recovery->candidate > i) recovery->candidate = i;
      last = distance(recovery->trail[i], q);
    } else {
      if (recovery->count == TRAIL_CAPACITY) {
        recovery->count = TRAIL_CAPACITY / 2;
        for (i = 1; i < recovery->count; ++i) {
          copied(recovery->trail[i], recovery->trail[2 * i], N_MOTORS);
        }
        recovery->destination /= 2;
        if (recovery->candidate > 0) recovery->candidate /= 2;
      }
      copied(recovery->trail[recovery->count++], q, N_MOTORS);
      last = 0;
    }
  }
  last = fmin(floor((TRAIL_SPACING - last) / recovery->longest_step), 1e9);
  recovery->cycles_to_check = last < recovery->check_cycles ? recovery->check_cycles : (int64_t) last;
}

/* Compares postures of the trail once the error has not decreased for a while. */
static void look_for_progress(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double ratio = follower->record[RECORD_ERROR_RATIO];
  double record[sizeof follower->record / sizeof(double)];
  int64_t i;
  if (ratio < TRAIL_PROGRESS * recovery->least) {
    start_clock(recovery, ratio);
    return;
  }
  if (++recovery->cycles_stuck <= recovery->patience) return;
  if (recovery->candidate < 0) {
    recovery->candidate = recovery->count - 1;
    recovery->least_ratio = INFINITY;
  }
  memcpy(record, follower->record, sizeof record);
  for (i = 0; i < recovery->comparisons && recovery->candidate >= 0; ++i, --recovery->candidate) {
    (void) compute_step_from_rest(follower, recovery->trail[recovery->candidate]);
    if (follower->record[RECORD_ERROR_RATIO] < TRAIL_GAIN * recovery->least_ratio) {
      recovery->least_ratio = follower->record[RECORD_ERROR_RATIO];
      recovery->destination = recovery->candidate;
    }
  }
  memcpy(follower->record, record, sizeof record);
  if (recovery->candidate >= 0) return;
  start_clock(recovery, ratio);
  recovery->is_returning = recovery->least_ratio < TRAIL_GAIN * ratio;
  recovery->has_line = 0;
}

/* Begins the line to the destination if the motors are at rest. */
static void begin_line(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    if (follower->state[STATE_MOVED + i] != 0) return;
  }
  recovery->line_fastest = recovery->line_change = INFINITY;
  recovery->done = recovery->line_step = 0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double q = follower->state[STATE_Q + i];
    const double way = recovery->trail[recovery->destination][i] - q, length = fabs(way);
    recovery->start[i] = q;
    recovery->line[i] = way;
    if (length > 0) {
      recovery->line_fastest = fmin(recovery->line_fastest, follower->asked[ASKED_FASTEST + i] / length);
      recovery->line_change = fmin(recovery->line_change, follower->change[i] / length);
    }
  }
  if (recovery->line_fastest < INFINITY) recovery->has_line = 1;
  else follow_contacts(recovery);
}

/* Takes the result of a cycle. */
static void update_recovery(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  if (recovery->is_returning) {
    if (!recovery->has_line) {
      begin_line(follower);
      return;
    }
    recovery->done += recovery->next_step;
    recovery->line_step = recovery->next_step;
    if (recovery->done >= 1.0 - 1e-12) {
      recovery->count = recovery->destination + 1;
      recovery->cycles_to_check = 1;
      follow_contacts(recovery);
    }
    return;
  }
  if (--recovery->cycles_to_check <= 0) extend_trail(recovery, follower->state + STATE_Q);
  if (follower->record[RECORD_ERROR_RATIO] > 1 + TOLERANCE_SLACK
      && follower->record[RECORD_GOAL_ERROR_RATIO] > 1 + TOLERANCE_SLACK) {
    look_for_progress(follower);
  } else {
    start_clock(recovery, INFINITY);
  }
}

/* One step; returns 0 if a number was out of range, and leaves the state as it was. */
static int step(@PREFIX@_follower *follower) {
  if (follower->recovery.is_returning) {
    double way[N_MOTORS], q[N_MOTORS];
    int i;
    next_step(follower, way);
    for (i = 0; i < N_MOTORS; ++i) q[i] = follower->state[STATE_Q + i] + way[i];
    if (!compute_step_from_rest(follower, q)) return 0;
    copied(follower->after + STATE_Q, q, N_MOTORS);
    copied(follower->after + STATE_MOVED, way, N_MOTORS);
    copied(follower->after + STATE_GOAL, q, N_MOTORS);
    follower->after[STATE_LOCKED_ON] = 0.0;
  } else if (!compute_step(follower, follower->state)) {
    return 0;
  }
  memcpy(follower->state, follower->after, sizeof follower->state);
  return 1;
}

static int is_met(const @PREFIX@_follower *follower, int position, int angle) {
  int i, met = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *asked = follower->asked, *told = follower->record;
    met &= told[position + i] <= asked[ASKED_POSITION_TOLERANCE + i] * (1 + TOLERANCE_SLACK);
    met &= told[angle + i] <= asked[ASKED_ANGLE_TOLERANCE + i] * (1 + TOLERANCE_SLACK);
  }
  return met;
}

int @PREFIX@_follow_from(@PREFIX@_follower *follower, const double *q0, double period,
                         const double *velocity, const double *acceleration) {
  double *asked = follower->asked;
  const double kept = exp(-period / SETTLING);
  int i, sound = period > 0 && is_finite(period);
  memset(follower, 0, sizeof *follower);
  follower->period = period;
  copied(asked + ASKED_POSITION_TOLERANCE, POSITION_TOLERANCES, N_FINGERS);
  copied(asked + ASKED_ANGLE_TOLERANCE, ANGLE_TOLERANCES, N_FINGERS);
  copied(asked + ASKED_LOWER, LOWER, N_MOTORS);
  copied(asked + ASKED_UPPER, UPPER, N_MOTORS);
  asked[ASKED_PULL] = PULL;
  asked[ASKED_KEEP] = kept * kept;
  asked[ASKED_DRIFT] = (1 - kept) * (1 - kept);
  asked[ASKED_PATIENCE] = exp(-period / FADING);
  for (i = 0; i < N_MOTORS; ++i) {
    const double fastest = velocity ? velocity[i] : VELOCITY[i];
    const double change = acceleration ? acceleration[i] : fastest / RUN_UP;
    double q = q0 ? q0[i] : HOME[i];
    sound &= is_finite(q) && is_finite(fastest) && fastest > 0 && is_finite(change) && change > 0;
    asked[ASKED_POSTURE + i] = q;
    q = q > LOWER[i] ? q : LOWER[i];
    q = q < UPPER[i] ? q : UPPER[i];
    asked[ASKED_FASTEST + i] = fastest * period;
    asked[ASKED_CHANGE + i] = follower->change[i] = change * (period * period);
    follower->q[i] = follower->state[STATE_Q + i] = follower->state[STATE_GOAL + i] = q;
  }
  follower->state[STATE_LOCKED_ON] = 1.0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double longest = asked[ASKED_FASTEST + i] / UNITS[i];
    follower->recovery.longest_step = fmax(follower->recovery.longest_step, longest);
  }
  follower->recovery.patience = sound ? (int64_t) fmin(ceil(TRAIL_PATIENCE / period), 1e9) : 0;
  follower->recovery.check_cycles =
      sound ? (int64_t) fmax(fmin(floor(TRAIL_CHECK_PERIOD / period), 1e9), 1.0) : 1;
  follower->recovery.comparisons =
      sound ? (int64_t) fmin(ceil(TRAIL_CAPACITY * period / TRAIL_SEARCH_TIME), TRAIL_CAPACITY) : 0;
  copied(follower->recovery.trail[0], follower->q, N_MOTORS);
  follower->recovery.count = follower->recovery.cycles_to_check = 1;
  follow_contacts(&follower->recovery);
  return sound ? 0 : @GUARD@_BAD_INPUT;
}

int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm) {
  int i, told = ask(follower, points, normals) && ask_palm(follower, palm) && step(follower);
  if (!told) {
    follow_contacts(&follower->recovery);
    ask_rest(follower);
    (void) step(follower);
  }
  for (i = 0; i < N_MOTORS; ++i) {
    follower->q[i] = follower->state[STATE_Q + i];
    follower->velocity[i] = follower->state[STATE_MOVED + i] / follower->period;
  }
  copied(follower->position_error, follower->record + RECORD_POSITION_ERROR, N_FINGERS);
  copied(follower->angle_error, follower->record + RECORD_ANGLE_ERROR, N_FINGERS);
  if (told) update_recovery(follower);
  follower->status = !told ? @GUARD@_HOLDING
      : is_met(follower, RECORD_POSITION_ERROR, RECORD_ANGLE_ERROR) ? @GUARD@_FOLLOWING
      : is_met(follower, RECORD_GOAL_POSITION_ERROR, RECORD_GOAL_ANGLE_ERROR) ? @GUARD@_LATE
      : @GUARD@_MISSED;
  return (int) follower->status;
}
