/* Evaluate a function for a batch of samples, one per call, or LANES per call.
 *
 * Requires the macros N_IN and N_OUT; in lanes also SIZES_IN and SIZES_OUT (numbers per input and
 * output, as initialisers), and TOTAL (their sum).
 */
#ifndef LANES

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

#else

/* The last call repeats the last sample in unused lanes. */
LANES_TARGET DRIVER(map_lanes, map_job) {
  static const int sizes_in[] = SIZES_IN, sizes_out[] = SIZES_OUT;
  workspace space;
  lanes *inputs[N_IN], *outputs[N_OUT], *next_values;
  int64_t ticks = 0, sample[LANES];
  scalar limit;
  int i, k, lane, outcome = set_up(&space, TOTAL);
  if (outcome != DONE) return outcome;
  next_values = space.extra;
  for (i = 0; i < N_IN; next_values += sizes_in[i++]) inputs[i] = next_values;
  for (i = 0; i < N_OUT; next_values += sizes_out[i++]) outputs[i] = next_values;
  limit = monotonic() + job->slice;
  for (; job->next < job->count; job->next += LANES) {
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (lane = 0; lane < LANES; ++lane) {
      sample[lane] = job->next + lane < job->count ? job->next + lane : job->count - 1;
    }
    for (i = 0; i < N_IN; ++i) {
      for (lane = 0; lane < LANES; ++lane) {
        const scalar *from = job->inputs[i] + sample[lane] * job->input_steps[i];
        for (k = 0; k < sizes_in[i]; ++k) ((scalar *) inputs[i])[k * LANES + lane] = from[k];
      }
    }
    for (i = 0; i < N_IN; ++i) space.arg[i] = inputs[i];
    for (i = 0; i < N_OUT; ++i) space.res[i] = outputs[i];
    STEP(space.arg, space.res, (1 << LANES) - 1);
    for (i = 0; i < N_OUT; ++i) {
      for (lane = 0; lane < LANES; ++lane) {
        scalar *to = job->outputs[i] + sample[lane] * job->output_steps[i];
        for (k = 0; k < sizes_out[i]; ++k) to[k] = ((const scalar *) outputs[i])[k * LANES + lane];
      }
    }
  }
  give_back(&space);
  return outcome;
}

#endif
