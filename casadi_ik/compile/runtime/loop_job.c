/* What a loop works on (loop.c). */
#ifndef SINGLE
typedef double scalar;
#endif

typedef struct {
  scalar *states;              /* N_STATE numbers of each solve, start in, end out; of each slot
                                  where there is `follow`, which writes the starts */
  scalar *parameters;          /* likewise */
  int64_t state_step;          /* numbers from one to the next */
  int64_t parameter_step;      /* likewise, 0 = the same for all */
  int64_t *iterations;         /* (count), zeros at the start */
  int32_t *status;             /* (count), at the start RUNNING; UNBEGUN where there is `follow` */
  scalar *seconds;             /* (count), zeros at the start */
  int64_t *slots;              /* (slot_count) the solve in each slot, -1 = none */
  int64_t *begun;              /* (slot_count) iterations of its solve before its last start */
  scalar *mark;                /* (slot_count, N_STATE) states that later ones are compared with */
  int64_t slot_count;          /* solves under way at a time, at most SLOTS */
  unsigned char *rows;         /* (capacity) rows, or NULL: no trace */
  int64_t *places;             /* (capacity, 2) solve and iteration of each row */
  int64_t capacity;
  int64_t used;                /* rows written so far */
  int64_t count;               /* solves */
  int64_t solve;               /* first solve not yet begun */
  int64_t max_iterations;      /* of one start, at least 1 */
  int64_t left;                /* steps until a pause (SLICE_OVER) */
  int64_t fewest;              /* with fewer solves left than that the loop for several stops */
  scalar slice;                /* [s] after which Python gets a look at its signals */
  /* What follows when the solve in a slot has ended (its status; RUNNING: at its budget) or is new
   * (UNBEGUN): GOES_ON from the start written; DONE; or why the loop has to stop. */
  int (*follow)(void *method, int64_t slot, int64_t solve, int32_t *status);
  void *method;
} loop_job;
