/* A follower of moving contacts: one call per cycle, from targets to motor positions.
 *
 * The graph STEP computes a cycle, (state, parameters) -> (new state, record). STATE_..., PARAMETER_... and
 * RECORD_... are the offsets of the fields, which casadi_ik/motion/cycle.py defines. Velocities are
 * expressed as steps, the motion of a motor in one cycle [rad or m], and accelerations as changes of a step
 * from cycle to cycle. Error ratios are errors over their tolerances. */
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

static void copy(double *to, const double *from, int count) {
  memcpy(to, from, (size_t) count * sizeof *to);
}

enum { VECTOR_INVALID, VECTOR_FREE, VECTOR_SET };

/* Returns the kind of a vector of a frame: free if all its numbers are NaN, set if all are finite. */
static int vector_kind(const double *vector) {
  const int n_nan = (vector[0] != vector[0]) + (vector[1] != vector[1]) + (vector[2] != vector[2]);
  if (n_nan == 3) return VECTOR_FREE;
  return are_finite(vector, 3) ? VECTOR_SET : VECTOR_INVALID;
}

static int is_zero(const double *vector) { return vector[0] == 0 && vector[1] == 0 && vector[2] == 0; }

/* Returns 1 if no point is set, or if the points are all zero or all the same: a tracker that has lost
 * the hand reports such points. */
static int is_hand_lost(const double *points) {
  const double *first = 0;
  int i, k, n_points = 0, coincide = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = points + 3 * i;
    if (vector_kind(point) != VECTOR_SET) continue;
    if (!first) first = point;
    for (k = 0; k < 3; ++k) coincide &= point[k] == first[k];
    ++n_points;
  }
  return n_points == 0 || (coincide && (n_points > 1 || is_zero(first)));
}

/* Returns 1 if every vector is free or set, every normal has a point and a direction, and the tracker
 * has not lost the hand. */
static int are_contacts_valid(const double *points, const double *normals) {
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *normal = normals + 3 * i;
    const int point_kind = vector_kind(points + 3 * i), normal_kind = vector_kind(normal);
    if (point_kind == VECTOR_INVALID || normal_kind == VECTOR_INVALID) return 0;
    if (normal_kind == VECTOR_SET && (point_kind == VECTOR_FREE || is_zero(normal))) return 0;
  }
  return !is_hand_lost(points);
}

/* Values of free vectors, which have no weight. A normal must not be zero, because the graph divides by
 * its length. */
static const double UNUSED_POINT[] = {0.0, 0.0, 0.0}, UNUSED_NORMAL[] = {1.0, 0.0, 0.0};

/* Sets the contacts of the next cycle to valid points and normals. */
static void set_contacts(@PREFIX@_follower *follower, const double *points, const double *normals) {
  double *parameters = follower->parameters;
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = points + 3 * i, *normal = normals + 3 * i;
    const int has_point = vector_kind(point) == VECTOR_SET, has_normal = vector_kind(normal) == VECTOR_SET;
    copy(parameters + PARAMETER_POINTS + 3 * i, has_point ? point : UNUSED_POINT, 3);
    copy(parameters + PARAMETER_NORMALS + 3 * i, has_normal ? normal : UNUSED_NORMAL, 3);
    parameters[PARAMETER_WEIGHTS + 2 * i] = has_point ? WEIGHTS[i][0] : 0.0;
    parameters[PARAMETER_WEIGHTS + 2 * i + 1] = has_normal ? WEIGHTS[i][1] : 0.0;
  }
}

/* Sets the contacts to the unused point and normal with a weight. */
static void set_unused_contacts(@PREFIX@_follower *follower, double weight) {
  double *parameters = follower->parameters;
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    copy(parameters + PARAMETER_POINTS + 3 * i, UNUSED_POINT, 3);
    copy(parameters + PARAMETER_NORMALS + 3 * i, UNUSED_NORMAL, 3);
    parameters[PARAMETER_WEIGHTS + 2 * i] = parameters[PARAMETER_WEIGHTS + 2 * i + 1] = weight;
  }
}

