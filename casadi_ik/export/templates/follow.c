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

/* Returns 1 if a vector is free (all NaN), 0 if it is set (all finite), -1 if it is invalid. */
static int free_state(const double *vector) {
  const int missing = (vector[0] != vector[0]) + (vector[1] != vector[1]) + (vector[2] != vector[2]);
  if (missing) return missing == 3 ? 1 : -1;
  return are_finite(vector, 3) ? 0 : -1;
}

static void copy(double *to, const double *from, int count) {
  memcpy(to, from, (size_t) count * sizeof *to);
}

/* Sets the contacts of the next cycle; returns the number of contact points, 0 if the contacts are
 * invalid or have no point. */
static int set_contacts(@PREFIX@_follower *follower, const double *points, const double *normals) {
  static const double any[] = {1.0, 0.0, 0.0}, none[] = {0.0, 0.0, 0.0};
  double *parameters = follower->parameters;
  const double *first = 0;
  int i, k, n_points = 0, coincide = 1, is_zero = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = points + 3 * i, *normal = normals + 3 * i;
    const int is_point_free = free_state(point), is_normal_free = free_state(normal);
    if (is_point_free < 0 || is_normal_free < 0 || (is_point_free && !is_normal_free)) return 0;
    if (!is_normal_free && normal[0] == 0 && normal[1] == 0 && normal[2] == 0) return 0;
    copy(parameters + PARAMETER_POINTS + 3 * i, is_point_free ? none : point, 3);
    copy(parameters + PARAMETER_NORMALS + 3 * i, is_normal_free ? any : normal, 3);
    parameters[PARAMETER_WEIGHTS + 2 * i] = is_point_free ? 0.0 : WEIGHTS[i][0];
    parameters[PARAMETER_WEIGHTS + 2 * i + 1] = is_normal_free ? 0.0 : WEIGHTS[i][1];
    n_points += !is_point_free;
    if (is_point_free) continue;
    if (!first) first = point;
    for (k = 0; k < 3; ++k) {
      coincide &= point[k] == first[k];
      is_zero &= point[k] == 0;
    }
  }
  /* A tracker that has lost the hand reports points that are all zero or all the same. */
  if (is_zero || (n_points > 1 && coincide)) return 0;
  return n_points;
}

#if MOVES_PALM
/* Returns 1 if a pose (its three axes, then its position) is a rigid motion. */
static int is_rigid(const double *r) {
  const double determinant = r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6])
                      + r[2] * (r[3] * r[7] - r[4] * r[6]);
  int i, k;
  if (!are_finite(r, 12) || !(determinant > 0)) return 0;
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      const double product = r[3 * i] * r[3 * k] + r[3 * i + 1] * r[3 * k + 1] + r[3 * i + 2] * r[3 * k + 2];
      if (!(fabs(product - (i == k)) < 1e-6)) return 0;
    }
  }
  return 1;
}
#endif

/* Sets the target pose of the palm; a null pointer removes it. Returns 0 if the pose is invalid. */
static int set_palm(@PREFIX@_follower *follower, const double *palm) {
#if MOVES_PALM
  double *parameters = follower->parameters;
  parameters[PARAMETER_PALM_WEIGHT] = parameters[PARAMETER_PALM_WEIGHT + 1] = 0.0;
  if (!palm) return 1;
  if (!is_rigid(palm)) return 0;
  copy(parameters + PARAMETER_PALM_AXES, palm, 9);
  copy(parameters + PARAMETER_PALM_POINT, palm + 9, 3);
  parameters[PARAMETER_PALM_WEIGHT] = parameters[PARAMETER_PALM_WEIGHT + 1] = PALM_WEIGHT;
  return 1;
#else
  (void) follower;
  return !palm;
#endif
}

/* Computes the nearest positions at which the motors can come to rest. */
static void posture_at_rest(const @PREFIX@_follower *follower, double *q) {
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    const double last_step = follower->state[STATE_LAST_STEP + i], change = follower->max_change[i];
    const double speed = fabs(last_step), steps = floor(speed / change);
    const double stopping_distance = speed * steps - change * steps * (steps + 1) / 2;
    q[i] = follower->state[STATE_Q + i] + (last_step < 0 ? -stopping_distance : stopping_distance);
  }
}

