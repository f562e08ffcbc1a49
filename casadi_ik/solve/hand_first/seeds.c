/* Where the rounds of hand-first begin: hand postures, each round's of another kind.
 *
 * The first round compares the target with a table of postures. The next ones compare it with a
 * table many times as large, half of it at limits. Of hands with many motors they begin from any
 * postures, of which every finger takes the one that suits it best by itself.
 *
 * The kernels are called by the macros LOOK_UP and SEEN (if MENDS), which take a pointer to a job of
 * the drivers; the constants come from driver.py.
 */

static double posture(int table, int64_t row, int motor) {
  const double spread = (even(row + 1, HAND_STEPS[motor]) - 0.5) / TABLE_SQUEEZE[table] + 0.5;
  return TABLE_LOWER[table][motor] + clipped(spread, 0.0, 1.0) * TABLE_RANGE[table][motor];
}

static int look_up(search *job, int table, int64_t wanted) {
  const double *inputs[2];
  lookup_job look = {0};
  inputs[0] = job->points;
  inputs[1] = job->normals;
  look.inputs = inputs;
  look.input_steps = ALONE;
  look.tiles = TILES(table);
  look.found = job->found;
  look.rows = TABLE_ROWS[table];
  look.wanted = wanted;
  look.count = 1;
  return LOOK_UP(&look);
}

static double apart(const double *one, const double *other) {
  double sum = 0.0;
  int i;
  for (i = 0; i < N_HAND; ++i) sum += (one[i] - other[i]) * (one[i] - other[i]);
  return sum;
}

#if MENDS
/* The row of a finger's table that is nearest to what is wanted of it, and its distance. */
LOOPS static int nearest_row(int finger, const double *wanted, double *least) {
  double distance[FINGER_ROWS];
  int best = 0, i, k;
  for (i = 0; i < FINGER_ROWS; ++i) distance[i] = 0.0;
  for (k = 0; k < FINGER_FEATURES; ++k) {
    const double factor = wanted[k * N_FINGERS + finger];
    for (i = 0; i < FINGER_ROWS; ++i) distance[i] += FINGER_TIPS[finger][k][i] * factor;
  }
  for (i = 1; i < FINGER_ROWS; ++i) {
    if (distance[i] < distance[best]) best = i;
  }
  *least = distance[best];
  return best;
}

/* A table of whole hands is thin where there are many motors: of 16 motors thousands of postures are
 * fewer than two for each. Seen from a palm, though, the fingers know nothing of each other, and a
 * small table of every finger together stands for all combinations of its rows. So a posture is
 * mended in turns: the palm pose that suits it best, then for that pose the best row of each finger.
 * `left` is what is left of its contacts' squared errors with the best palm. */
static int mend_one(search *job, double *hand, double *left) {
  double wanted[FINGER_FEATURES * N_FINGERS], own[N_FINGERS], least;
  const double *inputs[3];
  double *outputs[3];
  int turn, finger, k, code;
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = hand;
  outputs[0] = wanted;
  outputs[1] = own;
  outputs[2] = left;
  for (turn = 0; turn <= FINGER_TURNS; ++turn) {
    map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
    code = SEEN(&map);
    if (code != DONE) return code;
    for (finger = 0; turn < FINGER_TURNS && finger < N_FINGERS; ++finger) {
      const int best = nearest_row(finger, wanted, &least);
      if (!(least < own[finger])) continue;
      for (k = 0; k < FINGER_MOTORS[finger]; ++k) {
        hand[FINGER_PLACES[finger][k]] = FINGER_POSTURES[finger][best][k];
      }
    }
  }
  return DONE;
}

/* Postures from those of `near`: of the mended ones those of which least is left. */
static int mend(search *job, int64_t count) {
  int64_t i, place;
  for (i = 0; i < count; ++i) {
    const int code = mend_one(job, job->near + i * N_HAND, job->left + i);
    if (code != DONE) return code;
    for (place = i; place > 0 && job->left[i] < job->left[job->found[place - 1]]; --place) {
      job->found[place] = job->found[place - 1];
    }
    job->found[place] = i;
  }
  for (i = 0; i < N_CANDIDATES; ++i) {
    const double *best = job->near + job->found[i % count] * N_HAND;
    memcpy(job->postures + i * N_HAND, best, N_HAND * sizeof(double));
  }
  return DONE;
}
#endif

#if MENDS
/* Mended postures that do not look like the target in particular, other ones in every round; late
 * ones by turns as they are. */
static int from_spread(search *job, int64_t number) {
  const int plain = number >= LATE_ROUND && number % 2;
  const int64_t count = plain ? N_CANDIDATES : POOL;
  int64_t i;
  int k;
  for (i = 0; i < count; ++i) {
    for (k = 0; k < N_HAND; ++k) job->near[i * N_HAND + k] = posture(1, number * POOL + i, k);
  }
  if (plain) {
    memcpy(job->postures, job->near, sizeof job->postures);
    return DONE;
  }
  return mend(job, count);
}
#endif

/* Nearest to where the robot is first; its own posture before them, instead of the last. */
static void order(search *job, int own) {
  /* One number more than needed: a tool has no motors, and C no empty arrays. */
  double here[N_HAND + 1], near[N_HAND + 1], sorted[N_CANDIDATES * N_HAND + 1];
  double distance[N_CANDIDATES];
  const int first = own && HAS_ARM && N_CANDIDATES > 1;
  const int count = first ? N_CANDIDATES - 1 : N_CANDIDATES;
  int i, j, k;
  for (k = 0; k < N_HAND; ++k) {
    const int column = HAND[k];
    here[k] = clipped(job->here[column], job->terms[TERMS_LOWER + column],
                      job->terms[TERMS_UPPER + column]);
    near[k] = here[k] / ORDER_RANGES[k];
  }
  for (i = 0; i < count; ++i) {
    double place[N_HAND + 1];
    for (k = 0; k < N_HAND; ++k) place[k] = job->postures[i * N_HAND + k] / ORDER_RANGES[k];
    distance[i] = apart(place, near);
  }
  for (i = 0; i < count; ++i) {
    int before = first;
    for (j = 0; j < count; ++j) {
      before += distance[j] < distance[i] || (distance[j] == distance[i] && j < i);
    }
    for (k = 0; k < N_HAND; ++k) sorted[before * N_HAND + k] = job->postures[i * N_HAND + k];
  }
  for (k = 0; first && k < N_HAND; ++k) sorted[k] = here[k];
  memcpy(job->postures, sorted, N_CANDIDATES * N_HAND * sizeof(double));
}

/* Postures whose contacts look like the target, in later rounds the next best of another table. */
static int from_table(search *job, int64_t number) {
  const int table = !number ? 0 : !ENFORCE_LIMITS && number % 2 ? 2 : 1;
  const int64_t before = number ? (number - 1) * N_CANDIDATES : 0;
  int code, i, k;
#if MENDS
  if (number) {
    code = from_spread(job, number);
    if (code == DONE && job->terms[TERMS_NEAREST] > 0) order(job, 0);
    return code;
  }
#endif
  code = look_up(job, table, before + N_CANDIDATES);
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      job->postures[i * N_HAND + k] = posture(table, job->found[before + i], k);
    }
  }
  if (job->terms[TERMS_NEAREST] > 0) order(job, !number);
  return DONE;
}
