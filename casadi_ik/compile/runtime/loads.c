/* Loads: linear programs max s subject to W x + s d = 0, sum x + slack = 1, x, s, slack >= 0, by the
 * predictor-corrector method of S. Mehrotra (1992), LP_LANES programs at once. Interior-point iterates
 * end at the centre of the optimal face: equivalent edges of a cone share the force. */
enum { ROWS = 7, LP_LANES = 4 };

/* Values and masks by lane. */
typedef scalar lanes __attribute__((vector_size(LP_LANES * sizeof(scalar)), aligned(16)));
typedef int64_t lane_mask __attribute__((vector_size(LP_LANES * sizeof(scalar)), aligned(16)));

#define MIN_VARIABLE 1e-14 /* minimum of variables and dual slacks */

/* Relative regularisation of the diagonal of the normal matrix, for linearly dependent rows such as
 * those of contacts on a line, and the number of refinements that reduce its effect. */
#define REGULARISATION 1e-14
#define REFINEMENTS 2

/* Column of the matrix, with its variable x, dual slack z, their inverses, dual residual and steps. */
typedef struct {
  lanes entries[ROWS], x, z, inverse_x, inverse_z, dual, dx, dz;
} column;

typedef struct {
  const scalar *wrenches;      /* (count / n_directions, 6, edges) W */
  const scalar *directions;    /* (count, 6) d */
  scalar *solutions;           /* (count, edges + 2) x, s and slack */
  scalar *work;                /* (edges + 2) columns */
  scalar gap;                  /* mean of x z below which the program ends */
  int64_t edges, n_directions, max_steps, count, next;
  scalar slice;
} load_job;

static lanes lane_max(lanes a, lanes b) {
  const lane_mask is_greater = a > b;
  return (lanes) ((is_greater & (lane_mask) a) | (~is_greater & (lane_mask) b));
}

/* Solve with the Cholesky factor of a matrix, in place. */
static void solve_factored(lanes factor[ROWS][ROWS], lanes *y) {
  int i, k;
  for (i = 0; i < ROWS; ++i) {
    for (k = 0; k < i; ++k) y[i] -= factor[i][k] * y[k];
    y[i] *= factor[i][i];
  }
  for (i = ROWS - 1; i >= 0; --i) {
    for (k = i + 1; k < ROWS; ++k) y[i] -= factor[k][i] * y[k];
    y[i] *= factor[i][i];
  }
}

/* Return the scalar product of a column with y. */
static lanes column_dot(const column *c, const lanes *y) {
  lanes sum = c->entries[0] * y[0];
  int i;
  for (i = 1; i < ROWS; ++i) sum += c->entries[i] * y[i];
  return sum;
}

/* Compute the Newton step towards x z = `goal` - dx dz, with dx and dz of the previous step. */
static void newton_step(column *columns, int64_t n, lanes factor[ROWS][ROWS], const lanes *primal,
                        lanes goal, lanes *y) {
  lanes residual[ROWS];
  int64_t j;
  int i, pass;
  for (j = 0; j < n; ++j) {
    column *c = columns + j;
    c->dz = goal - c->dx * c->dz;
    c->dx = c->dual + c->z - c->dz * c->inverse_x;
  }
  memset(y, 0, ROWS * sizeof(lanes));
  for (pass = 0; pass < REFINEMENTS; ++pass) {
    for (i = 0; i < ROWS; ++i) residual[i] = primal[i];
    for (j = 0; j < n; ++j) {
      const column *c = columns + j;
      const lanes term = c->x * c->inverse_z * (c->dx - column_dot(c, y));
      for (i = 0; i < ROWS; ++i) residual[i] += c->entries[i] * term;
    }
    solve_factored(factor, residual);
    for (i = 0; i < ROWS; ++i) y[i] += residual[i];
  }
  for (j = 0; j < n; ++j) {
    column *c = columns + j;
    c->dx = c->x * c->inverse_z * (column_dot(c, y) - c->dx);
    c->dz = (c->dz - c->z * c->dx) * c->inverse_x - c->z;
  }
}

/* Compute the maximum step lengths, at most 1, at which all x and all z stay positive. */
static void max_step_lengths(const column *columns, int64_t n, lanes *x, lanes *z) {
  int64_t j;
  *x = *z = (lanes) {0} + 1;
  for (j = 0; j < n; ++j) {
    *x = lane_max(*x, -columns[j].dx * columns[j].inverse_x);
    *z = lane_max(*z, -columns[j].dz * columns[j].inverse_z);
  }
  *x = 1 / *x;
  *z = 1 / *z;
}

