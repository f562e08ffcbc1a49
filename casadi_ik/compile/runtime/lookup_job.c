/* Arguments of `casadi_ik_lookup`. */

typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* numbers from one sample to the next; 0: the same for all */
  const int16_t *tiles;        /* (tiles, pairs of entries, TILE, 2) quantized keys of the table */
  int64_t *found;              /* (count, wanted) indices of rows */
  int64_t rows;                /* number of rows of the table */
  int64_t wanted;              /* number of rows to find per sample */
  int64_t count;               /* number of samples */
  int64_t next;                /* first sample that is not done */
  scalar slice;                /* time [s] after which the driver returns for signals */
} lookup_job;
