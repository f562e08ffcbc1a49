/* Job of the lookup (lookup.c). */

typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* distance between consecutive samples; 0: shared by all samples */
  const int16_t *tiles;        /* (tiles, pairs of entries, TILE, 2) quantized keys of the table */
  int64_t *nearest_rows;             /* (count, n_nearest) indices of rows */
  int64_t rows;                /* number of rows of the table */
  int64_t n_nearest;              /* number of rows to find per sample */
  int64_t count;               /* number of samples */
  int64_t next;                /* next sample to compute */
  scalar slice;                /* time until SLICE_OVER, so that Python handles signals [s] */
} lookup_job;
