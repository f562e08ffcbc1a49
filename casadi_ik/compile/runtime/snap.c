/* Palms and hands moved until pads touch a surface: damped least squares, limits kept.
 *
 * Rows of a pad: its height over the surface, sliding along it (nearly free), and the part of its
 * lean beyond what it does for nothing. The step maps q to pads, their normals, and both Jacobians
 * over the fingers' motors, all in the palm's frame. Expects the macros N_Q, N_F (fingers), N_M
 * (their motors) and NEIGHBOURS (of a sample).
 */
typedef struct {
  scalar *palms;               /* (count, 12) rotation row by row, origin; of the object's frame */
  scalar *q;                   /* (count, N_Q) */
  const int64_t *used;         /* (count, N_F) */
  const int64_t *motors;       /* (N_M) which of q they are */
  const scalar *lower, *upper; /* (N_M) */
  const scalar *radii, *free_lean; /* (N_F) */
  const scalar *samples, *normals, *faces; /* (m, 3) */
  const int64_t *neighbours;   /* (m, NEIGHBOURS) */
  const int64_t *start;        /* (count, N_F) samples near the pads */
  scalar slide, turn;
  int64_t steps, count, next;
  scalar slice;
} snap_job;

enum { N_X = 6 + N_M };

static scalar product(const scalar *a, const scalar *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void times(const scalar *a, const scalar *b, scalar *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

static scalar apart_from(const snap_job *job, int64_t sample, const scalar *point) {
  const scalar *at = job->samples + 3 * sample;
  const scalar off[3] = {point[0] - at[0], point[1] - at[1], point[2] - at[2]};
  return product(off, off);
}

/* The nearest sample, from one that is near: always on to the nearest of its neighbours. */
static int64_t nearest_sample(const snap_job *job, int64_t sample, const scalar *point) {
  scalar best = apart_from(job, sample, point);
  for (;;) {
    const int64_t *row = job->neighbours + NEIGHBOURS * sample, before = sample;
    int k;
    for (k = 0; k < NEIGHBOURS; ++k) {
      const scalar here = apart_from(job, row[k], point);
      if (here < best) {
        best = here;
        sample = row[k];
      }
    }
    if (sample == before) return sample;
  }
}

/* Solves A x = b for a symmetric, positive matrix, whose lower part becomes its factor. */
static void solve(scalar a[N_X][N_X], const scalar *b, scalar *x) {
  int i, j, k;
  for (j = 0; j < N_X; ++j) {
    scalar over;
    for (k = 0; k < j; ++k) a[j][j] -= a[j][k] * a[j][k];
    a[j][j] = sqrt(a[j][j]);
    over = 1 / a[j][j];
    for (i = j + 1; i < N_X; ++i) {
      for (k = 0; k < j; ++k) a[i][j] -= a[i][k] * a[j][k];
      a[i][j] *= over;
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

/* A row of the least squares: adds its square, and what it wants. */
static void row_of(const scalar *row, scalar weight, scalar goal, scalar a[N_X][N_X], scalar *b) {
  int i, j;
  for (i = 0; i < N_X; ++i) {
    const scalar own = weight * row[i];
    if (own == 0) continue;
    for (j = 0; j <= i; ++j) a[i][j] += own * row[j];
    b[i] += own * goal;
  }
}

static scalar bounded(scalar x, scalar low, scalar high) {
  return x < low ? low : x > high ? high : x;
}

/* The rows of a finger's pad, in the object's frame. */
static void pad_rows(const snap_job *job, int f, const scalar *palm, scalar *const *res,
                     int64_t *sample, scalar a[N_X][N_X], scalar *b) {
  scalar jacobian[2][3][N_X], point[3], faces[3], arm[3], axis[3], row[N_X], lean, length, height;
  const scalar *normal;
  int i, j, k;
  memset(jacobian, 0, sizeof jacobian);
  for (k = 0; k < 3; ++k) {
    arm[k] = product(palm + 3 * k, res[0] + 3 * f);
    point[k] = arm[k] + palm[9 + k];
    faces[k] = product(palm + 3 * k, res[1] + 3 * f);
    for (i = 0; i < 2; ++i) {
      for (j = 0; j < N_M; ++j) {
        const scalar *column = res[2 + i] + 3 * f * N_M + j;
        jacobian[i][k][6 + j] = palm[3 * k] * column[0] + palm[3 * k + 1] * column[N_M]
                              + palm[3 * k + 2] * column[2 * N_M];
      }
    }
    /* A twist (v, w) of the palm moves a point by v + w x arm, and turns a normal by w. */
    jacobian[0][k][k] = jacobian[1][k][3 + k] = 1;
  }
  for (k = 0; k < 3; ++k) {
    jacobian[0][k][3 + (k + 1) % 3] = arm[(k + 2) % 3];
    jacobian[0][k][3 + (k + 2) % 3] = -arm[(k + 1) % 3];
  }
  *sample = nearest_sample(job, *sample, point);
  normal = job->normals + 3 * *sample;
  for (k = 0; k < 3; ++k) point[k] -= job->samples[3 * *sample + k];
  height = product(point, job->faces + 3 * *sample) - job->radii[f];
  for (j = 0; j < N_X; ++j) {
    row[j] = normal[0] * jacobian[0][0][j] + normal[1] * jacobian[0][1][j]
           + normal[2] * jacobian[0][2][j];
  }
  row_of(row, 1, -height, a, b);
  lean = acos(bounded(-product(faces, normal), -1, 1)) - job->free_lean[f];
  times(normal, faces, axis);
  length = sqrt(product(axis, axis));
  lean = lean > 0 ? lean / (length > 1e-9 ? length : 1e-9) : 0;
  for (k = 0; k < 3; ++k) {
    row_of(jacobian[0][k], job->slide * job->slide, 0, a, b);
    row_of(jacobian[1][k], job->turn * job->turn, lean * axis[k], a, b);
  }
}

/* One step of a palm and a hand, whose pads are as `res` tells. */
static void step_of(const snap_job *job, scalar *palm, scalar *q, const int64_t *used,
                    int64_t *sample, scalar *const *res) {
  scalar whole[N_X][N_X] = {{0}}, part[N_X][N_X], b[N_X] = {0}, want[N_X], x[N_X], turn[3][3], c, s;
  scalar angle, old[9];
  int stays[N_M] = {0}, pass, i, j, k, again = 1;
  for (i = 0; i < N_F; ++i) if (used[i]) pad_rows(job, i, palm, res, sample + i, whole, b);
  for (pass = 0; pass < 2 && again; ++pass) {
    for (i = 0; i < N_X; ++i) {
      const int fixed = i >= 6 && stays[i - 6];
      want[i] = fixed ? 0 : b[i];
      for (j = 0; j <= i; ++j) {
        part[i][j] = fixed || (j >= 6 && stays[j - 6]) ? 0 : whole[i][j];
      }
      part[i][i] += fixed ? 1 : i < 3 ? 1e-4 : 1e-6;
    }
    solve(part, want, x);
    for (again = i = 0; i < N_M; ++i) {
      const scalar after = q[job->motors[i]] + x[6 + i];
      if (after >= job->lower[i] && after <= job->upper[i]) continue;
      stays[i] = again = 1;
    }
  }
  for (i = 0; i < N_M; ++i) {
    scalar *own = q + job->motors[i];
    *own = bounded(*own + bounded(x[6 + i], -0.3, 0.3), job->lower[i], job->upper[i]);
  }
  for (k = 0; k < 3; ++k) {
    palm[9 + k] += bounded(x[k], -0.02, 0.02);
    x[3 + k] = bounded(x[3 + k], -0.5, 0.5);
  }
  angle = sqrt(product(x + 3, x + 3));
  s = angle > 1e-9 ? sin(angle) / angle : 1;
  c = angle > 1e-9 ? (1 - cos(angle)) / (angle * angle) : 0.5;
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) turn[i][j] = c * x[3 + i] * x[3 + j] + (i == j ? cos(angle) : 0);
    turn[i][(i + 1) % 3] -= s * x[3 + (i + 2) % 3];
    turn[i][(i + 2) % 3] += s * x[3 + (i + 1) % 3];
  }
  memcpy(old, palm, sizeof old);
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) {
      palm[3 * i + j] = turn[i][0] * old[j] + turn[i][1] * old[3 + j] + turn[i][2] * old[6 + j];
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
      step_of(job, palm, q, job->used + N_F * job->next, sample, space.res);
    }
  }
  give_back(&space);
  return outcome;
}
