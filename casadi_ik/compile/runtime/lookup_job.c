/* What `casadi_ik_lookup` works on. */

typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* numbers from one sample to the next, 0 = the same for all */
  const int16_t *tiles;        /* (tiles, pairs of entries, TILE, 2) keys of the table in steps */
  int64_t *found;              /* (count, wanted) */
  int64_t rows;                /* of the table */
  int64_t wanted;
  int64_t count;               /* samples */
  int64_t next;                /* first sample not yet done */
  scalar slice;                /* [s] after which Python gets a look at its signals */
} lookup_job;
