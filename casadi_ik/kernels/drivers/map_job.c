/* What `casadi_ik_map` and `casadi_ik_map_lanes` work on. */

typedef struct {
  const double **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* doubles from one sample to the next, 0 = the same for all */
  double **outputs;
  const int64_t *output_steps;
  int64_t count;               /* samples */
  int64_t next;                /* first sample not yet done */
  double slice;                /* [s] after which Python gets a look at its signals */
} map_job;