#if MOVES_PALM
/* Returns 1 if a pose (rotation row by row, then the origin) is a rigid motion. */
static int is_rigid(const double *pose) {
  const double *r = pose;
  const double determinant = r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6])
                      + r[2] * (r[3] * r[7] - r[4] * r[6]);
  int i, k;
  if (!are_finite(pose, 12) || !(determinant > 0)) return 0;
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      const double product = r[3 * i] * r[3 * k] + r[3 * i + 1] * r[3 * k + 1] + r[3 * i + 2] * r[3 * k + 2];
      if (!(fabs(product - (i == k)) < 1e-6)) return 0;
    }
  }
  return 1;
}

static void set_palm_weight(@PREFIX@_follower *follower, double weight) {
  follower->parameters[PARAMETER_PALM_WEIGHT] = follower->parameters[PARAMETER_PALM_WEIGHT + 1] = weight;
}
#endif

/* Removes the target pose of the palm. */
static void clear_palm(@PREFIX@_follower *follower) {
#if MOVES_PALM
  set_palm_weight(follower, 0.0);
#else
  (void) follower;
#endif
}

/* Returns 1 if there is no target pose of the palm, or if it is rigid and an arm moves the palm. */
static int is_palm_valid(const double *palm) {
#if MOVES_PALM
  return !palm || is_rigid(palm);
#else
  return !palm;
#endif
}

/* Sets the target pose of the palm to a valid pose; a null pointer removes it. */
static void set_palm(@PREFIX@_follower *follower, const double *palm) {
  clear_palm(follower);
#if MOVES_PALM
  if (!palm) return;
  copy(follower->parameters + PARAMETER_PALM_AXES, palm, 9);
  copy(follower->parameters + PARAMETER_PALM_POINT, palm + 9, 3);
  set_palm_weight(follower, PALM_WEIGHT);
#else
  (void) palm;
#endif
}

/* Returns the signed distance that a motor travels while it brakes to rest after its last step: the sum
 * of the steps that are shorter by one change, two changes, ... */
static double stopping_distance(double last_step, double change) {
  const double speed = fabs(last_step), steps = floor(speed / change);
  const double distance = speed * steps - change * steps * (steps + 1) / 2;
  return last_step < 0 ? -distance : distance;
}

/* Computes the positions at which the motors are at rest if they brake now. */
static void posture_at_rest(const @PREFIX@_follower *follower, double *q) {
  int i;
  for (i = 0; i < N_MOTORS; ++i) {
    const double last_step = follower->state[STATE_LAST_STEP + i];
    q[i] = follower->state[STATE_Q + i] + stopping_distance(last_step, follower->max_change[i]);
  }
}

/* Removes the target: the motors decelerate to rest. */
static void clear_target(@PREFIX@_follower *follower) {
  set_unused_contacts(follower, 0.0);
  clear_palm(follower);
  posture_at_rest(follower, follower->state + STATE_GOAL);
  follower->state[STATE_LOCKED_ON] = 0.0;
}

/* Evaluates the graph of a cycle; returns 0 if the result is not finite. */
static int evaluate_cycle(@PREFIX@_follower *follower, const double *state) {
  const double *inputs[] = {state, follower->parameters};
  double *outputs[] = {follower->new_state, follower->record};
  STEP(inputs, outputs, 0);
  return is_finite(follower->record[RECORD_CHECKSUM]);
}

/* Evaluates a cycle that begins at rest at a posture; returns 0 if the result is not finite. */
static int evaluate_cycle_from_rest(@PREFIX@_follower *follower, const double *q) {
  double state[sizeof follower->state / sizeof(double)];
  memset(state, 0, sizeof state);
  copy(state + STATE_Q, q, N_MOTORS);
  copy(state + STATE_GOAL, q, N_MOTORS);
  return evaluate_cycle(follower, state);
}

@CLUTCH@
@RECOVERY@
/* Sets bounds that lead motors beyond their limits back to them. */
static void return_to_limits(@PREFIX@_follower *follower) {
  double *parameters = follower->parameters;
  int i;
  follower->is_beyond_limits = 0;
  for (i = 0; i < N_MOTORS; ++i) {
    const double q = follower->state[STATE_Q + i], change = BRAKING_SHARE * follower->max_change[i];
    const double excess = fmin(fmax(q, LOWER[i]), UPPER[i]) - q, direction = (excess > 0) - (excess < 0);
    const double step = fmin(fmax(direction * follower->state[STATE_LAST_STEP + i], 0.0) + change,
                             RETURN_SHARE * parameters[PARAMETER_MAX_STEP + i]);
    const double q_next = q + direction * fmin(step, brake(fabs(excess), change));
    parameters[PARAMETER_LOWER + i] = fmin(LOWER[i], q_next);
    parameters[PARAMETER_UPPER + i] = fmax(UPPER[i], q_next);
    follower->is_beyond_limits |= excess != 0;
  }
}

