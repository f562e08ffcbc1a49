/* Where the rounds of hand-first begin: hand postures, each round's of another kind.
 *
 * The first round compares the target with a table of postures. The next ones compare it with a
 * table many times as large, half of it at limits, and take only postures that differ from each
 * other: the neighbours of one that failed fail as well. Of hands with many motors every finger
 * takes the posture that suits it best by itself. What all of them miss is one of two things. Its
 * fit has come to rest in a long valley, where the contacts hardly move while the hand does: so the
 * next round begins along it, to either side of the best fit so far. Or no table holds its like:
 * then postures drawn from anywhere follow, and a whole configuration of arm and hand.
 *
 * The kernels are called by the macros LOOK_UP, CONTACTS and SEEN (if MENDS), which take a pointer to
 * a job of the drivers; the constants come from driver.py.
 */

#ifndef NUDGE
#define NUDGE 1e-6             /* difference [rad or m] from which slopes are taken */
#endif
#define AT_END 1e-6            /* this near to a limit [rad or m] a motor stays there in a valley */
#define HELD 1e6               /* what holds it, in a matrix of squared slopes of order one */
#define FLAT 1e-12             /* squared slope below which directions are alike */
#define DEPENDENT 1e-9         /* part of a direction that must be left for it to be one of its own */
#define SQUARINGS 7            /* the flattest one then counts (ratio of squared slopes)^128 times */
#define GOLDEN 0.6180339887

static const int64_t ALONE[] = {0, 0, 0, 0, 0, 0, 0, 0};

static int is_number(double x) { return x == x; }
static int is_finite(double x) { return x * 0.0 == 0.0; }

static double clipped(double x, double low, double high) {
  const double above = x > low ? x : low;
  return above < high ? above : high;
}

/* Entry of the i-th point, counted from 1, of an even spread. */
static double even(int64_t i, double step) {
  const double x = 0.5 + (double) i * step;
  return x - (double) (int64_t) x;
}

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

static map_job mapping(int64_t count, const double **inputs, const int64_t *input_steps,
                       double **outputs, const int64_t *output_steps) {
  map_job map = {0};
  map.inputs = inputs;
  map.input_steps = input_steps;
  map.outputs = outputs;
  map.output_steps = output_steps;
  map.count = count;
  map.slice = SLICE;
  return map;
}

static double apart(const double *one, const double *other) {
  double sum = 0.0;
  int i;
  for (i = 0; i < N_HAND; ++i) sum += (one[i] - other[i]) * (one[i] - other[i]);
  return sum;
}

#if MENDS
/* A table of whole hands is thin where there are many motors: of 16 motors thousands of postures are
 * fewer than two for each. Seen from a palm, though, the fingers know nothing of each other, and a
 * small table of every finger together stands for all combinations of its rows. So a posture is
 * mended in turns: the palm pose that suits it best, then for that pose the best row of each finger.
 * `left` is what is left of its contacts' squared errors with the best palm. */
static int mend_one(search *job, double *hand, double *left) {
  double wanted[FINGER_FEATURES * N_FINGERS], own[N_FINGERS], distance[FINGER_ROWS];
  const double *inputs[3];
  double *outputs[3];
  int turn, finger, i, k, code;
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
      int best = 0;
      for (i = 0; i < FINGER_ROWS; ++i) distance[i] = 0.0;
      for (k = 0; k < FINGER_FEATURES; ++k) {
        const double factor = wanted[k * N_FINGERS + finger];
        for (i = 0; i < FINGER_ROWS; ++i) distance[i] += FINGER_TIPS[finger][k][i] * factor;
      }
      for (i = 1; i < FINGER_ROWS; ++i) {
        if (distance[i] < distance[best]) best = i;
      }
      if (!(distance[best] < own[finger])) continue;
      for (k = 0; k < FINGER_MOTORS[finger]; ++k) {
        hand[FINGER_PLACES[finger][k]] = FINGER_POSTURES[finger][best][k];
      }
    }
  }
  return DONE;
}

/* The pool's postures mended; those of which least is left come first. */
static int mend(search *job, int64_t pool) {
  int64_t i, place;
  memcpy(job->mended, job->near, (size_t) pool * N_HAND * sizeof(double));
  for (i = 0; i < pool; ++i) {
    const int code = mend_one(job, job->mended + i * N_HAND, job->left + i);
    if (code != DONE) return code;
    for (place = i; place > 0 && job->left[i] < job->left[job->found[place - 1]]; --place) {
      job->found[place] = job->found[place - 1];
    }
    job->found[place] = i;
  }
  for (i = 0; i < pool; ++i) {
    memcpy(job->near + i * N_HAND, job->mended + job->found[i] * N_HAND, N_HAND * sizeof(double));
  }
  return DONE;
}
#endif

