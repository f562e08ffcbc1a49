
/* All rounds for the target in the job. */
#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int casadi_ik_rounds(rounds *job) {
  int code;
  if (!job->paused && !rounds_begin(job)) return MALFORMED;
  do code = rounds_run(job, BUDGET);
  while (code == DONE && job->status == RUNNING);
  job->paused = code == SLICE_OVER;
  return code;
}

/* The rounds from job->round on: `state` is how those before ended. UNHELPED: none is left that may
 * help. */
#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int casadi_ik_rounds_on(rounds *job) {
  job->under_way = 0;
  job->iterations = 0;
  job->again = 0;
  job->status = RUNNING;
  while (job->round < job->rounds && !is_hopeful(job, job->round)) ++job->round;
  if (job->round >= job->rounds && !search_again(job)) return UNHELPED;
  job->paused = 1;
  return casadi_ik_rounds(job);
}
