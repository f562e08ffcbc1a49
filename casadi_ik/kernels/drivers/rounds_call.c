
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
