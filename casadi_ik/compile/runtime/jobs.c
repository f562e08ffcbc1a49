/* Jobs of the drivers in map.c, lookup.c and loop.c. */
#ifndef SINGLE
typedef double scalar;
#endif

/* Job of a map. */
typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* distance between consecutive samples; 0: shared by all samples */
  scalar **outputs;
  const int64_t *output_steps;
  int64_t count;               /* number of samples */
  int64_t next;                /* next sample to compute */
  scalar slice;                /* time until SLICE_OVER, so that Python handles signals [s] */
} map_job;

/* Job of the lookup. */
typedef struct {
  const scalar **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* distance between consecutive samples; 0: shared by all samples */
  const int16_t *tiles;        /* (tiles, pairs of entries, TILE, 2) quantized keys of the table */
  int64_t *nearest_rows;       /* (count, n_nearest) indices of rows */
  int64_t rows;                /* number of rows of the table */
  int64_t n_nearest;           /* number of rows to find per sample */
  int64_t count;               /* number of samples */
  int64_t next;                /* next sample to compute */
  scalar slice;                /* time until SLICE_OVER, so that Python handles signals [s] */
} lookup_job;

/* Job of the loop. */
typedef struct {
  scalar *states;              /* (count, N_STATE) first states in, last states out; with `follow`
                                  (slot_count, N_STATE), written by it */
  scalar *parameters;          /* likewise (., N_PARAMETERS) */
  int64_t state_step;          /* distance between consecutive states */
  int64_t parameter_step;      /* likewise; 0: shared by all solves */
  int64_t *iterations;         /* (count), zeros at the start */
  int32_t *status;             /* (count), initially RUNNING; with `follow` UNBEGUN */
  scalar *seconds;             /* (count), zeros at the start */
  int64_t *slots;              /* (slot_count) solve in each slot; -1: none */
  int64_t *iterations_before;  /* (slot_count) iterations of the solve before its last start */
  scalar *mark;                /* (slot_count, N_STATE) marked states for the detection of cycles */
  int64_t slot_count;          /* at most SLOTS */
  unsigned char *rows;         /* (capacity) rows; NULL without a trace */
  int64_t *row_owners;         /* (capacity, 2) solve and iteration of each row */
  int64_t capacity;
  int64_t n_rows;              /* number of rows written */
  int64_t count;               /* number of solves */
  int64_t solve;               /* next solve to start */
  int64_t max_iterations;      /* per start, at least 1 */
  int64_t remaining_steps;     /* steps until SLICE_OVER */
  int64_t min_solves;          /* the loop with lanes stops when fewer solves remain */
  scalar slice;                /* time until SLICE_OVER, so that Python handles signals [s] */
  /* Called when the solve in a slot has ended (with its status; RUNNING at max_iterations) or is new
   * (UNBEGUN). Returns CONTINUES after writing a start, DONE, or the reason to stop the loop. */
  int (*follow)(void *method, int64_t slot, int64_t solve, int32_t *status);
  void *method;
} loop_job;
