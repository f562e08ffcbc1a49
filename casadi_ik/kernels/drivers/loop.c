/* A step run to its end for each solve of a batch.
 *
 * A step is a function of state and parameters alone, so a state that comes back bit for bit comes
 * back for ever, and so does everything between: such a solve would run to its budget and ends as
 * REPEATED instead. Noticed as by Brent (1980): every state is compared with that of the last
 * iteration whose number is a power of two, so a cycle is found within its length after the first
 * such iteration in it that is no smaller than its length. It begins at FIRST_MARK: most solves end
 * before, and keeping states for a comparison costs.
 *
 * Expects the macros N_STATE, N_RECORD, ROW_BYTES, RUNNING, NON_FINITE, FAILED, REPEATED, CODE_LIMIT
 * and the function store_row(record, row). Everything that must survive a pause lives in the
 * job's arrays, so a call that returns SLICE_OVER or ROWS_FULL is taken up again by calling once more.
 */

/* x * 0 is 0 for finite x and NaN otherwise; sums have no branch and no library call, and four of
 * them need not wait for each other. */
static int all_finite(const double *x) {
  double sum[4] = {0, 0, 0, 0};
  int i, j;
  for (i = 0; i + 4 <= N_STATE; i += 4) {
    for (j = 0; j < 4; ++j) sum[j] += x[i + j] * 0.0;
  }
  for (; i < N_STATE; ++i) sum[0] += x[i] * 0.0;
  return (sum[0] + sum[1]) + (sum[2] + sum[3]) == 0;
}

EXPORT int casadi_ik_loop(loop_job *job) {
  workspace space;
  double *now, *next, *record, code, limit;
  int64_t ticks = 0;
  int outcome = set_up(&space, 2 * N_STATE + N_RECORD);
  if (outcome != DONE) return outcome;
  now = space.extra;
  next = now + N_STATE;
  record = next + N_STATE;
  limit = monotonic() + job->slice;

  for (; job->solve < job->count; ++job->solve) {
    const int64_t i = job->solve;
    const double *parameters = job->parameters + i * job->parameter_step;
    int64_t iteration = job->iterations[i];
    int32_t status = RUNNING;
    const double started = monotonic();
    memcpy(now, job->states + i * N_STATE, N_STATE * sizeof(double));
    while (status == RUNNING && iteration < job->max_iterations) {
      if (job->rows && job->used == job->capacity) {
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
        status = FAILED;
        break;
      }
      ++iteration;
      if (job->rows) store_row(record, job->rows + ROW_BYTES * job->used++);
      /* Written so that a NaN code fails the test too. */
      if (!(code > -CODE_LIMIT && code < CODE_LIMIT) || !all_finite(next)) {
        status = NON_FINITE;
      } else {
        double *last = now;
        now = next;
        next = last;
        status = (int32_t) code;
        if (status == RUNNING && iteration > FIRST_MARK
            && !memcmp(now, job->mark, N_STATE * sizeof(double))) status = REPEATED;
        if (is_marked(iteration)) memcpy(job->mark, now, N_STATE * sizeof(double));
      }
    }
    memcpy(job->states + i * N_STATE, now, N_STATE * sizeof(double));
    job->iterations[i] = iteration;
    job->status[i] = status;
    job->seconds[i] += monotonic() - started;
    if (outcome != DONE) break;
  }
  give_back(&space);
  return outcome;
}
