/* What `casadi_ik_map` and `casadi_ik_map_lanes` work on. */
#ifndef SINGLE
typedef double scalar;
#endif

typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* numbers from one sample to the next, 0 = the same for all */
  scalar **outputs;
  const int64_t *output_steps;
  int64_t count;               /* samples */
  int64_t next;                /* first sample not yet done */
  scalar slice;                /* [s] after which Python gets a look at its signals */
} map_job;