/* Of the pool of postures those that differ, best first, without the first of them. */
static void vary(search *job, int table, int64_t pool, int64_t count, int64_t first, double *into) {
  int64_t i, k, place, pick;
  for (i = 0; i < pool; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      const double range = TABLE_RANGE[table][k];
      job->places[i * N_HAND + k] = job->near[i * N_HAND + k] / (range > 0 ? range : 1.0);
    }
    job->closest[i] = 1e300;
    job->taken[i] = 0;
  }
  for (place = 0; place < count; ++place) {
    int64_t least = 4;
    pick = 0;
    for (i = 0; i < pool; ++i) {
      const int64_t rank = 2 * job->taken[i] + (job->closest[i] < ALIKE);
      if (rank < least) {
        least = rank;
        pick = i;
      }
    }
    job->taken[pick] = 1;
    for (i = 0; i < pool; ++i) {
      const double off = apart(job->places + i * N_HAND, job->places + pick * N_HAND);
      if (off < job->closest[i]) job->closest[i] = off;
    }
    if (place < first) continue;
    memcpy(into + (place - first) * N_HAND, job->near + pick * N_HAND, N_HAND * sizeof(double));
  }
}

#if MENDS
/* Mended postures that do not look like the target in particular, other ones in every round; late
 * ones by turns as they are. */
static int from_spread(search *job, int64_t number) {
  const int plain = number >= LATE_ROUND && number % 2;
  const int64_t count = plain ? N_CANDIDATES : number < LATE_ROUND ? FRESH_POOL : LATE_POOL;
  int64_t i;
  int code, k;
  for (i = 0; i < count; ++i) {
    for (k = 0; k < N_HAND; ++k) job->near[i * N_HAND + k] = posture(1, number * FRESH_POOL + i, k);
  }
  if (plain) {
    memcpy(job->postures, job->near, sizeof job->postures);
    return DONE;
  }
  code = mend(job, count);
  if (code == DONE) vary(job, 1, count, N_CANDIDATES, 0, job->postures);
  return code;
}
#endif

/* Nearest to where the robot is first; its own posture before them, instead of the last. */
static void order(search *job, int own) {
  double here[N_HAND], near[N_HAND], sorted[N_CANDIDATES * N_HAND], distance[N_CANDIDATES];
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
    double place[N_HAND];
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
  memcpy(job->postures, sorted, sizeof sorted);
}

#if N_SIDES
/* What the code of a side knows of hands: from its own search, points, normals and place of the
 * robot, and the round, into the postures. */
typedef int (*find_hands)(void *, const double *, const double *, const double *, int64_t, int64_t,
                          double *);

/* Postures of every hand whose contacts look like its part of the target. */
static int from_table(search *job, int64_t number) {
  double here[N_MOTORS], hands[N_CANDIDATES * N_HAND];
  int side, i, k, finger = 0, first = 0;
  for (side = 0; side < N_SIDES; ++side) {
    const int fingers = SIDE_FINGERS[side], count = SIDE_HANDS[side];
    int asked = 0, code;
    for (i = 0; i < fingers; ++i) asked |= is_number(job->points[3 * (finger + i)]);
    for (i = 0; i < SIDE_MOTORS[side]; ++i) here[i] = job->here[SIDE_PLACES[side][i]];
    if (asked) {
      const find_hands find = (find_hands) job->hands[side];
      code = find((void *) job->sides[side], job->points + 3 * finger, job->normals + 3 * finger,
                  here, job->terms[TERMS_NEAREST] > 0, number, hands);
      if (code != DONE) return code;
    }
    for (i = 0; i < N_CANDIDATES; ++i) {
      for (k = 0; k < count; ++k) {
        job->postures[i * N_HAND + first + k] =
            asked ? hands[i * count + k] : job->here[HAND[first + k]];
      }
    }
    finger += fingers;
    first += count;
  }
  return DONE;
}
#else
/* Postures whose contacts look like the target. */
static int from_table(search *job, int64_t number) {
  const int table = !number ? 0 : !ENFORCE_LIMITS && number % 2 ? 2 : 1;
  const int64_t wanted = number ? number * N_CANDIDATES : N_CANDIDATES;
  const int64_t most = TABLE_ROWS[table];
  int64_t pool = number ? POOL * wanted : wanted;
  int code, i, k;
#if MENDS
  if (number >= VARIED_ROUNDS) {
    code = from_spread(job, number);
    if (code == DONE && job->terms[TERMS_NEAREST] > 0) order(job, 0);
    return code;
  }
#endif
  if (pool > most) pool = most;
  code = look_up(job, table, pool);
  if (code != DONE) return code;
  for (i = 0; i < pool; ++i) {
    for (k = 0; k < N_HAND; ++k) job->near[i * N_HAND + k] = posture(table, job->found[i], k);
  }
  if (number) {
#if MENDS
    code = mend(job, pool);
    if (code != DONE) return code;
#endif
    vary(job, table, pool, wanted, wanted - N_CANDIDATES, job->postures);
  } else {
    memcpy(job->postures, job->near, sizeof job->postures);
  }
  if (job->terms[TERMS_NEAREST] > 0) order(job, !number);
  return DONE;
}

