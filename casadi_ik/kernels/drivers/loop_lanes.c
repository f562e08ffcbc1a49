/* loop.c for four solves side by side, each as it would be alone: see there.
 *
 * A lane that has finished its solve takes the next one; the order of the rows is put right in
 * Python, from `places`.
 */

typedef struct {
  double *states;              /* (count, N_STATE), start in, end out */
  const double *parameters;
  int64_t parameter_step;      /* doubles from one solve to the next, 0 = the same for all */
  int64_t *iterations;         /* (count), zeros at the start */
  int32_t *status;             /* (count), RUNNING at the start */
  double *seconds;             /* (count), zeros at the start; solves side by side share the time */
  double *mark;                /* (N_STATE, LANES), the states later ones are compared with */
  unsigned char *rows;         /* (capacity) rows, or NULL: no trace */
  int64_t capacity;
  int64_t used;                /* rows written so far */
  int64_t count;               /* solves */
  int64_t solve;               /* first solve not yet begun */
  int64_t max_iterations;      /* of one solve, at least 1 */
  double slice;                /* [s] after which Python gets a look at its signals */
  int64_t *places;             /* (capacity, 2) solve and iteration of each row */
  int64_t *running;            /* (LANES) the solve of each lane, -1 = none */
} loop_job;

#define LANE(pack, k, lane) (((double *) (pack))[(k) * LANES + (lane)])

static void load(const loop_job *job, int lane, lanes *state, lanes *parameters) {
  const double *from = job->states + job->running[lane] * N_STATE;
  int k;
  for (k = 0; k < N_STATE; ++k) LANE(state, k, lane) = from[k];
  from = job->parameters + job->running[lane] * job->parameter_step;
  for (k = 0; k < N_PARAMETERS; ++k) LANE(parameters, k, lane) = from[k];
}

static void save(const loop_job *job, int lane, const lanes *state) {
  double *to = job->states + job->running[lane] * N_STATE;
  int k;
  for (k = 0; k < N_STATE; ++k) to[k] = LANE(state, k, lane);
}

/* A free lane gets the next solve; what it worked on before stays in it if there is none. */
static int fill(loop_job *job, lanes *state, lanes *parameters) {
  int lane, busy = 0;
  for (lane = 0; lane < LANES; ++lane) {
    if (job->running[lane] < 0 && job->solve < job->count) {
      job->running[lane] = job->solve++;
      load(job, lane, state, parameters);
    }
    busy += job->running[lane] >= 0;
  }
  return busy;
}

static void write_rows(loop_job *job, const lanes *record) {
  double own[N_RECORD + 1];
  int lane, k;
  for (lane = 0; lane < LANES; ++lane) {
    const int64_t solve = job->running[lane];
    if (solve < 0) continue;
    for (k = 0; k < N_RECORD; ++k) own[k] = LANE(record, k, lane);
    job->places[2 * job->used] = solve;
    job->places[2 * job->used + 1] = job->iterations[solve] - 1;
    store_row(own, job->rows + ROW_BYTES * job->used++);
  }
}

/* Which lanes have a finite state, and which the one they were marked at. */
LANES_TARGET static void examine(
    const lanes *next, const lanes *mark, lane_mask *finite, lane_mask *repeated) {
  lanes sum = {0};
  lane_mask apart = {0};
  int k;
  for (k = 0; k < N_STATE; ++k) {
    sum += next[k] * SPREAD(0.0);
    apart |= (lane_mask) next[k] ^ (lane_mask) mark[k];
  }
  *finite = (lane_mask) (sum == SPREAD(0.0));
  *repeated = (lane_mask) (apart == (lane_mask) {0});
}

/* The seconds since last time, shared by the solves that were running. */
static void share(loop_job *job, int busy, double *since) {
  const double now = monotonic(), each = busy ? (now - *since) / busy : 0;
  int lane;
  for (lane = 0; lane < LANES; ++lane) {
    if (job->running[lane] >= 0) job->seconds[job->running[lane]] += each;
  }
  *since = now;
}

/* Whether this machine can run what LANES_TARGET asks for. */
EXPORT int casadi_ik_has_lanes(void) {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx2") != 0;
#else
  return 1;
#endif
}

EXPORT LANES_TARGET int casadi_ik_loop_lanes(loop_job *job) {
  workspace space;
  lanes *now, *next, *parameters, *mark, *record, code;
  lane_mask finite, repeated;
  int64_t ticks = 0;
  double limit, since;
  int lane, k, busy, outcome = set_up(&space, 3 * N_STATE + N_PARAMETERS + N_RECORD);
  if (outcome != DONE) return outcome;
  now = space.extra;
  next = now + N_STATE;
  mark = next + N_STATE;
  parameters = mark + N_STATE;
  record = parameters + N_PARAMETERS;
  memcpy(mark, job->mark, N_STATE * sizeof(lanes));
  memset(now, 0, N_STATE * sizeof(lanes));
  memset(parameters, 0, N_PARAMETERS * sizeof(lanes));
  for (lane = 0; lane < LANES; ++lane) {
    if (job->running[lane] >= 0) load(job, lane, now, parameters);
  }
  since = monotonic();
  limit = since + job->slice;

  while ((busy = fill(job, now, parameters))) {
    int ended = 0;
    while (!ended) {
      lanes *last = now;
      if (job->rows && job->used + LANES > job->capacity) {
        outcome = ROWS_FULL;
        break;
      }
      if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
        outcome = SLICE_OVER;
        break;
      }
      space.arg[0] = now;
      space.arg[1] = parameters;
      space.res[0] = next;
      space.res[1] = job->rows ? record : NULL;
      space.res[2] = &code;
      if (STEP(space.arg, space.res, space.iw, space.w, space.mem)) {
        give_back(&space);
        return STEP_FAILED;
      }
      examine(next, mark, &finite, &repeated);
      now = next;
      next = last;
      for (lane = 0; lane < LANES; ++lane) {
        if (job->running[lane] >= 0) ++job->iterations[job->running[lane]];
      }
      if (job->rows) write_rows(job, record);
      for (lane = 0; lane < LANES; ++lane) {
        const int64_t solve = job->running[lane];
        int64_t iteration;
        int32_t status;
        if (solve < 0) continue;
        iteration = job->iterations[solve];
        /* Written so that a NaN code fails the test too. */
        if (!(code[lane] > -CODE_LIMIT && code[lane] < CODE_LIMIT) || !finite[lane]) {
          status = NON_FINITE;
        } else {
          status = (int32_t) code[lane];
          if (status == RUNNING && iteration > 1 && repeated[lane]) status = REPEATED;
        }
        if (!(iteration & (iteration - 1))) {
          for (k = 0; k < N_STATE; ++k) LANE(mark, k, lane) = LANE(now, k, lane);
        }
        if (status == RUNNING && iteration < job->max_iterations) continue;
        if (!ended) share(job, busy, &since);
        ended = 1;
        save(job, lane, status == NON_FINITE ? last : now);
        job->status[solve] = status;
        job->running[lane] = -1;
      }
    }
    if (outcome != DONE) {
      share(job, busy, &since);
      for (lane = 0; lane < LANES; ++lane) {
        if (job->running[lane] >= 0) save(job, lane, now);
      }
      break;
    }
  }
  memcpy(job->mark, mark, N_STATE * sizeof(lanes));
  give_back(&space);
  return outcome;
}