/* Removes the target: the motors decelerate to rest. */
static void clear_target(@PREFIX@_follower *follower) {
  double *state = follower->state;
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    memset(follower->parameters + PARAMETER_POINTS + 3 * i, 0, 3 * sizeof(double));
    copy(follower->parameters + PARAMETER_NORMALS + 3 * i, (const double[]){1.0, 0.0, 0.0}, 3);
  }
  memset(follower->parameters + PARAMETER_WEIGHTS, 0, 2 * N_FINGERS * sizeof(double));
  (void) set_palm(follower, 0);
  posture_at_rest(follower, state + STATE_GOAL);
  state[STATE_LOCKED_ON] = 0.0;
}

/* Computes a step; returns 0 if the result is not finite. */
static int compute_step(@PREFIX@_follower *follower, const double *state) {
  const double *arg[] = {state, follower->parameters};
  double *res[] = {follower->new_state, follower->record};
  STEP(arg, res, 0);
  return is_finite(follower->record[RECORD_CHECKSUM]);
}

/* Computes a step from rest at a posture; returns 0 if the result is not finite. */
static int compute_step_from_rest(@PREFIX@_follower *follower, const double *q) {
  double state[sizeof follower->state / sizeof(double)];
  memset(state, 0, sizeof state);
  copy(state + STATE_Q, q, N_MOTORS);
  copy(state + STATE_GOAL, q, N_MOTORS);
  return compute_step(follower, state);
}

/* Computes the contacts and the palm of a posture as the residual of a target at the origin, with
 * normals (1, 0, 0): points over LENGTH, normals minus (1, 0, 0), palm point over LENGTH, and
 * palm axes. */
static void measure(@PREFIX@_follower *follower, const double *q, double *residual) {
  double parameters[sizeof follower->parameters / sizeof(double)];
  double record[sizeof follower->record / sizeof(double)];
  int i;
  memcpy(parameters, follower->parameters, sizeof parameters);
  memcpy(record, follower->record, sizeof record);
  for (i = 0; i < 2 * N_FINGERS; ++i) follower->parameters[PARAMETER_WEIGHTS + i] = 1.0;
  for (i = 0; i < N_FINGERS; ++i) {
    memset(follower->parameters + PARAMETER_POINTS + 3 * i, 0, 3 * sizeof(double));
    copy(follower->parameters + PARAMETER_NORMALS + 3 * i, (const double[]){1.0, 0.0, 0.0}, 3);
  }
#if MOVES_PALM
  memset(follower->parameters + PARAMETER_PALM_POINT, 0, 3 * sizeof(double));
  memset(follower->parameters + PARAMETER_PALM_AXES, 0, 9 * sizeof(double));
  follower->parameters[PARAMETER_PALM_WEIGHT] = follower->parameters[PARAMETER_PALM_WEIGHT + 1] = 1.0;
#endif
  copy(follower->parameters + PARAMETER_LOWER, q, N_MOTORS);
  copy(follower->parameters + PARAMETER_UPPER, q, N_MOTORS);
  (void) compute_step_from_rest(follower, q);
  copy(residual, follower->new_state + STATE_RESIDUAL, N_RESIDUALS);
  memcpy(follower->parameters, parameters, sizeof parameters);
  memcpy(follower->record, record, sizeof record);
}

/* Computes the smallest rotation that turns a vector into the direction of another. */
static void turn_between(const double *a, const double *b, double *turn) {
  const double length = sqrt((a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2]));
  const double cosine = (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / length;
  double v[3] = {(a[1] * b[2] - a[2] * b[1]) / length, (a[2] * b[0] - a[0] * b[2]) / length,
                 (a[0] * b[1] - a[1] * b[0]) / length};
  const int opposite = cosine < -1 + 1e-12;
  int i, k;
  if (opposite) {
    const int least = fabs(a[0]) <= fabs(a[1]) && fabs(a[0]) <= fabs(a[2]) ? 0 : fabs(a[1]) <= fabs(a[2]) ? 1 : 2;
    const double e[3] = {least == 0, least == 1, least == 2};
    const double x = a[1] * e[2] - a[2] * e[1], y = a[2] * e[0] - a[0] * e[2], z = a[0] * e[1] - a[1] * e[0];
    const double size = sqrt(x * x + y * y + z * z);
    v[0] = x / size;
    v[1] = y / size;
    v[2] = z / size;
  }
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      const double product = v[i] * v[k];
      turn[3 * i + k] = opposite ? 2 * product - (i == k) : product / (1 + cosine) + (i == k ? cosine : 0.0);
    }
  }
  if (opposite) return;
  turn[1] -= v[2];
  turn[2] += v[1];
  turn[3] += v[2];
  turn[5] -= v[0];
  turn[6] -= v[1];
  turn[7] += v[0];
}

