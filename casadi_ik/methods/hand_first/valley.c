/* Rounds of hand-first for what the tables of seeds.c miss, because a fit has come to rest in a long
 * valley, where the contacts hardly move while the hand does: the next round begins along it, to
 * either side of the best fit so far.
 *
 * Kernels and constants as in seeds.c, and CONTACTS.
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
