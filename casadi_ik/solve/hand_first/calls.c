/* What Python calls of hand-first: one search, a batch of them, one decision, one round's hands. */

/* k targets; all rows are one after the other. */
typedef struct {
  search *searches;            /* one for each slot of the loop */
  const double *points, *normals, *more, *here, *terms;
  const int64_t *most;
  int64_t terms_step;          /* doubles from one target's terms to the next's, 0 = the same */
  double *q, *counts;
  int64_t *restarts;
} batch;

/* Searches for the target in the job; SLICE_OVER: to be called again. */
EXPORT int casadi_ik_search(search *job) {
  int code;
  if (!job->paused && !search_begin(job)) return MALFORMED;
  code = search_run(job, FOREVER, FOREVER);
  job->paused = code == DONE && job->status == RUNNING;
  return job->paused ? SLICE_OVER : code;
}

/* A batch: `follow` for the search in a slot, which takes its question from the rows of the batch
 * and leaves its answer there. */
EXPORT int casadi_ik_follow(void *method, int64_t slot, int64_t solve, int32_t *status) {
  const batch *all = method;
  search *job = all->searches + slot;
  int code, i;
  if (*status == UNBEGUN) {
    memcpy(job->points, all->points + 3 * N_FINGERS * solve, sizeof job->points);
    memcpy(job->normals, all->normals + 3 * N_FINGERS * solve, sizeof job->normals);
    for (i = 0; i < 3 * N_FINGERS * N_MORE; ++i) {
      job->more[i] = all->more[3 * N_FINGERS * N_MORE * solve + i];
    }
    memcpy(job->here, all->here + N_MOTORS * solve, sizeof job->here);
    memcpy(job->terms, all->terms + all->terms_step * solve, sizeof job->terms);
    job->most = all->most[solve];
    job->may_begin = FOREVER;
    job->judged = 0;
  }
  code = follow(job, 0, 0, status);
  if (code != DONE) return code;
  memcpy(all->q + N_MOTORS * solve, job->q, sizeof job->q);
  memcpy(all->counts + N_COUNTS * solve, job->state + STATE_COUNTS, N_COUNTS * sizeof(double));
  all->restarts[solve] = job->restarts;
  return DONE;
}

/* One decision, for a solve by steps: `status` is how the state in the job ended, or UNBEGUN. */
EXPORT int casadi_ik_decide(search *job) {
  int32_t status = (int32_t) job->loop_status;
  job->may_begin = 1;
  job->judged = 0;
  return follow(job, 0, 0, &status);
}

/* The hands of a round whose postures look like the target, into `postures`. */
EXPORT int casadi_ik_postures(search *job) { return from_table(job, job->round); }