/* Displaces the target by the offsets and turns since the follower was resumed. A contact or palm
 * that is new gets an offset and turn that lead to the posture at which the motors can rest. */
static void displace(@PREFIX@_follower *follower) {
  double *parameters = follower->parameters, *weights = parameters + PARAMETER_WEIGHTS;
  int i, k, is_new = 0;
  for (i = 0; i < N_FINGERS; ++i) {
    is_new |= weights[2 * i] > 0 && !follower->has_offset[i];
    is_new |= weights[2 * i + 1] > 0 && !follower->has_turn[i];
  }
#if MOVES_PALM
  is_new |= parameters[PARAMETER_PALM_WEIGHT] > 0 && !follower->has_palm;
#endif
  if (is_new) {
    double q[N_MOTORS], residual[N_RESIDUALS];
    posture_at_rest(follower, q);
    measure(follower, q, residual);
    for (i = 0; i < N_FINGERS; ++i) {
      const double *point = parameters + PARAMETER_POINTS + 3 * i, *normal = parameters + PARAMETER_NORMALS + 3 * i;
      if (weights[2 * i] > 0 && !follower->has_offset[i]) {
        for (k = 0; k < 3; ++k) follower->offsets[i][k] = LENGTH * residual[3 * i + k] - point[k];
        follower->has_offset[i] = 1;
      }
      if (weights[2 * i + 1] > 0 && !follower->has_turn[i]) {
        const double *row = residual + 3 * N_FINGERS + 3 * i;
        turn_between(normal, (const double[]){row[0] + 1.0, row[1], row[2]}, follower->turns[i]);
        follower->has_turn[i] = 1;
      }
    }
#if MOVES_PALM
    if (parameters[PARAMETER_PALM_WEIGHT] > 0 && !follower->has_palm) {
      const double *palm = residual + N_RESIDUALS - 12, *axes = parameters + PARAMETER_PALM_AXES;
      int row;
      for (row = 0; row < 3; ++row) {
        follower->palm_offset[row] = LENGTH * palm[row] - parameters[PARAMETER_PALM_POINT + row];
        for (k = 0; k < 3; ++k) {
          follower->palm_turn[3 * row + k] = axes[row] * palm[3 + 3 * k] + axes[3 + row] * palm[3 + 3 * k + 1]
                                             + axes[6 + row] * palm[3 + 3 * k + 2];
        }
      }
      follower->has_palm = 1;
    }
#endif
  }
  for (i = 0; i < N_FINGERS; ++i) {
    double *point = parameters + PARAMETER_POINTS + 3 * i, *normal = parameters + PARAMETER_NORMALS + 3 * i;
    const double *turn = follower->turns[i], n[3] = {normal[0], normal[1], normal[2]};
    for (k = 0; k < 3; ++k) {
      if (weights[2 * i] > 0) point[k] += follower->offsets[i][k];
      if (weights[2 * i + 1] > 0) normal[k] = turn[3 * k] * n[0] + turn[3 * k + 1] * n[1] + turn[3 * k + 2] * n[2];
    }
  }
#if MOVES_PALM
  if (parameters[PARAMETER_PALM_WEIGHT] > 0) {
    double axes[9], *target = parameters + PARAMETER_PALM_AXES;
    const double *turn = follower->palm_turn;
    copy(axes, target, 9);
    for (i = 0; i < 3; ++i) {
      parameters[PARAMETER_PALM_POINT + i] += follower->palm_offset[i];
      for (k = 0; k < 3; ++k) {
        target[3 * i + k] = axes[3 * i] * turn[k] + axes[3 * i + 1] * turn[3 + k] + axes[3 * i + 2] * turn[6 + k];
      }
    }
  }
#endif
}

/* Recovery of a follower that is stuck, as in motion/recovery.py without collision checks: every
 * straight line between two postures counts as free. */

/* Returns the distance of two postures: the largest difference of a motor in its unit. */
static double distance(const double *a, const double *b) {
  double largest = 0;
  int i;
  for (i = 0; i < N_MOTORS; ++i) largest = fmax(largest, fabs(a[i] - b[i]) / UNITS[i]);
  return largest;
}

