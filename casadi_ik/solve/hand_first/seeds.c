/* Seeds of the restarts of hand-first: hand postures from tables.
 *
 * The first restart compares the target with a table of postures. The next restarts compare it
 * with a larger table, half of whose postures are at limits. For hands with many motors they take
 * low-discrepancy postures instead and repair them finger by finger.
 *
 * The macros LOOK_UP and FINGER_ERRORS (if REPAIRS) call kernels with a pointer to a job;
 * search_code.py defines the constants.
 */

/* Return the position of a motor in a row of a table of postures. */
static double table_posture(int table, int64_t row, int motor) {
  const double part = (even(row + 1, HAND_STEPS[motor]) - 0.5) / TABLE_SQUEEZE[table] + 0.5;
  return TABLE_LOWER[table][motor] + clipped(part, 0.0, 1.0) * TABLE_RANGE[table][motor];
}

/* Write the `count` rows of a table nearest to the target to `seed_rows`, nearest first. */
static int look_up_rows(search *job, int table, int64_t count) {
  const double *inputs[2];
  lookup_job look = {0};
  inputs[0] = job->points;
  inputs[1] = job->normals;
  look.inputs = inputs;
  look.input_steps = ALONE;
  look.tiles = TILES(table);
  look.nearest_rows = job->seed_rows;
  look.rows = TABLE_ROWS[table];
  look.n_nearest = count;
  look.count = 1;
  return LOOK_UP(&look);
}

static double squared_distance(const double *a, const double *b) {
  double sum = 0.0;
  int i;
  for (i = 0; i < N_HAND; ++i) sum += (a[i] - b[i]) * (a[i] - b[i]);
  return sum;
}

#if REPAIRS
/* Return the row of a finger's table nearest to its target features, and its distance. */
LOOPS static int nearest_row(int finger, const double *features, double *min_distance) {
  double distance[FINGER_ROWS];
  int best = 0, i, k;
  for (i = 0; i < FINGER_ROWS; ++i) distance[i] = 0.0;
  for (k = 0; k < FINGER_FEATURES; ++k) {
    const double factor = features[k * N_FINGERS + finger];
    for (i = 0; i < FINGER_ROWS; ++i) distance[i] += FINGER_TIPS[finger][k][i] * factor;
  }
  for (i = 1; i < FINGER_ROWS; ++i) {
    if (distance[i] < distance[best]) best = i;
  }
  *min_distance = distance[best];
  return best;
}

/* Repair a hand posture finger by finger; `error` is its remaining sum of squared contact errors
 * with the best palm pose.
 *
 * A table of whole hands is sparse for many motors: with 16 motors, thousands of postures are
 * fewer than two values per motor. Given the palm pose, however, fingers are independent, and
 * small tables of single fingers cover all combinations of their rows. The repair alternates
 * between the best palm pose of the posture and the best row of each finger for that pose. */
static int repair_per_finger(search *job, double *hand, double *error) {
  double features[FINGER_FEATURES * N_FINGERS], finger_errors[N_FINGERS], distance;
  const double *inputs[3];
  double *outputs[3];
  int pass, finger, k, code;
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = hand;
  outputs[0] = features;
  outputs[1] = finger_errors;
  outputs[2] = error;
  for (pass = 0; pass <= FINGER_TURNS; ++pass) {
    map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
    code = FINGER_ERRORS(&map);
    if (code != DONE) return code;
    for (finger = 0; pass < FINGER_TURNS && finger < N_FINGERS; ++finger) {
      const int best = nearest_row(finger, features, &distance);
      if (!(distance < finger_errors[finger])) continue;
      for (k = 0; k < FINGER_MOTORS[finger]; ++k) {
        hand[FINGER_COLUMNS[finger][k]] = FINGER_POSTURES[finger][best][k];
      }
    }
  }
  return DONE;
}

