/* Refinement of palms and hands until pads touch a surface: damped least squares within limits.
 *
 * Residuals of a pad: its height over the surface, its sliding along the surface (with a low weight),
 * and the excess of its lean over the permitted lean. The step maps q to pads, their normals, and the
 * Jacobians of both with respect to the fingers' motors, all in the palm frame. Requires the macros
 * N_Q (motors), N_F (fingers), N_M (fingers' motors) and NEIGHBOURS (of a sample).
 */
typedef struct {
  scalar *palms;               /* (count, 12) rotation row by row, origin; object frame */
  scalar *q;                   /* (count, N_Q) */
  const int64_t *touches;      /* (count, N_F) 1 for fingers that touch */
  const int64_t *motors;       /* (N_M) indices of the fingers' motors in q */
  const scalar *lower, *upper; /* (N_M) */
  const scalar *radii, *free_lean; /* (N_F) */
  const scalar *samples, *normals, *faces; /* (m, 3) */
  const int64_t *neighbours;   /* (m, NEIGHBOURS) */
  const int64_t *start;        /* (count, N_F) nearest samples of the initial pads */
  scalar sliding_weight, lean_length;
  int64_t steps, count, next;
  scalar slice;
} snap_job;

enum { N_X = 6 + N_M };

static scalar dot_product(const scalar *a, const scalar *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross_product(const scalar *a, const scalar *b, scalar *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

/* Return the squared distance between a sample and a point. */
static scalar square_to_sample(const snap_job *job, int64_t sample, const scalar *point) {
  const scalar *p = job->samples + 3 * sample;
  const scalar offset[3] = {point[0] - p[0], point[1] - p[1], point[2] - p[2]};
  return dot_product(offset, offset);
}

/* Return the nearest sample by descent along neighbours from a nearby sample. */
static int64_t nearest_sample(const snap_job *job, int64_t sample, const scalar *point) {
  scalar best = square_to_sample(job, sample, point);
  for (;;) {
    const int64_t *row = job->neighbours + NEIGHBOURS * sample, previous = sample;
    int k;
    for (k = 0; k < NEIGHBOURS; ++k) {
      const scalar square = square_to_sample(job, row[k], point);
      if (square < best) {
        best = square;
        sample = row[k];
      }
    }
    if (sample == previous) return sample;
  }
}

/* Solve A x = b for a positive definite matrix, whose lower triangle becomes its Cholesky factor. */
static void solve(scalar a[N_X][N_X], const scalar *b, scalar *x) {
  int i, j, k;
  for (j = 0; j < N_X; ++j) {
    scalar inverse;
    for (k = 0; k < j; ++k) a[j][j] -= a[j][k] * a[j][k];
    a[j][j] = sqrt(a[j][j]);
    inverse = 1 / a[j][j];
    for (i = j + 1; i < N_X; ++i) {
      for (k = 0; k < j; ++k) a[i][j] -= a[i][k] * a[j][k];
      a[i][j] *= inverse;
    }
  }
  for (i = 0; i < N_X; ++i) {
    x[i] = b[i];
    for (k = 0; k < i; ++k) x[i] -= a[i][k] * x[k];
    x[i] /= a[i][i];
  }
  for (i = N_X - 1; i >= 0; --i) {
    for (k = i + 1; k < N_X; ++k) x[i] -= a[k][i] * x[k];
    x[i] /= a[i][i];
  }
}

/* Add a row of the least-squares problem to the normal matrix and the right-hand side. */
static void add_row(const scalar *row, scalar weight, scalar goal, scalar a[N_X][N_X], scalar *b) {
  int i, j;
  for (i = 0; i < N_X; ++i) {
    const scalar weighted = weight * row[i];
    if (weighted == 0) continue;
    for (j = 0; j <= i; ++j) a[i][j] += weighted * row[j];
    b[i] += weighted * goal;
  }
}

static scalar clamp(scalar x, scalar low, scalar high) {
  return x < low ? low : x > high ? high : x;
}

/* Add the rows of the pad of finger f, in the object frame. */
static void add_pad_rows(const snap_job *job, int f, const scalar *palm, scalar *const *res,
                     int64_t *sample, scalar a[N_X][N_X], scalar *b) {
  scalar jacobian[2][3][N_X], point[3], pad_normal[3], arm[3], axis[3], row[N_X], lean, length, height;
  const scalar *normal;
  int i, j, k;
  memset(jacobian, 0, sizeof jacobian);
  for (k = 0; k < 3; ++k) {
    arm[k] = dot_product(palm + 3 * k, res[0] + 3 * f);
    point[k] = arm[k] + palm[9 + k];
    pad_normal[k] = dot_product(palm + 3 * k, res[1] + 3 * f);
    for (i = 0; i < 2; ++i) {
      for (j = 0; j < N_M; ++j) {
        const scalar *column = res[2 + i] + 3 * f * N_M + j;
        jacobian[i][k][6 + j] = palm[3 * k] * column[0] + palm[3 * k + 1] * column[N_M]
                              + palm[3 * k + 2] * column[2 * N_M];
      }
    }
    /* A twist (v, w) of the palm moves a point by v + w x arm and rotates a normal by w. */
    jacobian[0][k][k] = jacobian[1][k][3 + k] = 1;
  }
  for (k = 0; k < 3; ++k) {
    jacobian[0][k][3 + (k + 1) % 3] = arm[(k + 2) % 3];
    jacobian[0][k][3 + (k + 2) % 3] = -arm[(k + 1) % 3];
  }
  *sample = nearest_sample(job, *sample, point);
  normal = job->normals + 3 * *sample;
  for (k = 0; k < 3; ++k) point[k] -= job->samples[3 * *sample + k];
  height = dot_product(point, job->faces + 3 * *sample) - job->radii[f];
  for (j = 0; j < N_X; ++j) {
    row[j] = normal[0] * jacobian[0][0][j] + normal[1] * jacobian[0][1][j]
           + normal[2] * jacobian[0][2][j];
  }
  add_row(row, 1, -height, a, b);
  lean = acos(clamp(-dot_product(pad_normal, normal), -1, 1)) - job->free_lean[f];
  cross_product(normal, pad_normal, axis);
  length = sqrt(dot_product(axis, axis));
  lean = lean > 0 ? lean / (length > 1e-9 ? length : 1e-9) : 0;
  for (k = 0; k < 3; ++k) {
    add_row(jacobian[0][k], job->sliding_weight * job->sliding_weight, 0, a, b);
    add_row(jacobian[1][k], job->lean_length * job->lean_length, lean * axis[k], a, b);
  }
}

/* Make one step of a palm and a hand whose pads are in `res`. Motors that would exceed a limit are
 * fixed, and the step is computed again. */
static void refine(const snap_job *job, scalar *palm, scalar *q, const int64_t *touches,
                   int64_t *sample, scalar *const *res) {
  scalar normal_matrix[N_X][N_X] = {{0}}, reduced[N_X][N_X], b[N_X] = {0}, reduced_b[N_X], x[N_X];
  scalar rotation[3][3], c, s, angle, previous[9];
  int is_fixed[N_M] = {0}, pass, i, j, k, is_unsettled = 1;
  for (i = 0; i < N_F; ++i) {
    if (touches[i]) add_pad_rows(job, i, palm, res, sample + i, normal_matrix, b);
  }
  for (pass = 0; pass < 2 && is_unsettled; ++pass) {
    for (i = 0; i < N_X; ++i) {
      const int row_is_fixed = i >= 6 && is_fixed[i - 6];
      reduced_b[i] = row_is_fixed ? 0 : b[i];
      for (j = 0; j <= i; ++j) {
        reduced[i][j] = row_is_fixed || (j >= 6 && is_fixed[j - 6]) ? 0 : normal_matrix[i][j];
      }
      reduced[i][i] += row_is_fixed ? 1 : i < 3 ? 1e-4 : 1e-6;
    }
    solve(reduced, reduced_b, x);
    for (is_unsettled = i = 0; i < N_M; ++i) {
      const scalar position = q[job->motors[i]] + x[6 + i];
      if (position >= job->lower[i] && position <= job->upper[i]) continue;
      is_fixed[i] = is_unsettled = 1;
    }
  }
  for (i = 0; i < N_M; ++i) {
    scalar *position = q + job->motors[i];
    *position = clamp(*position + clamp(x[6 + i], -0.3, 0.3), job->lower[i], job->upper[i]);
  }
  for (k = 0; k < 3; ++k) {
    palm[9 + k] += clamp(x[k], -0.02, 0.02);
    x[3 + k] = clamp(x[3 + k], -0.5, 0.5);
  }
  angle = sqrt(dot_product(x + 3, x + 3));
  s = angle > 1e-9 ? sin(angle) / angle : 1;
  c = angle > 1e-9 ? (1 - cos(angle)) / (angle * angle) : 0.5;
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) rotation[i][j] = c * x[3 + i] * x[3 + j] + (i == j ? cos(angle) : 0);
    rotation[i][(i + 1) % 3] -= s * x[3 + (i + 2) % 3];
    rotation[i][(i + 2) % 3] += s * x[3 + (i + 1) % 3];
  }
  memcpy(previous, palm, sizeof previous);
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) {
      palm[3 * i + j] = rotation[i][0] * previous[j] + rotation[i][1] * previous[3 + j]
                      + rotation[i][2] * previous[6 + j];
    }
  }
}

DRIVER(snap, snap_job) {
  workspace space;
  const scalar limit = monotonic() + job->slice;
  int outcome = set_up(&space, N_F * (6 + 6 * N_M)), i;
  int64_t sample[N_F], step;
  if (outcome != DONE) return outcome;
  space.res[0] = space.extra;
  space.res[1] = space.res[0] + 3 * N_F;
  space.res[2] = space.res[1] + 3 * N_F;
  space.res[3] = space.res[2] + 3 * N_F * N_M;
  for (; job->next < job->count; ++job->next) {
    scalar *palm = job->palms + 12 * job->next, *q = job->q + N_Q * job->next;
    if (monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (i = 0; i < N_F; ++i) sample[i] = job->start[N_F * job->next + i];
    for (step = 0; step < job->steps; ++step) {
      space.arg[0] = q;
      STEP(space.arg, space.res, 0);
      refine(job, palm, q, job->touches + N_F * job->next, sample, space.res);
    }
  }
  give_back(&space);
  return outcome;
}