/* Returns the largest step that ends at a distance if each later step is smaller by a change. */
static double brake(double distance, double change) {
  const double u = distance / change, steps = floor((sqrt(1 + 8 * u) - 1) / 2);
  return change * (u + steps * (steps + 1) / 2) / (steps + 1);
}

/* Restarts the count of cycles in which the error does not decrease. */
static void start_clock(@PREFIX@_recovery *recovery, double least_ratio) {
  recovery->least_since = least_ratio;
  recovery->cycles_stuck = 0;
  recovery->candidate = -1;
}

static void follow_contacts(@PREFIX@_recovery *recovery) {
  recovery->is_returning = recovery->has_line = 0;
  start_clock(recovery, INFINITY);
}

/* Computes the next step of motors that brake, or that return along the line. */
static void next_step(@PREFIX@_follower *follower, double *step) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double *state = follower->state;
  double limit, share;
  int i;
  if (follower->is_paused || !recovery->has_line) {
    for (i = 0; i < N_MOTORS; ++i) {
      const double last_step = state[STATE_LAST_STEP + i];
      const double speed = fmax(fabs(last_step) - follower->max_change[i], 0.0);
      step[i] = last_step < 0 ? -speed : speed;
    }
    return;
  }
  limit = fmin(recovery->line_max_step, recovery->line_step + recovery->line_change);
  recovery->next_step = fmin(limit, brake(fmax(1.0 - recovery->done, 0.0), recovery->line_change));
  share = recovery->done + recovery->next_step;
  for (i = 0; i < N_MOTORS; ++i) {
    step[i] = recovery->start[i] + share * recovery->line[i] - state[STATE_Q + i];
  }
}

/* Adds a posture to the trail if it is far enough from the last one; a trail that comes back to
 * itself is cut off there. */
static void extend_trail(@PREFIX@_recovery *recovery, const double *q) {
  double from_last = distance(recovery->trail[recovery->count - 1], q);
  double cycles;
  int64_t i;
  if (from_last > TRAIL_SPACING) {
    for (i = 0; i < recovery->count && distance(recovery->trail[i], q) > TRAIL_SPACING; ++i) {
    }
    if (i < recovery->count) {
      recovery->count = i + 1;
      if (recovery->candidate > i) recovery->candidate = i;
      from_last = distance(recovery->trail[i], q);
    } else {
      if (recovery->count == TRAIL_CAPACITY) {
        recovery->count = TRAIL_CAPACITY / 2;
        for (i = 1; i < recovery->count; ++i) {
          copy(recovery->trail[i], recovery->trail[2 * i], N_MOTORS);
        }
        recovery->destination /= 2;
        if (recovery->candidate > 0) recovery->candidate /= 2;
      }
      copy(recovery->trail[recovery->count++], q, N_MOTORS);
      from_last = 0;
    }
  }
  cycles = fmin(floor((TRAIL_SPACING - from_last) / recovery->longest_step), 1e9);
  recovery->cycles_to_check = cycles < recovery->check_cycles ? recovery->check_cycles : (int64_t) cycles;
}

/* Once the error has not decreased for a while, searches the trail for a posture from which it gets
 * smaller, and starts the return to that posture. */
static void check_progress(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  const double ratio = follower->record[RECORD_ERROR_RATIO];
  double record[sizeof follower->record / sizeof(double)];
  int64_t i;
  if (ratio < TRAIL_PROGRESS * recovery->least_since) {
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

/* Starts the line to the destination if the motors are at rest. */
static void start_line(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    if (follower->state[STATE_LAST_STEP + i] != 0) return;
  }
  recovery->line_max_step = recovery->line_change = INFINITY;
  recovery->done = recovery->line_step = 0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double q = follower->state[STATE_Q + i];
    const double line = recovery->trail[recovery->destination][i] - q, length = fabs(line);
    recovery->start[i] = q;
    recovery->line[i] = line;
    if (length > 0) {
      recovery->line_max_step = fmin(recovery->line_max_step, follower->parameters[PARAMETER_MAX_STEP + i] / length);
      recovery->line_change = fmin(recovery->line_change, follower->max_change[i] / length);
    }
  }
  if (recovery->line_max_step < INFINITY) recovery->has_line = 1;
  else follow_contacts(recovery);
}