/* Repair the postures of the seed pool; the seeds are those with the smallest errors. */
static int repair_pool(search *job, int64_t count) {
  int64_t i, rank;
  for (i = 0; i < count; ++i) {
    const int code = repair_per_finger(job, job->seed_pool + i * N_HAND, job->seed_error + i);
    if (code != DONE) return code;
    for (rank = i; rank > 0; --rank) {
      if (!(job->seed_error[i] < job->seed_error[job->seed_rows[rank - 1]])) break;
      job->seed_rows[rank] = job->seed_rows[rank - 1];
    }
    job->seed_rows[rank] = i;
  }
  for (i = 0; i < N_CANDIDATES; ++i) {
    const double *best = job->seed_pool + job->seed_rows[i % count] * N_HAND;
    memcpy(job->postures + i * N_HAND, best, N_HAND * sizeof(double));
  }
  return DONE;
}
#endif

#if REPAIRS
/* Seed with low-discrepancy postures, different ones in every restart, and repair them unless the
 * restart omits it. */
static int seed_repaired(search *job, int64_t number) {
  const int64_t count = repairs_seeds(number) ? POOL : N_CANDIDATES;
  int64_t i;
  int k;
  for (i = 0; i < count; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      job->seed_pool[i * N_HAND + k] = table_posture(TABLE_OF_LATER_SEEDS, number * POOL + i, k);
    }
  }
  if (!repairs_seeds(number)) {
    memcpy(job->postures, job->seed_pool, sizeof job->postures);
    return DONE;
  }
  return repair_pool(job, count);
}
#endif

/* Sort the seeds by their distance to the hand of q0. If `inserts_q0`, that hand replaces the last
 * seed and comes first. */
static void sort_by_distance_to_q0(search *job, int inserts_q0) {
  /* One element more than needed, because a rigid tool has no motors and C has no empty arrays. */
  double hand_of_q0[N_HAND + 1], scaled_q0[N_HAND + 1], sorted[N_CANDIDATES * N_HAND + 1];
  double distance[N_CANDIDATES];
  const int first = inserts_q0 && HAS_ARM && N_CANDIDATES > 1;
  const int count = first ? N_CANDIDATES - 1 : N_CANDIDATES;
  int i, j, k;
  for (k = 0; k < N_HAND; ++k) {
    const int column = HAND[k];
    hand_of_q0[k] = clipped(job->q0[column], job->settings[SETTINGS_LOWER + column],
                            job->settings[SETTINGS_UPPER + column]);
    scaled_q0[k] = hand_of_q0[k] / ORDER_RANGES[k];
  }
  for (i = 0; i < count; ++i) {
    double scaled[N_HAND + 1];
    for (k = 0; k < N_HAND; ++k) scaled[k] = job->postures[i * N_HAND + k] / ORDER_RANGES[k];
    distance[i] = squared_distance(scaled, scaled_q0);
  }
  for (i = 0; i < count; ++i) {
    int rank = first;
    for (j = 0; j < count; ++j) {
      rank += distance[j] < distance[i] || (distance[j] == distance[i] && j < i);
    }
    for (k = 0; k < N_HAND; ++k) sorted[rank * N_HAND + k] = job->postures[i * N_HAND + k];
  }
  for (k = 0; first && k < N_HAND; ++k) sorted[k] = hand_of_q0[k];
  memcpy(job->postures, sorted, N_CANDIDATES * N_HAND * sizeof(double));
}

/* Seed with the postures whose contacts resemble the target most; in later restarts with the next
 * best of a larger table. */
static int seed_from_tables(search *job, int64_t number) {
  const int table = table_of_restart(number);
  const int64_t first = number ? (number - 1) * N_CANDIDATES : 0;
  int code, i, k;
#if REPAIRS
  if (number) {
    code = seed_repaired(job, number);
    if (code == DONE && job->settings[SETTINGS_NEAREST] > 0) sort_by_distance_to_q0(job, 0);
    return code;
  }
#endif
  code = look_up_rows(job, table, first + N_CANDIDATES);
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      job->postures[i * N_HAND + k] = table_posture(table, job->seed_rows[first + i], k);
    }
  }
  if (job->settings[SETTINGS_NEAREST] > 0) sort_by_distance_to_q0(job, !number);
  return DONE;
}
