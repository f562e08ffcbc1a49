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

/* Asks for contacts; 0: they are none. */
static int ask(@PREFIX@_follower *follower, const double *points, const double *normals) {
  static const double any[] = {1.0, 0.0, 0.0}, none[] = {0.0, 0.0, 0.0};
  double *asked = follower->asked;
  int i, touched = 0;
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = points + 3 * i, *normal = normals + 3 * i;
    const int placeless = is_free(point), faceless = is_free(normal);
    if (placeless < 0 || faceless < 0 || (placeless && !faceless)) return 0;
    if (!faceless && normal[0] == 0 && normal[1] == 0 && normal[2] == 0) return 0;
    copied(asked + ASKED_POINTS + 3 * i, placeless ? none : point, 3);
    copied(asked + ASKED_NORMALS + 3 * i, faceless ? any : normal, 3);
    asked[ASKED_WEIGHTS + 2 * i] = placeless ? 0.0 : WEIGHTS[i][0];
    asked[ASKED_WEIGHTS + 2 * i + 1] = faceless ? 0.0 : WEIGHTS[i][1];
    touched |= !placeless;
  }
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

/* One step; 0: a number was out of range, and the state is what it was. */
static int step(@PREFIX@_follower *follower) {
  const double *arg[] = {follower->state, follower->asked};
  double *res[] = {follower->after, follower->record};
  STEP(arg, res, 0);
  if (!is_finite(follower->record[RECORD_SOUND])) return 0;
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
  return sound ? 0 : @GUARD@_BAD_INPUT;
}

int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm) {
  int i, told = ask(follower, points, normals) && ask_palm(follower, palm) && step(follower);
  if (!told) {
    ask_rest(follower);
    (void) step(follower);
  }
  for (i = 0; i < N_MOTORS; ++i) {
    follower->q[i] = follower->state[STATE_Q + i];
    follower->velocity[i] = follower->state[STATE_MOVED + i] / follower->period;
  }
  copied(follower->position_error, follower->record + RECORD_POSITION_ERROR, N_FINGERS);
  copied(follower->angle_error, follower->record + RECORD_ANGLE_ERROR, N_FINGERS);
  follower->status = !told ? @GUARD@_HOLDING
      : is_met(follower, RECORD_POSITION_ERROR, RECORD_ANGLE_ERROR) ? @GUARD@_FOLLOWING
      : is_met(follower, RECORD_GOAL_POSITION_ERROR, RECORD_GOAL_ANGLE_ERROR) ? @GUARD@_LATE
      : @GUARD@_MISSED;
  return (int) follower->status;
}