#endif

/* How the contacts move with palm and hand. */
static int find_slopes(search *job, const double *q) {
  const double *inputs[1];
  double *outputs[2];
  static const int64_t in[] = {N_MOTORS}, out[] = {3 * N_FINGERS, 3 * N_FINGERS};
  const double *base[2];
  map_job map = mapping(N_HAND + 1, inputs, in, outputs, out);
  int code, kind, i, k, m;
  for (k = 0; k <= N_HAND; ++k) {
    memcpy(job->moved + k * N_MOTORS, q, N_MOTORS * sizeof(double));
    if (k) job->moved[k * N_MOTORS + HAND[k - 1]] += NUDGE * SIZE[k - 1];
  }
  inputs[0] = job->moved;
  outputs[0] = job->moved_points;
  outputs[1] = job->moved_normals;
  code = CONTACTS(&map);
  if (code != DONE) return code;
  for (i = 0; i < (N_HAND + 1) * 3 * N_FINGERS; ++i) job->moved_points[i] /= LENGTH;
  base[0] = job->moved_points;
  base[1] = job->moved_normals;
  memset(job->rigid, 0, sizeof job->rigid);
  for (kind = 0; kind < 2; ++kind) {
    const double *target = kind ? job->normals : job->points;
    for (i = 0; i < 3 * N_FINGERS; ++i) {
      const int place = kind * 3 * N_FINGERS + i;
      const double counts = is_number(target[i - i % 3]) ? 1.0 : 0.0;
      for (k = 0; k < N_HAND; ++k) {
        const double there = base[kind][(k + 1) * 3 * N_FINGERS + i];
        job->slopes[k * 6 * N_FINGERS + place] = (there - base[kind][i]) / NUDGE * counts;
      }
      if (!HAS_ARM) continue;
      if (!kind) job->rigid[i % 3 * 6 * N_FINGERS + place] = counts;
      for (m = 0; m < 3; ++m) {
        /* The m-th axis times the vector. */
        const double *vector = base[kind] + i - i % 3;
        const int axis = i % 3;
        double turn = 0.0;
        if (axis == (m + 1) % 3) turn = -vector[(m + 2) % 3];
        if (axis == (m + 2) % 3) turn = vector[(m + 1) % 3];
        job->rigid[(3 + m) * 6 * N_FINGERS + place] = turn * counts;
      }
    }
  }
  return DONE;
}

static double product(const double *one, const double *other, int count) {
  double sum = 0.0;
  int i;
  for (i = 0; i < count; ++i) sum += one[i] * other[i];
  return sum;
}

/* What is left of a vector beside a direction. */
static void without(double *vector, const double *direction, int count) {
  const double along = product(vector, direction, count);
  int i;
  for (i = 0; i < count; ++i) vector[i] -= along * direction[i];
}

/* The direction in which the hand moves while its contacts hardly do, the palm following as well as
 * it can; 1 for the motor that moves most. The slopes change on the way. */