/* Advances a return after a cycle, or extends the trail and checks the progress. */
static void update_recovery(@PREFIX@_follower *follower) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  if (recovery->is_returning) {
    if (!recovery->has_line) {
      start_line(follower);
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
    if (recovery->has_met) check_progress(follower);
  } else {
    recovery->has_met = 1;
    start_clock(recovery, INFINITY);
  }
}

/* Sets bounds that lead motors beyond their limits back to them. */
static void return_to_limits(@PREFIX@_follower *follower) {
  double *parameters = follower->parameters;
  int i;
  follower->is_beyond_limits = 0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double q = follower->state[STATE_Q + i], change = BRAKING_SHARE * follower->max_change[i];
    const double way = fmin(fmax(q, LOWER[i]), UPPER[i]) - q, direction = (way > 0) - (way < 0);
    const double step = fmin(fmax(direction * follower->state[STATE_LAST_STEP + i], 0.0) + change,
                             RETURN_SHARE * parameters[PARAMETER_MAX_STEP + i]);
    const double next = q + direction * fmin(step, brake(fabs(way), change));
    parameters[PARAMETER_LOWER + i] = fmin(LOWER[i], next);
    parameters[PARAMETER_UPPER + i] = fmax(UPPER[i], next);
    follower->is_beyond_limits |= way != 0;
  }
}

/* Makes a step; returns 0, with the state unchanged, if the result is not finite. */
static int step(@PREFIX@_follower *follower) {
  if (follower->is_beyond_limits) return_to_limits(follower);
  if (follower->is_paused || follower->recovery.is_returning) {
    double motor_steps[N_MOTORS], q[N_MOTORS];
    int i;
    next_step(follower, motor_steps);
    for (i = 0; i < N_MOTORS; ++i) q[i] = follower->state[STATE_Q + i] + motor_steps[i];
    if (!compute_step_from_rest(follower, q)) return 0;
    copy(follower->new_state + STATE_Q, q, N_MOTORS);
    copy(follower->new_state + STATE_LAST_STEP, motor_steps, N_MOTORS);
    copy(follower->new_state + STATE_GOAL, q, N_MOTORS);
    follower->new_state[STATE_LOCKED_ON] = 0.0;
  } else if (!compute_step(follower, follower->state)) {
    return 0;
  }
  memcpy(follower->state, follower->new_state, sizeof follower->state);
  return 1;
}

static int is_met(const @PREFIX@_follower *follower, int position, int angle) {
  int i, met = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *parameters = follower->parameters, *record = follower->record;
    met &= record[position + i] <= parameters[PARAMETER_POSITION_TOLERANCE + i] * (1 + TOLERANCE_SLACK);
    met &= record[angle + i] <= parameters[PARAMETER_ANGLE_TOLERANCE + i] * (1 + TOLERANCE_SLACK);
  }
  return met;
}

/* Restarts at rest at q, which may be beyond the limits. */
static void restart(@PREFIX@_follower *follower, const double *q) {
  @PREFIX@_recovery *recovery = &follower->recovery;
  int i;
  memset(follower->state, 0, sizeof follower->state);
  for (i = 0; i < N_MOTORS; ++i) {
    follower->q[i] = follower->state[STATE_Q + i] = follower->state[STATE_GOAL + i] = q[i];
    recovery->trail[0][i] = fmin(fmax(q[i], LOWER[i]), UPPER[i]);
  }
  follower->state[STATE_LOCKED_ON] = 1.0;
  follower->is_beyond_limits = 1;
  recovery->count = recovery->cycles_to_check = 1;
  recovery->has_met = recovery->destination = 0;
  follow_contacts(recovery);
}

void @PREFIX@_pause(@PREFIX@_follower *follower) { follower->is_paused = 1; }

int @PREFIX@_follow_posture(@PREFIX@_follower *follower, const double *q) {
  int i;
  if (!are_finite(q, N_MOTORS)) return @GUARD@_BAD_INPUT;
  for (i = 0; i < N_MOTORS; ++i) follower->parameters[PARAMETER_POSTURE + i] = fmin(fmax(q[i], LOWER[i]), UPPER[i]);
  return 0;
}

