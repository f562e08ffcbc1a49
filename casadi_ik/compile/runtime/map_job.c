/* Job of a map (map.c, map_lanes.c). */
#ifndef SINGLE
typedef double scalar;
#endif

typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* distance between consecutive samples; 0: shared by all samples */
  scalar **outputs;
  const int64_t *output_steps;
  int64_t count;               /* number of samples */
  int64_t next;                /* next sample to compute */
  scalar slice;                /* time until SLICE_OVER, so that Python handles signals [s] */
} map_job;