static void find_valley(search *job) {
  const int rows = 6 * N_FINGERS;
  double square[N_HAND * N_HAND + 1], inverse[N_HAND * N_HAND + 1], most = 0.0;
  int i, j, k, m, turn;
  for (i = 0; i < 6; ++i) {
    double *base = job->rigid + i * rows;
    const double whole = sqrt(product(base, base, rows));
    double left;
    for (j = 0; j < i; ++j) without(base, job->rigid + j * rows, rows);
    left = sqrt(product(base, base, rows));
    /* One that depends on those before is none. */
    for (k = 0; k < rows; ++k) base[k] = left > DEPENDENT * whole ? base[k] / left : 0.0;
    for (k = 0; k < N_HAND; ++k) without(job->slopes + k * rows, base, rows);
  }
  /* The inverse of the squares' matrix, by elimination in place: it is positive definite. */
  for (i = 0; i < N_HAND; ++i) {
    for (j = 0; j < N_HAND; ++j) {
      inverse[i * N_HAND + j] = product(job->slopes + i * rows, job->slopes + j * rows, rows)
                              + (i == j ? job->held[i] + FLAT : 0.0);
    }
  }
  for (k = 0; k < N_HAND; ++k) {
    const double pivot = 1.0 / inverse[k * N_HAND + k];
    inverse[k * N_HAND + k] = 1.0;
    for (j = 0; j < N_HAND; ++j) inverse[k * N_HAND + j] *= pivot;
    for (i = 0; i < N_HAND; ++i) {
      const double factor = inverse[i * N_HAND + k];
      if (i == k) continue;
      inverse[i * N_HAND + k] = 0.0;
      for (j = 0; j < N_HAND; ++j) inverse[i * N_HAND + j] -= factor * inverse[k * N_HAND + j];
    }
  }
  /* With every squaring the largest eigenvalue stands out twice as much. */
  for (turn = 0; turn < SQUARINGS; ++turn) {
    double trace = 0.0;
    for (i = 0; i < N_HAND; ++i) trace += inverse[i * N_HAND + i];
    for (i = 0; i < N_HAND * N_HAND; ++i) square[i] = inverse[i] / trace;
    for (i = 0; i < N_HAND; ++i) {
      for (j = 0; j < N_HAND; ++j) {
        double sum = 0.0;
        for (m = 0; m < N_HAND; ++m) sum += square[i * N_HAND + m] * square[m * N_HAND + j];
        inverse[i * N_HAND + j] = sum;
      }
    }
  }
  /* Of any vector that no symmetry of a hand makes orthogonal to the direction. */
  for (k = 0; k < N_HAND; ++k) {
    job->motion[k] = 0.0;
    for (j = 0; j < N_HAND; ++j) {
      job->motion[k] += inverse[k * N_HAND + j] * (0.5 + even(j, GOLDEN));
    }
    if (fabs(job->motion[k]) > most) most = fabs(job->motion[k]);
  }
  for (k = 0; k < N_HAND; ++k) job->motion[k] /= most;
}

/* Postures to either side of a fit that came to rest. */
static int along_valley(search *job, int64_t which) {
  const double *q = job->last + STATE_BEST_Q;
  int code = find_slopes(job, q), i, k;
  if (code != DONE) return code;
  for (k = 0; k < N_HAND; ++k) {
    const double at = q[HAND[k]], below = at - LOWER[HAND[k]], above = UPPER[HAND[k]] - at;
    const double end = below < above ? below : above;
    job->held[k] = which % 2 == 0 && end < AT_END ? HELD : 0.0;
  }
  find_valley(job);
  for (i = 0; i < N_CANDIDATES; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      const double step = job->motion[k] * SIZE[k];
      job->postures[i * N_HAND + k] = q[HAND[k]] + STRIDES[which * N_CANDIDATES + i] * step;
    }
  }
  return DONE;
}

/* Hand postures from anywhere, and all motors of the first of them. */
static void from_anywhere(search *job, int64_t number, double *first) {
  int i, k;
  for (i = 0; i < N_CANDIDATES; ++i) {
    const int64_t place = number * N_CANDIDATES + i + 1;
    for (k = 0; k < N_HAND; ++k) {
      const int column = HAND[k];
      job->postures[i * N_HAND + k] =
          ANYWHERE_LOWER[column] + even(place, ALL_STEPS[column]) * ANYWHERE_RANGE[column];
    }
  }
  for (k = 0; k < N_MOTORS; ++k) {
    first[k] = ANYWHERE_LOWER[k]
             + even(number * N_CANDIDATES + 1, ALL_STEPS[k]) * ANYWHERE_RANGE[k];
  }
}