int @PREFIX@_resume(@PREFIX@_follower *follower, const double *q) {
  double q_rest[N_MOTORS];
  if (q && !are_finite(q, N_MOTORS)) return @GUARD@_BAD_INPUT;
  if (q) restart(follower, q);
  follower->is_paused = follower->has_palm = 0;
  follower->is_relative = 1;
  memset(follower->has_offset, 0, sizeof follower->has_offset);
  memset(follower->has_turn, 0, sizeof follower->has_turn);
  posture_at_rest(follower, q_rest);
  return @PREFIX@_follow_posture(follower, q_rest);
}

int @PREFIX@_follow_from(@PREFIX@_follower *follower, const double *q0, double period,
                         const double *velocity, const double *acceleration) {
  double *parameters = follower->parameters;
  const double decay = exp(-period / SETTLING);
  int i, is_valid = period > 0 && is_finite(period);
  memset(follower, 0, sizeof *follower);
  follower->period = period;
  copy(parameters + PARAMETER_POSITION_TOLERANCE, POSITION_TOLERANCES, N_FINGERS);
  copy(parameters + PARAMETER_ANGLE_TOLERANCE, ANGLE_TOLERANCES, N_FINGERS);
  copy(parameters + PARAMETER_LOWER, LOWER, N_MOTORS);
  copy(parameters + PARAMETER_UPPER, UPPER, N_MOTORS);
  parameters[PARAMETER_PULL] = PULL;
  parameters[PARAMETER_MOMENTUM] = decay * decay;
  parameters[PARAMETER_SPRING] = (1 - decay) * (1 - decay);
  parameters[PARAMETER_ERROR_DECAY] = exp(-period / ERROR_TIME);
  for (i = 0; i < N_MOTORS; ++i) {
    const double max_velocity = velocity ? velocity[i] : VELOCITY[i];
    const double max_acceleration = acceleration ? acceleration[i] : max_velocity / RUN_UP;
    const double q = q0 ? q0[i] : HOME[i];
    is_valid &= is_finite(q) && is_finite(max_velocity) && max_velocity > 0 && is_finite(max_acceleration)
                && max_acceleration > 0;
    parameters[PARAMETER_POSTURE + i] = q;
    parameters[PARAMETER_MAX_STEP + i] = max_velocity * period;
    parameters[PARAMETER_MAX_CHANGE + i] = follower->max_change[i] = max_acceleration * (period * period);
  }
  for (i = 0; i < N_MOTORS; ++i) {
    const double longest = parameters[PARAMETER_MAX_STEP + i] / UNITS[i];
    follower->recovery.longest_step = fmax(follower->recovery.longest_step, longest);
  }
  follower->recovery.patience = is_valid ? (int64_t) fmin(ceil(TRAIL_PATIENCE / period), 1e9) : 0;
  follower->recovery.check_cycles =
      is_valid ? (int64_t) fmax(fmin(floor(TRAIL_CHECK_PERIOD / period), 1e9), 1.0) : 1;
  follower->recovery.comparisons =
      is_valid ? (int64_t) fmin(ceil(TRAIL_CAPACITY * period / TRAIL_SEARCH_TIME), TRAIL_CAPACITY) : 0;
  restart(follower, q0 ? q0 : HOME);
  return is_valid ? 0 : @GUARD@_BAD_INPUT;
}

int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm) {
  int i, is_valid = !follower->is_paused && set_contacts(follower, points, normals) && set_palm(follower, palm);
  if (is_valid && follower->is_relative) displace(follower);
  is_valid = is_valid && step(follower);
  if (!is_valid) {
    follow_contacts(&follower->recovery);
    clear_target(follower);
    (void) step(follower);
  }
  for (i = 0; i < N_MOTORS; ++i) {
    follower->q[i] = follower->state[STATE_Q + i];
    follower->velocity[i] = follower->state[STATE_LAST_STEP + i] / follower->period;
  }
  copy(follower->position_error, follower->record + RECORD_POSITION_ERROR, N_FINGERS);
  copy(follower->angle_error, follower->record + RECORD_ANGLE_ERROR, N_FINGERS);
  if (is_valid) update_recovery(follower);
  follower->status = !is_valid ? @GUARD@_HOLDING
      : is_met(follower, RECORD_POSITION_ERROR, RECORD_ANGLE_ERROR) ? @GUARD@_FOLLOWING
      : is_met(follower, RECORD_GOAL_POSITION_ERROR, RECORD_GOAL_ANGLE_ERROR) ? @GUARD@_LATE
      : @GUARD@_MISSED;
  return (int) follower->status;
}