/* Makes a step towards the target, or the step of motors that brake or return, whose errors the graph
 * computes at the new positions. Returns 0, with the state unchanged, if the result is not finite. */
static int make_step(@PREFIX@_follower *follower) {
  if (follower->is_beyond_limits) return_to_limits(follower);
  if (follower->is_paused || follower->recovery.is_returning) {
    double steps[N_MOTORS], q[N_MOTORS];
    int i;
    if (follower->is_paused || !follower->recovery.has_line) braking_steps(follower, steps);
    else line_steps(follower, steps);
    for (i = 0; i < N_MOTORS; ++i) q[i] = follower->state[STATE_Q + i] + steps[i];
    if (!evaluate_cycle_from_rest(follower, q)) return 0;
    copy(follower->new_state + STATE_Q, q, N_MOTORS);
    copy(follower->new_state + STATE_LAST_STEP, steps, N_MOTORS);
    copy(follower->new_state + STATE_GOAL, q, N_MOTORS);
    follower->new_state[STATE_LOCKED_ON] = 0.0;
  } else if (!evaluate_cycle(follower, follower->state)) {
    return 0;
  }
  memcpy(follower->state, follower->new_state, sizeof follower->state);
  return 1;
}

/* Returns 1 if position errors [m] and angle errors [rad] of all fingers are within tolerance. */
static int is_met(const @PREFIX@_follower *follower, const double *position_errors, const double *angle_errors) {
  const double *position_tolerances = follower->parameters + PARAMETER_POSITION_TOLERANCE;
  const double *angle_tolerances = follower->parameters + PARAMETER_ANGLE_TOLERANCE;
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    if (!(position_errors[i] <= position_tolerances[i] * (1 + TOLERANCE_SLACK))) return 0;
    if (!(angle_errors[i] <= angle_tolerances[i] * (1 + TOLERANCE_SLACK))) return 0;
  }
  return 1;
}

/* Returns the status of a cycle with a valid target. */
static int valid_status(const @PREFIX@_follower *follower) {
  const double *record = follower->record;
  if (is_met(follower, record + RECORD_POSITION_ERROR, record + RECORD_ANGLE_ERROR)) return @GUARD@_FOLLOWING;
  if (is_met(follower, record + RECORD_GOAL_POSITION_ERROR, record + RECORD_GOAL_ANGLE_ERROR)) return @GUARD@_LATE;
  return @GUARD@_MISSED;
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
  recovery->trail_length = recovery->cycles_until_check = 1;
  recovery->has_met_contacts = recovery->destination = 0;
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
  follower->is_paused = follower->has_palm_offset = 0;
  follower->displaces_targets = 1;
  memset(follower->has_point_offset, 0, sizeof follower->has_point_offset);
  memset(follower->has_normal_rotation, 0, sizeof follower->has_normal_rotation);
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
  if (is_valid) set_recovery_cycles(follower, period);
  restart(follower, q0 ? q0 : HOME);
  return is_valid ? 0 : @GUARD@_BAD_INPUT;
}

int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm) {
  int i, is_valid = !follower->is_paused && are_contacts_valid(points, normals) && is_palm_valid(palm);
  if (is_valid) {
    set_contacts(follower, points, normals);
    set_palm(follower, palm);
    if (follower->displaces_targets) displace_target(follower);
    is_valid = make_step(follower);
  }
  if (!is_valid) {
    follow_contacts(&follower->recovery);
    clear_target(follower);
    (void) make_step(follower);
  }
  for (i = 0; i < N_MOTORS; ++i) {
    follower->q[i] = follower->state[STATE_Q + i];
    follower->velocity[i] = follower->state[STATE_LAST_STEP + i] / follower->period;
  }
  copy(follower->position_error, follower->record + RECORD_POSITION_ERROR, N_FINGERS);
  copy(follower->angle_error, follower->record + RECORD_ANGLE_ERROR, N_FINGERS);
  if (is_valid) update_recovery(follower);
  follower->status = is_valid ? valid_status(follower) : @GUARD@_HOLDING;
  return (int) follower->status;
}
