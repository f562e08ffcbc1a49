/* Entry points for Python: one search, a batch, one decision, and the seeds of one restart. */

/* k targets with contiguous rows. */
typedef struct {
  search *searches;            /* one for each slot of the loop */
  const double *points, *normals, *extra_vectors, *q0, *settings;
  const int64_t *max_restarts;
  int64_t settings_step;       /* doubles from one target's settings to the next's, 0 = the same */
  double *q, *counts;
  int64_t *restarts;
} batch;

/* Search for the target in the job; returns SLICE_OVER if it has to be called again. */
EXPORT int casadi_ik_search(search *job) {
  int code;
  if (!job->paused && !search_begin(job)) return MALFORMED;
  code = search_run(job, FOREVER, FOREVER);
  job->paused = code == DONE && job->status == RUNNING;
  return job->paused ? SLICE_OVER : code;
}

/* Call `follow` for the search in a slot, which reads its target from the rows of the batch and
 * writes its answer there. */
EXPORT int casadi_ik_follow(void *method, int64_t slot, int64_t solve, int32_t *status) {
  const batch *rows = method;
  search *job = rows->searches + slot;
  int code, i;
  if (*status == UNBEGUN) {
    memcpy(job->points, rows->points + 3 * N_FINGERS * solve, sizeof job->points);
    memcpy(job->normals, rows->normals + 3 * N_FINGERS * solve, sizeof job->normals);
    for (i = 0; i < 3 * N_FINGERS * N_EXTRA_VECTORS; ++i) {
      job->extra_vectors[i] = rows->extra_vectors[3 * N_FINGERS * N_EXTRA_VECTORS * solve + i];
    }
    memcpy(job->q0, rows->q0 + N_MOTORS * solve, sizeof job->q0);
    memcpy(job->settings, rows->settings + rows->settings_step * solve, sizeof job->settings);
    job->max_restarts = rows->max_restarts[solve];
    job->restart_quota = FOREVER;
    job->has_verdict = 0;
  }
  code = follow(job, 0, 0, status);
  if (code != DONE) return code;
  memcpy(rows->q + N_MOTORS * solve, job->q, sizeof job->q);
  memcpy(rows->counts + N_COUNTS * solve, job->state + STATE_COUNTS, N_COUNTS * sizeof(double));
  rows->restarts[solve] = job->restarts;
  return DONE;
}

/* Decide once, for a solve by steps: `loop_status` is how the iterations ended, or UNBEGUN. */
EXPORT int casadi_ik_decide(search *job) {
  int32_t status = (int32_t) job->loop_status;
  job->restart_quota = 1;
  job->has_verdict = 0;
  return follow(job, 0, 0, &status);
}

/* Write the seeds of a restart from tables to `postures`. */
EXPORT int casadi_ik_postures(search *job) { return seed_from_tables(job, job->round); }
