/* What a loop works on, one solve by one (loop.c) or some side by side (loop_lanes.c). */
typedef struct {
  double *states;              /* (count, N_STATE), start in, end out */
  const double *parameters;
  int64_t parameter_step;      /* doubles from one solve to the next, 0 = the same for all */
  int64_t *iterations;         /* (count), zeros at the start */
  int32_t *status;             /* (count), RUNNING at the start */
  double *seconds;             /* (count), zeros at the start */
  double *mark;                /* (SLOTS, N_STATE), states later ones are compared with; one by
                                  one only the first is used */
  unsigned char *rows;         /* (capacity) rows, or NULL: no trace */
  int64_t capacity;
  int64_t used;                /* rows written so far */
  int64_t count;               /* solves */
  int64_t solve;               /* first solve not yet begun; one by one: not yet finished */
  int64_t max_iterations;      /* of one solve; side by side at least 1 */
  double slice;                /* [s] after which Python gets a look at its signals */
  /* Only side by side: */
  int64_t *places;             /* (capacity, 2) solve and iteration of each row */
  int64_t *slots;              /* (SLOTS) the solves under way, -1 = none */
} loop_job;
