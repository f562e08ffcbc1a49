/* Evaluate a function for a batch of samples. Requires the macros N_IN and N_OUT. */

DRIVER(map, map_job) {
  workspace space;
  int outcome = set_up(&space, 0);
  int64_t ticks = 0;
  scalar limit = 0;
  int i;
  if (outcome != DONE) return outcome;
  if (job->count - job->next > CLOCK_INTERVAL) limit = monotonic() + job->slice;
  for (; job->next < job->count; ++job->next) {
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (i = 0; i < N_IN; ++i) space.arg[i] = job->inputs[i] + job->next * job->input_steps[i];
    for (i = 0; i < N_OUT; ++i) space.res[i] = job->outputs[i] + job->next * job->output_steps[i];
    STEP(space.arg, space.res, 0);
  }
  give_back(&space);
  return outcome;
}