/* Compute the Cholesky factor of A diag(x / z) A', with an inverted diagonal. */
static void factorise(const column *columns, int64_t n, lanes a[ROWS][ROWS]) {
  int64_t j;
  int i, k, l;
  memset(a, 0, ROWS * ROWS * sizeof(lanes));
  for (j = 0; j < n; ++j) {
    const lanes ratio = columns[j].x * columns[j].inverse_z;
    for (i = 0; i < ROWS; ++i) {
      const lanes scaled = ratio * columns[j].entries[i];
      for (k = 0; k <= i; ++k) a[i][k] += scaled * columns[j].entries[k];
    }
  }
  for (k = 0; k < ROWS; ++k) {
    const lanes shift = REGULARISATION * a[k][k] + 1e-300;
    a[k][k] += shift;
    for (l = 0; l < k; ++l) a[k][k] -= a[k][l] * a[k][l];
    a[k][k] = lane_max(a[k][k], shift);
    for (i = 0; i < LP_LANES; ++i) a[k][k][i] = 1 / sqrt(a[k][k][i]);
    for (i = k + 1; i < ROWS; ++i) {
      for (l = 0; l < k; ++l) a[i][k] -= a[i][l] * a[k][l];
      a[i][k] *= a[k][k];
    }
  }
}

/* Make one iteration; return the mean of x z before it. */
static lanes load_step(column *columns, int64_t n, lanes *y) {
  const lanes zero = {0};
  lanes factor[ROWS][ROWS], primal[ROWS], dy[ROWS], gap = zero, affine_gap = zero, x, z;
  int64_t j;
  int i;
  memset(primal, 0, sizeof primal);
  primal[ROWS - 1] += 1;
  for (j = 0; j < n; ++j) {
    column *c = columns + j;
    c->inverse_x = 1 / c->x;
    c->inverse_z = 1 / c->z;
    c->dx = c->dz = zero;
    c->dual = -c->z - (j == n - 2);
    for (i = 0; i < ROWS; ++i) {
      primal[i] -= c->entries[i] * c->x;
      c->dual -= c->entries[i] * y[i];
    }
    gap += c->x * c->z;
  }
  factorise(columns, n, factor);
  newton_step(columns, n, factor, primal, zero, dy);
  max_step_lengths(columns, n, &x, &z);
  for (j = 0; j < n; ++j) {
    affine_gap += (columns[j].x + x * columns[j].dx) * (columns[j].z + z * columns[j].dz);
  }
  gap /= (scalar) n;
  affine_gap /= gap * (scalar) n;
  newton_step(columns, n, factor, primal, affine_gap * affine_gap * affine_gap * gap, dy);
  max_step_lengths(columns, n, &x, &z);
  for (j = 0; j < n; ++j) {
    columns[j].x = lane_max(columns[j].x + 0.99 * x * columns[j].dx, zero + MIN_VARIABLE);
    columns[j].z = lane_max(columns[j].z + 0.99 * z * columns[j].dz, zero + MIN_VARIABLE);
  }
  for (i = 0; i < ROWS; ++i) y[i] += 0.99 * z * dy[i];
  return gap;
}

DRIVER(loads, load_job) {
  const scalar limit = monotonic() + job->slice;
  const int64_t n = job->edges + 2;
  column *columns = (column *) job->work;
  for (; job->next < job->count; job->next += LP_LANES) {
    const int64_t n_programs = job->count - job->next < LP_LANES ? job->count - job->next : LP_LANES;
    int64_t step, j, l, n_running = n_programs;
    int is_done[LP_LANES] = {0}, i;
    lanes y[ROWS];
    if (monotonic() > limit) return SLICE_OVER;
    memset(y, 0, sizeof y);
    memset(columns, 0, (size_t) n * sizeof(column));
    for (l = 0; l < LP_LANES; ++l) { /* unused lanes repeat the last program */
      const int64_t number = job->next + (l < n_programs ? l : n_programs - 1);
      const scalar *wrench = job->wrenches + number / job->n_directions * 6 * job->edges;
      for (j = 0; j < n; ++j) {
        for (i = 0; i < 6 && j < job->edges; ++i) columns[j].entries[i][l] = wrench[i * job->edges + j];
        columns[j].entries[6][l] = j != job->edges;
        columns[j].x[l] = 1 / (scalar) n;
        columns[j].z[l] = 1;
      }
      for (i = 0; i < 6; ++i) columns[job->edges].entries[i][l] = job->directions[6 * number + i];
    }
    for (step = 1; step <= job->max_steps && n_running; ++step) {
      const lanes gap = load_step(columns, n, y);
      for (l = 0; l < n_programs; ++l) {
        if (is_done[l] || (gap[l] >= job->gap && step < job->max_steps)) continue;
        for (j = 0; j < n; ++j) job->solutions[n * (job->next + l) + j] = columns[j].x[l];
        is_done[l] = 1;
        --n_running;
      }
    }
  }
  return DONE;
}
